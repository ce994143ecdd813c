"""Messages of the solvers: what was given, and what to write instead."""

import re
from collections.abc import Callable
from typing import NamedTuple

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.solvers import direct
from sparsedp.solvers.engine import EmptySystem
from sparsedp.solvers.nullspace import find_null_space
from sparsedp.solvers.system import System

SHAPE = dp.errors.ShapeError
FINITE = dp.errors.NonFiniteError
FAILED = dp.errors.ConvergenceError
INCOMPATIBLE = dp.errors.IncompatibleError


class Case(NamedTuple):
    make: Callable
    error: type
    match: str  # the whole message


GRID = dp.Grid((3, 2))
OP = -dp.laplacian(GRID, dp.dirichlet)
NEUMANN = -dp.laplacian(GRID)
WIND = dp.upwind(GRID, 0, 1, dp.dirichlet) + OP
BOX = dp.Grid((20, 20), size=1.0)
B = np.ones((3, 2))
LATE = np.where(np.arange(6).reshape(3, 2) > 2, np.nan, 1.0)
SOLID = np.zeros((3, 2), dtype=bool)
SOLID[1, 1] = True


def matrix(*rows):
    return dp.from_matrix(np.array(rows, dtype=float))


def tiny(dtype=float):
    """A solution that is 1e10 times the data."""
    return lambda: dp.inverse(1e-10 * dp.identity(GRID.cells))((B * (1e300 if dtype is float else 1e30)).astype(dtype))


CONTRACT = [
    Case(
        lambda: dp.inverse(OP)(LATE),
        FINITE,
        match="inverse(-laplacian) takes finite numbers, got 3 that are NaN or infinite, the first at (1, 1)",
    ),
    Case(
        tiny(),
        FINITE,
        match="the solution of inverse(1e-10 * identity) is beyond 1.8e308; scale the right-hand side down",
    ),
    Case(
        tiny(np.float32),
        FINITE,
        match="the solution of inverse(1e-10 * identity) is beyond float32; give it double precision",
    ),
    Case(
        lambda: dp.inverse(NEUMANN)(B),
        INCOMPATIBLE,
        match="inverse(-laplacian) is singular and the right-hand side is not in its range: on component 1 of 1 "
        "(6 cells from (0, 0)) the defect is 1.0e+00, allowed is 1e-06; "
        "subtract the weighted mean or write nullspace='project'",
    ),
    Case(
        lambda: dp.inverse(-dp.laplacian(GRID, dp.dirichlet, SOLID))(B),
        INCOMPATIBLE,
        match="inverse(-laplacian): the right-hand side must be 0 where there is no unknown (solid or isolated cells, "
        "coefficient 0), but is not in cell (1, 1); set it to 0 or write nullspace='project'",
    ),
    Case(
        lambda: dp.inverse(-dp.laplacian(BOX, dp.dirichlet), "krylov", rtol=0.01, maxiter=1)(np.ones((20, 20))),
        FAILED,
        match="krylov on <-laplacian: cells(20, 20) -> cells(20, 20), explicit>: "
        "relative residual 1.0e+00 after 1 iterations, wanted 0.01 (max_iterations)",
    ),
    Case(
        lambda: dp.inverse(OP, "krylov", diff="unrolled", maxiter=1)(B + np.arange(6.0).reshape(3, 2)),
        FAILED,
        match="unrolled krylov on <-laplacian: cells(3, 2) -> cells(3, 2), explicit>: "
        "relative residual 3.0e-01 after 1 iterations, wanted 1e-10",
    ),
    Case(
        lambda: dp.inverse(OP)(B, start=np.ones(3)),
        SHAPE,
        match="inverse(-laplacian), as start, takes a field on cells(3, 2), got an array of shape (3,)",
    ),
]

SET_UP = [
    Case(
        lambda: dp.inverse(matrix([1, 2], [2, 4])),
        FAILED,
        match="<matrix: space(2) -> space(2), explicit> is singular and its null space is neither the constants nor "
        "the volumes, or its condition number is beyond 1e14; add a shift, or remove the rows that depend on others",
    ),
    Case(
        lambda: dp.inverse(matrix([0, 0], [1, 2])),
        FAILED,
        match="row 0 of <matrix: space(2) -> space(2), explicit> has no entries, but its unknown is used in other "
        "rows; give it an equation",
    ),
    Case(
        lambda: dp.inverse(matrix([1, -1], [1, -1])),
        FAILED,
        match="<matrix: space(2) -> space(2), explicit> is singular and cannot be projected: "
        "the null vector of the other side was not found; add a shift",
    ),
    Case(
        lambda: find_null_space(System(matrix([1, -1], [1, -1]))),
        ArithmeticError,
        match="the null vector of the other side was not found",
    ),
    Case(
        lambda: find_null_space(System(matrix([2, -1, -1], [2, -1, -1], [1, 1, -2]))),
        ArithmeticError,
        match="the right and the left null vector are orthogonal",
    ),
    Case(
        lambda: dp.inverse(matrix([-1900, 1], [1, 400]), "multigrid"),
        ValueError,
        match="multigrid needs a diagonal of one sign; <matrix: space(2) -> space(2), explicit> "
        "has -1.9e+03 and 4.0e+02; write method='direct'",
    ),
    Case(
        lambda: dp.inverse(dp.from_functions(lambda u: 2 * u, lambda u: 2 * u, 5, 5, name="double"), "multigrid"),
        ValueError,
        match="multigrid needs the entries, <double: space(5) -> space(5), matrix-free> has only products; "
        "write method='krylov'",
    ),
    Case(
        lambda: dp.inverse(1j * OP, "multigrid"),
        ValueError,
        match=f"multigrid takes real operators, {1j * OP} is complex; write method='direct' or 'krylov'",
    ),
]

SETTINGS = [
    Case(
        lambda: dp.inverse(np.eye(3)),
        TypeError,
        match="inverse takes an Operator, got ndarray; write dp.from_matrix(...) first",
    ),
    Case(
        lambda: dp.inverse(dp.gradient(GRID)),
        SHAPE,
        match="inverse takes a square operator, got one from cells(3, 2) to faces(3, 2); write op.T @ op",
    ),
    Case(
        lambda: dp.inverse(OP, rtol=0.0),
        ValueError,
        match="rtol must be between 0 and 1, got 0; the default is 1e-10",
    ),
    Case(
        lambda: dp.inverse(OP, rtol=np.nan),
        ValueError,
        match="rtol must be finite, got nan",
    ),
    Case(
        lambda: dp.inverse(OP, maxiter=0),
        ValueError,
        match="maxiter must be a whole number >= 1, got 0; None leaves it to the method",
    ),
    Case(
        lambda: dp.inverse(OP, maxiter=2.5),
        ValueError,
        match="maxiter must be a whole number >= 1, got 2.5; None leaves it to the method",
    ),
    Case(
        lambda: dp.inverse(OP, maxiter="a"),
        ValueError,
        match="maxiter must be a whole number >= 1, got 'a'; None leaves it to the method",
    ),
    Case(
        lambda: dp.inverse(OP, nullspace="drop"),
        ValueError,
        match="nullspace must be one of raise, project, got 'drop'",
    ),
    Case(
        lambda: dp.inverse(OP, "direct", x=1),
        TypeError,
        match="method direct takes the options rtol, maxiter, nullspace, precision, got 'x'",
    ),
    Case(
        lambda: dp.inverse(OP, "multigrid", cycle="F"),
        ValueError,
        match="cycle must be one of V, W, got 'F'; the F cycle has no transpose of its own kind",
    ),
    Case(
        lambda: dp.inverse(OP, "multigrid", strength=1.0),
        ValueError,
        match="strength must be from 0 to below 1, got 1; the default is 0.25",
    ),
    Case(
        lambda: dp.inverse(OP, "multigrid", sweeps=(("up",), ())),
        ValueError,
        match="sweeps must be two tuples of 'forward' and 'backward', got (('up',), ()); "
        "write for example (('forward',), ('backward',))",
    ),
    Case(
        lambda: dp.inverse(OP, "multigrid", sweeps=3),
        ValueError,
        match="sweeps must be two tuples of 'forward' and 'backward', got 3; "
        "write for example (('forward',), ('backward',))",
    ),
    Case(
        lambda: dp.inverse(OP, "multigrid", levels=0),
        ValueError,
        match="levels must be a whole number >= 1, got 0; the default is 25",
    ),
    Case(
        lambda: dp.inverse(OP, "multigrid", levels=2.5),
        ValueError,
        match="levels must be a whole number >= 1, got 2.5; the default is 25",
    ),
    Case(
        lambda: dp.inverse(OP, "krylov", diff="both"),
        ValueError,
        match="diff must be one of implicit, unrolled, got 'both'",
    ),
    Case(
        lambda: dp.inverse(OP, "krylov", iterations=0),
        ValueError,
        match="iterations must be a whole number >= 1, got 0; None leaves it to the tolerance",
    ),
    Case(
        lambda: dp.inverse(OP, "krylov", preconditioner="ilu"),
        ValueError,
        match="preconditioner must be None, 'jacobi' (for a diagonal of one sign), 'shifted_laplace' (for an "
        "operator with entries), an Operator or a function, got 'ilu'",
    ),
    Case(
        lambda: dp.inverse(WIND, "krylov", diff="unrolled"),
        ValueError,
        match="diff='unrolled' needs a symmetric operator and no preconditioner; write diff='implicit'",
    ),
]

D = dp.divergence(GRID)
G = dp.gradient(GRID, dp.dirichlet)
SOLVE = dp.elliptic_solver(D, G)
K = np.ones(17)
BAD = np.where(np.arange(17) > 14, np.nan, 1.0)

ELLIPTIC = [
    Case(
        lambda: SOLVE(K[1:], B),
        SHAPE,
        match="k takes a number or a field on faces(3, 2) of shape (17,), got an array of shape (16,); "
        "a batch of 16 numbers has the shape (16, 1)",
    ),
    Case(
        lambda: SOLVE(B, B),
        SHAPE,
        match="k takes a number or a field on faces(3, 2) of shape (17,), got an array of "
        "shape (3, 2); write harmonic_average(grid)(k)",
    ),
    Case(
        lambda: SOLVE(np.full(17, "1"), B),
        TypeError,
        match="k must hold numbers, got dtype <U1; write np.asarray(k, float)",
    ),
    Case(
        lambda: SOLVE(K, B, "1"),
        TypeError,
        match="shift must hold numbers, got dtype <U1; write np.asarray(shift, float)",
    ),
    Case(
        lambda: SOLVE(BAD, B),
        FINITE,
        match="k must be finite, got 2 that are NaN or infinite, the first at 15",
    ),
    Case(lambda: SOLVE(-2.0 * K, B), ValueError, match="k must be >= 0, got -2 at 0"),
    Case(lambda: value_and_grad(lambda k: anp.sum(SOLVE(k, B)))(-K), ValueError, match="k must be >= 0, got -1 at 0"),
    Case(
        lambda: SOLVE(K, B, K),
        SHAPE,
        match="shift takes a number or a field on cells(3, 2), got an array of shape (17,); "
        "a batch of 17 numbers has the shape (17, 1, 1)",
    ),
    Case(
        lambda: SOLVE(K, B, np.ones((4, 2))),
        SHAPE,
        match="shift takes a number or a field on cells(3, 2), got an array of shape (4, 2)",
    ),
    Case(
        lambda: SOLVE(K, B, np.where(B > 0, np.nan, 1j)),
        FINITE,
        match="shift must be finite, got 6 that are NaN or infinite, the first at (0, 0)",
    ),
    Case(
        lambda: SOLVE(np.full(17, complex(1, np.inf)), B),
        FINITE,
        match="k must be finite, got 17 that are NaN or infinite, the first at 0",
    ),
    Case(lambda: SOLVE(K, B, np.nan), FINITE, match="shift must be finite, got nan; write a finite number"),
    Case(
        lambda: SOLVE(K, B.T), SHAPE, match="elliptic_solver takes a field on cells(3, 2), got an array of shape (2, 3)"
    ),
    Case(
        lambda: dp.elliptic_solver(np.eye(3), G),
        TypeError,
        match="elliptic_solver, as D, takes an Operator, got ndarray; write dp.from_matrix(...) first",
    ),
    Case(
        lambda: dp.elliptic_solver(D, D),
        SHAPE,
        match="elliptic_solver needs D @ G to be square: divergence maps faces(3, 2) to cells(3, 2), "
        "divergence faces(3, 2) to cells(3, 2)",
    ),
    Case(
        lambda: dp.elliptic_solver(D, G, rtol=2.0),
        ValueError,
        match="rtol must be between 0 and 1, got 2; the default is 1e-10",
    ),
]


@pytest.mark.parametrize("case", CONTRACT + SET_UP + SETTINGS + ELLIPTIC, ids=lambda case: case.match[:40])
def test_message(case):
    with pytest.raises(case.error, match=f"^{re.escape(case.match)}$"):
        case.make()


def test_names_of_methods_are_listed():
    with pytest.raises(ValueError, match=r"^method must be one of auto, separable, .*, got 'magic'$"):
        dp.inverse(OP, "magic")
    with pytest.raises(TypeError, match=r"^method multigrid takes the options rtol, .*, got 'cycles'; write 'cycle'$"):
        dp.inverse(OP, "multigrid", cycles="V")


def test_factors_that_do_not_fit_into_memory(monkeypatch):
    def full(*args, **options):
        raise MemoryError

    monkeypatch.setattr(direct, "splu", full)
    with pytest.raises(FAILED, match=r"sparse LU of <.*> does not fit into memory; write method='multigrid'") as caught:
        dp.inverse(-dp.laplacian(BOX, dp.dirichlet), "direct")
    with pytest.raises(FAILED, match=r"write method='krylov', preconditioner='shifted_laplace'"):
        dp.inverse(1j * dp.laplacian(BOX, dp.dirichlet), "direct")
    assert caught.value.info.status == "setup_failed"


def test_an_engine_says_what_it_does_not_define():
    engine = EmptySystem()
    with pytest.raises(TypeError, match="EmptySystem defines no solve"):
        engine.solve(np.zeros(0), 0.0, False)
    with pytest.raises(TypeError, match="EmptySystem defines no unroll"):
        engine.unroll(np.zeros(0), 0.0, False)
