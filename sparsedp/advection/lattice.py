"""Points that carry a field, the interfaces between them, and the velocity there, as sparse matrices.

A component of the moved field lives on a lattice of points, one control volume each: the cells
of the grid, or the faces across one axis (half a cell at a wall). Along each axis, interface f lies
between points f - 1 and f; a bounded axis has one more interface than points, the two walls
included, a periodic one as many. All interfaces of all axes of all components stand in one flat array.

Upwind transport is bilinear away from w = 0. With p = max(w, 0), m = min(w, 0), w = S v the velocity
where it is needed, and z = (u, inflow),

    u' = u - dt [ C+ (p * A+ z) + C- (m * A- z) ].

flux:                    w on interfaces, A+ (A-) takes the point below (above), C+ = C- is the divergence.
advective, face velocity: w on interfaces, A+ = A- is the difference across, C+ (C-) divides it by the
                         width of the point above (below): the flux form minus u times the divergence of w.
advective, cell velocity: w on points, A+ (A-) is the slope to the point below (above), C adds up the axes.
"""

from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.law import component_shapes
from sparsedp.conditions import neumann
from sparsedp.operators.boundary import solid_faces

__all__ = ["Axis", "Lattice", "Matrices", "lattices"]


class Axis(NamedTuple):
    """One axis of a lattice."""

    points: int
    interfaces: int
    periodic: bool
    widths: np.ndarray  # of the control volumes; infinite where there is none
    gaps: np.ndarray  # between the points beside an interface; at a wall the width of the control volume
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


class Matrices:
    """The matrices of the formula in the head of this file. Made when first asked for."""

    def __init__(self, setting, walls):
        self.setting = setting
        self.lattices = lattices(setting)
        self.on_points = setting.velocity == "cells" and setting.form == "advective"
        self.size = setting.space.size
        self.walls = walls.size

    @cached_property
    def neighbours(self):
        """For each (component, axis): columns of z below and above each interface, whether it is open, its Axis."""
        found, point, wall = [], 0, self.size
        for lattice in self.lattices:
            own = np.arange(point, point + prod(lattice.shape)).reshape(lattice.shape)
            point += own.size
            for number, axis in enumerate(lattice.axes):
                below, above, wall = _beside(own, number, axis, wall)
                found.append((below, above, _open(lattice, number, axis, below.shape), own, axis))
        return found

    @cached_property
    def parts(self):
        """A+, A-, C+, C- as csr_arrays."""
        blocks = [self._block(number, *item) for number, item in enumerate(self.neighbours)]
        lower, upper, left, right = zip(*blocks, strict=True)
        stack = [sp.vstack(lower, "csr"), sp.vstack(upper, "csr"), sp.hstack(left, "csr"), sp.hstack(right, "csr")]
        return tuple(sp.csr_array(matrix) for matrix in stack)

    def _block(self, number, below, above, is_open, own, axis):
        number %= len(self.lattices[0].axes)
        width, gap = (along(line, number, own.ndim) for line in (axis.widths, axis.gaps))
        z, n = self.size + self.walls, self.size
        if self.on_points:
            weight = is_open / gap
            rows = np.arange(own.size).reshape(own.shape)
            slopes = []
            for shift in (0, 1):  # the interface below a point, and the one above
                index = (np.arange(axis.points) + shift) % max(axis.interfaces, 1)
                low, high, size = (
                    np.take(x, index, number) for x in (below, above, np.broadcast_to(weight, below.shape))
                )
                slopes.append(entries((own.size, z), (rows, high, size), (rows, low, -size)))
            total = entries((n, own.size), (own, rows, 1.0))
            return *slopes, total, total
        faces = np.arange(below.size).reshape(below.shape)
        first, last = (np.take(faces, (np.arange(axis.points) + s) % max(axis.interfaces, 1), number) for s in (0, 1))
        into, out = entries((n, below.size), (own, first, 1 / width)), entries((n, below.size), (own, last, 1 / width))
        if self.setting.form == "flux":
            lower, upper = (entries((below.size, z), (faces, side, is_open)) for side in (below, above))
            return lower, upper, out - into, out - into
        across = entries((below.size, z), (faces, above, is_open), (faces, below, -is_open))
        return across, across, into, out

    @cached_property
    def turned(self):
        """The transposes of `parts`."""
        return tuple(sp.csr_array(matrix.T) for matrix in self.parts)

    @cached_property
    def own(self):
        """E+, E-: the step leaves u_i the weight 1 - dt (E+ p + E- m)_i."""
        lower, upper, left, right = self.parts
        pairs = ((left, lower), (right, upper))
        return tuple(sp.csr_array(c.multiply(sp.csr_array(a[:, : self.size].T))) for c, a in pairs)

    def place(self, index):
        """Words for the place of a number of the field."""
        for lattice in self.lattices:
            if index < prod(lattice.shape):
                break
            index -= prod(lattice.shape)
        where = tuple(map(int, np.unravel_index(index, lattice.shape)))
        return f"{where if len(where) > 1 else where[0]}{lattice.label}"


def _beside(own, number, axis, wall):
    """Columns of z below and above each interface; the columns from `wall` on are inflow values."""
    first, last = (np.take(own, [end] if axis.points else [], number) for end in (0, -1))
    if axis.periodic:
        return np.concatenate([last, own], number)[_most(own, number, axis.points)], own, wall
    outside = []
    for side, edge in enumerate((first, last)):
        many = own[_most(own, number, 1)].size if axis.points else prod(own.shape[:number] + own.shape[number + 1 :])
        if axis.closed[side] or not axis.points:
            outside.append(edge)
        else:
            outside.append(np.arange(wall, wall + edge.size).reshape(edge.shape))
        wall += many
    return np.concatenate([outside[0], own], number), np.concatenate([own, outside[1]], number), wall


def _most(array, axis, stop):
    return tuple(slice(stop) if a == axis else slice(None) for a in range(array.ndim))


def _open(lattice, number, axis, shape):
    """1 where an interface lets something through, 0 where it touches a solid."""
    if lattice.solid is None:
        return np.ones(shape)
    if axis.periodic:
        return 1.0 - (lattice.solid | np.roll(lattice.solid, 1, number))
    pad = [(0, 0)] * len(lattice.shape)
    pad[number] = (1, 1)
    solid = np.pad(lattice.solid, pad)
    low, high = (np.delete(solid, end, number) for end in (-1, 0))
    return 1.0 - (low | high)


def along(line, number, dim):
    return line.reshape([-1 if a == number else 1 for a in range(dim)])


def entries(shape, *triples):
    """csr_array from (rows, columns, values); values broadcast, equal places add up, zeros are left out."""
    rows, columns, values = (
        np.concatenate([np.broadcast_to(entry[k], entry[0].shape).ravel() for entry in triples]) for k in range(3)
    )
    keep = values != 0
    found = sp.csr_array((values[keep], (rows[keep].astype(np.int32), columns[keep].astype(np.int32))), shape)
    found.sum_duplicates()
    return found
