"""Semi-Lagrangian and MacCormack transport: published cases, orders, kinks, edges of the input, steps for rollout."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import pullback

# ---------------------------------------------------------------- published figures


def burgers(cells=128):
    """Case A7: explicit diffusion, then transport of the field by itself."""
    grid = dp.Grid(cells, size=2.0, origin=-1.0, periodic=True)
    L = dp.laplacian(grid)
    carry = dp.transport(grid, "semi_lagrangian", velocity="cells")
    dt = 1 / 32
    nu = 0.01 / 128 / np.pi

    def step(u, _=None):
        u = u + dt * nu * L(u)
        return carry(u, u, dt)

    return step, -np.sin(np.pi * grid.centres()[0])


def frames(step, u, n):
    found = [u]
    for _ in range(n):
        found.append(step(found[-1]))
    return np.array(found)


def test_burgers_forward():
    """A7: published to 6 digits."""
    step, start = burgers()
    published = [0.0057228, 0.01716715, 0.02861034, 0.040052, 0.05149214]
    assert frames(step, start, 32)[-1, :5] == pytest.approx(published, abs=1e-7)


@pytest.mark.whole
def test_burgers_inverse():
    """A8: gradient descent at rate 5 from zero, mean error over frames 0 to 31 after 50 and 200 steps."""
    step, start = burgers()
    wanted = frames(step, start, 31)
    evaluate = dp.value_and_grad(lambda u: anp.mean((dp.rollout(step, u, None, 16) - wanted[16]) ** 2))
    u = np.zeros(128)
    for number in range(201):
        if number == 50:
            assert np.mean(np.abs(frames(step, u, 31) - wanted)) == pytest.approx(0.0474, abs=5e-5)
        if number < 200:
            u = u - 5 * evaluate(u)[1]
    assert np.mean(np.abs(frames(step, u, 31) - wanted)) == pytest.approx(0.0105, abs=5e-5)
    assert np.mean(np.abs(u - start)) == pytest.approx(0.0443, abs=5e-5)


def test_rotating_hump():
    """A3: the L1 error of each scheme after one revolution; upwind has 2.4e-2."""
    n = 64
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    hump = 0.5 * (1 + np.cos(np.pi * np.minimum(np.hypot(x - 0.25, y - 0.5) / 0.15, 1)))
    wind = grid.join(-2 * np.pi * (grid.face_centres(0)[1] - 0.5), 2 * np.pi * (grid.face_centres(1)[0] - 0.5))
    errors = {}
    for scheme, interpolation, form in (
        ("semi_lagrangian", "linear", "midpoint"),
        ("semi_lagrangian", "cubic", "midpoint"),
        ("maccormack", "linear", "midpoint"),
    ):
        move = dp.transport(grid, scheme, dp.dirichlet, interpolation=interpolation, backtrace=form)
        u = hump
        for _ in range(2 * n):
            u = move(u, wind, 1 / n / 2)
        errors[scheme, interpolation] = np.mean(np.abs(u - hump))
    assert errors["semi_lagrangian", "linear"] < 2.4e-2
    assert errors["maccormack", "linear"] < 0.4 * errors["semi_lagrangian", "linear"]
    assert errors["semi_lagrangian", "cubic"] < 0.15 * errors["semi_lagrangian", "linear"]


# ---------------------------------------------------------------- orders


def turned_blob(n, **options):
    """Return the mean error of a blob after an eighth of a revolution."""
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    blob = lambda cx, cy: np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 0.01)
    wind = np.stack([0.5 - y, x - 0.5])
    move = dp.transport(grid, velocity="cells", **options)
    steps = n // 4
    u = blob(0.7, 0.5)
    for _ in range(steps):
        u = move(u, wind, np.pi / 4 / steps)
    c = 0.2 * np.cos(np.pi / 4)
    return np.mean(np.abs(u - blob(0.5 + c, 0.5 + c)))


@pytest.mark.parametrize(
    ("least", "most", "sizes", "options"),
    [
        (0.9, 1.1, (160, 320), dict(scheme="semi_lagrangian")),
        (1.9, 3.2, (48, 96), dict(scheme="semi_lagrangian", interpolation="cubic", backtrace="midpoint")),
        (1.9, 2.3, (48, 96), dict(scheme="maccormack", backtrace="midpoint", clamp=False)),
    ],
)
def test_order(least, most, sizes, options):
    coarse, fine = (turned_blob(n, **options) for n in sizes)
    assert least <= np.log2(coarse / fine) <= most


# ---------------------------------------------------------------- kinks, edges of the domain and of the input


def test_slope_at_a_point_is_the_mean_of_both_sides():
    """A start from rest: the central difference."""
    u = np.array([0.0, 1.0, 4.0, 9.0])
    for periodic, ends in ((True, (1 - 9, 0 - 4)), (False, (1 - 0, 9 - 4))):
        move = dp.transport(dp.Grid(4, spacing=0.5, periodic=periodic), "semi_lagrangian", velocity="cells")
        value, pull = pullback(lambda v: move(u, v, 0.25), np.zeros(4))
        assert np.array_equal(value, u)
        assert pull(np.ones(4)) == pytest.approx(-0.25 * np.array([ends[0], 4, 8, ends[1]]))


def test_derivative_at_a_bound_is_the_mean_of_both_sides():
    """A straight line moved by half a cell: MacCormack gives 1/2, and 1 below a bound that it meets exactly."""
    move = dp.transport(dp.Grid(4, periodic=True), "maccormack", velocity="cells")
    value, pull = pullback(lambda u: move(u, np.zeros(4), 1.0), np.array([0.0, 1.0, 2.0, 3.0]))
    assert np.array_equal(value, [0, 1, 2, 3])
    assert np.array_equal(pull(np.array([0.0, 1.0, 0.0, 0.0])), [0, 1, 0, 0])


@pytest.mark.parametrize("boundary", [dp.neumann, dp.dirichlet])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_departure_points_far_outside(boundary, interpolation):
    """A departure point far outside gives the value at the wall, with a slope of 0 in the velocity."""
    move = dp.transport(dp.Grid(3), "semi_lagrangian", boundary, "cells", interpolation=interpolation)
    u = np.array([1.0, 5.0, 7.0])
    v = np.array([1e3, 1e300, -1e6])
    step = move._rule  # move itself refuses an inflow that no side uses
    value, pull = pullback(lambda x: step(u, x[0], 1.0, x[1]), (v, np.array([2.0, 3.0])))
    assert value == pytest.approx([1, 1, 7] if boundary is dp.neumann else [2, 2, 3])
    of_v, of_inflow = pull(np.ones(3))
    assert not of_v.any()
    assert of_inflow == pytest.approx([0, 0] if boundary is dp.neumann else [2, 1])


def test_shifts_by_whole_periods_are_exact():
    move = dp.transport(dp.Grid((4, 3), periodic=True), "semi_lagrangian", velocity="cells", interpolation="cubic")
    u = np.arange(12.0).reshape(4, 3)
    v = np.stack([np.full((4, 3), 9.0), np.full((4, 3), -6.0)])
    assert np.array_equal(move(u, v, 1.0), np.roll(u, 1, 0))


@pytest.mark.parametrize("scheme", ["semi_lagrangian", "maccormack"])
@pytest.mark.parametrize("of", ["cells", "faces"])
@pytest.mark.parametrize("shape", [(1,), (1, 4), (2, 2)])
def test_small_grids_preserve_constants(scheme, of, shape):
    for periodic in (True, False):
        grid = dp.Grid(shape, periodic=periodic)
        move = dp.transport(grid, scheme, of=of)
        u = np.full(move.space.shape, 3.0)
        value, pull = pullback(lambda v: move(u, v, 0.4), np.sin(np.arange(grid.faces.size)))
        assert value == pytest.approx(u, rel=1e-14)
        assert np.max(np.abs(pull(u))) <= 1e-14


@pytest.mark.parametrize("scheme", ["semi_lagrangian", "maccormack"])
def test_no_cells(scheme):
    grid = dp.Grid((0, 3))
    move = dp.transport(grid, scheme)
    value, pull = pullback(lambda x: move(*x), (np.ones((0, 3)), np.ones(grid.faces.size), 0.5))
    assert value.shape == (0, 3)
    assert [np.shape(back) for back in pull(value)] == [(0, 3), (grid.faces.size,), ()]
    point = np.ones((0, 3)), np.ones(grid.faces.size), 0.5
    assert [np.shape(one) for one in dp.jvp(lambda x: move(*x), point, point)] == 2 * [(0, 3)]
    if scheme == "semi_lagrangian":
        assert move.operator(np.ones(grid.faces.size), 0.5).shape == (0, 0)


LAYOUTS = {
    "float32": lambda u: u.astype(np.float32),
    "int": lambda u: u.astype(int),
    "bool": lambda u: u > 1,
    "Fortran": np.asfortranarray,
    "strided": lambda u: np.repeat(u, 2, axis=0)[::2],
    "reversed": lambda u: u[::-1].copy()[::-1],
    "broadcast": lambda u: np.broadcast_to(u[:1], u.shape),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("scheme", ["semi_lagrangian", "maccormack"])
def test_array_layouts(scheme, layout):
    grid = dp.Grid((4, 3))
    move = dp.transport(grid, scheme, dp.dirichlet)
    u = LAYOUTS[layout](np.arange(12.0).reshape(4, 3))
    v = np.sin(np.arange(grid.faces.size))
    for array in (u, v):
        array.flags.writeable = False
    kept = u.copy()
    value = move(u, v, 0.3)
    wanted = move(np.array(u, dtype=float), v.copy(), 0.3)
    assert value.dtype == (np.float32 if layout == "float32" else float)
    assert np.array_equal(value, wanted.astype(value.dtype))
    assert np.array_equal(u, kept)
    if layout not in ("int", "bool"):
        g = np.cos(np.arange(12.0)).reshape(4, 3)[:, ::-1]
        back = pullback(lambda u: move(u, v, 0.3), u)[1](g.astype(u.dtype))
        twin = pullback(lambda u: move(u, v, 0.3), np.array(u, dtype=float))[1](g.copy())
        assert back == pytest.approx(twin, rel=1e-6 if layout == "float32" else 1e-15)


# ---------------------------------------------------------------- steps for rollout


@pytest.mark.parametrize("scheme", ["semi_lagrangian", "maccormack"])
def test_step_in_a_rollout(scheme):
    """A step with fixed dt, alone, on the tape and in a rollout."""
    grid = dp.Grid((6, 5))
    move = dp.transport(grid, scheme)
    step = lambda u, v: move(u, v, 0.3)
    rng = np.random.default_rng(1)
    u = rng.standard_normal((6, 5))
    v = rng.standard_normal(grid.faces.size)
    g = rng.standard_normal((6, 5))
    wanted, pull = pullback(lambda x: step(*x), (u, v))
    of_u, of_v = pull(g)
    assert np.array_equal(step(u, v), wanted)
    of_u_alone = pullback(lambda u: step(u, v), u)[1](g)
    assert np.array_equal(of_u_alone, of_u) and of_v.shape == v.shape
    loop = lambda x: anp.sum(step(step(step(x[0], x[1]), x[1]), x[1]) ** 2)
    rolled = lambda x: anp.sum(dp.rollout(step, x[0], x[1], 3) ** 2)
    for one, other in zip(dp.value_and_grad(loop)((u, v))[1], dp.value_and_grad(rolled)((u, v))[1]):
        assert one == pytest.approx(other, rel=1e-13, abs=1e-13)
