r"""
Edges in the ground
===================

Total variation beside a smooth regularizer: blocks in the ground, found from pressures.

Water is pumped out at twelve wells in turn, and 480 sensors measure the pressure: how conductive is the ground? This is
the scene of ``python -m sparsedp demo``, but here the ground consists of blocks. The readings alone do not determine
it. The regularizer that is added to the misfit decides whether edges stay sharp.

Run it: ``python examples/edges.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp
from sparsedp.report.demo.scene import Ground, survey

parser = argparse.ArgumentParser(description="Edges in the ground, by total variation.")
parser.add_argument("cells", nargs="?", type=int, default=40, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The ground and the readings
# ---------------------------
# Two sides of the ground are rivers, where the pressure is 0; the other two are tight. With a pump :math:`b` at a well
# and the conductivity :math:`k`, the pressure :math:`p` solves
#
# .. math:: -\nabla \cdot (k \, \nabla p) = b .
#
# `Ground` of the demo goes through all wells and reads all sensors. The unknown is :math:`m = \log k` in every cell, so
# that :math:`k` is positive. The truth has a block that conducts well and a tight one.


def blocks(grid):
    """log k: 1.5 in one block, -1.5 in another, 0 around."""
    x, y = grid.centres()
    conductive = (abs(x - 0.3) < 0.17) & (abs(y - 0.35) < 0.2)
    tight = (abs(x - 0.7) < 0.15) & (abs(y - 0.65) < 0.2)
    return 1.5 * conductive - 1.5 * tight


# %%
# The data are made on a grid twice as fine, with noise of half a percent. Who makes them on the grid of the search
# makes the search too easy: its errors of discretisation would be in the data as well.

n = options.cells
grid = dp.Grid((n, n), size=1.0)
finer = dp.Grid((2 * n, 2 * n), size=1.0)
data = survey(finer, blocks(finer))
ground = Ground(grid, data.wells, data.sensors)
hidden = blocks(grid)

# %%
# Two regularizers
# ----------------
# The loss is half the mean squared misfit of all :math:`N` readings :math:`d_i`, in units of their noise, and a price
# for a rough :math:`m`:
#
# .. math:: J(m) = \frac{1}{2 N} \sum_i \left( \frac{r_i(m) - d_i}{\sigma_i} \right)^2 + \beta \, R(m) .
#
# The usual price is half the integral of :math:`|\nabla m|^2`. To go up by 1 within a width :math:`w` costs
# :math:`w \, (1 / w)^2 / 2 = 1 / (2 w)`: a jump is dear, and it is cheaper to spread it. **Total variation** is the
# integral of :math:`|\nabla m|`. It costs :math:`w \cdot 1 / w = 1` for any width, so that an edge is as cheap as a
# slope. At :math:`\nabla m = 0` the length of a vector has a kink; :math:`\sqrt{|\nabla m|^2 + \epsilon^2}` rounds it
# off.


def search(regularizer, weight):
    """Return the ground that fits the readings, for a weight of the regularizer."""

    def loss(m):
        misfit = (ground.readings(m) - data.readings) / data.noise
        return 0.5 * np.mean(misfit**2) + weight * regularizer(m)

    return dp.minimize(loss, np.zeros(grid.shape), maxiter=120)


# %%
# Field and jumps
# ---------------
# Each weight is the best of a scan, so that both regularizers show what they can do. They are larger than the noise
# alone would ask for: readings on a coarser grid than the one they were made on are off by more than noise.
#
# Both errors are relative: that of :math:`m`, and that of its differences between neighbours.

terms = {
    "smooth": (dp.smoothness(grid), 1e-2),
    "edges": (dp.total_variation(grid, eps=0.3), 0.2),
}
jumps = dp.gradient(grid)


def error(field, truth):
    """Return the relative error."""
    return np.linalg.norm(field - truth) / np.linalg.norm(truth)


fields = {"the ground": hidden}
print("regularizer     weight  error of log k  of its jumps  evaluations")
for name, (term, weight) in terms.items():
    best = search(term, weight)
    of_field = error(best.x, hidden)
    of_jumps = error(jumps(best.x), jumps(hidden))
    print(f"{name:12} {weight:9.0e} {of_field:15.3f} {of_jumps:13.3f} {best.evaluations:12}")
    fields[name] = best.x

# %%
# The picture
# -----------
# The smooth regularizer leaves waves in the blocks and around them, total variation leaves both flat. The tight block
# is the harder one: little water flows through it, so that the readings tell little of it.
#
# Exercises
# ---------
# 1. Vary the weights by factors of 3. What does too little do to the field, and what too much?
# 2. Set `eps=0.01`. What does the search make of a sharper kink, within 120 iterations?
# 3. Make the ground smooth (a bump in place of blocks). Which regularizer is better now?

if options.out:
    from matplotlib import pyplot

    picture, places = pyplot.subplots(1, 3, figsize=(11.5, 3.4), layout="constrained")
    titles = "the ground", "found, smooth regularizer", "found, total variation"
    for ax, title, field in zip(places, titles, fields.values()):
        dp.plot(grid, field, ax=ax, title=title, limits=(-1.6, 1.6), label="log k")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "edges.png", dpi=120)
