"""Twelve elliptic gradients of 256^2 cells: here, and by processes, one thread each; the bits are the same.

Each process sets up its own solver for a new coefficient. Two processes therefore cannot be faster than six gradients
in one process: this limit is the second row. The remaining difference is due to messages, and to two cores that share
caches and memory.

Run ``python -m benchmarks.ensembles [cells]`` in the root of the repository.
"""

import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.triad import best_times

CELLS = int(sys.argv[1]) if sys.argv[1:] and sys.argv[1].isdigit() else 256
LAPS = 40  # the least time of each row counts: on a busy machine few laps have two processors for themselves
GRID = dp.Grid((CELLS, CELLS), size=1.0)
SOLVE = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))


def loss(logarithm, source):
    return anp.mean(SOLVE(anp.exp(logarithm), source) ** 2)


def main():
    rng = np.random.default_rng(0)
    scenes, x = list(rng.random((12, *GRID.shape))), 0.5 * rng.standard_normal(GRID.faces.size)
    dp.set_threads(1)
    pools = [ProcessPoolExecutor(n, multiprocessing.get_context("spawn"), dp.set_threads, (1,)) for n in (1, 2)]
    totals = {"here": dp.ensemble(loss, scenes), "half of them, here": dp.ensemble(loss, scenes[:6])}
    for n, pool in enumerate(pools, 1):
        totals[f"{n} worker{'s' * (n > 1)}"] = dp.ensemble(loss, scenes, pool)
        totals[f"{n} worker{'s' * (n > 1)}, 6 scenes a task"] = dp.ensemble(loss, scenes, pool, chunk=6)
    tasks = {name: dp.value_and_grad(total) for name, total in totals.items()}
    results = {name: task(x) for name, task in tasks.items()}  # sets the solvers up
    best = best_times({name: lambda task=task: task(x + rng.random() * 1e-3) for name, task in tasks.items()}, LAPS)
    print(f"{'12 elliptic gradients of ' + str(CELLS) + '^2':34} {'s':>8} {'faster':>8}  same bits")
    for name, seconds in best.items():
        wanted = results["here"] if "task" not in name else results["1 worker, 6 scenes a task"]
        same = results[name][0] == wanted[0] and np.array_equal(results[name][1], wanted[1])
        told = "" if "half" in name else "yes" if same else "NO"
        print(f"{name:34} {seconds:8.3f} {best['here'] / seconds:8.2f}  {told}")
    print(f"{os.cpu_count()} processors, {os.getloadavg()[0]:.1f} tasks on them in the last minute, these included")
    for pool in pools:
        pool.shutdown()


if __name__ == "__main__":
    main()
