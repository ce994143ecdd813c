"""Compiled loops of semi-Lagrangian transport: departure points, the interpolation there, bounds of a cell.

A field is known with ghost cells around it, as the flat array `samples`. `axes` says for each of its one to three axes
what `departure.Points` lists. The departure point (i, j, k) - scale w of point (i, j, k), in index coordinates, is kept
as a column of `departures`: the fraction of a cell along each axis, and the number of the first sample of its stencil,
which lies one sample before the cell along each axis.

The loops work on TILE points at a time, counted by `start` and `stop`: what belongs to a tile stays in the L1 cache,
and every inner loop runs over it for one axis or one sample of the stencil. So the same loops serve 1-D to 3-D, linear
and cubic interpolation. Indices are unsigned, for a signed one would be tested for being negative.
"""

import numpy as np

from sparsedp.kernels.team import kernel

__all__ = ["TILE", "depart", "extrema", "interpolate"]

TILE = 256  # points; up to 17 rows of 2 KB are in use, which fits the L1 cache


@kernel("read2 read1 read2 write2")
def depart(w, scale, axes, departures, start, stop):
    """Velocities or displacements w, one row for each axis -> departure points."""
    dim, points = w.shape
    rest = np.empty(TILE)
    for left in range(start * TILE, min(stop * TILE, points), TILE):
        right = min(left + TILE, points)
        many, first = right - left, departures[dim, left:right]
        for j in range(many):
            rest[j] = left + j
            first[j] = 0.0
        for axis in range(dim - 1, -1, -1):
            n, stride, origin, low, high, last, periodic = axes[axis]
            fraction, displacement, s = departures[axis, left:right], w[axis, left:right], scale[axis]
            for j in range(many):  # the index along this axis is a remainder, in floats for the vector units
                above = np.floor(rest[j] / n)
                fraction[j] = rest[j] - above * n
                rest[j] = above
            for j in range(many):
                p = fraction[j] - s * displacement[j]
                if periodic != 0.0:
                    p -= n * np.floor(p / n)
                p += origin
                p = p if p >= low else low  # NaN too
                p = p if p <= high else high
                cell = np.floor(p)
                cell = cell if cell <= last else last
                fraction[j] = p - cell
                first[j] += stride * (cell - 1.0)


@kernel("write1 read2 read2 read3 real read1 write1 flag")
def interpolate(samples, departures, axes, weights, factor, g, out, transpose, start, stop):
    """out = factor g * (W samples); transposed, samples += W^T (factor g): for one thread, as points share samples.

    `weights` has for each axis and each of the four samples of the stencil the coefficients of its weight, a cubic
    in the fraction t of the cell: those of 1, t, t^2, t^3, and the weight where t = 0. An empty g is 1.
    """
    dim, points = len(axes), departures.shape[1]
    first, shared, rows, ends = (
        np.empty(TILE, np.uint64),
        np.empty(TILE),
        np.empty((3, 4, TILE)),
        np.zeros((3, 2), np.int64),
    )
    rows[: 3 - dim, 0], ends[:, 1] = 1.0, 1  # where there is no axis
    far, middle = int(axes[0, 1]) if dim > 2 else 0, int(axes[dim - 2, 1]) if dim > 1 else 0
    for left in range(start * TILE, min(stop * TILE, points), TILE):
        right = min(left + TILE, points)
        many, result = right - left, out[left:right]
        for j in range(many):
            first[j] = np.uint64(departures[dim, left + j])
        for axis in range(dim):
            fraction, outer = departures[axis, left:right], 0
            for m in range(4):
                a, b, c, d, at_point = weights[axis, m]
                row, used = rows[axis + 3 - dim, m], 0
                for j in range(many):
                    t = fraction[j]
                    row[j] = ((d * t + c) * t + b) * t + a if t != 0.0 else at_point
                    used += row[j] != 0.0
                outer += used if m == 0 or m == 3 else 0
            ends[axis + 3 - dim, 0], ends[axis + 3 - dim, 1] = (0, 4) if outer else (1, 3)
        if not transpose:
            result[:] = 0.0
        for i in range(ends[0, 0], ends[0, 1]):
            for k in range(ends[1, 0], ends[1, 1]):
                one, two = rows[0, i], rows[1, k]
                for j in range(many):
                    shared[j] = factor * one[j] * two[j]
                if g.size:
                    given = g[left:right]
                    for j in range(many):
                        shared[j] *= given[j]
                for m in range(ends[2, 0], ends[2, 1], 2):
                    line, three, four = samples[i * far + k * middle + m :], rows[2, m], rows[2, m + 1]
                    if transpose:
                        for j in range(many):
                            line[first[j]] += shared[j] * three[j]
                        for j in range(many):
                            line[first[j] + np.uint64(1)] += shared[j] * four[j]
                    else:
                        for j in range(many):
                            at = first[j]
                            result[j] += shared[j] * (three[j] * line[at] + four[j] * line[at + np.uint64(1)])


@kernel("read1 read2 read2 write1 write1")
def extrema(samples, departures, axes, low, high, start, stop):
    """Least and greatest sample of the cell of each departure point."""
    dim, points = len(axes), departures.shape[1]
    first = np.empty(TILE, np.uint64)
    for left in range(start * TILE, min(stop * TILE, points), TILE):
        right = min(left + TILE, points)
        least, greatest = low[left:right], high[left:right]
        for j in range(right - left):
            first[j] = np.uint64(departures[dim, left + j])
        least[:], greatest[:] = np.inf, -np.inf
        for corner in range(1 << dim):
            number = 0
            for axis in range(dim):
                number += (1 + (corner >> axis & 1)) * int(axes[axis, 1])
            line = samples[number:]
            for j in range(right - left):
                value = line[first[j]]
                least[j], greatest[j] = min(least[j], value), max(greatest[j], value)
