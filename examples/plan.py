r"""
What does a gradient cost, and what does it not need?
=====================================================

Two questions to one law: what each calls, sets up and keeps, and what is skipped.

Water is pumped out of the ground, and we measure the pressure in the middle. If the rock is known, the unknown is where
to pump; if the wells are known, the unknown is the rock. Both problems use the same law, but their gradients need
different computations. `dp.explain` lists the computations of a gradient.

Run it: ``python examples/plan.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="What does a gradient cost, and what does it not need?")
parser.add_argument("cells", nargs="?", type=int, default=48, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The law
# -------
# The pressure :math:`p` in ground of conductivity :math:`k`, with wells :math:`b`, obeys
#
# .. math:: -\nabla \cdot (k \, \nabla p) = b .
#
# The solver below takes both :math:`k` and :math:`b`, and has derivatives in both.

grid = dp.Grid((options.cells, options.cells), size=1.0)
x, y = grid.centres()
G = dp.gradient(grid, dp.dirichlet)
D = dp.divergence(grid)
ground = dp.elliptic_solver(D, G)
middle = dp.sample(grid, [[0.5, 0.5]])

wells = np.exp(-80 * ((x - 0.3) ** 2 + (y - 0.6) ** 2))
rock = 1.0 + 0.5 * np.sin(3 * np.arange(grid.faces.size))


def pressure(k, b):
    """The law that both questions share: pressure in the middle."""
    return middle(ground(k, b))[0]


# %%
# Two questions
# -------------
# With the adjoint :math:`\lambda`, the solution of the transposed problem, the two derivatives are
#
# .. math:: \frac{\partial p}{\partial b} = \lambda, \qquad
#           \frac{\partial p}{\partial k} = -(\nabla \lambda) \, (\nabla p) .
#
# The second needs the field :math:`p` to be kept, the first does not.


def pump(b):
    """Where to pump. The rock is known, and uniform: no derivative in it, and transforms solve."""
    return (pressure(1.0, b) - 0.02) ** 2


def survey(k):
    """What the rock is. The wells are known, the coefficient varies: a set-up of its own."""
    return (pressure(k, wells) - 0.02) ** 2


# %%
# The plans
# ---------
# What is called, what is set up, what is kept; and at the end what is not asked for, and so is not done.

for title, loss, start in (("where to pump", pump, wells), ("what the rock is", survey, rock)):
    plan = dp.explain(loss, start)
    print(f"{title}\n{plan}\n")

# %%
# The same numbers as data: one forward and one adjoint solve each, whatever was asked.

for loss, start in ((pump, wells), (survey, rock)):
    totals = dp.explain(loss, start).totals
    print(f"{loss.__name__:7} solves {totals['forward solves']} + {totals['adjoint solves']} adjoint")

# %%
# The picture
# -----------
# Both gradients. A well near the middle counts most. In the rock it is the way between the wells and the middle that
# counts, and with the other sign the ways from there to the edge. Of the faces we show those that look along x.
#
# Exercises
# ---------
# 1. Ask for both at once: a loss of the tuple `(k, b)`. How many solves does the plan say?
# 2. Measure at three points instead of one. Does the number of adjoint solves grow?

if options.out:
    from matplotlib import pyplot

    in_wells = dp.grad(pump)(wells)
    in_rock, _ = grid.split(dp.grad(survey)(rock))
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for ax, slope, title in ((left, in_wells, "slope in the wells"), (right, in_rock[1:], "slope in the rock")):
        most = np.max(np.abs(slope))
        dp.plot(grid, slope, ax=ax, title=title, limits=(-most, most), cmap="RdBu_r")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "plan.png", dpi=120)
