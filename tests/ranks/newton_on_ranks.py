"""Newton's method for unknowns in blocks compared with one process: roots, steady states, derivatives, errors.

The first line that is printed is the same on any number of ranks: bits of products with Jacobians.

mpirun -n 2 python -m mpi4py tests/ranks/newton_on_ranks.py
"""

import sys
from functools import partial
from hashlib import sha256

import autograd.numpy as anp
import numpy as np
from flow_on_ranks import COMM, close, derivatives, in_blocks, on_both, refused

import sparsedp as dp
from sparsedp.autodiff.tape import plain
from sparsedp.parallel.jacobian import RanksJacobians
from sparsedp.solvers.choose_method import check_settings
from sparsedp.solvers.newton import Equation, Unknowns

PLAIN = dp.Grid((9, 8), size=(1.0, 2.0))
GRIDS = [
    PLAIN,
    dp.Grid((7, 8), spacing=[np.linspace(1, 2, 7), np.linspace(2, 1, 8)], periodic=(False, True)),
    dp.Grid((5, 6, 4), size=1.0, periodic=(True, False, True)),
    dp.Grid(23, size=1.0, periodic=True),
]


def diffusion(grid):
    """An implicit step of D (k + u^2) G u: a matrix that is not symmetric."""
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    A = dp.average(grid)
    return lambda x, u, k: x - u - 1e-2 * D((k + A(x) ** 2) * G(x))


def bratu(grid):
    """L u + k exp(u) = u_0, a symmetric one."""
    L = dp.laplacian(grid, dp.dirichlet)
    return lambda x, u, k: L(x) - x + 0.3 * k * anp.exp(x) + u


def pointwise(grid):
    """Without neighbours."""
    return lambda x, u, k: x + k * x**3 - u


def species(grid):
    """Two fields on cells that react."""
    L = dp.laplacian(grid)
    return lambda x, u, k: {
        "a": x["a"] - 0.1 * k * L(x["a"] * x["b"]) - u,
        "b": x["b"] - 0.3 * x["a"] ** 2 - 1.0,
    }


def flux(grid):
    """A field on cells and one on faces."""
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    A = dp.average(grid)
    return lambda x, u, k: {
        "p": x["p"] - k * D(x["q"]) - u,
        "q": x["q"] * (1 + 0.1 * A(x["p"]) ** 2) - k * G(x["p"]),
    }


def guess(make, grid, field):
    """Return the guess."""
    zeros = field(grid.cells, np.zeros(grid.shape))
    if make is species:
        return {"a": zeros, "b": zeros + 1.0}
    if make is flux:
        return {"p": zeros, "q": field(grid.faces, np.zeros(grid.faces.size))}
    return zeros


def root_and_derivatives(make, grid, field):
    """The root, and a loss of it with its derivatives to second order."""
    solve = dp.implicit(make(grid), rtol=1e-13)
    start = guess(make, grid, field)
    u, t = np.random.default_rng(1).standard_normal((2, *grid.shape))
    x = (field(grid.cells, u), 0.2)
    along = (field(grid.cells, t), -0.3)

    def loss(x):
        root = solve(start, *x)
        fields = list(root.values()) if isinstance(root, dict) else [root]
        return sum(anp.sum(anp.sin(field) ** 2) + anp.sum(field) for field in fields)

    value, slopes, tangent, bent = derivatives(loss, x, along)
    assert solve.info.forward.status.startswith("converged") and solve.info.forward.iterations < 12
    return value, *slopes, tangent, *bent


def cavity(grid, field):
    """The steady flow under a lid, velocity and pressure together."""
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    L = dp.face_laplacian(grid)
    convect = dp.convection(grid)
    inside = dp.interior(grid)
    lid = dp.face_lift(grid)
    pin = np.zeros(grid.shape)
    moving, pin[0, 0] = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0)), 1.0

    def equations(x, reynolds):
        v = x["v"]
        p = x["p"]
        momentum = (L(v) + moving) / reynolds - convect(v, v) - G(p)
        return {"v": inside(momentum) + v - inside(v), "p": D(v) + pin * p}

    rest = {"v": field(grid.faces, np.zeros(grid.faces.size)), "p": field(grid.cells, np.zeros(grid.shape))}

    def loss(reynolds):
        x = dp.steady(equations, rest, reynolds, rtol=1e-12)
        return anp.sum(x["v"] ** 2 * (1 + x["v"])) + anp.sum(x["p"] ** 2)

    return dp.value_and_grad(loss)(50.0)


def jacobian_given(matrix, grid, field):
    """A Jacobian of operators, or a matrix that every rank has."""
    L = dp.laplacian(grid)

    def jacobian(x, u, k):
        J = dp.identity(grid.cells) - 1e-2 * L @ dp.diagonal(grid.cells, 3 * k * dp.gather(x) ** 2)
        if matrix:
            return J.matrix
        return J

    solve = dp.implicit(lambda x, u, k: x - u - 1e-2 * k * L(x**3), jacobian, rtol=1e-13)
    u = field(grid.cells, np.random.default_rng(1).standard_normal(grid.shape))
    value, slopes = dp.value_and_grad(lambda x: anp.sum(anp.sin(solve(x[0], *x)) ** 2))((u, 0.7))
    return value, *slopes


def roots():
    """Compare all problems on all grids."""
    for one in GRIDS:
        for make in (diffusion, bratu, pointwise, species, flux):
            on_both(make.__name__, one, partial(root_and_derivatives, make), fields=(in_blocks,))
    on_both("cavity", dp.Grid((12, 12), size=1.0), cavity, fields=(in_blocks,))
    for matrix in (False, True):
        on_both("jacobian", PLAIN, partial(jacobian_given, matrix), fields=(in_blocks,))


def entries_that_are_0_at_first():
    """Compare a residual whose coupling to neighbours is 0 near the guess; and one root for several spaces."""

    def compute(grid, field):
        L = dp.laplacian(grid, dp.dirichlet)
        A = dp.average(grid)
        solve = dp.implicit(lambda x, k: x - k - 1e-2 * L(anp.maximum(x - 5.0, 0.0)), rtol=1e-13)
        loss = lambda k: anp.sum(solve(field(grid.cells, np.ones(grid.shape)), k) ** 2)
        cube = dp.implicit(lambda x, k: x**3 - k)
        both = [cube(field(space, np.ones(space.shape)), 2.0) for space in (grid.cells, A.codomain)]
        others = *grid.centres()[:1], *grid.face_centres(0)[:1], grid.split(both[1])[0]
        places = [cube(1.0 + abs(x), 2.0) for x in others]
        return *dp.value_and_grad(loss)(6.0), *both, *places

    on_both("late entries", PLAIN, compute, fields=(in_blocks,))


def bits():
    """The digest of products with Jacobians."""
    digest = sha256()
    for one in GRIDS:
        grid = dp.distribute(one, COMM)
        for make in (diffusion, bratu, species, flux):
            start = guess(make, grid, in_blocks)
            unknowns = Unknowns(start, "f")
            params = (in_blocks(grid.cells, np.ones(grid.shape)), 0.7)
            equation = Equation(make(grid), unknowns, params, "f")
            settings = check_settings("auto", 1e-10, None, "raise", {})
            x = unknowns.distribute(np.sin(np.arange(float(unknowns.size))))
            J = RanksJacobians("f", None, None, settings).evaluate(equation, x, equation.variables(params))
            digest.update(dp.gather(J.product(x)).tobytes())
    if COMM.rank == 0:
        print(digest.hexdigest())


def narrow(x, k):
    """A residual that one rank cannot evaluate beyond 2."""
    if COMM.rank == COMM.size - 1 and np.max(plain(x).flat) > 2:
        raise dp.errors.UnstableStepError("planted")
    return x**2 - k


def errors_are_the_same_on_all_ranks():
    """Compare error messages between ranks, of errors that one rank or all raise."""
    grid = dp.distribute(PLAIN, COMM)
    one = in_blocks(grid.cells, np.ones(grid.shape))
    L = dp.laplacian(grid)
    refused(dp.errors.UnstableStepError, "planted", lambda: dp.implicit(narrow)(3 * one, 2.0))
    solve = dp.implicit(narrow)
    close(
        solve(0.1 * one, 2.0), np.full(grid.shape, 2**0.5), 1e-12, "a search on all ranks for a point that one refuses"
    )
    assert solve.info.forward.iterations > 3
    hole = np.ones(grid.shape)
    hole[-1, -1] = np.nan
    refused(dp.errors.NonFiniteError, "1 that are NaN", lambda: dp.implicit(narrow)(in_blocks(grid.cells, hole), 2.0))
    refused(dp.errors.ConvergenceError, "Newton steps", lambda: dp.implicit(lambda x, k: x**2 + k)(one, 1.0))
    free = dp.implicit(lambda x, k: k * L(x))
    refused(dp.errors.ConvergenceError, "not isolated", lambda: dp.grad(lambda k: anp.sum(free(one, k) ** 2))(1.3))
    wrong = dp.implicit(lambda x, k: x**3 - k, lambda x, k: dp.diagonal(grid.cells, 4 * dp.gather(x) ** 2))
    refused(dp.errors.DerivativeError, "the jacobian given", lambda: dp.grad(lambda k: anp.sum(wrong(one, k)))(1.3))


if __name__ == "__main__":
    bits()
    if sys.argv[1:] != ["bits"]:
        roots()
        entries_that_are_0_at_first()
        errors_are_the_same_on_all_ranks()
    if COMM.rank == 0:
        print("all agree")
