"""Points that carry a field, and the sides between them.

A component of the moved field lives on a lattice of points, one control volume each: the cells of the grid, or the
faces across one axis (half a cell at a wall). Along each axis, side f lies between the points f - 1 and f; a bounded
axis has one more side than points, the two walls included, a periodic one as many. Points and sides of all components
and axes are numbered one after the other, like the inflow values of all walls.
"""

from math import prod
from typing import Any, NamedTuple

import numpy as np

from sparsedp.advection.law import component_shapes
from sparsedp.conditions import neumann
from sparsedp.operators.boundary import solid_faces

__all__ = ["Axis", "Lattice", "beside", "lattices", "place_words"]


class Axis(NamedTuple):
    """One axis of a lattice."""

    periodic: bool
    widths: np.ndarray  # of the control volumes; infinite where there is none
    gaps: np.ndarray  # between the points beside a side, both ends included; at a wall the width of the control volume
    closed: tuple  # for each wall, whether what comes from outside is the point's own value

    @property
    def sides(self):
        """How many sides there are."""
        return self.widths.size + (not self.periodic)

    @property
    def around(self):
        """The distances to both neighbours."""
        return self.gaps[:-1], self.gaps[1:]

    @property
    def distances(self):
        """The distances to both neighbours, or to walls, over half a width."""
        gaps = self.gaps.copy()
        if not self.periodic:
            gaps[[0, -1]] /= 2
        return 2 * gaps[:-1] / self.widths, 2 * gaps[1:] / self.widths


class Lattice(NamedTuple):
    """One component of the moved field."""

    shape: tuple
    axes: tuple
    solid: Any  # boolean array, or None
    label: str  # words for messages

    @property
    def open(self):
        """For each axis, whether the lower and upper sides of points let something through: not those of solids."""
        solid, found = self.solid, []
        for number, axis in enumerate(self.axes):
            outside = None if axis.periodic else [np.zeros_like(solid.take([0], number))] * 2
            found.append([~(solid | other) for other in beside(solid, number, outside)])
        return np.array(found)


def lattices(setting):
    """All components of the moved field."""
    shapes, grid = component_shapes(setting), setting.grid
    if setting.of == "cells":
        return [_lattice(setting, None, shapes[0], setting.solid, "")]
    solid: list = [None] * grid.dim
    if setting.solid is not None:
        below, above = solid_faces(grid, setting.solid)
        solid = list(grid.faces.split(below | above))
    words = [f" of the {axis}-faces" for axis in grid.axes]
    return [_lattice(setting, a, shape, solid[a], words[a]) for a, shape in enumerate(shapes)]


def _lattice(setting, own, shape, solid, label):
    axes = tuple(_axis(setting, axis, axis == own) for axis in range(setting.grid.dim))
    return Lattice(shape, axes, solid, label)


def _axis(setting, axis, staggered):
    grid = setting.grid
    cells, between, periodic = grid.widths[axis], grid.spacings(axis), grid.periodic[axis]
    widths, inner = (between, cells) if staggered else (cells, between[1:-1])
    with np.errstate(divide="ignore"):
        widths = np.where(widths > 0, widths, np.inf)
    if periodic:
        gaps = np.append(cells[-1:], cells) if staggered else np.append(between, between[:1])
    else:
        gaps = np.concatenate([widths[:1], inner, widths[-1:]])
    sides = setting.sides[axis] or (None, None)
    return Axis(periodic, widths, gaps, tuple(side == neumann for side in sides))


def beside(x, number, outside=None):
    """What stands below and above the points along an axis; `outside`: beyond its walls, None if it is periodic."""
    if outside is None:
        return np.roll(x, 1, number), np.roll(x, -1, number)
    padded, points = np.concatenate([outside[0], x, outside[1]], number), np.arange(x.shape[number])
    return padded.take(points, number), padded.take(points + 2, number)


def place_words(setting, index):
    """Words for the place of a number of the field."""
    for lattice in lattices(setting):
        if index < prod(lattice.shape):
            break
        index -= prod(lattice.shape)
    where = tuple(map(int, np.unravel_index(index, lattice.shape)))
    return f"{where if len(where) > 1 else where[0]}{lattice.label}"
