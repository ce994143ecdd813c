"""What cut_flow refuses, and what it says."""

import re

import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import IncompatibleError, JitError, NonFiniteError, ShapeError

GRID = dp.Grid((4, 3))
LEVEL = np.ones(GRID.nodes.shape)


def refused(error, message):
    return pytest.raises(error, match=f"^{re.escape(message)}$")


def test_grids_and_levels():
    with refused(ShapeError, "cut_flow takes a 2-D grid with cells, got Grid(4 cells, size 4)"):
        dp.cut_flow(dp.Grid(4), np.ones(5))
    with refused(ShapeError, "cut_flow takes a 2-D grid with cells, got Grid(0 x 3 cells, size 0 x 3)"):
        dp.cut_flow(dp.Grid((0, 3)), np.ones((1, 4)))
    message = "the level of cut_flow takes a field on nodes(4, 3) of shape (5, 4), got an array of shape (4, 3)"
    with refused(ShapeError, message):
        dp.cut_flow(GRID, np.ones((4, 3)))
    with pytest.raises(NonFiniteError, match="the level of cut_flow must be finite"):
        dp.cut_flow(GRID, np.nan * LEVEL)
    with pytest.raises(TypeError, match="the level of cut_flow must hold real numbers"):
        dp.cut_flow(GRID, 1j * LEVEL)
    message = (
        "dp.jit cannot record the level of cut_flow, whose values decide which cells are cut; call the function "
        "without dp.jit"
    )
    with refused(JitError, message):
        dp.jit(lambda level: dp.cut_flow(GRID, level).steady(1.0)["v"])(LEVEL)


def test_given_velocities():
    flow = dp.cut_flow(GRID, LEVEL)
    message = "v of cut_flow takes a number or a field on faces(4, 3), got an array of shape (3,)"
    with refused(ShapeError, message):
        flow.steady(1.0, np.ones(3))
    with pytest.raises(NonFiniteError, match="v of cut_flow must be finite"):
        flow.steady(1.0, np.inf)
    with pytest.raises(ShapeError, match="cut_flow, as walls, takes a field on"):
        flow.steady(1.0, walls=np.ones(3))
    with refused(ValueError, "the viscosity of cut_flow must be > 0, got -1"):
        flow.steady(-1.0)
    message = (
        "cut_flow: inflow and outflow through the walls of a region differ; make the given velocity balance, or open a "
        "wall with dp.outflow"
    )
    with refused(IncompatibleError, message):
        flow.steady(1.0, np.arange(GRID.faces.size))


def test_a_body_that_grows():
    grid = dp.Grid((8, 8), size=2.0, origin=-1.0)
    message = "solid_velocity of cut_flow must be tangential to the wall of the body; the fluid would flow through it"
    with refused(IncompatibleError, message):
        dp.cut_flow(grid, lambda x, y: np.hypot(x, y) - 0.5, solid_velocity=lambda x, y: (x, y))


CHANNEL_GRID = dp.Grid((8, 6), size=(2.0, 1.5))


def around_disc(solid_velocity):
    level = lambda x, y: np.hypot(x - 1.03, y - 0.77) - 0.4
    return dp.cut_flow(CHANNEL_GRID, level, {"x": (dp.inflow, dp.outflow)}, solid_velocity)


@pytest.mark.parametrize("wrong", [lambda x, y: 0.3 * x, lambda x, y: (x, y, x), lambda x, y: 1.0])
def test_a_velocity_that_is_no_pair(wrong):
    message = "solid_velocity of cut_flow must return a pair of components; write lambda x, y: (-omega * y, omega * x)"
    with refused(ShapeError, message):
        around_disc(wrong)


def test_wrong_velocities_of_the_body():
    with pytest.raises(
        ShapeError,
        match="^solid_velocity of cut_flow must return numbers or arrays of the shape of x, got an array of shape "
        r".*$",
    ):
        around_disc(lambda x, y: (np.ones(3), y))
    with pytest.raises(NonFiniteError, match="solid_velocity of cut_flow must be finite"):
        around_disc(lambda x, y: (np.nan * x, y))
    with pytest.raises(TypeError, match="solid_velocity of cut_flow must hold real numbers"):
        around_disc(lambda x, y: (1j * x, y))
    message = "solid_velocity of cut_flow must be tangential to the wall of the body; the fluid would flow through it"
    for through in (3.0, lambda x, y: (x - 1.03, y - 0.77)):
        with refused(IncompatibleError, message):
            around_disc(through)
    flow = around_disc(0.0)
    with pytest.raises(ValueError, match="the viscosity of cut_flow must be > 0, got -1"):
        flow.force(flow.steady(1.0, 0.0), -1.0)


def test_wrong_kinds_of_velocities():
    flow = dp.cut_flow(GRID, LEVEL)
    with refused(TypeError, "v of cut_flow must hold real numbers, got dtype complex128"):
        flow.steady(1.0, 1j)
    with refused(TypeError, "v of cut_flow must hold real numbers, got dtype <U1"):
        flow.steady(1.0, "a")
    walls = np.zeros(dp.face_lift(GRID).domain.size)
    with refused(TypeError, "walls of cut_flow must hold real numbers, got dtype complex128"):
        flow.steady(1.0, walls=1j + walls)
    with pytest.raises(NonFiniteError, match="^walls of cut_flow must be finite, got 18 that are NaN"):
        flow.steady(1.0, walls=np.nan + walls)


@pytest.mark.parametrize("convection", ["no", 2, None])
def test_convection_is_true_or_false(convection):
    with refused(ValueError, f"convection of cut_flow must be one of True, False, got {convection!r}"):
        dp.cut_flow(GRID, LEVEL, convection=convection)


@pytest.mark.parametrize("use", ["steady", "residual", "jacobian", "force"])
def test_what_is_no_flow(use):
    flow = dp.cut_flow(GRID, LEVEL)
    name = "guess" if use == "steady" else "x"
    call = (lambda x: flow.steady(1.0, guess=x)) if use == "steady" else (lambda x: getattr(flow, use)(x, 1.0))
    rest = {"v": np.zeros(GRID.faces.size), "p": np.zeros(GRID.shape)}
    message = f'{name} of cut_flow must be a flow {{"v": faces, "p": cells}}, such as steady returns, got '
    with refused(TypeError, message + "ndarray"):
        call(rest["v"])
    with refused(TypeError, message + "a dict with the keys ['v']"):
        call({"v": rest["v"]})
    with refused(
        ShapeError, "x['v'] of cut_flow takes a field on faces(4, 3) of shape (31,), got an array of shape (3,)"
    ):
        call({**rest, "v": np.zeros(3)})
    with refused(ShapeError, "x['p'] of cut_flow takes a field on cells(4, 3), got an array of shape (3,)"):
        call({**rest, "p": np.zeros(3)})
    with refused(TypeError, "x['p'] of cut_flow must hold real numbers, got dtype complex128"):
        call({**rest, "p": 1j * rest["p"]})
    with pytest.raises(NonFiniteError, match=r"^x\['v'\] of cut_flow must be finite"):
        call({**rest, "v": np.nan * rest["v"]})


def test_flows_that_nothing_determines():
    message = (
        "cut_flow: no wall, inflow or body determines the velocity along {}; give the level a body, or another boundary"
    )
    grid = dp.Grid((4, 4), periodic=True)
    with refused(IncompatibleError, message.format("x")):
        dp.cut_flow(grid, np.ones(grid.nodes.shape))
    grid = dp.Grid((4, 4), periodic=(False, True))
    with refused(IncompatibleError, message.format("y")):
        dp.cut_flow(grid, np.ones(grid.nodes.shape), {"x": dp.free_slip})
    dp.cut_flow(grid, np.ones(grid.nodes.shape))


def test_batches_of_different_sizes_around_a_body():
    body = dp.cut_cells(GRID, lambda x, y: np.hypot(x - 2.0, y - 1.4) - 0.8, dp.neumann)
    u, v = np.ones((3, *GRID.shape)), np.zeros((2, GRID.faces.size))
    message = (
        "cut_cells needs one shape of the batch, got (3,) of u, (2,) of v; give each argument the same leading axes, "
        "or none"
    )
    with refused(ShapeError, message):
        body.advection(u, v)
    message = message.replace("of v", "of values")
    for use in (body.slopes, body.flux, body.diffusion):
        with refused(ShapeError, message):
            use(u, u[:2])
    with refused(ShapeError, message.replace("of u", "of b")):
        body.solve(u, u[:2])
    move = dp.transport(GRID, "upwind", solid=body)
    with pytest.raises(ShapeError, match=r"^cut_cells needs one shape of the batch, got \(3,\) of u, \(2,\) of v"):
        move(u, v, 0.1)
    for project in (dp.projection(GRID, body), dp.projection(GRID)):
        with pytest.raises(ShapeError, match=r"^projection takes a field on faces\(4, 3\) of shape \(31,\), got an"):
            project(np.ones(30))
    with refused(TypeError, "v of projection must hold numbers, got dtype <U1"):
        dp.projection(GRID, body)(np.full(GRID.faces.size, "a"))
