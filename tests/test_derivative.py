"""The public derivatives: grad, value_and_grad, vjp, jvp, hvp, against formulas and differences."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError, ShapeError

RNG = np.random.default_rng(0)
GRID = dp.Grid((4, 5), size=1.0)
LAPLACIAN = dp.laplacian(GRID, dp.dirichlet)
U, T = RNG.standard_normal((2, *GRID.shape))


def energy(u, k=0.3):
    return anp.sum(anp.sin(k * LAPLACIAN(u)) * u**2)


def difference(fun, x, t, step=1e-6):
    return (fun(x + step * t) - fun(x - step * t)) / (2 * step)


def test_grad_and_the_number_of_the_argument():
    assert np.sum(dp.grad(energy)(U) * T) == pytest.approx(difference(energy, U, T), rel=1e-6)
    of_k = dp.grad(energy, argnum=1)(U, 0.3)
    assert isinstance(of_k, float)
    assert of_k == pytest.approx(difference(lambda k: energy(U, k), 0.3, 1.0), rel=1e-6)
    value, same = dp.value_and_grad(energy, 1)(U, 0.3)
    assert (value, same) == (energy(U), of_k)


def test_vjp_of_several_arguments_and_of_a_tree():
    g = RNG.standard_normal(GRID.shape)
    value, pull = dp.vjp(lambda u, k: k * LAPLACIAN(u), U, 0.7)
    of_u, of_k = pull(g)
    assert np.array_equal(value, 0.7 * LAPLACIAN(U))
    np.testing.assert_allclose(of_u, 0.7 * LAPLACIAN.T(g), rtol=1e-13)
    assert of_k == pytest.approx(np.sum(g * LAPLACIAN(U)), rel=1e-13)
    _, pull = dp.vjp(lambda x: x["a"] * x["n"], {"a": U, "n": 2})
    back = pull(g)
    assert np.array_equal(back["a"], 2 * g) and back["n"] is None


def test_jvp_of_trees_and_without_a_forward_derivative():
    value, slope = dp.jvp(lambda x: {"s": anp.sin(x[0]) * x[1], "n": 3}, (U, 2.0), (T, 0.5))
    assert np.array_equal(value["s"], np.sin(U) * 2.0) and slope["n"] is None
    np.testing.assert_allclose(slope["s"], np.cos(U) * T * 2.0 + np.sin(U) * 0.5, rtol=1e-13)
    backward_only = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * u**2 * g,))
    np.testing.assert_allclose(dp.jvp(backward_only, U, T)[1], 3 * U**2 * T, rtol=1e-12)


def test_hvp_is_the_difference_of_gradients_and_symmetric():
    other = RNG.standard_normal(GRID.shape)
    product = dp.hvp(energy, U, T)
    np.testing.assert_allclose(product, difference(dp.grad(energy), U, T), rtol=1e-5, atol=1e-5)
    assert np.sum(product * other) == pytest.approx(np.sum(dp.hvp(energy, U, other) * T), rel=1e-11)
    tree = dp.hvp(lambda x: x["a"] ** 3 * x["n"], {"a": 2.0, "n": 5}, {"a": 1.0, "n": None})
    assert tree == {"a": 60.0, "n": None}


def test_derivatives_of_derivatives():
    once = lambda u: anp.sum(dp.grad(energy)(u) * T)
    np.testing.assert_allclose(dp.grad(once)(U), dp.hvp(energy, U, T), rtol=1e-11)
    third = dp.grad(lambda u: anp.sum(dp.hvp(energy, u, T) * T))(U)
    wanted = difference(lambda u: dp.hvp(energy, u, T), U, T, 1e-5)
    np.testing.assert_allclose(third, wanted, rtol=1e-4, atol=1e-4 * np.max(np.abs(wanted)))


@pytest.mark.parametrize("function", [dp.grad, dp.value_and_grad, lambda f: dp.vjp(f, U), lambda f: dp.hvp(f, U, T)])
def test_what_is_no_function_is_refused(function):
    with pytest.raises(TypeError, match="takes a function, got float"):
        function(2.0)


def test_messages():
    with pytest.raises(TypeError, match="takes a function, got ndarray"):
        dp.jvp(U, U, T)
    with pytest.raises(
        ValueError, match="argnum of value_and_grad must be a whole number >= 0, got -1; write 0 for the first argument"
    ):
        dp.grad(energy, -1)
    with pytest.raises(TypeError, match="the gradient in argument 1 of the loss needs it, got 1 arguments"):
        dp.grad(energy, 1)(U)
    with pytest.raises(ShapeError, match="the tangent must have the structure of x"):
        dp.jvp(energy, U, T[:2])
    with pytest.raises(ShapeError, match="the loss must be a scalar"):
        dp.hvp(LAPLACIAN, U, T)
    with pytest.raises(DerivativeError, match="a gradient needs floating values"):
        dp.vjp(energy, 3)
