"""Semi-Lagrangian and MacCormack transport against their twins: values, all derivatives, both kinds of kernels."""

import numpy as np
import pytest
from semi_lagrangian_reference import against_twin

import sparsedp as dp
from sparsedp import kernels
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.errors import DerivativeError
from sparsedp.kernels import interpolation_weights, team

NUMBA = pytest.mark.skipif(not kernels.compiled(), reason="numba is not installed")
SCHEMES = [
    ("semi_lagrangian", {}),
    ("semi_lagrangian", {"backtrace": "midpoint"}),
    ("maccormack", {}),
    ("maccormack", {"backtrace": "midpoint", "clamp": False}),
]
GRIDS = [((7,), (True,)), ((6, 5), (False, True)), ((3, 4, 5), (False, True, False))]
PLACES = [("cells", "faces"), ("faces", "faces"), ("cells", "cells"), ("faces", "cells")]


@pytest.fixture
def without_numba(monkeypatch):
    monkeypatch.setattr(kernels, "compiled", lambda: False)


def setting(shape, periodic, scheme, form, interpolation, of="cells", velocity="faces", solid=None, **options):
    """Return a transport and arguments (u, v, dt, inflow) away from all kinks."""
    grid = dp.Grid(shape, spacing=(0.3, 0.4, 0.5)[: len(shape)], periodic=periodic)
    move = dp.transport(
        grid, scheme, velocity=velocity, of=of, interpolation=interpolation, **form, solid=solid, **options
    )
    rng = np.random.default_rng(5)
    v = 0.7 * rng.standard_normal(grid.faces.shape if velocity == "faces" else (grid.dim, *shape))
    return move, (rng.standard_normal(move.space.shape), v, 0.31, 0.4)


def every_case(test):
    test = pytest.mark.parametrize("boundary", [dp.neumann, dp.dirichlet], ids=repr)(test)
    test = pytest.mark.parametrize(("of", "velocity"), PLACES)(test)
    test = pytest.mark.parametrize("interpolation", ["linear", "cubic"])(test)
    test = pytest.mark.parametrize(("scheme", "form"), SCHEMES)(test)
    return pytest.mark.parametrize(("shape", "periodic"), GRIDS)(test)


@pytest.mark.sampled
@every_case
def test_agrees_with_the_reference(without_numba, shape, periodic, scheme, form, interpolation, of, velocity, boundary):
    """Value and cotangents of field, velocity, step and inflow; the tangent against them."""
    move, point = setting(shape, periodic, scheme, form, interpolation, of, velocity, boundary=boundary)
    against_twin(move, point, 1e-12)


@NUMBA
@pytest.mark.parametrize(("shape", "interpolation"), [((7,), "linear"), ((6, 5), "cubic"), ((3, 4, 5), "linear")])
@pytest.mark.parametrize(("scheme", "form"), SCHEMES)
def test_compiled_against_numpy(monkeypatch, shape, interpolation, scheme, form):
    periodic = (True, False, False)[: len(shape)]
    for boundary in (dp.neumann, dp.dirichlet):
        move, point = setting(shape, periodic, scheme, form, interpolation, "faces", boundary=boundary)
        along = tuple(0.3 * np.cos(np.arange(np.size(x))).reshape(np.shape(x)) if np.ndim(x) else 0.3 for x in point)
        results = []
        for compiled in (True, False):
            with monkeypatch.context() as patch:
                patch.setattr(kernels, "compiled", lambda compiled=compiled: compiled)
                step = move._rule  # move itself refuses an inflow that no side uses
                value, pull = pullback(lambda x, step=step: step(*x), point)
                results.append(
                    (value, *pull(np.cos(value)), pushforward(lambda x, step=step: step(*x), point, along)[1])
                )
        for one, other in zip(*results):
            assert one == pytest.approx(other, rel=1e-13, abs=1e-13)


@pytest.mark.parametrize(("scheme", "form"), SCHEMES)
@pytest.mark.parametrize("of", ["cells", "faces"])
def test_gradient_agrees_with_differences(scheme, form, of):
    move, (u, v, dt, _) = setting((6, 5), (False, True), scheme, form, "linear", of, boundary=dp.dirichlet)
    inflow = np.cos(3.0 * np.arange(move.walls.size))  # equal ones would be a kink of the clamp
    loss = lambda x: (move(x["u"], x["v"], x["dt"], x["inflow"]) ** 3).sum()
    result = dp.check.gradient(loss, {"u": u, "v": v, "dt": dt, "inflow": inflow}, directions=1)
    assert result.verdict == "agrees", str(result)


# ---------------------------------------------------------------- solids


@pytest.mark.sampled
@pytest.mark.parametrize(("scheme", "form"), SCHEMES)
@pytest.mark.parametrize("of", ["cells", "faces"])
def test_solid(without_numba, scheme, form, of):
    """Values in a solid do not change and have no effect on fluid cells; the derivatives agree."""
    solid = np.zeros((6, 5), bool)
    solid[2:5, 1:4] = True
    move, point = setting((6, 5), (False, True), scheme, form, "linear", of, solid=solid)
    u, v, dt, _ = point
    new = move(u, v, dt)
    if of == "cells":
        assert np.array_equal(new[solid], u[solid])
        assert np.array_equal(move(np.where(solid, 99.0, u), v, dt)[~solid], new[~solid])
    assert move(np.full_like(u, 3.0), v, dt) == pytest.approx(np.full(u.shape, 3.0), rel=1e-14)
    result = dp.check.gradient(lambda x: (move(x[0], x[1], dt) ** 3).sum(), (u, v), directions=1)
    assert result.verdict == "agrees", str(result)


def test_all_cells_solid(without_numba):
    move, (u, v, dt, _) = setting((3, 2), False, "maccormack", {}, "linear", solid=np.ones((3, 2), bool))
    assert np.array_equal(move(u, v, dt), u)


# ---------------------------------------------------------------- the matrix


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("of", ["cells", "faces"])
def test_matrix(without_numba, of, interpolation):
    solid = np.zeros((6, 5), bool)
    solid[3, 1:3] = True
    move, (u, v, dt, _) = setting(
        (6, 5), (True, False), "semi_lagrangian", {}, interpolation, of, solid=solid, boundary=dp.dirichlet
    )
    op = move.operator(v, dt)
    assert op(u) == pytest.approx(move(u, v, dt), rel=1e-13, abs=1e-13)
    g = np.cos(u)
    assert op.T(g) == pytest.approx(pullback(lambda u: move(u, v, dt), u)[1](g), rel=1e-13, abs=1e-13)


def test_maccormack_has_no_matrix():
    move, (_, v, dt, _) = setting((6, 5), True, "maccormack", {}, "linear")
    with pytest.raises(ValueError, match="transport maccormack is not linear in u and has no matrix"):
        move.operator(v, dt)


def test_second_derivatives(without_numba):
    """The linear scheme has them in the field; all others raise a typed error."""
    move, (u, v, dt, _) = setting((6, 5), True, "semi_lagrangian", {}, "linear")
    slope = lambda u: dp.value_and_grad(lambda w: (move(w, v, dt) ** 3).sum())(u)[1]
    along = np.sin(np.arange(u.size)).reshape(u.shape)
    _, bend = dp.value_and_grad(lambda u: (slope(u) * along).sum())(u)
    assert bend == pytest.approx((slope(u + 1e-6 * along) - slope(u - 1e-6 * along)) / 2e-6, rel=1e-6, abs=1e-6)
    curved = lambda v: dp.value_and_grad(lambda w: (move(u, w, dt) ** 2).sum())(v)[1]
    with pytest.raises(DerivativeError, match="transport semi_lagrangian has first derivatives only"):
        dp.value_and_grad(lambda v: curved(v).sum())(v)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("shape", [(5,), (4, 3), (3, 4, 2), (1, 300)])
def test_loops_agree_with_the_matrix_and_stay_within_the_samples(shape, interpolation):
    """Departure points far outside and at the points; memory around the samples holds NaN."""
    periodic = (False, True, False)[: len(shape)]
    points = interpolation_weights.Points.of(shape, periodic, interpolation)
    rng = np.random.default_rng(1)
    n = points.size
    scale = np.array([1.0, 0.5, 2.0])[: len(shape)]
    samples = np.full(points.samples + 200, np.nan)[100:-100]
    samples[:] = rng.standard_normal(points.samples)
    g = rng.standard_normal(n)
    axes = range(len(shape))
    for w in [np.full((len(shape), n), far) for far in (-50.0, -1.0, 0.0, 0.3, 1.0, 50.0, np.nan, -np.inf)] + [
        rng.standard_normal((len(shape), n)),
        np.where(rng.random((len(shape), n)) < 0.5, 0.0, 1.3),
    ]:
        value = _dense(points, w, scale)
        slope = [_dense(points, w, scale, axis) for axis in axes]
        close = dict(rtol=1e-13, atol=1e-13)
        found = interpolation_weights.interpolate(points, samples, w, scale, np.empty(n))
        np.testing.assert_allclose(found, value @ samples, **close)
        back = interpolation_weights.scatter(points, w, scale, g, np.zeros(points.samples))
        np.testing.assert_allclose(back, value.T @ g, **close)
        steep = interpolation_weights.interpolate(points, samples, w, scale, np.empty(w.shape), g)
        for axis in axes:
            np.testing.assert_allclose(steep[axis], -scale[axis] * g * (slope[axis] @ samples), **close)
        low, high = bounds = np.empty((2, n))
        interpolation_weights.interpolate(points, samples, w, scale, np.empty(n), bounds=bounds)
        assert np.isfinite([low, high]).all() and (low <= high).all()
        corners, *shares = interpolation_weights.bound_shares(points, samples, w, scale, np.arange(n))
        for share, bound in zip(shares, (low, high)):
            np.testing.assert_array_equal(np.sum(share * samples[corners], axis=0), bound)


def _dense(points, w, scale, along=None):
    """The matrix of the interpolation, or of its slope."""
    found = np.zeros((points.size, points.samples))
    for index, weight in interpolation_weights.entries(points, w, scale, along):
        np.add.at(found, (np.arange(points.size), index), weight)
    return found


@NUMBA
@pytest.mark.parametrize("scheme", ["semi_lagrangian", "maccormack"])
@pytest.mark.parametrize("shape", [(2000,), (60, 50), (11, 12, 13)])
def test_bits_do_not_depend_on_threads(monkeypatch, scheme, shape):
    monkeypatch.setattr(team, "SERIAL", 0)
    move, point = setting(shape, False, scheme, {}, "linear")
    found = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(kernels, "threads", lambda threads=threads: threads)
        value, pull = pullback(lambda x: move._rule(*x), point)  # move itself refuses an inflow that no side uses
        found.append([np.asarray(x).tobytes() for x in (value, *pull(np.cos(value)))])
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize(("share", "order"), [(0.0, 1), (0.5, 2), (1.0, 1)])
def test_which_velocity_makes_maccormack_second_order_in_time(share, order):
    """Velocity at the start of a step, mean of both ends, at the end: v = (1 + t)^2 transports by 7 / 3 until t = 1."""

    def error(n):
        grid = dp.Grid(n, size=2 * np.pi, periodic=True)
        move = dp.transport(grid, "maccormack", velocity="cells", interpolation="cubic", clamp=False)
        (x,), dt, v = grid.centres(), 8 / n, lambda k: (1 + 8 * k / n) ** 2
        u = np.exp(np.sin(x))
        for k in range(n // 8):
            u = move(u, np.full(n, (1 - share) * v(k) + share * v(k + 1)), dt)
        return np.max(np.abs(u - np.exp(np.sin(x - 7 / 3))))

    assert np.log2(error(64) / error(128)) == pytest.approx(order, abs=0.2)
