"""What a function reads beside its arguments, and changes before the backward pass: refused, never a wrong number."""

from collections import OrderedDict, defaultdict

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.errors import DerivativeError

START = np.linspace(0.5, 1.0, 6)
FIRST = np.linspace(1.0, 2.0, 6)


def implicit_root(work):
    root = dp.implicit(lambda x, y: x + work * x**3 - y)
    return lambda y: root(y, y)


def root_with_jacobian(work):
    root = dp.implicit(lambda x, y: x + work * x**3 - y, jacobian=lambda x, y: np.diag(1 + 3 * work * x**2))
    return lambda y: root(y, y)


def adopted(work):
    return dp.from_blackbox(lambda x: work * x**2)


def adopted_with_sparsity(work):
    return dp.from_blackbox(lambda x: work * x**2, sparsity=np.eye(6))


@pytest.mark.parametrize("make", [implicit_root, root_with_jacobian, adopted, adopted_with_sparsity])
def test_arrays_of_functions_that_change_before_the_way_back(make):
    work = FIRST.copy()
    act = make(work)

    def loss(y, change):
        work[:] = FIRST
        y = act(y)
        work[3] = 5.0 if change else work[3]
        return anp.sum(anp.sin(y))

    direction = np.cos(np.arange(6))
    h = 1e-5
    difference = (loss(START + h * direction, False) - loss(START - h * direction, False)) / (2 * h)
    assert value_and_grad(loss)(START, False)[1] @ direction == pytest.approx(difference, rel=1e-8)
    act = make(work)  # one that keeps no Jacobian of before
    if make in (adopted, adopted_with_sparsity):
        with pytest.raises(
            DerivativeError,
            match="<lambda> gives another result for the same argument than before; it must depend on its argument "
            "only, so make everything that changes between calls a part of it",
        ):
            value_and_grad(loss)(START, True)
    else:
        with pytest.raises(
            DerivativeError,
            match="the root of .* no longer solves its residual: the residual uses something that has changed since "
            "the solve, such as an array that was written into; make what changes a parameter",
        ):
            value_and_grad(loss)(START, True)


@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2"])
def test_a_number_at_a_fixed_point_sees_the_rate_of_today(method):
    """Its root does not move, so that only its Jacobian tells one rate from the other."""
    share = 1.0
    rate = lambda u, p: share * (p - u)
    step = dp.stepper(method, rate, 0.5)
    root = dp.implicit(rate)
    slope = lambda step, u: dp.grad(lambda u: anp.sum(step(u, 2.0)))(u)
    slope(step, 2.0)
    assert dp.grad(lambda p: root(2.0, p))(2.0) == pytest.approx(1.0)
    share = 10.0
    wanted = pytest.approx(slope(dp.stepper(method, rate, 0.5), 2.0), rel=1e-12)
    assert slope(step, 2.0) == wanted and slope(step, np.array([2.0]))[0] == wanted
    assert dp.grad(lambda p: root(2.0, p))(2.0) == pytest.approx(1.0)


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_adopted_code_that_changes_between_gradients_is_refused(kind):
    share = [1.0]
    x = np.arange(1, 5).astype(kind)
    act = dp.from_blackbox(lambda x: share[0] * x**2)
    loss = value_and_grad(lambda x: anp.sum(act(x)))
    assert np.array_equal(loss(x)[1], 2 * x)
    share[0] = 3.0
    with pytest.raises(DerivativeError, match="another result for the same argument than before"):
        loss(x)


def test_adopted_code_with_a_counter_is_refused():
    runs = [0]

    def simulator(x):
        runs[0] += 1
        return x**2 * (1 + 0.01 * runs[0])

    act = dp.from_blackbox(simulator, sparsity=np.eye(6))
    with pytest.raises(DerivativeError, match="another result|does not agree"):
        value_and_grad(lambda x: anp.sum(act(x)))(START)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2"])
@pytest.mark.parametrize("memory", [None, 900, 3000])
@pytest.mark.parametrize("form", ["array", "dict", "timed"])
def test_rates_that_change_before_the_way_back(method, memory, form):
    work = FIRST.copy()
    rate = {
        "array": lambda u, p: -work * p * u**2,
        "dict": lambda u, p: {"a": -work * p * u["a"] ** 2},
        "timed": lambda u, p, t: -work * p * u**2 * (1 + t),
    }[form]
    start = {"array": START, "dict": {"a": START}, "timed": (START, 0.0)}[form]
    step = dp.stepper(method, rate, 0.05)

    def loss(p, change):
        work[:] = FIRST
        end = dp.rollout(step, start, p, 5, memory=memory)
        work[3] = 7.0 if change else work[3]
        end = end if form == "array" else end["a"] if form == "dict" else end[0]
        return anp.sum(end**2)

    difference = (loss(1.3 + 1e-5, False) - loss(1.3 - 1e-5, False)) / 2e-5
    assert value_and_grad(loss)(1.3, False)[1] == pytest.approx(difference, rel=1e-7)
    with pytest.raises(DerivativeError, match="changed since|run again"):
        value_and_grad(loss)(1.3, True)


@pytest.mark.parametrize("kind", [dict, OrderedDict, lambda **given: defaultdict(list, given)])
def test_dicts_of_any_kind_are_copied_for_rules(kind):
    product = dp.differentiable(
        "product", lambda x, given: x * given["a"], lambda nums, ans, x, given: lambda g: (g * given["a"],)
    )
    work = np.zeros(6)

    def loss(x):
        for number in range(3):
            work[:] = FIRST + number
            x = product(x, kind(a=work))
        work[:] = np.nan
        return anp.sum(x)

    np.testing.assert_allclose(value_and_grad(loss)(START)[1], FIRST * (FIRST + 1) * (FIRST + 2), rtol=1e-13)


def test_roots_near_zero_where_terms_cancel_are_no_other_roots():
    rate = lambda u, p: p - 0.3 - u - u**3
    step = dp.stepper("backward_euler", rate, 0.1)
    loss = lambda p: anp.sum(dp.rollout(step, np.zeros(6), 0.1 * p + 0.2, 4))
    root = dp.implicit(lambda x, p: x + x**3 - p + 0.3)
    single = lambda p: anp.sum(root(np.ones(6), 0.1 * p + 0.2))
    for p in (1.0, np.nextafter(1.0, 2.0), 1.0 + 1e-14):
        assert value_and_grad(loss)(p)[1] == pytest.approx(0.6 * (1 - 1.1**-4), rel=1e-9)
        assert value_and_grad(single)(p)[1] == pytest.approx(0.6, rel=1e-9)
