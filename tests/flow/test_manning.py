"""Friction of shallow water with implicit steps: uniform flow on a slope, thin layers, derivatives."""

import copy
import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

SLOPE, MANNING, GRAVITY = 0.01, 0.03, 9.81
LONG = dp.Grid(20, size=20000.0)  # waves from the ends do not reach the middle within 400 s
GROUND = -SLOPE * LONG.centres()[0]
SHEET = np.stack([np.ones(20), np.zeros(20)])


def river(**options):
    return dp.shallow_water(LONG, GROUND, GRAVITY, manning=MANNING, **options)


@pytest.mark.parametrize("scheme", ["van_leer", "upwind"])
def test_uniform_flow_reaches_its_normal_depth(scheme):
    """The normal depth of a discharge q is (n q / sqrt(slope))^(3/5); steps of every length keep it."""
    if scheme == "upwind":  # its ground is a staircase: flat ground, and the weight along the slope as a source
        weight = lambda u, params: anp.stack([0.0 * u[0], GRAVITY * SLOPE * u[0]])
        law = dp.shallow_water(LONG, 0.0, GRAVITY, scheme=scheme, manning=MANNING, source=weight)
    else:
        law = river()
    depth, discharge = dp.rollout(law.stepper(20.0), SHEET, None, 20)[:, 10]
    assert depth == pytest.approx(1.0, rel=1e-4)
    assert depth == pytest.approx((MANNING * discharge / SLOPE**0.5) ** 0.6, rel=1e-4)
    uniform = np.stack([np.ones(20), np.full(20, SLOPE**0.5 / MANNING)])
    for dt in (1e-3, 1.0, 100.0):
        assert law.stepper(dt)(uniform)[:, 10] == pytest.approx(uniform[:, 10], rel=1e-13)
    assert np.max(np.abs(law(uniform)[:, 10])) < 1e-13


def test_the_start_of_uniform_flow_is_of_order_2():
    """q' = g h slope - g n^2 q^2 / h^(7/3) has the solution sqrt(a / b) tanh(sqrt(a b) t)."""
    a, b = GRAVITY * SLOPE, GRAVITY * MANNING**2
    exact = np.sqrt(a / b) * np.tanh(np.sqrt(a * b) * 40.0)
    errors = []
    for steps in (20, 40, 80):
        end = dp.rollout(river().stepper(40.0 / steps), SHEET, None, steps)
        errors.append(abs(end[1, 10] - exact))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(orders > 1.9) and errors[-1] < 1e-3


@pytest.mark.parametrize("depth", [0.0, 1e-300, 1e-12, 1e-6, 1e-3])
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_thin_layers_come_to_rest(depth, speed):
    """Friction without bound: explicit steps of a layer of 1e-3 would reverse the flow and grow."""
    u = np.stack([np.full(20, depth), np.full(20, depth * speed)])
    for _ in range(5):
        new = river().stepper(5.0)(u)
        assert np.all(np.isfinite(new)) and np.all(new[0] >= 0)
        u = new
    limit = SLOPE**0.5 * (2 * depth) ** (5 / 3) / MANNING  # the discharge of uniform flow of twice the depth
    if depth < 1e-6:  # below `dry` the velocity, and with it the friction, is reduced: the layer falls freely for 25 s
        limit = (speed + 25.0 * GRAVITY * SLOPE) * depth * 1.001
    assert np.max(np.abs(u[1])) <= limit


def test_friction_acts_against_the_flow_in_two_dimensions():
    """q' = -b |q| q with flat ground: q = q_0 / (1 + b |q_0| t), in the direction of q_0; tracers are not slowed."""
    grid = dp.Grid((3, 3), periodic=True)
    law = dp.shallow_water(grid, 0.0, GRAVITY, manning=0.2)
    u = np.stack([np.full((3, 3), value) for value in (0.5, 0.3, -0.4, 7.0)])
    b = GRAVITY * 0.2**2 / 0.5 ** (7 / 3)
    end = dp.rollout(law.stepper(0.01), u, None, 100)
    np.testing.assert_allclose(end[1:3], u[1:3] / (1 + b * 0.5), rtol=1e-4)
    np.testing.assert_allclose(end[[0, 3]], u[[0, 3]], rtol=1e-13)
    np.testing.assert_allclose(law(u)[1:3], -b * 0.5 * u[1:3], rtol=1e-13)


def test_without_friction_the_step_is_that_of_ssprk3():
    grid = dp.Grid(8)
    law = dp.shallow_water(grid)
    u = np.stack([2.0 + np.sin(np.arange(8.0)), np.cos(np.arange(8.0))])
    np.testing.assert_allclose(law.stepper(0.05)(u), dp.stepper("ssprk3", law, 0.05)(u), rtol=1e-12)
    coarse = law.stepper(0.05)(u.astype(np.float32))
    assert coarse.dtype == np.float32
    friction = dp.shallow_water(grid, manning=np.full(8, 0.03)).friction_rate
    single = friction(u.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, friction(u), rtol=1e-6)
    rough = dp.shallow_water(grid, manning=np.full(8, 0.03)).stepper(0.05)
    for other in (copy.deepcopy(rough), pickle.loads(pickle.dumps(rough)), dp.jit(rough)):
        np.testing.assert_allclose(other(u), rough(u), rtol=1e-14)
    assert repr(rough) == "<step of <shallow_water van_leer: cells(8)>>"


@pytest.mark.whole
def test_derivatives_of_steps_with_friction():
    """In the state, the coefficient in every cell, gravity and the length of the steps; also where water stands."""
    grid = dp.Grid(6)
    law = dp.shallow_water(
        grid, lambda p: p["ground"], lambda p: p["gravity"], manning=lambda p: p["roughness"], boundary=dp.free_slip
    )
    step = law.stepper(lambda p: p["dt"])
    x = np.arange(6.0)
    params = {"ground": 0.1 * np.sin(x), "gravity": 9.81, "roughness": 0.1 + 0.02 * x, "dt": 0.02}
    weights = np.cos(np.arange(12.0)).reshape(2, 6)

    def loss(p):
        return anp.sum(weights * dp.rollout(step, anp.stack([p["depth"], p["discharge"]]), p, 3))

    point = {**params, "depth": 1.0 + 0.3 * np.cos(2 * x), "discharge": 0.5 + 0.2 * np.sin(3 * x)}
    assert dp.check.gradient(loss, point, quick=True).verdict == "agrees"
    still = {**point, "discharge": 0 * x}
    slope = dp.grad(loss)(still)
    assert all(np.all(np.isfinite(leaf)) for leaf in slope.values())
    along = dp.jvp(loss, point, {**point})[1]
    gradient = dp.grad(loss)(point)
    assert along == pytest.approx(sum(np.sum(gradient[name] * point[name]) for name in point), rel=1e-10)


def test_whole_numbers_as_a_state():
    law = dp.shallow_water(dp.Grid(6, size=6.0), manning=0.03)
    u = np.array([[4, 4, 4, 2, 2, 2], [0] * 6])
    assert np.array_equal(law.stepper(0.1)(u), law.stepper(0.1)(u.astype(float)))
