r"""
Raising the lowest frequencies of a membrane
============================================

Where to put a given mass, so that the first or the second eigenvalue of a membrane is as large as possible.

Most of the weight of a drum is a layer that can be twice as thick in some places as in others. The total mass is given.
The lowest eigenvalue is the easy case: it is simple, and the problem is convex. The second one of a nearly square drum
is the usual case in practice: during the search it meets the third, and a double eigenvalue has no gradient.

Run it: ``python examples/membrane_design.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Raising the lowest frequencies of a membrane.")
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


def mass_deficit(density):
    """At most 0 if the membrane is heavy enough."""
    return 1.5 - np.mean(density)


def search(label, loss, maxiter=60):
    """Return the best density for a loss."""
    limits = {"bounds": (1.0, 2.0), "constraints": mass_deficit}
    best = dp.minimize(loss, START, "augmented_lagrangian", maxiter, **limits)
    print(f"{label}: {best.evaluations} evaluations, mean density {np.mean(best.x):.6f}")
    return best.x


# %%
# The lowest eigenvalue
# ---------------------
# By Rayleigh's principle,
#
# .. math:: \frac{1}{\lambda_1} = \max_u \frac{\int \rho \, u^2}{\int |\nabla u|^2}
#
# is a maximum of functions that are linear in :math:`\rho`, and so it is convex. We minimize this inverse, divided by
# its value at the start. The derivative of :math:`\lambda_1` with respect to :math:`\rho` is :math:`-\lambda_1 u^2`, if
# :math:`\int \rho \, u^2 = 1`. At the optimum no exchange of mass between two cells raises :math:`\lambda_1`: the
# membrane is heavy where :math:`u^2` is small, light where it is large, and between them is a line on which :math:`u^2`
# is constant.

square = -dp.laplacian(dp.Grid((n, n), size=1.0), dp.dirichlet)
lowest_at_start = dp.eigenpairs(square, 1, mass=START).values[0]


def inverse_of_lowest(density):
    """Return the inverse of the lowest eigenvalue, 1 at the start."""
    return lowest_at_start / dp.eigenpairs(square, 1, mass=density).values[0]


best_square = search("lowest eigenvalue of the square", inverse_of_lowest)
pairs = dp.eigenpairs(square, 1, mass=best_square)
squared_mode = pairs.vectors[0] ** 2 / np.max(pairs.vectors[0] ** 2)
largest_if_heavy = np.max(squared_mode[best_square > 1.95])
smallest_if_light = np.min(squared_mode[best_square < 1.05])
print(f"eigenvalue {lowest_at_start:.4f} -> {pairs.values[0]:.4f}")
print(f"u^2 up to {largest_if_heavy:.3f} in heavy cells, from {smallest_if_light:.3f} in light ones")

# %%
# The second eigenvalue
# ---------------------
# The drum is now 1.06 times as long as it is wide. Its second and third eigenvalues differ by 7 %. A search for the
# largest second eigenvalue raises it until it meets the third. There both are equal. Each change of the density splits
# them, and neither has a gradient. `dp.eigenpairs` raises an error, because the formula of the derivative would return
# a number that depends on the arbitrary choice of two modes.

drum = -dp.laplacian(dp.Grid((n, n), size=(1.0, 1.06)), dp.dirichlet)
values_at_start = dp.eigenpairs(drum, 3, mass=START).values
clusters = []


def inverse_of_second(density):
    """Return the inverse of the second eigenvalue, 1 at the start."""
    pairs = dp.eigenpairs(drum, 3, mass=density)
    clusters.append(pairs.clusters)
    return values_at_start[1] / pairs.values[1]


try:
    search("second eigenvalue, its own gradient", inverse_of_second)
except dp.errors.DerivativeError as error:
    print(f"second eigenvalue, its own gradient: after {len(clusters)} evaluations: {error}")

# %%
# A function of both that treats them alike has a gradient at that point too. The norm
#
# .. math:: \Bigl( \lambda_2^{-p} + \lambda_3^{-p} \Bigr)^{1/p}
#
# is between the larger of :math:`1/\lambda_2`, :math:`1/\lambda_3` and :math:`2^{1/p}` times that. We use
# :math:`p = 64`. We compute three pairs; the fourth eigenvalue is much larger, so that no cluster continues behind the
# last pair.


def norm_of_inverses(density):
    """Return the p-norm of the inverses of the second and third eigenvalues, a smooth maximum."""
    values = dp.eigenpairs(drum, 3, mass=density).values[1:]
    return np.sum((values_at_start[1] / values) ** 64) ** (1 / 64)


best_drum = search("second eigenvalue, p-norm of two", norm_of_inverses)
values = dp.eigenpairs(drum, 4, mass=best_drum).values
_, second_at_start, third_at_start = values_at_start
print(f"second and third eigenvalue {second_at_start:.3f}, {third_at_start:.3f} -> {values[1]:.3f}, {values[2]:.3f}")
print(f"fourth eigenvalue {values[3]:.3f}")

# %%
# The picture
# -----------
# Left: the heavy cells (dark) of the square with the largest first eigenvalue, and the level line of :math:`u^2` that
# separates them from the light ones. Middle: :math:`u^2`. Right: the drum with the largest second eigenvalue, heavy
# where both modes are small.
#
# Exercises
# ---------
# 1. Search for the *smallest* first eigenvalue: change the signs of loss and constraint. Where is the mass then?
# 2. Use :math:`p = 4` and :math:`p = 512`. How do the second eigenvalue and the number of evaluations change?
# 3. Raise the sum of the second and third eigenvalues, ``pairs.sum(1, 3)``, on a square, where they are equal from the
#    start. Why does this loss have second derivatives (`dp.hvp`)?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
    x = (np.arange(n) + 0.5) / n
    level = 0.5 * (largest_if_heavy + smallest_if_light)
    shown = {"origin": "lower", "vmin": 1.0, "vmax": 2.0, "cmap": "Greys"}
    left.imshow(best_square.T, extent=(0, 1, 0, 1), **shown)
    left.contour(x, x, squared_mode.T, [level], colors="tab:orange")
    left.set_title(f"first eigenvalue: {lowest_at_start:.1f} to {pairs.values[0]:.1f}")
    middle.imshow(squared_mode.T, extent=(0, 1, 0, 1), origin="lower", cmap="viridis")
    middle.set_title("its mode, squared")
    right.imshow(best_drum.T, extent=(0, 1, 0, 1.06), **shown)
    right.set_title(f"second eigenvalue: {second_at_start:.1f} to {values[1]:.1f}")
    for ax in (left, middle, right):
        ax.set(xticks=[], yticks=[])
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "membrane_design.png", dpi=120)
