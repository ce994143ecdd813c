r"""
The velocity that carried a marker
==================================

Found from one look at the end; and why the start of a search matters.

A drop of dye is carried along a ring by a velocity that differs from place to place. We know where the dye was and see
where it went, and look for the velocity in every cell. The question has two traps: a search can begin where the loss is
flat, and where no dye has passed, nothing can be known.

Run it: ``python examples/velocity_recovery.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Recover the velocity that carried a marker.")
parser.add_argument("cells", nargs="?", type=int, default=64)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The physics
# -----------
# The marker :math:`c` obeys :math:`c_t + v \, c_x = 0`. The upwind scheme looks at the neighbour that the dye comes
# from; it is stable as long as the dye moves by less than a cell in a step.

n = options.cells
steps = 60 * n // 64
grid = dp.Grid(n, size=1.0, periodic=True)
(x,) = grid.centres()

fastest = 1.3
dt = 0.5 / n / fastest
move = dp.transport(grid, velocity="cells")  # upwind, one velocity for each cell


def step(c, v):
    """The marker after a step."""
    return move(c, v, dt)


start = np.exp(-(((x - 0.3) / 0.06) ** 2) / 2)
hidden = 1 + 0.3 * np.sin(2 * np.pi * x)


def carried(v):
    """The marker at the end."""
    return dp.rollout(step, start, v, steps)


# %%
# The loss
# --------
# .. math:: J(v) = \sum_i \left( c_i(v) - c_{\text{seen}, i} \right)^2

seen = carried(hidden)


def loss(v):
    """Return the squared error at the end."""
    return np.sum((carried(v) - seen) ** 2)


# %%
# Where to begin
# --------------
# A marker that does not overlap with what was seen has no slope towards it: moved a little, it misses as much as
# before. So a few constant velocities are tried first, which costs ten runs and no gradient.

trials = np.linspace(-1, 1.25, 10)
guess = min(trials, key=lambda speed: loss(np.full(n, speed)))

# %%
# What can be known
# -----------------
# Only cells in which there was some dye at some time have a say in the end. We count the error there.

everywhere = dp.rollout(step, start, hidden, steps, keep="all")
passed = np.max(everywhere, axis=0) > 0.2
print(f"{n} cells, {steps} upwind steps; the marker passes {np.count_nonzero(passed)} cells")

# %%
# The search
# ----------
# From rest and from the best constant, by gradient descent and by L-BFGS.

beginnings = {"rest": np.zeros(n), f"constant {guess:+.2f}": np.full(n, guess)}
methods = {"gd": {"rate": 0.01}, "lbfgs": {}}
velocities = {}
print("start                    method        loss at start   after   gradients   error where it passed")
for label, first in beginnings.items():
    for method, settings in methods.items():
        best = dp.minimize(loss, first, method, maxiter=200, **settings)
        velocities[label, method] = best.x
        error = np.max(np.abs(best.x - hidden)[passed])
        print(f"{label:24} {method:12} {loss(first):10.2f} {best.value:12.1e} {len(best.history):8} {error:16.3f}")

# %%
# The picture
# -----------
# Left: the marker. Right: the velocity; where no dye has passed, the search has left what it began with.
#
# Exercises
# ---------
# 1. Add a second drop at :math:`x = 0.8`. How much more of the velocity can be known?
# 2. See the marker halfway as well (`keep=[steps // 2, steps]`). From which constants does the search succeed now?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    found = velocities[f"constant {guess:+.2f}", "lbfgs"]
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    left.set(title="the marker", xlabel="x", ylabel="dye", ylim=(0, 1.45))
    left.plot(x, start, ":", label="start")
    left.plot(x, seen, color="black", linewidth=4, alpha=0.3, label="seen")
    left.plot(x, carried(found), label="carried by what is found")
    left.legend(frameon=False, loc="upper right")
    right.set(title="the velocity", xlabel="x", ylabel="v")
    right.plot(x, hidden, color="black", linewidth=4, alpha=0.3, label="hidden")
    right.plot(x, found, ":", label="found")
    right.plot(x, np.where(passed, found, np.nan), label="found where the marker passed")
    right.legend(frameon=False, loc="lower left")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "velocity_recovery.png", dpi=120)
