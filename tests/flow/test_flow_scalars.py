"""flow_step with scalars, and the step that convection allows."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp


def cavity(n, dt, implicit=True, rayleigh=1e4, **options):
    """A square, hot at x = 0, cold at x = 1 (de Vahl Davis, 1983)."""
    grid = dp.Grid((n, n), size=1.0)
    hot = {"x": dp.dirichlet}
    values = dp.lift(grid, hot).domain.join(1.0, 0.0, 0.0, 0.0)
    mean = dp.average(grid)
    up = grid.join(0.0, 1.0)
    heat = {"diffusivity": 1.0, "boundary": hot, "values": values}
    push = lambda v, s, params: 0.71 * params * up * mean(s["heat"])
    step = dp.flow_step(grid, dt, 0.71, push, implicit=implicit, scalars={"heat": heat}, **options)
    state = step.start(np.zeros(grid.faces.size), rayleigh, {"heat": 1 - grid.centres()[0]})
    return grid, step, state


def heat_flow(n, implicit, dt):
    """Return the final heat flow through each plane across x, convective and diffusive."""
    grid, step, state = cavity(n, dt, implicit)
    end = dp.rollout(step, state, 1e4, round(0.25 / dt))
    u = grid.split(end["v"])[0]
    heat = end["s"]["heat"]
    return np.mean(u[1:-1] * 0.5 * (heat[1:] + heat[:-1]) - np.diff(heat, axis=0) * n, axis=1)


@pytest.mark.whole
def test_natural_convection_in_one_call():
    """Published 2.243 at Ra 1e4; 20^2 cells are 2.8 % off, as in examples/convection.py."""
    flow = heat_flow(20, True, 1e-3)
    assert np.mean(flow) == pytest.approx(2.243, rel=0.03)
    assert np.ptp(flow) < 0.02  # as much through every plane
    np.testing.assert_allclose(heat_flow(10, False, 1e-3), heat_flow(10, True, 1e-3), rtol=2e-3)


def test_second_order_in_time():
    answers = [dp.rollout(step, state, 1e4, n) for n in (16, 32, 64) for _, step, state in [cavity(8, 0.016 / n)]]
    for part in (lambda end: end["s"]["heat"], lambda end: end["v"]):
        coarse, fine = (np.max(np.abs(part(a) - part(b))) for a, b in zip(answers, answers[1:]))
        assert 1.8 < np.log2(coarse / fine) < 2.3


def test_gradients():
    _, step, state = cavity(6, 2e-3)

    def loss(params):
        s = {"heat": state["s"]["heat"] + params["warm"]}
        end = dp.rollout(step, step.start(state["v"], params["rayleigh"], s), params["rayleigh"], 5)
        return anp.sum(end["s"]["heat"] ** 2) + anp.sum(end["v"] ** 2)

    start = {"rayleigh": 1e4, "warm": 0.1 * np.sin(np.arange(36.0)).reshape(6, 6)}
    assert dp.check.gradient(loss, start, quick=True).verdict == "agrees"


def test_dye_that_flows_in_and_past_a_solid():
    """A channel: dye is conserved, does not enter the solid, and finally fills the fluid."""
    grid = dp.Grid((16, 9), size=(16.0, 9.0))
    solid = np.zeros(grid.shape, bool)
    solid[5:7, 3:6] = True
    sides = {"x": (dp.inflow, dp.outflow), "y": dp.free_slip}
    D = dp.divergence(grid)
    ends = {"x": (dp.dirichlet, dp.neumann)}
    values = dp.lift(grid, ends).domain.join(1.0, 0.0, 0.0, 0.0)
    dye = {"diffusivity": 0.5, "boundary": ends, "values": values}
    step = dp.flow_step(grid, 0.1, 0.5, boundary=sides, solid=solid, scalars={"dye": dye})
    v = grid.join(1.0, 0.0)
    state = step.start(v, None, {"dye": np.zeros(grid.shape)})
    end = dp.rollout(step, state, None, 100)
    u = end["s"]["dye"]
    flow = grid.split(end["v"])[0]
    assert np.all(u[solid] == 0)
    assert np.max(np.abs(D(end["v"])[~solid])) < 1e-9
    assert np.max(u) < 1.1 and np.min(u) > -0.1
    rate = step.scalars["dye"].rate(end["v"], end["s"], None)
    slope = 0.5 * (1.0 - u[0]) / 0.5  # through the lower end
    assert np.sum(rate) == pytest.approx(np.sum(flow[0] * 1.0 + slope) - np.sum(flow[-1] * u[-1]), rel=1e-12)
    late = dp.rollout(step, end, None, 900)["s"]["dye"]
    assert np.min(late[~solid]) > 0.95


def test_sources_get_all_scalars():
    grid = dp.Grid((4, 4), periodic=True)
    sources = {"a": {"source": lambda s, k: -k * s["a"]}, "b": {"source": lambda s, k: k * s["a"]}}
    step = dp.flow_step(grid, 0.01, convective=False, scalars=sources)
    start = step.start(np.zeros(32), 2.0, {"a": np.ones((4, 4)), "b": np.zeros((4, 4))})
    end = dp.rollout(step, start, 2.0, 100)["s"]
    np.testing.assert_allclose(end["a"], np.exp(-2.0), rtol=1e-3)
    np.testing.assert_allclose(end["a"] + end["b"], 1.0, rtol=1e-13)
    assert repr(step) == f"<flow step on {grid}: pressure, scalars>"


def wave(dt, speed, viscosity=0.0, **options):
    grid = dp.Grid((16, 16), periodic=True)
    step = dp.flow_step(grid, dt, viscosity, **options)
    rng = np.random.default_rng(0)
    return step, step.start(grid.join(speed, 0.0) + 1e-3 * rng.standard_normal(512))


def test_a_step_beyond_the_courant_limit_is_refused():
    step, state = wave(0.6, 1.0)
    with pytest.raises(dp.errors.UnstableStepError, match=r"waves grow by \d% a step, at a Courant number of 0.60"):
        step(state)
    message = "dt = 0.49.* is safe, or write unstable='allow'"
    with pytest.raises(dp.errors.UnstableStepError, match=message):
        dp.rollout(step, state, None, 10)
    allowed, state = wave(0.6, 1.0, unstable="allow")
    assert np.all(np.isfinite(allowed(state)["v"]))
    step, state = wave(0.49, 1.0)
    step(state)
    step, state = wave(1.0, 0.9, 0.5, implicit=True)  # viscosity damps what would grow
    step(state)


@pytest.mark.parametrize("implicit", [False, True])
def test_growth_of_waves_at_the_stability_limit(implicit):
    """The predicted growth agrees with the growth of the fastest wave in the linear scheme."""
    from sparsedp.flow.diffusion import wave_growth

    for courant, damping in ((0.3, 0.0), (0.9, 0.2), (0.7, 0.9), (1.5, 0.3)):
        angles = np.linspace(0, np.pi, 200)
        fastest = 0.0
        for angle in angles:
            c = 1j * courant * np.sin(angle)
            d = damping * np.sin(angle / 2) ** 2
            left = 1 + d / 2 if implicit else 1.0
            now = (1 - d / 2 + 1.5 * c if implicit else 1 + 1.5 * (c - d)) / left
            matrix = np.array([[now, -0.5 * (c if implicit else c - d) / left], [1, 0]])
            fastest = max(fastest, *np.abs(np.linalg.eigvals(matrix)))
        assert wave_growth(courant, damping, implicit) == pytest.approx(fastest, rel=2e-3)


def test_refused_scalars():
    grid = dp.Grid((4, 4))
    with pytest.raises(ValueError, match="unstable must be one of raise, allow, got 'warn'"):
        dp.flow_step(grid, 0.1, unstable="warn")
    with pytest.raises(
        ValueError, match="scalar 'heat' of flow_step needs a dict of diffusivity, boundary, values, source"
    ):
        dp.flow_step(grid, 0.1, scalars={"heat": 0.1})
    with pytest.raises(ValueError, match="diffusivity of 'heat' of flow_step must be >= 0, got -1"):
        dp.flow_step(grid, 0.1, scalars={"heat": {"diffusivity": -1.0}})
    with pytest.raises(
        dp.errors.UnstableStepError, match="flow_step is unstable for diffusivity of 'heat' = 9 with dt = 1:"
    ):
        dp.flow_step(grid, 1.0, scalars={"heat": {"diffusivity": 9.0}})
    step = dp.flow_step(grid, 0.1, scalars={"heat": {}})
    with pytest.raises(
        dp.errors.ShapeError, match=r"flow_step needs the scalars \['heat'\], got \[\]; write step.start"
    ):
        step.start(np.zeros(40))
    with pytest.raises(dp.errors.ShapeError, match="flow_step takes a dict of v, p, a, s and r as its state"):
        step({"v": np.zeros(40)})


@pytest.mark.parametrize("implicit", [False, True])
def test_a_wall_does_not_heat_an_adjacent_obstacle(implicit):
    grid = dp.Grid((4, 3), size=1.0)
    solid = np.zeros((4, 3), bool)
    solid[0, 1] = True
    hot = {"diffusivity": 0.1, "boundary": {"x": dp.dirichlet}, "values": np.array([1.0] * 3 + [0.0] * 11)}
    step = dp.flow_step(grid, 0.01, 0.1, solid=solid, implicit=implicit, scalars={"heat": hot})
    end = dp.rollout(step, step.start(np.zeros(grid.faces.size), None, {"heat": np.zeros((4, 3))}), None, 5)
    heat = end["s"]["heat"]
    assert heat[0, 1] == 0.0 and np.all(heat[0, [0, 2]] > 0.01)


def plate(n, implicit, values):
    """Return a step of a fluid at rest between two walls with these temperatures, and its first state at params 0."""
    grid = dp.Grid((6, 2), size=1.0, periodic=(False, True))
    heat = {"diffusivity": 0.2, "boundary": {"x": dp.dirichlet}, "values": values}
    step = dp.flow_step(grid, 0.4 / n, boundary=dp.free_slip, implicit=implicit, scalars={"heat": heat})
    return step, step.start(np.zeros(grid.faces.size), 0.0, {"heat": np.zeros(grid.shape)})


@pytest.mark.parametrize("implicit", [True, pytest.param(False, marks=pytest.mark.whole)])
def test_wall_values_that_are_a_function(implicit):
    """A constant function is a constant array, bit for bit; values that vary in time keep order 2."""
    ends = []
    for values in (np.ones(4), lambda params: np.ones(4)):
        step, state = plate(20, implicit, values)
        single = {"heat": np.zeros((6, 2), np.float32)}
        state = step(step.start(state["v"].astype(np.float32), 0.0, single), 0.0)
        assert state["s"]["heat"].dtype == np.float32
    for values in (np.array([1.0, 2.0, 3.0, 4.0]), lambda params: np.array([1.0, 2.0, 3.0, 4.0])):
        step, state = plate(20, implicit, values)
        for _ in range(3):
            state = step(state, 0.0)
        ends.append(state["s"]["heat"])
    np.testing.assert_array_equal(*ends)

    def end(n):
        step, state = plate(n, implicit, lambda t: np.sin(5 * t) * np.array([1.0, 2.0, 0.0, 0.0]))
        for number in range(1, n + 1):
            state = step(state, 0.4 * number / n)
        return state["s"]["heat"]

    coarse, middle, fine = (end(n) for n in (20, 40, 80))
    assert 1.8 < np.log2(np.max(np.abs(coarse - middle)) / np.max(np.abs(middle - fine))) < 2.3


def test_gradient_in_wall_values_of_each_step():
    """Rows of `inputs` along a wall, one for each step."""
    rows = np.linspace(0.0, 1.0, 6).reshape(3, 2)
    step, state = plate(32, True, lambda row: anp.concatenate([row * anp.ones(2), np.zeros(2)]))

    def loss(rows):
        run = dp.rollout(lambda state, params, row: step(state, row), state, None, 3, inputs=rows)
        return anp.sum(run["s"]["heat"] ** 3)

    gradient = dp.grad(loss)(rows)
    for place in ((0, 0), (2, 1)):
        change = np.zeros_like(rows)
        change[place] = 1e-4
        assert (loss(rows + change) - loss(rows - change)) / 2e-4 == pytest.approx(gradient[place], rel=1e-6)
    assert np.all(gradient > 0)
    with pytest.raises(dp.errors.ShapeError, match=r"write dp.lift\(grid, boundary\).domain.join\(...\)"):
        plate(32, True, lambda params: np.zeros(3))
