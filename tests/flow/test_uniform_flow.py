"""Uniform flow in any direction is steady for every term on every grid; walls that move, inflows at an angle."""

from itertools import product
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

SHAPES = [(5,), (1,), (4, 5), (1, 4), (5, 1), (1, 1), (3, 4, 2), (4, 1, 3), (1, 1, 3)]
SCHEMES = [
    {"scheme": "upwind"},
    {"scheme": "upwind", "form": "advective"},
    {"scheme": "van_leer"},
    {"scheme": "van_leer", "form": "advective"},
    {"scheme": "semi_lagrangian"},
    {"scheme": "semi_lagrangian", "interpolation": "cubic", "backtrace": "midpoint"},
    {"scheme": "maccormack"},
    {"scheme": "maccormack", "clamp": False, "backtrace": "midpoint"},
]
STEPS = {
    "inviscid": {},
    "explicit": {"viscosity": 0.01},
    "implicit": {"viscosity": 3.0, "implicit": True},
    "viscosity of params": {"viscosity": lambda params: 0.01},
    "Stokes": {"viscosity": 0.01, "convective": False},
}


class Uniform:
    """A uniform flow through a grid: in through one side of each bounded axis, out through the other one."""

    def __init__(self, shape, periodic, stretched, seed=0):
        rng = np.random.default_rng(seed)
        spacing = [rng.uniform(0.5, 1.5, n) if stretched else np.full(n, 0.7) for n in shape]
        self.grid = grid = dp.Grid(shape, spacing=spacing, periodic=periodic)
        self.wind = rng.uniform(0.2, 1.0, grid.dim) * rng.choice([-1, 1], grid.dim)
        self.bounded = [a for a in range(grid.dim) if not periodic[a]]
        sides = {a: (dp.inflow, dp.outflow) if self.wind[a] > 0 else (dp.outflow, dp.inflow) for a in self.bounded}
        self.sides = {grid.axes[a]: pair for a, pair in sides.items()}
        self.v = grid.join(*self.wind)
        self.lift = dp.face_lift(grid, self.sides)
        # In the order of `face_lift`: wall after wall, for each the components along it.
        along = [self.wind[c] for a in self.bounded for c in range(grid.dim) if c != a]
        self.walls = self.lift.domain.join(*along)


WHOLE = pytest.mark.whole
KINDS = [pytest.param(shape, False, id=str(shape)) for shape in [(5,), (4, 5), (1, 4), (1, 1, 3)]]
KINDS += [pytest.param((3, 4, 2), False, id="(3, 4, 2)", marks=pytest.mark.whole)]
KINDS += [pytest.param(shape, True, id=f"{shape}-all", marks=WHOLE) for shape in SHAPES]
BOTH = [False, pytest.param(True, marks=WHOLE)]


def flows(shape, every):
    """Every choice of periodic axes and of widths; else bounded axes of different widths, and one mixed grid."""
    if every:
        for periodic in product((False, True), repeat=len(shape)):
            for stretched in (False, True):
                yield Uniform(shape, periodic, stretched)
    else:
        yield Uniform(shape, (False,) * len(shape), True)
        yield Uniform(shape, (True,) + (False,) * (len(shape) - 1), False)


def rounding(flow):
    """A bound of the rounding errors of second differences."""
    least = min(float(h.min()) for h in flow.grid.widths)
    return 1e-13 / least**2


@pytest.mark.sampled(0)
@pytest.mark.parametrize(("shape", "every"), KINDS)
def test_each_term_preserves_a_uniform_flow(shape, every):
    for flow in flows(shape, every):
        grid = flow.grid
        v = flow.v
        convect = dp.convection(grid, flow.sides)
        viscous = dp.face_laplacian(grid, flow.sides)
        close = dict(rtol=0, atol=rounding(flow))
        np.testing.assert_allclose(convect(v, v, flow.walls), 0.0, **close)
        np.testing.assert_allclose(viscous(v) + flow.lift(flow.walls), 0.0, **close)
        np.testing.assert_allclose(dp.projection(grid, boundary=flow.sides)(v), v, **close)
        on = dp.forces(grid, boundary=flow.sides, cells=np.ones(shape, bool))
        far = dp.brinkman(grid)(np.full(grid.faces.size, 1e3))
        np.testing.assert_allclose(far * v, 0.0, **close)
        if not any(grid.periodic):
            np.testing.assert_allclose(on(v, np.zeros(shape), 0.1, flow.walls)[: grid.dim], 0.0, **close)


@pytest.mark.sampled(0)
@pytest.mark.parametrize(("shape", "every"), KINDS)
def test_transport_on_faces_preserves_a_uniform_flow(shape, every):
    for flow in flows(shape, every):
        for options in SCHEMES:
            if options.get("interpolation") == "cubic" and not all(flow.grid.uniform):
                continue  # refused where widths change too fast
            move = dp.transport(flow.grid, boundary=dp.dirichlet, of="faces", **options)
            # In the order of `move.walls`: for each component wall after wall.
            given = [flow.wind[c] for c in range(flow.grid.dim) for _ in range(2 * len(flow.bounded))]
            moved = move(flow.v, flow.v, 0.05, move.walls.join(*given))
            np.testing.assert_allclose(moved, flow.v, rtol=0, atol=1e-13)


STEPPING = [pytest.param((4, 5), False, name, id=name) for name in STEPS]
STEPPING += [pytest.param((3, 4, 2), False, "implicit", id="three axes", marks=pytest.mark.whole)]
for number, shape in enumerate(SHAPES):  # one half of the steps, and the other one for the next shape
    names = list(STEPS)[number % 2 :: 2]
    STEPPING += [pytest.param(shape, True, name, id=f"{shape}-{name}", marks=WHOLE) for name in names]


@pytest.mark.sampled(0)
@pytest.mark.parametrize(("shape", "every", "name"), STEPPING)
def test_flow_steps_preserve_a_uniform_flow(shape, every, name):
    """Yield wall velocities as a function and, where it determines them, as the result of `face_lift`."""
    for flow in flows(shape, every):
        grid = flow.grid
        options = {"boundary": flow.sides, "unstable": "allow", **STEPS[name]}
        steps = [dp.flow_step(grid, 0.02, walls=lambda params, flow=flow: flow.walls, **options)]
        if len(flow.bounded) < 2 or grid.dim < 3:  # else two walls add up on faces along the edge between them
            steps.append(dp.flow_step(grid, 0.02, walls=flow.lift(flow.walls), **options))
        for step in steps:
            end = dp.rollout(step, step.start(flow.v), None, 3)
            np.testing.assert_allclose(end["v"], flow.v, rtol=0, atol=1e-11)


def test_scalars_and_friction_preserve_a_uniform_flow():
    """A scalar of 1 in the cells and at the walls; a friction of an obstacle far away."""
    flow = Uniform((4, 5), (False, False), True)
    grid = flow.grid
    sides = dict.fromkeys(flow.grid.axes, dp.dirichlet)
    heat = {"diffusivity": 0.01, "boundary": sides, "values": np.ones(18)}
    friction = dp.brinkman(grid)(np.full(grid.faces.size, 1e3))
    step = dp.flow_step(
        grid, 0.02, 0.01, boundary=flow.sides, walls=lambda p: flow.walls, scalars={"heat": heat}, friction=friction
    )
    end = dp.rollout(step, step.start(flow.v, None, {"heat": np.ones(grid.shape)}), None, 3)
    np.testing.assert_allclose(end["v"], flow.v, rtol=0, atol=1e-12)
    np.testing.assert_allclose(end["s"]["heat"], 1.0, rtol=0, atol=1e-12)


def test_without_wall_velocities_flow_enters_at_right_angles():
    flow = Uniform((4, 5), (False, False), False)
    convect = dp.convection(flow.grid, flow.sides)
    assert np.max(np.abs(convect(flow.v, flow.v))) > 0.1
    assert np.array_equal(convect(flow.v, flow.v), convect(flow.v, flow.v, 0.0 * flow.walls))


# ---- published flows -------------------------------------------------------------------------------------------------


def free_of(grid, sides):
    """Return the mask of the faces whose velocity is unknown, on which a uniform acceleration acts."""
    still = dp.flow_step(grid, 1.0, boundary=sides, convective=False, force=lambda v, p: 1.0)
    return dp.mask(grid.faces, still.start(np.zeros(grid.faces.size))["a"] != 0.0)


def steady_flow(grid, sides, given, walls, nu, friction=0.0):
    """Velocity and pressure of a steady flow; `given`: faces, with the normal velocity at inflows."""
    convect = dp.convection(grid, sides)
    viscous = dp.face_laplacian(grid, sides)
    lift = dp.face_lift(grid, sides)
    pressures = {axis: tuple(side.pressure for side in pair) for axis, pair in sides.items()}
    free = free_of(grid, sides)
    slope = dp.gradient(grid, pressures)
    D = dp.divergence(grid)

    def residual(x, scale):
        v = x["v"]
        wind = scale * given
        along = scale * walls
        rate = nu * (viscous(v) + lift(along) - friction * v) - convect(v, v, along) - slope(x["p"])
        return {"v": free(rate) + (v - wind) - free(v - wind), "p": D(v)}

    return dp.steady(residual, {"v": given, "p": np.zeros(grid.shape)}, 1.0)


def kovasznay(n):
    """The error of Kovasznay's flow (1948) at Re 40 behind a grid, exact at the inflow, up to x = 1/2."""
    rate = 20.0 - np.sqrt(400.0 + 4 * np.pi**2)
    u = lambda x, y: 1 - np.exp(rate * x) * np.cos(2 * np.pi * y)
    v = lambda x, y: rate / (2 * np.pi) * np.exp(rate * x) * np.sin(2 * np.pi * y)
    grid = dp.Grid((4 * n, n), size=(4.0, 1.0), origin=(-0.5, -0.5), periodic=(False, True))
    sides = {"x": (dp.inflow, dp.outflow)}
    exact = grid.join(u(*grid.face_centres(0)), v(*grid.face_centres(1)))
    x = steady_flow(grid, sides, exact, v(-0.5, grid.coordinates(1, "nodes")), 1 / 40)
    wrong = grid.split(x["v"] - exact)
    near = [np.abs(part[: n + 1]) for part in wrong]
    return np.sqrt(sum(np.mean(part**2) for part in near))


@pytest.mark.parametrize("sizes", [(8, 16), pytest.param((8, 16, 32, 64), marks=WHOLE)])
def test_kovasznay_is_of_second_order(sizes):
    errors = [kovasznay(n) for n in sizes]
    assert np.all(np.abs(np.log2(np.divide(errors[:-1], errors[1:])) - 2.0) < 0.1) and errors[-1] < 8e-3


def cylinder(angle, cells=10, far=8.0):
    """Drag along the stream and lift across it, of a cylinder at Re 40; on it, and from the momentum around it."""
    side = 1.15 ** np.arange(1, 100) / cells
    side = side[: np.searchsorted(np.cumsum(side), far) + 1]
    widths = np.concatenate([side[::-1], np.full(2 * cells, 1 / cells), side])
    half = 0.5 * widths.sum()
    grid = dp.Grid((widths.size,) * 2, spacing=[widths, widths], origin=(-half, -half))
    along = np.array([np.cos(angle), np.sin(angle)])
    sides = {"x": (dp.inflow, dp.outflow), "y": (dp.inflow, dp.outflow) if angle else (dp.free_slip, dp.free_slip)}
    walls = dp.face_lift(grid, sides).domain.join(*(along[::-1] if angle else [0.0]))
    x, y = (grid.join(*(grid.face_centres(c)[a] for c in (0, 1))) for a in (0, 1))
    friction = dp.brinkman(grid)(np.hypot(x, y) - 0.5)
    nu = 1 / 40
    state = steady_flow(grid, sides, grid.join(*along), walls, nu, friction)
    on = [part.sum() for part in grid.split(grid.faces.volumes * nu * friction * state["v"])]
    around = dp.forces(grid, boundary=sides, cells=np.hypot(*grid.centres()) < 0.9)(state["v"], state["p"], nu, walls)
    turned = np.array([along, [-along[1], along[0]]])
    return 2 * turned @ on, 2 * turned @ around[:2]


@WHOLE
def test_cylinder_in_an_oblique_flow():
    """The drag does not depend on the orientation of the grid, and the lift is 0."""
    (straight, _), (turned, around) = cylinder(0.0), cylinder(np.deg2rad(20.0))
    assert turned[0] == pytest.approx(1.62, rel=0.02) and turned[0] == pytest.approx(straight[0], rel=0.015)
    assert abs(turned[1]) < 0.03 and abs(straight[1]) < 1e-9
    np.testing.assert_allclose(around, turned, rtol=0, atol=1e-9)


# ---- derivatives, and the same numbers by hand -----------------------------------------------------------------------


def by_hand(grid, v, w, walls):
    """div(w v) inside a 2-D box of inflows on three sides, an outflow at x-upper; walls: v, u, u on them."""
    (u, v), (wu, wv) = grid.split(v), grid.split(w)
    h = grid.widths[0][0]
    left, below, above = walls
    middle = lambda a, axis: 0.5 * (a[1:] + a[:-1]) if axis == 0 else 0.5 * (a[:, 1:] + a[:, :-1])
    uu = middle(u, 0) * middle(wu, 0)
    uu = anp.concatenate([uu, u[-1:] * wu[-1:]])  # through the outflow itself
    edges = anp.concatenate([below.reshape(-1, 1), middle(u, 1), above.reshape(-1, 1)], axis=1)
    wide = anp.concatenate([wv[:1], middle(wv, 0), wv[-1:]])  # no slope at the outflow
    uv = edges * wide
    lengths = np.full((u.shape[0], 1), h)
    lengths[-1] = 0.5 * h
    first = (uu[1:] - uu[:-1]) / lengths[1:] + (uv[1:, 1:] - uv[1:, :-1]) / h
    vv = middle(v, 1) * middle(wv, 1)
    sides = anp.concatenate([left.reshape(1, -1), middle(v, 0), v[-1:]])
    vu = (sides * anp.concatenate([wu[:, :1], middle(wu, 1), wu[:, -1:]], axis=1))[:, 1:-1]
    second = (vv[:, 1:] - vv[:, :-1]) / h + (vu[1:] - vu[:-1]) / h
    zeros = np.zeros
    return grid.join(
        anp.concatenate([zeros((1, u.shape[1])), first]),
        anp.concatenate([zeros((v.shape[0], 1)), second, zeros((v.shape[0], 1))], axis=1),
    )


def test_convection_with_wall_velocities_agrees_with_a_hand_calculation(rng):
    grid = dp.Grid((4, 3), spacing=0.3)
    sides = {"x": (dp.inflow, dp.outflow), "y": dp.inflow}
    walls = dp.face_lift(grid, sides).domain
    parts = [int(np.prod(part)) for part in walls.parts]
    cut = lambda flat: [flat[end - n : end] for end, n in zip(np.cumsum(parts), parts, strict=True)]
    convect = dp.convection(grid, sides)
    twin = lambda v, w, flat: by_hand(grid, v, w, cut(flat))
    v, w = rng.standard_normal((2, grid.faces.size))
    flat, along, g = *rng.standard_normal((2, walls.size)), rng.standard_normal(grid.faces.size)
    np.testing.assert_allclose(convect(v, w, flat), twin(v, w, flat), atol=1e-13)
    loss = lambda rule: lambda x: anp.sum(g * anp.sin(rule(x[0], x[1], x[2])))
    point = (v, w, flat)
    tangent = (w, g, along)
    (value, slopes), (other, wanted) = (dp.value_and_grad(loss(rule))(point) for rule in (convect, twin))
    assert value == pytest.approx(other, rel=1e-12)
    for one, two in zip(slopes, wanted, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-11)
    assert dp.jvp(loss(convect), point, tangent)[1] == pytest.approx(dp.jvp(loss(twin), point, tangent)[1], rel=1e-10)
    for one, two in zip(*(dp.hvp(loss(rule), point, tangent) for rule in (convect, twin)), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-9)


CHANNEL = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}


def channel(implicit, dt=0.02, dtype=float):
    """Return a channel whose inflow and upper wall change with the params."""
    grid = dp.Grid((6, 4), size=(1.5, 1.0))
    space = dp.face_lift(grid, CHANNEL).domain
    bump = np.sin(np.pi * grid.coordinates(1, "cells"))

    def walls(params):
        return space.join(params["turn"] * np.sin(np.pi * grid.coordinates(1, "nodes")), 0.0, params["lid"])

    def inflow(params):
        entering = anp.concatenate([anp.reshape(params["blow"] * bump, (1, 4)), np.zeros((6, 4))])
        return grid.join(entering, 0.0)

    step = dp.flow_step(grid, dt, 0.05, boundary=CHANNEL, implicit=implicit, walls=walls, inflow=inflow)
    return step, np.zeros(grid.faces.size, dtype)


def blown(t):
    return {"turn": 0.3 * np.sin(3.0 * t), "blow": 0.5 + 0.3 * np.cos(2.0 * t), "lid": np.sin(2.0 * t)}


@pytest.mark.parametrize("implicit", [False, pytest.param(True, marks=pytest.mark.whole)])
def test_changing_wall_velocities_are_second_order_in_time(implicit):
    answers = []
    for n in (10, 20, 40, 80):
        step, v = channel(implicit, 0.4 / n)
        state = step.start(v, blown(0.0))
        for k in range(n):
            state = step(state, blown(0.4 * (k + 1) / n))
        answers.append(state["v"])
    differences = [np.max(np.abs(a - b)) for a, b in zip(answers, answers[1:])]
    assert np.log2(differences[-2] / differences[-1]) > 1.8
    u = step.grid.split(state["v"])[0]
    np.testing.assert_allclose(u[0], blown(0.4)["blow"] * np.sin(np.pi * step.grid.coordinates(1, "cells")), rtol=1e-12)


@pytest.mark.parametrize("implicit", BOTH)
def test_derivatives_in_wall_velocities(implicit):
    """Both orders, in a rollout whose inputs are the velocities of walls and inflow."""
    step, v = channel(implicit)
    times = np.linspace(0.02, 0.1, 5)
    inputs = {name: np.array([blown(t)[name] for t in times]) for name in ("turn", "blow", "lid")}
    advance = lambda state, params, given: step(state, {name: params * given[name] for name in given})

    def loss(x):
        start = step.start(v, {name: x * blown(0.0)[name] for name in inputs})
        return anp.sum(dp.rollout(advance, start, x, 5, inputs)["v"] ** 3)

    result = dp.check.gradient(loss, 0.9)
    assert result.verdict == "agrees" and "Hessian product: agrees" in str(result), str(result)
    slope = dp.grad(loss)(0.9)
    assert dp.jvp(loss, 0.9, 1.0)[1] == pytest.approx(slope, rel=1e-9)


def test_single_precision_with_functions_as_walls():
    step, v = channel(True, dtype=np.float32)
    end = dp.rollout(step, step.start(v, blown(0.0)), blown(0.1), 2)
    assert {name: part.dtype for name, part in end.items()} == dict.fromkeys(("v", "p", "a", "walls"), np.float32)


def test_a_lid_given_as_a_function_and_as_a_lift():
    grid = dp.Grid((5, 4), size=1.0)
    lift = dp.face_lift(grid)
    values = lift.domain.join(0.0, 0.2, -0.5, 1.0)
    for options in ({}, {"implicit": True}):
        one, two = (dp.flow_step(grid, 0.02, 0.1, walls=w, **options) for w in (lambda p: values, lift(values)))
        ends = [dp.rollout(step, step.start(np.zeros(grid.faces.size)), None, 3)["v"] for step in (one, two)]
        np.testing.assert_allclose(*ends, rtol=0, atol=1e-14)


def test_an_array_as_walls_gives_the_inflow_angle():
    """The result of `face_lift` for velocities that vary along the inflow gives the same value and gradient."""
    grid = dp.Grid((4, 3), size=1.0)
    lift = dp.face_lift(grid, CHANNEL)
    wind = grid.join(1.0, 0.0)
    speeds = np.cos(np.arange(float(lift.domain.size)))

    def loss(speeds, walls):
        step = dp.flow_step(grid, 0.02, 0.05, boundary=CHANNEL, walls=walls(speeds))
        state = step.start(wind, speeds)
        for _ in range(3):
            state = step(state, speeds)
        return anp.sum(state["v"] ** 3)

    (one, slope), (two, wanted) = (
        dp.value_and_grad(lambda speeds, walls=walls: loss(speeds, walls))(speeds)
        for walls in (lift, lambda speeds: lambda params: params)
    )
    assert one == pytest.approx(two, rel=1e-13)
    np.testing.assert_allclose(slope, wanted, rtol=0, atol=1e-12)


def test_a_batch_of_velocities_and_of_walls(rng):
    grid = dp.Grid((4, 3))
    convect = dp.convection(grid, CHANNEL)
    v = rng.standard_normal((2, grid.faces.size))
    walls = rng.standard_normal((2, dp.face_lift(grid, CHANNEL).domain.size))
    each = [convect(v[k], v[k], walls[k]) for k in range(2)]
    np.testing.assert_array_equal(convect(v, v, walls), each)


@pytest.mark.parametrize("given", [lambda lift, values: lift(values), lambda lift, values: lambda params: values])
def test_an_obstacle_beside_a_moving_wall(given):
    """The wall does not drag the faces of the obstacle, from which an implicit viscosity would drag the fluid."""
    grid = dp.Grid((6, 5), size=1.0)
    solid = np.zeros((6, 5), bool)
    solid[2:4, 3:] = True
    lift = dp.face_lift(grid)
    walls = given(lift, lift.domain.join(0.0, 0.3, 0.0, 1.0))
    ends = []
    for implicit in (False, True):
        step = dp.flow_step(grid, 0.01, 0.2, solid=solid, implicit=implicit, convective=False, walls=walls)
        ends.append(dp.rollout(step, step.start(np.zeros(grid.faces.size)), None, 150)["v"])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-5)
    closed = dp.face_lift(grid, solid=solid)(np.ones(lift.domain.size))
    assert not np.any(closed - dp.interior(grid, solid)(closed))


@pytest.mark.parametrize("part", [np.s_[:, :3], np.s_[:, 1:]])
def test_forces_on_fluid_beside_a_moving_wall(part):
    """Couette flow is steady: the force on any part of it is 0, next to either wall."""
    grid = dp.Grid((3, 5), size=(1.0, 1.0), periodic=(True, False))
    v = grid.join(2.0 * grid.face_centres(0)[1], 0.0)
    cells = np.zeros(grid.shape, bool)
    cells[part] = True
    on = dp.forces(grid, cells=cells)
    walls = dp.face_lift(grid).domain.join(0.0, 2.0)
    np.testing.assert_allclose(on(v, np.zeros(grid.shape), 0.1, walls), 0.0, atol=1e-13)
    loss = lambda speed: on(v, np.zeros(grid.shape), 0.1, speed * walls)[0]
    moved = cells[0, -1]  # beside the moving wall: nu times its area over half a cell
    assert dp.grad(loss)(1.0) == pytest.approx(moved * 0.1 * 2.0 / 0.1, abs=1e-12)


# ---- what is refused -------------------------------------------------------------------------------------------------


class Case(NamedTuple):
    """Refused wall velocities."""

    act: Any
    error: Any
    match: str


SIDES = {"x": (dp.inflow, dp.outflow)}
SQUARE = dp.Grid((3, 3))
ROOM = dp.Grid((3, 3, 3))
ONES = np.ones(SQUARE.faces.size)
EVERYWHERE = dp.face_lift(ROOM, SIDES)(np.ones(dp.face_lift(ROOM, SIDES).domain.size))
REFUSED = [
    Case(
        act=lambda: dp.convection(SQUARE, SIDES)(ONES, ONES, ONES),
        error=dp.errors.ShapeError,
        match="convection, as walls, .*; write face_lift.grid, boundary..domain.join",
    ),
    Case(
        act=lambda: dp.forces(SQUARE, cells=np.s_[:1, :])(ONES, np.ones((3, 3)), 1.0, ONES),
        error=dp.errors.ShapeError,
        match="as walls, .*; write face_lift.grid, boundary..domain.join",
    ),
    Case(
        act=lambda: dp.flow_step(SQUARE, 0.1, boundary=SIDES, walls=lambda p: np.ones(3)).start(ONES),
        error=dp.errors.ShapeError,
        match="flow_step, as walls, .*; write face_lift.grid, boundary..domain.join",
    ),
    Case(
        act=lambda: dp.flow_step(SQUARE, 0.1, walls=np.ones(3)),
        error=dp.errors.ShapeError,
        match="flow_step, as walls, .*; write walls=lambda params: values, or face_lift.grid, boundary..values",
    ),
    Case(
        act=lambda: dp.flow_step(SQUARE, 0.1, walls=lambda: 0),
        error=TypeError,
        match="flow_step, as walls, .* walls=lambda params: values",
    ),
    Case(
        act=lambda: dp.flow_step(ROOM, 0.1, boundary=SIDES, walls=EVERYWHERE),
        error=ValueError,
        match="walls of flow_step got an array in which the velocities of walls that meet are summed; "
        r"write walls=lambda params: values, with values on face_lift\(grid, boundary\).domain",
    ),
    Case(
        act=lambda: dp.flow_step(SQUARE, 0.1, 0.1, boundary=dp.free_slip, walls=ONES),
        error=ValueError,
        match="flow_step takes velocities along sides of dp.no_slip and dp.inflow as walls=, and boundary= has no such "
        "side; leave walls out, or write boundary=dp.no_slip",
    ),
    Case(
        act=lambda: dp.flow_step(SQUARE, 0.1, inflow=ONES),
        error=ValueError,
        match="flow_step got inflow= without a side of dp.inflow in boundary=; give both or none",
    ),
    Case(
        act=lambda: dp.flow_step(SQUARE, 0.1, boundary=SIDES, inflow=lambda: 0),
        error=TypeError,
        match="flow_step, as inflow, .* inflow=lambda params: ...",
    ),
    Case(
        act=lambda: dp.flow_step(SQUARE, 0.1, boundary=SIDES, inflow=lambda p: np.ones(4)).start(ONES),
        error=dp.errors.ShapeError,
        match="flow_step, as inflow, .*; join its components with grid.join",
    ),
]


@pytest.mark.parametrize("case", REFUSED)
def test_refused_wall_velocities(case):
    with pytest.raises(case.error, match=case.match):
        case.act()


def test_a_periodic_grid_has_no_wall_velocities():
    assert dp.face_lift(dp.Grid(3, periodic=True)).domain.join().shape == (0,)
