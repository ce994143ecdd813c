"""shallow_water: exact solutions with dry beds and moving shore lines, lakes at rest, provable steps, derivatives."""

import copy

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

GRAVITY = 9.81


def run(law, u, end, cfl=0.45, fastest=1.0):
    """Return the state at a time; `fastest` is the largest wave speed divided by the largest one at the start."""
    steps = int(np.ceil(end * fastest / law.time_step(u, cfl=cfl)))
    return dp.rollout(dp.stepper("ssprk3", law, end / steps), u, None, steps)


def islands(shape, surface=0.3):
    """Return a grid, a rough ground, and a lake at rest in which more than a third of the cells is dry."""
    grid = dp.Grid(shape, size=(2.0, 1.5)[: len(shape)])
    rough = 0.3 * np.random.default_rng(0).random(shape)
    ground = sum(0.8 * np.cos(5 * x) + 0.3 * np.sin(9 * x + 1) for x in grid.centres()) + rough
    lake = np.stack([np.maximum(surface - ground, 0.0), *[0.0 * ground] * grid.dim])
    assert 0.3 < np.mean(lake[0] == 0) < 0.7
    return grid, ground, lake


@pytest.mark.parametrize("scheme", ["van_leer", "upwind"])
@pytest.mark.parametrize("shape", [(30,), (9, 8)])
def test_a_lake_with_islands_stays_at_rest(shape, scheme):
    grid, ground, lake = islands(shape)
    law = dp.shallow_water(grid, ground, boundary=dp.free_slip, scheme=scheme)
    assert np.max(np.abs(law(lake))) < 1e-12
    later = dp.rollout(dp.stepper("ssprk3", law, law.time_step(lake)), lake, None, 5)
    np.testing.assert_allclose(later, lake, rtol=0, atol=1e-14)
    assert np.array_equal(later[0] == 0, lake[0] == 0)


@pytest.mark.parametrize("shape", [(30,), (9, 8)])
def test_a_step_of_the_proven_length_leaves_no_negative_depth(shape):
    rng = np.random.default_rng(3)
    _, ground, _ = islands(shape)
    grid = dp.Grid(shape, spacing=[rng.uniform(0.1, 1.0, n) for n in shape])
    law = dp.shallow_water(grid, ground, boundary=dp.free_slip)
    for _ in range(5):
        depth = 10.0 ** rng.uniform(-14, 1, shape) * (rng.random(shape) < 0.7)
        u = np.stack([depth, *(depth * rng.normal(size=shape) * 10.0 ** rng.uniform(0, 3) for _ in shape)])
        later = u + law.time_step(u, cfl=0.5) * law(u)
        assert np.min(later[0]) > -1e-15
        volume = np.sum(grid.volumes * later[0])
        assert volume == pytest.approx(np.sum(grid.volumes * depth), rel=1e-13)


def ritter(x, time):
    """Depth and discharge after a dam of height 1 at x = 0 broke onto dry ground (Ritter, 1892)."""
    c = np.sqrt(GRAVITY)
    s = np.clip(x / time, -c, 2 * c)
    depth = (2 * c - s) ** 2 / (9 * GRAVITY)
    return np.stack([depth, depth * 2 / 3 * (c + s)])


def error_of_dam(n):
    grid = dp.Grid(n, size=2.0, origin=-1.0)
    (x,) = grid.centres()
    end = run(dp.shallow_water(grid), np.stack([np.where(x < 0, 1.0, 0.0), 0 * x]), 0.15, fastest=2.0)
    assert np.min(end[0]) >= 0
    assert np.mean(end[0]) == pytest.approx(0.5, rel=1e-13)
    return np.mean(np.abs(end - ritter(x, 0.15)), axis=1)


def test_a_dam_breaks_onto_dry_ground():
    depth, discharge = error_of_dam(50)
    assert depth < 0.008
    assert discharge < 0.021


@pytest.mark.whole
def test_order_of_a_dam_on_dry_ground():
    """Order 1, because the ends of the fan are kinks."""
    assert np.all(np.log2(error_of_dam(100) / error_of_dam(200)) > 0.9)


def bowl(n, dim):
    """Water that oscillates in a parabolic bowl with a plane surface (Thacker, J. Fluid Mech. 107, 1981).

    Returns the law, the state as a function of the time, and the period.
    """
    grid = dp.Grid((n,) * dim, size=4.0, origin=-2.0)
    x = grid.centres()[0]
    ground = 0.5 * (sum(y**2 for y in grid.centres()) - 1.0)  # depth 0.5 in the middle, radius 1
    turn = np.sqrt(GRAVITY)  # sqrt(2 g depth) / radius
    shift = 0.5

    def state(time):
        angle = turn * time
        if dim == 1:
            plane = shift * (x * np.cos(angle) - 0.5 * shift * np.cos(angle) ** 2)
            velocities = [-shift * turn * np.sin(angle)]
        else:
            y = grid.centres()[1]
            plane = shift * (x * np.cos(angle) + y * np.sin(angle) - 0.5 * shift)
            velocities = [-shift * turn * np.sin(angle), shift * turn * np.cos(angle)]
        depth = np.maximum(plane - ground, 0.0)
        return np.stack([depth, *(depth * v for v in velocities)])

    return dp.shallow_water(grid, ground), state, 2 * np.pi / turn


def error_of_bowl(n, dim, periods):
    law, state, period = bowl(n, dim)
    end = run(law, state(0.0), periods * period, fastest=2.0)
    assert np.sum(end[0]) == pytest.approx(np.sum(state(0.0)[0]), rel=1e-13)
    return np.mean(np.abs(end[0] - state(periods * period)[0]))


def test_a_moving_shore_line():
    """Half a period in the bowl of one dimension."""
    assert error_of_bowl(40, 1, 0.5) < 0.0035


@pytest.mark.whole
@pytest.mark.parametrize(("dim", "n"), [(1, 50), (2, 20)])
def test_order_of_a_moving_shore_line(dim, n):
    """A period in the bowl: order 1.5 in one dimension."""
    errors = [error_of_bowl(cells, dim, 1) for cells in (n, 2 * n)]
    assert np.log2(errors[0] / errors[1]) > 1.3


def smooth(n):
    """Flow over a hill without dry cells and extrema of the order of rounding; also the ground."""
    x = (np.arange(n) + 0.5) / n
    ground = 0.2 * np.sin(2 * np.pi * x + 0.3)
    return np.stack([1.0 - ground + 0.05 * np.cos(2 * np.pi * x), 0.3 + 0.1 * np.sin(2 * np.pi * x)]), ground


@pytest.mark.whole
def test_order_where_the_water_is_smooth():
    """Richardson's estimate with three grids, in L1."""
    ends = []
    for n in (100, 200, 400):
        u, ground = smooth(n)
        law = dp.shallow_water(dp.Grid(n, size=1.0, periodic=True), ground)
        ends.append(run(law, u, 0.1))
    coarse, middle, fine = (end.reshape(2, 100, -1).mean(axis=2) for end in ends)
    assert np.log2(np.mean(np.abs(coarse - middle)) / np.mean(np.abs(middle - fine))) > 1.8


def test_flat_ground_has_the_rate_of_the_law_of_water():
    """On a flat ground and with equal velocities the depth has the rate of `conservation_law`."""
    grid = dp.Grid(12, size=1.0, periodic=True)
    depth = 1.0 + 0.2 * np.sin(2 * np.pi * grid.centres()[0])
    u = np.stack([depth, 0.5 * depth])

    def flux(u, g, axis):
        return anp.stack([u[1], u[1] ** 2 / u[0] + 0.5 * g * u[0] ** 2])

    def speed(u, g, axis):
        return u[1] / u[0] - anp.sqrt(g * u[0]), u[1] / u[0] + anp.sqrt(g * u[0])

    wanted = dp.conservation_law(grid, flux, speed)(u, 2.0)
    np.testing.assert_allclose(dp.shallow_water(grid, gravity=lambda g: g)(u, 2.0), wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
def test_axes_are_equivalent_and_tracers_are_carried(axis):
    """A channel along an axis, between walls; a tracer of constant concentration keeps it."""
    _, ground, lake = islands((12,))
    depth = lake[0] + 0.1 * np.arange(12)
    discharge = 0.3 * depth
    line = dp.Grid(12, size=2.0)
    one = dp.shallow_water(line, ground, boundary=(dp.inflow, dp.free_slip), inflow=[0.5, 0.2])
    wanted = one(np.stack([depth, discharge]))
    sides = {"xy"[axis]: (dp.inflow, dp.free_slip), "xy"[1 - axis]: dp.free_slip}
    grid = dp.Grid((12, 2) if axis == 0 else (2, 12), size=2.0)
    along = lambda values: np.stack([values, values], axis=1 - axis)
    entering = [0.5, 0.2, 0.0, 0.25] if axis == 0 else [0.5, 0.0, 0.2, 0.25]
    law = dp.shallow_water(grid, along(ground), boundary=sides, inflow=entering)
    fields = [along(depth), along(discharge), 0 * along(depth), 0.5 * along(depth)]
    if axis == 1:
        fields[1], fields[2] = fields[2], fields[1]
    rate = law(np.stack(fields))
    np.testing.assert_allclose(rate[[0, 1 + axis]], np.stack(list(map(along, wanted))), rtol=1e-12, atol=1e-12)
    assert not np.any(rate[2 - axis])
    np.testing.assert_allclose(rate[3], 0.5 * rate[0], rtol=1e-12, atol=1e-12)


def twin(u, z, g):
    """The law between walls on cells of width 1, wet everywhere, in slices of autograd.numpy."""

    def beyond(row, sign=1.0):
        return anp.concatenate([sign * row[1::-1], row, sign * row[:-3:-1]])

    def slope(row):
        a = row[1:-1] - row[:-2]
        b = row[2:] - row[1:-1]
        return anp.where(a * b > 0, a * b / anp.where(a * b > 0, a + b, 1.0), 0.0)

    h, z, v = beyond(u[0]), beyond(z), beyond(u[1], -1.0) / beyond(u[0])
    sh, sw, sv = slope(h), slope(h + z), slope(v)
    h, z, v = h[1:-1], z[1:-1], v[1:-1]
    lower = (h + sh)[:-1], (z + sw - sh)[:-1], (v + sv * (h - sh) / h)[:-1]
    upper = (h - sh)[1:], (z - sw + sh)[1:], (v - sv * (h + sh) / h)[1:]
    top = anp.maximum(lower[1], upper[1])
    hl, hu = lower[0] + lower[1] - top, upper[0] + upper[1] - top
    vl, vu = lower[2], upper[2]
    cl, cu = anp.sqrt(g * hl), anp.sqrt(g * hu)
    a = anp.minimum(vl - cl, vu - cu)
    b = anp.maximum(vl + cl, vu + cu)
    mass = (b * hl * vl - a * hu * vu + a * b * (hu - hl)) / (b - a)
    fl, fu = (d * w**2 + g * d**2 / 2 for d, w in ((hl, vl), (hu, vu)))
    force = (b * fl - a * fu + a * b * (hu * vu - hl * vl)) / (b - a)
    left = (force + g / 2 * (lower[0] ** 2 - hl**2))[1:]  # on the cell below the face
    right = (force + g / 2 * (upper[0] ** 2 - hu**2))[:-1]
    weight = g * h * 2 * (sw - sh)
    return anp.stack([mass[:-1] - mass[1:], right - left - weight[1:-1]])


def test_values_and_derivatives_agree_with_the_reference():
    grid = dp.Grid(9)
    law = dp.shallow_water(grid, lambda p: p["z"], lambda p: p["g"], boundary=dp.free_slip)
    rng = np.random.default_rng(0)
    u = np.stack([1 + 0.4 * rng.random(9), rng.random(9) - 0.5])
    p = {"z": 0.3 * rng.random(9), "g": 2.0}
    np.testing.assert_allclose(law(u, p), twin(u, p["z"], p["g"]), rtol=1e-12, atol=1e-12)
    g, t, zt = rng.normal(size=(2, 9)), rng.normal(size=(2, 9)), rng.normal(size=9)
    ours = lambda u, z, pull: anp.sum(g * law(u, {"z": z, "g": pull}) ** 2)
    other = lambda u, z, pull: anp.sum(g * twin(u, z, pull) ** 2)
    for number, tangent in enumerate((t, zt, 1.0)):

        def of(loss, number=number):
            args = [u, p["z"], p["g"]]
            return lambda x: loss(*args[:number], x, *args[number + 1 :])

        x = (u, p["z"], p["g"])[number]
        np.testing.assert_allclose(dp.grad(of(ours))(x), dp.grad(of(other))(x), rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(
            dp.jvp(of(ours), x, tangent)[1], dp.jvp(of(other), x, tangent)[1], rtol=1e-10, atol=1e-10
        )
        second = [dp.hvp(of(loss), x, tangent) for loss in (ours, other)]
        np.testing.assert_allclose(*second, rtol=1e-8, atol=1e-8)
    verdict = dp.check.gradient(lambda x: ours(x[0], x[1], x[2]), (u, p["z"], 2.0), quick=True).verdict
    assert verdict == "agrees"


def test_gradients_with_dry_cells_are_finite():
    """Also of the ground, through several steps; dry cells away from the water have the derivative 0."""
    grid, ground, lake = islands((20,))
    law = dp.shallow_water(grid, lambda p: p, boundary=dp.free_slip, source=lambda u, p: -0.1 * u)
    step = dp.stepper("ssprk3", law, 0.01)
    lake[0] += 0.1 * (lake[0] > 0) * np.sin(np.arange(20.0)) ** 2
    loss = lambda u, p: anp.sum(np.cos(np.arange(40.0)).reshape(2, 20) * dp.rollout(step, u, p, 3))
    rng = np.random.default_rng(1)
    for number, tangent in enumerate(((lake > 0) * rng.normal(size=lake.shape), rng.normal(size=20) * (lake[0] > 0))):
        slope = dp.grad(loss, number)(lake, ground)
        assert np.all(np.isfinite(slope))
        one = [lambda u: loss(u, ground), lambda p: loss(lake, p)][number]
        along = dp.jvp(one, (lake, ground)[number], tangent)[1]
        assert np.sum(slope * tangent) == pytest.approx(along, rel=1e-10)
    waves = dp.rollout(step, lake, ground, 3)
    assert np.any(waves[1])


GROUNDS = {
    "flat": np.zeros(7),
    "beach": np.array([-1.0, -1.0, -0.5, 0.1, 0.7, 1.1, 1.6]),
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
@pytest.mark.parametrize("ground", GROUNDS.values(), ids=GROUNDS)
@pytest.mark.parametrize("spacing", [None, [0.1, 0.2, 0.3, 0.15, 0.2, 0.2, 0.1]], ids=["even", "uneven"])
def test_derivatives_in_dry_cells_are_one_sided(ground, scheme, spacing):
    """A depth of 0 can only rise: against one-sided differences, in the rate and after three steps.

    After a step depths rise together, and limited slopes are not additive in them: the derivative has an error of 2 %.
    """
    grid = dp.Grid(7, spacing=[spacing]) if spacing else dp.Grid(7)
    law = dp.shallow_water(grid, ground, scheme=scheme, dry=1e-3)
    step = dp.stepper("ssprk3", law, 0.01)
    weights = np.cos(np.arange(14.0) ** 2).reshape(2, 7)
    depth = np.array([1.0, 1.2, 0.9, 0.0, 0.0, 0.0, 0.0])
    still = np.zeros(7)

    def of_rate(h):
        return anp.sum(weights * law(anp.stack([h, still])))

    def of_steps(h):
        return anp.sum(weights * dp.rollout(step, anp.stack([h, still]), None, 3))

    for loss, rtol in ((of_rate, 1e-6), (of_steps, 0.02 if scheme == "van_leer" else 1e-4)):
        slope = dp.grad(loss)(depth)
        rise = 1e-8
        differences = [(loss(depth + rise * unit) - loss(depth)) / rise for unit in np.eye(7)]
        np.testing.assert_allclose(slope, differences, rtol=rtol, atol=3e-5)
        along = [dp.jvp(loss, depth, unit)[1] for unit in np.eye(7)]
        np.testing.assert_allclose(along, slope, rtol=1e-12, atol=1e-13)
        assert np.all(np.isfinite(dp.hvp(loss, depth, weights[0])))


def test_programs_floats_and_copies():
    grid, ground, lake = islands((12,))
    law = dp.shallow_water(grid, ground)
    u = lake + np.array([[0.2], [0.1]])
    rate = dp.jit(lambda u: law(u))
    for state in (lake, u, lake):
        assert np.array_equal(rate(state), law(state))
    with pytest.raises(
        dp.errors.UnstableStepError, match="the depth of a shallow_water must be >= 0, got -1 in cell 2"
    ):
        rate(u - np.array([[1.0], [0.0]]) * (np.arange(12) == 2) * (1.0 + u[0]))
    assert np.array_equal(copy.deepcopy(law)(u), law(u))
    coarse = u.astype(np.float32)
    assert law(coarse).dtype == np.float32
    end = run(law, coarse, 0.2, fastest=2.0)
    assert end.dtype == np.float32
    np.testing.assert_allclose(end, run(law, u, 0.2, fastest=2.0), rtol=0, atol=1e-5)


@pytest.mark.parametrize("scale", [1e-14, 1.0, 1e8])
def test_depths_of_any_size(scale):
    """With `dry` in the same unit, all lengths may be multiplied by a factor."""
    grid = dp.Grid(12, size=scale)
    (x,) = grid.centres()
    ground = scale * 0.3 * np.sin(5 * x / scale)
    u = np.stack([np.maximum(0.2 * scale - ground, 0.0), 0 * x])
    u[1] = 0.1 * u[0] * np.sqrt(scale)
    law = dp.shallow_water(grid, ground, dry=1e-6 * scale)
    end = run(law, u, 0.1 * np.sqrt(scale), fastest=2.0)
    assert np.min(end[0]) >= 0
    unit = dp.shallow_water(dp.Grid(12, size=1.0), ground / scale)
    wanted = run(unit, u / [[scale], [scale**1.5]], 0.1, fastest=2.0)
    np.testing.assert_allclose(end / [[scale], [scale**1.5]], wanted, rtol=0, atol=1e-12)


def test_small_and_empty_grids():
    for shape in ((1,), (1, 1), (0,)):
        law = dp.shallow_water(dp.Grid(shape), boundary=dp.free_slip)
        u = np.ones((1 + len(shape), *shape))
        u[1:] = 0.0
        assert not np.any(law(u))
        assert law(u).shape == u.shape
    thin = np.array([[1e-14, 1e-300, 0.0, 0.0], [1.0, 1.0, 1.0, 0.0]])
    assert np.all(np.isfinite(dp.shallow_water(dp.Grid(4))(thin)))


@pytest.mark.parametrize("wrong", [-1.0, np.nan])
def test_a_step_length_of_an_invalid_state_is_refused_as_its_rate(wrong):
    law = dp.shallow_water(dp.Grid(4), np.zeros(4))
    u = np.array([[1.0, wrong, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
    with pytest.raises(ValueError) as of_rate:
        law(u)
    with pytest.raises(ValueError) as of_step:
        law.time_step(u)
    assert str(of_step.value) == str(of_rate.value)
