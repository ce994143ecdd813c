"""Transport on cases with known answers: A1 to A3, orders of accuracy, conservation."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad

# ---- A1: recovery of a velocity ------------------------------------------------------------------------------------


class Recovery:
    """Case A1: a marker transported along a periodic line by an unknown velocity in each cell."""

    def __init__(self, n=64, steps=60):
        self.grid = dp.Grid(n, size=1.0, periodic=True)
        self.n = n
        self.steps = steps
        self.dt = 0.5 / n / 1.3
        self.x = self.grid.centres()[0]
        self.start = np.exp(-(((self.x - 0.3) / 0.06) ** 2) / 2)
        self.hidden = 1 + 0.3 * np.sin(2 * np.pi * self.x)
        self.move = dp.transport(self.grid, velocity="cells")
        self.target = self.end(self.hidden)

    def end(self, u):
        d = self.start
        for _ in range(self.steps):
            d = self.move(d, u, self.dt)
        return d

    def loss(self, u):
        return anp.sum((self.end(u) - self.target) ** 2)

    def by_hand(self, u):
        """The formula of the literature: slices forward, slices backward."""
        c = self.dt * self.n
        states = [self.start]
        for _ in range(self.steps):
            d = states[-1]
            up = np.roll(d, -1) - d
            down = d - np.roll(d, 1)
            states.append(d - c * (np.minimum(u, 0) * up + np.maximum(u, 0) * down))
        g = 2 * (states[-1] - self.target)
        total = 0.0
        p = c * np.maximum(u, 0)
        m = c * np.minimum(u, 0)
        for d in states[-2::-1]:
            up = np.roll(d, -1) - d
            down = d - np.roll(d, 1)
            total = total - c * g * np.where(u < 0, up, np.where(u > 0, down, 0.5 * (up + down)))
            g = g * (1 - p + m) - np.roll(g * m, 1) + np.roll(g * p, -1)
        return total


@pytest.mark.parametrize("start", ["rest", "mixed"])
def test_velocity_gradient_agrees_with_a_hand_written_adjoint(start):
    case = Recovery()
    u = np.zeros(case.n) if start == "rest" else np.where(np.arange(64) % 5, 0.7 - case.x, 0.0)
    loss, g = value_and_grad(case.loss)(u)
    wanted = case.by_hand(u)
    assert np.max(np.abs(g - wanted)) <= 1e-13 * max(1, np.max(np.abs(wanted)))
    if start == "rest":
        assert loss == pytest.approx(9.30, abs=0.005)


def test_velocity_gradient_agrees_with_central_differences():
    case = Recovery()
    u = 0.4 + 0.5 * np.cos(7 * case.x)
    d = np.sin(3 * np.arange(64.0))
    slope = value_and_grad(case.loss)(u)[1] @ d
    errors = [abs((case.loss(u + h * d) - case.loss(u - h * d)) / (2 * h) - slope) / abs(slope) for h in (1e-5, 1e-6)]
    assert min(errors) <= 1e-8


def test_velocity_is_recovered_from_rest():
    case = Recovery()
    best = dp.minimize(case.loss, np.zeros(64), maxiter=60)
    assert best.value <= 2.5


# ---- A2: what upwind does to a wave, exactly ------------------------------------------------------------------------


def amplitude(c, steps, **options):
    grid = dp.Grid(100, size=1.0, periodic=True)
    move = dp.transport(grid, **options)
    x = grid.centres()[0]
    u = np.sin(2 * np.pi * x)
    for _ in range(steps):
        u = move(u, np.ones(100), c / 100)
    return 2 * abs(np.mean(u * np.exp(-2j * np.pi * x)))


@pytest.mark.parametrize("velocity", ["faces", "cells"])
def test_damping_of_a_wave(velocity):
    assert amplitude(0.5, 200, velocity=velocity) == pytest.approx(0.906003342970, rel=1e-12)
    assert amplitude(0.8, 125, velocity=velocity) == pytest.approx(0.961291201325, rel=1e-12)


@pytest.mark.parametrize("velocity, form", [("faces", "flux"), ("faces", "advective"), ("cells", "advective")])
@pytest.mark.parametrize("speed", [1.0, -1.0, 3.0])
def test_exact_shift_and_growth_of_a_wave(velocity, form, speed):
    grid = dp.Grid(100, size=1.0, periodic=True)
    u = np.random.default_rng(0).random(100)
    v = np.full(100, speed)
    move = dp.transport(grid, velocity=velocity, form=form)
    np.testing.assert_array_equal(move(u, v, 0.01 / abs(speed)), np.roll(u, int(np.sign(speed))))
    sawtooth = (-1.0) ** np.arange(100)
    with pytest.raises(dp.errors.UnstableStepError, match="dt = .* is too large at 100 of 100 points"):
        move(sawtooth, v, 0.015 / abs(speed))
    forced = dp.transport(grid, velocity=velocity, form=form, unstable="allow")
    np.testing.assert_allclose(forced(sawtooth, v, 0.015 / abs(speed)), -2 * sawtooth, rtol=1e-14)


# ---- A3: the rotating hump ------------------------------------------------------------------------------------------


def rotate(n, scheme, steps):
    """Return the errors L1, L2, Linf and the largest value after one revolution."""
    grid = dp.Grid((n, n), size=1.0)
    v = grid.join(-2 * np.pi * (grid.face_centres(0)[1] - 0.5), 2 * np.pi * (grid.face_centres(1)[0] - 0.5))
    x, y = grid.centres()
    hump = (1 + np.cos(np.pi * np.minimum(np.hypot(x - 0.25, y - 0.5) / 0.15, 1))) / 2
    move = dp.transport(grid, scheme, dp.dirichlet)
    u = hump
    for _ in range(steps):
        u = move(u, v, 1 / steps)
    error = np.abs(u - hump)
    return error.mean(), np.sqrt(np.mean(error**2)), error.max(), u.max()


def test_errors_of_a_rotating_hump():
    found = rotate(64, "upwind", 8 * 64)
    wanted = 2.425287983808e-02, 8.258573849961e-02, 7.819941318319e-01, 2.139710394875e-01
    np.testing.assert_allclose(found, wanted, rtol=1e-10)


@pytest.mark.whole
def test_van_leer_is_three_times_more_accurate():
    assert 3 * rotate(128, "van_leer", 16 * 128)[0] <= rotate(128, "upwind", 8 * 128)[0]


# ---- orders ---------------------------------------------------------------------------------------------------------


def profile(x):
    return np.exp(np.sin(2 * np.pi * x))


def error(n, scheme, form, velocity, stretched):
    """Return the mean error after half a period of a periodic line."""
    s = np.linspace(0, 1, n + 1)
    widths = np.diff(s + 0.1 * np.sin(2 * np.pi * s) / (2 * np.pi)) if stretched else np.full(n, 1 / n)
    grid = dp.Grid(n, spacing=widths, periodic=True)
    move = dp.transport(grid, scheme, velocity=velocity, form=form)
    x = grid.centres()[0]
    u = profile(x)
    for _ in range(2 * n):
        u = move(u, np.ones(n), 0.25 / n)
    return np.sum(grid.widths[0] * np.abs(u - profile(x - 0.5)))


@pytest.mark.parametrize("stretched", [False, True])
@pytest.mark.parametrize("form, velocity", [("flux", "faces"), ("advective", "cells"), ("advective", "faces")])
def test_order_of_upwind(form, velocity, stretched):
    errors = [error(n, "upwind", form, velocity, stretched) for n in (200, 400, 800)]
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(slopes >= 0.9) and np.all(slopes <= 1.1), slopes


@pytest.mark.parametrize("stretched", [False, True])
@pytest.mark.parametrize("form, velocity", [("flux", "faces"), ("advective", "cells")])
def test_order_of_van_leer(form, velocity, stretched):
    errors = [error(n, "van_leer", form, velocity, stretched) for n in (100, 200, 400)]
    assert np.log2(errors[1] / errors[2]) >= 1.8, errors


def test_an_unused_inflow_may_be_zero():
    grid = dp.Grid((3, 2), periodic=(True, False))
    u = np.arange(6.0).reshape(3, 2)
    for move in (dp.transport(grid), dp.transport(dp.Grid((3, 2), periodic=True))):
        v = np.ones(move.settings.grid.faces.size)
        for zero in (0, 0.0, np.zeros(move.walls.size)):
            assert np.array_equal(move(u, v, 0.1, zero), move(u, v, 0.1))


def test_inflow_through_a_wall():
    """A wave that enters through the lower wall: order 1 and order 2, up to the wall."""
    found = {}
    for scheme in ("upwind", "van_leer"):
        errors = []
        for n in (100, 200):
            grid = dp.Grid(n, size=1.0)
            t = 0.0
            dt = 0.25 / n
            move = dp.transport(grid, scheme, {"x": (dp.dirichlet, dp.neumann)})
            x = grid.centres()[0]
            u = profile(0.3 * x)
            for _ in range(2 * n):
                value = profile(0.3 * -(t + 0.5 * dt))
                u = move(u, np.ones(n + 1), dt, np.array([value, 0.0]))
                t = t + dt
            errors.append(np.mean(np.abs(u - profile(0.3 * (x - t)))))
        found[scheme] = np.log2(errors[0] / errors[1])
    assert 0.9 <= found["upwind"] <= 1.1 and found["van_leer"] >= 1.8, found


# ---- what is kept ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
@pytest.mark.parametrize("of", ["cells", "faces"])
@pytest.mark.parametrize("shape", [(50,), (12, 9), (5, 6, 4)])
def test_flux_form_conserves(scheme, of, shape):
    rng = np.random.default_rng(2)
    solid = rng.random(shape) < 0.2
    for periodic in (True, False):
        grid = dp.Grid(shape, spacing=[rng.uniform(0.5, 1.5, n) for n in shape], periodic=periodic)
        move = dp.transport(grid, scheme, of=of, solid=solid)
        u = rng.random(move.space.shape)
        v = dp.interior(grid)(rng.normal(size=grid.faces.size))
        mass = np.sum(move.space.volumes * u)
        for _ in range(5):
            u = move(u, v, 0.02)
        assert abs(np.sum(move.space.volumes * u) - mass) <= 10 * np.finfo(float).eps * mass


@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
@pytest.mark.parametrize("of", ["cells", "faces"])
def test_a_divergence_free_flow_preserves_constants(scheme, of):
    rng = np.random.default_rng(3)
    grid = dp.Grid((8, 7), spacing=[rng.uniform(0.5, 1.5, n) for n in (8, 7)], periodic=(True, False))
    psi = rng.normal(size=grid.nodes.shape)
    v = dp.curl(grid)(psi - psi[:, :1] * 0)
    move = dp.transport(grid, scheme, dp.neumann, of=of)
    np.testing.assert_allclose(move(np.ones(move.space.shape), v, 0.02), 1.0, rtol=1e-13)


def test_van_leer_creates_no_new_extrema():
    grid = dp.Grid(60, size=1.0, periodic=True)
    move = dp.transport(grid, "van_leer")
    u = np.random.default_rng(4).random(60)
    variation = lambda u: np.sum(np.abs(u - np.roll(u, 1)))
    for _ in range(50):
        new = move(u, np.ones(60), 0.5 / 60)
        assert variation(new) <= variation(u) * (1 + 1e-14) and u.min() <= new.min() and new.max() <= u.max()
        u = new


def test_solid_cells_keep_their_value_and_block_fluxes():
    rng = np.random.default_rng(5)
    grid = dp.Grid((9, 8), size=1.0)
    solid = np.zeros((9, 8), bool)
    solid[3:5, 2:6] = solid[7, 7] = solid[0, 0] = True
    for scheme in ("upwind", "van_leer"):
        for velocity, form in (("faces", "flux"), ("faces", "advective"), ("cells", "advective"), ("cells", "flux")):
            move = dp.transport(grid, scheme, dp.dirichlet, velocity, form=form, solid=solid)
            v = rng.normal(size=move.settings.velocity_shapes[0])
            u = rng.random(grid.shape)
            other = np.where(solid, rng.random(grid.shape), u)
            new = move(u, v, 0.005)
            same = move(other, v, 0.005)
            np.testing.assert_array_equal(new[solid], u[solid])
            np.testing.assert_allclose(new[~solid], same[~solid], rtol=0, atol=1e-15)
