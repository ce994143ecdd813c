r"""
The uncertainty of a conductivity
=================================

A Bayesian inverse problem: the posterior of the conductivity of the ground, its mode, standard deviation and samples.

Water is pumped through the ground at one place, and its pressure is measured in some wells. We look for the
conductivity of the ground. Few wells do not determine it in each cell: many fields fit the data. Which of them are
probable, and what do they have in common? The answer is a probability distribution, the posterior.

Run it: ``python examples/posterior.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="A posterior of the conductivity of the ground, from pressures in wells.")
parser.add_argument("cells", nargs="?", type=int, default=48, help="cells along each axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The prior
# ---------
# The prior is the knowledge before the measurement. The logarithm :math:`m` of the conductivity has the mean 0 and a
# standard deviation of about :math:`\sigma = 0.5`. Points that are much closer than the length :math:`\ell = 0.2` have
# nearly equal values. The covariance of such a field is a power of a Laplacian (a Matérn field):
#
# .. math:: C = R R^T, \qquad R = \sigma \sqrt{4 \pi} \, \frac{\kappa}{h} \, (\kappa^2 - \Delta)^{-1},
#           \qquad \kappa = \frac{\sqrt 8}{\ell} .
#
# On a grid of equal cells the cosines are its eigenvectors, so that a product takes two fast cosine transforms, and the
# covariance is never stored as a matrix. Samples of the prior are :math:`R z` with standard normal numbers :math:`z`.

n = options.cells
grid = dp.Grid((n, n), size=1.0)
length = 0.2
sigma = 0.5
kappa = np.sqrt(8.0) / length
scale = sigma * np.sqrt(4 * np.pi) * kappa
root = scale * n * dp.matrix_power(kappa**2 * dp.identity(grid.cells) - dp.laplacian(grid), -1)
prior = root @ root

# %%
# The measurement
# ---------------
# The true field is a sample of the prior. The pressure is 0 at the left and the right wall, and the other walls are
# closed. The standard deviation of the noise is 2 % of the largest pressure. The residuals are divided by it, so that
# their variance is 1.

rng = np.random.default_rng(4)
x, y = grid.centres()
coefficients = rng.standard_normal((16, 16))  # of cosines: a field that does not depend on the grid
frequencies = np.arange(16)
cosines = [np.sqrt(np.where(frequencies > 0, 2.0, 1.0)) * np.cos(np.pi * c[..., None] * frequencies) for c in (x, y)]
decay = kappa**2 + np.pi**2 * (frequencies[:, None] ** 2 + frequencies**2)
truth = scale * np.einsum("abi,abj,ij->ab", *cosines, coefficients / decay)

sides = {"x": (dp.dirichlet, dp.dirichlet), "y": (dp.neumann, dp.neumann)}
solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, sides))
to_faces = dp.harmonic_average(grid)
pump = np.exp(-((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.02)
wells = dp.sample(grid, rng.uniform(0.08, 0.92, (40, 2)))


def pressures(m):
    """Return the pressures in the wells for a logarithm of the conductivity."""
    return wells(solve(to_faces(np.exp(m)), pump))


noise = 0.02 * np.max(pressures(truth))
data = pressures(truth) + noise * rng.standard_normal(40)


def residuals(m):
    """Return the differences from the data in standard deviations."""
    return (pressures(m) - data) / noise


# %%
# The mode (maximum a posteriori)
# -------------------------------
# The posterior density is largest where :math:`|r(m)|^2 + m^T C^{-1} m` is smallest. With :math:`m = R z` the second
# term is :math:`|z|^2`, and no inverse of the prior is needed. The search also takes fewer iterations, because the
# problem is preconditioned by the prior: its steps are smooth fields.


def objective(z):
    """Return the negative logarithm of the posterior density up to a constant."""
    return 0.5 * np.sum(residuals(root(z)) ** 2) + 0.5 * np.sum(z**2)


best = dp.minimize(objective, np.zeros(grid.shape), maxiter=200, tolerance=1e-6)
mode = root(best.x)
print(f"search: {best.message}")

# %%
# The posterior
# -------------
# Near the mode, the residuals are nearly linear, and the posterior is nearly normal. `laplace` returns this normal
# distribution (Laplace approximation). Its covariance is the covariance of the prior minus a matrix of low rank: data
# reduce the variance along some eigenvectors by the factors :math:`1 / (1 + \lambda_i)`, and do not change the others.

posterior = dp.laplace(residuals, mode, prior)
print(posterior)

deviation = np.sqrt(posterior.variance())
without_data = dp.laplace(lambda m: np.zeros(0), mode, prior, prior_mean=mode)  # no residuals: this is the prior
prior_deviation = np.sqrt(without_data.variance())
figures = f"after {np.mean(deviation):.2f}, smallest {np.min(deviation):.2f}"
print(f"\nstandard deviation before {np.mean(prior_deviation):.2f}, {figures}")

is_covered = np.abs(mode - truth) < 1.96 * deviation
print(f"truth within the intervals of 95 %: in {100 * np.mean(is_covered):.0f} % of the cells")

# %%
# Quantities of interest
# ----------------------
# Often one number is wanted: here the pressure at a place without a well, and the mean of :math:`m` in the right half.
# `std_of` replaces the function by its linearization at the mode (delta method). To test this we compute the number for
# 200 samples of the posterior.

place = dp.sample(grid, [[0.3, 0.7]])


def pressure_there(m):
    """Return the pressure at the place."""
    return place(solve(to_faces(np.exp(m)), pump))[0]


def mean_right(m):
    """Return the mean of the right half."""
    return np.sum(np.where(x > 0.5, m, 0.0)) / np.sum(x > 0.5)


samples = posterior.sample(200, seed=1)
print("\n                            mode    truth   std_of   std of 200 samples")
for name, quantity in (("pressure at (0.3, 0.7)", pressure_there), ("mean of the right half", mean_right)):
    values = [quantity(m) for m in samples]
    figures = f"{quantity(mode):8.4f} {quantity(truth):8.4f} {posterior.std_of(quantity):8.4f}"
    print(f"{name:24} {figures}   {np.std(values):8.4f}")

# %%
# The picture
# -----------
# The true field, the mode, the standard deviation, and a sample of the posterior. The sample is as rough as the truth.
# The mode is smoother, because it is the mean of the distribution, not a sample. At the walls the standard deviation is
# larger, as in this prior.
#
# Exercises
# ---------
# 1. Place ten new wells where the standard deviation is largest. What is the information gain now?
# 2. Make the noise ten times as large, then ten times as small. How many eigenvalues are above 1?
# 3. Run with 96 cells. Which figures should change, and which should not?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, axes = pyplot.subplots(1, 4, figsize=(15, 3.6), layout="constrained")
    panels = {"truth": truth, "mode": mode, "standard deviation": deviation, "a sample": samples[0]}
    for ax, (title, field) in zip(axes, panels.items(), strict=True):
        dp.plot(grid, field, ax=ax, title=title, label="log of the conductivity")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "posterior.png", dpi=120)
