"""Errors of minimize()."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError, UnstableStepError


def bowl(x):
    return anp.sum((x - 3.0) ** 2)


def foreign(value, gradient):
    """Run minimize with a loss and a gradient that are not traced."""
    return dp.minimize(lambda x: value(x), np.ones(2), gradient=gradient)


def test_errors_at_the_start_are_not_hidden():
    def refuse(x):
        raise UnstableStepError("beyond 0.5")

    with pytest.raises(UnstableStepError, match="beyond 0.5"):
        dp.minimize(refuse, np.ones(2))
    with pytest.raises(KeyError):
        dp.minimize(lambda x: {}["no such"], np.ones(2))
    with pytest.raises(NonFiniteError, match="the loss is nan; start where it is finite"):
        foreign(lambda x: np.nan, lambda x: x)
    hint = r"\(dp.check.gradient\(loss, x\) shows where it comes from\)"
    with pytest.raises(
        NonFiniteError,
        match=rf"^the gradient of start must be finite {hint}, got 2 that are NaN or infinite, the first at 0$",
    ):
        foreign(lambda x: 1.0, lambda x: x * np.nan)
    with (
        np.errstate(divide="ignore"),
        pytest.raises(
            NonFiniteError,
            match="^the derivative of sqrt is NaN or infinite where its argument is 0; keep it away from there$",
        ),
    ):
        dp.minimize(lambda x: anp.sum(anp.sqrt(x)), np.array([4.0, 0.0]))
    where = r"^the gradient of start\['b'\] must be finite .*, the first at \(0, 1\)$"
    with pytest.raises(NonFiniteError, match=where):
        start = {"a": 1.0, "b": np.ones((2, 2))}
        dp.minimize(lambda x: 1.0, start, gradient=lambda x: {"a": 1.0, "b": np.array([[1, np.nan], [1, 1]])})


@pytest.mark.parametrize("method", ["gauss_newton", "levenberg_marquardt", "newton_cg"])
def test_a_wrong_derivative_is_no_convergence(method):
    """With a wrong sign no point is lower along the step; that is not rounding."""
    wrong = dp.differentiable("wrong", lambda x: x**2, lambda nums, y, x: lambda g: (-2 * x * g,))
    loss = (lambda x: anp.sum(wrong(x))) if method == "newton_cg" else (lambda x: wrong(x) + 1.0)
    best = dp.minimize(loss, np.ones(2), method)
    assert not best.converged and np.array_equal(best.x, np.ones(2))
    assert best.message.endswith("dp.check.gradient(loss, x) tells whether the gradient is right")


def test_methods_and_options():
    with pytest.raises(
        ValueError, match="method must be one of lbfgs, gd, adam, newton_cg, .*, admm, .*, ipopt, got 'newton'"
    ):
        dp.minimize(bowl, np.ones(2), "newton")
    with pytest.raises(TypeError, match="lbfgs has no option 'rate'; it has memory, line_search"):
        dp.minimize(bowl, np.ones(2), rate=1.0)
    with pytest.raises(ValueError, match="maxiter of minimize must be a whole number >= 0, got -1; the default is 100"):
        dp.minimize(bowl, np.ones(2), maxiter=-1)
    with pytest.raises(
        ValueError, match="maxiter of minimize must be a whole number >= 0, got True; the default is 100"
    ):
        dp.minimize(bowl, np.ones(2), maxiter=True)
    with pytest.raises(
        ValueError, match="maxiter of minimize must be a whole number >= 0, got None; the default is 100"
    ):
        dp.minimize(bowl, np.ones(2), maxiter=None)
    with pytest.raises(ValueError, match="tolerance of minimize must be finite, got nan$"):
        dp.minimize(bowl, np.ones(2), tolerance=np.nan)
    with pytest.raises(ValueError, match="tolerance of minimize must be >= 0, got -1; the default is 1e-8"):
        dp.minimize(bowl, np.ones(2), tolerance=-1)
    with pytest.raises(TypeError, match="tolerance of minimize must be one real number, got 'a'$"):
        dp.minimize(bowl, np.ones(2), tolerance="a")


def test_a_tolerance_of_infinity_takes_any_gradient():
    best = dp.minimize(bowl, np.ones(2), tolerance=np.inf)
    assert best.converged and len(best.history) == 1 and np.array_equal(best.x, np.ones(2))
    assert dp.minimize(bowl, np.ones(2), "gd", rate=0.1, tolerance=np.float32(np.inf)).converged


def test_ranges_of_options():
    with pytest.raises(ValueError, match="memory of lbfgs must be a whole number >= 1, got 0; the default is 10"):
        dp.minimize(bowl, np.ones(2), memory=0)
    with pytest.raises(ValueError, match="line_search of lbfgs must be a whole number >= 2, got 1; the default is 20"):
        dp.minimize(bowl, np.ones(2), line_search=1)
    with pytest.raises(ValueError, match="rate of gd must be > 0, got -1; leave it out and it is searched for"):
        dp.minimize(bowl, np.ones(2), "gd", rate=-1)
    with pytest.raises(ValueError, match="momentum of gd must be from 0 to below 1, got 1; leave it out for none"):
        dp.minimize(bowl, np.ones(2), "gd", momentum=1)
    with pytest.raises(ValueError, match="line_search of gd must be backtracking, got 'wolfe'; leave it out for none"):
        dp.minimize(bowl, np.ones(2), "gd", line_search="wolfe")
    with pytest.raises(ValueError, match="rate of adam must be > 0, got 0; the default is 1e-3"):
        dp.minimize(bowl, np.ones(2), "adam", rate=0)
    with pytest.raises(TypeError, match="rate of adam must be one real number, got None$"):
        dp.minimize(bowl, np.ones(2), "adam", rate=None)
    with pytest.raises(ValueError, match="max_norm of adam must be > 0, got 0; leave it out for no clipping"):
        dp.minimize(bowl, np.ones(2), "adam", max_norm=0)
    with pytest.raises(ValueError, match=r"rate\(2\) of adam must be >= 0, got -1; return the rate for the step"):
        dp.minimize(bowl, np.ones(2), "adam", rate=lambda step: 1.0 - step)
    with pytest.raises(TypeError, match=r"rate\(0\) of adam must be one real number, got None$"):
        dp.minimize(bowl, np.ones(2), "adam", rate=lambda step: None)
    with pytest.raises(ValueError, match="epsilon of adam must be > 0, got 0; the default is 1e-8"):
        dp.minimize(bowl, np.ones(2), "adam", epsilon=0)
    with pytest.raises(
        ValueError, match=r"adam needs two betas from 0 to below 1, got \(1, 2\); the default is \(0.9, 0.999\)"
    ):
        dp.minimize(bowl, np.ones(2), "adam", betas=(1, 2))


def test_losses_and_gradients():
    with pytest.raises(
        DerivativeError, match=r"floating values are needed, and start holds none; write np.asarray\(start, float\)"
    ):
        dp.minimize(bowl, np.arange(3))
    with pytest.raises(ShapeError, match=r"the loss must be a scalar, got an array of shape \(2,\); sum it"):
        foreign(lambda x: x, lambda x: x)
    with pytest.raises(
        DerivativeError,
        match="gradient: expected one array or number, got a tuple of length 2",
    ):
        foreign(lambda x: 1.0, lambda x: (x, x))
    with pytest.raises(
        DerivativeError,
        match=r"gradient: expected shape \(2,\), got \(1,\); return a tree like start",
    ):
        foreign(lambda x: 1.0, lambda x: x[:1])


def test_the_result_is_frozen_and_shares_nothing():
    x = np.ones(3)
    x.flags.writeable = False
    best = dp.minimize(bowl, x)
    assert not np.may_share_memory(best.x, x) and best.x.flags.writeable
    with pytest.raises(AttributeError, match="Minimum is frozen; make a new one instead of setting x"):
        best.x = 1


def test_admm_without_a_weight():
    with pytest.raises(TypeError, match="admm needs the weight of the sum of absolute values; write weight=0.1"):
        dp.minimize(lambda x: anp.sum(x**2), np.ones(2), "admm")
