"""The shortcuts of the tape, each against autograd, by bits."""

import autograd
import autograd.numpy as anp
import numpy as np
import pytest
from autograd.extend import defvjp, primitive

import sparsedp as dp
from sparsedp.derivative import pushforward

RNG = np.random.default_rng(3)
X, Y = RNG.standard_normal((2, 3, 4))
FORMULAS = {
    "add": lambda x, y: x + y,
    "itself": lambda x, y: x + x + y,
    "number": lambda x, y: 2 + x * 3.0 - y,
    "subtract": lambda x, y: 1.0 - x - y,
    "multiply": lambda x, y: x * y * x,
    "divide": lambda x, y: x / y + 1.0 / x + y / 2,
    "negative": lambda x, y: -x + y,
    "power": lambda x, y: x**2 + (y**2) ** 0.5 + x**0 + y**-3 + x**1,
    "power of a power": lambda x, y: (x**2) ** y,
    "mean": lambda x, y: anp.mean(x) * y + anp.sum(y) * x,
    "axes": lambda x, y: anp.mean(x, axis=0) + anp.sum(y, axis=1, keepdims=True) + anp.sum(x, 0),
    "broadcast": lambda x, y: x[0] * y + x[:, :1] + y[1, 1] * x,
    "nothing": lambda x, y: anp.sum(x[:0]) + anp.mean(y[:, 1]) + x[0, 0] * y,
    "plain neighbours": lambda x, y: x * np.arange(4) + y * np.float32(0.1) + x * [1, 2, 3, 4] + y * True,
}


@pytest.mark.parametrize("name", FORMULAS)
def test_the_shortcuts_of_the_tape_have_the_bits_of_autograd(name):
    def loss(z):
        return anp.sum(anp.sin(FORMULAS[name](z[0], z[1])))

    value, g = dp.value_and_grad(loss)((X, Y))
    same, known = autograd.value_and_grad(loss)((X, Y))
    assert value == same and abs(value - loss((X, Y))) <= 1e-15 * X.size  # x**2 is not power(x, 2) in NumPy 1.26
    assert all(np.array_equal(a, b) for a, b in zip(g, known, strict=True))


@pytest.mark.parametrize("name", FORMULAS)
def test_second_derivatives_pass_through_the_shortcuts(name):
    def loss(z):
        return anp.sum(anp.sin(FORMULAS[name](z[0], z[1])))

    def slope(z, gradient):
        g = gradient(z)
        return anp.sum(X * g[0] + Y * g[1])

    ours = dp.value_and_grad(lambda z: slope(z, lambda z: dp.value_and_grad(loss)(z)[1]))((X, Y))[1]
    known = autograd.grad(lambda z: slope(z, autograd.grad(loss)))((X, Y))
    assert all(np.max(np.abs(a - b)) <= 1e-13 * np.max(np.abs(b)) for a, b in zip(ours, known, strict=True))


FORWARD = {
    **FORMULAS,
    "items": lambda x, y: anp.array([x[0, 0] * y[1, 1], 2.0, x[1, 2] - y[0, 0] / x[2, 3], -y[0, 1]]),
    "rows": lambda x, y: anp.array([x[0], y[1], np.arange(4.0)]),
    "kinds": lambda x, y: anp.array([x[0, 0], 3], dtype=float) + anp.array(y[0, :2], ndmin=1),
    "wider": lambda x, y: (x[0] + np.ones((3, 4))) - (1j * y[0] - x) + y[0] * anp.real(1j * x),
}


@pytest.mark.parametrize("name", FORWARD)
def test_forward_shortcuts_have_the_bits_of_autograd(name):
    def ends(z):
        return anp.sin(FORWARD[name](z[:3], z[3:]))

    z, t = np.concatenate([X, Y]), np.concatenate([Y, X])
    value, slope = pushforward(ends, z, t)
    known, along = autograd.make_jvp(ends)(z)(t)
    assert np.array_equal(value, known) and np.array_equal(slope, along) and slope.dtype == along.dtype


@pytest.mark.parametrize("name", FORMULAS)
def test_second_derivatives_pass_through_the_forward_shortcuts(name):
    """Reverse over forward and forward over reverse, beside reverse over reverse of autograd."""

    def loss(z):
        return anp.sum(anp.sin(FORMULAS[name](z[:3], z[3:])))

    z, t = np.concatenate([X, Y]), np.concatenate([Y, X])
    known = autograd.grad(lambda z: anp.sum(t * autograd.grad(loss)(z)))(z)
    back = dp.value_and_grad(lambda z: pushforward(loss, z, t)[1])(z)[1]
    along = pushforward(lambda z: dp.value_and_grad(loss)(z)[1], z, t)[1]
    assert all(np.max(np.abs(a - known)) <= 1e-13 * np.max(np.abs(known)) for a in (back, along))


@pytest.mark.parametrize("kind", ["f", "D"])
def test_other_kinds_of_numbers_are_left_to_autograd(kind):
    x, y = X.astype(kind), Y.astype(kind)

    def loss(z):
        return anp.sum(anp.real(z[0] * z[1] - z[0] / z[1]) ** 2)

    ours, known = dp.value_and_grad(loss)((x, y))[1], autograd.grad(loss)((x, y))
    assert all(a.dtype == kind and np.allclose(a, b, rtol=1e-6) for a, b in zip(ours, known, strict=True))


def test_a_primitive_that_a_user_made_of_a_function_of_numpy_keeps_its_own_derivative():
    total, average = primitive(np.sum), primitive(np.mean)
    defvjp(total, lambda ans, x: lambda g: 2.0 * g * np.ones(x.shape))
    defvjp(average, lambda ans, x: lambda g: 3.0 * g * np.ones(x.shape))
    assert np.all(dp.value_and_grad(lambda x: total(x) + average(x))(X)[1] == 5.0)


@pytest.mark.parametrize("join", [lambda x, z: anp.where(X > 0, x, z), lambda x, z: anp.concatenate([x, z])])
@pytest.mark.parametrize("real", [lambda x: x * x, lambda x: -x, lambda x: x + 1.0, lambda x: x**3, lambda x: 2 / x])
def test_real_values_beside_complex_ones_get_real_cotangents(join, real):
    loss = lambda x: anp.sum(anp.abs(join(real(x), 1j * x) * (1 + 2j) + 1j) ** 2)
    ours = dp.value_and_grad(loss)(X)[1]
    assert ours.dtype == float and np.allclose(ours, np.real(autograd.grad(loss)(X)), rtol=1e-13)
