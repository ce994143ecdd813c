"""Viscosity, moving walls, convection and the flow step: identities, orders, derivatives, and what is not built."""

import re
from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pushforward, value_and_grad

FINITE = dp.errors.NonFiniteError


def field(grid, seed=0):
    return np.random.default_rng(seed).standard_normal(grid.faces.size)


def grids(shape):
    rng = np.random.default_rng(3)
    for periodic in product((False, True), repeat=len(shape)):
        yield dp.Grid(shape, spacing=0.3, periodic=periodic)
        yield dp.Grid(shape, spacing=[rng.uniform(0.5, 2.0, n) for n in shape], periodic=periodic)


# ---------------------------------------------------------------- viscosity


def test_explicit_viscosity_at_its_limit_does_not_grow():
    grid = dp.Grid((16, 16), size=1.0)
    v = np.random.default_rng(0).standard_normal(grid.faces.size)
    step = dp.flow_step(grid, 0.125 / 256, 1.0, convective=False)
    first = dp.rollout(step, step.start(v), None, 20)["v"]
    assert np.max(np.abs(dp.rollout(step, step.start(v), None, 300)["v"])) < np.max(np.abs(first))


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", [(6, 5), (4, 3, 5), (7,)])
@pytest.mark.parametrize("word", [dp.no_slip, dp.free_slip])
def test_viscosity_is_symmetric_and_dissipates_energy(shape, word):
    """With W the volumes of the faces and K those inside, W K L K is symmetric and not positive."""
    for grid in grids(shape):
        K = dp.interior(grid)
        matrix = (K @ dp.face_laplacian(grid, word) @ K).matrix.toarray() * grid.faces.volumes[:, None]
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
        assert np.linalg.eigvalsh(matrix).max() <= 1e-12


def test_laplacian_of_a_solenoidal_field_is_minus_curl_curl():
    grid = dp.Grid((8, 9), size=(1.0, 2.0), periodic=True)
    psi = np.random.default_rng(1).standard_normal(grid.nodes.shape)
    v = dp.curl(grid)(psi)
    vorticity = -dp.curl(grid).T(v)
    np.testing.assert_allclose(dp.face_laplacian(grid)(v), dp.curl(grid)(vorticity), atol=1e-9)


@pytest.mark.parametrize("word", [dp.no_slip, dp.free_slip])
def test_laplacian_around_obstacles_agrees_with_a_hand_calculation(word):
    """One solid cell in the middle of 5 x 5 unit cells; the x-face just above it."""
    grid = dp.Grid((5, 5))
    solid = np.zeros(grid.shape, bool)
    solid[2, 2] = True
    L = dp.face_laplacian(grid, dp.no_slip, solid, word)
    v = dp.interior(grid, solid)(field(grid))
    u = grid.split(v)[0]
    bent = grid.split(L(v))[0]
    below = -u[2, 3] if word == dp.no_slip else u[2, 3]  # the mirror image in the upper side of the obstacle
    wanted = u[1, 3] + u[3, 3] + u[2, 4] + below - 4 * u[2, 3]
    assert bent[2, 3] == pytest.approx(wanted, rel=1e-13)
    assert bent[2, 2] == bent[3, 2] == 0.0
    far = dp.face_laplacian(grid)(v)
    assert bent[1, 1] == pytest.approx(grid.split(far)[0][1, 1], rel=1e-13)


@pytest.mark.parametrize("stretched", [False, True])
def test_moving_wall_drags_the_fluid_along(stretched):
    """Couette flow between a wall at rest and a moving one is linear, exactly."""
    widths = np.linspace(1, 2, 6) if stretched else np.ones(6)
    grid = dp.Grid((3, 6), spacing=(1.0, widths), periodic=(True, False))
    L = dp.face_laplacian(grid)
    B = dp.face_lift(grid)
    y = grid.face_centres(0)[1]
    v = grid.join(2.0 * y / grid.size[1], 0.0)
    np.testing.assert_allclose(L(v) + B(B.domain.join(0.0, 2.0)), 0, atol=1e-13)


def test_channel_is_of_second_order():
    """Poiseuille flow between walls: nu u'' = -1."""
    errors = []
    for n in (8, 16, 32):
        grid = dp.Grid((2, n), size=(1.0, 1.0), periodic=(True, False))
        solve = dp.inverse(
            dp.mask(grid.faces, ~dp.interior(grid)(np.ones(grid.faces.size)).astype(bool)) - dp.face_laplacian(grid)
        )
        u = grid.split(solve(grid.join(1.0, 0.0)))[0]
        y = grid.face_centres(0)[1]
        errors.append(np.max(np.abs(u - 0.5 * y * (1 - y))))
    assert 1.9 <= np.log2(errors[0] / errors[1]) <= 2.2 and 1.9 <= np.log2(errors[1] / errors[2]) <= 2.2


# ---------------------------------------------------------------- convection


def slices(u, w, h):
    """div(w u) on a periodic 2-D grid by slices: the twin, x-component and y-component."""
    back = lambda a, axis: anp.roll(a, 1, axis)
    ahead = lambda a, axis: anp.roll(a, -1, axis)
    (ux, uy), (wx, wy) = u, w
    xx = 0.25 * (ux + ahead(ux, 0)) * (wx + ahead(wx, 0))
    yy = 0.25 * (uy + ahead(uy, 1)) * (wy + ahead(wy, 1))
    xy = 0.25 * (ux + back(ux, 1)) * (wy + back(wy, 0))
    yx = 0.25 * (uy + back(uy, 0)) * (wx + back(wx, 1))
    return (xx - back(xx, 0) + ahead(xy, 1) - xy) / h, (yy - back(yy, 1) + ahead(yx, 0) - yx) / h


def test_convection_and_its_derivatives_agree_with_slices():
    grid = dp.Grid((6, 5), spacing=0.3, periodic=True)
    convect = dp.convection(grid)
    twin = lambda v, w: grid.join(*slices(grid.split(v), grid.split(w), 0.3))
    v, w, g = (field(grid, seed) for seed in range(3))
    np.testing.assert_allclose(convect(v, w), twin(v, w), atol=1e-13)
    for f in (
        lambda rule: lambda v: anp.sum(g * rule(v, v)),
        lambda rule: lambda v: anp.sum(rule(v, w) ** 2 * rule(w, v)),
    ):
        (value, slope), (other, wanted) = value_and_grad(f(convect))(v), value_and_grad(f(twin))(v)
        assert value == pytest.approx(other, rel=1e-12)
        np.testing.assert_allclose(slope, wanted, atol=1e-10 * np.max(np.abs(wanted)))
        second = lambda rule: value_and_grad(lambda v: anp.sum(w * value_and_grad(f(rule))(v)[1]))(v)[1]
        np.testing.assert_allclose(second(convect), second(twin), atol=1e-9 * np.max(np.abs(wanted)))
    tangent = pushforward(lambda v: convect(v, v), v, w)[1]
    np.testing.assert_allclose(tangent, convect(v, w) + convect(w, v), atol=1e-13)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", [(6, 5), (4, 3, 5), (7,)])
def test_convection_conserves(shape):
    """Momentum on periodic grids, and energy wherever nothing enters, when the carrier has no divergence."""
    for grid in grids(shape):
        w = dp.projection(grid)(field(grid))
        v = dp.interior(grid)(field(grid, 1))
        convect = dp.convection(grid)
        W = grid.faces.volumes
        rate = convect(v, w)
        if all(grid.periodic):
            for part in grid.split(W * rate):
                assert abs(np.sum(part)) <= 1e-12 * np.sum(np.abs(rate))
        if all(grid.uniform):
            assert abs(np.sum(W * v * rate)) <= 1e-10 * np.sum(W * np.abs(v * rate)) + 1e-14


def test_check_gradient_agrees_on_a_channel():
    grid = dp.Grid((8, 6), size=(2.0, 1.0))
    sides = {"x": (dp.inflow, dp.outflow)}
    solid = np.zeros(grid.shape, bool)
    solid[3, 2:4] = True
    step = dp.flow_step(grid, 0.01, 0.1, boundary=sides, solid=solid)

    def loss(v):
        return anp.sum(dp.rollout(step, step.start(v), None, 3)["v"] ** 2)

    assert dp.check.gradient(loss, field(grid), quick=True).verdict == "agrees"


# ---------------------------------------------------------------- the step


def vortex(grid):
    """A divergence-free velocity that is 0 on all walls, with its slope along them."""
    x, y = np.meshgrid(*(grid.coordinates(a, "nodes") for a in (0, 1)), indexing="ij")
    return dp.curl(grid)(np.sin(np.pi * x) ** 2 * np.sin(np.pi * y) ** 2 * (1 + x))


@pytest.mark.parametrize("implicit", [False, True])
def test_order_two_in_time(implicit):
    """Velocity of a vortex between four walls, incremental pressure: order 1.8 or more; its gradient in nu too."""
    grid = dp.Grid((10, 10), size=1.0)
    start = vortex(grid)
    end = 0.16

    def run(steps):
        step = dp.flow_step(grid, end / steps, 0.05, implicit=implicit)
        loss = lambda v: anp.sum(dp.rollout(step, step.start(v), None, steps)["v"] ** 2)
        v = dp.rollout(step, step.start(start), None, steps)["v"]
        return v, value_and_grad(loss)(start)[1]

    exact, slope = run(128)
    errors = [[np.linalg.norm(a - b) for a, b in zip(run(steps), (exact, slope))] for steps in (16, 32)]
    orders = np.log2(np.divide(*errors))
    assert np.all(orders >= 1.8) and np.all(orders <= 2.6), (orders, errors)


@pytest.mark.parametrize("implicit", [False, True])
def test_a_force_on_walls_and_inflows_does_nothing(implicit):
    """Implicit viscosity must not carry the force into the fluid, which is a first-order error."""
    grid = dp.Grid((8, 8), size=1.0)
    end = 0.016
    x, y = grid.centres()
    force = dp.average(grid)(100 * np.sin(3 * x) * y) * grid.join(0.0, 1.0)
    answers = []
    for steps in (32, 64, 128):
        step = dp.flow_step(grid, end / steps, 0.71, lambda v, params: force, implicit=implicit)
        answers.append(dp.rollout(step, step.start(np.zeros(grid.faces.size)), None, steps)["v"])
    coarse, fine = (np.max(np.abs(a - b)) for a, b in zip(answers, answers[1:]))
    assert 1.8 < np.log2(coarse / fine) < 2.2
    step = dp.flow_step(grid, 0.001, 0.71, lambda v, params: 5.0, {"x": (dp.inflow, dp.outflow)}, implicit=implicit)
    start = step.start(grid.join(1.0, 0.0))
    np.testing.assert_array_equal(grid.split(step(start)["v"])[0][0], grid.split(start["v"])[0][0])


def test_implicit_viscosity_is_stable_at_any_step():
    grid = dp.Grid((16, 16), size=1.0)
    step = dp.flow_step(grid, 1.0, 100.0, implicit=True, convective=False)
    state = dp.rollout(step, step.start(vortex(grid)), None, 20)
    assert np.max(np.abs(state["v"])) < np.max(np.abs(vortex(grid)))


def test_unneeded_operators_are_not_built():
    grid = dp.Grid((8, 8), periodic=True)
    plain = dp.flow_step(grid, 0.1)
    assert plain.viscous.op is None and plain.scalars == {}
    assert repr(plain).endswith("pressure, convection>")
    state = plain.start(field(grid))
    with recording() as calls:
        plain(state, None)
    assert not any("laplacian" in name for name, _ in calls)
    assert sum(many for (_, kind), many in calls.items() if kind == "solve") == 1


def test_free_stream_passes_an_open_channel():
    """A uniform flow between free-slip walls does not change."""
    grid = dp.Grid((10, 6))
    sides = {"x": (dp.inflow, dp.outflow), "y": dp.free_slip}
    step = dp.flow_step(grid, 0.2, 0.1, boundary=sides)
    state = dp.rollout(step, step.start(grid.join(1.0, 0.0)), None, 10)
    np.testing.assert_allclose(state["v"], grid.join(1.0, 0.0), atol=1e-12)


@pytest.mark.whole
def test_viscosity_as_a_parameter():
    """The same bits as with the number, and the energy J of Taylor-Green vortices has dJ/dnu = -4 T J."""
    grid = dp.Grid((32, 32), size=2 * np.pi, periodic=True)
    (x, y), (s, t) = grid.face_centres(0), grid.face_centres(1)
    v = grid.join(np.sin(x) * np.cos(y), -np.cos(s) * np.sin(t))
    step = dp.flow_step(grid, 0.04, lambda nu: nu)

    def energy(nu):
        return 0.5 * anp.sum(dp.rollout(step, step.start(v, nu), nu, 25)["v"] ** 2)

    value, slope = dp.value_and_grad(energy)(0.1)
    plain = dp.flow_step(grid, 0.04, 0.1)
    assert value == 0.5 * np.sum(dp.rollout(plain, plain.start(v), None, 25)["v"] ** 2)
    assert slope == pytest.approx(-4 * value, rel=0.01)
    assert dp.check.gradient(energy, 0.1, quick=True).verdict == "agrees"


@pytest.mark.parametrize("shape", [(7,), (3, 1), (1, 5, 1)])
def test_nothing_flows_in_a_closed_line_of_cells(shape):
    """Not even rounding, which an audit of the operator would take for a wrong transpose."""
    P = dp.projection(dp.Grid(shape))
    assert not np.any(P(np.arange(1.0, P.domain.size + 1.0))) and not dp.check.operator(P).failed
    assert np.any(dp.projection(dp.Grid(7), boundary={"x": (dp.inflow, dp.outflow)})(np.ones(8)))


def test_refused_arguments():
    grid = dp.Grid((4, 4))
    with pytest.raises(ValueError, match="dt of flow_step must be > 0, got 0"):
        dp.flow_step(grid, 0)
    with pytest.raises(ValueError, match="viscosity of flow_step must be >= 0, got -1"):
        dp.flow_step(grid, 0.1, -1.0)
    rest = np.zeros(grid.faces.size)
    with pytest.raises(
        dp.errors.DerivativeError,
        match="flow_step needs a constant viscosity, got a traced one; a derivative in the viscosity takes "
        "viscosity=lambda params: ...",
    ):
        dp.value_and_grad(lambda nu: anp.sum(dp.flow_step(grid, 0.1, nu).start(rest)["v"]))(0.1)
    with pytest.raises(ValueError, match="viscosity of flow_step must be >= 0, got -1"):
        dp.flow_step(grid, 0.1, lambda nu: nu).start(rest, -1.0)
    with pytest.raises(
        dp.errors.ShapeError,
        match=r"flow_step takes a dict of v, p and a as its state; write state = step.start\(v, params\)",
    ):
        dp.flow_step(grid, 0.1)({"v": rest})
    with pytest.raises(FINITE, match="dt of flow_step must be finite, got nan"):
        dp.flow_step(grid, np.nan)
    with pytest.raises(
        dp.errors.UnstableStepError,
        match=re.escape(
            "flow_step is unstable for viscosity = 1 with dt = 0.001: the largest stable dt is 0.000488281; take "
            "smaller steps or write implicit=True"
        ),
    ):
        dp.flow_step(dp.Grid((16, 16), size=1.0), 0.001, 1.0)
    step = dp.flow_step(grid, 0.1, lambda nu: nu)
    with pytest.raises(dp.errors.UnstableStepError, match="flow_step is unstable for viscosity = 100"):
        step.start(np.zeros(grid.faces.size), 100.0)
    with pytest.raises(TypeError, match="solid_boundary needs dp.no_slip or dp.free_slip, got outflow"):
        dp.face_laplacian(grid, solid=np.zeros(grid.shape, bool), solid_boundary=dp.outflow)
    with pytest.raises(ValueError, match="animate needs at least one frame, got none; run with keep='all'"):
        dp.animate(grid, [], "film.gif")
    step = dp.flow_step(grid, 0.1)
    with pytest.raises(dp.errors.ShapeError, match="flow_step takes a dict of v, p and a as its state"):
        step(np.zeros(grid.faces.size))
    with pytest.raises(FINITE, match="the velocity in projection must be finite"):
        step.start(np.full(grid.faces.size, np.nan))


@pytest.mark.parametrize("convective", [False, True])
def test_short_steps_with_explicit_and_implicit_viscosity_agree(convective):
    """Moving walls act at both ends of an implicit step: short explicit and implicit steps agree."""
    grid = dp.Grid((6, 5), size=1.0)
    dt = 1e-6
    nu = 0.3
    lid = dp.face_lift(grid)
    walls = lid(lid.domain.join(0.0, -0.5, 0.0, 1.0))
    shorts = [
        dp.flow_step(grid, dt, nu, implicit=implicit, convective=convective, walls=walls) for implicit in (True, False)
    ]
    implicit, explicit = (step(step.start(0.0 * walls)) for step in shorts)
    assert np.linalg.norm(explicit["v"]) > 0.1 * dt * nu * np.linalg.norm(walls)
    np.testing.assert_allclose(implicit["v"], explicit["v"], rtol=0, atol=1e-4 * np.max(np.abs(explicit["v"])))


def test_sources_have_the_shape_of_their_field():
    def doubled(s, params):
        s["heat"] *= 2.0
        return s["heat"]

    grid = dp.Grid((4, 5))
    heat = np.ones((4, 5))
    for source, error, message in (
        (
            lambda s, params: np.ones(5),
            dp.errors.ShapeError,
            r"a source of 'heat' of shape \(4, 5\), or a number, got an",
        ),
        (doubled, ValueError, "read-only"),
    ):
        step = dp.flow_step(grid, 0.1, scalars={"heat": {"source": source}})
        with pytest.raises(error, match=message):
            step.start(np.zeros(grid.faces.shape), None, {"heat": heat})
    assert np.all(heat == 1.0)


def test_deprecated_name_of_the_pressure_gradient():
    step = dp.flow_step(dp.Grid((2, 2)), 0.1)
    with pytest.warns(DeprecationWarning, match="FlowStep.slope is deprecated .* write FlowStep.pressure_gradient"):
        assert step.slope is step.pressure_gradient


def test_the_pressure_belongs_to_the_middle_of_the_step():
    """A force that is a gradient and oscillates is balanced by the pressure."""
    grid = dp.Grid((6, 5), size=1.0)
    x, y = grid.centres()
    potential = np.cos(np.pi * x) * np.cos(np.pi * y)
    push = dp.gradient(grid)(potential)
    errors = []
    for n in (20, 40):
        dt = 1.0 / n
        step = dp.flow_step(grid, dt, force=lambda v, t: np.sin(t) * push)
        state = step.start(np.zeros(grid.faces.size), 0.0)
        for i in range(n):
            state = step(state, i * dt)
        middle, end = (np.max(abs(state["p"] - np.sin(t) * potential)) for t in (1.0 - dt / 2, 1.0))
        errors.append((middle, end))
    orders = np.log2(np.divide(*errors))
    assert abs(orders[0] - 2.0) < 0.1 and abs(orders[1] - 1.0) < 0.1
