"""flow_step with a viscosity, diffusivity, density and step length that vary."""

from functools import partial

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.flow.diffusion import wave_growth


def channel(n):
    """A channel between y = 0 and y = 1 that is periodic along x."""
    return dp.Grid((1, n), spacing=[np.ones(1), np.full(n, 1 / n)], periodic=(True, False))


def steady_speeds(grid, viscosity, params, steps, dt, s=None, scalars=None):
    """Return the speeds of a channel after many implicit steps under a constant force."""
    if s is None:
        force = lambda v, params: grid.join(1.0, 0.0)
    else:
        force = lambda v, s, params: grid.join(1.0, 0.0)
    step = dp.flow_step(grid, dt, viscosity, force, implicit=True, convective=False, scalars=scalars)
    end = dp.rollout(step, step.start(np.zeros(grid.faces.size), params, s), params, steps)
    return grid.split(end["v"])[0][0]


@pytest.mark.parametrize(
    ("sides", "solid"),
    [
        (dp.no_slip, False),
        ({"x": (dp.inflow, dp.outflow), "y": (dp.free_slip, dp.outflow)}, False),
        ({"x": (dp.inflow, dp.outflow), "y": dp.no_slip}, True),
    ],
)
def test_a_constant_field_is_a_number(rng, sides, solid):
    """For a velocity without divergence the stress equals the Laplacian, at walls, outflows and obstacles too."""
    grid = dp.Grid((7, 6), spacing=[rng.uniform(0.8, 1.2, 7), rng.uniform(0.8, 1.2, 6)])
    obstacle = np.zeros(grid.shape, bool)
    obstacle[2:4, 2:4] = solid
    walls = rng.standard_normal(dp.face_lift(grid, sides).domain.size)
    options = {"boundary": sides, "solid": obstacle, "walls": lambda params: walls}
    v = rng.standard_normal(grid.faces.size)
    number = dp.flow_step(grid, 1e-3, 0.1, **options).start(v)["a"]
    field = dp.flow_step(grid, 1e-3, np.full(grid.shape, 0.1), **options).start(v)["a"]
    np.testing.assert_allclose(field, number, rtol=1e-12, atol=1e-12)


@pytest.mark.whole
def test_three_axes(rng):
    grid = dp.Grid((4, 3, 2), periodic=(False, True, False))
    v = rng.standard_normal(grid.faces.size)
    number = dp.flow_step(grid, 1e-3, 0.1).start(v)["a"]
    field = dp.flow_step(grid, 1e-3, np.full(grid.shape, 0.1)).start(v)["a"]
    np.testing.assert_allclose(field, number, rtol=1e-12, atol=1e-12)


def test_stress_and_shear_rate_of_a_strain():
    """The velocity (y, x, 0) has the shear rate 2; with the viscosity 1 + x its stress pushes along y, by 2."""
    grid = dp.Grid((6, 5, 4), spacing=0.1)
    v = grid.join(grid.face_centres(0)[1], grid.face_centres(1)[0], 0.0)
    step = dp.flow_step(grid, 1e-4, lambda rate, params: rate, convective=False)
    rate = step.viscous.form.shear_rate(v)
    np.testing.assert_allclose(rate[1:-1, 1:-1, 1:-1], 2.0, rtol=1e-12)
    field = dp.flow_step(grid, 1e-4, 1 + grid.centres()[0], convective=False).viscous.form
    push = grid.split(field.flux_divergence(field.at_sites(1 + grid.centres()[0]), v))
    np.testing.assert_allclose(push[0][2:-2, 1:-1, 1:-1], 0.0, atol=1e-12)
    np.testing.assert_allclose(push[1][1:-1, 2:-2, 1:-1], 2.0, rtol=1e-2)
    stretched = grid.join(grid.face_centres(0)[0], -grid.face_centres(1)[1], 0.0)  # du/dx = -dv/dy = 1
    np.testing.assert_allclose(step.viscous.form.shear_rate(stretched)[1:-1, 1:-1, 1:-1], 2.0, rtol=1e-12)


def test_shear_rate_beside_a_moving_wall():
    """Couette flow has the same shear rate everywhere, beside the walls too."""
    grid = channel(6)
    walls = dp.face_lift(grid).domain.join(0.0, 3.0)
    step = dp.flow_step(grid, 0.01, lambda rate, params: rate, walls=lambda params: walls)
    rate = step.viscous.form.shear_rate(grid.join(3.0 * grid.face_centres(0)[1], 0.0), walls)
    np.testing.assert_allclose(rate, 3.0, rtol=1e-12)


@pytest.mark.whole
def test_power_law_fluid():
    """Shear-thinning with exponent 1/2: the mean speed is n / (2 n + 1) (1/2)^(1 + 1/n), of order 2."""

    def error(cells):
        speeds = steady_speeds(channel(cells), lambda rate, n: (1e-6 + rate**2) ** ((n - 1) / 2), 0.5, 60, 0.03)
        return np.mean(speeds) / 0.03125 - 1

    assert abs(error(16)) < 6e-3
    assert error(8) / error(16) > 2.8  # tends to 4: the viscosity in the middle is singular


@pytest.mark.parametrize("law", ["smagorinsky", pytest.param("plastic", marks=pytest.mark.whole)])
def test_long_steps_of_laws_of_the_shear_rate(law):
    """Steps far beyond the explicit limit reach the exact steady flow of a channel, with a shear stress 1/2 - y."""
    cells = 8
    stress = 0.5 - (np.arange(cells) + 0.5) / cells
    if law == "smagorinsky":  # (0.001 + 0.25 g) g = stress
        viscosity = lambda rate, p: 0.001 + 0.25 * rate
        rate = (np.sqrt(1e-6 + np.abs(stress)) - 0.001) / 0.5
    else:  # (0.1 + 1 / (g + 1)) g = stress
        viscosity = lambda rate, p: 0.1 + 1 / (1 + rate)
        excess = 1.1 - np.abs(stress)
        rate = (np.sqrt(excess**2 + 0.4 * np.abs(stress)) - excess) / 0.2
    speeds = steady_speeds(channel(cells), viscosity, None, 40, 1.0)
    slopes = np.sign(stress) * rate
    exact = (np.cumsum(slopes) - 0.5 * slopes) / cells
    np.testing.assert_allclose(speeds, exact, atol=0.08 * np.max(exact))


@pytest.mark.whole
def test_order_in_time_of_an_implicit_law():
    """A decaying flow with a viscosity that increases with the shear rate: order 2."""
    grid = channel(8)
    y = grid.face_centres(0)[1]

    def end(n):
        step = dp.flow_step(grid, 1 / n, lambda rate, p: 0.05 + 0.05 * rate, implicit=True)
        return dp.rollout(step, step.start(grid.join(np.sin(np.pi * y), 0.0)), None, n)["v"]

    coarse, middle, fine = end(20), end(40), end(80)
    assert np.max(np.abs(coarse - middle)) / np.max(np.abs(middle - fine)) > 3.6


@pytest.mark.whole
def test_viscosity_of_temperature():
    """A channel with a hot wall and exp(-b T): (exp(b y) (y0 - y))' integrates to the exact profile."""
    b = 2.0

    def error(cells):
        grid = channel(cells)
        hot = {"y": dp.dirichlet}
        values = dp.lift(grid, hot).domain.join(0.0, 1.0)
        heat = {"diffusivity": 1.0, "boundary": hot, "values": values}
        y = grid.centres()[1]
        viscosity = lambda rate, s, b: anp.exp(-b * s["heat"])
        speeds = steady_speeds(grid, viscosity, b, 40, 0.1, {"heat": y}, scalars={"heat": heat})
        y = y[0]
        middle = (np.exp(b) * (b - 1) + 1) / b / (np.exp(b) - 1)  # where the shear rate is 0
        antiderivative = lambda y: np.exp(b * y) * (middle / b - y / b + 1 / b**2)
        return np.max(np.abs(speeds - antiderivative(y) + antiderivative(0.0)))

    assert error(16) < 3e-3
    assert error(8) / error(16) > 3.5


def test_two_layers():
    """Couette flow of two layers with viscosities 1 and 1e6: the exact profile, linear in each layer, is steady."""
    grid = channel(8)
    y = grid.centres()[1][0]
    viscosity = np.where(grid.centres()[1] < 0.5, 1.0, 1e6)
    stress = 1 / (0.5 + 0.5e-6)
    exact = np.where(y < 0.5, stress * y, 1 - stress * (1 - y) * 1e-6)
    walls = dp.face_lift(grid).domain.join(0.0, 1.0)
    step = dp.flow_step(grid, 0.1, viscosity, implicit=True, walls=lambda params: walls)
    end = dp.rollout(step, step.start(grid.join(exact, 0.0)), None, 10)
    np.testing.assert_allclose(grid.split(end["v"])[0][0], exact, rtol=1e-9)


@pytest.mark.parametrize("ratio", [1000.0, 1e6])
def test_two_layers_at_rest(ratio):
    """Heavy below light fluid stays at rest up to rounding, and the pressure balances the weight."""
    grid = dp.Grid((5, 6), size=1.0)
    y = grid.centres()[1]
    density = np.where(y > 0.5, 1.0, ratio)
    step = dp.flow_step(grid, 0.01, 1e-3, lambda v, params: grid.join(0.0, -9.8), density=density)
    end = dp.rollout(step, step.start(np.zeros(grid.faces.size)), None, 20)
    assert np.max(np.abs(end["v"])) < 1e-15 * ratio
    weight = 9.8 * (ratio * (0.5 - 1 / 12) + 0.5 - 1 / 12)
    np.testing.assert_allclose(np.ptp(end["p"]), weight, rtol=1e-12)


def test_density_one_is_no_density(rng):
    grid = dp.Grid((6, 5))
    v = rng.standard_normal(grid.faces.size)
    plain = dp.flow_step(grid, 0.01, 0.1)
    given = dp.flow_step(grid, 0.01, 0.1, density=np.ones(grid.shape))
    heavy = dp.flow_step(grid, 0.01, 0.3, density=3.0)
    ends = [dp.rollout(step, step.start(v), None, 3) for step in (plain, given, heavy)]
    np.testing.assert_allclose(ends[1]["v"], ends[0]["v"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ends[2]["v"], ends[0]["v"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ends[2]["p"], 3.0 * ends[0]["p"], rtol=1e-9, atol=1e-9)


def test_projection_with_a_density(rng):
    """No divergence, v - P(v) is a gradient divided by the density, and all derivatives are right."""
    grid = dp.Grid((4, 3), spacing=[rng.uniform(0.5, 1, 4), rng.uniform(0.5, 1, 3)])
    solid = np.zeros((4, 3), bool)
    solid[1, 1] = True
    project = dp.projection(grid, solid, {"x": (dp.inflow, dp.outflow)})
    v = rng.standard_normal(grid.faces.size)
    density = 10.0 ** rng.uniform(-1, 2, grid.shape)
    result = project(v, density)
    assert np.max(np.abs(dp.divergence(grid)(result))) < 1e-10
    np.testing.assert_allclose(project(v, 7.0), project(v), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(project(v, np.full(v.shape, 3.0)), project(v), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(project(result, density), result, rtol=1e-9, atol=1e-9)
    pushed = project(
        dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)}, solid)(rng.standard_normal((4, 3))) / 5.0, 5.0
    )
    np.testing.assert_allclose(pushed, 0.0, atol=1e-9)
    weights = rng.standard_normal(grid.faces.size)
    loss = lambda x: anp.sum(weights * project(x["v"], x["density"]) ** 2)
    given = {"v": v, "density": density}
    direction = {"v": rng.standard_normal(v.shape), "density": density * rng.standard_normal(density.shape)}
    moved = lambda t: {key: given[key] + t * direction[key] for key in given}
    inner = lambda a: sum(np.sum(a[key] * direction[key]) for key in a)
    slope = inner(dp.grad(loss)(given))
    assert dp.jvp(loss, given, direction)[1] == pytest.approx(slope, rel=1e-8)
    assert (loss(moved(1e-5)) - loss(moved(-1e-5))) / 2e-5 == pytest.approx(slope, rel=1e-6)
    curvature = (inner(dp.grad(loss)(moved(1e-5))) - inner(dp.grad(loss)(moved(-1e-5)))) / 2e-5
    assert inner(dp.hvp(loss, given, direction)) == pytest.approx(curvature, rel=1e-5)


@pytest.mark.whole
def test_rayleigh_taylor():
    """Growth of a wave on the interface of two fluids without viscosity, by linear theory."""
    grid = dp.Grid((16, 32), size=(1.0, 2.0), periodic=(True, False))
    x, y = grid.face_centres(1)
    heavy = np.where(grid.centres()[1] > 1, 1.0, 0.0)
    step = dp.flow_step(
        grid,
        0.03,
        force=lambda v, s, ratio: grid.join(0.0, -1.0),
        density=lambda s, ratio: 1 + (ratio - 1) * s["heavy"],
        scalars={"heavy": {}},
    )
    start = grid.join(0.0, 1e-6 * np.cos(2 * np.pi * x) * np.exp(-2 * np.pi * np.abs(y - 1)))
    middle, end = dp.rollout(step, step.start(start, 3.0, {"heavy": heavy}), 3.0, 100, keep=[70, 100])["v"]
    growth = np.log(np.sum(end**2) / np.sum(middle**2)) / (2 * 30 * 0.03)
    assert growth == pytest.approx(np.sqrt(np.pi), rel=0.1)  # 9.5 % with 16 cells a wavelength, 2.5 % with 64


@pytest.mark.parametrize("varies", [False, True])
def test_oscillating_wall(varies):
    """Stokes' second problem in a channel: the wall velocity is a function of time, given by the inputs."""
    viscosity, frequency = 0.02, 2 * np.pi
    decay = np.sqrt(1j * frequency / viscosity)
    given = (lambda speed: viscosity) if varies else viscosity

    def error(n):
        grid = channel(n)
        y = grid.centres()[1]
        exact = lambda t: np.real(np.exp(1j * frequency * t) * np.sinh(decay * (1 - y)) / np.sinh(decay))
        times = np.arange(1, 2 * n + 1) / (2 * n)
        walls = dp.face_lift(grid).domain
        flow = dp.flow_step(
            grid, 0.5 / n, given, implicit=True, convective=False, walls=lambda speed: walls.join(speed, 0.0)
        )
        step = lambda state, params, speed: flow(state, speed)
        start = flow.start(grid.join(exact(0.0), 0.0), 1.0)
        end = dp.rollout(step, start, None, 2 * n, inputs=np.cos(frequency * times))
        return np.max(np.abs(grid.split(end["v"])[0] - exact(1.0)))

    assert error(16) / error(32) > 3.9


def test_step_length_of_params():
    """A constant function gives the numbers of a constant; steps of different length keep order 2."""
    grid = dp.Grid((6, 6), size=1.0, periodic=True)
    x, y = (2 * np.pi * c for c in grid.face_centres(0))
    z, w = (2 * np.pi * c for c in grid.face_centres(1))
    start = grid.join(np.sin(x) * np.cos(y), -np.cos(z) * np.sin(w))
    constant = dp.flow_step(grid, 0.01, 0.05)
    varying = dp.flow_step(grid, lambda dt: dt, 0.05)
    ends = [dp.rollout(step, step.start(start, 0.01), 0.01, 3) for step in (constant, varying)]
    np.testing.assert_allclose(ends[1]["v"], ends[0]["v"], rtol=1e-14, atol=1e-15)

    def end(n):
        lengths = 1 + 0.5 * (-1.0) ** np.arange(n)
        lengths *= 0.2 / np.sum(lengths)
        step = lambda state, params, dt: varying(state, dt)
        return dp.rollout(step, varying.start(start, lengths[0]), None, n, inputs=lengths)["v"]

    coarse, middle, fine = end(10), end(20), end(40)
    assert np.max(np.abs(coarse - middle)) / np.max(np.abs(middle - fine)) > 3


def test_diffusivity_in_layers():
    """Conduction through two layers in series is exact, explicit and implicit."""
    grid = dp.Grid(8, size=1.0)
    ends = {"x": dp.dirichlet}
    values = dp.lift(grid, ends).domain.join(0.0, 1.0)
    diffusivity = np.where(grid.centres()[0] < 0.5, 1.0, 4.0)
    y = grid.centres()[0]
    exact = np.where(y < 0.5, 1.6 * y, 1 - 0.4 * (1 - y))
    for implicit in (False, True):
        heat = {"diffusivity": lambda k: k, "boundary": ends, "values": values}
        step = dp.flow_step(grid, 5e-4, scalars={"heat": heat}, implicit=implicit, convective=False)
        start = step.start(np.zeros(9), diffusivity, {"heat": exact})
        end = step(step(start, diffusivity), diffusivity)
        np.testing.assert_allclose(end["s"]["heat"], exact, rtol=1e-12)


def test_smagorinsky_at_rest():
    """The shear rate is 0 at rest, and so is its derivative."""
    grid = dp.Grid((4, 4))
    step = dp.flow_step(grid, 0.1, lambda rate, c: c * rate)
    gradient = dp.grad(lambda v: anp.sum(step(step.start(v, 0.1), 0.1)["v"] ** 2))(np.zeros(grid.faces.size))
    assert np.all(gradient == 0)


def nothing_bound(rate, s, params, *, power=1.0):
    return params * (1 + rate) ** power * s["c"]


class Law:
    """An object that is called, and a method that is."""

    def __call__(self, rate, s, params):
        return nothing_bound(rate, s, params)

    def at(self, params):
        return 2 * params


@pytest.mark.parametrize(
    ("law", "plain"),
    [
        (Law(), nothing_bound),
        (Law().__call__, nothing_bound),
        (partial(nothing_bound, power=2.0), lambda rate, s, p: p * (1 + rate) ** 2 * s["c"]),
        (lambda rate, *rest: nothing_bound(rate, *rest), None),
        (lambda rate, s, p=None: nothing_bound(rate, s, p), nothing_bound),
        (lambda rate, s=None, p=None: nothing_bound(rate, s, p), None),
        (dp.jit(lambda rate, s, p: nothing_bound(rate, s, p)), nothing_bound),
        (Law().at, lambda p: 2 * p),
        (lambda p, *, k=3.0: k * p, lambda p: 3 * p),
        (lambda p, k=3.0: k * p, lambda p: 3 * p),
        (partial(lambda k, p: k * p, 3.0), lambda p: 3 * p),
        (lambda *params: 3 * params[0], None),
        (lambda: 3.0, None),
    ],
)
def test_functions_of_all_kinds(law, plain, rng):
    """A viscosity with scalars is called with one argument or with three, whichever it accepts; both are refused."""
    grid = dp.Grid((3, 3))
    v = rng.standard_normal(grid.faces.size)
    c = rng.uniform(0.5, 1.0, grid.shape)

    def rate(viscosity):
        step = dp.flow_step(grid, 1e-3, viscosity, scalars={"c": {}})
        return step.start(v, 0.1, {"c": c})["a"]

    if plain is None:
        with pytest.raises(TypeError, match="^flow_step calls viscosity with 1 or 3 arguments, got a function "):
            rate(law)
    else:
        np.testing.assert_array_equal(rate(law), rate(plain))


@pytest.mark.sampled(0)
@pytest.mark.parametrize("argument", ["density", "diffusivity", "dt"])
def test_methods_as_other_arguments(argument, rng):
    """Density and diffusivity take the params, or scalars and params; dt the params, with or without default values."""
    grid = dp.Grid((3, 3))
    c = rng.uniform(0.5, 1.0, grid.shape)

    def end(**given):
        scalars = {"c": {"diffusivity": given.pop("diffusivity", 0.0)}}
        step = dp.flow_step(grid, **{"dt": 1e-3, **given}, viscosity=0.1, scalars=scalars)
        state = step(step.start(np.arange(24.0), 0.01, {"c": c}), 0.01)
        return np.concatenate([state["v"], state["s"]["c"].ravel()])

    np.testing.assert_array_equal(end(**{argument: Law().at}), end(**{argument: lambda p: 2 * p}))
    ambiguous = lambda p, q=2.0: q * p
    if argument == "dt":
        np.testing.assert_array_equal(end(dt=ambiguous), end(dt=lambda p: 2 * p))
        return
    method = partial(lambda q, s, p: q * p * s["c"], 2.0)
    np.testing.assert_array_equal(end(**{argument: method}), end(**{argument: lambda s, p: 2 * p * s["c"]}))
    with pytest.raises(TypeError, match=f"^flow_step calls {argument} with 1 or 2 arguments, got a function that acc"):
        end(**{argument: ambiguous})


@pytest.mark.whole
def test_lifted_walls_beside_a_viscosity_for_each_cell(rng):
    """The array of face_lift gives the step of the function that returns the velocities."""
    grid = dp.Grid((4, 3), spacing=[rng.uniform(0.5, 1, 4), rng.uniform(0.5, 1, 3)])
    lift = dp.face_lift(grid)
    speeds = rng.standard_normal(lift.domain.size)
    viscosity = rng.uniform(0.01, 0.02, grid.shape)
    v = rng.standard_normal(grid.faces.size)
    for implicit, medium in ((False, viscosity), (True, viscosity), (True, lambda p: 0.1)):
        for density in (None, 2.0):
            options = {"density": density, "implicit": implicit}
            steps = [
                dp.flow_step(grid, 0.01, medium, walls=walls, **options) for walls in (lift(speeds), lambda p: speeds)
            ]
            ends = [dp.rollout(step, step.start(v), None, 2)["v"] for step in steps]
            np.testing.assert_allclose(ends[0], ends[1], rtol=1e-11, atol=1e-12)


def test_implicit_diffusivity_of_a_scalar():
    """Steady conduction for the diffusivity 1 + u, and order 2 in time; values at walls may be a list."""
    grid = dp.Grid(16, size=1.0)
    ends = {"x": dp.dirichlet}
    heat = {"diffusivity": lambda s, p: 1 + p * s["u"], "boundary": ends, "values": [0.0, 1.0]}
    x = grid.centres()[0]

    def end(dt, time, start):
        step = dp.flow_step(grid, dt, scalars={"u": heat}, implicit=True, convective=False)
        return dp.rollout(step, step.start(np.zeros(17), 1.0, {"u": start}), 1.0, round(time / dt))["s"]["u"]

    np.testing.assert_allclose(end(0.1, 3.0, x), np.sqrt(1 + 3 * x) - 1, atol=1e-3)
    start = x + 0.5 * np.sin(np.pi * x)
    coarse, middle, fine = (end(0.02 / n, 0.08, start) for n in (1, 2, 4))
    assert np.max(np.abs(coarse - middle)) / np.max(np.abs(middle - fine)) > 3.5


def batch(rng, lead, implicit):
    """Return a run of flows with media of their own, their velocities and scalars."""
    grid = dp.Grid((4, 3), spacing=0.5)
    step = dp.flow_step(
        grid,
        0.01,
        lambda rate, s, p: p * (1 + rate) * s["c"],
        density=lambda s, p: 1 + s["c"],
        scalars={"c": {"diffusivity": lambda s, p: p * s["c"]}},
        implicit=implicit,
    )
    v = rng.standard_normal((*lead, grid.faces.size))
    c = rng.uniform(0.5, 1, (*lead, *grid.shape))
    return lambda v, c, p: step(step.start(v, p, {"c": c}), p), v, c


@pytest.mark.sampled(0)
@pytest.mark.parametrize("implicit", [False, True])
@pytest.mark.parametrize("lead", [(2,), (2, 1, 2)])
def test_a_batch_of_flows(lead, implicit, rng):
    """Each entry has its own viscosity, density and diffusivity."""
    run, v, c = batch(rng, lead, implicit)
    end = run(v, c, 0.1)
    for entry in np.ndindex(*lead):
        alone = run(v[entry], c[entry], 0.1)
        np.testing.assert_allclose(end["v"][entry], alone["v"], rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(end["s"]["c"][entry], alone["s"]["c"], rtol=1e-10)


@pytest.mark.whole
@pytest.mark.parametrize("implicit", [False, True])
def test_derivatives_of_a_batch_of_flows(implicit, rng):
    run, v, c = batch(rng, (2,), implicit)
    loss = lambda x: anp.sum(run(x["v"], x["c"], x["p"])["v"] ** 3)
    assert dp.check.gradient(loss, {"v": v, "c": c, "p": 0.1}, quick=True).verdict == "agrees"


def test_a_batch_of_projections(rng):
    """A batch of velocities, of densities, or of both, and their derivatives."""
    grid = dp.Grid((2, 3), spacing=0.5)
    project = dp.projection(grid)
    v = rng.standard_normal((2, grid.faces.size))
    weights = rng.standard_normal(v.shape)
    for density in (rng.uniform(0.5, 2, (2, *grid.shape)), rng.uniform(0.5, 2, (2, grid.faces.size))):
        of_all = project(v, density[0])
        np.testing.assert_allclose(of_all, [project(one, density[0]) for one in v], rtol=1e-9, atol=1e-9)
        of_pairs = project(v, density)
        np.testing.assert_allclose(of_pairs, list(map(project, v, density)), rtol=1e-9, atol=1e-9)
        of_densities = project(v[0], density)
        np.testing.assert_allclose(of_densities, [project(v[0], rho) for rho in density], rtol=1e-9, atol=1e-9)
        together = lambda x, v=v: anp.sum(weights * project(v, x) ** 2)
        one_by_one = lambda x, v=v: sum(anp.sum(weights[i] * project(v[i], x[i]) ** 2) for i in range(2))
        wanted = dp.grad(one_by_one)(density)
        np.testing.assert_allclose(dp.grad(together)(density), wanted, rtol=1e-6, atol=1e-8)
    deep = project(v[:, None] * np.ones((2, 2, 1)), density[0])
    np.testing.assert_allclose(deep[1, 1], project(v[1], density[0]), rtol=1e-9, atol=1e-9)


def test_limit_of_the_courant_number():
    """Up to 0.5 steps are accepted, and waves grow by 2.7 %; above, without viscosity, they are refused."""
    assert wave_growth(0.5, 0.0, False) == pytest.approx(1.0267, abs=1e-4)
    grid = dp.Grid((4, 4), periodic=True)
    wind = np.ones(grid.faces.size)
    for dt in (0.25, 0.2501):
        step = dp.flow_step(grid, dt)
        if dt == 0.25:
            np.testing.assert_allclose(step(step.start(wind))["v"], 1.0)
        else:
            with pytest.raises(dp.errors.UnstableStepError, match="dt = 0.25 is safe"):
                step(step.start(wind))


@pytest.mark.sampled(0)
@pytest.mark.parametrize("number", [float, np.float64, np.asarray])
def test_functions_that_return_double_precision(number):
    """A flow in single precision stays so, forward and in its derivative."""
    grid = dp.Grid((3, 3))
    ones = np.ones(grid.faces.size)
    state = lambda step, p: step.start(ones.astype(np.float32), p, {"c": np.ones(grid.shape, np.float32)})
    scalars = {"c": {"diffusivity": lambda p: number(0.1), "source": lambda s, p: np.ones(grid.shape)}}
    media = {"viscosity": lambda p: number(0.1), "density": lambda p: number(2.0), "scalars": scalars}
    media |= {"dt": lambda p: number(0.1), "force": lambda v, s, p: ones}
    for more in ({"implicit": True}, {"friction": ones}, {"friction": lambda p: ones}):
        step = dp.flow_step(grid, **media, **more)
        end = step(step(state(step, None)))
        assert {leaf.dtype for leaf in (end["v"], end["p"], end["a"], end["dt"], *end["s"].values())} == {
            np.dtype(np.float32)
        }
    step = dp.flow_step(grid, lambda p: p, lambda p: p, scalars={"c": {}})
    energy = lambda p: anp.sum(step(state(step, p), p)["v"] ** 2)
    value, _ = dp.value_and_grad(energy)(0.1)
    assert value == energy(np.asarray(0.1))


@pytest.mark.sampled(0)
@pytest.mark.parametrize("implicit", [False, True])
@pytest.mark.parametrize("density", [None, 1.5])
def test_numbers_in_double_precision(implicit, density, rng):
    """NumPy numbers do not change the precision of a flow; the step is the one with Python numbers, bit for bit."""
    grid = dp.Grid((3, 4))
    v, c = rng.standard_normal(grid.faces.size).astype(np.float32), rng.standard_normal(grid.shape).astype(np.float32)

    def end(number):
        scalars = {"c": {"diffusivity": number(0.02)}}
        fluid = None if density is None else number(density)
        step = dp.flow_step(grid, number(0.1), number(0.03), scalars=scalars, implicit=implicit, density=fluid)
        state = step(step(step.start(v, None, {"c": c})))
        return state["v"], state["p"], state["a"], state["s"]["c"], state["r"]["c"]

    for number in (np.float64, np.asarray):
        for ours, plain in zip(end(number), end(float), strict=True):
            assert ours.dtype == np.float32
            np.testing.assert_array_equal(ours, plain)


def test_a_step_at_the_limit_in_single_precision():
    """A step length at the limit may be rounded up."""
    grid = dp.Grid((4, 4))
    for dt in np.linspace(0.3, 0.7, 9):
        step = dp.flow_step(grid, lambda p, dt=dt: dt, 0.125 / dt)
        step.start(np.zeros(grid.faces.size, np.float32))


@pytest.mark.whole
def test_single_precision():
    grid = dp.Grid((4, 4))
    laws = {"viscosity": lambda rate, s, p: p * (1 + rate) * s["c"], "density": lambda s, p: 1 + s["c"]}
    for implicit in (False, True):
        step = dp.flow_step(grid, 0.1, scalars={"c": {"diffusivity": lambda p: p}}, implicit=implicit, **laws)
        p = np.full(grid.shape, 0.1)
        state = step.start(np.ones(grid.faces.size, np.float32), p, {"c": np.ones(grid.shape, np.float32)})
        end = step(state, p)
        assert end["v"].dtype == end["p"].dtype == end["s"]["c"].dtype == np.float32


def test_lists_and_complex_velocities(rng):
    """A list is an array; a complex velocity keeps its imaginary part."""
    grid = dp.Grid((3, 3))
    v = rng.standard_normal(grid.faces.size)
    listed, array = (dp.flow_step(grid, 0.01, mu, convective=False) for mu in ([[0.1] * 3] * 3, np.full((3, 3), 0.1)))
    plain = array(array.start(v))["v"]
    np.testing.assert_array_equal(listed(listed.start(v))["v"], plain)
    np.testing.assert_allclose(array(array.start(1j * v))["v"], 1j * plain, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("shape", [(0, 3), (1, 1)])
def test_no_cells_and_one_cell(shape):
    grid = dp.Grid(shape)
    media = np.ones(shape)
    step = dp.flow_step(grid, 0.1, media, density=media, implicit=True)
    assert np.all(step(step.start(np.ones(grid.faces.size)))["v"] == 0)


def test_large_ratios(rng):
    """Viscosities and densities that differ by 12 and 8 orders of magnitude: no energy from nothing, no divergence."""
    grid = dp.Grid((8, 8), size=1.0)
    viscosity = 10.0 ** rng.uniform(-6, 6, grid.shape)
    density = 10.0 ** rng.uniform(-4, 4, grid.shape)
    step = dp.flow_step(grid, 0.01, viscosity, density=density, implicit=True, convective=False)
    first = step.start(rng.standard_normal(grid.faces.size))
    end = dp.rollout(step, first, None, 5)
    assert np.max(np.abs(dp.divergence(grid)(end["v"]))) < 1e-8
    assert np.max(np.abs(end["v"])) < 10 * np.max(np.abs(first["v"]))
    plain = dp.flow_step(grid, 0.01, np.ones(grid.shape), density=np.full(grid.shape, 2.0**900), convective=False)
    assert np.all(np.isfinite(plain(plain.start(first["v"]))["v"]))


LAWS = {
    "field": {"viscosity": lambda p: p["mu"]},
    "all": {
        "viscosity": lambda rate, s, p: p["mu"] * (0.01 + rate**2) ** ((p["n"] - 1) / 2) * anp.exp(-s["c"]),
        "density": lambda s, p: 1 + p["rho"] * s["c"],
        "scalars": {"c": {"diffusivity": lambda p: p["k"], "boundary": {"x": dp.dirichlet}}},
        "dt": lambda p: p["dt"],
    },
}


def loss_of(law, implicit, rng):
    """Return a loss of three steps, and its params."""
    grid = dp.Grid((4, 3), spacing=[rng.uniform(0.8, 1.2, 4), rng.uniform(0.8, 1.2, 3)])
    v = rng.standard_normal(grid.faces.size)
    weights = rng.standard_normal(grid.faces.size)
    given = {"dt": 0.02, **LAWS[law]}
    params = {"mu": 0.1 + 0.1 * rng.uniform(size=grid.shape), "n": 0.6, "dt": 0.02, "v": v}
    params["rho"] = rng.uniform(size=grid.shape)
    params["k"] = 0.1 + rng.uniform(size=grid.shape)

    def loss(params):
        step = dp.flow_step(grid, implicit=implicit, **given)
        s = {"c": anp.ones(grid.shape)} if "scalars" in given else None
        end = dp.rollout(step, step.start(params["v"], params, s), params, 2)
        return anp.sum(weights * end["v"]) + anp.sum(end["v"] ** 2)

    return loss, params


@pytest.mark.whole
@pytest.mark.parametrize(("law", "implicit"), [("field", True), ("all", False)])
def test_gradients(law, implicit, rng):
    loss, params = loss_of(law, implicit, rng)
    assert dp.check.gradient(loss, params, quick=True).verdict == "agrees"


@pytest.mark.whole
@pytest.mark.parametrize("implicit", [False, True])
def test_derivatives_of_all_orders_and_modes(implicit, rng):
    """vjp, jvp and hvp of all arguments agree with each other and with differences; jit with the plain step."""
    loss, params = loss_of("all", implicit, rng)
    direction = scaled(lambda leaf: 0.1 * leaf * np.cos(np.arange(np.size(leaf))).reshape(np.shape(leaf)), params)
    value, gradient = dp.value_and_grad(loss)(params)
    inner = lambda a, b: sum(np.sum(a[key] * b[key]) for key in a)
    moved = lambda t: {key: params[key] + t * direction[key] for key in params}
    slope = inner(gradient, direction)
    assert dp.jvp(loss, params, direction)[1] == pytest.approx(slope, rel=1e-10)
    differences = (loss(moved(1e-4)) - loss(moved(-1e-4))) / 2e-4
    assert differences == pytest.approx(slope, rel=1e-6)
    change = dp.hvp(loss, params, direction)
    before, after = (inner(dp.grad(loss)(moved(t)), direction) for t in (-1e-4, 1e-4))
    assert inner(change, direction) == pytest.approx((after - before) / 2e-4, rel=1e-5)
    assert dp.jit(loss)(params) == value


def scaled(function, tree):
    return {key: function(leaf) for key, leaf in tree.items()}


def test_whole_numbers_are_floats():
    """Fields of integers give the results of their float64 copies: density and diffusivity are not rounded."""
    grid = dp.Grid((2, 2))
    density = np.array([[1.2, 1.9], [3.3, 4.0]])
    project = dp.projection(grid)
    v = np.arange(grid.faces.size)
    np.testing.assert_array_equal(project(v, density), project(v * 1.0, density))
    np.testing.assert_array_equal(project(v, 0.5), project(v * 1.0, 0.5))
    step = dp.flow_step(grid, 0.01, scalars={"h": {"diffusivity": np.full(grid.shape, 0.9)}})
    h = np.array([[0, 1], [2, 4]])
    found = step(step.start(0.0 * v, None, {"h": h}), None)["s"]["h"]
    np.testing.assert_allclose(found, step(step.start(0.0 * v, None, {"h": 1.0 * h}), None)["s"]["h"], rtol=1e-15)
    assert np.any(found != h)
