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

__all__ = ["Axis", "Lattice", "lattices", "opened", "place_words", "spread", "take"]


class Axis(NamedTuple):
    """One axis of a lattice."""

    points: int
    sides: int
    periodic: bool
    widths: np.ndarray  # of the control volumes; infinite where there is none
    gaps: np.ndarray  # between the points beside a side; at a wall the width of the control volume
    closed: tuple  # for each wall, whether what comes from outside is the point's own value


class Lattice(NamedTuple):
    """One component of the moved field."""

    shape: tuple
    axes: tuple
    solid: Any  # boolean array, or None
    label: str  # words for messages


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
        gaps = np.roll(cells, 1) if staggered else between
    else:
        gaps = np.concatenate([widths[:1], inner, widths[-1:]])
    sides = setting.sides[axis] or (None, None)
    points = widths.size
    return Axis(points, gaps.size if points else 0, periodic, widths, gaps, tuple(side == neumann for side in sides))


def spread(line, number, shape):
    """One number for each point along an axis -> one for each point."""
    return np.broadcast_to(line.reshape([-1 if a == number else 1 for a in range(len(shape))]), shape)


def take(x, axis, number, shift):
    """From sides to points: what stands at the lower (0) or upper (1) side of each point."""
    return np.take(x, (np.arange(axis.points) + shift) % max(axis.sides, 1), number)


def opened(lattice, number):
    """Whether the sides across an axis let something through: False where one touches a solid."""
    axis, many = lattice.axes[number], list(lattice.shape)
    many[number] = axis.sides
    if lattice.solid is None:
        return np.ones(many, bool)
    if axis.periodic:
        return ~(lattice.solid | np.roll(lattice.solid, 1, number))
    solid = np.pad(lattice.solid, [(1, 1) if a == number else (0, 0) for a in range(len(many))])
    return ~(np.delete(solid, -1, number) | np.delete(solid, 0, number))


def place_words(setting, index):
    """Words for the place of a number of the field."""
    for lattice in lattices(setting):
        if index < prod(lattice.shape):
            break
        index -= prod(lattice.shape)
    where = tuple(map(int, np.unravel_index(index, lattice.shape)))
    return f"{where if len(where) > 1 else where[0]}{lattice.label}"
