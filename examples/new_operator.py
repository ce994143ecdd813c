r"""
An operator of your own
=======================

Five lines, as a matrix or as two functions; and what the checks say when one of them is wrong.

Your instrument or your physics may need an operator that the library does not have. Every linear map can be used that
can be applied and transposed. Gradients then work as for other operators: the VJP of a linear map *is* its transpose.

Run it: ``python examples/new_operator.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np
import scipy.sparse as sp

import sparsedp as dp

parser = argparse.ArgumentParser(description="Your own operator in five lines, in both families.")
parser.add_argument("cells", nargs="?", type=int, default=48, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

n = options.cells
grid = dp.Grid((n, n), size=1.0)
x, y = grid.centres()

# %%
# As a matrix
# -----------
# Any sparse matrix of SciPy will do. Here is a scanner that reads the mean of every row of cells along y: a field goes
# in, `n` numbers come out.

means = sp.kron(sp.eye_array(n), np.full((1, n), 1 / n))
scanner = dp.from_matrix(means, grid.cells, n, name="scanner")
print(dp.check.operator(scanner))

# %%
# As two functions
# ----------------
# Without a matrix, an operator is the map and its transpose. Here a wind blows half of each value one cell along x, and
# round the end. In the transpose the wind blows the other way:
#
# .. math:: (W u)_i = \tfrac{1}{2} (u_i + u_{i-1}), \qquad (W^T g)_i = \tfrac{1}{2} (g_i + g_{i+1}) .


def smear(u):
    """Apply the operator."""
    return 0.5 * u + 0.5 * np.roll(u, 1, axis=0)


def smear_back(g):
    """Apply the transpose of the operator."""
    return 0.5 * g + 0.5 * np.roll(g, -1, axis=0)


wind = dp.from_functions(smear, smear_back, grid.cells, grid.cells, name="wind")
print(dp.check.operator(wind))

# %%
# Together with the catalogue
# ---------------------------
# Both compose with what is there, and gradients run through all of it.

scan = scanner @ dp.laplacian(grid) @ wind
field = np.sin(5 * x + y)
print(scan)


def loss(u):
    """The size of what the scanner reads."""
    return np.sum(scan(u) ** 2)


print(dp.check.gradient(loss, field))

# %%
# What the check is for
# ---------------------
# Forget to turn the wind in the transpose: every value stays right, and every gradient is wrong. The check says so. It
# compares :math:`g^T (W u)` with :math:`(W^T g)^T u` for random :math:`u` and :math:`g`.

wrong = dp.from_functions(smear, smear, grid.cells, grid.cells, name="wind that never turns")
report = dp.check.operator(wrong)
print(f"{wrong.name}: {report.verdict}, because these fail: " + "; ".join(report.failed))

# %%
# The picture
# -----------
# A field, its gradient through scanner, Laplacian and wind, and the gradient with the wind that never turns.
#
# Exercises
# ---------
# 1. Write an operator that mirrors a field in x. What is its transpose?
# 2. Write a blur with weights 1/4, 1/2, 1/4 along y. Why does `smear_back=smear` pass the check now?

if options.out:
    from matplotlib import pyplot

    false_scan = scanner @ dp.laplacian(grid) @ wrong
    slopes = dp.grad(loss)(field), dp.grad(lambda u: np.sum(false_scan(u) ** 2))(field)
    most = np.max(np.abs(slopes))
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(13, 3.4), layout="constrained")
    dp.plot(grid, field, ax=left, title="the field", limits=(-1, 1), cmap="RdBu_r")
    for ax, slope, title in zip((middle, right), slopes, ("its gradient", "with the wind that never turns")):
        dp.plot(grid, slope, ax=ax, title=title, limits=(-most, most), cmap="RdBu_r")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "new_operator.png", dpi=120)
