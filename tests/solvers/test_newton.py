"""Newton's method behind implicit: its verdict, scales, dtypes, products only, and every way to fail."""

from functools import partial

import autograd.numpy as anp
import numpy as np
import pytest
from residuals import PROBLEMS, directions, dot

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.solvers.records import STATUS_WORDS
from sparsedp.solvers.roots import implicit


def square(x, p):
    return x**2 - p


# ---- scales ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["auto", "krylov"])
def test_scaling_the_residual_by_a_power_of_two_keeps_all_bits(method):
    op = dp.laplacian(dp.Grid(40, size=1.0), dp.dirichlet)
    root = implicit(lambda u, f, scale: scale * (5 * anp.sin(u) - op(u) - f), method=method)
    f = np.cos(np.arange(40.0))

    def solved(scale):
        x, pull = pullback(lambda f: root(np.zeros(40), f, scale), f)
        return x, pull(np.ones(40)), root.info.forward.iterations

    x, slope, steps = solved(1.0)
    for power in (-900, -300, -1, 7, 300, 900):
        found = solved(2.0**power)
        np.testing.assert_array_equal(found[0], x)
        np.testing.assert_array_equal(found[1], slope)
        assert found[2] == steps


def test_cotangents_of_any_size_have_the_same_bits():
    problem = PROBLEMS["diffusion 1-D"]()
    x, pull = pullback(
        lambda f: implicit(problem.residual)(problem.guess, problem.params | {"f": f}), problem.params["f"]
    )
    wanted = pull(np.ones(x.shape))
    for power in (-960, -1, 960):
        np.testing.assert_array_equal(np.ldexp(pull(np.ldexp(np.ones(x.shape), power)), -power), wanted)


@pytest.mark.parametrize("size", [1e-30, 1e-9, 1.0, 1e12])
def test_the_tolerance_is_relative(size):
    """x^3 + size^2 x = p, whose root scales with size."""
    root = implicit(lambda x, p: x**3 + size**2 * x - p)
    assert root(0.1 * size, 2 * size**3) / size == pytest.approx(1.0, rel=1e-9)
    assert root.info.forward.residual <= 1e-10


def test_roots_at_zero_and_rounding_of_terms_that_cancel():
    assert implicit(lambda x, p: x**3 + x - p)(1.0, 0.0) == 0.0
    op = dp.laplacian(dp.Grid(9, size=1.0), dp.dirichlet)
    linear = implicit(lambda u: op(u))
    np.testing.assert_array_equal(linear(np.ones(9)), 0.0)
    turned = implicit(lambda x, p: anp.cos(x + p))
    assert abs(turned(0.1, np.pi / 2)) < 1e-15 and turned.info.forward.status == "converged_at_roundoff"
    assert implicit(lambda x, p: anp.exp(x) - 1 - p)(1.0, 1e-7) == pytest.approx(1e-7, rel=1e-8)


def test_a_kink_without_a_root_is_not_taken_for_rounding():
    root = implicit(lambda x, p: anp.abs(x - 1.0) + p)
    with pytest.raises(ConvergenceError) as caught:
        root(1e6, 1e-8)
    assert caught.value.info.status in ("stagnated", "max_iterations")


# ---- products only -----------------------------------------------------------------------------------------------


@pytest.mark.whole
@pytest.mark.parametrize("name", ["diffusion 2-D", "advection 1-D", "fields in one array"])
def test_krylov_gives_the_same_derivatives(name):
    problem = PROBLEMS[name]()
    free = implicit(problem.residual, method="krylov")
    assembled = implicit(problem.residual)
    p = problem.params
    d = directions(problem.params)
    slope = lambda p, root: value_and_grad(problem.loss(root))(p)[1]
    slopes = [slope(p, root) for root in (free, assembled)]
    hessian = [pushforward(partial(slope, root=root), p, d)[1] for root in (free, assembled)]
    for found, wanted in (slopes, hessian):
        assert abs(dot(found, d) / dot(wanted, d) - 1) <= 1e-7
    assert "products only, as asked" in str(free) and free.info.adjoint.residual <= 1e-10


def bare(x):
    """x^2 + sin x with a VJP and no JVP."""
    return BARE(x)


BARE = dp.differentiable("bare", lambda x: x**2 + np.sin(x), lambda nums, ans, x: lambda g: (g * (2 * x + anp.cos(x)),))


def test_a_residual_without_jvp_is_assembled_by_rows():
    op = dp.laplacian(dp.Grid(30, size=1.0), dp.dirichlet)
    residual = lambda smooth: lambda u, p: p[0] * smooth(u) - op(u) - p[1]
    with_jvp = implicit(residual(lambda x: x**2 + anp.sin(x)))
    without = implicit(residual(bare))
    p = (0.7, np.ones(30))
    d = (0.3, np.cos(np.arange(30.0)))

    def derivatives(root):
        slope = lambda p: value_and_grad(lambda p: anp.sum(root(np.zeros(30), p) ** 2))(p)[1]
        along = pushforward(lambda p: anp.sum(root(np.zeros(30), p) ** 2), p, d)[1]
        return dot(slope(p), d), along, dot(value_and_grad(lambda p: dot(slope(p), d))(p)[1], d)

    with recording() as calls:
        found = derivatives(without)
    np.testing.assert_allclose(found, derivatives(with_jvp), rtol=1e-11)
    assert calls[f"{without.name}.jacobian", "vjp"] > 0 == calls[f"{without.name}.jacobian", "jvp"]


# ---- guesses and dtypes ------------------------------------------------------------------------------------------


def test_the_root_has_the_structure_and_dtypes_of_the_guess():
    p = np.array([4.0, 9.0])
    assert isinstance(implicit(square)(1.0, 9.0), float) and isinstance(implicit(square)(1, 9.0), float)
    for guess in (np.ones(2, np.float32), np.ones(2, int), np.ones(2, bool), np.ones(4)[::2]):
        kept = guess.copy()
        x = implicit(square)(guess, p)
        np.testing.assert_array_equal(x, np.array([2.0, 3.0], x.dtype))
        np.testing.assert_array_equal(guess, kept)
        assert x.dtype == (np.float32 if guess.dtype == np.float32 else np.float64)
    slope = value_and_grad(lambda p: anp.sum(implicit(square)(np.ones(2, np.float32), p)))(p.astype(np.float32))[1]
    assert slope.dtype == np.float32
    np.testing.assert_allclose(slope, [0.25, 1 / 6], rtol=1e-6)
    assert implicit(square)(np.zeros(0), np.zeros(0)).shape == (0,)


def test_a_result_that_is_overwritten_does_not_change_the_derivative():
    x, pull = pullback(lambda p: implicit(square)(np.ones(2), p), np.array([4.0, 9.0]))
    x[:] = 100.0
    np.testing.assert_allclose(pull(np.ones(2)), [0.25, 1 / 6], rtol=1e-12)


def test_a_trial_point_where_the_residual_raises_is_rejected():
    for refuse in (UnstableStepError, NonFiniteError, ConvergenceError):

        def residual(x, p, refuse=refuse):
            if np.any(np.asarray(getattr(x, "_value", x)) < -1):
                raise refuse("too far")
            return anp.arctan(x) - p

        assert implicit(residual)(3.0, 0.1) == pytest.approx(np.tan(0.1), rel=1e-9)
    assert implicit(lambda x, p: anp.log(x) - p)(50.0, 1.0) == pytest.approx(np.e, rel=1e-9)


# ---- failures ----------------------------------------------------------------------------------------------------


REFUSED = [
    (square, np.array([1.0, np.nan]), 1.0, NonFiniteError, r"the guess of implicit\(square\) must be .*the first at 1"),
    (square, 1.0, np.inf, NonFiniteError, r"parameter 1 of implicit\(square\) must be finite"),
    (lambda x, p: anp.log(x) - p, -1.0, 1.0, NonFiniteError, "the residual of .* at the guess must be finite"),
    (square, 1j, 1.0, TypeError, r"implicit\(square\) solves for real unknowns; give real and imaginary part"),
    (square, "one", 1.0, TypeError, r"implicit\(square\) takes a guess of numbers, got str"),
    (lambda x, p: x * 1j - p, 1.0, 1.0, TypeError, "the residual of .* must be real"),
    (lambda x, p: x[1:] - p, np.ones(3), 1.0, ShapeError, "the residual of .* must hold 3 numbers, .* got 2"),
    (square, 1.0, -1.0, ConvergenceError, r"after 50 Newton steps: .* \(stagnated\); its Jacobian is singular"),
    (square, 1.0, 0.0, ConvergenceError, r"after 50 Newton steps: relative residual 3.3e-01, wanted 1e-10 \(max_"),
]


@pytest.mark.parametrize(("residual", "guess", "p", "error", "message"), REFUSED)
def test_invalid_problems_raise(residual, guess, p, error, message):
    root = implicit(residual)
    with pytest.raises(error, match=message) as caught:
        root(guess, p)
    if error in (NonFiniteError, ConvergenceError):
        assert root.info.forward.status in STATUS_WORDS
    if error is ConvergenceError:
        assert caught.value.info.status == root.info.forward.status and np.isfinite(caught.value.best)


@pytest.mark.parametrize(
    ("name", "value"), [("method", "magic"), ("rtol", 0.0), ("maxiter", 0), ("maxiter", None), ("nullspace", "x")]
)
def test_invalid_settings_raise(name, value):
    with pytest.raises(ValueError, match=f"^{name} must be"):
        implicit(square, **{name: value})


def test_the_error_of_a_failed_solve_holds_its_best_iterate():
    problem = PROBLEMS["diffusion 1-D"]()
    root = implicit(problem.residual, maxiter=2)
    with pytest.raises(ConvergenceError) as caught:
        root(problem.guess, problem.params)
    error = caught.value
    start = problem.residual(problem.guess, problem.params)
    assert error.info.iterations == root.info.forward.iterations == 2 and error.info.status == "max_iterations"
    assert np.linalg.norm(problem.residual(error.best, problem.params)) < 0.2 * np.linalg.norm(start)


def test_a_traced_value_that_is_not_a_parameter_raises():
    with pytest.raises(DerivativeError, match="uses a traced value that is not an argument; make it a parameter"):
        value_and_grad(lambda q: implicit(lambda x, p: x - p * q)(1.0, 2.0))(3.0)


def test_a_root_that_is_not_isolated_has_a_derivative_only_with_project():
    op = dp.laplacian(dp.Grid(10, size=1.0))
    f = np.cos(np.pi * (np.arange(10) + 0.5) / 10)
    loss = lambda root: lambda f: anp.sum(root(np.zeros(10), f) ** 2)
    refused, projected = (implicit(lambda u, f: op(u) - f, nullspace=word) for word in ("raise", "project"))
    assert loss(refused)(f) == pytest.approx(loss(projected)(f))
    with pytest.raises(ConvergenceError, match="is singular at the solution: the root is not isolated"):
        value_and_grad(loss(refused))(f)
    inv = dp.inverse(op, nullspace="project")
    wanted = value_and_grad(lambda f: anp.sum(inv(f) ** 2))(f)[1]
    np.testing.assert_allclose(value_and_grad(loss(projected))(f)[1], wanted, atol=1e-14)


def test_a_jacobian_of_the_wrong_kind_raises():
    for jacobian, error, message in (
        (
            lambda x, p: np.eye(3),
            ShapeError,
            r"the jacobian of implicit\(square\) must have shape \(2, 2\), got \(3, 3\)",
        ),
        (
            lambda x, p: 1j * np.eye(2),
            TypeError,
            r"the jacobian of implicit\(square\) must hold real numbers, got dtype complex128",
        ),
    ):
        with pytest.raises(error, match=message):
            implicit(square, jacobian)(np.ones(2), np.ones(2) * 4)
    with pytest.raises(ShapeError, match=r"the sparsity of implicit\(square\) must have shape \(2, 2\), got \(3, 3\)"):
        implicit(square, sparsity=np.eye(3))(np.ones(2), np.ones(2) * 4)
