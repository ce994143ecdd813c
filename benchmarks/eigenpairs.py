"""Eigenvalues of membranes: errors on an L-shape, and seconds beside SciPy's `eigsh` with a shift.

Run ``python -m benchmarks.eigenpairs [cells]`` in the root of the repository; cells: the finest grid along an axis.

The L-shape is (-1, 1)^2 without a quarter, with walls on the faces of the cells that are left out; three of its
eigenvalues are known to many digits. The squares have 6 pairs each, with constant coefficients and with a tension and a
density that vary. `eigsh` factors the matrix by SuperLU; its default start vector is random.
"""

import sys
from time import perf_counter

import autograd.numpy as anp
import numpy as np
from scipy.sparse.linalg import eigsh

import sparsedp as dp

__all__ = ["L_SHAPE", "l_shape", "square"]

L_SHAPE = 9.6397238440219, 15.1972519267, 2 * np.pi**2  # Trefethen and Betcke (2006); the third one is exact


def l_shape(n):
    """Return the operator on n x n cells of the square around the L."""
    grid = dp.Grid((n, n), size=2.0, origin=-1.0)
    x, y = grid.centres()
    return -dp.laplacian(grid, dp.dirichlet, solid=(x > 0) & (y < 0), solid_boundary=dp.dirichlet)


def square(n):
    """Return the solver of a membrane on n x n cells, its tension and its density."""
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    tension = dp.harmonic_average(grid)(1.0 + 0.5 * np.sin(3 * x) * y)
    return dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet)), tension, 1.0 + 0.5 * x + 0.3 * y**2


def timed(call):
    """Return the result of a call and its seconds."""
    start = perf_counter()
    result = call()
    return result, perf_counter() - start


def orders(finest):
    """Print the errors on the L-shape, and the orders of two grids."""
    print("L-shape  cells  errors of the three eigenvalues      orders")
    last = None
    for n in (n for n in (16, 32, 64, 128, 256, 512) if n <= finest):
        errors = dp.eigenpairs(l_shape(n), 3).values - L_SHAPE
        order = "" if last is None else "  ".join(f"{number:.2f}" for number in np.log2(np.abs(last / errors)))
        print(f"         {n:4}   {'  '.join(f'{error:9.2e}' for error in errors)}      {order}", flush=True)
        last = errors


def seconds(n):
    """Print the seconds of 6 pairs on a square of n x n cells, of derivatives, and of SciPy."""
    solve, tension, density = square(n)
    constant = -dp.laplacian(dp.Grid((n, n), size=1.0), dp.dirichlet)

    def pairs(k):
        return dp.eigenpairs(solve, 6, coefficients=k, mass=density)

    rows = {
        "constant": lambda: dp.eigenpairs(constant, 6).values,
        "variable": lambda: pairs(tension).values,
        "variable, lobpcg": lambda: dp.eigenpairs(solve, 6, coefficients=tension, mass=density, method="lobpcg").values,
        "value and gradient of a value": lambda: dp.value_and_grad(lambda k: pairs(k).values[0])(tension)[0],
        "value and gradient of a vector": lambda: dp.value_and_grad(lambda k: anp.sum(pairs(k)[0][1] ** 4))(tension)[0],
        "eigsh, constant, sigma=0": lambda: np.sort(eigsh(constant.matrix.tocsc(), 6, sigma=0.0)[0]),
    }
    for name, call in rows.items():
        result, time = timed(call)
        print(f"{n:4}^2  {name:32} {time:8.2f} s   {np.ravel(result)[0]:.12g}", flush=True)


def main(finest):
    """Print both tables."""
    timed(lambda: dp.eigenpairs(square(64)[0], 2, coefficients=1.0).values)  # compiles the loops
    orders(min(finest, 256))
    for n in (256, 1024):
        if n <= finest:
            seconds(n)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1024)
