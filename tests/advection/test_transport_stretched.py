"""Semi-Lagrangian and MacCormack transport on cells of different widths: twins, exactness, derivatives, orders."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest
from semi_lagrangian_reference import against_twin

import sparsedp as dp

SCHEMES = [
    ("semi_lagrangian", {}),
    ("semi_lagrangian", {"backtrace": "midpoint"}),
    ("maccormack", {}),
    ("maccormack", {"backtrace": "midpoint", "clamp": False}),
]
WIDTHS = (
    np.array([0.3, 0.4, 0.35, 0.5, 0.3, 0.25, 0.45]),
    np.array([0.5, 0.3, 0.4, 0.6, 0.45]),
    np.array([0.4, 0.5, 0.3]),
)
GRIDS = [((7,), True), ((7, 5), (False, True)), ((3, 4, 3), (False, True, False))]
PLACES = [("cells", "faces"), ("faces", "faces"), ("cells", "cells"), ("faces", "cells")]


def scene(shape, periodic, scheme, form, interpolation="linear", of="cells", velocity="faces", **options):
    widths = [h[:n] for h, n in zip(WIDTHS, shape)]
    grid = dp.Grid(shape, spacing=widths if len(shape) > 1 else [widths[0]], periodic=periodic)
    move = dp.transport(grid, scheme, velocity=velocity, of=of, interpolation=interpolation, **form, **options)
    rng = np.random.default_rng(5)
    v = 0.7 * rng.standard_normal(grid.faces.shape if velocity == "faces" else (grid.dim, *shape))
    return move, (rng.standard_normal(move.space.shape), v, 0.31, 0.4)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("boundary", [dp.neumann, dp.dirichlet], ids=repr)
@pytest.mark.parametrize(("scheme", "form"), SCHEMES)
@pytest.mark.parametrize(("shape", "periodic"), GRIDS)
def test_agrees_with_the_reference(shape, periodic, scheme, form, boundary):
    """Value and cotangents of field, velocity, step and inflow; the tangent against them."""
    cases = list(product(("linear", "cubic"), PLACES))
    start = SCHEMES.index((scheme, form)) + 3 * (boundary == dp.neumann)  # four of the eight each time, one in 3-D
    for interpolation, (of, velocity) in (cases[start:] + cases[:start])[: 7 if len(shape) < 3 else 1 : 2]:
        move, point = scene(shape, periodic, scheme, form, interpolation, of, velocity, boundary=boundary)
        against_twin(move, point, 1e-11)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize(("scheme", "form"), SCHEMES)
def test_linear_fields_are_transported_exactly(scheme, form, interpolation):
    """u = a + b x + c y goes to a + b (x - w t) + c (y - z t), away from walls, for any widths."""
    grid = dp.Grid((14, 15), spacing=[np.tile(WIDTHS[0], 2), np.tile(WIDTHS[1], 3)])
    move, (x, y) = dp.transport(grid, scheme, interpolation=interpolation, **form), grid.centres()
    v = grid.join(np.full((15, 15), 0.2), np.full((14, 16), -0.3))
    new = move(1.0 + 2.0 * x - 3.0 * y, v, 0.4)
    wanted = 1.0 + 2.0 * (x - 0.08) - 3.0 * (y + 0.12)
    assert new[4:-4, 4:-4] == pytest.approx(wanted[4:-4, 4:-4], rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("of", ["cells", "faces"])
@pytest.mark.parametrize(("scheme", "form"), SCHEMES)
def test_zero_velocity_is_the_identity_with_a_two_sided_mean_slope(scheme, form, of):
    move, (u, v, dt, _) = scene((7, 5), (False, True), scheme, form, of=of)
    assert np.array_equal(move(u, 0 * v, dt), u)
    if scheme == "semi_lagrangian":  # at rest: both sides alike, but for terms of second order
        slope = dp.value_and_grad(lambda v: anp.sum(np.cos(u) * move(u, v, dt)))(0 * v)[1]
        for k in (3, 20, 50):
            step = np.where(np.arange(v.size) == k, 1e-6, 0.0)
            ends = [float(np.sum(np.cos(u) * move(u, sign * step, dt))) for sign in (1, -1)]
            assert slope[k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=1e-6)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize(("scheme", "form"), SCHEMES)
def test_gradient_agrees_with_differences(scheme, form, interpolation):
    move, (u, v, dt, _) = scene((7, 5), (False, True), scheme, form, interpolation, boundary=dp.dirichlet)
    inflow = np.cos(3.0 * np.arange(move.walls.size))
    result = dp.check.gradient(lambda x: (move(*x) ** 3).sum(), (u, v, dt, inflow), directions=1)
    assert result.verdict == "agrees", str(result)


@pytest.mark.parametrize("of", ["cells", "faces"])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_matrix(interpolation, of):
    solid = np.zeros((7, 5), bool)
    solid[3, 1:3] = True
    move, (u, v, dt, _) = scene((7, 5), (True, False), "semi_lagrangian", {}, interpolation, of, solid=solid)
    assert move.operator(v, dt)(u) == pytest.approx(move(u, v, dt), rel=1e-12, abs=1e-12)


def error(n, options):
    """Return the errors of value and gradient of a wave after one period, on smoothly stretched cells."""
    nodes = np.linspace(0.0, 1.0, n + 1)
    widths = np.diff(nodes + 0.05 * np.sin(2 * np.pi * nodes))
    grid = dp.Grid(n, spacing=[widths], periodic=True)
    (x,) = grid.centres()
    x = x - x[0] + 0.5 * widths[0]
    move = dp.transport(grid, velocity="cells", **options)
    steps = 2 * n
    step = lambda u, v: move(u, v, 0.5 / n)
    wave = lambda p: 1 / (2 + anp.sin(2 * np.pi * (x - p)))
    value = dp.rollout(step, wave(0.0), np.ones(n), steps)
    loss = lambda p: anp.sum(grid.volumes * (dp.rollout(step, wave(p), np.ones(n), steps) - wave(0.3)) ** 2)
    fine = np.linspace(0, 1, 4097)[:-1]
    smooth = lambda p: 1 / (2 + anp.sin(2 * np.pi * (fine - p)))
    exact = lambda p: anp.mean((smooth(p) - smooth(0.3)) ** 2)
    slopes = [dp.value_and_grad(f)(0.1)[1] for f in (loss, exact)]
    return np.sqrt(np.sum(grid.volumes * (value - wave(0.0)) ** 2)), abs(slopes[0] - slopes[1])


@pytest.mark.sampled(0)
@pytest.mark.parametrize(
    ("options", "least", "most", "sizes"),
    [
        (dict(scheme="semi_lagrangian"), 0.85, 1.15, (200, 400)),
        (dict(scheme="semi_lagrangian", interpolation="cubic"), 1.9, 3.3, (40, 80)),
        (dict(scheme="maccormack", clamp=False), 1.8, 2.3, (80, 160)),
    ],
    ids=lambda item: item.get("interpolation", item["scheme"]) if isinstance(item, dict) else "",
)
def test_order_of_value_and_gradient(options, least, most, sizes):
    first, second = (error(n, options) for n in sizes)
    for coarse, fine in zip(first, second):
        assert least <= np.log2(coarse / fine) <= most
