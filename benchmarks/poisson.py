"""Solves of Poisson's equation, forward and adjoint, beside transforms and PyAMG: times and errors in each row.

Sections, each a few minutes at most: transforms, variable, sizes, jumps, anisotropy, adjoint, memory.
Run ``python -m benchmarks.poisson SECTION ... [--quick]`` in the root of the repository. Times are the
smallest of a few, for one right-hand side; "first s" is the first solve, which loads the compiled
kernels and touches fresh memory. PyAMG has one thread. Only ratios of one run mean anything.
"""

import argparse
import os
import subprocess
import sys
from functools import partial
from itertools import product

import numpy as np

import sparsedp as dp
from benchmarks.scenes import ANISOTROPIC, JUMPS, VARIABLE, WINDS
from benchmarks.solves import HEAD, Ours, PyAMG, row
from sparsedp import kernels
from sparsedp._utils.counters import recording

MEMORY = {(4096, 4096): 8, (256, 256, 256): 14}  # unknowns: GB for set-up, forward and adjoint solve


def ours(method, **options):
    return lambda op: Ours(op, method, **options)


def table(title):
    print(f"\n{title}\n{HEAD}")


def both_threads(scene, op, method):
    """Rows for one thread and for all; the seconds of one thread, which PyAMG is held against."""
    found = {}
    for threads in sorted({1, _most()}):
        dp.set_threads(threads)
        found[threads] = row(f"{scene}, {threads}t", op, ours(method))
    dp.set_threads()
    return found[1]


def _most():
    dp.set_threads()
    return kernels.threads()


def transforms(quick):
    """Box, constant coefficients: forward + adjoint <= 1.15 x the bare pair of transforms (1.6 x without numba)."""
    for plain in ([], ["--plain"]):
        subprocess.run([sys.executable, "-m", "benchmarks.transforms", *plain, *["--quick"] * quick], check=True)


def variable(quick):
    """No transform possible: one thread >= 15 x PyAMG, set-up <= 1/20 of Ruge-Stueben."""
    shapes = ((256, 256), (32, 32, 32)) if quick else ((1024, 1024), (128, 128, 128))
    for shape in shapes:
        table(f"{' x '.join(map(str, shape))}; limits: solve 15 x PyAMG, set-up 1/20")
        for name, make in VARIABLE.items():
            op = make(shape)
            row(f"{name}, warm-up", op, ours("structured"), 1)
            fast, slow = both_threads(name, op, "structured"), row(name, op, PyAMG, 1)
            print(f"{name}: solve {slow[0] / fast[0]:.1f} x faster than PyAMG, set-up 1/{slow[1] / fast[1]:.1f}")


def sizes(quick):
    """Iterations <= 12 to 1e-10 at every size; time linear in the unknowns (exponent <= 1.1)."""
    table("structured at growing sizes; limits: 12 iterations, exponent 1.1")
    dp.set_threads(1)
    for shapes in ([(n, n) for n in (128, 256, 512, 1024, 2048)], [(n, n, n) for n in (32, 64, 128)]):
        shapes = shapes[:2] if quick else shapes
        for name, make in VARIABLE.items():
            seconds = [row(f"{name}, {shape[0]}", make(shape), ours("structured"), 5)[0] for shape in shapes]
            order = np.polyfit(np.log([np.prod(shape) for shape in shapes]), np.log(seconds), 1)[0]
            print(f"{name}: exponent {order:.2f}")
    dp.set_threads()


def jumps(quick):
    """Jumps of 1e6: backward error <= 1e-12 and >= 4 x PyAMG; inclusions <= 30 iterations; honest in every case."""
    shape = (96, 96) if quick else (512, 512)
    table(f"jumps, {shape[0]} x {shape[1]}; limits: backward error 1e-12, 4 x PyAMG, 30 iterations for inclusions")
    for name, make in JUMPS.items():
        op = make(shape)
        fast = both_threads(name, op, "auto")
        row(name, op, ours("structured"))
        row(name, op, ours("multigrid"))
        row(name, op, ours("direct"))
        slow = row(name, op, partial(PyAMG, rtol=1e-12), 2)
        print(f"{name}: auto solves {slow[0] / fast[0]:.1f} x faster than PyAMG")


def anisotropy(quick):
    """Anisotropy 1e-6 and cell aspect 1e4: <= 30 iterations."""
    table("anisotropy; limit: 30 iterations")
    for n in (64,) if quick else (64, 256, 512):
        for name, make in ANISOTROPIC.items():
            for method in ("auto", "multigrid", "structured"):
                row(f"{name}, {n}", make((n, n)), ours(method))


def adjoint(quick):
    """Not symmetric: the adjoint within 20 % of the forward iterations, without a second set-up."""
    table("advection and diffusion; limit: adjoint iterations 1.2 x forward")
    for n in (60,) if quick else (60, 100, 200, 400):
        for (name, make), strength in product(WINDS.items(), (20.0, 500.0, 1e5)):
            op = make((n, n), strength)
            with recording() as calls:
                row(f"{name} {strength:g}, {n}", op, ours("multigrid"))
            print(f"set-ups: {sum(number for (_, what), number in calls.items() if what == 'setup')}")


def memory(quick):
    """Peak memory of a process that sets up, solves forward and adjoint."""
    table("largest problems; limits: 8 GB for 4096^2, 14 GB for 256^3")
    for shape, limit in MEMORY.items():
        shape = tuple(n // 8 for n in shape) if quick else shape
        for method in ("separable", "structured", "multigrid"):
            code = f"from benchmarks.poisson import one; one({shape}, {method!r}, {limit})"
            subprocess.run([sys.executable, "-c", code], check=False)


def one(shape, method, limit):
    """One row, and the peak memory of this process. Killed rather than let the machine run out."""
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (20 << 30, 20 << 30))
    name = "x".join(map(str, shape))
    op = -dp.laplacian(dp.Grid(shape, size=1.0), dp.dirichlet) if method == "separable" else VARIABLE["smooth k"](shape)
    try:
        row(name, op, ours(method), 1)
    except MemoryError:
        print(f"{name:17}{method:23} more than 20 GB")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{name}, {method}: peak {peak:.1f} GB, limit {limit}", flush=True)


SECTIONS = {f.__name__: f for f in (transforms, variable, sizes, jumps, anisotropy, adjoint, memory)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("sections", nargs="*", choices=[*SECTIONS, []], help=", ".join(SECTIONS))
    parser.add_argument("--quick", action="store_true", help="small sizes")
    chosen = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name in chosen.sections or SECTIONS:
        print(f"\n== {name}: {SECTIONS[name].__doc__}")
        SECTIONS[name](chosen.quick)


if __name__ == "__main__":
    main()
