"""Compiled loops of semi-Lagrangian transport: interpolation at departure points, its slope and its transpose.

The departure point of the point (i, j, k) is (i, j, k) - scale w, in index coordinates. A field is known with ghost
cells around it, as the flat array `samples`; `axes` and `tables` are those of `departure_samples.Points`.

The loops work on TILE points at a time, counted by `start` and `stop`: what belongs to a tile stays in the L1 cache,
and every inner loop runs over it, for one axis or one sample of the stencil. So the same loops serve 1-D to 3-D, linear
and cubic interpolation. Indices are unsigned, for a signed one would be tested for being negative.
"""

import numpy as np
from numba import njit

from sparsedp.kernels.departure_samples import PAD, TILE
from sparsedp.kernels.team import INNER, kernel

__all__ = ["interpolate", "scatter"]


@njit(**INNER)
def _stencils(w, scale, axes, tables, left, right, first, begin, weights, rows):
    """Departure points of the points left:right -> first sample of each stencil, weights of the samples by axis.

    There are always three axes: the weights of those that the field does not have are 1. `begin` says which of the
    four samples is the first that counts: for slopes at the points it is the one before the cell.
    """
    many, dim = right - left, len(w)
    number, rest, fraction = rows[0, :many], rows[1, :many], rows[2, :many]
    for j in range(number.size):
        rest[j] = left + j
        number[j] = 0.0
    for line in range(3 - dim):
        begin[line], weight = 1, weights[0, line, 1]
        for j in range(number.size):
            weight[j] = 1.0
    for axis in range(dim - 1, -1, -1):
        line = axis + 3 - dim
        n, stride, periodic, start, _ = axes[line]
        displacement, s, inverse, at_points = w[axis, left:right], scale[axis], 1.0 / n, 0
        low, high = 1.0 - PAD, n + PAD - 2.0
        for j in range(number.size):  # the index along this axis is a remainder; the half makes it exact
            above = np.floor((rest[j] + 0.5) * inverse)
            p = rest[j] - above * n - s * displacement[j]
            rest[j] = above
            if periodic:
                p -= n * np.floor(p * inverse)
            p = p if p >= low else low  # NaN too
            p = p if p <= high else high
            cell = np.floor(p)
            cell = cell if cell <= n else n
            fraction[j] = p - cell
            number[j] += stride * (cell + (PAD - 1))
            at_points += p == cell
        begin[line] = 0 if at_points and len(tables) > 1 else start
        for kind in range(len(tables)):
            for m in range(begin[line], 4 - begin[line]):
                weight, (a, b, c, d, at_point) = weights[kind, line, m, :many], tables[kind, m]
                for j in range(number.size):
                    t = fraction[j]
                    weight[j] = ((d * t + c) * t + b) * t + a if t != 0.0 else at_point
    for j in range(number.size):
        first[j] = np.int64(number[j])


@kernel("read1 read2 read1 index2 read3 read1 write2 write2")
def interpolate(samples, w, scale, axes, tables, g, out, bounds, start, stop):
    """out = W samples, and the least and greatest sample of the cell of each departure point, where there is room.

    `tables` has the weights of the value. With those of the slope too, out[axis] = -scale g times the slope of the
    interpolant along the axis: the derivative of g . (W samples) in w.
    """
    first, begin = np.empty(TILE, np.int64), np.empty(3, np.int64)
    weights, rows = np.empty((2, 3, 4, TILE)), np.empty((1, 1, 3, TILE))[0, 0]  # of value and slope by axis and sample
    dim, slopes = len(w), len(tables) > 1
    value, slope, _ = rows
    for left in range(start * TILE, min(stop * TILE, w.shape[1]), TILE):
        right = min(left + TILE, w.shape[1])
        _stencils(w, scale, axes, tables, left, right, first, begin, weights, rows)
        many, least, greatest = right - left, bounds[0, left:right], bounds[1, left:right]
        for axis in range(len(out)):
            for j in range(left, right):
                out[axis, j] = 0.0
        for j in range(least.size):
            least[j], greatest[j] = np.inf, -np.inf
        for i in range(begin[0], axes[0, 4]):
            for k in range(begin[1], axes[1, 4]):
                for j in range(many):
                    value[j] = slope[j] = 0.0
                near = samples[i * axes[0, 1] + k * axes[1, 1] :]
                for m in range(begin[2], 4 - begin[2], 2):  # in pairs: half the passes over the sums
                    line, a, b = near[m:], weights[0, 2, m], weights[0, 2, m + 1]
                    c, d = weights[1, 2, m], weights[1, 2, m + 1]
                    for j in range(many):
                        place = np.uint64(first[j])
                        one, two = line[place], line[place + np.uint64(1)]
                        value[j] += a[j] * one + b[j] * two
                        if slopes:
                            slope[j] += c[j] * one + d[j] * two
                for m in range(1, 3 if 0 < i < 3 and 0 < k < 3 else 1):
                    line = near[m:]
                    for j in range(least.size):
                        sample = line[np.uint64(first[j])]
                        least[j] = sample if sample < least[j] else least[j]
                        greatest[j] = sample if sample > greatest[j] else greatest[j]
                for axis in range(len(out)):  # its factor is the slope, the others are values
                    steep = axis + 3 - dim if slopes else -1
                    a, b, c = weights[int(steep == 0), 0, i], weights[int(steep == 1), 1, k], rows[int(steep == 2)]
                    result = out[axis, left:right]
                    for j in range(result.size):
                        result[j] += a[j] * b[j] * c[j]
        if slopes:
            for axis in range(dim):
                result, given, factor = out[axis, left:right], g[left:right], -scale[axis]
                for j in range(result.size):
                    result[j] *= factor * given[j]


@kernel("read2 read1 index2 read3 read1 write1")
def scatter(w, scale, axes, tables, g, samples, start, stop):
    """samples += W^T g: for one thread, as points share samples."""
    first, begin = np.empty(TILE, np.int64), np.empty(3, np.int64)
    weights, rows = np.empty((2, 3, 4, TILE)), np.empty((1, 1, 3, TILE))[0, 0]  # of value and slope by axis and sample
    for left in range(start * TILE, min(stop * TILE, w.shape[1]), TILE):
        right = min(left + TILE, w.shape[1])
        _stencils(w, scale, axes, tables, left, right, first, begin, weights, rows)
        given, share = g[left:right], rows[0]
        for i in range(begin[0], axes[0, 4]):
            for k in range(begin[1], axes[1, 4]):
                a, b = weights[0, 0, i], weights[0, 1, k]
                for j in range(given.size):
                    share[j] = a[j] * b[j] * given[j]
                for m in range(begin[2], axes[2, 4]):
                    line, weight = samples[i * axes[0, 1] + k * axes[1, 1] + m :], weights[0, 2, m]
                    for j in range(given.size):
                        line[np.uint64(first[j])] += weight[j] * share[j]
