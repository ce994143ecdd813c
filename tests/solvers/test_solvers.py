"""The solve contract, which every method meets."""

import re

import numpy as np
import pytest

import sparsedp as dp
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.inverse import Inverse, Solution
from sparsedp.solvers.records import SolveLog
from sparsedp.solvers.solve import Solver
from sparsedp.solvers.system import System

ITERATIVE = ("multigrid", "krylov")
METHODS = ("direct", "separable", *ITERATIVE)
EVERY = pytest.mark.parametrize("method", METHODS)
GENERAL = pytest.mark.parametrize("method", ("direct", *ITERATIVE))  # no need for a sum of 1-D factors


def stretched(*shape):
    return dp.Grid(shape, spacing=[1.0 + 0.5 * np.sin(np.arange(n)) for n in shape])


def wind(grid):
    """Advection and diffusion: not symmetric."""
    return 3.0 * dp.upwind(grid, "x", 1, dp.dirichlet) - dp.laplacian(grid, dp.dirichlet)


def takes(problem, method):
    """Transforms need factors that are symmetric up to scaling: winds over stretched or periodic axes are not."""
    if method == "separable" and problem in ("wind, stretched", "wind, periodic"):
        with pytest.raises(ValueError, match="separable needs a sum of 1-D factors that can be diagonalised"):
            dp.inverse(ALL[problem](), method)
        pytest.skip("refused, as it must be")


PROBLEMS = {
    "dirichlet": lambda: -dp.divergence(g := dp.Grid((26, 22), size=1.0)) @ dp.gradient(g, dp.dirichlet),
    "negative": lambda: dp.laplacian(dp.Grid((9, 10, 8), size=1.0), dp.dirichlet),
    "shifted": lambda: dp.identity((g := dp.Grid((24, 21), periodic=True)).cells) - dp.laplacian(g),
    "robin, stretched": lambda: dp.laplacian(stretched(22, 24), dp.robin(1, 2)),
    "line": lambda: -dp.laplacian(dp.Grid(401, size=1.0), {"x": (dp.dirichlet, dp.neumann)}),
    "wind": lambda: wind(dp.Grid((24, 25), size=2.0)),
    "wind, stretched": lambda: wind(stretched(24, 23)),
}
SINGULAR = {
    "neumann": lambda: -dp.laplacian(dp.Grid((23, 22), size=1.0)),
    "periodic": lambda: dp.laplacian(dp.Grid((9, 8, 7), periodic=True)),
    "stretched neumann": lambda: -dp.laplacian(stretched(21, 26)),
    "wind, periodic": lambda: dp.upwind(g := dp.Grid((26, 19), periodic=True)) - dp.laplacian(g),
}
ALL = {**PROBLEMS, **SINGULAR}


@EVERY
@pytest.mark.parametrize("problem", PROBLEMS)
def test_solution_and_adjoint_against_dense_algebra(problem, method, rng):
    takes(problem, method)
    op = PROBLEMS[problem]()
    inv = dp.inverse(op, method)
    matrix = op.matrix.toarray()
    b, g = rng.standard_normal((2, *op.domain.shape))
    assert inv(b) == pytest.approx(np.linalg.solve(matrix, b.ravel()).reshape(b.shape), rel=1e-7, abs=1e-9)
    assert inv.T(g) == pytest.approx(np.linalg.solve(matrix.T, g.ravel()).reshape(b.shape), rel=1e-7, abs=1e-9)


@EVERY
@pytest.mark.parametrize("problem", ALL)
def test_the_adjoint_is_the_transpose(problem, method, rng):
    """Singular operators too: inv = P A+ P, so that inv.T = P^T A+^T P^T."""
    takes(problem, method)
    op = ALL[problem]()
    inv = dp.inverse(op, method, nullspace="project")
    b, g = rng.standard_normal((2, *op.domain.shape)) + 1.0
    x = inv(b)
    y = inv.T(g)
    assert abs(np.sum(x * g) - np.sum(b * y)) <= 1e-9 * np.linalg.norm(x) * np.linalg.norm(g)
    assert inv.info.forward.status.startswith("converged") and inv.info.adjoint.status.startswith("converged")


@pytest.mark.sampled
@EVERY
@pytest.mark.parametrize("problem", ["robin, stretched", "wind", "stretched neumann"])
@pytest.mark.parametrize("exponent", [-963, -900, 17, 900, 963])
def test_bits_do_not_depend_on_the_scale_of_the_data(problem, method, exponent, rng):
    op = ALL[problem]()
    inv = dp.inverse(op, method, nullspace="project")
    b = rng.standard_normal(op.domain.shape)
    for solve in (inv, inv.T):
        assert np.array_equal(solve(np.ldexp(b, exponent)), np.ldexp(solve(b), exponent))


@EVERY
@pytest.mark.parametrize("exponent", [-960, -300, 300, 960])
def test_bits_do_not_depend_on_the_scale_of_the_operator(method, exponent, rng):
    op = PROBLEMS["dirichlet"]()
    b = rng.standard_normal(op.domain.shape)
    scaled = dp.inverse(op * 2.0**exponent, method)
    for solve, other in ((scaled, dp.inverse(op, method)), (scaled.T, dp.inverse(op, method).T)):
        assert np.array_equal(np.ldexp(solve(b), exponent), other(b))


def test_solutions_beyond_the_range_of_floats_are_refused():
    inv = dp.inverse(1e-10 * dp.identity(dp.Grid(3).cells))
    with pytest.raises(
        dp.errors.NonFiniteError, match=r"the solution of .* is beyond 1.8e308; scale the right-hand side down"
    ):
        inv(np.full(3, 1e300))
    assert inv.info.forward.status == "not_representable"
    assert inv(np.full(3, 1e-310)) == pytest.approx(np.full(3, 1e-300))  # a subnormal keeps the digits it has
    for dtype in (np.float32, np.complex64):
        with pytest.raises(
            dp.errors.NonFiniteError, match=r"the solution of .* is beyond float32; give it double precision"
        ):
            inv(np.full(3, 1e30, dtype))


# ---------------------------------------------------------------- judged by the true residual


class Scripted(Engine):
    """An engine that reports success, with an error that the test sets."""

    method = "scripted"

    def __init__(self, op, error, word="", refines=True):
        self.inverse = np.linalg.inv(op.matrix.toarray())
        self.error = error
        self.word = word
        self.calls = 0
        self.refines = refines

    def solve(self, b, goal, transposed):
        self.calls += 1
        exact = (self.inverse.T if transposed else self.inverse) @ b
        return exact * (1 + self.error), 3, self.word


def scripted(error, word="", rtol=1e-10, **options):
    op = -dp.laplacian(dp.Grid(101, size=1.0), dp.dirichlet)
    engine = Scripted(op, error, word, **options)
    return Inverse(Solution(Solver(System(op, rtol), engine, "raise", SolveLog(), "inverse", None))), engine


def test_an_inexact_method_is_refined():
    inv, engine = scripted(1e-3)
    x = inv(np.ones(101))
    assert engine.calls == 4 and inv.info.forward.iterations == 12  # 1e-3, 1e-6, 1e-9, 1e-12
    assert inv.info.forward.residual <= 1e-10
    assert np.linalg.norm(1.0 - inv.solver.system.unscaled(x)) <= 1e-10 * np.sqrt(101)


@pytest.mark.parametrize("error, status", [(0.7, "stagnated"), (np.nan, "nonfinite_output")])
def test_an_engine_that_reports_success_is_tested_by_the_true_residual(error, status):
    inv, _ = scripted(error)
    for solve in (inv, inv.T):
        with pytest.raises(dp.errors.ConvergenceError, match=re.escape(f"wanted 1e-10 ({status})")) as caught:
            solve(np.ones(101))
        assert caught.value.info.status == status
        assert np.all(np.isfinite(caught.value.best)) and caught.value.best.shape == (101,)
    assert inv.info.forward.status == inv.info.adjoint.status == status


def test_the_status_of_a_failed_engine_is_reported():
    inv, _ = scripted(0.7, "indefinite_operator")
    with pytest.raises(dp.errors.ConvergenceError, match="indefinite_operator"):
        inv(np.ones(101))


def test_an_engine_that_does_not_refine_is_called_once():
    inv, engine = scripted(0.1, "max_iterations", refines=False)
    inv(np.ones(101))
    assert engine.calls == 1 and inv.info.forward.status == "max_iterations"
    assert inv.info.forward.residual == pytest.approx(0.1)


def test_the_tolerance_is_relative_and_roundoff_has_its_own_status():
    inv, _ = scripted(1e-3, rtol=1e-2)
    inv(1e-200 * np.ones(101))
    assert inv.info.forward.status == "converged" and inv.info.forward.residual == pytest.approx(1e-3)
    tight, _ = scripted(1e-9, rtol=1e-30)
    tight(np.ones(101))
    assert tight.info.forward.status == "converged_at_roundoff"
    assert 0 < tight.info.forward.backward_error <= 8 * np.finfo(float).eps


def test_a_zero_right_hand_side_needs_no_iteration():
    inv, engine = scripted(0.0)
    for solve in (inv, inv.T):
        assert np.array_equal(solve(np.zeros(101)), np.zeros(101))
    assert engine.calls == 0 and inv.info.forward.status == inv.info.adjoint.status == "exact_zero_rhs"


@pytest.mark.parametrize("method", ITERATIVE)
@pytest.mark.parametrize("transposed", [False, True])
def test_no_silent_failure(method, transposed):
    inv = dp.inverse(ALL["wind"](), method, maxiter=1)
    solve = inv.T if transposed else inv
    message = rf"{method} on <.*>: relative residual .* after 1 (cycles|iterations), wanted 1e-10 \(max_iterations\)"
    with pytest.raises(dp.errors.ConvergenceError, match=message) as caught:
        solve(np.ones((24, 25)))
    assert caught.value.info.iterations == 1 and caught.value.best.shape == (24, 25)
    record = inv.info.adjoint if transposed else inv.info.forward
    assert record.status == caught.value.info.status == "max_iterations"


def test_data_that_are_not_finite_are_refused():
    inv = dp.inverse(PROBLEMS["dirichlet"]())
    b = np.ones((26, 22))
    b[3, 4], b[7, 1] = np.nan, np.inf
    message = (
        "inverse(-divergence @ gradient) takes finite numbers, got 2 that are NaN or infinite, the first at (3, 4)"
    )
    with pytest.raises(dp.errors.NonFiniteError, match=re.escape(message)):
        inv(b)
    assert inv.info.forward.status == "nonfinite_input"
    with pytest.raises(dp.errors.NonFiniteError):
        inv.T(np.where(np.isnan(b), 1.0, b))
