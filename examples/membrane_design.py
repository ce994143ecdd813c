r"""
The highest tone of a membrane
==============================

Where to put a given mass, so that the lowest frequencies of a membrane are as high as possible.

Most of the weight of a drum is a layer that can be twice as thick in some places as in others. The total mass is given.
The lowest eigenvalue is the easy case: it is simple, and the problem is convex. The second one of a nearly square drum
is the usual case in practice: under the search it meets the third, and from then on it has no gradient of its own.

Run it: ``python examples/membrane_design.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="The highest tone of a membrane.")
parser.add_argument("cells", nargs="?", type=int, default=48, help="cells along each side")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The problem
# -----------
# The membrane is fixed at its rim and has the tension 1. With the density :math:`\rho`, its modes :math:`u` and
# frequencies :math:`\sqrt{\lambda}` satisfy
#
# .. math:: -\Delta u = \lambda \, \rho \, u, \qquad 1 \le \rho \le 2, \qquad \int \rho \ge 1.5 \int 1 .
#
# `dp.eigenpairs` computes them, with derivatives in `mass`. The condition on the mass is a constraint of
# `dp.minimize`, the limits of the density are bounds.

n = options.cells
START = np.full((n, n), 1.5)


def mass_that_is_missing(density):
    """At most 0 where the membrane is heavy enough."""
    return 1.5 - np.mean(density)


def search(label, loss, maxiter=60):
    """Return the best density for a loss."""
    limits = {"bounds": (1.0, 2.0), "constraints": mass_that_is_missing}
    best = dp.minimize(loss, START, "augmented_lagrangian", maxiter, **limits)
    print(f"{label}: {best.evaluations} evaluations, mean density {np.mean(best.x):.6f}")
    return best.x


# %%
# The lowest tone
# ---------------
# By Rayleigh's principle,
#
# .. math:: \frac{1}{\lambda_1} = \max_u \frac{\int \rho \, u^2}{\int |\nabla u|^2}
#
# is a maximum of functions that are linear in :math:`\rho`, and so it is convex. The derivative of
# :math:`\lambda_1` in the density of a cell is :math:`-\lambda_1 u^2`, if :math:`\int \rho \, u^2 = 1`. At the optimum
# it cannot pay to carry mass from one cell to another: the membrane is heavy where :math:`u^2` is small, light where it
# is large, and between them is a line on which :math:`u^2` is constant.

square = -dp.laplacian(dp.Grid((n, n), size=1.0), dp.dirichlet)
even = dp.eigenpairs(square, 1, mass=START).values[0]


def lowest(density):
    """The inverse of the lowest eigenvalue, 1 at the start."""
    return even / dp.eigenpairs(square, 1, mass=density).values[0]


best_square = search("lowest tone of the square", lowest)
pairs = dp.eigenpairs(square, 1, mass=best_square)
mode = pairs.vectors[0] ** 2
heavy, light = best_square > 1.95, best_square < 1.05
print(f"eigenvalue {even:.4f} -> {pairs.values[0]:.4f}")
most, least = np.max(mode[heavy]), np.min(mode[light])
print(f"u^2 up to {most / np.max(mode):.3f} in heavy cells, from {least / np.max(mode):.3f} in light ones")

# %%
# The second tone
# ---------------
# The drum is now 1.06 times as long as it is wide. Its second and third eigenvalues differ by 7 %. A search for the
# highest second eigenvalue raises it until it meets the third. There both are equal, every change of the design splits
# them in another direction, and neither has a gradient. `dp.eigenpairs` says so, where a plain derivative would be an
# arbitrary mixture of two modes.

drum = -dp.laplacian(dp.Grid((n, n), size=(1.0, 1.06)), dp.dirichlet)
start = dp.eigenpairs(drum, 3, mass=START).values
path = []


def second(density):
    """The inverse of the second eigenvalue, 1 at the start."""
    pairs = dp.eigenpairs(drum, 3, mass=density)
    path.append(pairs.clusters)
    return start[1] / pairs.values[1]


try:
    search("second tone, its own gradient", second)
except dp.errors.DerivativeError as error:
    print(f"second tone, its own gradient: after {len(path)} evaluations: {error}")

# %%
# A function of both that treats them alike has a gradient at that point too. The norm
#
# .. math:: \Bigl( \lambda_2^{-p} + \lambda_3^{-p} \Bigr)^{1/p}
#
# is between the larger of :math:`1/\lambda_2`, :math:`1/\lambda_3` and :math:`2^{1/p}` times that. We search with
# :math:`p = 64`. The third pair is the last one that we ask for; the fourth is far away, so that no cluster is cut.


def lower_of_two(density):
    """A smooth maximum of the inverses of the second and third eigenvalues."""
    values = dp.eigenpairs(drum, 3, mass=density).values[1:]
    return np.sum((start[1] / values) ** 64) ** (1 / 64)


best_drum = search("second tone, smooth minimum of two", lower_of_two)
values = dp.eigenpairs(drum, 4, mass=best_drum).values
print(f"second and third eigenvalue {start[1]:.3f}, {start[2]:.3f} -> {values[1]:.3f}, {values[2]:.3f}")
print(f"fourth eigenvalue {values[3]:.3f}")

# %%
# The picture
# -----------
# Left: the heavy cells (dark) of the square with the highest lowest tone, and the line on which :math:`u^2` divides
# them from the light ones. Middle: that mode. Right: the drum with the highest second tone, heavy where both modes are
# small.
#
# Exercises
# ---------
# 1. Ask for the *lowest* lowest tone: exchange the signs of loss and constraint. Where does the mass go?
# 2. Use :math:`p = 4` and :math:`p = 512`. What does the norm cost, and how many evaluations?
# 3. Raise the sum of the second and third eigenvalues, ``pairs.sum(1, 3)``, on a square, where they are equal from the
#    start. Why does `dp.hvp` of this loss exist?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
    x = (np.arange(n) + 0.5) / n
    level = 0.5 * (most + least)
    shown = {"origin": "lower", "vmin": 1.0, "vmax": 2.0, "cmap": "Greys"}
    left.imshow(best_square.T, extent=(0, 1, 0, 1), **shown)
    left.contour(x, x, mode.T, [level], colors="tab:orange")
    left.set_title(f"lowest tone: {even:.1f} to {pairs.values[0]:.1f}")
    middle.imshow(mode.T, extent=(0, 1, 0, 1), origin="lower", cmap="viridis")
    middle.set_title("its mode, squared")
    right.imshow(best_drum.T, extent=(0, 1, 0, 1.06), **shown)
    right.set_title(f"second tone: {start[1]:.1f} to {values[1]:.1f}")
    for ax in (left, middle, right):
        ax.set(xticks=[], yticks=[])
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "membrane_design.png", dpi=120)
