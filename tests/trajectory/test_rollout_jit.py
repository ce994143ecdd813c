"""Rollouts of jitted steps equal those of the steps themselves, under every option."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

RING = dp.Grid(12, periodic=True)
L = dp.laplacian(RING)
CARRY = dp.transport(RING, "upwind", velocity="cells")
U = np.sin(np.arange(12.0))


def one_array(u, p):
    return CARRY(u, 0.2 * u, 0.3) + 0.1 * p * L(u)


def tree(state, p):
    u = state["u"] + 0.1 * p["rate"] * L(state["u"]) * state["more"][0]
    return {"more": (state["more"][0] * 0.9, anp.sum(u)), "u": u + p["source"]}  # in another order


def with_input(u, p, source):
    return u + 0.1 * p * L(u) + source["a"] * source["b"]


STATES = {"u": U, "more": (1.0, np.float64(2.0))}
PARAMS = {"rate": 0.7, "source": 0.01 * U}
INPUTS = {"a": np.linspace(0.0, 1.0, 9), "b": np.cos(np.arange(108.0)).reshape(9, 12)}
CASES = {
    "one array": (one_array, U, 0.5, None),
    "tree": (tree, STATES, PARAMS, None),
    "inputs": (with_input, U, np.float64(0.5), INPUTS),
}
OPTIONS = [
    {},
    {"memory": 3000},
    {"memory": 800},
    {"keep": "all"},
    {"keep": [0, 4, 9], "memory": 3000},
    {"keep": lambda i, state: anp.sum(dp.flatten(state)[0] if i < 0 else np.ones(3)) * i},
    {"truncate": 4},
]


def total(result):
    leaves = []

    def visit(tree):
        if isinstance(tree, dict):
            for key in sorted(tree):
                visit(tree[key])
        elif isinstance(tree, tuple):
            for entry in tree:
                visit(entry)
        else:
            leaves.append(tree)

    visit(result)
    return sum(anp.sum((1.0 + 0.1 * k) * leaf**2) for k, leaf in enumerate(leaves))


def gradient(step, state, params, inputs, **options):
    def loss(x):
        state, params, inputs = x
        return total(dp.rollout(step, state, params, 9, inputs, **options))

    return dp.value_and_grad(loss)((state, params, inputs))


def assert_close(found, expected):
    found, _ = dp.flatten(found)
    expected, _ = dp.flatten(expected)
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14 * np.max(np.abs(expected)))


@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("options", OPTIONS, ids=["none", "much", "little", "all", "list", "function", "truncate"])
@pytest.mark.parametrize("case", CASES)
def test_values_and_gradients(case, options):
    step, state, params, inputs = CASES[case]
    if inputs is not None and options.get("memory") == 800:
        options = {"memory": 2500}  # the inputs take 1900 bytes
    jitted = dp.jit(step)
    for factor in (1.0, 0.5):
        arguments = [None if tree is None else scaled(tree, factor) for tree in (state, params, inputs)]
        plain_result = dp.rollout(step, arguments[0], arguments[1], 9, arguments[2], **options)
        result = dp.rollout(jitted, arguments[0], arguments[1], 9, arguments[2], **options)
        np.testing.assert_array_equal(dp.flatten(result)[0], dp.flatten(plain_result)[0])
        value, slopes = gradient(step, *arguments, **options)
        found, slopes_found = gradient(jitted, *arguments, **options)
        assert found == value
        assert_close(slopes_found, slopes)


def scaled(tree, factor):
    vector, build = dp.flatten(tree)
    return build(factor * vector)


@pytest.mark.parametrize("case", CASES)
def test_the_step_is_called_for_recordings_and_comparisons_only(case):
    step, state, params, inputs = CASES[case]
    calls = []

    def counted(*args):
        calls.append(None)
        return step(*args)

    jitted = dp.jit(counted)
    for _ in range(3):
        gradient(jitted, state, params, inputs)
        dp.rollout(jitted, state, params, 9, inputs)
    assert len(calls) == 4  # each of the two programs is recorded and compared once


def test_only_some_arguments_are_differentiated():
    for loss_of in (
        lambda step: lambda p: total(dp.rollout(step, STATES, {**PARAMS, "rate": p}, 5)),
        lambda step: lambda u: total(dp.rollout(step, {**STATES, "u": u * U}, PARAMS, 5)),
        lambda step: lambda u: dp.rollout(step, {**STATES, "u": u * U}, PARAMS, 5)["more"][0],
        lambda step: lambda u: dp.rollout(step, {**STATES, "u": u * U}, PARAMS, 0)["u"][1],
    ):
        for x in (0.3, 0.6):
            value, slope = dp.value_and_grad(loss_of(tree))(x)
            found, jitted_slope = dp.value_and_grad(loss_of(dp.jit(tree)))(x)
            assert found == value and jitted_slope == pytest.approx(slope, rel=1e-13)


def test_higher_order_and_forward_mode():
    def loss(p, step=one_array):
        return anp.sum(dp.rollout(step, U, p, 6) ** 2)

    jitted = dp.jit(one_array)
    assert dp.jvp(lambda p: loss(p, jitted), 0.5, 1.0)[1] == pytest.approx(dp.jvp(loss, 0.5, 1.0)[1], rel=1e-13)
    assert dp.hvp(lambda p: loss(p, jitted), 0.5, 1.0) == pytest.approx(dp.hvp(loss, 0.5, 1.0), rel=1e-12)


def test_a_rollout_inside_a_jitted_loss():
    def loss(x):
        end = dp.rollout(tree, {**STATES, "u": x["u"]}, {**PARAMS, "rate": x["rate"]}, 7, memory=2000)
        return total(end) + anp.sum(dp.rollout(one_array, x["u"], 0.3, 3, keep="all")[2])

    jitted = dp.jit(loss)
    for x in ({"u": U, "rate": 0.5}, {"u": 0.3 * U, "rate": 0.8}, {"u": -U, "rate": 0.1}):
        value, slopes = dp.value_and_grad(loss)(x)
        found, slopes_found = dp.value_and_grad(jitted)(x)
        assert jitted(x) == found == value
        assert_close(slopes_found, slopes)


def test_states_with_leaves_that_are_not_floating():
    def counted(state, p):
        u, i = state
        return u + 0.01 * i * p * L(u), i + 1

    value, slope = dp.value_and_grad(lambda p: anp.sum(dp.rollout(counted, (U, 0), p, 6)[0] ** 2))(0.5)
    found, jitted_slope = dp.value_and_grad(lambda p: anp.sum(dp.rollout(dp.jit(counted), (U, 0), p, 6)[0] ** 2))(0.5)
    assert found == value and jitted_slope == pytest.approx(slope, rel=1e-14)


def test_errors_name_the_step():
    jitted = dp.jit(lambda u, p: u * p * 1e200)
    with pytest.raises(dp.errors.NonFiniteError, match="state of step 1 of rollout needs a smaller time step"):
        dp.rollout(jitted, U + 2.0, 1.0, 5)
    with pytest.raises(dp.errors.ShapeError, match=r"state must keep its form: the step made shape \(6,\) of shape"):
        dp.rollout(dp.jit(lambda u, p: u[:6]), U, 1.0, 5)
    rng = np.random.default_rng(0)
    with pytest.raises(dp.errors.JitError, match="the program of .* differs from the function"):
        dp.rollout(dp.jit(lambda u, p: 0.5 * u + rng.random()), U, 1.0, 5)
