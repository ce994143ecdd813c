"""The schemes of transport, with slices in autograd.numpy: slow, plain, and differentiated by the tape."""

import autograd.numpy as anp

import sparsedp as dp
from sparsedp.grid.boundary_conditions import resolve


def cut(x, axis, start, stop):
    return x[tuple(slice(start, stop) if a == axis else slice(None) for a in range(anp.ndim(x)))]


def line(x, axis, dim):
    return anp.reshape(x, [-1 if a == axis else 1 for a in range(dim)])


def to_nodes(x, grid, axis, shared):
    """Interpolate from cells to nodes: linear between centres, or the mean weighted with the widths."""
    h = line(grid.widths[axis], axis, grid.dim)
    if grid.periodic[axis]:
        x, h = (anp.concatenate([cut(y, axis, -1, None), y], axis) for y in (x, h))
    low = cut(x, axis, 0, -1)
    high = cut(x, axis, 1, None)
    hl = cut(h, axis, 0, -1)
    hh = cut(h, axis, 1, None)
    inner = (low * hl + high * hh) / (hl + hh) if shared else (low * hh + high * hl) / (hl + hh)
    if grid.periodic[axis]:
        return inner
    return anp.concatenate([cut(x, axis, 0, 1), inner, cut(x, axis, -1, None)], axis)


def inside(x, grid, axis, nodes):
    """Return values at the interfaces between the nodes of an axis: the cell centres, and the walls."""
    periodic = grid.periodic[axis]
    middle = x
    if nodes:
        if periodic:
            x = anp.concatenate([x, cut(x, axis, 0, 1)], axis)
        middle = 0.5 * (cut(x, axis, 0, -1) + cut(x, axis, 1, None))
    if periodic:
        return anp.concatenate([cut(middle, axis, -1, None), cut(middle, axis, 0, -1)], axis)
    return anp.concatenate([cut(x, axis, 0, 1), middle, cut(x, axis, -1, None)], axis)


def carrying_speeds(grid, v, velocity, form, own):
    """The velocity along each axis where component `own` (None: cells) needs it."""
    on_faces = velocity == "faces"
    if on_faces:
        parts = grid.split(v)
    else:
        parts = list(anp.reshape(v, (grid.dim, *grid.shape)))
    speeds = []
    for axis, part in enumerate(parts):
        if not on_faces and form == "advective":
            if own is not None:
                part = to_nodes(part, grid, own, False)
        elif axis == own:
            part = inside(part, grid, axis, on_faces)
        else:
            if not on_faces:
                part = to_nodes(part, grid, axis, False)
            if own is not None:
                part = to_nodes(part, grid, own, True)
        speeds.append(part)
    return speeds


class Line:
    """One axis of a component: its widths and distances, and what stands outside."""

    def __init__(self, grid, axis, own, sides, walls):
        self.axis = axis
        self.periodic = grid.periodic[axis]
        self.sides = sides
        self.walls = walls
        cells = grid.widths[axis]
        between = grid.spacings(axis)
        if own == axis:  # points on faces
            h = between
            inner_gaps = cells
            wrapped_gaps = anp.roll(cells, 1)
        else:
            h = cells
            inner_gaps = between[1:-1]
            wrapped_gaps = between
        if self.periodic:
            gaps = anp.append(wrapped_gaps, wrapped_gaps[:1])
            share_at_ends = 1.0
        else:
            gaps = anp.concatenate([h[:1], inner_gaps, h[-1:]])
            share_at_ends = 0.5
        self.half = gaps * anp.where(anp.arange(gaps.size) % (gaps.size - 1) == 0, share_at_ends, 1.0)
        self.h, self.gaps, self.half = (line(x, axis, grid.dim) for x in (h, gaps, self.half))

    def around(self, u, low=None, high=None):
        """The values below and above each interface, walls and both ends of a periodic axis included."""
        if low is None:
            low = high = u
        first = cut(u, self.axis, 0, 1)
        last = cut(u, self.axis, -1, None)
        before = cut(low, self.axis, -1, None)
        after = cut(high, self.axis, 0, 1)
        if not self.periodic:
            before, after = (
                edge if side == dp.neumann else wall for edge, side, wall in zip((first, last), self.sides, self.walls)
            )
        return anp.concatenate([before, low], self.axis), anp.concatenate([high, after], self.axis)

    def slope(self, u):
        """Van Leer's limited difference from the point to its face."""
        below, above = self.around(u)
        a = u - cut(below, self.axis, 0, -1)
        b = cut(above, self.axis, 1, None) - u
        c, e = (2 * cut(self.half, self.axis, i, j) / self.h for i, j in ((0, -1), (1, None)))
        same = a * b > 0
        a = anp.where(same, a, 1.0)
        b = anp.where(same, b, 1.0)
        top = a * b * (a * e**2 + b * c**2)
        return anp.where(same, top / (a**2 * e**2 + (c + e - 2) * c * e * a * b + b**2 * c**2), 0.0)

    def rate(self, u, w, form, points, limited):
        slope = self.slope(u) if limited else 0.0
        below, above = self.around(u, u + slope, u - slope)
        lower = lambda x: cut(x, self.axis, 0, -1)
        upper = lambda x: cut(x, self.axis, 1, None)
        if points:
            p = anp.maximum(w, 0.0)
            m = anp.minimum(w, 0.0)
            back = ahead = self.h
            if not limited:
                back = lower(self.gaps)
                ahead = upper(self.gaps)
            return -p * (upper(below) - lower(below)) / back - m * (upper(above) - lower(above)) / ahead
        if self.periodic:
            w = anp.concatenate([w, cut(w, self.axis, 0, 1)], self.axis)
        flux = anp.maximum(w, 0.0) * below + anp.minimum(w, 0.0) * above
        rate = -(upper(flux) - lower(flux)) / self.h
        if form == "advective":
            return rate + u * (upper(w) - lower(w)) / self.h
        return rate


def component(grid, own, u, w, dt, walls, sides, form, points, scheme):
    lines = []
    for axis in range(grid.dim):
        outside = [next(walls) for _ in sides[axis] or ()]
        lines.append(Line(grid, axis, own, sides[axis], outside))
    rate = lambda u: sum(one.rate(u, w[a], form, points, scheme == "van_leer") for a, one in enumerate(lines))
    first = u + dt * rate(u)
    if scheme == "upwind":
        return first
    return 0.5 * (u + first + dt * rate(first))


def twin(grid, scheme, boundary, velocity, of, form):
    """The function that ``dp.transport(...)`` with the same arguments is."""
    sides = resolve(grid, boundary)
    space = grid.cells if of == "cells" else grid.faces
    points = velocity == "cells" and form == "advective"
    walls = dp.transport(grid, scheme, boundary, velocity, of, form=form).walls

    def move(u, v, dt, inflow):
        values = iter(walls.split(inflow * anp.ones(walls.size)))
        parts = [u] if of == "cells" else space.split(u)
        moved = []
        for number, part in enumerate(parts):
            own = None if of == "cells" else number
            w = carrying_speeds(grid, v, velocity, form, own)
            moved.append(component(grid, own, part, w, dt, values, sides, form, points, scheme))
        if of == "cells":
            return moved[0]
        return space.join(*moved)

    return move
