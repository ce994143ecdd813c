r"""
Gradients through code that has none
====================================

A simulator in plain NumPy, its sparse Jacobian from a dozen runs, and a gradient that is checked.

Suppose that a working simulation code exists, and that rewriting it only to get a gradient is too much work.
`dp.from_blackbox` takes one time step of it unchanged, determines which results depend on which values, and returns a
function with derivatives.

Run it: ``python examples/adopt_a_simulator.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np
import numpy

import sparsedp as dp

parser = argparse.ArgumentParser(description="Gradients through code that has none.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The foreign code
# ----------------
# The reaction of Gray and Scott: a substance :math:`v` feeds on another, :math:`u`, and both spread,
#
# .. math:: u_t = 0.16 \, \Delta u - u v^2 + 0.04 \, (1 - u), \qquad
#           v_t = 0.08 \, \Delta v + u v^2 - 0.1 \, v .
#
# A step of length 1 on cells of width 1, written with shifts. It uses NumPy itself and knows nothing of derivatives.


def foreign(x):
    """Return both substances after one step; x has the shape (2, n, n)."""
    u, v = x
    reaction = u * v * v
    new_u = u + 0.16 * spread(u) - reaction + 0.04 * (1 - u)
    new_v = v + 0.08 * spread(v) + reaction - 0.1 * v
    return numpy.stack([new_u, new_v])


def spread(a):
    """Return the sum of the four neighbours of each cell minus four times the cell; the plane is periodic."""
    along_x = numpy.roll(a, 1, axis=0) + numpy.roll(a, -1, axis=0)
    along_y = numpy.roll(a, 1, axis=1) + numpy.roll(a, -1, axis=1)
    return along_x + along_y - 4 * a


def start(n):
    """Return the initial state: a spot of v with less u in it, and a little noise."""
    x, y = dp.Grid((n, n), size=1.0).centres()
    spot = np.exp(-((x - 0.5) ** 2 + (y - 0.4) ** 2) / 0.01)
    noise = np.random.default_rng(0).random((2, n, n))
    return np.stack([1 - 0.5 * spot, 0.25 * spot]) + 0.01 * noise


# %%
# Many columns in one run
# -----------------------
# A run with a tiny imaginary change in a direction :math:`d` gives the Jacobian :math:`J` times :math:`d`, and no
# digits cancel, as nothing is subtracted:
#
# .. math:: J d = \frac{\operatorname{Im} f(x + i h d)}{h} + O(h^2), \qquad h = 10^{-30} .
#
# With one direction for each unknown this would take as many runs as there are unknowns. But a cell is felt by its
# neighbours only. Two columns of :math:`J` without a row in common can share a run, since each result then tells which
# of the two it comes from. Columns that may share get the same *colour*, as the countries of a map do when they have no
# border in common; and as on a map, how many colours are needed has nothing to do with the size of the map.
#
# A result depends on five cells of its own substance and on one of the other: six entries in each row.

print("unknowns  entries of J  runs to find them  seconds  runs for each J  seconds  instead of")
for n in (options.cells, 4 * options.cells):
    step = dp.from_blackbox(foreign)
    x = start(n)

    clock = perf_counter()
    jacobian = step.jacobian(x)  # the first one finds out which entries there are
    first_seconds = perf_counter() - clock
    first_runs = step.runs

    clock = perf_counter()
    step.jacobian(x + 0.01)
    seconds = perf_counter() - clock
    runs = step.runs - first_runs

    first = f"{x.size:8} {jacobian.nnz:13} {first_runs:18} {first_seconds:8.2f}"
    print(f"{first} {runs:16} {seconds:8.3f} {x.size:11}")
print(step, "\n")

# %%
# A scene with a foreign step
# ---------------------------
# The adopted step is a function like any other. Five of them, and the loss asks how much :math:`v` is left:
#
# .. math:: J(x) = \sum_i v_i^2 \quad \text{after five steps.}
#
# The check does not trust the colours: it compares the gradient with differences of the loss itself.

step = dp.from_blackbox(foreign)
x = start(options.cells)


def run(x):
    """Return both substances after five steps."""
    return dp.rollout(lambda x, _: step(x), x, None, 5)


def loss(x):
    """Return the sum of squares of the remaining v."""
    _, v = run(x)
    return np.sum(v**2)


print("5 steps as they are, how much v is left:")
print(dp.check.gradient(loss, x))

runs = step.runs
clock = perf_counter()
value, slope = dp.value_and_grad(loss)(x + 0.01)
seconds = perf_counter() - clock
print(f"\nloss {value:.4f}; its gradient in {x.size} unknowns took {step.runs - runs} runs and {seconds:.2f} s")

# %%
# The picture
# -----------
# Left: :math:`v` at the end. Right: how much a little more :math:`v` at the start adds to the loss. It counts in
# the spot, where there is something to grow.
#
# Exercises
# ---------
# 1. Put a branch into the foreign code: no reaction where there is little, `numpy.where(v > 0.1, u * v * v, 0)`. Does
#    the check still agree?
# 2. Feed the mean of the whole plane, `0.04 * (1 - u.mean())`, on 8 cells. How many runs does a Jacobian take now, and
#    why?
# 3. Write the step with `autograd.numpy` and without `dp.from_blackbox`. Compare the seconds of a gradient.

if options.out:
    from matplotlib import pyplot

    grid = dp.Grid((options.cells, options.cells), size=1.0)
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    dp.plot(grid, run(x)[1], ax=left, title="after five steps", label="v")
    dp.plot(grid, slope[1], ax=right, title="how the v of each cell changes the loss", label="slope")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "adopt_a_simulator.png", dpi=120)
