"""Points that carry a field, and what is beyond their sides, as the numbers that the loops over sides take.

A component of the moved field lives on a lattice of points, one control volume each: the cells of the grid, or the
faces across one axis (half a cell at a wall). Along each axis, side f lies between the points f - 1 and f; a bounded
axis has one more side than points, the two walls included, a periodic one as many. Points and sides of all components
and axes are numbered one after the other, like the inflow values of all walls.
"""

from math import prod
from typing import Any, NamedTuple

import numpy as np

from sparsedp import kernels
from sparsedp._utils.validation import place
from sparsedp.grid.boundary_conditions import neumann
from sparsedp.kernels.fluxes import ITSELF, ROUND, TILE, UNEVEN

__all__ = ["Component", "Sides", "components", "place_words"]


class Sides(NamedTuple):
    """The lower and the upper sides (rows) of the points of a component along an axis."""

    beyond: Any  # the point on the other side, at a wall the point itself
    speed: Any  # which of the velocities
    wall: Any  # which of the inflow values; -1 where none is given
    at_wall: Any
    column: Any  # of each point in the table


class Component(NamedTuple):
    """One component of the field; for the arrays see `sparsedp.kernels.fluxes`."""

    field: slice  # its numbers in the field, in the inflow, in the velocity
    inflow: slice
    speed: slice
    free: Any
    table: Any
    axes: Any
    tiles: int

    def run(self, loop, *args):
        """A loop over the tiles."""
        work = (self.field.stop - self.field.start) * len(self.axes)  # each axis is a pass: 512^2 pays for two threads
        loop.run(self.tiles, work, kernels.threads(), *args)

    def sides(self, a):
        """Axis -> Sides."""
        return _sides(self.axes[a], np.arange(self.field.stop - self.field.start))


def components(setting, limited):
    """All components of the moved field. limited: the scheme has slopes."""
    found, starts, at_points, in_solid = [], [0, 0, 0], setting.at_points, setting.solid_points
    for own, shape in enumerate(setting.space.parts):
        rows, cells, speed, wall = [], prod(shape), 0, 0
        tables: list = []
        for a, n in enumerate(shape):
            stride, ends, extra, many = prod(shape[a + 1 :]), [ROUND] * 2, 0, cells // n
            if setting.sides[a]:
                pair = zip(setting.sides[a], (wall, wall + many), strict=True)
                ends = [ITSELF if side == neumann else at for side, at in pair]
                wall, extra = wall + 2 * many, 0 if at_points else stride
            lines = _lines(setting.grid, a, setting.of == "faces" and a == own, at_points, limited)
            rows.append([n, stride, not at_points, speed, extra, *ends, sum(map(len, tables)), len(lines) > 1, False])
            tables.append(lines)
            speed += cells + extra * (many // stride)
        axes, free = np.array(rows, np.int64), np.zeros((2 * len(shape), 0), bool)
        if in_solid is not None:
            solid, cell = in_solid[starts[0] :][:cells], np.arange(cells)
            free = np.concatenate([~(solid | solid[_sides(row, cell).beyond]) for row in axes])
        axes[:, UNEVEN] = free.size or any(np.any(x[:, :4] != x[0, 0]) for x in tables)
        stops = [starts[0] + cells, starts[1] + wall, starts[2] + speed]
        tiles = cells // shape[-1] * -(-shape[-1] // TILE)
        field, inflow, speeds = map(slice, starts, stops)
        found.append(Component(field, inflow, speeds, free, np.concatenate(tables).T.copy(), axes, tiles))
        starts = stops
    return found


def _sides(row, cell):
    """A row of `axes`, the numbers of all points -> Sides."""
    n, stride, on_sides, speed, extra = row[:5]
    through, sign, walls = cell // stride, np.array([[-1], [1]]), row[5:7, None]
    place, block = through % n, through // n
    ends, bounded = place == [[0], [n - 1]], walls != ROUND
    step = np.where(ends, 1 - n, 1) * sign * stride
    return Sides(
        cell + np.where(ends & bounded, 0, step),
        speed + cell + block * extra + (sign > 0) * on_sides * np.where(bounded, stride, step),
        np.where(ends & (walls >= 0), walls + block * stride + cell % stride, -1),
        ends & bounded,
        row[7] + row[8] * place,
    )


def _lines(grid, axis, staggered, at_points, limited):
    """The columns of an axis in the table: one for each place along it, or one for all.

    Lengths are the widths of control volumes, infinite where there is none; or (at_points and not limited) those
    between points, at a wall the width of the control volume.
    """
    cells, between, periodic = grid.widths[axis], grid.spacings(axis), grid.periodic[axis]
    widths, inner = (between, cells) if staggered else (cells, between[1:-1])
    with np.errstate(divide="ignore"):
        widths = np.where(widths > 0, widths, np.inf)
    gaps = np.concatenate([widths[:1], inner, widths[-1:]])
    if periodic:
        gaps = np.append(cells[-1:], cells) if staggered else np.append(between, between[:1])
    around = gaps[:-1], gaps[1:]
    lengths = [widths, widths, np.roll(widths, 1), np.roll(widths, -1)]
    if at_points and not limited:
        lengths = [*around, *around]
    lines = [1.0 / length for length in lengths]
    if limited:  # the distances to both neighbours, or to walls, over half a width
        gaps[[0, -1]] /= 1 if periodic else 2
        lines += [2 * gaps[:-1] / widths, 2 * gaps[1:] / widths]
    table = np.transpose(lines)
    return table if np.any(table != table[0]) else table[:1]


def place_words(setting, index):
    """Words for the place of a number of the field."""
    space = setting.space
    own = int(np.searchsorted(space.offsets, index, "right")) - 1
    label = f" of the {setting.grid.axes[own]}-faces" if setting.of == "faces" else ""
    return f"{place(index - space.offsets[own], space.parts[own])}{label}"
