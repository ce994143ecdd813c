"""Poisson and its adjoint: error against run time for every solver. Run: python examples/poisson_adjoint.py [cells]"""

import sys
from time import perf_counter

import autograd.numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

import sparsedp as dp

EXACT = 0.03514425373879  # integral of u on the unit square, -lap u = 1, u = 0 on the walls
finest = int(sys.argv[1]) if len(sys.argv) > 1 else 256

# J(f) = integral of u with -lap u = f. The adjoint problem is -lap w = 1 as well, so dJ/df = h^2 u: the
# gradient has the same exact solution, and one table shows the error of the value and of the gradient.
print("method      cells  set-up s  forward s  adjoint s  error of J  error of dJ/df  iterations")
for method in ("direct", "multigrid", "structured", "separable", "krylov"):
    for n in (finest // 4, finest // 2, finest):
        grid = dp.Grid((n, n), size=1.0)
        try:
            solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet), method)
        except ValueError as missing:
            print(f"{method:10} {n:4}^2  {missing}")
            continue
        middle = dp.sample(grid, [[0.5, 0.5]])
        ones = np.ones(grid.shape)
        solve(ones)  # the first call of a compiled kernel is not the price of a solve
        start = perf_counter()
        value, gradient = dp.value_and_grad(lambda f: np.sum(grid.volumes * solve(f)))(ones)
        total = perf_counter() - start
        adjoint = solve.info.adjoint.seconds
        errors = abs(value / EXACT - 1), abs(middle(gradient / grid.volumes)[0] / 0.07367135328151 - 1)
        print(
            f"{method:10} {n:4}^2  {solve.info.setup_seconds:8.1e}  {total - adjoint:9.1e}  {adjoint:9.1e}"
            f"  {errors[0]:10.1e}  {errors[1]:14.1e}  {solve.info.forward.iterations:10}"
        )


def lowest(n):
    """Lowest eigenvalue of -lap on the L-shape: the square (-1, 1)^2 without one quarter, u = 0 all around."""
    grid = dp.Grid((n, n), size=2.0, origin=-1.0)
    x, y = grid.centres()
    quarter = (x > 0) & (y < 0)
    inverse = dp.inverse(-dp.laplacian(grid, dp.dirichlet, quarter, dp.dirichlet), nullspace="project")
    flat = LinearOperator(inverse.shape, matvec=inverse.matvec, dtype=float)
    return 1 / eigsh(flat, k=1, which="LA", v0=np.where(quarter, 0.0, 1.0).ravel(), return_eigenvectors=False)[0]


sizes = (finest // 4, finest // 2, finest)
gaps = [abs(lowest(n) - 9.6397238440219) for n in sizes]
order = np.log2(gaps[-2] / gaps[-1])
print(f"\nL-shape, lowest eigenvalue 9.63972384: errors {gaps[0]:.1e} {gaps[1]:.1e} {gaps[2]:.1e}, order {order:.2f}")
