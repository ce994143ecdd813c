"""The tangential velocities of walls and inflows in a flow step, for convection and viscosity.

They are given in one of two forms:

- a function ``walls(params)``, whose result holds the velocities themselves, one flat array on the domain of
  `face_lift` (`ChangingWalls`);
- an array on faces, ``face_lift(grid, boundary)(velocities)``: the contribution of constant velocities to the
  Laplacian of the flow (`ConstantWalls`). A viscosity that is one number uses this array directly. Convection needs the
  velocities at inflow boundaries, and a viscosity that varies in space needs the velocities of all walls;
  `velocities_from_lift` recovers them from the array.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp.autodiff.backend import gathered
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import cast
from sparsedp.flow.momentum import check_walls, face_lift, free_face_mask, inflow_points, wall_stresses, wall_velocities
from sparsedp.grid.boundary_conditions import inflow, occurring
from sparsedp.operators.masks_and_lift import mask
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.lazy import Mask, compose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.flow.settings import FlowSettings
    from sparsedp.grid.grid import Grid

__all__ = ["ChangingWalls", "ConstantWalls", "WallsAtRest", "moving_walls", "velocities_from_lift"]


def moving_walls(settings: FlowSettings, sides: tuple) -> WallsAtRest:
    """Return the object that represents the wall velocities of a flow step, by the form in which they are given.

    Parameters
    ----------
    settings : FlowSettings
    sides : tuple
        The flow conditions as `resolve` returns them.

    Raises
    ------
    ValueError
        If a nonzero array is given and no wall has a tangential velocity.
    """
    if settings.walls is None:
        return WallsAtRest()
    if callable(settings.walls):
        return ChangingWalls(settings)
    if not wall_velocities(settings.grid, sides).size:
        check_values(_check_zero, settings.walls)
    return ConstantWalls(settings, sides)


def _check_zero(walls):
    """Raise ValueError for wall velocities other than 0 where no wall has a tangential velocity."""
    if np.any(gathered(walls)):
        raise ValueError(
            "flow_step takes velocities along sides of dp.no_slip and dp.inflow as walls=, and boundary= has no such "
            "side; leave walls out, or write boundary=dp.no_slip"
        )


class WallsAtRest:
    """Walls and inflows without a tangential velocity.

    Attributes
    ----------
    changes : bool
        Whether the velocities depend on params. If they do, the state of a flow step contains them.
    constant : array or None
        Constant velocities on the domain of `face_lift`, as convection needs them; None where they are 0.
    """

    changes = False
    constant: Any = None

    def velocities(self, params: Any, dtype: np.dtype) -> Any:
        """Return the velocities for params on the domain of `face_lift`; None if convection does not need them."""
        return self.constant

    def laplacian_part(self, velocities: Any) -> Any:
        """Return the contribution of wall velocities to the Laplacian of the flow; None stands for 0."""
        return None

    def laplacian_part_sum(self, before: Any, after: Any) -> Any:
        """Return the sum of `laplacian_part` for the velocities before and after a step; None stands for 0."""
        return None

    def for_stress(self, velocities: Any, factor: float) -> Any:
        """Return the velocities that the stress of a viscosity that varies in space needs; None stands for 0.

        Parameters
        ----------
        velocities : array or None
            The sum of the velocities at some times, if they depend on params.
        factor : float
            The number of these times.
        """
        return None


class ConstantWalls(WallsAtRest):
    """Constant wall velocities, given as ``face_lift(grid, boundary)(velocities)``."""

    def __init__(self, settings: FlowSettings, sides: tuple) -> None:
        grid = settings.grid
        self._settings = settings
        self._sides = sides
        # Set to 0 on faces that are not free, because an implicit viscosity would spread these values into the fluid.
        self._lifted = mask(grid.faces, free_face_mask(grid, sides, settings.solid))(settings.walls)
        if settings.convective and inflow in occurring(sides):
            self.constant = velocities_from_lift(settings.walls, grid, sides, inflow_points(grid, sides))

    def laplacian_part(self, velocities: Any) -> Any:
        """Return the given array; see `WallsAtRest`."""
        return self._lifted

    def laplacian_part_sum(self, before: Any, after: Any) -> Any:
        """Return twice the given array; see `WallsAtRest`."""
        return 2.0 * self._lifted

    def for_stress(self, velocities: Any, factor: float) -> Any:
        """Return the recovered velocities of all walls, times the factor; see `WallsAtRest`."""
        return factor * self._of_all_walls

    @cached_property
    def _of_all_walls(self) -> Any:
        grid = self._settings.grid
        everywhere = np.ones(wall_velocities(grid, self._sides).size, bool)
        return velocities_from_lift(self._settings.walls, grid, self._sides, everywhere)


class ChangingWalls(WallsAtRest):
    """Wall velocities that are a function of params."""

    changes = True

    def __init__(self, settings: FlowSettings) -> None:
        self._settings = settings

    @cached_property
    def _lift(self) -> Operator:
        return face_lift(self._settings.grid, self._settings.boundary, self._settings.solid)

    def velocities(self, params: Any, dtype: np.dtype) -> Any:
        """Return the velocities for params in the dtype of the flow; see `WallsAtRest`."""
        values = self._settings.walls(params)
        check_walls("flow_step", values, self._lift.domain)
        return cast(values, dtype)

    def laplacian_part(self, velocities: Any) -> Any:
        """Return the lift of the velocities; see `WallsAtRest`."""
        return self._lift(velocities)

    def laplacian_part_sum(self, before: Any, after: Any) -> Any:
        """Return the lift of the sum of the velocities; see `WallsAtRest`."""
        return self._lift(before + after)

    def for_stress(self, velocities: Any, factor: float) -> Any:
        """Return the given velocities; see `WallsAtRest`."""
        return velocities


def velocities_from_lift(lifted: Any, grid: Grid, sides: tuple, required: NDArray) -> Any:
    """Recover wall velocities from the result of `face_lift`; those on faces that are not free get 0.

    Parameters
    ----------
    lifted : array
        ``face_lift(grid, boundary)(velocities)``; may be traced.
    grid : Grid
    sides : tuple
        The flow conditions as `resolve` returns them.
    required : bool array on the domain of `face_lift`
        The velocities to recover; all others get 0.

    Returns
    -------
    array on the domain of `face_lift`

    Raises
    ------
    ValueError
        If a face with a required velocity also touches another wall with a velocity. The array then holds only the sum
        of both contributions, from which they cannot be separated.
    """
    lift = compose(Mask(free_face_mask(grid, sides, None)), wall_stresses(grid, sides)).explicit().tocsr()
    walls = wall_velocities(grid, sides)
    wall_count = np.diff(lift.indptr)  # number of wall velocities that each face depends on
    needed = abs(lift) @ required > 0
    check_values(partial(_check_separate, needed & (wall_count > 1)), lifted)
    # If a face depends on a single wall velocity, this velocity is the value on the face divided by the coefficient.
    face, wall = lift.nonzero()
    invertible = (wall_count[face] == 1) & required[wall]
    coefficients = 1.0 / lift.data[invertible]
    inverse = sp.csr_array((coefficients, (wall[invertible], face[invertible])), shape=lift.shape[::-1])
    return Operator(Matrix(inverse), grid.faces, walls, "wall velocities")(lifted)


def _check_separate(is_shared, lifted):
    """Raise ValueError if a result of `face_lift` is nonzero on faces that depend on several wall velocities."""
    if np.any(gathered(lifted)[is_shared]):
        raise ValueError(
            "walls of flow_step got an array in which the velocities of walls that meet are summed; write "
            "walls=lambda params: values, with values on face_lift(grid, boundary).domain"
        )
