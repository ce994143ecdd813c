"""The control volumes of an Eulerian transport scheme, stored as tables for the loops over their sides.

The points of a component of the field are the centres of the cells, or the faces across one axis. Each point has a
control volume: the cell, or the volume between the neighbouring cell centres (half a cell at a wall). Along each axis,
side f lies between the points f - 1 and f. A bounded axis has one more side than points, because both walls are sides;
a periodic axis has as many sides as points. Points, velocities on sides and inflow values at walls are each numbered
consecutively over all axes and components.
"""

from __future__ import annotations

from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp import kernels
from sparsedp.grid.boundary_conditions import MixedWall, neumann
from sparsedp.kernels.fluxes import (
    COLUMN,
    EXTRA,
    HAS_COLUMNS,
    IS_UNEVEN,
    ON_SIDES,
    PROPERTIES,
    ROUND,
    SAME_AS_CELL,
    SPEED,
    STRIDE,
    TILE,
    WALL,
    N,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.advection.settings import TransportSettings
    from sparsedp.grid.grid import Grid

__all__ = ["Component", "Sides", "components"]


class Sides(NamedTuple):
    """The sides of all points of a component along an axis: lower sides are in row 0, upper sides in row 1.

    Attributes
    ----------
    beyond : int array
        Index of the neighbouring point beyond the side; at a wall the point itself.
    speed : int array
        Index of the velocity.
    wall : int array
        Index of the inflow value; -1 if the side has none.
    at_wall : bool array
        Whether the side is a wall.
    column : int array, one entry for each point
        The column of the point in the table of lengths.
    """

    beyond: NDArray[np.int64]
    speed: NDArray[np.int64]
    wall: NDArray[np.int64]
    at_wall: NDArray[np.bool_]
    column: NDArray[np.int64]


class Component(NamedTuple):
    """One component of the field.

    Attributes
    ----------
    field, inflow, speed : slice
        The range of its entries in the flat field, in the inflow values and in the velocity.
    free : bool array, shape (2 dim, points) or (2 dim, 0)
        Whether the sides of the points are open: a row for the lower and a row for the upper side along each axis. No
        columns if all sides are open.
    table : array
        Inverse lengths and distances; see `sparsedp.kernels.fluxes`.
    axes : int array
        One row of properties for each axis; see `sparsedp.kernels.fluxes`.
    tiles : int
        Number of tiles that the loops run over.
    work : int
        Number of values that the loops process: one pass for each axis. Two threads are faster from 512^2 cells on.
    repeated : int array, shape (2, m)
        Indices of inflow values that are not used, because the wall has the value of the point there, and the indices
        of these points. Empty unless a wall has several conditions. The loops read an inflow value on the whole of such
        a wall, so that the caller writes the values of the points there.
    """

    field: slice
    inflow: slice
    speed: slice
    free: NDArray[np.bool_]
    table: NDArray[np.float64]
    axes: NDArray[np.int64]
    tiles: int
    work: int
    repeated: NDArray[np.int64]

    @property
    def points(self) -> int:
        """Number of points."""
        return self.field.stop - self.field.start

    def run(self, loop: Any, *args: Any) -> None:
        """Run a compiled loop, a `Kernel`, over all tiles."""
        loop.run_all(self.tiles, self.work, kernels.threads, args)

    def bound(self, loop: Any) -> Callable[..., bool]:
        """Return a function that does what `run` does for a loop, with less overhead."""
        return loop.over(self.tiles, self.work, kernels.threads)

    def sides(self, axis: int) -> Sides:
        """Return the sides of all points along an axis."""
        sides = _sides(self.axes[axis], np.arange(self.points))
        is_repeated = (sides.wall >= 0) & np.isin(sides.wall, self.repeated[0])
        return sides._replace(wall=np.where(is_repeated, -1, sides.wall))


def components(settings: TransportSettings, limited: bool) -> list[Component]:
    """Return all components of the transported field. `limited` states whether the scheme has limited slopes."""
    result: list[Component] = []
    field_start = inflow_start = speed_start = 0
    solid_points = settings.solid_points
    for number, shape in enumerate(settings.space.parts):
        points = prod(shape)
        axes = np.zeros((len(shape), PROPERTIES), np.int64)
        tables: list = []
        speeds = 0
        wall_values = 0
        repeated = [np.zeros((2, 0), np.int64)]
        numbers = np.arange(points).reshape(shape)
        sides = settings.sides_of(number)
        for axis, n in enumerate(shape):
            row = axes[axis]
            lines = points // n
            row[N] = n
            row[STRIDE] = prod(shape[axis + 1 :])
            row[ON_SIDES] = not settings.at_points
            row[SPEED] = speeds
            row[WALL : WALL + 2] = ROUND
            if sides[axis]:
                for side, condition in enumerate(sides[axis]):
                    if condition == neumann:
                        row[WALL + side] = SAME_AS_CELL
                    else:
                        row[WALL + side] = wall_values + side * lines
                    if isinstance(condition, MixedWall):
                        places = np.flatnonzero(condition.faces_with(lambda on_face: on_face == neumann))
                        at_wall = np.take(numbers, -side, axis).reshape(-1)
                        repeated.append(np.stack([row[WALL + side] + places, at_wall[places]]))
                wall_values += 2 * lines
                if row[ON_SIDES]:
                    row[EXTRA] = row[STRIDE]
            staggered = settings.of == "faces" and axis == number
            table = _lengths(settings.grid, axis, staggered, settings.at_points, limited)
            row[COLUMN] = sum(map(len, tables))
            row[HAS_COLUMNS] = len(table) > 1
            tables.append(table)
            speeds += points + row[EXTRA] * (lines // row[STRIDE])
        free = np.zeros((2 * len(shape), 0), bool)
        if solid_points is not None:
            solid = solid_points[field_start:][:points]
            free = np.concatenate([~(solid | solid[_sides(row, np.arange(points)).beyond]) for row in axes])
        axes[:, IS_UNEVEN] = free.size or any(np.any(table[:, :4] != table[0, 0]) for table in tables)
        result.append(
            Component(
                field=slice(field_start, field_start + points),
                inflow=slice(inflow_start, inflow_start + wall_values),
                speed=slice(speed_start, speed_start + int(speeds)),
                free=free,
                table=np.concatenate(tables).T.copy(),
                axes=axes,
                tiles=points // shape[-1] * -(-shape[-1] // TILE),
                work=points * len(axes),
                repeated=np.concatenate(repeated, axis=1),
            )
        )
        field_start = result[-1].field.stop
        inflow_start = result[-1].inflow.stop
        speed_start = result[-1].speed.stop
    return result


def _sides(row: NDArray[np.int64], points: NDArray[np.int64]) -> Sides:
    """Return the sides of the given points along an axis, whose row of properties is `row`."""
    n = row[N]
    stride = row[STRIDE]
    sign = np.array([[-1], [1]])  # lower and upper
    walls = row[WALL : WALL + 2, None]
    bounded = walls != ROUND
    line = points // stride
    position = line % n  # along the axis
    block = line // n
    at_end = position == [[0], [n - 1]]
    step = np.where(at_end, 1 - n, 1) * sign * stride
    to_next_side = np.where(bounded, stride, step)
    return Sides(
        beyond=points + np.where(at_end & bounded, 0, step),
        speed=row[SPEED] + points + block * row[EXTRA] + (sign > 0) * row[ON_SIDES] * to_next_side,
        wall=np.where(at_end & (walls >= 0), walls + block * stride + points % stride, -1),
        at_wall=at_end & bounded,
        column=row[COLUMN] + row[HAS_COLUMNS] * position,
    )


def _lengths(grid: Grid, axis: int, staggered: bool, at_points: bool, limited: bool) -> NDArray[np.float64]:
    """Return the table of lengths of an axis: one row for each position along it, or a single row if all are equal.

    The columns are the inverse lengths of `sparsedp.kernels.fluxes` (INVERSE_LENGTH, INVERSE_LENGTH_BEYOND)
    and, if `limited`, the distances to the neighbours. The lengths are the widths of the control volumes (infinite if a
    width is 0). If the velocity is given at points and the scheme has no slopes, they are the distances between points
    instead; at a wall they remain the width of the control volume.
    """
    cells = grid.widths[axis]
    spacings = grid.spacings(axis)
    periodic = grid.periodic[axis]
    if staggered:
        widths = spacings
    else:
        widths = cells
    if staggered:
        inner_gaps = cells
    else:
        inner_gaps = spacings[1:-1]
    with np.errstate(divide="ignore"):
        widths = np.where(widths > 0, widths, np.inf)
    if not periodic:
        gaps = np.concatenate([widths[:1], inner_gaps, widths[-1:]])
    elif staggered:
        gaps = np.append(cells[-1:], cells)
    else:
        gaps = np.append(spacings, spacings[:1])
    below = gaps[:-1]
    above = gaps[1:]
    if at_points and not limited:
        lengths = [below, above, below, above]
    else:
        lengths = [widths, widths, np.roll(widths, 1), np.roll(widths, -1)]
    columns = [1.0 / length for length in lengths]
    if limited:  # the distances to both neighbours, or to the walls, divided by half the width
        if not periodic:
            gaps[[0, -1]] /= 2  # `below` and `above` are views
        columns += [2 * below / widths, 2 * above / widths]
    table = np.transpose(columns)
    if np.any(table != table[0]):
        return table
    return table[:1]
