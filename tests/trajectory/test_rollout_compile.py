"""Rollouts of steps that dp.jit(..., compile=True) translates to machine code."""

import warnings

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.pytree import leaves

pytest.importorskip("llvmlite")
START = np.array([1.0, 0.5])
RATES = np.array([1.0, 0.8, 0.9])
WIDE = 8.0 + np.sin(np.arange(12.0))


def rate(u, p):
    return anp.array([p[0] * u[0] - p[1] * u[0] * u[1], p[1] * u[0] * u[1] - p[2] * u[1]])


def circle(u, force):
    return (anp.roll(u, -1) - anp.roll(u, 2)) * anp.roll(u, 1) - u + force


def pendulum(state, params, push):
    angle, turning = state
    return angle + 0.1 * turning, turning - 0.1 * (params["g"] * anp.sin(angle) + push * anp.cos(angle)) / params["l"]


PENDULUM = (np.linspace(-1.0, 1.0, 9), np.zeros(9)), {"g": 9.81, "l": np.linspace(1.0, 2.0, 9)}
PUSHES = np.sin(np.arange(11.0))


def compare(step, arguments, n, tolerance=1e-13, **options):
    """Compare value and gradient in all arguments with those of the plain step; return the jitted step."""
    jitted = dp.jit(step, compile=True)

    def loss(step, arguments):
        end = dp.rollout(step, arguments[0], arguments[1], n, *arguments[2:], **options)
        return sum(anp.sum(leaf**2) + anp.sum(anp.sin(leaf)) for leaf in leaves(end))

    vector, build = dp.flatten(arguments)
    for scale in (1.0, 0.9):
        x = build(scale * vector)
        expected, slopes = dp.value_and_grad(lambda x: loss(step, x))(x)
        found, gradient = dp.value_and_grad(lambda x: loss(jitted, x))(x)
        assert found == pytest.approx(expected, rel=tolerance)
        assert loss(jitted, x) == pytest.approx(expected, rel=tolerance)
        a, b = dp.flatten(slopes)[0], dp.flatten(gradient)[0]
        np.testing.assert_allclose(b, a, rtol=0, atol=tolerance * np.max(np.abs(a)))
    return jitted


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"keep": [0, 3, 7]}, marks=pytest.mark.whole),
        {"truncate": 4, "keep": "all"},
        pytest.param({}, marks=pytest.mark.whole),
        pytest.param({"keep": "all"}, marks=pytest.mark.whole),
        pytest.param({"truncate": 4}, marks=pytest.mark.whole),
        pytest.param({"memory": 4000}, marks=pytest.mark.whole),
    ],
    ids=str,
)
def test_options(options):
    arguments = *PENDULUM, PUSHES
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.errors.BudgetWarning)
        jitted = compare(pendulum, arguments, 11, **options)
    assert jitted.not_compiled == ()


def test_steppers_are_one_call_of_machine_code(monkeypatch):
    from sparsedp.autodiff.jit import PullbackProgram

    for method, arguments, n in ((rate, (START, RATES), 30), (circle, (WIDE, 8.0), 9)):
        step = dp.stepper("rk4", method, 0.02)
        jitted = compare(step, arguments, n)
        assert jitted.not_compiled == ()
        calls = []
        forward = PullbackProgram.forward
        monkeypatch.setattr(PullbackProgram, "forward", lambda *args: calls.append(0) or forward(*args))
        dp.grad(lambda state: anp.sum(dp.rollout(jitted, state, arguments[1], n)))(arguments[0])
        dp.grad(lambda state: anp.sum(dp.rollout(jitted, state, arguments[1], n)))(arguments[0])
        before = len(calls)
        dp.grad(lambda state: anp.sum(dp.rollout(jitted, state, arguments[1], n)))(arguments[0])
        assert len(calls) == before  # no step by itself
        monkeypatch.undo()


@pytest.mark.whole
def test_a_loss_with_a_rollout():
    loss = lambda p: anp.sum(dp.rollout(dp.stepper("rk4", rate, 0.05), START, p, 20) ** 2)
    jitted = dp.jit(loss, compile=True)
    for p in (RATES, 1.1 * RATES):
        value, gradient = dp.value_and_grad(loss)(p)
        found, slope = dp.value_and_grad(jitted)(p)
        assert found == pytest.approx(value, rel=1e-13)
        np.testing.assert_allclose(slope, gradient, rtol=1e-12)
    assert jitted.not_compiled == ()


@pytest.mark.whole
def test_second_order_and_forward_mode():
    step = dp.stepper("rk4", rate, 0.05)
    jitted = dp.jit(step, compile=True)
    plain = lambda p: anp.sum(dp.rollout(step, START, p, 6) ** 2)
    compiled = lambda p: anp.sum(dp.rollout(jitted, START, p, 6) ** 2)
    np.testing.assert_allclose(dp.hvp(compiled, RATES, RATES), dp.hvp(plain, RATES, RATES), rtol=1e-10)
    np.testing.assert_allclose(dp.jvp(compiled, RATES, RATES)[1], dp.jvp(plain, RATES, RATES)[1], rtol=1e-12)
    nested = lambda loss: dp.grad(lambda p: anp.sum(dp.grad(loss)(p) ** 2))(RATES)
    np.testing.assert_allclose(nested(compiled), nested(plain), rtol=1e-9)


@pytest.mark.whole
def test_two_backward_passes_and_records():
    step = dp.jit(dp.stepper("rk4", rate, 0.05), compile=True)
    for memory in (None, 10**5):
        runs = []
        end, pull = dp.vjp(lambda p: dp.rollout(step, START, p, 40, memory=memory, record=runs.append), RATES)
        first, second = pull(np.ones(2)), pull(np.ones(2))
        np.testing.assert_array_equal(first, second)
    plain = []
    dp.grad(lambda p: anp.sum(dp.rollout(step.function, START, p, 40, record=plain.append)))(RATES)
    backward = next(run for run in runs if run.direction == "backward")
    assert [i for i, _ in backward.norms] == [i for i, _ in plain[1].norms]
    np.testing.assert_allclose([size for _, size in backward.norms], [size for _, size in plain[1].norms], rtol=1e-12)


def test_errors_name_the_step():
    step = dp.jit(lambda u, p: u * u * p, compile=True)
    dp.grad(lambda u: anp.sum(dp.rollout(step, u, 1.0, 3)))(START)
    with pytest.raises(dp.errors.NonFiniteError, match="step 3 of rollout"), np.errstate(all="ignore"):
        dp.rollout(step, 1e20 * START, 1.0, 30)
    with pytest.raises(dp.errors.NonFiniteError, match="params of rollout"):
        dp.rollout(step, START, np.nan, 3)


@pytest.mark.whole
def test_fields_in_single_precision():
    step = lambda u, p: u + p * (anp.roll(u, 1) - u)
    jitted = dp.jit(step, compile=True)
    start = WIDE.astype(np.float32)
    for p in (np.float32(0.1), 0.2):
        expected = dp.rollout(step, start, p, 5)
        found = dp.rollout(jitted, start, p, 5)
        assert found.dtype == expected.dtype
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.whole
def test_one_step_and_no_step():
    step = dp.jit(dp.stepper("rk4", rate, 0.05), compile=True)
    for n in (0, 1):
        for p in (RATES, 1.2 * RATES):
            expected = dp.rollout(step.function, START, p, n, keep="all")
            np.testing.assert_allclose(dp.rollout(step, START, p, n, keep="all"), expected, rtol=1e-15)
