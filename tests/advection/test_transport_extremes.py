"""Extreme cases of explicit transport: no velocity, the largest Courant numbers, obstacles, numbers of extreme size."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward, value_and_grad
from sparsedp.errors import NonFiniteError, UnstableStepError

SCHEMES = pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
EVERY = list(product(("faces", "cells"), ("flux", "advective"), ("cells", "faces")))


def scene(scheme, shape=(6, 5), velocity="faces", form=None, of="cells", **options):
    grid = dp.Grid(shape, size=1.0, periodic=options.pop("periodic", False))
    move = dp.transport(grid, scheme, dp.dirichlet, velocity, of, form=form, **options)
    rng = np.random.default_rng(0)
    v = rng.normal(size=move.settings.velocity_shapes[0])
    return move, rng.normal(size=move.space.shape), v, rng.normal(size=move.walls.shape)


@SCHEMES
@pytest.mark.parametrize("velocity, form, of", EVERY)
def test_zero_velocity_is_the_identity_with_a_gradient(scheme, velocity, form, of):
    move, u, v, q = scene(scheme, velocity=velocity, form=form, of=of)
    np.testing.assert_array_equal(move(u, 0 * v, 0.1, q), u)
    slope = value_and_grad(lambda v: anp.sum(move(u, v, 0.1, q) ** 2))(0 * v)[1]
    assert np.all(np.isfinite(slope)) and np.any(slope)


@SCHEMES
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("velocity, form, of", EVERY)
def test_nonfinite_arguments_are_refused(scheme, velocity, form, of, value):
    move, *args = scene(scheme, velocity=velocity, form=form, of=of)
    for number, words in enumerate(("field", "velocity", "inflow")):
        for index in (0, -1, args[number].size // 2):
            bad = [arg.copy() for arg in args]
            bad[number].reshape(-1)[index] = value
            with pytest.raises(NonFiniteError, match=f"needs .*{words}.*got 1 that"):
                move(*bad[:2], 0.001, bad[2])


@SCHEMES
def test_nonfinite_values_in_solids_and_at_closed_walls_are_refused(scheme):
    move, u, v, q = scene(scheme, solid=np.ones((6, 5), bool))
    for number in range(3):
        bad = [u.copy(), v.copy(), q.copy()]
        bad[number].reshape(-1)[3] = np.nan
        with pytest.raises(NonFiniteError, match="got 1 that are NaN or infinite"):
            move(*bad[:2], 0.1, bad[2])


@SCHEMES
@pytest.mark.parametrize("dt", [0, -1.0, -np.inf, np.nan, np.inf])
def test_invalid_time_steps_are_refused(scheme, dt):
    move, u, v, q = scene(scheme)
    with pytest.raises(ValueError, match="dt of .* must be (> 0|finite), got"):
        move(u, v, dt, q)


@pytest.mark.parametrize("scheme, most", [("upwind", 1.0), ("van_leer", 0.5)])
def test_the_stated_largest_step_is_stable(scheme, most):
    """A step at the limit passes, a slightly longer one raises, and the message names the limit."""
    move, u, v, q = scene(scheme, (7,))
    with pytest.raises(UnstableStepError, match="the largest stable dt is") as caught:
        move(u, v, 10.0, q)
    limit = float(str(caught.value).split("dt is ")[1].split(",")[0])
    v = np.sign(v) * (np.sign(v[0]) == np.sign(v))  # one direction
    limit = most / 7
    move(u, v, limit, q)
    with pytest.raises(UnstableStepError, match="is too large at"):
        move(u, v, limit * (1 + 1e-13), q)


@SCHEMES
@pytest.mark.parametrize("power", [900, -900])
def test_scaling_keeps_the_bits(scheme, power):
    for velocity, form, of in EVERY:
        move, u, v, q = scene(scheme, velocity=velocity, form=form, of=of)
        scale = 2.0**power
        np.testing.assert_array_equal(move(scale * u, v, 0.01, scale * q), scale * move(u, v, 0.01, q))
        plain = value_and_grad(lambda p: anp.sum(move(*p, 0.01, q)))((u, v))[1]
        large = value_and_grad(lambda p: scale * anp.sum(move(*p, 0.01, q)))((u, v))[1]
        for one, other in zip(plain, large):
            np.testing.assert_array_equal(other, scale * one)


@SCHEMES
@pytest.mark.parametrize("velocity", ["faces", "cells"])
def test_an_overflowing_derivative_is_an_error(scheme, velocity):
    """Field and cotangent of 2^900: their product, the gradient in the velocity, is refused, not infinity."""
    move, u, v, q = scene(scheme, velocity=velocity)
    u = 2.0**900 * u
    scale = 2.0**900
    through = lambda x, dt=0.01: scale * anp.sum(move(u, x, dt, q) * u / scale)
    shared = lambda x: through(x) + anp.sum(move(u / scale, x, 0.01, q))  # the second of two that are added up
    for loss, x, name in ((through, v, "v"), (shared, v, "v"), (lambda dt: through(v, dt), 0.01, "dt")):
        with np.errstate(all="ignore"), pytest.raises(NonFiniteError, match=f"cannot represent the gradient in {name}"):
            value_and_grad(loss)(x)
    with np.errstate(all="ignore"), pytest.raises(NonFiniteError, match="cannot represent the tangent, got"):
        pushforward(lambda x: move(u, x, 0.01, q), v, scale * v)


def disguises(x):
    """Yield arrays of other layouts with the same values."""
    yield np.asfortranarray(x)
    yield np.repeat(x, 2, axis=-1)[..., ::2]
    yield np.ascontiguousarray(np.flip(x))[tuple(slice(None, None, -1) for _ in x.shape)]
    frozen = x.copy()
    frozen.flags.writeable = False
    yield frozen
    yield x.astype(">f8")


@SCHEMES
@pytest.mark.parametrize("of", ["cells", "faces"])
def test_array_layouts_and_dtypes(scheme, of):
    move, u, v, q = scene(scheme, of=of)
    kept = [x.copy() for x in (u, v, q)]
    wanted = move(u, v, 0.01, q)
    grads = value_and_grad(lambda p: anp.sum(move(p[0], p[1], 0.01, p[2]) ** 2))
    first = grads((u, v, q))[1]
    for a, b, c in zip(disguises(u), disguises(v), disguises(q)):
        np.testing.assert_array_equal(move(a, b, 0.01, c), wanted)
        assert move(a, b, 0.01, c).dtype == float
        for one, other in zip(grads((a, b, c))[1], first):
            np.testing.assert_array_equal(one, other)
    for x, copy in zip((u, v, q), kept):
        np.testing.assert_array_equal(x, copy)
    ones = np.broadcast_to(np.ones(()), u.shape)
    np.testing.assert_array_equal(move(ones, v, 0.01), move(np.ones(u.shape), v, 0.01))


@SCHEMES
@pytest.mark.parametrize("kind", [np.float32, np.int32, np.uint8, bool])
def test_complex_and_integer_arguments(scheme, kind):
    move, u, v, q = scene(scheme)
    x = (np.abs(u) > 0.5).astype(kind) if np.dtype(kind).kind in "bu" else (10 * u).astype(kind)
    w = v.astype(np.float32)
    new = move(x, w, np.float32(0.01), 0)
    assert new.dtype == (kind if kind is np.float32 else np.float64)
    np.testing.assert_array_equal(
        new, move(x.astype(float), w.astype(float), float(np.float32(0.01)), 0.0).astype(new.dtype)
    )
    if kind is np.float32:
        g = value_and_grad(lambda p: anp.sum(move(p[0], p[1], p[2]) ** 2))((x, w, np.float32(0.01)))[1]
        assert [part.dtype for part in g] == [np.float32] * 3


@pytest.mark.sampled(1)
@SCHEMES
@pytest.mark.parametrize("of", ["cells", "faces"])
@pytest.mark.parametrize("shape", [(0,), (0, 4), (3, 0), (1,), (1, 1), (1, 7), (7, 1), (2, 2), (2, 1, 3), (0, 2, 2)])
def test_small_and_empty_grids(scheme, of, shape):
    for periodic, (velocity, form, _) in product((False, True), EVERY):
        move, u, v, q = scene(scheme, shape, velocity, form, of, periodic=periodic)
        new = move(u, v, 0.01, q)
        assert new.shape == u.shape
        if 0 in shape:
            np.testing.assert_array_equal(new, u)
        value_and_grad(lambda p: anp.sum(move(*p) ** 2))((u, v, 0.01, q))
        if scheme == "upwind":
            np.testing.assert_allclose(move.operator(v, 0.01)(u), move(u, v, 0.01), rtol=0, atol=1e-14)


@SCHEMES
@pytest.mark.parametrize("of", ["cells", "faces"])
def test_all_solid_is_the_identity(scheme, of):
    for velocity, form, _ in EVERY:
        move, u, v, q = scene(scheme, velocity=velocity, form=form, of=of, solid=np.ones((6, 5), bool))
        np.testing.assert_array_equal(move(u, v, 0.9, q), u)
        slopes = value_and_grad(lambda p: anp.sum(move(u, *p) ** 2))((v, 0.9, q))[1]
        assert not any(np.any(slope) for slope in slopes)


@SCHEMES
def test_islands_and_cells_of_high_aspect(scheme):
    grid = dp.Grid((12, 10), size=(1.0, 1e4))
    solid = np.random.default_rng(1).random((12, 10)) < 0.5
    move = dp.transport(grid, scheme, solid=solid)
    rng = np.random.default_rng(2)
    u = rng.random(grid.shape)
    v = dp.interior(grid)(grid.join(rng.normal(size=(13, 10)), 1e4 * rng.normal(size=(12, 11))))
    new = u
    for _ in range(20):
        new = move(new, v, 0.005)
    np.testing.assert_allclose(np.sum(grid.volumes * new), np.sum(grid.volumes * u), rtol=1e-14)


def test_ten_thousand_steps():
    grid = dp.Grid(16, size=1.0, periodic=True)
    move = dp.transport(grid)
    u = np.random.default_rng(3).random(16)
    v = np.ones(16)
    mass = u.sum()
    for _ in range(10_000):
        u = move(u, v, 0.03)
    np.testing.assert_allclose(u, mass / 16, rtol=1e-11)
    assert (
        repr(dp.transport(grid, solid=u > 9))
        == "<transport upwind: cells(16), velocity on faces, flux form, 0 solid cells>"
    )
