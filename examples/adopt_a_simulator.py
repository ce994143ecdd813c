"""Gradients through code that has none. Run: python examples/adopt_a_simulator.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np
import numpy

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 64


def foreign(x):
    """A step of Gray and Scott's reaction as somebody wrote it: plain NumPy, shifts, no derivatives."""
    u, v = x
    spread = lambda a: sum(numpy.roll(a, s, axis) for axis in (0, 1) for s in (-1, 1)) - 4 * a
    eaten = u * v * v
    return numpy.stack([u + 0.16 * spread(u) - eaten + 0.04 * (1 - u), v + 0.08 * spread(v) + eaten - 0.1 * v])


def start(n):
    (x, y), seed = dp.Grid((n, n), size=1.0).centres(), np.random.default_rng(0)
    spot = np.exp(-((x - 0.5) ** 2 + (y - 0.4) ** 2) / 0.01)
    return np.stack([1 - 0.5 * spot, 0.25 * spot]) + 0.01 * seed.random((2, n, n))


print("unknowns  entries of J  runs to find them  seconds  runs for each J  seconds  instead of")
for cells in (n, 4 * n):  # neither number of runs grows with the grid as the unknowns do
    step, x = dp.adopt(foreign), start(cells)
    clock = perf_counter()
    found, runs, once = step.jacobian(x), step.runs, perf_counter() - clock
    clock = perf_counter()
    step.jacobian(x + 0.01)
    more, each = step.runs - runs, perf_counter() - clock
    print(f"{x.size:8} {found.nnz:13} {runs:18} {once:8.2f} {more:16} {each:8.3f} {x.size:11}")
print(step, "\n")

step, x = dp.adopt(foreign), start(n)
loop = lambda x: dp.rollout(lambda x, _: step(x), x, None, 5)
loss = lambda x: np.sum(loop(x)[1] ** 2)
print("5 steps as they are, how much v is left:\n", dp.check.gradient(loss, x), sep="")
runs, clock = step.runs, perf_counter()
value, slope = dp.value_and_grad(loss)(x + 0.01)
spent = perf_counter() - clock
print(f"\nloss {value:.4f}; its gradient in {x.size} unknowns took {step.runs - runs} runs and {spent:.2f} s")

if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    axes = dp.plot(dp.Grid((n, n), size=1.0), slope[1], title="how each cell's v changes the loss")
    axes.figure.savefig(Path(sys.argv[-1]) / "adopt_a_simulator.png", dpi=120)
