"""The tape: rules, what they refuse, counts, and derivatives of programs of any order."""

import gc
import inspect
import math
import weakref

import autograd
import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback, pushforward, taped, value_and_grad
from sparsedp.autodiff.tape import linear

SQUARE = dp.differentiable(
    "square",
    lambda x: x * x,
    lambda nums, ans, x: lambda g: (2 * x * g,),
    lambda nums, tangents, ans, x: 2 * x * tangents[0],
)


def product_rule(calls):
    """x * y with one pullback for all requested arguments; `calls` logs what was asked."""

    def vjp(nums, ans, x, y):
        def pull(g):
            calls.append(nums)
            return tuple(g * (y, x)[num] for num in nums)

        return pull

    return dp.differentiable(
        "product", lambda x, y: x * y, vjp, lambda nums, ts, ans, x, y: sum(t * (y, x)[num] for num, t in zip(nums, ts))
    )


def test_one_pullback_serves_all_arguments_and_none_is_run_when_nothing_asks():
    calls = []
    rule = product_rule(calls)
    value, gradient = value_and_grad(lambda x: anp.sum(rule(x["a"], x["b"])))({"a": np.ones(2), "b": 2 * np.ones(2)})
    assert value == 4.0 and calls == [(0, 1)]
    np.testing.assert_array_equal(gradient["a"], [2, 2])
    value_and_grad(lambda x: anp.sum(rule(x, np.ones(2))))(np.ones(2))
    assert calls[1:] == [(0,)]
    rule(np.ones(2), np.ones(2))
    assert len(calls) == 2


def test_every_mode_of_second_order():
    """forward over reverse, reverse over reverse, reverse over forward, forward over forward."""
    f = lambda x: anp.sum(SQUARE(x) * anp.sin(x))
    x = np.array([0.3, -1.2])
    v = np.array([0.7, 0.4])
    wanted = v * (2 * np.sin(x) + 4 * x * np.cos(x) - x**2 * np.sin(x))
    slope = lambda x: value_and_grad(f)(x)[1]
    along = lambda x: pushforward(f, x, v)[1]
    np.testing.assert_allclose(pushforward(slope, x, v)[1], wanted, rtol=1e-14)
    np.testing.assert_allclose(value_and_grad(lambda x: anp.sum(slope(x) * v))(x)[1], wanted, rtol=1e-14)
    np.testing.assert_allclose(value_and_grad(along)(x)[1], wanted, rtol=1e-14)
    np.testing.assert_allclose(pushforward(along, x, v)[1], np.sum(wanted * v), rtol=1e-14)


def test_a_wider_cotangent_is_rounded_to_the_dtype_of_the_field():
    wide = dp.differentiable("wide", lambda x: x * 1, lambda nums, ans, x: lambda g: (np.full(2, 1 / 3),))
    gradient = value_and_grad(lambda x: anp.sum(wide(x)))(np.ones(2, np.float32))[1]
    assert gradient.dtype == np.float32


def test_float32_has_second_derivatives_in_every_mode():
    op = dp.laplacian(dp.Grid(4))
    scale = np.arange(1.0, 5.0)  # float64 meets float32: cotangents are cast in the backward pass
    f = lambda u: anp.sum(op(u * scale) ** 2)
    u = np.ones(4, np.float32)
    v = np.arange(4, dtype=np.float32)
    wanted = 2 * scale * op.T(op(scale * v))
    slope = lambda u: value_and_grad(f)(u)[1]
    for product in (pushforward(slope, u, v)[1], value_and_grad(lambda u: anp.sum(slope(u) * v))(u)[1]):
        assert product.dtype == np.float32
        np.testing.assert_allclose(product, wanted, rtol=1e-5)


def test_missing_derivatives_and_hidden_boxes_are_named():
    bare = dp.differentiable("bare", lambda x: x)
    with pytest.raises(dp.errors.DerivativeError, match=r"^bare has no VJP; give differentiable\(...\) a vjp$"):
        value_and_grad(lambda x: bare(x))(1.0)
    with pytest.raises(dp.errors.DerivativeError, match=r"^bare has no JVP; give differentiable\(...\) a jvp$"):
        pushforward(bare, 1.0, 1.0)
    first = dp.differentiable("first", lambda pair: pair[0], lambda nums, ans, pair: None)
    with pytest.raises(
        dp.errors.DerivativeError, match="^first got a traced value inside a tuple; pass it as an argument$"
    ):
        value_and_grad(lambda x: first((x, 1.0)))(1.0)


def test_a_vjp_of_another_form():
    """Such as a VJP in the form of JAX."""
    cube = dp.differentiable("cube", lambda x: x**3, lambda g, x: (3 * x**2 * g,))
    assert cube(2.0) == 8.0
    with pytest.raises(
        TypeError,
        match=r"^differentiable\('cube'\) calls a function with 3 arguments, got one that takes 2; "
        r"write vjp=lambda nums, ans, \*args: lambda g: \(\.\.\.,\)$",
    ):
        dp.value_and_grad(cube)(2.0)
    cube = dp.differentiable("cube", lambda x: x**3, lambda nums, ans, x: (3 * x**2,))
    with pytest.raises(
        TypeError,
        match=r"^the vjp of cube must return a function, got tuple; "
        r"write vjp=lambda nums, ans, \*args: lambda g: \(\.\.\.,\)$",
    ):
        dp.value_and_grad(cube)(2.0)


def test_a_jvp_of_another_form():
    cube = dp.differentiable("cube", lambda x: x**3, jvp=lambda primals, tangents: (primals[0] ** 3, tangents[0]))
    with pytest.raises(
        TypeError,
        match=r"^differentiable\('cube'\) calls a function with 4 arguments, got one that takes 2; "
        r"write jvp=lambda nums, tangents, ans, \*args: \.\.\.$",
    ):
        dp.jvp(cube, 2.0, 1.0)


def test_keywords_are_traced():
    power = dp.differentiable(
        "scale",
        lambda u, rate=2.0: u * rate,
        lambda nums, ans, u, rate: lambda g: tuple(anp.sum(g * (rate, u)[num]) if num else g * rate for num in nums),
        keywords=("rate",),
    )
    assert value_and_grad(lambda r: anp.sum(power(np.ones(3), rate=r)))(5.0) == (15.0, 3.0)
    assert power(1.5) == 3.0
    with pytest.raises(dp.errors.DerivativeError, match="^scale takes no keyword 'u'; pass the value by position$"):
        power(u=1.0)


def test_containers_pass_ints_and_none_through():
    seen = {}

    def loss(x):
        seen.update(n=x["n"], none=x["none"], flag=x["list"][1])
        return anp.sum(x["a"] ** 2) * x["n"] + x["list"][0] * x["pair"][0]

    start = {"a": np.array([1.0, 2.0]), "n": 3, "none": None, "list": [2.0, True], "pair": (4.0, "name")}
    value, gradient = value_and_grad(loss)(start)
    assert seen == {"n": 3, "none": None, "flag": True} and value == 23.0
    np.testing.assert_array_equal(gradient["a"], [6.0, 12.0])
    assert gradient["n"] is None and gradient["none"] is None
    assert gradient["list"] == [4.0, None] and gradient["pair"] == (2.0, None)


def test_gradient_keeps_shape_and_dtype_of_every_leaf():
    start = (np.ones((2, 3), np.float32), np.float64(2.0), 3.0, np.ones((), np.float32), np.ones(2, complex))
    gradient = value_and_grad(lambda x: anp.sum(x[0]) * x[1] * x[2] * x[3] + anp.real(anp.sum(x[4] ** 2)))(start)[1]
    assert [np.asarray(leaf).dtype.char for leaf in gradient] == ["f", "d", "d", "f", "D"]
    assert [np.shape(leaf) for leaf in gradient] == [(2, 3), (), (), (), (2,)]
    assert isinstance(gradient[2], float)


def test_leaves_of_a_gradient_are_apart():
    x = np.ones(3)
    one, other = value_and_grad(lambda p: anp.sum(p[0] + p[1]))((x, x.copy()))[1]
    one += 1.0
    np.testing.assert_array_equal(other, [1, 1, 1])
    rule = dp.differentiable("listed", lambda x: x * 1, lambda nums, ans, x: lambda g: ([1.0, 2.0, 3.0],))
    assert isinstance(value_and_grad(lambda x: anp.sum(rule(x)))(x)[1], np.ndarray)


def test_a_loss_that_does_not_use_x_has_a_zero_gradient():
    value, gradient = value_and_grad(lambda x: 3.0)({"a": np.ones(2), "b": 1.0})
    assert value == 3.0 and gradient["b"] == 0.0
    np.testing.assert_array_equal(gradient["a"], [0, 0])


def test_counts():
    grid = dp.Grid(4)
    op = dp.laplacian(grid)
    with recording() as calls:
        value_and_grad(lambda u: anp.sum(SQUARE(op(op(u)))))(np.ones(4))
        pushforward(lambda u: SQUARE(op(u)), np.ones(4), np.ones(4))
    assert calls == {
        ("laplacian", "forward"): 3,
        ("laplacian", "vjp"): 2,
        ("laplacian", "jvp"): 1,
        ("square", "forward"): 2,
        ("square", "vjp"): 1,
        ("square", "jvp"): 1,
        ("laplacian", "assembled"): 1,
    }
    op(np.ones(4))
    assert calls["laplacian", "forward"] == 3


def test_rules_and_operators_do_not_leak():
    def use():
        rule = product_rule([])
        op = dp.laplacian(dp.Grid(5))
        value_and_grad(lambda x: anp.sum(op(op.T(rule(x, x)))))(np.ones(5))
        return weakref.ref(op)

    alive = use()
    gc.disable()
    try:
        assert use()() is None  # without the cycle collector
    finally:
        gc.enable()
    gc.collect()
    assert alive() is None


def test_an_exception_in_an_inner_derivative_leaves_the_outer_one_right():
    def stop(x):
        raise ValueError("no")

    def loss(x):
        for _ in range(3):
            with pytest.raises(ValueError, match="no"):
                value_and_grad(stop)(x)
        return x * value_and_grad(lambda y: y**3)(x)[1]

    assert value_and_grad(loss)(2.0) == (24.0, 36.0)


def test_an_entry_that_is_read_twice_is_recorded_once():
    """Two entries and the three operations on them, whose derivatives of both orders are exact."""
    f = lambda u: u[0] * u[1] + u[0] ** 2
    u = np.array([3.0, 5.0])
    tape = taped(f, u, [True])
    assert len(tape.nodes) == 5
    np.testing.assert_array_equal(tape.pull([1.0])[0], [11, 3])
    np.testing.assert_array_equal(dp.hvp(f, u, np.array([1.0, 10.0])), [12, 1])
    slope = lambda u: value_and_grad(f)(u)[1]
    np.testing.assert_array_equal(value_and_grad(lambda u: anp.sum(slope(u)))(u)[1], [3, 1])


def test_linear_rules_are_each_others_derivative():
    rows = np.array([[1.0, 2.0], [0.0, 3.0], [4.0, 0.0]])
    there, back = linear("rows", lambda x: rows @ x, lambda g: rows.T @ g)
    x = np.array([1.0, -1.0])
    g = np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(pullback(there, x)[1](g), rows.T @ g)
    np.testing.assert_array_equal(pullback(back, g)[1](x), rows @ x)
    hessian = pushforward(lambda x: value_and_grad(lambda x: anp.sum(there(x) ** 2))(x)[1], x, x)[1]
    np.testing.assert_allclose(hessian, 2 * rows.T @ rows @ x)


def test_tape_cost_of_one_operator_call():
    """The gate is 12 us on a quiet machine (benchmarks/apply.py prints it); this catches a regression: 2.2 sines."""
    from time import process_time
    from timeit import repeat

    def cost(call):
        def loss(u):
            for _ in range(200):
                u = call(u)
            return anp.sum(u)

        slope = value_and_grad(loss)
        u = np.ones((2, 2))
        slope(u)
        return min(repeat(lambda: slope(u), timer=process_time, number=1, repeat=30))

    assert cost(dp.laplacian(dp.Grid((2, 2)))) <= 3.0 * cost(anp.sin)


def test_a_function_that_does_not_tell_how_it_is_called():
    """Functions of C without a signature, as all of NumPy's own were in 1.26: they take their arguments by position."""
    with pytest.raises(ValueError):
        inspect.signature(math.hypot)
    hypot = dp.differentiable(
        "hypot",
        math.hypot,
        lambda nums, ans, x, y: lambda g: tuple(g * (x, y)[num] / ans for num in nums),
        lambda nums, tangents, ans, x, y: sum(t * (x, y)[num] / ans for num, t in zip(nums, tangents)),
    )
    assert dp.value_and_grad(lambda z: hypot(z[0], z[1]))((3.0, 4.0)) == (5.0, (0.6, 0.8))
    assert "derivative of hypot in args: not asked" in dp.explain(lambda x: hypot(x, 4.0), 3.0).skipped


@pytest.mark.parametrize("inner", [autograd.grad, lambda f: lambda x: value_and_grad(f)(x)[1]], ids=["autograd", "own"])
@pytest.mark.parametrize("outer", [autograd.grad, lambda f: lambda x: value_and_grad(f)(x)[1]], ids=["autograd", "own"])
def test_trace_numbers_increase(outer, inner):
    """Of two that are nested the inner one has the larger number, and a later one has a larger one than both."""
    numbers = []

    def cube(x):
        numbers.append(x._trace)
        return x**3

    def slope(x):
        numbers.append(x._trace)
        return inner(cube)(x)

    assert [outer(slope)(2.0), inner(cube)(2.0), outer(slope)(2.0)] == [12.0, 12.0, 12.0]
    assert len(numbers) == 5 and all(before < after for before, after in zip(numbers, numbers[1:]))
