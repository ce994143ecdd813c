"""Rule.bound of transport: a function for arguments of one form, with the bits of `forward` and the same checks."""

import pickle

import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels
from sparsedp.autodiff.tape import MOST_BOUND, Rule

SCHEMES = ["upwind", "van_leer", "semi_lagrangian", "maccormack"]
GRIDS = [
    dp.Grid(9, size=1.0, periodic=True),
    dp.Grid((5, 4), size=1.0),
    dp.Grid((3, 4, 3), periodic=(True, False, True)),
]


def arguments(move, rng, inflow=0.3):
    u = rng.standard_normal(move.space.shape)
    v = 0.1 * rng.standard_normal(move.settings.velocity_shapes[0])
    return u, v, 0.05, inflow


@pytest.mark.parametrize("grid", GRIDS, ids=str)
@pytest.mark.parametrize("of", ["cells", "faces"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_same_bits(scheme, of, grid, rng):
    move = dp.transport(grid, scheme, dp.dirichlet, velocity="cells", of=of)
    rule = move._rule
    args = arguments(move, rng)
    walls = rng.standard_normal(move.walls.shape)
    for values in (args, (*args[:3], walls)):
        bound = rule.bound(*values)
        wanted = rule.forward(*values)
        assert bound(*values).tobytes() == rule(*values).tobytes() == wanted.tobytes()
        assert rule.bound(*(np.copy(x) if np.ndim(x) else x for x in values)) is bound


@pytest.mark.parametrize("scheme", SCHEMES)
def test_cotangents_do_not_depend_on_the_layout_of_arguments(scheme, rng):
    """Strided arguments are flattened with all checks, contiguous ones by the bound function."""
    move = dp.transport(GRIDS[1], scheme, velocity="cells")
    u, v, dt, inflow = arguments(move, rng)
    g = rng.standard_normal(u.shape)
    nums = (0, 1, 2, 3)
    wanted = move._rule.vjp(nums, None, u, v, dt, inflow)(g)
    found = move._rule.vjp(nums, None, np.asfortranarray(u), np.asfortranarray(v), dt, inflow)(g)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("of", ["cells", "faces"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_bound_pullback_has_the_same_bits(scheme, of, rng):
    """A strided cotangent is not taken by the direct form of the bound pullback."""
    for grid in GRIDS:
        move = dp.transport(grid, scheme, dp.dirichlet, velocity="cells", of=of)
        rule = move._rule
        args = arguments(move, rng)
        walls = rng.standard_normal(move.walls.shape)
        strided = np.asfortranarray(args[1])
        g = rng.standard_normal(args[0].shape)
        for nums in ((0,), (1,), (0, 1), (1, 2), (0, 3)):
            found = rule.bound_vjp(nums, *args)(g, *args)
            wanted = rule.vjp(nums, None, args[0], strided, *args[2:3], np.full(walls.shape, args[3]))(g)
            for num, one, other in zip(nums, found, wanted, strict=True):
                assert np.shape(one) == np.shape(args[num])
                assert np.asarray(one).tobytes() == np.asarray(np.sum(other) if num == 3 else other).tobytes()
        assert rule.bound_vjp((0,), *args[:3], walls) is None
        assert rule.bound_vjp((0,), *args) is rule.bound_vjp((0,), *args)


@pytest.mark.skipif(not kernels.compiled(), reason="NumPy computes the cotangent in an array of its own")
def test_bound_pullback_adds_to_a_sum(rng):
    """The cotangent of a velocity that many steps share is added in place."""
    move = dp.transport(GRIDS[0], "upwind", velocity="cells")
    args = arguments(move, rng)
    g = rng.standard_normal(args[0].shape)
    pull = move._rule.vjp((0, 1), None, *args)
    total = np.ones(args[1].shape)
    wanted = total + pull(g)[1]
    result = pull(g, None, total)[1]
    assert result is total
    np.testing.assert_allclose(total, wanted, rtol=0, atol=1e-14)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("scheme", ["upwind", "semi_lagrangian"])
def test_bound_pullback_checks_its_result(scheme, rng):
    move = dp.transport(GRIDS[0], scheme, velocity="cells")
    args = arguments(move, rng)
    with pytest.raises(dp.errors.NonFiniteError, match="cannot represent the gradient in v"):
        move._rule.vjp((0, 1), None, 1e200 * args[0], *args[1:])(1e200 * np.cos(args[0]))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_other_forms_after_the_bound_one(scheme, rng):
    """Other shapes are refused, other layouts and dtypes converted."""
    move = dp.transport(GRIDS[1], scheme, velocity="cells")
    u, v, dt, _ = arguments(move, rng)
    wanted = move(u, v, dt)
    with pytest.raises(dp.errors.ShapeError, match="takes u of shape"):
        move(u.T.copy(), v, dt)
    with pytest.raises(dp.errors.ShapeError, match="takes v of shape"):
        move(u, v[:1], dt)
    np.testing.assert_array_equal(move(np.asfortranarray(u), v, dt), wanted)
    np.testing.assert_array_equal(move(u, np.asfortranarray(v), np.float64(dt)), wanted)
    np.testing.assert_array_equal(move(u.astype(">f8"), v, dt), wanted)
    assert move(u.astype("f4"), v, dt).dtype == np.float32
    assert not np.shares_memory(move(u, 0.0 * v, dt), u)
    move = dp.transport(GRIDS[0], scheme, velocity="cells")
    u, v, dt, _ = arguments(move, rng)
    wanted = move(u, v, dt)
    np.testing.assert_array_equal(move(np.repeat(u, 2)[::2], np.repeat(v, 2, axis=-1)[..., ::2], dt), wanted)
    np.testing.assert_array_equal(move(u, v[0], dt), wanted)
    np.testing.assert_array_equal(move(u, np.repeat(v[0], 2)[::2], dt), wanted)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_values_are_checked_in_every_call(scheme, rng):
    move = dp.transport(GRIDS[1], scheme, dp.dirichlet, velocity="cells")
    u, v, dt, inflow = arguments(move, rng)
    move(u, v, dt, inflow)
    for number in range(2):
        bad = [u.copy(), v.copy()]
        bad[number].flat[3] = np.inf
        with pytest.raises(dp.errors.NonFiniteError, match="needs a finite"):
            move(*bad, dt, inflow)
    with pytest.raises(dp.errors.NonFiniteError, match="needs finite inflow values"):
        move(u, v, dt, np.nan)
    for wrong in (0.0, -dt, np.nan):
        with pytest.raises((ValueError, dp.errors.NonFiniteError), match="dt of transport"):
            move(u, v, wrong, inflow)


@pytest.mark.parametrize("scheme", ["semi_lagrangian", "maccormack"])
def test_large_fields_are_padded_with_the_same_values(scheme, monkeypatch, rng):
    """Ghost cells are gathered for small fields, and copied in blocks for large ones."""
    for grid in GRIDS:
        results = []
        for limit in (0, 10**6):
            monkeypatch.setattr("sparsedp.advection.interpolant.GATHER_BELOW", limit)
            monkeypatch.setattr("sparsedp.advection.interpolant.GATHER_SUMS_BELOW", limit)
            move = dp.transport(grid, scheme, dp.dirichlet, velocity="cells", backtrace="midpoint")
            args = arguments(move, np.random.default_rng(1))
            results.append((move._rule(*args), *move._rule.vjp((0, 1, 3), None, *args)(np.cos(args[0]))))
        for one, other in zip(*results, strict=True):
            assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


def test_a_time_step_that_changes(rng):
    """The scale of displacements belongs to the time step of the call."""
    move = dp.transport(GRIDS[0], "semi_lagrangian", velocity="cells")
    u, v, *_ = arguments(move, rng)
    for dt in (0.05, 0.02, 0.05):
        fresh = dp.transport(GRIDS[0], "semi_lagrangian", velocity="cells")
        assert move(u, v, dt).tobytes() == fresh(u, v, dt).tobytes()


def test_rules_keep_few_functions_and_pickle_none(rng):
    move = dp.transport(GRIDS[0], velocity="cells")
    size = len(pickle.dumps(move))
    args = arguments(move, rng)
    move._rule(*args)
    assert len(pickle.dumps(move)) == size
    assert 0 < len(move._rule._bound) <= MOST_BOUND
    plain = Rule("double", lambda x: 2 * x)
    assert plain.bound(1.0) is plain.forward
