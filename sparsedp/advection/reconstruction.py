"""Values on both sides of every interface from limited slopes, as `van_leer` needs them, and their tangents:
by sparse matrices, beside the fused loops."""

from functools import cached_property
from math import prod

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.lattice import Matrices, along, entries

__all__ = ["Reconstruction"]


class Reconstruction:
    """From z = (u, inflow) to the values below and above: on interfaces, or their slopes on points.

    Slopes s are numbered (component, axis, point) like a velocity on points.
    """

    def __init__(self, setting, walls):
        self.advective = setting.form == "advective" and setting.velocity == "faces"
        self.on_points = setting.form == "advective" and setting.velocity == "cells"
        self.matrices = Matrices(setting._replace(form="flux"), walls)

    @cached_property
    def _sides(self):
        """From z: the jumps on interfaces, x+ and x-; from the slopes: what they add to x+ and take from x-."""
        blocks, slope = [], 0
        for number, item in enumerate(self.matrices.neighbours):
            own = item[3]
            index = np.full(self.matrices.size + self.matrices.walls, -1)
            index[own] = slope + np.arange(own.size).reshape(own.shape)
            slope += own.size
            blocks.append((number % len(own.shape), index, *item))
        size, slopes = self.matrices.size + self.matrices.walls, slope
        rows = [self._block(size, slopes, *block) for block in blocks]
        return tuple(sp.csr_array(sp.vstack(side, "csr")) for side in zip(*rows, strict=True))

    def _block(self, size, slopes, number, index, below, above, is_open, own, axis):
        faces = np.arange(below.size).reshape(below.shape)
        jump = entries((faces.size, size), (faces, above, is_open), (faces, below, -is_open))
        under, over = index[below], index[above]  # slopes of the points on both sides, -1 outside
        if not axis.periodic and own.size:
            np.moveaxis(under, number, 0)[0] = np.moveaxis(over, number, 0)[-1] = -1
        if not self.on_points:
            sides = [entries((faces.size, size), (faces, side, is_open)) for side in (below, above)]
            slope = [entries((faces.size, slopes), _known(faces, side, is_open)) for side in (under, over)]
            return jump, *sides, *slope
        point, mine = np.arange(own.size).reshape(own.shape), index[own]
        ends = [(np.arange(axis.points) + shift) % max(axis.interfaces, 1) for shift in (0, 1)]
        width = 1 / along(axis.widths, number, own.ndim) * np.ones(own.shape)
        found = []
        for end, side, beyond, sign in ((ends[0], below, under, 1.0), (ends[1], above, over, -1.0)):
            scale = np.take(is_open, end, number) * width
            near, slope = np.take(side, end, number), np.take(beyond, end, number)
            found.append(entries((own.size, size), (point, own, sign * scale), (point, near, -sign * scale)))
            weights = (point, mine, sign * width), _known(point, slope, -sign * scale)
            found.append(entries((own.size, slopes), *weights))
        return jump, found[0], found[2], found[1], found[3]

    @cached_property
    def _stencil(self):
        """For each slope: the interface below and above, c and e."""
        lower: list = []
        upper: list = []
        back: list = []
        ahead: list = []
        face = 0
        for number, (below, _, _, own, axis) in enumerate(self.matrices.neighbours):
            number %= len(own.shape)
            faces = face + np.arange(below.size).reshape(below.shape)
            face += below.size
            gaps = axis.gaps.copy()
            if not axis.periodic and gaps.size:
                gaps[[0, -1]] *= 0.5  # an inflow value stands on the wall
            for shift, sides, factors in ((0, lower, back), (1, upper, ahead)):
                index = (np.arange(axis.points) + shift) % max(axis.interfaces, 1)
                sides.append(np.take(faces, index, number).ravel())
                factor = along(2 * gaps[index] / axis.widths, number, own.ndim)
                factors.append(np.broadcast_to(factor, own.shape).ravel())
        return tuple(map(np.concatenate, (lower, upper, back, ahead)))

    @cached_property
    def opened(self):
        """1 on interfaces that let something through."""
        return np.concatenate([is_open.ravel() for _, _, is_open, _, _ in self.matrices.neighbours])

    @cached_property
    def divide(self):
        """From the flux (or, on points, speed times slope) to what leaves each point."""
        if not self.on_points:
            return self.matrices.parts[2]
        blocks, start = [], 0
        for lattice in self.matrices.lattices:
            size = prod(lattice.shape)
            rows = np.tile(np.arange(start, start + size), len(lattice.shape))
            blocks.append(entries((self.matrices.size, rows.size), (rows, np.arange(rows.size), np.ones(rows.size))))
            start += size
        return sp.csr_array(sp.hstack(blocks, "csr"))

    def _jumps(self, z):
        """A and B of every slope."""
        jump = self._sides[0] @ z
        return jump[self._stencil[0]], jump[self._stencil[1]]

    def values(self, z):
        """x+ and x-."""
        _, lower, upper, of_lower, of_upper = self._sides
        slope = limited(*self._jumps(z), *self._stencil[2:])
        return lower @ z + of_lower @ slope, upper @ z - of_upper @ slope

    def push(self, z, dz):
        """Tangent of z -> those of x+ and x-."""
        _, lower, upper, of_lower, of_upper = self._sides
        da, db = slopes_of(*self._jumps(z), *self._stencil[2:])
        a, b = self._jumps(dz)
        slope = da * a + db * b
        return lower @ dz + of_lower @ slope, upper @ dz - of_upper @ slope


def _known(rows, columns, values):
    """Entries of a matrix whose column is not -1."""
    keep = columns >= 0
    return rows[keep], columns[keep], np.broadcast_to(values, rows.shape)[keep]


def _share(a, b, c, e):
    """Where A and B agree in sign, q, and the numerator and denominator of R with their parts."""
    same = ((a > 0) & (b > 0)) | ((a < 0) & (b < 0))
    q = a / np.where(same, a + b, 1.0)
    cc, ee, mixed = c * c, e * e, (c + e - 2) * c * e
    top = q * (1 - q) * (q * ee + (1 - q) * cc)
    under = q * q * ee + mixed * q * (1 - q) + (1 - q) ** 2 * cc
    return same, q, top, np.where(same, under, 1.0), cc, ee, mixed


def limited(a, b, c, e):
    """s of the formula in `van_leer`."""
    same, _, top, under, *_ = _share(a, b, c, e)
    return np.where(same, (a + b) * (top / under), 0.0)


def slopes_of(a, b, c, e):
    """ds/dA and ds/dB."""
    same, q, top, under, cc, ee, mixed = _share(a, b, c, e)
    ratio = top / under
    top_slope = ee * (2 * q - 3 * q * q) + cc * ((1 - q) ** 2 - 2 * q * (1 - q))
    slope = (top_slope - ratio * (2 * q * ee + mixed * (1 - 2 * q) - 2 * (1 - q) * cc)) / under
    da = np.where(same, ratio + (1 - q) * slope, 0.5 * ((a == 0) & (b != 0)))
    db = np.where(same, ratio - q * slope, 0.5 * ((b == 0) & (a != 0)))
    return da, db
