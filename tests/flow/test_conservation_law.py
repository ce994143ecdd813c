"""conservation_law: published shocks and waves, steady states, walls, orders, derivatives, refusals."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import brentq

import sparsedp as dp

GAMMA = 1.4
GRAVITY = 9.81


def pressure(u):
    momentum = u[1:-1]
    return (GAMMA - 1) * (u[-1] - 0.5 * anp.sum(momentum**2, axis=0) / u[0])


def euler_flux(u, params, axis):
    v = u[1 + axis] / u[0]
    p = pressure(u)
    rows = [u[k] * v + (p if k == 1 + axis else 0.0) for k in range(len(u) - 1)]
    return anp.stack([*rows, v * (u[-1] + p)])


def euler_speed(u, params, axis):
    v = u[1 + axis] / u[0]
    c = anp.sqrt(GAMMA * pressure(u) / u[0])
    return v - c, v + c


def water_flux(u, params, axis):
    v = u[1 + axis] / u[0]
    rows = [u[k] * v for k in range(len(u))]
    rows[1 + axis] = rows[1 + axis] + 0.5 * GRAVITY * u[0] ** 2
    return anp.stack(rows)


def water_speed(u, params, axis):
    v = u[1 + axis] / u[0]
    c = anp.sqrt(GRAVITY * u[0])
    return v - c, v + c


def rusanov(speed):
    return lambda u, params, axis: anp.maximum(*map(anp.abs, speed(u, params, axis)))


def run(law, u, end, cfl=0.4, params=None):
    """Return the state at a time, with steps that are stable for the first state."""
    steps = int(np.ceil(2.2 * end / law.time_step(u, params, cfl)))
    return dp.rollout(dp.stepper("ssprk3", law, end / steps), u, params, steps)


def sod(x, time):
    """Density of Sod's tube (J. Comput. Phys. 27, 1978) by the exact solution: fan, contact, shock."""
    left = (1.0, 1.0)
    right = (0.125, 0.1)
    wave = (GAMMA - 1) / (GAMMA + 1)
    cl, cr = (np.sqrt(GAMMA * p / rho) for rho, p in (left, right))
    a = 2 / ((GAMMA + 1) * right[0])
    b = wave * right[1]

    def excess(p):
        expansion = 2 * cl / (GAMMA - 1) * ((p / left[1]) ** ((GAMMA - 1) / 2 / GAMMA) - 1)
        return expansion + (p - right[1]) * np.sqrt(a / (p + b))

    p = brentq(excess, 0.1, 1)
    v = (p - right[1]) * np.sqrt(a / (p + b))
    behind_fan = left[0] * (p / left[1]) ** (1 / GAMMA)
    behind_shock = right[0] * (p / right[1] + wave) / (wave * p / right[1] + 1)
    shock = cr * np.sqrt((GAMMA + 1) / 2 / GAMMA * p / right[1] + (GAMMA - 1) / 2 / GAMMA)
    s = (x - 0.5) / time
    c = cl * (p / left[1]) ** ((GAMMA - 1) / 2 / GAMMA)
    fan = left[0] * np.maximum(2 / (GAMMA + 1) - wave / cl * s, 0) ** (2 / (GAMMA - 1))
    return np.select([s < -cl, s < v - c, s < v, s < shock], [left[0], fan, behind_fan, behind_shock], right[0])


@pytest.mark.sampled(0)
@pytest.mark.parametrize(("speed", "most"), [(euler_speed, 0.002), (rusanov(euler_speed), 0.0023)])
def test_sod(speed, most):
    """Mean error of the density with 400 cells; the required accuracy is 0.004."""
    grid = dp.Grid(400, size=1.0)
    (x,) = grid.centres()
    start = np.stack([np.where(x < 0.5, 1.0, 0.125), 0 * x, np.where(x < 0.5, 1.0, 0.1) / (GAMMA - 1)])
    end = run(dp.conservation_law(grid, euler_flux, speed), start, 0.2)
    assert np.mean(np.abs(end[0] - sod(x, 0.2))) < most
    assert np.sum(end[0]) == pytest.approx(np.sum(start[0]), rel=1e-13)  # nothing has reached the ends


def stoker(x, time, deep, shallow):
    """Depth after a dam broke at x = 0 (Stoker, Water Waves, 1957)."""

    def excess(h):
        return 2 * (np.sqrt(GRAVITY * deep) - np.sqrt(GRAVITY * h)) - (h - shallow) * np.sqrt(
            GRAVITY * (h + shallow) / (2 * h * shallow)
        )

    h = brentq(excess, shallow, deep)
    v = 2 * (np.sqrt(GRAVITY * deep) - np.sqrt(GRAVITY * h))
    c = np.sqrt(GRAVITY * deep)
    s = x / time
    fan = (2 * c - s) ** 2 / 9 / GRAVITY
    shock = h * v / (h - shallow)
    return np.select([s < -c, s < v - np.sqrt(GRAVITY * h), s < shock], [deep, fan, h], shallow)


def test_dam_break():
    errors = []
    for n in (100, 200):
        grid = dp.Grid(n, size=2.0, origin=-1.0)
        (x,) = grid.centres()
        law = dp.conservation_law(grid, water_flux, water_speed, boundary=dp.free_slip, momentum=1)
        end = run(law, np.stack([np.where(x < 0, 1.0, 0.2), 0 * x]), 0.2)
        errors.append(np.mean(np.abs(end[0] - stoker(x, 0.2, 1.0, 0.2))))
    assert errors[1] < 0.0025
    assert np.log2(errors[0] / errors[1]) > 0.75  # a shock: order 1


@pytest.mark.parametrize("dim", [1, 2])
def test_lake_at_rest(dim):
    """Water over hills stays at rest to the last bit; without the equilibrium it does not."""
    grid = dp.Grid((24, 16)[:dim], size=(2.0, 1.5)[:dim])
    ground = 0.3 * np.exp(-10 * sum((x - 0.8) ** 2 for x in grid.centres()))
    slopes = np.stack(np.gradient(ground, *(1 / 12, 1.5 / 16)[:dim])).reshape(dim, *grid.shape)

    def weight(u, params):
        return anp.concatenate([0 * u[:1], -GRAVITY * u[0] * slopes])

    lake = np.stack([1.0 - ground, *[0 * ground] * dim])
    given = dict(boundary=dp.free_slip, momentum=tuple(range(1, 1 + dim)), source=weight)
    still = dp.conservation_law(grid, water_flux, water_speed, equilibrium=lake, **given)
    assert np.array_equal(run(still, lake, 0.05), lake)
    assert np.max(np.abs(dp.conservation_law(grid, water_flux, water_speed, **given)(lake))) > 1e-3
    wave = lake + 1e-6 * np.sin(3 * grid.centres()[0]) * (np.arange(1 + dim) == 0).reshape(-1, *[1] * dim)
    moved = run(still, wave, 0.05)
    assert np.sum(moved[0]) == pytest.approx(np.sum(wave[0]), rel=1e-14)
    assert 1e-8 < np.max(np.abs(moved - lake)) < 3e-6 * np.sqrt(GRAVITY)
    called = dp.conservation_law(grid, water_flux, water_speed, equilibrium=lambda params: lake, **given)
    np.testing.assert_array_equal(called(wave), still(wave))


def river(n, flow, equilibrium="lake", bump=True):
    """A channel of 25 m with a bump (Goutal and Maurel, 1997), depth 2 m and discharge `flow` at both ends."""
    grid = dp.Grid(n, size=25.0)
    x = grid.centres()[0]
    h = 25.0 / n
    ground = bump * np.maximum(0.2 - 0.05 * (x - 10) ** 2, 0.0)
    slope = np.gradient(ground, h)
    lake = np.stack([2.0 - ground, 0.0 * ground])
    law = dp.conservation_law(
        grid,
        water_flux,
        water_speed,
        boundary=dp.inflow,
        inflow=lambda params, axis, side: np.array([2.0, flow]) if params is None else params[:, [0, -1][side]],
        source=lambda u, params: anp.stack([0 * u[0], -GRAVITY * u[0] * slope]),
        equilibrium=lake if equilibrium == "lake" else equilibrium,
    )
    return law, lake, ground


def settled(law, lake, flow, end):
    """Return the state of a lake with an inflow after a time."""
    dt = 0.5 * law.grid.widths[0][0] / (np.sqrt(2 * GRAVITY) + 0.5 * flow)
    return dp.rollout(dp.stepper("ssprk3", law, dt), lake, None, int(end / dt))


@pytest.mark.parametrize(
    ("flow", "n"), [pytest.param(1.0, 25, marks=pytest.mark.whole), pytest.param(4.42, 60, marks=pytest.mark.whole)]
)
def test_a_river_over_a_lake_at_rest(flow, n):
    """The inflow acts beside an equilibrium: the discharge equals the inflow, and Bernoulli's head the same all
    along: 2.249 m for 4.42."""
    law, lake, ground = river(n, flow)
    depth, discharge = settled(law, lake, flow, 30.0)
    head = discharge**2 / (2 * GRAVITY * depth**2) + depth + ground
    np.testing.assert_allclose(discharge, flow, rtol=5e-3)
    np.testing.assert_allclose(head, flow**2 / (8 * GRAVITY) + 2.0, rtol=4e-3)


def test_equilibria_are_preserved_bit_for_bit():
    """A lake at rest whose inflow is the lake, and a river whose inflow is its own at both ends."""
    law, lake, _ = river(24, 0.0)
    assert not np.any(law(lake))
    law, lake, _ = river(24, 1.0)
    moving = settled(law, lake, 1.0, 2.0)
    kept = river(24, 1.0, equilibrium=lambda params: moving)[0]
    assert not np.any(kept(moving, moving)) and np.any(kept(moving))
    slope = dp.jvp(lambda u: kept(u, moving), moving, np.ones_like(moving))[1]
    assert np.any(slope)


def test_inflow_with_and_without_an_equilibrium():
    """Over flat ground the slopes of the difference to a lake equal the slopes of the field."""
    laws = [river(24, 1.0, given, bump=False)[0] for given in ("lake", None)]
    _, lake, _ = river(24, 1.0, bump=False)
    wave = lake + 0.1 * np.sin(np.arange(48.0)).reshape(2, 24)
    np.testing.assert_allclose(laws[0](wave), laws[1](wave), rtol=0, atol=1e-12)
    losses = [lambda u, law=law: anp.sum(law(u) ** 2) for law in laws]
    np.testing.assert_allclose(*(dp.grad(loss)(wave) for loss in losses), rtol=0, atol=1e-9)


@pytest.mark.whole
def test_wave_of_euler_in_a_plane():
    """A wave of density is carried along the diagonal of a periodic box: order 2, and everything is conserved."""
    errors = []
    for n in (24, 48):
        grid = dp.Grid((n, n), size=1.0, periodic=True)
        x, y = grid.centres()

        def state(time, x=x, y=y):
            rho = 1 + 0.2 * np.sin(2 * np.pi * (x + y - 2 * time))
            one = 1 + 0 * x
            return np.stack([rho, rho, rho, one / (GAMMA - 1) + rho])

        end = run(dp.conservation_law(grid, euler_flux, euler_speed), state(0.0), 0.1)
        errors.append(np.mean(np.abs(end[0] - state(0.1)[0])))
        sums = np.sum(end, axis=(1, 2)), np.sum(state(0.0), axis=(1, 2))
        np.testing.assert_allclose(*sums, rtol=1e-13)
    assert np.log2(errors[0] / errors[1]) > 1.7


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axes_are_equivalent(axis):
    """A flow along any axis of a box with walls, inflow and stretched cells is the one-dimensional one."""
    widths = np.linspace(0.5, 1.5, 12)
    line = dp.Grid(12, spacing=[widths])
    shape = [2, 3, 2]
    spacing = [1.0, 1.0, 1.0]
    shape[axis], spacing[axis] = 12, widths
    box = dp.Grid(tuple(shape), spacing=spacing)
    u = np.stack([1.0 + 0.2 * np.sin(np.arange(12)), 0.1 * np.cos(np.arange(12))])
    sides = (dp.inflow, dp.free_slip)
    one = dp.conservation_law(line, water_flux, water_speed, boundary={"x": sides}, momentum=1, inflow=[1.2, 0.3])(u)
    fields = np.zeros((4, 12))
    fields[0], fields[1 + axis] = u
    given = np.zeros(4)
    inside = [1, 1, 1]
    given[0], given[1 + axis], inside[axis] = 1.2, 0.3, 12
    conditions = {"xyz"[a]: sides if a == axis else dp.free_slip for a in range(3)}
    law = dp.conservation_law(
        box, water_flux, water_speed, boundary=conditions, momentum=(1, 2, 3), inflow=lambda params, axis, side: given
    )
    rate = law(fields.reshape(4, *inside) + np.zeros((4, *shape)))
    lines = np.moveaxis(rate, 1 + axis, -1).reshape(4, -1, 12)
    np.testing.assert_allclose(lines[[0, 1 + axis]], np.repeat(one[:, None], lines.shape[1], 1), rtol=1e-13, atol=1e-13)
    others = [k for k in (1, 2, 3) if k != 1 + axis]
    assert np.all(lines[others] == 0)


def twin(u, widths, flux, speed):
    """The same on a line with walls, in slices of autograd.numpy: van Leer's limiter, HLL."""
    u = anp.concatenate([u[:, 1::-1] * [[1], [-1]], u, u[:, :-3:-1] * [[1], [-1]]], 1)
    h = np.concatenate([widths[1::-1], widths, widths[:-3:-1]])
    step = u[:, 1:] - u[:, :-1]
    a = step[:, :-1]
    b = step[:, 1:]
    c = (h[1:-1] + h[:-2]) / h[1:-1]
    e = (h[1:-1] + h[2:]) / h[1:-1]
    q = a / anp.where(a * b > 0, a + b, 1.0)
    p = 1 - q
    m = (c + e - 2) * c * e
    share = q * p * (q * e**2 + p * c**2) / (q * q * e**2 + m * q * p + p * p * c**2)
    slope = anp.where(a * b > 0, (a + b) * share, 0.0)
    lower = u[:, 1:-2] + slope[:, :-1]
    upper = u[:, 2:-1] - slope[:, 1:]
    (s0, f0), (s1, f1) = speed(lower, None, 0), speed(upper, None, 0)
    a = anp.minimum(anp.minimum(s0, s1), 0.0)
    b = anp.maximum(anp.maximum(f0, f1), 0.0)
    f = (b * flux(lower, None, 0) - a * flux(upper, None, 0) + a * b * (upper - lower)) / (b - a)
    return (f[:, :-1] - f[:, 1:]) / widths


def test_values_and_derivatives_agree_with_the_reference():
    widths = np.linspace(0.5, 1.5, 9)
    grid = dp.Grid(9, spacing=[widths])
    law = dp.conservation_law(grid, water_flux, water_speed, boundary=dp.free_slip, momentum=1)
    rng = np.random.default_rng(0)
    u = np.stack([1 + 0.3 * rng.random(9), rng.random(9) - 0.5])
    g = rng.random((2, 9))
    t = rng.random((2, 9))

    def other(u):
        return twin(u, widths, water_flux, water_speed)

    np.testing.assert_allclose(law(u), other(u), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(dp.vjp(law, u)[1](g), dp.vjp(other, u)[1](g), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(dp.jvp(law, u, t)[1], dp.jvp(other, u, t)[1], rtol=1e-12, atol=1e-12)

    def loss(act):
        return lambda u: anp.sum(g * act(u) ** 2)

    np.testing.assert_allclose(dp.hvp(loss(law), u, t), dp.hvp(loss(other), u, t), rtol=1e-10, atol=1e-10)


def test_gradient_in_params_inflow_source_and_equilibrium():
    grid = dp.Grid((5, 4), size=1.0, periodic=(False, True))
    x, y = grid.centres()

    def flux(u, params, axis):
        return 0.5 * params["speed"] * u**2

    law = dp.conservation_law(
        grid,
        flux,
        lambda u, params, axis: anp.abs(params["speed"] * u),
        boundary={"x": (dp.inflow, dp.outflow)},
        inflow=lambda params, axis, side: params["in"],
        source=lambda u, params: params["drag"] * u,
        equilibrium=lambda params: params["still"] * (2 + x),
    )
    start = {"speed": 0.7, "in": 1.1, "drag": -0.2, "still": 0.4}
    u = 1.5 + 0.3 * np.sin(3 * x + 2) * np.cos(2 * y)
    assert dp.check.gradient(lambda p: anp.sum(law(u, p) ** 2), start, quick=True).verdict == "agrees"
    assert dp.check.gradient(lambda u: anp.sum(law(u, start) ** 2), u, quick=True).verdict == "agrees"


FRONTS = {
    "Burgers": (lambda u, p, axis: u**2 / 2, lambda u, p, axis: (u, u)),
    "Buckley-Leverett": (
        lambda u, p, axis: u**2 / (u**2 + 0.5 * (1 - u) ** 2),
        lambda u, p, axis: anp.abs(u * (1 - u)) / (u**2 + 0.5 * (1 - u) ** 2) ** 2,
    ),
    "cubic": (lambda u, p, axis: u**3, lambda u, p, axis: (3 * u**2, 3 * u**2)),
}


@pytest.mark.parametrize("name", ["Burgers", *(pytest.param(name, marks=pytest.mark.whole) for name in [*FRONTS][1:])])
def test_gradient_of_a_front_into_zeros(name):
    """Ahead of the front the waves are 1e-170 fast: their square underflows in the derivative of a quotient."""
    grid = dp.Grid(60, size=1.0)
    law = dp.conservation_law(grid, *FRONTS[name], scheme="upwind")
    step = dp.stepper("ssprk3", law, 0.3 / 60)
    start = np.where(grid.centres()[0] < 0.3, 1.0, 0.0)
    along = np.exp(-((grid.centres()[0] - 0.1) ** 2) / 0.002)
    weights = np.sin(np.arange(60.0))
    loss = lambda u: anp.sum(weights * dp.rollout(step, u, None, 40))
    slope = np.sum(dp.grad(loss)(start) * along)
    assert slope == pytest.approx(dp.jvp(loss, start, along)[1], rel=1e-10)
    h = 1e-6
    assert slope == pytest.approx((loss(start) - loss(start - h * along)) / h, rel=1e-4)  # u > 1 is another branch


def test_check_gradient_at_a_kink():
    """Where neighbours are equal the limiter has a kink: the check says so."""
    grid = dp.Grid(8, periodic=True)
    law = dp.conservation_law(grid, lambda u, p, axis: u**2 / 2, lambda u, p, axis: anp.abs(u))
    weights = np.sin(np.arange(8.0))
    assert dp.check.gradient(lambda u: anp.sum(weights * law(u)), np.ones(8)).verdict == "inconclusive"


@pytest.mark.parametrize("shape", [(1,), (2,), (1, 1), (0,), (3, 0)])
def test_smallest_grids(shape):
    for periodic in (False, True):
        grid = dp.Grid(shape, size=1.0, periodic=periodic)
        law = dp.conservation_law(grid, lambda u, p, axis: u, lambda u, p, axis: 1 + 0 * u)
        u = np.arange(1.0, 1 + np.prod(shape)).reshape(shape)
        rate = law(u)
        assert rate.shape == shape
        assert abs(np.sum(rate)) < 1e-12 if periodic else True
        assert dp.grad(lambda u, law=law: anp.sum(law(u) ** 2))(u).shape == shape


def test_dtypes():
    law = dp.conservation_law(dp.Grid(8, periodic=True), lambda u, p, axis: 2 * u, lambda u, p, axis: 2 + 0 * u)
    u = np.sin(np.arange(8.0))
    single = law(u.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, law(u), rtol=1e-5, atol=1e-5)
    assert law(np.arange(8)).dtype == np.float64
    assert dp.grad(lambda u: anp.sum(law(u) ** 2))(u.astype(np.float32)).dtype == np.float32


def test_time_step():
    grid = dp.Grid((4, 5), size=(1.0, 2.0))
    law = dp.conservation_law(grid, lambda u, p, axis: u, lambda u, p, axis: (axis + 1.0) * u)
    assert law.time_step(np.ones((4, 5))) == pytest.approx(0.4 / (1 / 0.25 + 2 / 0.4))
    assert law.time_step(np.zeros((4, 5))) == np.inf
    assert repr(law) == "<conservation_law van_leer: cells(4, 5)>"
    fast, lake, _ = river(24, 20.0)  # the river is faster than any wave of the lake
    assert fast.time_step(lake) == pytest.approx(0.4 * 25 / 24 / (10 + np.sqrt(2 * GRAVITY)))


def test_states_at_rest_do_not_change():
    """Without waves the flux is the mean of both sides, which cancels for a constant pressure."""
    grid = dp.Grid(6)
    law = dp.conservation_law(grid, lambda u, p, axis: 3 + 0 * u, lambda u, p, axis: 0 * u)
    assert np.array_equal(law(np.arange(6.0)), np.zeros(6))


LINE = dp.Grid(4)


def carry(u, params, axis):
    return u


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (dict(scheme="weno"), "scheme of conservation_law must be one of upwind, van_leer, got 'weno'"),
        (dict(boundary=dp.no_slip), "conservation_law takes outflow, free_slip or inflow, got no_slip"),
        (
            dict(boundary=dp.free_slip),
            "must be the number of a field for each axis, got None; write for example",
        ),
        (dict(boundary=dp.inflow), "side of dp.inflow without inflow="),
        (dict(inflow=1.0), "inflow= without such a side"),
    ],
)
def test_refused_settings(given, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        dp.conservation_law(LINE, carry, carry, **given)


def test_refused_functions():
    with pytest.raises(
        TypeError, match="conservation_law, as flux, takes a function, got ndarray; write lambda u, params, axis: ..."
    ):
        dp.conservation_law(LINE, np.ones(4), carry)
    with pytest.raises(TypeError, match="conservation_law, as speed, calls a function with 3 arguments, got one that"):
        dp.conservation_law(LINE, carry, lambda u: u)
    with pytest.raises(TypeError, match="conservation_law takes a Grid"):
        dp.conservation_law((4,), carry, carry)


def test_refused_values():
    law = dp.conservation_law(LINE, carry, carry)
    with pytest.raises(dp.errors.ShapeError, match=r"takes a field on cells\(4\), got an array of shape \(5,\)"):
        law(np.ones(5))
    with pytest.raises(dp.errors.ShapeError, match=r"takes u of shape \(fields, 4\), got \(2, 3, 4\)"):
        law(np.ones((2, 3, 4)))
    channel = dp.Grid((3, 4), periodic=(True, False))  # its walls would turn the sign of a row of cells
    with pytest.raises(
        dp.errors.ShapeError, match=r"field for each number in momentum=\(0, 1\), got u of shape \(3, 4\)"
    ):
        dp.conservation_law(channel, carry, carry, boundary=dp.free_slip, momentum=(0, 1))(np.ones((3, 4)))
    with pytest.raises(
        TypeError, match="u of conservation_law must hold real numbers, got dtype complex128; write u.real"
    ):
        law(np.ones(4, complex))
    with pytest.raises(TypeError, match="got a masked array; fill it first"):
        law(np.ma.ones(4))
    with pytest.raises(
        dp.errors.NonFiniteError, match="along x must be finite, got .*; a density or a depth may have become negative"
    ):
        law(np.array([1.0, np.nan, 1.0, 1.0]))
    with pytest.raises(dp.errors.ShapeError, match=r"speed of a conservation_law must have shape \(10,\), got \(\)"):
        dp.conservation_law(LINE, carry, lambda u, p, axis: 1.0)(np.ones(4))
    with pytest.raises(dp.errors.ShapeError, match=r"flux of a conservation_law must have shape \(10,\), got"):
        dp.conservation_law(LINE, lambda u, p, axis: 1.0, carry)(np.ones(4))
    with pytest.raises(dp.errors.ShapeError, match=r"the source of a conservation_law must have shape \(4,\), got"):
        dp.conservation_law(LINE, carry, carry, source=lambda u, p: 1.0)(np.ones(4))
    with pytest.raises(dp.errors.ShapeError, match="the equilibrium of a conservation_law must have"):
        dp.conservation_law(LINE, carry, carry, equilibrium=np.ones(3))(np.ones(4))
    given = dp.conservation_law(LINE, carry, carry, boundary=dp.inflow, inflow=np.ones((3, 2)))
    with pytest.raises(dp.errors.ShapeError, match=r"inflow of a conservation_law must have shape \(2,\)"):
        given(np.ones(4))


def test_negative_speeds_are_refused():
    """The flux would be the unstable mean instead of the upwind flux."""
    u = np.array([1.0, 2.0, 4.0, 3.0])
    for speed in (lambda u, p, axis: -u, lambda u, p, axis: (u + 1.0, u - 1.0)):
        law = dp.conservation_law(LINE, carry, speed)
        for use in (law, law.time_step):
            with pytest.raises(ValueError, match="speed of a conservation_law must be >= 0, or a pair, the slowest"):
                use(u)


@pytest.mark.parametrize("name", ["flux", "speed", "source", "equilibrium"])
def test_complex_numbers_are_refused(name):
    wave = dict(flux=carry, speed=carry)
    given = np.ones(4, complex) if name == "equilibrium" else lambda u, *rest: u + 0j
    with pytest.raises(
        TypeError, match=f"the {name} of a conservation_law must hold real numbers, got dtype complex128; write"
    ):
        dp.conservation_law(LINE, **wave | {name: given})(np.ones(4))


@pytest.mark.parametrize("name", ["flux", "speed", "source"])
def test_functions_cannot_write_into_their_arguments(name):
    def doubled(u, *rest):
        u *= 2.0
        return u

    u = np.array([1.0, 2.0, 4.0, 3.0])
    with pytest.raises(ValueError, match="read-only"):
        dp.conservation_law(LINE, **dict(flux=carry, speed=carry) | {name: doubled})(u)
    assert np.array_equal(u, [1.0, 2.0, 4.0, 3.0])


def test_one_field_is_the_momentum_of_one_axis():
    with pytest.raises(ValueError, match=r"must be the number of a field for each axis, got \(1, 1\); write"):
        dp.conservation_law(dp.Grid((3, 4)), carry, carry, boundary=dp.free_slip, momentum=(1, 1))


def test_a_single_field_may_be_the_momentum():
    """Burgers' equation between walls: u is its own momentum, as a field of the grid and as one of a stack."""
    half = lambda u, p, axis: 0.5 * u**2
    walls = dict(boundary=dp.free_slip, momentum=0)
    law = dp.conservation_law(LINE, half, lambda u, p, axis: (u, u), **walls)
    stack = dp.conservation_law(LINE, half, lambda u, p, axis: (u[0], u[0]), **walls)
    u = np.array([1.0, 2.0, 4.0, 3.0])
    np.testing.assert_array_equal(law(u), stack(u[None])[0])
    assert law(u)[-1] == pytest.approx(-law(-u[::-1])[0])  # mirrored, with its sign changed
    assert dp.check.gradient(lambda u: anp.sum(anp.sin(law(u))), u + 0.1 * np.cos(u), quick=True).verdict == "agrees"
