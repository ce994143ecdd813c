r"""
Poisson and its adjoint
=======================

The gradient of a solve is one more solve. Here every solver pays for both, and we see what each of them gets for it.

A membrane over a square is pushed by a load :math:`f`, and its edge is fixed. How much volume is below it, and at which
point would a little more load change that the most? On a grid, the answer costs two linear solves, however many cells
carry load.

Run it: ``python examples/poisson_adjoint.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

import sparsedp as dp

parser = argparse.ArgumentParser(description="Poisson and its adjoint with every solver.")
parser.add_argument("cells", nargs="?", type=int, default=256, help="cells along an axis of the finest grid")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()
sizes = options.cells // 4, options.cells // 2, options.cells

# %%
# The adjoint solve
# -----------------
# The membrane :math:`u` solves :math:`A u = f` with :math:`A = -\Delta`, and the volume is :math:`J = w^T u`, where
# :math:`w` holds the areas of the cells. A change of the load moves the volume by
#
# .. math:: dJ = w^T A^{-1} df = (A^{-T} w)^T df .
#
# The gradient is :math:`A^{-T} w`: a solve with the transposed operator, the **adjoint solve**. The iterations of the
# solver are not differentiated, and they need not be stored.
#
# With a uniform load the exact results are known: the volume, and the height of the membrane in the middle. Since
# :math:`A` is symmetric here, the gradient divided by the area of a cell is the membrane itself, so that the error in
# the middle is the error of the gradient.

VOLUME = 0.03514425373879
MIDDLE = 0.07367135328151


def measure(method, cells):
    """Return a row of the table: cost and accuracy of one solver on one grid."""
    grid = dp.Grid((cells, cells), size=1.0)
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet), method)
    load = np.ones(grid.shape)
    solve(load)  # the first solve of a kind also compiles its loops

    def volume(f):
        return np.sum(grid.volumes * solve(f))

    start = perf_counter()
    value, gradient = dp.value_and_grad(volume)(load)
    total = perf_counter() - start
    middle = dp.sample(grid, [[0.5, 0.5]])(gradient / grid.volumes)[0]
    return {
        "cells": cells,
        "setup": solve.info.setup_seconds,
        "forward": total - solve.info.adjoint.seconds,
        "adjoint": solve.info.adjoint.seconds,
        "value error": abs(value / VOLUME - 1),
        "gradient error": abs(middle / MIDDLE - 1),
        "iterations": solve.info.forward.iterations,
    }


# %%
# Every solver, three grids
# -------------------------
# All solvers solve the same equations, so on one grid all have the same error. With twice as many cells along an axis
# it is four times smaller. Only the run times differ.

rows = {}
print("method      cells  set-up s  forward s  adjoint s  error of J  error of dJ/df  iterations")
for method in ("direct", "multigrid", "structured", "separable", "krylov"):
    for cells in sizes:
        try:
            measure(method, 16)  # importing and compiling is no part of a set-up
            row = measure(method, cells)
        except ValueError as missing:  # a solver that is not installed, or not made for this grid
            print(f"{method:10} {cells:4}^2  {missing}")
            continue
        rows.setdefault(method, []).append(row)
        seconds = f"{row['setup']:8.1e}  {row['forward']:9.1e}  {row['adjoint']:9.1e}"
        errors = f"{row['value error']:10.1e}  {row['gradient error']:14.1e}"
        print(f"{method:10} {cells:4}^2  {seconds}  {errors}  {row['iterations']:10}")

# %%
# A corner that points inwards
# ----------------------------
# Not everything converges with order 2. Without a quarter of the square :math:`(-1, 1)^2`, the membrane behaves like
# :math:`r^{2/3}` at the new corner; its slope is infinite there, which a uniform grid does not resolve. We compute the
# least eigenvalue of :math:`-\Delta`, the lowest frequency of an L-shaped drum, which is known to many digits. An
# inverse is an operator, so SciPy's Lanczos method accepts it: the largest eigenvalue of the inverse is the reciprocal
# of the least eigenvalue.

LOWEST = 9.6397238440219


def drum(cells):
    """The L-shape: a grid of the whole square, the quarter that is missing, and the inverse of its operator."""
    grid = dp.Grid((cells, cells), size=2.0, origin=-1.0)
    x, y = grid.centres()
    quarter = (x > 0) & (y < 0)
    operator = -dp.laplacian(grid, dp.dirichlet, solid=quarter, solid_boundary=dp.dirichlet)
    return grid, quarter, dp.inverse(operator, nullspace="project")


def lowest(cells):
    """Lowest eigenvalue of the drum and its shape."""
    _, quarter, inverse = drum(cells)
    flat = LinearOperator(inverse.shape, matvec=inverse.matvec, dtype=float)
    (value,), shape = eigsh(flat, k=1, which="LA", v0=np.where(quarter, 0.0, 1.0).ravel())
    return 1 / value, np.abs(shape[:, 0])


gaps = [abs(lowest(cells)[0] - LOWEST) for cells in sizes]
order = np.log2(gaps[-2] / gaps[-1])
print(f"L-shape, lowest eigenvalue 9.63972384: errors {gaps[0]:.1e} {gaps[1]:.1e} {gaps[2]:.1e}, order {order:.2f}")

# %%
# The picture
# -----------
# Left: run time of a gradient, including the set-up, and its error; the lower left is better. Right: the least
# eigenvalue of the drum.
#
# Exercises
# ---------
# 1. Replace the volume by the height at one point, `dp.sample(grid, [[0.3, 0.7]])`. What does the gradient look like?
#    It is a well known function: which?
# 2. Print `solve.info.adjoint` for `method="krylov"`. Does the adjoint solve take as many iterations as the forward
#    one?
# 3. Which order has the drum when the corner is cut away at 45 degrees?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (costs, tone) = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for (method, points), mark in zip(rows.items(), "os^Dv"):
        seconds = [row["setup"] + row["forward"] + row["adjoint"] for row in points]
        costs.loglog(seconds, [row["gradient error"] for row in points], marker=mark, label=method)
    costs.set(title="value and gradient", xlabel="time [s]", ylabel="relative error of the gradient")
    costs.legend(frameon=False)
    grid, quarter, _ = drum(sizes[1])
    shape = lowest(sizes[1])[1].reshape(grid.shape)
    shape = np.where(quarter, np.nan, shape / np.max(shape))
    dp.plot(grid, shape, ax=tone, title="lowest tone of the drum", label="height, largest 1", limits=(0, 1))
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "poisson_adjoint.png", dpi=120)
