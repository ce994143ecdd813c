r"""
Optimal control of Poisson's equation
=====================================

To the exact optimum, and at the same cost on every grid.

We heat a plate with cold edges, and want a given temperature in it, at a low price for heating. This is the standard
problem of optimal control. Since both of its terms are quadratic, sine waves solve it one by one, and we can see how
close to the exact optimum a search with gradients ends. Whether it takes more steps on finer grids depends on one line.

Run it: ``python examples/poisson_control.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np
from scipy.fft import dstn

import sparsedp as dp

parser = argparse.ArgumentParser(description="Optimal control of Poisson's equation, against the exact optimum.")
parser.add_argument("cells", nargs="?", type=int, default=128, help="cells along an axis of the finest grid")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The problem
# -----------
# Find the source :math:`u` that makes the temperature :math:`y` as :math:`y_d` wants it:
#
# .. math:: \min_u \; \frac{1}{2} \, | y - y_d |^2 + \frac{\alpha}{2} \, | u |^2
#           \quad \text{with} \quad -\Delta y = u, \; y = 0 \text{ on the walls} .
#
# The norms are those of functions: sums over cells, times :math:`h^2`.


class Problem:
    """One grid and one price of heating."""

    def __init__(self, cells, alpha):
        self.grid = dp.Grid((cells, cells), size=1.0)
        self.h, self.alpha = 1.0 / cells, alpha
        x, y = self.grid.centres()
        self.wanted = x * (1 - x**2) * y**2 * (1 - y)
        self.solve = dp.inverse(-dp.laplacian(self.grid, dp.dirichlet))

    def loss(self, v):
        """The loss of v = h u; see below."""
        miss = self.h * (self.solve(v / self.h) - self.wanted)
        return 0.5 * np.sum(miss**2) + 0.5 * self.alpha * np.sum(v**2)

    def exact(self):
        """The least loss, by sine modes."""
        cells = self.grid.shape[0]
        line = 4 * cells**2 * np.sin(np.pi * np.arange(1, cells + 1) / (2 * cells)) ** 2
        mu = line[:, None] + line
        modes = self.h * dstn(self.wanted, type=2, norm="ortho")
        return 0.5 * np.sum(self.alpha * mu**2 / (1 + self.alpha * mu**2) * modes**2)


# %%
# The one line
# ------------
# A search knows nothing of functions; it takes steps in a list of numbers. On a fine grid the numbers of :math:`u` are
# many and each counts little, :math:`h^2`. In :math:`v = h \, u` the plain sum of squares *is* the norm of the
# function,
#
# .. math:: \sum_i v_i^2 = h^2 \sum_i u_i^2 = |u|^2 ,
#
# so that the gradient is the one of the function, on every grid alike.
#
# The exact optimum
# -----------------
# For a sine wave, :math:`-\Delta` is a number :math:`\mu`. Each wave :math:`k` of the wanted field then leaves
#
# .. math:: J_k = \frac{1}{2} \, \frac{\alpha \, \mu_k^2}{1 + \alpha \, \mu_k^2} \, y_{d,k}^2 .

print("cells   alpha  J found          J exact          gap     iterations  gradients")
finest = {}
for alpha in (1e-2, 1e-4):
    for cells in (options.cells // 4, options.cells // 2, options.cells):
        problem = Problem(cells, alpha)
        exact = problem.exact()
        best = dp.minimize(problem.loss, np.zeros((cells, cells)), maxiter=60)
        gap = abs(best.value / exact - 1)
        steps = best.history[-1].iteration
        print(f"{cells:4}^2  {alpha:6.0e}  {best.value:.9e}  {exact:.9e}  {gap:.0e}  {steps:10}  {best.evaluations:9}")
    finest[alpha] = best.x / problem.h

# %%
# The picture
# -----------
# What is wanted, and what comes of it at both prices: dear heat leaves the plate cold.
#
# Exercises
# ---------
# 1. Search in :math:`u` instead of :math:`v`. How many iterations does each grid take?
# 2. Heat may not be negative: give `dp.minimize` the `bounds=(0, None)`. Which cells stay off?

if options.out:
    from matplotlib import pyplot

    fields = {"wanted": problem.wanted}
    for alpha, source in finest.items():
        fields[f"reached, alpha = {alpha:g}"] = problem.solve(source)
    picture, places = pyplot.subplots(1, 3, figsize=(13, 3.6), layout="constrained")
    limits = 0.0, np.max(problem.wanted)
    for ax, (title, field) in zip(places, fields.items()):
        dp.plot(problem.grid, field, ax=ax, title=title, label="temperature", limits=limits)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "poisson_control.png", dpi=120)
