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
