"""conservation_law with positive quantities: strong rarefactions, blasts, provable steps, derivatives."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

GAMMA = 1.4


def pressure(u, params=None):
    return (GAMMA - 1) * (u[-1] - 0.5 * anp.sum(u[1:-1] ** 2, axis=0) / u[0])


def flux(u, params, axis):
    v = u[1 + axis] / u[0]
    p = pressure(u)
    rows = [u[k] * v + (p if k == 1 + axis else 0.0) for k in range(len(u) - 1)]
    return anp.stack([*rows, v * (u[-1] + p)])


def speed(u, params, axis):
    v = u[1 + axis] / u[0]
    c = anp.sqrt(GAMMA * pressure(u) / u[0])
    return v - c, v + c


POSITIVE = {"density": lambda u, params: u[0], "pressure": pressure}


def gas(density, velocities, p):
    """Return the state of a gas: density, momenta, energy."""
    kinetic = 0.5 * density * sum(v**2 for v in velocities)
    return np.stack([density, *(density * v for v in velocities), p / (GAMMA - 1) + kinetic])


def rarefactions(n):
    """Two rarefactions with nearly a vacuum between them (Einfeldt and others, J. Comput. Phys. 92, 1991, 1-2-3)."""
    grid = dp.Grid(n, size=1.0)
    (x,) = grid.centres()
    return grid, gas(1.0 + 0.0 * x, [np.where(x < 0.5, -2.0, 2.0)], 0.4 + 0.0 * x)


def density_between(x, time):
    """Exact density of `rarefactions`: a fan on each side, and a state at rest between them."""
    s = np.abs(x - 0.5) / time
    c = np.sqrt(GAMMA * 0.4)  # in front of the fan, where the velocity is 2
    c_rest = c - 0.5 * (GAMMA - 1) * 2.0  # v - 2 c / (gamma - 1) is the same in the whole fan
    c_fan = np.clip((2.0 * c + (GAMMA - 1) * (s - 2.0)) / (GAMMA + 1), c_rest, c)
    return (c_fan / c) ** (2 / (GAMMA - 1))


def error_of_rarefactions(n):
    """Return the mean error of the density at the time 0.1."""
    grid, start = rarefactions(n)
    law = dp.conservation_law(grid, flux, speed, positive=POSITIVE)
    steps = int(np.ceil(0.1 / law.time_step(start, cfl=0.45)))
    end = dp.rollout(dp.stepper("ssprk3", law, 0.1 / steps), start, None, steps)
    return np.mean(np.abs(end[0] - density_between(grid.centres()[0], 0.1)))


def test_two_rarefactions():
    """Without positive quantities the pressure becomes negative."""
    assert error_of_rarefactions(50) < 0.04
    grid, start = rarefactions(50)
    unlimited = dp.conservation_law(grid, flux, speed)
    step = dp.stepper("ssprk3", unlimited, unlimited.time_step(start))
    with np.errstate(invalid="ignore"), pytest.raises(dp.errors.NonFiniteError, match="may have become negative"):
        dp.rollout(step, start, None, 20)


@pytest.mark.whole
def test_order_of_two_rarefactions():
    """Order 1, because the ends of the fans are kinks."""
    assert np.log2(error_of_rarefactions(150) / error_of_rarefactions(300)) > 0.8


def extreme(rng, shape):
    """Random gas with densities and pressures over many orders of magnitude, and Mach numbers up to 1000."""
    density = 10.0 ** rng.uniform(-6, 2, shape)
    p = 10.0 ** rng.uniform(-4, 3, shape)
    c = np.sqrt(GAMMA * p / density)
    velocities = [c * 10.0 ** rng.uniform(-2, 3, shape) * rng.choice([-1.0, 1.0], shape) for _ in shape]
    return gas(density, velocities, p)


@pytest.mark.parametrize("shape", [(40,), (12, 10)])
def test_a_step_of_the_proven_length_keeps_every_state_positive(shape):
    rng = np.random.default_rng(5)
    grid = dp.Grid(shape, spacing=[rng.uniform(0.1, 1.0, n) for n in shape])
    momentum = tuple(range(1, 1 + len(shape)))
    law = dp.conservation_law(grid, flux, speed, positive=POSITIVE, boundary=dp.free_slip, momentum=momentum)
    unlimited = dp.conservation_law(grid, flux, speed, boundary=dp.free_slip, momentum=momentum)
    for _ in range(5):
        u = extreme(rng, shape)
        later = u + law.time_step(u, cfl=0.5) * law(u)
        assert np.min(later[0]) > 0 and np.min(pressure(later)) > 0
        with np.errstate(invalid="ignore"), pytest.raises(dp.errors.NonFiniteError):
            unlimited(u)


def test_smooth_states_have_the_rate_of_the_law_without_positive_quantities():
    grid = dp.Grid((9, 8), size=1.0, periodic=(True, False))
    x, y = grid.centres()
    u = gas(1.0 + 0.3 * np.sin(2 * np.pi * x) * y, [0.5 + y, x], 1.0 + 0.2 * y)
    rates = [dp.conservation_law(grid, flux, speed, positive=given)(u) for given in (None, POSITIVE)]
    assert np.array_equal(*rates)


def test_limited_states_are_conserved_on_a_periodic_axis():
    """The cells beyond the end of a periodic axis are limited as those at its other end."""
    rng = np.random.default_rng(1)
    grid = dp.Grid(12, periodic=True)
    law = dp.conservation_law(grid, flux, speed, positive=POSITIVE)
    u = extreme(rng, (12,))
    for shift in range(12):
        moved = np.roll(u, shift, axis=1)
        rate = law(moved)
        np.testing.assert_allclose(np.roll(rate, -shift, axis=1), law(u), rtol=1e-12)
        assert np.all(np.abs(np.sum(rate, axis=1)) <= 1e-13 * np.sum(np.abs(rate), axis=1))


def values_at_faces(u, pressure_floor):
    """Return the values below and above each face, on cells of width 1 with open ends, by slices of autograd.numpy."""
    u = anp.concatenate([u[:, :1], u[:, :1], u, u[:, -1:], u[:, -1:]], 1)
    step = u[:, 1:] - u[:, :-1]
    a = step[:, :-1]
    b = step[:, 1:]
    slope = anp.where(a * b > 0, a * b / anp.where(a * b > 0, a + b, 1.0), 0.0)
    cells = u[:, 1:-1]
    for quantity in (lambda u: u[0], pressure):
        mean = quantity(cells)
        least = anp.minimum(quantity(cells - slope), quantity(cells + slope))
        share = (1 - pressure_floor) * mean / anp.where(least < mean, mean - least, 1.0)
        slope = slope * anp.where(least < pressure_floor * mean, share, 1.0)
    return (cells + slope)[:, :-1], (cells - slope)[:, 1:]


def twin(u, pressure_floor=0.01):
    """The rate of the law for these values."""
    lower, upper = values_at_faces(u, pressure_floor)
    (s0, f0), (s1, f1) = speed(lower, None, 0), speed(upper, None, 0)
    a = anp.minimum(anp.minimum(s0, s1), 0.0)
    b = anp.maximum(anp.maximum(f0, f1), 0.0)
    f = (b * flux(lower, None, 0) - a * flux(upper, None, 0) + a * b * (upper - lower)) / (b - a)
    return f[:, :-1] - f[:, 1:]


def strong(n):
    """A state in which the slopes of some cells are limited, away from kinks."""
    x = (np.arange(n) + 0.5) / n
    return gas(1.0 + 0.5 * np.sin(7 * x), [12 * (x - 0.5) ** 3 + 6 * x], 0.1 + 0.05 * np.cos(5 * x))


def test_values_and_derivatives_of_limited_states_agree_with_the_reference():
    law = dp.conservation_law(dp.Grid(9), flux, speed, positive=POSITIVE)
    u = strong(9)
    rng = np.random.default_rng(0)
    g, t = rng.normal(size=(2, *u.shape))
    np.testing.assert_allclose(law(u), twin(u), rtol=1e-12, atol=1e-12)
    with np.errstate(invalid="ignore"):
        assert not np.all(np.isfinite(twin(u, -np.inf)))  # without a floor the pressure is negative at ends of cells
    np.testing.assert_allclose(dp.vjp(law, u)[1](g), dp.vjp(twin, u)[1](g), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(dp.jvp(law, u, t)[1], dp.jvp(twin, u, t)[1], rtol=1e-11, atol=1e-11)

    def loss(act):
        return lambda u: anp.sum(g * act(u) ** 2)

    np.testing.assert_allclose(dp.hvp(loss(law), u, t), dp.hvp(loss(twin), u, t), rtol=1e-9, atol=1e-7)
    assert dp.check.gradient(loss(law), u, quick=True).verdict == "agrees"


def test_time_step_knows_the_waves_at_the_ends_of_the_cells():
    u = extreme(np.random.default_rng(0), (9,))
    law = dp.conservation_law(dp.Grid(9), flux, speed, positive=POSITIVE)
    at_faces, in_cells = (max(np.max(np.abs(speed(v, None, 0))) for v in w) for w in (values_at_faces(u, 0.01), [u]))
    assert at_faces > 1.03 * in_cells
    assert law.time_step(u) == pytest.approx(0.4 / at_faces, rel=1e-12)


def test_programs_limit_and_check_each_state():
    law = dp.conservation_law(dp.Grid(9), flux, speed, positive=POSITIVE)
    u = strong(9)
    rate = dp.jit(lambda u: law(u))
    smooth = gas(np.linspace(1.0, 2.0, 9), [np.ones(9)], np.ones(9))
    for state in (smooth, u, smooth):
        assert np.array_equal(rate(state), law(state))
    u[2, 4] = 0.1
    with pytest.raises(dp.errors.UnstableStepError, match="the pressure of a conservation_law must be > 0, got -"):
        rate(u)
    assert law(strong(9).astype(np.float32)).dtype == np.float32


def test_copies_keep_the_positive_quantities():
    law = dp.conservation_law(dp.Grid(9), flux, speed, positive=POSITIVE)
    again, arguments = law.recipe()
    assert np.array_equal(again(*arguments)(strong(9)), law(strong(9)))


def test_a_field_that_is_its_own_positive_quantity():
    """One field without an axis of fields, over an equilibrium, with faces at which the sum would be negative."""
    grid = dp.Grid(6)
    given = np.array([2.0, 0.1, 2.0, 0.1, 2.0, 0.1])
    law = dp.conservation_law(
        grid,
        lambda u, p, axis: anp.sqrt(u),
        lambda u, p, axis: 0.5 / anp.sqrt(u),
        equilibrium=given,
        positive={"amount": lambda u, p: u},
    )
    assert not np.any(law(given))
    u = np.array([0.1, 2.0, 0.1, 2.0, 0.1, 2.0])
    assert np.all(np.isfinite(law(u)))
    assert law.time_step(u) <= 0.4 / (0.5 / np.sqrt(0.1))


@pytest.mark.whole
def test_two_blast_waves():
    """Peak of the density 6.4 (Woodward and Colella, J. Comput. Phys. 54, 1984, at 0.038 s)."""
    grid = dp.Grid(800, size=1.0)
    (x,) = grid.centres()
    law = dp.conservation_law(grid, flux, speed, positive=POSITIVE, boundary=dp.free_slip, momentum=1)
    u = gas(1.0 + 0.0 * x, [0.0 * x], np.select([x < 0.1, x < 0.9], [1000.0, 0.01], 100.0))
    start = u
    for _ in range(20):
        steps = int(np.ceil(1.2 * 0.0019 / law.time_step(u)))
        u = dp.rollout(dp.stepper("ssprk3", law, 0.0019 / steps), u, None, steps)
    assert np.max(u[0]) == pytest.approx(6.4, rel=0.06)
    assert np.argmax(u[0]) / 800 == pytest.approx(0.78, abs=0.01)
    assert np.sum(u[0]) == pytest.approx(np.sum(start[0]), rel=1e-12)
