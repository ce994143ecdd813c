"""Steps of transport in a rollout, and steps that share a tape: each against single steps, by bits."""

import autograd
import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import pullback
from sparsedp.errors import DerivativeError, NonFiniteError, UnstableStepError

N = 20
RNG = np.random.default_rng(3)
SCENES = {  # grid, arguments of transport, inflow
    "ring": (dp.Grid(9, periodic=True), {}, 0.0),
    "cells": (dp.Grid(7, periodic=True), {"velocity": "cells"}, 0.0),
    "walls": (dp.Grid((5, 4)), {}, 0.0),
    "inflow": (dp.Grid((5, 4), periodic=(True, False)), {"boundary": dp.dirichlet}, 0.7),
    "faces": (dp.Grid((4, 5)), {"of": "faces"}, 0.0),
    "solid": (dp.Grid((4, 5)), {"solid": np.eye(4, 5, dtype=bool)}, 0.0),
    "box": (dp.Grid((3, 4, 2), periodic=(False, True, False)), {"velocity": "cells", "form": "flux"}, 0.0),
    "van_leer": (dp.Grid((5, 4)), {"scheme": "van_leer"}, 0.0),
    "semi_lagrangian": (dp.Grid((5, 4)), {"scheme": "semi_lagrangian", "boundary": dp.dirichlet}, 0.3),
    "maccormack": (dp.Grid(9, periodic=True), {"scheme": "maccormack", "backtrace": "midpoint", "clamp": False}, 0.0),
}


def scene(name):
    grid, options, inflow = SCENES[name]
    move = dp.transport(grid, **options)
    u = RNG.standard_normal(move.space.shape)
    v = 0.4 * RNG.standard_normal(move.settings.velocity_shapes[0])
    return (lambda u, v: move(u, v, 0.15, inflow)), u, v, RNG.standard_normal(u.shape)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("wanted", ["u and v", "u", "v"])
def test_steps_of_transport_in_a_rollout_have_the_bits_of_a_budget_and_the_values_of_a_loop(name, wanted):
    step, u, v, weights = scene(name)

    def loss(x, **options):
        a = x.get("u", u)
        b = x.get("v", v)
        end = dp.rollout(step, a, b, N, **options)
        return anp.sum(weights * end * end)  # in NumPy 1.26 the bits of a power are others on a tape

    x = {"u": {"u": u}, "v": {"v": v}}.get(wanted, {"u": u, "v": v})
    value, g = dp.value_and_grad(loss)(x)
    assert value == loss(x)
    for options in ({"keep": "last"}, {"memory": 7 * u.nbytes + 2 * v.nbytes}):
        other, h = dp.value_and_grad(lambda x, options=options: loss(x, **options))(x)
        assert value == other
        assert all(np.array_equal(g[key], h[key]) for key in g)
    taped = dp.value_and_grad(lambda x: anp.sum(weights * _by_hand(step, x.get("u", u), x.get("v", v)) ** 2))(x)[1]
    assert all(np.max(np.abs(g[key] - taped[key])) <= 1e-12 * np.max(np.abs(taped[key])) for key in g)


def _by_hand(step, u, v):
    for _ in range(N):
        u = step(u, v)
    return u


def test_records_and_cuts_of_steps_of_transport():
    step, u, v, weights = scene("ring")
    states = dp.rollout(step, u, v, N, keep="all")
    assert np.array_equal(states[-1], dp.rollout(step, u, v, N))
    assert np.array_equal(dp.rollout(step, u, v, 0), u)
    cut = dp.value_and_grad(lambda u: anp.sum(weights * dp.rollout(step, u, v, N, truncate=N)))(u)[1]
    full = dp.value_and_grad(lambda u: anp.sum(weights * dp.rollout(step, u, v, N)))(u)[1]
    assert np.array_equal(cut, full)
    runs = []
    dp.value_and_grad(lambda u: anp.sum(weights * dp.rollout(step, u, v, N, record=runs.append)))(u)
    assert [run.direction for run in runs] == ["forward", "backward"]
    assert [i for i, _ in runs[1].norms] == [20, 16, 0] and runs[1].kept == N


def test_second_derivatives_and_tangents_pass_through_the_loop():
    step, u, v, weights = scene("ring")

    def loss(u, v):
        return anp.sum(weights * dp.rollout(step, u, v, 4) ** 2)

    d = RNG.standard_normal(u.shape)
    product = autograd.grad(lambda u: anp.sum(d * autograd.grad(loss)(u, v)))(u)
    h = 1e-6
    difference = (autograd.grad(loss)(u + h * d, v) - autograd.grad(loss)(u - h * d, v)) / (2 * h)
    assert np.max(np.abs(product - difference)) <= 1e-8 * np.max(np.abs(product))


def test_single_precision_and_other_kinds_take_the_way_by_single_steps():
    step, u, v, _ = scene("ring")
    value = dp.rollout(step, u.astype("f"), v, N)
    assert value.dtype == np.float32 and np.max(np.abs(value - dp.rollout(step, u, v, N))) < 1e-5
    assert np.max(np.abs(dp.rollout(step, u, v.astype("f"), N) - dp.rollout(step, u, v, N))) < 1e-5


def test_the_loop_stops_at_the_step_that_goes_wrong():
    move = dp.transport(dp.Grid(8, periodic=True))
    u = np.arange(8.0)
    v = np.full(8, 1.5)
    with pytest.raises(UnstableStepError, match="dt = 1 is too large at 8 of 8 points"):
        dp.rollout(lambda u, v: move(u, v, 1.0), u, v, 5)
    with pytest.raises(NonFiniteError, match="cannot represent the result"):
        bold = dp.transport(dp.Grid(8, periodic=True), unstable="allow")
        dp.rollout(lambda u, v: bold(u, v, 1e30), np.cos(np.arange(8.0)), v, 40)
    with pytest.raises(NonFiniteError, match="finite inflow"):
        open_ = dp.transport(dp.Grid(4), boundary=dp.dirichlet)
        dp.rollout(lambda u, v: open_(u, v, 0.1, np.array([np.nan, 0.0])), u[:4], np.ones(5), 3)
    bold = dp.transport(dp.Grid(8, periodic=True), unstable="allow")
    sawtooth = dp.rollout(lambda u, v: bold(u, v, 1.0), np.tile([1.0, -1.0], 4), v, 3)
    assert np.allclose(sawtooth, -8 * np.tile([1.0, -1.0], 4))  # grows by exactly 2 a step


# ---------------------------------------------------------------- steps on one tape

WHERE = np.linspace(0.0, 1.0, 6)
NUMBERS = 0.1 * np.arange(6.0)


def bend(u, p):
    return 0.9 * u + 0.1 * anp.sin(p["rate"] * u) * anp.roll(u, 1) + p["shift"] * anp.cos(u) * u


def now_and_then(u, p):
    """Every few steps a result that is no contiguous array of its own."""
    return (bend(u, p)[::-1] if plain_sum(u) > 1.0 else bend(u, p)) * 1.0


def turned(u, p):
    return anp.concatenate([bend(u, p)[3:], u[:3]])[::-1]


def plain_sum(u):
    return float(np.sum(getattr(u, "_value", u)))


def forgetful(u, p):
    """A state that depends on params only, wherever the one before is large."""
    if plain_sum(u) > 2.0:
        return p["rate"] * NUMBERS
    return bend(u, p) + 0.5


def constant(u, p):
    if plain_sum(u) > 2.0:
        return np.cos(NUMBERS)
    return bend(u, p) + 0.5


STEPS = {f.__name__: f for f in (bend, now_and_then, turned, forgetful, constant)}


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize("n", [1, 2, 9, 40])
def test_linked_steps_have_the_bits_of_single_steps(name, n):
    def loss(x, **options):
        u = x.get("u", WHERE)
        p = {"rate": x.get("rate", 0.7), "shift": x.get("shift", NUMBERS), "flag": None}
        end = dp.rollout(STEPS[name], u, p, n, **options)
        return anp.sum(NUMBERS * end * end)

    for x in ({"u": WHERE}, {"rate": 0.7, "shift": NUMBERS}, {"u": WHERE, "rate": 0.7, "shift": NUMBERS}):
        free = []
        tight = []
        value, g = dp.value_and_grad(lambda x, free=free: loss(x, record=free.append))(x)
        other, h = dp.value_and_grad(lambda x, tight=tight: loss(x, memory=1200, record=tight.append))(x)
        assert value == other == loss(x)
        assert all(np.array_equal(g[key], h[key]) for key in g)
        assert free[-1].norms == tight[-1].norms and (tight[-1].kept < n or n < 40)


@pytest.mark.parametrize("step", [lambda u, p: (u + p).T, lambda u, p: u + 1.0, lambda u, p: np.cos(NUMBERS) + 0 * p])
def test_a_step_that_cannot_be_linked_is_not_run_twice(step):
    calls = []
    counted = lambda u, p: (calls.append(0), step(u, p))[1]
    dp.value_and_grad(lambda p: anp.sum(dp.rollout(counted, WHERE, p, 12)))(0.3)
    assert len(calls) == 12


def test_a_linked_step_that_keeps_a_traced_value_is_refused():
    seen = []

    def step(u, p):
        seen.append(p * u)
        return u + p * u + (seen[0] if len(seen) == 6 else 0.0)

    with pytest.raises(
        DerivativeError,
        match="the step uses a traced value that is not one of its arguments, and its derivative would be lost; pass "
        "it in params or make it a part of the state",
    ):
        dp.value_and_grad(lambda p: anp.sum(dp.rollout(step, WHERE, p, 12)))(0.3)


def test_a_linked_step_with_a_rule_that_writes_into_the_state_is_refused():
    def double(u):
        u *= 2.0
        return u.copy()

    rule = dp.differentiable("double", double, lambda nums, ans, u: lambda g: (2.0 * g,))

    def step(state, p):
        u, i = state
        return (anp.sin(rule(u) * u * p) if i == 3 else u + p * u), i + 1

    with pytest.raises(ValueError, match=r"^the step changes state\[0\] in place; write u = u \+ du"):
        dp.value_and_grad(lambda p: anp.sum(dp.rollout(step, (WHERE, 0), p, 4)[0]))(0.3)


def test_a_linked_step_that_reuses_an_array_is_run_again():
    room = np.zeros(6)

    def step(u, p):
        room[:] = getattr(p, "_value", p) * NUMBERS  # an array of the step's own, another one for other params
        room[0] += plain_sum(u)
        return u * room + p * u

    slope = dp.value_and_grad(lambda p: anp.sum(dp.rollout(step, WHERE, p, 12)))(0.3)[1]
    fresh = lambda u, p: u * (plain_sum(p) * NUMBERS + plain_sum(u) * (np.arange(6) == 0)) + p * u
    known = WHERE
    loss = lambda p: anp.sum(_chain(fresh, known, p, 12))
    assert slope == pytest.approx(dp.value_and_grad(loss)(0.3)[1], rel=1e-12)


def _chain(step, u, p, n):
    for _ in range(n):
        u = step(u, p)
    return u


def test_two_pullbacks_of_one_linked_run():
    value, pull = pullback(lambda x: dp.rollout(lambda u, p: u + p * anp.sin(u), x[0], x[1], 20), (WHERE, NUMBERS))
    first = pull(np.ones(6))
    second = pull(2 * np.ones(6))
    assert all(np.array_equal(2 * a, b) for a, b in zip(first, second, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(first, pull(np.ones(6)), strict=True))
