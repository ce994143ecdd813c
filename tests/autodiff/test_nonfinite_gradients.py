"""Derivatives that are NaN or infinite: a warning that names the call, which can be turned into an error."""

import warnings

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

ROOT_AT_ZERO = "the derivative of sqrt is NaN or infinite where its argument is 0; keep it away from there"
NORM_AT_ZERO = "the derivative of norm is NaN or infinite where its argument is 0; keep it away from there"
X = np.array([0.0, 1.0])

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


def chosen_root(u):
    return anp.sum(anp.where(u > 0, anp.sqrt(anp.abs(u)), 0.0))


def power(u):
    return anp.sum(u**1.5)


DERIVATIVES = {
    "value_and_grad": lambda: dp.value_and_grad(chosen_root)(X),
    "grad": lambda: dp.grad(chosen_root)(X),
    "vjp": lambda: dp.vjp(anp.sqrt, X)[1](np.ones(2)),
    "jvp": lambda: dp.jvp(anp.sqrt, X, np.ones(2)),
    "in a tree": lambda: dp.grad(lambda p: chosen_root(p["u"]))({"u": X, "n": 3}),
    "argnum": lambda: dp.grad(lambda n, u: n * chosen_root(u), 1)(2.0, X),
}


@pytest.mark.parametrize("name", DERIVATIVES)
def test_the_call_is_named(name):
    with pytest.warns(dp.errors.NonFiniteGradientWarning, match=ROOT_AT_ZERO) as seen:
        DERIVATIVES[name]()
    assert len([one for one in seen if one.category is dp.errors.NonFiniteGradientWarning]) == 1
    assert seen[-1].filename == __file__


@pytest.mark.parametrize("name", DERIVATIVES)
def test_it_can_be_an_error(name):
    with warnings.catch_warnings():
        warnings.filterwarnings("error", category=dp.errors.NonFiniteGradientWarning)
        with pytest.raises(dp.errors.NonFiniteGradientWarning, match="the derivative of sqrt"):
            DERIVATIVES[name]()


def test_the_norm_at_zero():
    with pytest.warns(dp.errors.NonFiniteGradientWarning, match=NORM_AT_ZERO):
        value, gradient = dp.value_and_grad(anp.linalg.norm)(np.zeros(3))
    assert value == 0.0 and np.all(np.isnan(gradient))


def test_a_second_derivative():
    """The gradient of u^1.5 is finite at 0, its Hessian is not."""
    with pytest.warns(
        dp.errors.NonFiniteGradientWarning,
        match="the derivative returned by hvp holds NaN or infinity: the derivative of ",
    ):
        dp.hvp(power, X, np.ones(2))


def test_a_function_that_cannot_run_twice_is_not_named():
    runs = iter([chosen_root])
    reason = "the derivative returned by value_and_grad holds NaN or infinity: dp.check.gradient"
    with pytest.warns(dp.errors.NonFiniteGradientWarning, match=reason):
        dp.grad(lambda u: next(runs)(u))(X)


@pytest.mark.filterwarnings("error::sparsedp.errors.NonFiniteGradientWarning")
def test_who_refuses_does_not_warn():
    """Finite derivatives, and derivatives for an input that is not finite, give no warning either."""
    assert np.allclose(dp.grad(chosen_root)(X + 1.0), 0.5 / np.sqrt(X + 1.0), rtol=1e-15)
    assert np.isnan(dp.vjp(anp.sin, X)[1](np.array([np.nan, 1.0]))[0])
    with pytest.raises(dp.errors.NonFiniteError, match=ROOT_AT_ZERO):
        dp.minimize(chosen_root, X)
    assert dp.check.gradient(chosen_root, X).verdict == "disagrees"
    assert dp.stress(chosen_root, X, only=["as given"]).counts["FAILED"]
    assert dp.explain(chosen_root, X).value == dp.certify(chosen_root, X).value == 1.0


def test_an_adjoint_solve_that_refuses_a_cotangent_names_the_call_at_fault():
    """The solution is 0, where the square root has no derivative; the right-hand side of the user is finite."""
    grid = dp.Grid(4)
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet))
    with pytest.raises(dp.errors.NonFiniteError, match="inverse.*, in the backward pass: " + ROOT_AT_ZERO):
        dp.grad(lambda b: anp.sum(anp.sqrt(solve(b))))(np.zeros(4))
