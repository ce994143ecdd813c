"""Inverses on ranks, forward and adjoint, compared with one process; null spaces, isolated regions, errors.

mpirun -n 2 python -m mpi4py tests/ranks/solves_on_ranks.py
"""

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI

import sparsedp as dp

COMM = MPI.COMM_WORLD
RNG = np.random.default_rng(3)
GRIDS = [
    dp.Grid(23, spacing=0.3),
    dp.Grid((12, 9), size=(2.0, 1.0), periodic=(True, False)),
    dp.Grid((12, 14), spacing=[RNG.uniform(0.5, 2.0, n) for n in (12, 14)]),
    dp.Grid((6, 4, 8), size=1.0, periodic=(False, True, False)),
]
ISLANDS = dp.Grid((12, 10), size=1.0)
WALL = np.zeros((12, 10), dtype=bool)
WALL[5], WALL[2, 3], WALL[6:, 4] = True, True, True


def operators(grid):
    """Name, square operator: regular and singular, symmetric and not, with obstacles."""
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    yield "dirichlet", -dp.laplacian(grid, {grid.axes[-1]: dp.robin(1, 2)} if not grid.periodic[-1] else dp.neumann)
    yield "neumann", -D @ G
    yield "negative", dp.laplacian(grid)
    yield "step", dp.identity(grid.cells) - 0.3 * dp.laplacian(grid)
    k = dp.diagonal(grid.faces, 1.0 + np.arange(grid.faces.size) % 7)
    yield "coefficients", -D @ k @ G
    yield "wind", dp.identity(grid.cells) + 2.0 * dp.upwind(grid, 0, 1, dp.neumann) - 0.1 * dp.laplacian(grid)
    yield "far from 1", 2.0**300 * dp.laplacian(grid, dp.dirichlet)
    if grid.shape == WALL.shape:
        yield "islands", -dp.laplacian(grid, solid=WALL)
        yield "held", -dp.laplacian(grid, dp.dirichlet, WALL, dp.dirichlet)


def close(value, expected, tol, name):
    """Compare, and see that all ranks have the same."""
    value = np.asarray(dp.gather(value))
    expected = np.asarray(expected)
    assert len(set(COMM.allgather(value.tobytes()))) == 1
    error = np.max(np.abs(value - expected), initial=0.0) / np.max(np.abs(expected), initial=1e-300)
    assert error <= tol, (name, error)


def inverses_are_those_of_one_process():
    """Solutions, adjoints and gradients at rtol 1e-12."""
    for plain in (*GRIDS, ISLANDS):
        grid = dp.distribute(plain, COMM)
        for (name, one), (_, op) in zip(operators(plain), operators(grid)):
            expected, actual = (dp.inverse(A, rtol=1e-12, nullspace="project") for A in (one, op))
            b = np.random.default_rng(1).standard_normal(plain.shape)
            b = b if name not in ("islands", "held") else np.where(WALL, 0.0, b)
            where = f"{name} on {plain}"
            close(actual(b), expected(b), 1e-9, where)
            close(actual.T(b), expected.T(b), 1e-9, f"{where}, adjoint")
            close(actual(1e-200 * b), expected(1e-200 * b), 1e-9, f"{where}, small")
            assert actual.info.forward.residual <= 1e-12 or actual.info.forward.status == "converged_at_roundoff"
            slopes = [dp.grad(lambda b, inv=inv: anp.sum(anp.sin(inv(b)) ** 2))(b) for inv in (actual, expected)]
            close(*slopes, 1e-8, f"{where}, gradient")
    grid = dp.distribute(ISLANDS, COMM)
    assert dp.inverse(-dp.laplacian(grid, solid=WALL), nullspace="project").solver.system.null_space.count == 3


def elliptic_misfits():
    """Value, gradient, tangent and Hessian product in a coefficient on cells, data and shift, whole or on ranks.

    Without obstacles, and with one cell in eight of them.
    """
    for plain in (GRIDS[2], GRIDS[3]):
        rng = np.random.default_rng(4)
        k, b, t = rng.uniform(0.5, 2.0, plain.shape), *rng.standard_normal((2, *plain.shape))
        holes = rng.random(plain.shape) < 0.125
        for boundary, solid in ((dp.dirichlet, None), (dp.neumann, None), (dp.dirichlet, holes)):
            results = []
            for grid, lay in ((plain, False), (dp.distribute(plain, COMM), False), (dp.distribute(plain, COMM), True)):
                D = dp.divergence(grid)
                G = dp.gradient(grid, boundary, solid)
                mean = dp.harmonic_average(grid)
                solve = dp.elliptic_solver(D, G, rtol=1e-13, nullspace="project")
                field = dp.identity(grid.cells) if lay else lambda u: u
                x = (field(np.log(k)), field(b), 0.2)
                along = (field(t), field(b[::-1].copy()), 0.3)
                loss = lambda x, solve=solve, mean=mean: anp.sum(anp.sin(solve(mean(anp.exp(x[0])), x[1], x[2])) ** 2)
                value, slopes = dp.value_and_grad(loss)(x)
                results.append((value, *slopes, dp.jvp(loss, x, along)[1], *dp.hvp(loss, x, along)))
            for actual in results[1:]:
                for number, pair in enumerate(zip(actual, results[0])):
                    close(*pair, 1e-10, f"elliptic_solver on {plain}, number {number}")


def products_with_inverses():
    """A projection written out: v + G A^-1 D v as one operator, and its transpose."""
    results = []
    for grid in (GRIDS[2], dp.distribute(GRIDS[2], COMM)):
        D = dp.divergence(grid)
        G = dp.gradient(grid)
        inside = dp.interior(grid)
        P = inside + G @ dp.inverse(-D @ G, rtol=1e-12, nullspace="project") @ D @ inside
        v = np.random.default_rng(2).standard_normal(grid.faces.size)
        results.append((P(v), P.T(v)))
    for actual, expected in zip(results[1], results[0]):
        close(actual, expected, 1e-9, "projection")


def refused(kind, words, act):
    """An error with the same words on all ranks."""
    try:
        act()
    except kind as error:
        messages = COMM.allgather(str(error))
        assert len(set(messages)) == 1 and words in messages[0], messages
    else:
        raise AssertionError(words)


def errors_are_the_same_on_all_ranks():
    """Incompatible data, NaN in one block, too few iterations, data in an obstacle."""
    plain = GRIDS[2]
    grid = dp.distribute(plain, COMM)
    inv = dp.inverse(-dp.laplacian(grid))
    refused(
        dp.errors.IncompatibleError,
        "is singular and the right-hand side is not in its range",
        lambda: inv(1.0 + plain.volumes),
    )
    b = np.ones(plain.shape)
    b[-1, -1] = np.nan
    refused(dp.errors.NonFiniteError, "the first at (11, 13)", lambda: inv(b))
    few = dp.inverse(dp.identity(grid.cells) - 50 * dp.laplacian(grid), rtol=1e-13, maxiter=1)
    b[-1, -1] = 7.0
    refused(dp.errors.ConvergenceError, "petsc on", lambda: few(b * np.arange(14)))
    solid = dp.inverse(-dp.laplacian(dp.distribute(ISLANDS, COMM), solid=WALL))
    b = np.zeros(WALL.shape)
    b[8, 4] = 1.0
    refused(dp.errors.IncompatibleError, "but is not in cell (8, 4)", lambda: solid(b))


if __name__ == "__main__":
    inverses_are_those_of_one_process()
    elliptic_misfits()
    products_with_inverses()
    errors_are_the_same_on_all_ranks()
    if COMM.rank == 0:
        print("all agree")
