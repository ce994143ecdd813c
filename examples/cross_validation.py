r"""
Regularization weights by cross-validation
==========================================

Scattered, noisy data are smoothed with the two weights that predict omitted data best: five folds in one call.

A field is measured at some cells, with noise, and a penalty on its slopes fills the gaps. Two weights say how smooth
the field is along x and along y, and both are unknown. Cross-validation finds them: one fifth of the data is omitted,
predicted from the others, and compared; this is repeated for each fifth. The five solves are one batch, and the mean
squared error is a differentiable function of the weights.

Run it: ``python examples/cross_validation.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Smoothing weights by cross-validation.")
parser.add_argument("cells", nargs="?", type=int, default=48)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The data
# --------
# The field varies quickly along y and slowly along x. One cell out of four is measured, with noise.

grid = dp.Grid((options.cells, options.cells), size=1.0)
x, y = grid.centres()
truth = np.sin(9.0 * y + 2.0 * x) + 0.5 * np.cos(14.0 * y)
rng = np.random.default_rng(0)
is_measured = rng.random(grid.shape) < 0.25
data = np.where(is_measured, truth + 0.2 * rng.standard_normal(grid.shape), 0.0)

# %%
# The estimate
# ------------
# With the mask :math:`m`, 1 at the measured cells and 0 elsewhere, the estimate minimises
#
# .. math:: \sum m \, (u - d)^2 + w_x \sum (\partial_x u)^2 + w_y \sum (\partial_y u)^2 ,
#
# so that :math:`(m - \nabla \cdot w \, \nabla) \, u = m \, d`. In `elliptic_solver` the weights are the coefficient
# on the faces, and the mask is the shift.

solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid))


def coefficient(log_weights):
    """Return the weight of each face."""
    weights = np.exp(log_weights)
    return grid.join(weights[0], weights[1])


# %%
# Five folds, one batch
# ---------------------
# Each fold has its own mask. The leading axis of `shift` and of `b` is the batch, and the weights are the same for all
# folds. One call solves all five systems; one adjoint solve for each fold gives both derivatives.

folds = 5
fold = rng.integers(folds, size=grid.shape)
is_omitted = np.stack([is_measured & (fold == number) for number in range(folds)])
masks = np.where(is_omitted, 0.0, 1.0 * is_measured)


def score(log_weights):
    """Return the mean squared error of the predictions of the omitted data."""
    predictions = solve(coefficient(log_weights), masks * data, masks)
    return np.sum(is_omitted * (predictions - data) ** 2) / np.sum(is_measured)


# %%
# The search
# ----------

start = np.log(np.array([1e-3, 1e-3]))
path = [start]
check = dp.check.gradient(score, start)
best = dp.minimize(score, start, maxiter=20, tolerance=1e-3, callback=lambda record, point: path.append(point))


def error(log_weights):
    """Return the root-mean-square error of the estimate from all data."""
    estimate = solve(coefficient(log_weights), data, 1.0 * is_measured)
    return np.sqrt(np.mean((estimate - truth) ** 2))


print(f"gradient of the score by finite differences: {check.verdict}")
print(f"score {score(start):.4f} -> {best.value:.4f} in {len(best.history) - 1} iterations")
print(f"weights along x and y: {np.exp(best.x[0]):.1e}, {np.exp(best.x[1]):.1e}")
print(f"error of the estimate: {error(start):.3f} with equal weights, {error(best.x):.3f} with those of the search")

# %%
# The picture
# -----------
# Left: the data. Middle: the estimate with the weights of the search. Right: the score over both weights, and the
# points of the search. The score is close to the variance of the noise, 0.04, plus the variance
# of the error.
#
# Exercises
# ---------
# 1. Let every measured cell be a fold of its own. How many systems has the batch, and does the result differ?
# 2. Replace the two weights by a weight that depends on y, as 48 unknowns. Does cross-validation still choose well?
# 3. Add a third weight, of the mask at cells with larger noise.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, axes = pyplot.subplots(1, 3, figsize=(10.5, 3.4), layout="constrained")
    limits = {"vmin": -1.6, "vmax": 1.6, "cmap": "RdBu_r", "origin": "lower", "extent": (0, 1, 0, 1)}
    axes[0].imshow(np.where(is_measured, data, np.nan).T, **limits)
    axes[0].set(title="data", xlabel="x", ylabel="y")
    estimate = solve(coefficient(best.x), data, 1.0 * is_measured)
    axes[1].imshow(estimate.T, **limits)
    axes[1].set(title="estimate", xlabel="x", ylabel="y")
    lines = np.log(10) * np.linspace(-5.5, -1.5, 9)
    scores = np.array([[score(np.array([a, b])) for a in lines] for b in lines])
    contours = axes[2].contourf(lines / np.log(10), lines / np.log(10), np.log10(scores), 16, cmap="viridis")
    picture.colorbar(contours, ax=axes[2], label="log10 of the score")
    points = np.array(path) / np.log(10)
    axes[2].plot(points[:, 0], points[:, 1], "o-", color="white", markersize=4)
    axes[2].set(title="score and search", xlabel="log10 of the weight along x", ylabel="log10 of the weight along y")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "cross_validation.png", dpi=120)
