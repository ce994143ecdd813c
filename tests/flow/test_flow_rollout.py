"""Scenes of flow_step in a rollout, against the same steps in a loop."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import pullback

BLOCK = np.zeros((8, 6), bool)
BLOCK[3:5, 2:4] = True
CHANNEL = {"x": (dp.inflow, dp.outflow), "y": (dp.free_slip, dp.no_slip)}
UNEVEN = [np.linspace(0.1, 0.2, 8), np.full(6, 0.15)]


def pushes(v, params):
    return params["push"] * anp.sin(v)


SCENES = {
    "inviscid": {},
    "stokes": dict(convective=False, viscosity=0.01),
    "nothing but pressure": dict(convective=False),
    "explicit": dict(viscosity=0.01),
    "implicit": dict(viscosity=0.5, implicit=True),
    "forced": dict(viscosity=0.01, force=pushes),
    "viscosity of params": dict(viscosity=lambda params: params["nu"] ** 2, force=pushes),
    "viscosity of nothing": dict(viscosity=lambda params: 0.01),
    "moving walls": dict(viscosity=0.01, walls=True),
    "implicit, moving walls": dict(viscosity=0.5, implicit=True, walls=True),
    "solid": dict(viscosity=0.01, solid=BLOCK),
    "channel": dict(viscosity=0.01, boundary=CHANNEL, force=pushes),
    "channel, solid, stretched": dict(viscosity=0.001, boundary=CHANNEL, solid=BLOCK, spacing=UNEVEN),
    "periodic": dict(viscosity=0.01, periodic=True),
    "three axes": dict(viscosity=0.01, shape=(4, 3, 5), force=pushes),
}


def scene(shape=(8, 6), spacing=0.2, periodic=False, walls=None, dtype=float, **options):
    grid = dp.Grid(shape, spacing=spacing, periodic=periodic)
    if walls:
        lid = dp.face_lift(grid)
        walls = lid(np.linspace(0.0, 1.0, lid.domain.size))
    step = dp.flow_step(grid, 0.05, walls=walls, **options)
    rng = np.random.default_rng(3)
    v, p, a = (rng.standard_normal(n).astype(dtype) for n in (grid.faces.size, grid.cells.size, grid.faces.size))
    state = {"v": dp.projection(grid, options.get("solid"))(0.3 * v), "p": p.reshape(grid.shape), "a": 0.3 * a}
    return step, state, {"push": np.ones(1, dtype), "nu": 0.1, "name": "ink", "count": 3}


@pytest.mark.parametrize("name", SCENES)
def test_rollout_agrees_with_a_loop(name):
    step, state, params = scene(**SCENES[name])
    weights = np.random.default_rng(5).standard_normal(state["v"].size)

    def loss(x, go):
        end = go(*x)
        return anp.sum(weights * end["v"]) + anp.sum(anp.sin(end["p"])) + anp.sum(end["a"] ** 2)

    def loop(state, params):
        for _ in range(3):
            state = step(state, params)
        return state

    known, wanted = dp.value_and_grad(lambda x: loss(x, loop))((state, params))
    value, slopes = dp.value_and_grad(lambda x: loss(x, lambda *s: dp.rollout(step, *s, 3)))((state, params))
    assert value == known
    for one, other in zip(leaves(slopes), leaves(wanted), strict=True):
        assert one is other is None or np.linalg.norm(one - other) <= 1e-10 * (np.linalg.norm(other) + 1e-3)


def test_one_solve_each_way_and_single_precision():
    step, state, params = scene(**SCENES["forced"])
    flat = lambda x: anp.concatenate([anp.ravel(part) for part in step(*x).values()])
    with recording() as calls:
        new, pull = pullback(flat, (state, params))
        back, slopes = pull(new)
    assert calls["pressure solve", "solve"] == calls["pressure solve", "adjoint"] == 1
    again, _ = pullback(flat, (state, params))[1](new)  # recordings change no bit
    assert sorted(slopes) == sorted(params) and np.array_equal(back["v"], again["v"])
    step, state, _ = scene(**SCENES["explicit"], dtype=np.float32)
    single = dp.rollout(step, state, None, 2)
    slope = dp.value_and_grad(lambda s: anp.sum(dp.rollout(step, s, None, 2)["v"] ** 2))(state)[1]
    assert {leaf.dtype for tree in (single, slope) for leaf in leaves(tree)} == {np.dtype(np.float32)}


def test_second_order():
    step, state, params = scene(**SCENES["viscosity of params"])
    assert (
        dp.check.gradient(lambda nu: anp.sum(dp.rollout(step, state, {**params, "nu": nu}, 3)["v"] ** 2), 0.1).verdict
        == "agrees"
    )
    energy = lambda v, go: anp.sum(go(step, {**state, "v": v}, params, 2)["v"] ** 3)
    along = np.cos(np.arange(state["v"].size))
    once = lambda go: lambda v: anp.sum(along * dp.value_and_grad(lambda u: energy(u, go))(v)[1])
    twice = lambda go: dp.value_and_grad(once(go))(state["v"])[1]
    two = lambda step, s, p, n: step(step(s, p), p)
    np.testing.assert_allclose(twice(dp.rollout), twice(two), rtol=1e-9, atol=1e-9)
