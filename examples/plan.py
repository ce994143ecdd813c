"""What does a gradient cost, and what does it not need? Run: python examples/plan.py [cells]"""

import sys

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 48
grid = dp.Grid((n, n), size=1.0)
G, D = dp.gradient(grid, dp.dirichlet), dp.divergence(grid)
ground = dp.elliptic_solver(D, G)
middle = dp.sample(grid, [[0.5, 0.5]])
x, y = grid.centres()
wells = np.exp(-80 * ((x - 0.3) ** 2 + (y - 0.6) ** 2))
rock = 1.0 + 0.5 * np.sin(3 * np.arange(grid.faces.size))


def pressure(k, b):
    """The law both scenes share."""
    return middle(ground(k, b))[0]


def pump(b):
    """Scene 1: where to pump. The rock is known, and uniform: no derivative in it, transforms solve."""
    return (pressure(1.0, b) - 0.02) ** 2


def survey(k):
    """Scene 2: what the rock is. The wells are known, the coefficient varies: a set-up of its own."""
    return (pressure(k, wells) - 0.02) ** 2


for title, loss, start in (("where to pump", pump, wells), ("what the rock is", survey, rock)):
    plan = dp.explain(loss, start)
    print(f"{title}\n{plan}\n")

# The same numbers as data: one forward and one adjoint solve each, whatever was asked.
for loss, start in ((pump, wells), (survey, rock)):
    totals = dp.explain(loss, start).totals
    print(f"{loss.__name__:7} solves {totals['forward solves']} + {totals['adjoint solves']} adjoint")
