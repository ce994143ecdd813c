r"""
Optimal control of Poisson's equation
=====================================

The exact optimum, and a number of iterations that does not grow with the number of cells.

We heat a plate with cold edges so that its temperature is close to a given one, and add a penalty of the heat source
(Tikhonov regularization). This is the standard problem of optimal control. Both terms are quadratic, and sine waves
diagonalize them, so that the exact optimum is known. Whether a search takes more iterations on finer grids depends on
one line, and for a smooth source on one argument.

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
    """The control problem on one grid, for one weight alpha of the penalty."""

    def __init__(self, cells, alpha):
        self.grid = dp.Grid((cells, cells), size=1.0)
        self.h = 1.0 / cells
        self.alpha = alpha
        x, y = self.grid.centres()
        self.wanted = x * (1 - x**2) * y**2 * (1 - y)
        self.solve = dp.inverse(-dp.laplacian(self.grid, dp.dirichlet))

    def loss(self, v):
        """Return the loss of v = h u; see below."""
        miss = self.h * (self.solve(v / self.h) - self.wanted)
        return 0.5 * np.sum(miss**2) + 0.5 * self.alpha * np.sum(v**2)

    def exact(self):
        """Return the smallest loss, by sine modes."""
        cells = self.grid.shape[0]
        mu_of_line = 4 * cells**2 * np.sin(np.pi * np.arange(1, cells + 1) / (2 * cells)) ** 2
        mu = mu_of_line[:, None] + mu_of_line
        modes = self.h * dstn(self.wanted, type=2, norm="ortho")
        return 0.5 * np.sum(self.alpha * mu**2 / (1 + self.alpha * mu**2) * modes**2)


# %%
# The one line
# ------------
# A search takes steps in a vector of numbers, with the Euclidean norm. On a fine grid this norm of :math:`u` differs
# from the norm of the function by the factor :math:`h`. For :math:`v = h \, u` both are equal,
#
# .. math:: \sum_i v_i^2 = h^2 \sum_i u_i^2 = |u|^2 ,
#
# so that the gradient with respect to :math:`v` is the gradient in the function space, on every grid.
#
# The exact optimum
# -----------------
# Sine waves are eigenvectors of :math:`-\Delta`, with eigenvalues :math:`\mu`. The wave :math:`k` of the target
# contributes to the smallest loss
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
# A smooth source
# ---------------
# Now the penalty contains the gradient of the source as well:
#
# .. math:: \min_u \; \frac{1}{2} \, | y - y_d |^2 + \frac{\alpha}{2} \left( | u |^2 + | \nabla u |^2 \right) .
#
# The second term is :math:`u \cdot M u` with :math:`M = h^2 (1 - \Delta)`. On a finer grid a source can be rougher, so
# that the largest second derivatives of the loss grow with the number of cells, and so does the number of iterations.
# No factor of :math:`u` prevents this. But in the inner product of :math:`M`, the direction of steepest descent is
# :math:`-M^{-1} g` in place of :math:`-g` with the gradient :math:`g` (:math:`M^{-1} g` is its Riesz representer), and
# every grid takes about the same number of iterations.

print()
print("cells   iterations  in the metric  difference of the losses")
counts = {}
for cells in (options.cells // 16, options.cells // 8, options.cells // 4, options.cells // 2):
    problem = Problem(cells, 1e-4)
    M = problem.h**2 * (dp.identity(problem.grid.cells) - dp.laplacian(problem.grid))

    def smooth_loss(u, problem=problem, M=M):
        miss = problem.h * (problem.solve(u) - problem.wanted)
        return 0.5 * np.sum(miss**2) + 0.5 * problem.alpha * np.sum(u * M(u))

    start = np.zeros((cells, cells))
    runs = [dp.minimize(smooth_loss, start, maxiter=1000, tolerance=1e-6, metric=metric) for metric in (None, M)]
    plain, in_metric = (best.history[-1].iteration for best in runs)
    counts[cells] = plain, in_metric
    gap = abs(runs[0].value / runs[1].value - 1)
    print(f"{cells:4}^2  {plain:11}  {in_metric:13}  {gap:24.0e}")

# %%
# The picture
# -----------
# The target, the temperatures that are reached with both weights (a large weight leaves the plate cold), and the
# iterations for a smooth source.
#
# Exercises
# ---------
# 1. Search in :math:`u` instead of :math:`v`. How many iterations does each grid take?
# 2. The source may not be negative: give `dp.minimize` the `bounds=(0, None)`. In which cells is it 0?
# 3. In the last search write ``method="newton_cg"``, and compare ``best.history[-1].solves``.

if options.out:
    from matplotlib import pyplot

    problem = Problem(options.cells, alpha)
    fields = {"wanted": problem.wanted}
    for alpha, source in finest.items():
        fields[f"reached, alpha = {alpha:g}"] = problem.solve(source)
    picture, axes = pyplot.subplots(1, 4, figsize=(16, 3.6), layout="constrained")
    limits = 0.0, np.max(problem.wanted)
    for ax, (title, field) in zip(axes, fields.items()):
        dp.plot(problem.grid, field, ax=ax, title=title, label="temperature", limits=limits)
    ax = axes[-1]
    for label, values in zip(("without metric", "metric of H1"), zip(*counts.values())):
        ax.loglog(list(counts), values, "o-", label=label)
    ax.set(title="smooth source", xlabel="cells along an axis", ylabel="iterations")
    ax.set_xticks(list(counts), list(map(str, counts)))
    ax.minorticks_off()
    ax.legend()
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "poisson_control.png", dpi=120)
