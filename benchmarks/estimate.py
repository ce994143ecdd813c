"""What an elliptic solve with 10^9 cells on 10^3 ranks would take: a model, fed with what is measured here.

Measured: processor seconds a cell and iteration on one rank; how iterations grow with the grid; messages and bytes of
an iteration, counted by Open MPI on 27 ranks, one of which has neighbours on all sides. Assumed: the network below;
that messages grow as the levels do, as log(cells), and bytes as the surface of a block; that each rank has as much
memory bandwidth as the one that was measured alone. No network is measured; this is an estimate. The measured times of
one process and of two ranks are printed beside it. Two ranks wait for each other, so their times are wall-clock times,
which need a machine without other work.

Run ``python -m benchmarks.estimate [--cells 96] [--ranks 27]`` in the root of the repository, where PETSc is installed.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from math import log, log2
from pathlib import Path

import numpy as np

import sparsedp as dp

LATENCY = 2e-6  # [s] of a message from one machine to another
BANDWIDTH = 1e10  # [bytes / s] of a rank
REDUCTIONS = 3  # in an iteration of conjugate gradients
RTOL = 1e-6
SHARE, WHOLE = 1e6, 1e9  # cells of one rank, and of all
SECONDS = 540  # after which a run is given up
COUNTED = 48  # cells along an axis where messages are counted


def solved(grid, laps):
    """Solve div k grad u = b; return the iterations and the least CPU and elapsed seconds, without the set-up."""
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), rtol=RTOL)
    x, y = grid.centres()[:2]
    k, b = dp.average(grid)(np.exp(np.sin(6 * x) * np.sin(6 * y))), np.sin(7 * x) * np.cos(5 * y) + x
    times = []
    for _ in range(laps + 1):
        start = time.process_time(), time.perf_counter()
        solve(k, b)
        times.append((time.process_time() - start[0], time.perf_counter() - start[1]))
    return solve.info.forward.iterations, *map(min, zip(*times, strict=True))


def child(shape, laps):
    """One of the ranks: print what `solved` returns."""
    from mpi4py import MPI

    result = solved(dp.distribute(dp.Grid(shape, size=1.0), MPI.COMM_WORLD), laps)
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(result))


def on_ranks(count, shape, laps, *options):
    """Run `child` on `count` ranks."""
    name = "x".join(map(str, shape))
    command = ["mpirun", "--oversubscribe", *options, "-n", str(count), sys.executable, "-m", "mpi4py"]
    command += ["-m", "benchmarks.estimate", "--shape", name, "--laps", str(laps)]
    settings = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    done = subprocess.run(command, env=settings, capture_output=True, text=True, timeout=SECONDS, check=False)
    if done.returncode:
        sys.exit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def sent(count, shape, laps):
    """Return messages and bytes of each rank, one row for each, in a program of `laps` solves."""
    with tempfile.TemporaryDirectory() as folder:
        names = {"enable": "1", "enable_output": "3", "filename": f"{folder}/sent"}
        options = [word for name, value in names.items() for word in ("--mca", f"pml_monitoring_{name}", value)]
        iterations = on_ranks(count, shape, laps, *options)[0]
        total = np.zeros((count, 2))
        for path in Path(folder).iterdir():
            for line in path.read_text().splitlines():  # E, from, to, bytes, "bytes", messages, ...
                if line.startswith("E"):
                    _, rank, _, size, _, number, *_ = line.split()
                    total[int(rank)] += int(number), int(size)
    return iterations, total


def messages(count):
    """Messages and bytes of the busiest rank in one iteration: what another solve adds, and so all of it."""
    shape = (COUNTED,) * 3
    (iterations, once), (_, twice) = (sent(count, shape, laps) for laps in (0, 1))
    return np.max((twice - once) / iterations, axis=0)


def table(seconds, growth, iterations, counted, count):
    """Rows of the model: seconds a cell and iteration on one rank, iterations of 10^6 cells, and per doubling."""
    rows, alone = [], seconds * SHARE * iterations
    rows.append((1, SHARE, seconds * SHARE, 0, 0, 0, alone, 1.0))
    many = np.ceil(iterations + growth * log2(WHOLE / SHARE) / 3)
    for ranks in (10**3, 10**4, 10**5):
        cells = WHOLE / ranks
        number = counted[0] * log(WHOLE) / log(COUNTED**3)
        size = counted[1] * (cells * count / COUNTED**3) ** (2 / 3)
        parts = seconds * cells, number * LATENCY, size / BANDWIDTH, REDUCTIONS * log2(ranks) * LATENCY
        solve = many * sum(parts)
        rows.append((ranks, cells, *parts, solve, alone * WHOLE / SHARE / (ranks * solve)))
    return rows, many, number


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=96, help="along an axis, where seconds are measured")
    parser.add_argument("--ranks", type=int, default=27, help="on which messages are counted")
    parser.add_argument("--laps", type=int, default=5, help="of which the fastest counts")
    parser.add_argument("--shape", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.shape:
        return child(tuple(map(int, options.shape.split("x"))), options.laps)
    n, laps = options.cells, options.laps
    heads = "one process", "1 rank", "by a clock", "2 ranks"
    print(f"{'one solve to ' + format(RTOL, '.0e'):18}", *(f"{head:>11}" for head in heads), " iterations of each")
    dp.set_threads(1)
    for shape in ((512, 512), (n, n, n)):
        alone, one, two = solved(dp.Grid(shape, size=1.0), laps), *(on_ranks(k, shape, laps) for k in (1, 2))
        cells = "  ".join(f"{1e3 * seconds:7.0f} ms" for seconds in (alone[1], one[1], one[2], two[2]))
        print(f"{'x'.join(map(str, shape)):18} {cells}  {alone[0]:6} {one[0]:6} {two[0]:6}", flush=True)
    iterations, seconds = one[0], one[1] / (one[0] * n**3)
    few = on_ranks(1, (n // 4,) * 3, 0)[0]
    growth = max(iterations - few, 0) / 2
    counted = messages(options.ranks)
    print(
        f"measured on 1 rank: {1e9 * seconds:.0f} ns a cell and iteration; iterations: {few} at {n // 4}^3, "
        f"{iterations} at {n}^3"
    )
    print(
        f"measured on {options.ranks} ranks at {COUNTED}^3: an iteration sends {counted[0]:.0f} messages, "
        f"{counted[1] / 1e3:.0f} kB from the busiest rank"
    )
    rows, many, number = table(seconds, growth, iterations + growth * log2(SHARE / n**3) / 3, counted, options.ranks)
    print(
        f"assumed: {1e6 * LATENCY:.0f} us a message, {BANDWIDTH / 1e9:.0f} GB/s; {many:.0f} iterations of "
        f"{number:.0f} messages at {WHOLE:.0e} cells"
    )
    columns = "ranks", "cells a rank", "compute", "messages", "bytes", "reductions", "one solve", "efficiency"
    print(" ".join(f"{head:>12}" for head in columns))
    for ranks, cells, *parts, solve, efficiency in rows:
        times = " ".join(f"{1e3 * part:9.2f} ms" for part in parts)
        print(f"{ranks:12} {cells:12.0f} {times} {solve:10.2f} s {100 * efficiency:10.0f} %")
    return None


if __name__ == "__main__":
    main()
