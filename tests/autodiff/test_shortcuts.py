"""The shortcuts of the tape, each against autograd, by bits; quotients of numbers whose squares underflow."""

import re
from time import process_time

import autograd
import autograd.numpy as anp
import numpy as np
import pytest
from autograd.extend import defvjp, primitive
from autograd.tracer import getval

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward
from sparsedp.autodiff.tape import primitive_jvps, primitive_vjps, replaced_functions
from sparsedp.errors import DerivativeError

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
    "numbers": lambda x, y: x[0, 1] * y[2, 3] - x[0, 1] / y[0, 0] + (2.0 - x[1, 1]) * y[2, 3] ** 3 * x,
    "entries": lambda x, y: (
        x[0] * y[..., -1:] + x[1:, None, 2][0] + y[x > 0][0] + y[[0, 0, 2]] + x[:, np.array([1] * 4)]
    ),
    "made of numbers": lambda x, y: anp.array([x[0, 0] * y[1, 1], 2.0, anp.array(x[1, 2]), -y[0, 1]]) * x,
    "made of rows": lambda x, y: anp.array([x[0], anp.array(y[1]), np.arange(4.0)]) * anp.array(y),
    "plain on the left": lambda x, y: (
        np.float64(2) * x + X * y[0, 0] - np.float64(3) / y + (X**2) ** y[0] + np.float32(2) * x
    ),
    "plain neighbours": lambda x, y: x * np.arange(4) + y * np.float32(0.1) + x * [1, 2, 3, 4] + y * True,
}


@pytest.fixture
def scaled_quotients(monkeypatch):
    """Give autograd the derivatives of quotients that do not divide by squares, as the tape has them."""
    for fun, scaled in replaced_functions.items():
        for rules in (primitive_vjps, primitive_jvps):
            monkeypatch.setitem(rules, fun, rules[scaled])


@pytest.mark.usefixtures("scaled_quotients")
@pytest.mark.parametrize("name", FORMULAS)
def test_the_shortcuts_of_the_tape_have_the_bits_of_autograd(name):
    def loss(z):
        return anp.sum(anp.sin(FORMULAS[name](z[0], z[1])))

    value, g = dp.value_and_grad(loss)((X, Y))
    same, known = autograd.value_and_grad(loss)((X, Y))
    assert value == same and abs(value - loss((X, Y))) <= 1e-15 * X.size  # x**2 is not power(x, 2) in NumPy 1.26
    assert all(np.array_equal(a, b) for a, b in zip(g, known, strict=True))


SMALL = 2.0**-570  # its square underflows
QUOTIENTS = {
    "equal shapes": lambda x, y: x / (y * np.ones((3, 4))),
    "broadcast": lambda x, y: x / y[0],
    "number": lambda x, y: x[0, 1] / y,
    "function": lambda x, y: anp.divide(x, y[:, :1]),
    "reciprocal": lambda x, y: x * anp.reciprocal(y),
    "power": lambda x, y: x * y**-1,
    "power of a number": lambda x, y: x[0, 1] * y[1, 1] ** -1.0 * np.ones(4),
    "arctan2": lambda x, y: anp.arctan2(x, y[:, :1]),
    "angle": lambda x, y: anp.angle(x + 1j * y),
    "complex": lambda x, y: anp.real(x / (x + 1j * y)),
}


@pytest.mark.parametrize("name", QUOTIENTS)
def test_derivatives_of_quotients_of_small_numbers(name):
    """A quotient does not change when both operands are scaled: its derivative scales with the inverse."""
    loss = lambda z: anp.sum(anp.sin(QUOTIENTS[name](z[0], z[1])))
    x = (X, Y)
    y = (SMALL * X, SMALL * Y)
    t = (Y, X**2)
    known = autograd.grad(loss)(x)
    found = dp.grad(loss)(y)
    assert all(np.allclose(SMALL * a, b, rtol=1e-13, atol=1e-13) for a, b in zip(found, known, strict=True))
    along = sum(np.sum(a * b) for a, b in zip(known, t, strict=True))
    assert dp.jvp(loss, y, tuple(SMALL * one for one in t))[1] == pytest.approx(along, rel=1e-12)
    both = autograd.grad(lambda z: sum(anp.sum(a * b) for a, b in zip(autograd.grad(loss)(z), t)))(x)
    assert all(np.allclose(a, b, rtol=1e-11, atol=1e-11) for a, b in zip(dp.hvp(loss, x, t), both, strict=True))


def test_quotients_keep_their_derivatives_for_other_users_of_autograd():
    assert not any(primitive_vjps[fun] is primitive_vjps[scaled] for fun, scaled in replaced_functions.items())


def test_a_list_of_exponents():
    """autograd takes one from the list itself, which Python refuses."""
    exponents = [1.0, 2.0, 0.0, -1.0]
    found = [dp.hvp(lambda x, e=e: anp.sum(x**e * Y), X, Y) for e in (exponents, np.array(exponents))]
    assert np.array_equal(*found) and np.array_equal(
        dp.grad(lambda x: anp.sum(x ** (1, 2, 0, 3)))(X)[:, 1], 2 * X[:, 1]
    )


def test_lists_that_hold_traced_values():
    """Beside an operator they are arrays; autograd's functions do not see what is inside, and lost its derivative."""
    made = lambda x: x * [x[0], 1.0] + (x[1], 2.0) - [x[0] * x[1], 0.0] / x
    known = lambda x: x * anp.array([x[0], 1.0]) + anp.array([x[1], 2.0]) - anp.array([x[0] * x[1], 0.0]) / x
    x = np.array([2.0, 3.0])
    g = np.array([1.0, 5.0])
    assert np.array_equal(dp.vjp(made, x)[1](g), dp.vjp(known, x)[1](g))
    assert np.array_equal(dp.jvp(made, x, g)[1], dp.jvp(known, x, g)[1])
    products = anp.inner, anp.matmul, lambda x, y: anp.einsum("i,i->", x, y), lambda x, y: anp.tensordot(x, y, 1)
    for fun in (anp.add, anp.maximum, lambda x, y: anp.where(x > 2, x, y), *products):
        for lost in (lambda x, f=fun: f(x, [x[0], 1.0]), lambda x, f=fun: anp.sum(f(x, [x[0], 1.0]))):
            with pytest.raises(DerivativeError, match="got a list that holds traced values"):
                dp.vjp(lost, x)
            with pytest.raises(DerivativeError, match="got a list that holds traced values"):
                dp.jvp(lost, x, g)
    with pytest.raises(
        DerivativeError,
        match=re.escape(
            "add got a list that holds traced values, and their derivatives would be lost; write anp.array([...]) "
            "around it, with autograd.numpy as anp"
        ),
    ):
        dp.vjp(lambda x: anp.add(x, [x[0], 1.0]), x)


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
    "kinds": lambda x, y: anp.array([x[0, 0], 3], dtype=float) + anp.array(y[0, :2], ndmin=1),
    "wider": lambda x, y: (x[0] + np.ones((3, 4))) - (1j * y[0] - x) + y[0] * anp.real(1j * x),
}


@pytest.mark.usefixtures("scaled_quotients")
@pytest.mark.parametrize("name", FORWARD)
def test_forward_shortcuts_have_the_bits_of_autograd(name):
    def ends(z):
        return anp.sin(FORWARD[name](z[:3], z[3:]))

    z = np.concatenate([X, Y])
    t = np.concatenate([Y, X])
    value, slope = pushforward(ends, z, t)
    known, along = autograd.make_jvp(ends)(z)(t)
    assert np.array_equal(value, known) and np.array_equal(slope, along) and slope.dtype == along.dtype


@pytest.mark.parametrize("name", FORMULAS)
def test_second_derivatives_pass_through_the_forward_shortcuts(name):
    """Reverse over forward and forward over reverse, beside reverse over reverse of autograd."""

    def loss(z):
        return anp.sum(anp.sin(FORMULAS[name](z[:3], z[3:])))

    z = np.concatenate([X, Y])
    t = np.concatenate([Y, X])
    known = autograd.grad(lambda z: anp.sum(t * autograd.grad(loss)(z)))(z)
    back = dp.value_and_grad(lambda z: pushforward(loss, z, t)[1])(z)[1]
    along = pushforward(lambda z: dp.value_and_grad(loss)(z)[1], z, t)[1]
    assert all(np.max(np.abs(a - known)) <= 1e-13 * np.max(np.abs(known)) for a in (back, along))


@pytest.mark.parametrize("kind", ["f", "D"])
def test_other_kinds_of_numbers_are_left_to_autograd(kind):
    x = X.astype(kind)
    y = Y.astype(kind)

    def loss(z):
        return anp.sum(anp.real(z[0] * z[1] - z[0] / z[1]) ** 2)

    ours = dp.value_and_grad(loss)((x, y))[1]
    known = autograd.grad(loss)((x, y))
    assert all(a.dtype == kind and np.allclose(a, b, rtol=1e-6) for a, b in zip(ours, known, strict=True))


def test_a_primitive_that_a_user_made_of_a_function_of_numpy_keeps_its_own_derivative():
    total = primitive(np.sum)
    average = primitive(np.mean)
    defvjp(total, lambda ans, x: lambda g: 2.0 * g * np.ones(x.shape))
    defvjp(average, lambda ans, x: lambda g: 3.0 * g * np.ones(x.shape))
    assert np.all(dp.value_and_grad(lambda x: total(x) + average(x))(X)[1] == 5.0)


@pytest.mark.parametrize("join", [lambda x, z: anp.where(X > 0, x, z), lambda x, z: anp.concatenate([x, z])])
@pytest.mark.parametrize("real", [lambda x: x * x, lambda x: -x, lambda x: x + 1.0, lambda x: x**3, lambda x: 2 / x])
def test_real_values_beside_complex_ones_get_real_cotangents(join, real):
    loss = lambda x: anp.sum(anp.abs(join(real(x), 1j * x) * (1 + 2j) + 1j) ** 2)
    ours = dp.value_and_grad(loss)(X)[1]
    assert ours.dtype == float and np.allclose(ours, np.real(autograd.grad(loss)(X)), rtol=1e-13)


OPERATORS = {
    "+": anp.add,
    "-": anp.subtract,
    "*": anp.multiply,
    "/": anp.true_divide,
    "**": anp.power,
}


@pytest.mark.parametrize("sign", OPERATORS)
@pytest.mark.parametrize("mode", [autograd.grad, lambda loss: lambda z: autograd.make_jvp(loss)(z)(Y)[1]])
def test_operators_of_traced_values_are_the_functions_of_autograd(sign, mode):
    """Also on autograd's own traces, and on one trace inside another."""
    quick = eval(f"lambda x, y: x {sign} y")
    for left, right in [(X**2, None), (None, Y), (2.5, None), (None, 2.0), (np.float64(2.5), None), (None, None)]:

        def loss(z, act):
            inner = mode(lambda w: anp.sum(act(z**2, w)))(Y)
            return anp.sum(act(z**2 if left is None else left, z if right is None else right) * inner)

        known = mode(lambda z: loss(z, OPERATORS[sign]))(X)
        assert np.array_equal(mode(lambda z: loss(z, quick))(X), known)


def test_an_operand_that_acts_itself_is_still_asked():
    class Louder:
        def __array_ufunc__(self, ufunc, how, *args, **options):
            return ufunc.__name__

    other = Louder()
    found = []
    pushforward(lambda x: found.extend([x * other, other + x]) or x, X, Y)
    assert found == ["multiply", "add"]


RATE = lambda u, p: anp.array([u[0] * (p[0] - p[1] * u[1]), u[1] * (p[2] * u[0] - 1.0)])
STEPS = 100
POINT = np.array([1.3, 0.9, 0.9])


def of_rates(p):
    return anp.sum(dp.rollout(dp.stepper("rk4", RATE, 0.05), np.array([1.0, 0.5]), p, STEPS) ** 2)


def test_small_steps_do_without_the_dispatch_of_autograd(monkeypatch):
    calls = []
    found = autograd.tracer.find_top_boxed_args
    monkeypatch.setattr(autograd.tracer, "find_top_boxed_args", lambda args: calls.append(1) or found(args))
    pushforward(of_rates, POINT, np.ones(3))
    dp.value_and_grad(of_rates)(POINT)
    assert len(calls) < STEPS  # 17 functions for each of 4 rates, in each step


@pytest.mark.whole
def test_a_gradient_of_small_steps_takes_a_few_of_their_values():
    def seconds(act):
        times = []
        for _ in range(7):
            start = process_time()
            act()
            times.append(process_time() - start)
        return min(times)

    value = seconds(lambda: of_rates(POINT))
    assert seconds(lambda: dp.value_and_grad(of_rates)(POINT)) < 14 * value  # measured: 8.8, by autograd's dispatch 20
    assert seconds(lambda: pushforward(of_rates, POINT, np.ones(3))) < 8 * value  # measured: 5.8, 9.5


def test_powers_have_the_bits_of_the_plain_ones():
    """A rollout that runs a step again, without a tape, compares bits."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        s = np.float64(rng.random() + 0.3)
        u = rng.random(7) + 0.3
        for power in (2, 3, 1.5, -1, 0.5, np.float64(2.5)):
            for x in (s, u):
                plain = []
                dp.value_and_grad(
                    lambda x, power=power, plain=plain: anp.sum(plain.append(getval(x**power)) or x**power)
                )(x)
                assert np.array_equal(plain[0], x**power)


WHERE = {
    "a number": (lambda s: anp.where(X > 0, s, X), lambda s: (X > 0) * s + (X <= 0) * X, 0.7),
    "a number second": (lambda s: anp.where(X > 0, X, s**2), lambda s: (X > 0) * X + (X <= 0) * s**2, 0.7),
    "both": (lambda s: anp.where(X > 0, s * X, s), lambda s: (X > 0) * s * X + (X <= 0) * s, 0.7),
    "a row": (lambda s: anp.where(X > 0, s, 1.0), lambda s: (X > 0) * s + (X <= 0), X[0]),
    "a column": (lambda s: anp.where(X[0] > 0, s, X), lambda s: (X[0] > 0) * s + (X[0] <= 0) * X, X[:, :1]),
    "complex": (
        lambda s: anp.real(1j * anp.where(X > 0, s, 1j * X)),
        lambda s: anp.real(1j * ((X > 0) * s + (X <= 0) * 1j * X)),
        0.3 + 0.2j,
    ),
}


@pytest.mark.parametrize("name", WHERE)
def test_where_of_operands_that_are_repeated(name):
    """autograd does not add up their cotangents."""
    chosen, product, s = WHERE[name]
    loss, same = (lambda s, f=f: anp.sum(anp.sin(f(s)) * Y) for f in (chosen, product))
    for derivative in (dp.grad, lambda f: dp.grad(dp.jit(f)), lambda f: lambda s: dp.jvp(f, s, 2.0 * s)[1]):
        found, expected = derivative(loss)(s), derivative(same)(s)
        assert np.shape(found) == np.shape(expected) and np.allclose(found, expected, rtol=1e-13, atol=1e-13)
    assert np.allclose(dp.hvp(loss, s, s), dp.hvp(same, s, s), rtol=1e-13, atol=1e-13)
