"""cut_flow: exact flows between plane and round walls, balance of momentum, a published cylinder, derivatives."""

import pickle

import autograd.numpy as np
import numpy as onp
import pytest

import sparsedp as dp
from benchmarks.cut_flow import between_cylinders, disc
from sparsedp.errors import ConvergenceError

CHANNEL = {"x": (dp.inflow, dp.outflow)}


def parabola(grid):
    """A flow of mean 1 that enters a channel."""
    y = grid.face_centres(0)[1] / grid.size[1]
    return grid.join(6.0 * y * (1.0 - y), 0.0)


# ------------------------------------------------------------ exact flows


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [0, 1])
def test_flow_between_a_plane_wall_of_the_body_and_a_moving_wall(axis, side):
    """The profile is linear, and the wall cuts all cells of a row at the same height."""
    lengths = [np.array([0.2, 0.3, 0.25, 0.25]), np.linspace(0.1, 0.3, 6)]
    if axis == 1:
        lengths = lengths[::-1]
    grid = dp.Grid([h.size for h in lengths], spacing=lengths, periodic=[axis == 0, axis == 1])
    height = grid.size[1 - axis]
    place = 0.37 * height
    sign = 1.0 if side else -1.0
    flow = dp.cut_flow(grid, lambda *x: sign * (x[1 - axis] - place))
    walls = [0.0, 0.0]
    walls[side] = 2.0
    x = flow.steady(0.1, walls=dp.face_lift(grid).domain.join(*walls))
    along = np.arange(grid.faces.size) >= grid.faces.offsets[1]
    along = along if axis else ~along
    distance = sign * (flow.face_positions[1 - axis] - place) / (height - place if side else place)
    exact = np.where(along & (flow.apertures > 0), 2.0 * distance, 0.0)
    assert np.max(abs(x["v"] - exact)[flow.apertures > 0]) < 1e-7 and np.max(abs(x["p"])) < 1e-7
    shear = 0.1 * 2.0 / (height - place if side else place)
    expected = np.zeros(2)
    expected[axis] = shear * grid.size[axis]
    assert np.allclose(flow.force(x, 0.1), expected, rtol=1e-7, atol=1e-9)


def test_order_between_rotating_cylinders():
    *coarse, _ = between_cylinders(16)
    *fine, force = between_cylinders(64)
    orders = np.log(np.divide(coarse, fine)) / np.log(4)
    assert np.all(orders > [1.9, 1.5, 1.9]) and fine[0] < 5e-4
    assert force < 1e-8  # on both walls: nothing else takes momentum


def test_a_grid_without_body_has_the_equations_of_the_operators():
    grid = dp.Grid((5, 4), spacing=[np.linspace(0.1, 0.3, 5), 0.2])
    sides = {"x": (dp.inflow, dp.patch((0.2, 0.6), dp.outflow)), "y": (dp.free_slip, dp.no_slip)}
    flow = dp.cut_flow(grid, np.ones(grid.nodes.shape), sides)
    rng = onp.random.default_rng(0)
    x = {"v": rng.standard_normal(grid.faces.size), "p": rng.standard_normal(grid.shape)}
    lift = dp.face_lift(grid, sides)
    walls = rng.standard_normal(lift.domain.size)
    given = rng.standard_normal(grid.faces.size)
    free = dp.free_faces(grid, sides)
    pressure_gradient = dp.gradient(grid, {"x": (dp.neumann, dp.patch((0.2, 0.6), dp.dirichlet)), "y": dp.neumann})
    rate = 0.3 * (dp.face_laplacian(grid, sides)(x["v"]) + lift(walls)) - pressure_gradient(x["p"])
    rate = rate - dp.convection(grid, sides)(x["v"], x["v"], walls)
    residual = flow.residual(x, 0.3, given, walls)
    assert np.allclose(residual["v"], free(rate) + (given - x["v"]) - free(given - x["v"]), atol=1e-12)
    assert np.allclose(residual["p"], dp.divergence(grid)(x["v"]), atol=1e-13)
    assert np.allclose(flow.force(x, 0.3), 0.0, atol=1e-14)


# ------------------------------------------------------------ force


def cylinder(cells=8, y0=1.0, viscosity=0.05, **options):
    grid = dp.Grid((3 * cells, 2 * cells), size=(3.0, 2.0))
    flow = dp.cut_flow(grid, disc(1.03, y0, 0.3), CHANNEL, **options)
    return grid, flow, flow.steady(viscosity, parabola(grid))


def test_the_force_is_the_balance_over_a_volume_around_the_body():
    grid, flow, x = cylinder(y0=0.93)
    assert np.max(abs(dp.divergence(grid)(flow.apertures * x["v"]))) < 1e-13
    for margin in (0.5, 0.8):
        cells = np.all([abs(c - m) < margin for c, m in zip(grid.centres(), (1.0, 1.0))], axis=0)
        balance = dp.forces(grid, boundary=CHANNEL, cells=cells)(x["v"], x["p"], 0.05)
        assert np.allclose(flow.force(x, 0.05), balance[:2], rtol=1e-9, atol=1e-11)


def test_symmetric_flow_has_no_lift_and_stokes_flow_is_linear_and_reversible():
    _, flow, x = cylinder()
    drag, lift = flow.force(x, 0.05)
    assert drag > 0.5 and abs(lift) < 1e-10
    grid, flow, x = cylinder(convection=False)
    back = flow.steady(0.05, -2.0 * parabola(grid))
    assert np.allclose(back["v"], -2.0 * x["v"], atol=1e-10)
    assert np.allclose(flow.force(back, 0.05), -2.0 * flow.force(x, 0.05), atol=1e-10)


def test_a_body_may_cross_a_periodic_side():
    """A cylinder in a shear flow, in the middle and at the side, and the same with both axes exchanged."""

    def force(axis, place):
        grid = dp.Grid((12, 12), size=1.2, periodic=[axis == 0, axis == 1])

        def level(*x):
            distance = (x[axis] - place + 0.6) % 1.2 - 0.6
            return np.sqrt(distance**2 + (x[1 - axis] - 0.57) ** 2) - 0.23

        flow = dp.cut_flow(grid, level)
        found = flow.force(flow.steady(0.1, walls=dp.face_lift(grid).domain.join(-1.0, 1.0)), 0.1)
        return found if axis == 0 else found[::-1]

    middle = force(0, 0.63)
    assert abs(middle[0]) > 0.01
    for axis, place in ((0, 0.03), (1, 0.63), (1, 0.03)):
        assert np.allclose(force(axis, place), middle, rtol=1e-8, atol=1e-10)


@pytest.mark.whole
def test_tiny_cells_do_no_harm():
    """Wherever the wall passes, force and velocities change little."""
    found = []
    for shift in (0.0, 1e-13, 1e-9, 1e-3):
        grid = dp.Grid((24, 16), size=(3.0, 2.0))
        flow = dp.cut_flow(grid, disc(1.0, 1.0, 0.375 + shift), CHANNEL)
        x = flow.steady(0.05, parabola(grid))
        assert np.max(abs(x["v"])) < 3.0
        found.append(flow.force(x, 0.05)[0])
    assert np.allclose(found[:3], found[0], rtol=1e-7) and np.allclose(found, found[0], rtol=1e-2)


@pytest.mark.whole
@pytest.mark.parametrize("far", [1e3, 1e9, 1e200, 1e300])
def test_large_levels_far_from_the_wall_change_nothing(far):
    """The force was 50 % too large, as a jump of the level was interpolated to a body."""
    grid = dp.Grid((12, 8), size=(3.0, 2.0))
    nodes = np.meshgrid(grid.coordinates(0, "nodes"), grid.coordinates(1, "nodes"), indexing="ij")
    level = disc(1.0, 1.0, 0.3)(*nodes)

    def drag(level):
        flow = dp.cut_flow(grid, level, CHANNEL, rtol=1e-13)
        return flow.force(flow.steady(0.1, parabola(grid)), 0.1)[0]

    jumping = np.where(nodes[0] > 2, far, level)
    with onp.errstate(all="raise", under="ignore"):
        assert drag(jumping) == pytest.approx(drag(level), rel=1e-12)
        assert drag(far * level) == pytest.approx(drag(level), rel=1e-12)
    beside = np.minimum(level, nodes[1] - 0.13)  # a second body along one side of the grid
    for part in (slice(-1, None), slice(4, 7)):
        jumping_at_the_side = beside.copy()
        jumping_at_the_side[10:, part] = far
        assert drag(jumping_at_the_side) == pytest.approx(drag(beside), rel=1e-12)
    slope = dp.grad(drag)(level)
    assert np.allclose(dp.grad(drag)(jumping), slope, atol=1e-9 * np.max(abs(slope)))


def test_public_arrays_are_read_only():
    grid = dp.Grid((6, 6), size=2.0)
    level = disc(1.03, 0.97, 0.5)
    flow = dp.cut_flow(grid, level)
    body = dp.cut_cells(grid, level)
    arrays = [flow.apertures, flow.is_free, *flow.face_positions]
    arrays += [body.fractions, body.volumes, body.apertures, body.areas, body.is_fluid, *body.normals, *body.centroids]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


@pytest.mark.whole
def test_published_drag_and_lift_of_a_cylinder():
    """DFG benchmark 2D-1 at 20 cells a diameter; the grid is stretched behind the cylinder."""
    h = 0.005
    wake = np.minimum(1.06 ** np.arange(1, 200), 10.0)
    wake = wake[: np.argmax(np.cumsum(wake) >= 1.8 / h) + 1]
    widths = np.append(np.full(80, h), 1.8 / np.sum(wake) * wake)
    grid = dp.Grid((widths.size, 82), spacing=[widths, h])
    flow = dp.cut_flow(grid, disc(0.2, 0.2, 0.05), CHANNEL)
    x = flow.steady(1e-3, 0.2 * parabola(grid))
    drag, lift = 500 * flow.force(x, 1e-3)
    assert abs(drag / 5.57953523384 - 1) < 0.005 and abs(lift / 0.010618948146 - 1) < 0.02


# ------------------------------------------------------------ derivatives

SMALL = dp.Grid((12, 8), size=(3.0, 2.0))


def weighted_force(q, kind=dp.cut_flow):
    radius, viscosity, speed, omega = q
    wall = lambda x, y: (-omega * (y - 0.97), omega * (x - 1.03))
    flow = kind(SMALL, disc(1.03, 0.97, radius), CHANNEL, wall, rtol=1e-13)
    x = flow.steady(viscosity, speed * parabola(SMALL))
    return np.dot(np.array([1.0, 0.7]), flow.force(x, viscosity)) + 0.1 * np.sum(x["v"] ** 2)


POINT = np.array([0.42, 0.15, 1.0, 0.4])


@pytest.mark.whole
def test_the_gradient_agrees_with_differences():
    verdict = dp.check.gradient(weighted_force, POINT, quick=True)
    assert verdict.verdict == "agrees", verdict


@pytest.mark.whole
def test_forward_and_second_derivatives():
    gradient = dp.grad(weighted_force)
    direction = np.array([0.3, -0.1, 0.5, 0.2])
    assert np.isclose(dp.jvp(weighted_force, POINT, direction)[1], gradient(POINT) @ direction, rtol=1e-10)
    step = 1e-5 * direction
    difference = (gradient(POINT + step) - gradient(POINT - step)) / 2e-5
    assert np.allclose(dp.hvp(weighted_force, POINT, direction), difference, rtol=1e-5, atol=1e-6)


def test_the_derivative_in_the_level_is_that_of_its_parameter():
    """The derivative of the drag in all values of the level, by one adjoint solve."""
    x, y = np.meshgrid(*(SMALL.coordinates(axis, "nodes") for axis in (0, 1)), indexing="ij")

    def drag(level):
        flow = dp.cut_flow(SMALL, level, CHANNEL, rtol=1e-12)
        return flow.force(flow.steady(0.15, parabola(SMALL)), 0.15)[0]

    level = disc(1.03, 0.97, 0.42)(x, y)
    slope = dp.grad(drag)(level)
    difference = (drag(level - 1e-6) - drag(level + 1e-6)) / 2e-6
    assert np.isclose(-np.sum(slope), difference, rtol=1e-6) and difference > 0


def test_derivatives_where_the_wall_touches_nodes():
    """The wall touches nodes at four points, where some cells hold a wall without an area."""
    grid = dp.Grid((24, 16), size=(3.0, 2.0))

    def drag(radius):
        flow = dp.cut_flow(grid, disc(1.0, 1.0, radius), CHANNEL)
        return flow.force(flow.steady(0.15, parabola(grid)), 0.15)[0]

    slope = dp.grad(drag)(0.375)
    step = 1e-5
    below, above = ((drag(0.375 + side * step) - drag(0.375)) / (side * step) for side in (-1, 1))
    assert np.allclose([below, above], slope, rtol=1e-3)


def test_a_wrong_derivative_is_caught(monkeypatch):
    """The adjoint solve compares the Jacobian with the residual."""
    from sparsedp.flow.cut_flow import CutFlow

    right = CutFlow._jacobian

    def wrong(self, convection, x, weights, *rest):
        doubled = {**weights, "sides": 2.0 * weights["sides"]}
        return right(self, convection, x, doubled, *rest)

    monkeypatch.setattr(CutFlow, "_jacobian", wrong)
    with pytest.raises((dp.errors.DerivativeError, ConvergenceError)):
        dp.grad(weighted_force)(POINT)


@pytest.mark.slow
def test_a_force_that_is_not_differentiated_is_caught():
    def constant_force(*arguments, **options):
        flow = dp.cut_flow(*arguments, **options)
        flow._weights = {**flow._weights, "factors": np.asarray(dp.autodiff.tape.sample(flow._weights["factors"]))}
        return flow

    verdict = dp.check.gradient(lambda q: weighted_force(q, constant_force), POINT, quick=True)
    assert verdict.verdict == "disagrees"


def test_flows_are_found_again_by_continuation_and_after_pickling():
    grid, flow, x = cylinder(cells=5)
    root = dp.implicit(flow.residual, flow.jacobian)
    again = root({"v": 0.0 * x["v"], "p": 0.0 * x["p"]}, 0.05, parabola(grid))
    assert np.allclose(again["v"], x["v"], atol=1e-9)
    flow = dp.cut_flow(grid, np.ones(grid.nodes.shape), CHANNEL)
    copy = pickle.loads(pickle.dumps(flow))
    a, b = (f.steady(0.1, parabola(grid)) for f in (flow, copy))
    assert np.array_equal(a["v"], b["v"]) and repr(copy) == repr(flow)


def test_the_derivative_in_the_level_of_a_closed_box_with_a_moving_wall():
    """The shares of the outflow through a polygon depend on the level, too."""
    grid = dp.Grid((12, 8), size=(3.0, 2.0))

    def energy(height):
        level = lambda x, y: np.sqrt(((x - 1.03) / 0.7) ** 2 + ((y - 1.01) / height) ** 2) - 1.0
        wall = lambda x, y: (2 * (y - 1.01) / height**2, -2 * (x - 1.03) / 0.49)
        flow = dp.cut_flow(grid, level, solid_velocity=wall, convection=False)
        return np.sum(flow.steady(0.1, 0.0)["v"] ** 2)

    slope = (energy(0.35 + 1e-5) - energy(0.35 - 1e-5)) / 2e-5
    assert dp.grad(energy)(0.35) == pytest.approx(slope, rel=1e-6)


@pytest.mark.whole
def test_the_jump_of_the_force_on_a_square_on_grid_lines_decreases_with_the_cells():
    """Its edges lie on faces, which are open if the body is smaller by 1e-9: 12, 2 and 0.2 % with 4, 8 and 16 cells."""
    jumps = []
    for n in (4, 8, 16):
        grid = dp.Grid((3 * n, 2 * n), size=(3.0, 2.0))
        v = grid.join(np.ones(grid.faces.parts[0]), 0.0)
        sides = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}

        def drag(shift, grid=grid, v=v, sides=sides):
            level = lambda x, y: np.maximum(abs(x - 1.0), abs(y - 1.0)) - 0.5 + shift
            flow = dp.cut_flow(grid, level, sides)
            return flow.force(flow.steady(0.05, v), 0.05)[0]

        on_lines = drag(0.0)
        assert np.isclose(drag(-1e-9), on_lines, rtol=1e-6)
        jumps.append(abs(drag(1e-9) / on_lines - 1.0))
    assert jumps[0] < 0.13 and jumps[1] < jumps[0] / 4 and jumps[2] < jumps[1] / 4
