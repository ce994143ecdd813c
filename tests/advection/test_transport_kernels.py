"""The loops of Eulerian transport against sparse matrices, and bits that do not depend on the number of threads."""

from functools import cache
from itertools import product

import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels
from sparsedp._utils import buffers as memory
from sparsedp.autodiff.derivative import pullback
from sparsedp.kernels import fluxes, team
from sparsedp.kernels.fluxes import TILE

NUMBA = pytest.mark.skipif(not kernels.compiled(), reason="numba is not installed")
SHAPES = [(1,), (3,), (2 * TILE + 5,), (1, 9), (9, 1), (3, TILE + 20), (11, 13), (4, 5, 6), (2, 1, 19)]
FORMS = list(product(("faces", "cells"), ("flux", "advective")))


def scenes():
    rng = np.random.default_rng(0)
    for turn, (scheme, shape, (velocity, form)) in enumerate(product(("upwind", "van_leer"), SHAPES, FORMS)):
        widths = [rng.uniform(0.5, 1.5, n) for n in shape] if turn % 2 else 0.5
        grid = dp.Grid(shape, spacing=widths, periodic=tuple(rng.random(len(shape)) < 0.5))
        solid = rng.random(shape) < 0.2 if turn % 3 == 0 else None
        of = "faces" if turn % 5 == 0 else "cells"
        move = dp.transport(grid, scheme, dp.dirichlet, velocity, of, form=form, solid=solid)
        v = np.where(
            rng.random(move.settings.velocity_shapes[0]) < 0.1, 0.0, rng.normal(size=move.settings.velocity_shapes[0])
        )
        yield move, rng.normal(size=move.space.shape), v, rng.normal(size=move.walls.shape)


def results(move, u, v, q):
    """Return the result and all cotangents of the plain functions."""
    law = move.method
    args = (u.ravel(), v.ravel(), 0.01, q)
    new = law.forward(*args)
    g = np.cos(np.arange(new.size))
    tasks = ((0, 1, 3), (0,), (1,), (3,))
    return [new, *(np.ravel(x) for nums in tasks for x in law.vjp(nums, g, *args)[0])]


@NUMBA
def test_compiled_loops_agree_with_the_reference(monkeypatch):
    for scene in scenes():
        compiled = results(*scene)
        with monkeypatch.context() as patch:
            patch.setattr(kernels, "compiled", lambda: False)
            plain = results(*scene)
        for one, other in zip(compiled, plain):
            np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13)


@NUMBA
def test_bits_do_not_depend_on_threads(monkeypatch):
    monkeypatch.setattr(team, "SERIAL", 0)
    for scene in scenes():
        found = []
        for threads in (1, 2, 3):
            monkeypatch.setattr(kernels, "threads", lambda: threads)
            found.append([x.tobytes() for x in results(*scene)])
        assert found[0] == found[1] == found[2]


@NUMBA
def test_fallback_when_compilation_fails(monkeypatch):
    def refuse(words):
        raise TypeError("no such target")

    move, u, v, q = next(scenes())
    wanted = move(u, v, 0.01, q)
    broken = team.Kernel(fluxes.stage.loop, fluxes.stage.words)
    monkeypatch.setattr(fluxes, "stage", broken)
    with monkeypatch.context() as patch:
        patch.setattr(team, "_types", refuse)
        with pytest.warns(RuntimeWarning, match="The compiled kernels do not work here .no such target"):
            new = move(u, v, 0.01, q)
    np.testing.assert_allclose(new, wanted, rtol=1e-14)


def test_separate_cotangents_are_bit_equal():
    for move, u, v, q in scenes():
        _, *all_three, field, velocity, inflow = results(move, u, v, q)
        np.testing.assert_array_equal(field, all_three[0])
        np.testing.assert_array_equal(velocity, all_three[1])
        np.testing.assert_array_equal(inflow, all_three[2])


def test_a_short_last_axis():
    """A grid with few cells along its last axis."""
    grid = dp.Grid((3000, 2), size=1.0)
    move = dp.transport(grid)
    rng = np.random.default_rng(1)
    u = rng.random(grid.shape)
    v = rng.normal(size=grid.faces.size)
    np.testing.assert_allclose(move(u, v, 1e-5), move.operator(v, 1e-5)(u), rtol=1e-13)


def minmod(a, b, c, e):
    """Return half of the smaller of both differences (minmod); for equal cells."""
    low = np.abs(a) <= np.abs(b)
    same = a * b > 0
    slope = 0.5 * (low * a + (1.0 - low) * b) * same
    return slope, slope, 0.5 * low * same, 0.5 * (1.0 - low) * same, 0.5 * low * same, 0.5 * (1.0 - low) * same


def parabola(a, b, c, e):
    """Third-order upwind on equal cells: the sides of a cell differ, and so do the slopes."""
    one = 0.0 * a + 1.0
    return (a + 2 * b) / 6, (2 * a + b) / 6, one / 6, one / 3, one / 3, one / 6


@cache
def loop_of(limiter):
    """Return the compiled slope loop of a limiter, cached for all tests."""
    return fluxes.slope_loop("other", limiter, cache=False)


@pytest.mark.whole
@pytest.mark.parametrize("limiter", [minmod, parabola])
@pytest.mark.parametrize("velocity, form", FORMS)
def test_custom_limiters(limiter, velocity, form, monkeypatch):
    """A limiter function and an entry of SCHEMES give the loops, the tangent and the cotangents."""
    scheme = fluxes.Scheme(limiter, (0.0, 0.75, 1 / 3), 1.0, limiter is minmod)
    monkeypatch.setitem(fluxes.SCHEMES, "van_leer", scheme)
    monkeypatch.setitem(fluxes.slope_loops, "van_leer", loop_of(limiter))
    rng = np.random.default_rng(5)
    solid = np.zeros((7, 6), bool)
    solid[3, 3] = True
    for grid, obstacle in ((dp.Grid((7, 6), size=2.0, periodic=(True, False)), solid), (dp.Grid(9, spacing=0.3), None)):
        move = dp.transport(grid, "van_leer", dp.dirichlet, velocity, form=form, solid=obstacle)
        v = rng.normal(size=move.settings.velocity_shapes[0])
        scene = move, rng.normal(size=move.space.shape), v, rng.normal(size=move.walls.shape)
        found = results(*scene)
        law = move.method
        with monkeypatch.context() as patch:
            patch.setattr(kernels, "compiled", lambda: False)
            for one, other in zip(found, results(*scene)):
                np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13)
        u, v, q = (x.ravel() for x in scene[1:])
        along = {n: rng.normal(size=x.size) for n, x in ((0, u), (1, v), (3, q))}
        g = rng.normal(size=u.size)
        back = dict(zip(along, law.vjp(tuple(along), g, u, v, 0.01, q)[0]))
        ahead = law.jvp(along, u, v, 0.01, q)
        np.testing.assert_allclose(g @ ahead, sum(along[n] @ back[n] for n in along), rtol=1e-12)


@NUMBA
def test_recycled_buffers_do_not_change_results():
    grid = dp.Grid((200, 190), size=1.0)
    move = dp.transport(grid, "van_leer")
    rng = np.random.default_rng(2)
    u = rng.normal(size=grid.shape)
    v = 0.02 * rng.normal(size=grid.faces.size)
    q = rng.normal(size=move.walls.size)
    first = [x.tobytes() for x in results(move, u, v, q)]
    for spare in memory._free.values():
        spare[: spare.size // 8 * 8].view(float)[:] = np.nan
    assert memory._free and first == [x.tobytes() for x in results(move, u, v, q)]


def test_cotangents_need_not_be_contiguous():
    for scheme in ("upwind", "van_leer", "semi_lagrangian", "maccormack"):
        move = dp.transport(dp.Grid(8, periodic=True), scheme)
        rng = np.random.default_rng(0)
        u = rng.random(8)
        v = rng.normal(size=8)
        g = rng.normal(size=16)
        _, pull = pullback(lambda x, move=move, v=v: move(x, v, 0.1), u)
        for strided in (g[::2], g[7::-1], np.broadcast_to(1.5, (8,))):
            np.testing.assert_array_equal(pull(strided), pull(strided.copy()))
