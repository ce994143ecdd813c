"""Derivatives of transport: Taylor rates, second order, what is not asked, repeated bits, plain forms of the step."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.advection.eulerian import Eulerian
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad
from sparsedp.errors import DerivativeError

RNG = np.random.default_rng(0)
GRIDS = {
    "1-D": dp.Grid(12, spacing=RNG.uniform(0.5, 1.5, 12)),
    "2-D": dp.Grid((5, 4), size=3.0, periodic=(False, True)),
    "3-D": dp.Grid((3, 2, 4), size=2.0, periodic=(True, False, False)),
}
FORMS = list(product(("faces", "cells"), ("flux", "advective")))


def scene(scheme, grid, velocity, form, of="cells", **options):
    """Return a transport, its arguments and a loss of all four."""
    rng = np.random.default_rng(1)
    move = dp.transport(grid, scheme, dp.dirichlet, velocity, of, form=form, **options)
    shape = move.settings.velocity_shapes[0]
    # Means of cells of both signs could be close to 0, where there is a kink.
    signs = (
        rng.choice([-1, 1], shape)
        if velocity == "faces"
        else (-1.0) ** np.arange(len(shape) - 1).reshape(-1, *[1] * (len(shape) - 1))
    )
    args = {
        "u": rng.normal(size=move.space.shape),
        "v": rng.uniform(0.2, 1, shape) * signs,
        "dt": 0.02,
        "inflow": rng.normal(size=move.walls.shape),
    }
    weights = rng.uniform(0.5, 1.5, move.space.shape)

    def loss(p):
        u = move(p["u"], p["v"], p["dt"], p["inflow"])
        return anp.sum(weights * move(u, p["v"], p["dt"], p["inflow"]) ** 2)

    return move, args, loss


@pytest.mark.sampled
@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("velocity, form", FORMS)
@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
def test_taylor(scheme, velocity, form, name):
    _, args, loss = scene(scheme, GRIDS[name], velocity, form)
    result = dp.check.gradient(loss, args, directions=1)
    assert result.verdict == "agrees", str(result)


@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
@pytest.mark.parametrize("number", ["u", "v", "dt", "inflow"])
def test_taylor_in_each_argument(scheme, number):
    _, args, loss = scene(scheme, GRIDS["2-D"], "faces", "flux", of="faces")
    result = dp.check.gradient(lambda x: loss({**args, number: x}), args[number], directions=1)
    assert result.verdict == "agrees", str(result)


def moved(args, along, h):
    return {name: args[name] + h * along[name] for name in args}


def rates(values, steps):
    return np.diff(np.log(np.abs(values))) / np.diff(np.log(steps))


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("velocity, form", FORMS)
def test_hessian_of_upwind(velocity, form, name):
    """Remainder of order 3 with it, 2 without; every mode of second order agrees."""
    _, args, loss = scene("upwind", GRIDS[name], velocity, form)
    rng = np.random.default_rng(2)
    along = {key: rng.normal(size=np.shape(x))[()] * (0.1 if key != "dt" else 0.01) for key, x in args.items()}
    dot = lambda a, b: sum(anp.sum(a[key] * b[key]) for key in a)
    gradient = lambda p: value_and_grad(loss)(p)[1]
    value, g = value_and_grad(loss)(args)
    forward_over_reverse = pushforward(gradient, args, along)[1]
    reverse_over_reverse = value_and_grad(lambda p: dot(gradient(p), along))(args)[1]
    reverse_over_forward = value_and_grad(lambda p: pushforward(loss, p, along)[1])(args)[1]
    for key in args:
        scale = np.max(np.abs(forward_over_reverse[key]), initial=1.0)
        for other in (reverse_over_reverse, reverse_over_forward):
            np.testing.assert_allclose(other[key], forward_over_reverse[key], rtol=0, atol=1e-12 * scale)
    steps = np.array([0.2, 0.1, 0.05])
    curved = dot(forward_over_reverse, along)
    rest = [loss(moved(args, along, h)) - value - h * dot(g, along) for h in steps]
    assert np.all(rates(rest, steps) >= 1.9)
    assert np.all(rates([r - h * h / 2 * curved for r, h in zip(rest, steps)], steps) >= 2.9)


def test_second_order_of_van_leer_is_refused():
    move, args, loss = scene("van_leer", GRIDS["1-D"], "faces", "flux")
    slope = lambda u: anp.sum(value_and_grad(lambda u: loss({**args, "u": u}))(u)[1] ** 2)
    with pytest.raises(DerivativeError, match="transport van_leer has first derivatives only; for second ones write"):
        value_and_grad(slope)(args["u"])
    with pytest.raises(DerivativeError, match="transport van_leer has first derivatives only; for second ones write"):
        pushforward(lambda u: value_and_grad(lambda u: loss({**args, "u": u}))(u)[1], args["u"], args["u"])


def test_operator_agrees_with_the_step_of_linear_schemes():
    for grid, (velocity, form), of in product(GRIDS.values(), FORMS, ("cells", "faces")):
        move, args, _ = scene("upwind", grid, velocity, form, of)
        op = move.operator(args["v"], args["dt"])
        assert op.form == "explicit" and op.matrix.indices.dtype == np.int32
        np.testing.assert_allclose(op(args["u"]), move(args["u"], args["v"], args["dt"]), rtol=0, atol=1e-14)
    move, args, _ = scene("van_leer", grid, velocity, form)
    with pytest.raises(ValueError, match="transport van_leer is not linear in u and has no matrix; write scheme="):
        move.operator(args["v"], 0.1)


# ---- what is computed -----------------------------------------------------------------------------------------------


def test_only_requested_cotangents_are_computed(monkeypatch):
    move, args, loss = scene("upwind", GRIDS["2-D"], "faces", "flux")
    asked = []
    pull = Eulerian.vjp
    spy = lambda self, nums, *rest, **more: asked.append(nums) or pull(self, nums, *rest, **more)
    monkeypatch.setattr(Eulerian, "vjp", spy)
    for name, number in (("u", (0,)), ("v", (1,)), ("dt", (1,)), ("inflow", (3,))):  # of dt by way of v
        asked.clear()
        value_and_grad(lambda x: squares(move, {**args, name: x}))(args[name])
        assert asked == [number]
    asked.clear()
    value_and_grad(loss)(args)
    assert [set(nums) for nums in asked] == [{0, 1, 3}] * 2


def squares(move, args):
    return anp.sum(move(args["u"], args["v"], args["dt"], args["inflow"]) ** 2)


def test_each_step_is_one_rule():
    move, args, loss = scene("upwind", GRIDS["2-D"], "faces", "flux")
    with recording() as counts:
        value_and_grad(loss)(args)
    assert counts["transport upwind", "forward"] == 2 and counts["transport upwind", "vjp"] == 2


@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
def test_gradients_are_reproducible(scheme):
    _, args, loss = scene(scheme, GRIDS["3-D"], "faces", "flux")
    first, second = (value_and_grad(loss)(args)[1] for _ in range(2))
    for name in args:
        np.testing.assert_array_equal(first[name], second[name])


@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
@pytest.mark.parametrize("velocity", ["faces", "cells"])
def test_gradient_in_a_velocity_shared_by_steps(scheme, velocity):
    """Its cotangents are summed in one array; the result equals the sum of separate gradients."""
    move, args = scene(scheme, GRIDS["2-D"], velocity, "advective")[:2]
    u, v, dt, inflow = args.values()
    weight = RNG.normal(size=v.shape)

    def loss(vs):
        a, b, c, d, e = vs
        first = move(move(u, a, dt, inflow), b, dt, inflow)
        double = c + c  # autograd hands one array to both
        second = move(move(first, double, dt, inflow), double, dt, inflow)
        return anp.sum(move(second, d, dt, inflow) ** 2) + anp.sum(weight * e) + anp.sum(a * weight * d)

    v = 0.5 * v
    slopes = dp.grad(loss)((v,) * 5)
    wanted = sum(slopes)
    for single in (loss, lambda vs: dp.rollout(lambda s, p: s + loss(p), 0.0, vs, 1)):
        found = dp.grad(lambda v, f=single: f((v,) * 5))
        for _ in range(2):
            np.testing.assert_allclose(found(v), wanted, rtol=1e-13, atol=1e-14 * np.max(np.abs(wanted)))
    along = RNG.normal(size=v.shape)
    assert np.isclose(dp.jvp(lambda v: loss((v,) * 5), v, along)[1], np.sum(wanted * along), rtol=1e-12)
    if scheme == "upwind":
        twice = dp.jvp(dp.grad(lambda v: loss((v,) * 5)), v, along)[1]
        apart = dp.jvp(dp.grad(loss), (v,) * 5, (along,) * 5)[1]
        np.testing.assert_allclose(twice, sum(apart), rtol=1e-12, atol=1e-13 * np.max(np.abs(twice)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_field_that_is_its_own_velocity(dtype):
    """Field and velocity are the same array, whose two cotangents are added."""
    grid = dp.Grid(12, periodic=True)
    move = dp.transport(grid, "upwind", velocity="cells")
    u = RNG.uniform(0.5, 1, 12).astype(dtype)

    def run(u, w):
        for _ in range(3):
            u = move(u, w, 0.1)
            w = w
        return anp.sum(move(u, u, 0.1) * anp.sin(u)) + anp.sum(w**3)

    slopes = dp.grad(lambda pair: run(*pair))((u, u))
    found = dp.grad(lambda u: run(u, u))(u)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, sum(slopes), rtol=20 * np.finfo(dtype).eps, atol=20 * np.finfo(dtype).eps)


def test_inflow_as_one_number_gets_the_sum():
    move, args, _ = scene("upwind", GRIDS["2-D"], "faces", "flux")
    f = lambda q: anp.sum(move(args["u"], args["v"], args["dt"], q) ** 2)
    each = value_and_grad(f)(np.full(move.walls.size, 0.7))
    whole = value_and_grad(f)(0.7)
    assert whole == pytest.approx((each[0], np.sum(each[1])), rel=1e-13)


@pytest.mark.parametrize("velocity", ["faces", "cells"])
@pytest.mark.parametrize("kink", ["rest", "some"])
def test_kinks_get_the_mean_of_both_sides(velocity, kink):
    """At v = 0 the derivative equals the central difference."""
    grid = dp.Grid((5, 4), size=1.0)
    move = dp.transport(grid, boundary=dp.dirichlet, velocity=velocity)
    rng = np.random.default_rng(3)
    u = rng.normal(size=grid.shape)
    shape = move.settings.velocity_shapes[0]
    q = rng.normal(size=18)
    v = np.zeros(shape) if kink == "rest" else np.where(rng.random(shape) < 0.5, 0.0, rng.normal(size=shape))
    g = rng.normal(size=grid.shape)
    loss = lambda v: anp.sum(g * move(u, v, 0.01, q))
    slope = value_and_grad(loss)(v)[1]
    h = 2.0**-20
    for index in np.ndindex(shape):
        unit = np.zeros(shape)
        unit[index] = h
        assert slope[index] == pytest.approx((loss(v + unit) - loss(v - unit)) / (2 * h), abs=1e-8)


# ---- constants of a step --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["upwind", "van_leer", "semi_lagrangian", "maccormack", "convection"])
def test_an_array_may_be_reused_before_the_pullback(scheme):
    """Constants on the tape keep the values that they had when the step was evaluated."""
    grid = dp.Grid((5, 4), size=1.0, periodic=(True, False))
    carry = dp.convection(grid) if scheme == "convection" else dp.transport(grid, scheme, dp.dirichlet, of="faces")
    buffers = [np.cos(np.arange(float(grid.faces.size))), 0.3 * np.sin(np.arange(float(grid.faces.size)))]
    for number in (0, 1):
        others = [buffer.copy() for buffer in buffers]

        def moved(x, others=others, number=number):
            args = [x if place == number else value for place, value in enumerate(others)]
            if scheme == "convection":
                return carry(*args)
            return carry(*args, 0.1)

        wanted = pullback(moved, buffers[number])[1](buffers[0])
        pull = pullback(moved, buffers[number])[1]
        others[1 - number][:] = 0.01
        assert np.array_equal(pull(buffers[0]), wanted)
