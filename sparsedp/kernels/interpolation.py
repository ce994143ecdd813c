"""Compiled loops of semi-Lagrangian transport: interpolation at departure points, and bounds of the cells there.

The departure point of the point (i, j, k) is (i, j, k) - scale w, in index coordinates. A field is known with ghost
cells around it, as the flat array `samples`; `axes` and `weights` say for each of its one to three axes what
`departure.Points` lists.

The loops work on TILE points at a time, counted by `start` and `stop`: what belongs to a tile stays in the L1 cache,
and every inner loop runs over it, for one axis or one sample of the stencil. So the same loops serve 1-D to 3-D, linear
and cubic interpolation. Indices are unsigned, for a signed one would be tested for being negative.
"""

import numpy as np
from numba import njit

from sparsedp.kernels.team import kernel

__all__ = ["TILE", "extrema", "interpolate"]

TILE = 256  # points; up to 20 rows of 2 KB are in use at a time, which fits the L1 cache


@njit(error_model="numpy")
def _scratch():
    """Rows of a tile: first sample of each stencil, fractions of a cell along each axis, two rows of any kind."""
    return np.empty(TILE, np.uint64), np.empty((3, TILE)), np.empty((2, TILE))


@njit(error_model="numpy")
def _depart(w, scale, axes, start, stop, scratch):
    """Departure points of the points start:stop -> first sample of the stencil, fraction of a cell along each axis."""
    first, fractions, rows = scratch
    number, rest = rows[0], rows[1]
    for j in range(stop - start):
        rest[j] = start + j
        number[j] = 0.0
    for axis in range(len(w) - 1, -1, -1):
        n, stride, before, low, high, last, periodic = axes[axis]
        fraction, displacement, s, inverse = fractions[axis], w[axis, start:stop], scale[axis], 1.0 / n
        for j in range(displacement.size):  # the index along this axis is a remainder; the half makes it exact
            above = np.floor((rest[j] + 0.5) * inverse)
            fraction[j] = rest[j] - above * n
            rest[j] = above
        for j in range(displacement.size):
            p = fraction[j] - s * displacement[j]
            if periodic != 0.0:
                p -= n * np.floor(p * inverse)
            p = p if p >= low else low  # NaN too
            p = p if p <= high else high
            cell = np.floor(p)
            cell = cell if cell <= last else last
            fraction[j] = p - cell
            number[j] += stride * (cell + before)
    for j in range(stop - start):
        first[j] = np.uint64(number[j])


@njit(error_model="numpy")
def _weigh(tables, fractions, many, weights, ends):
    """Weights of the four samples of a stencil along each axis, for the value and, if there are tables, the slope.

    `ends` of those that are not 0 for all points, from and to. Where there is no axis, one weight is 1.
    """
    dim = tables.shape[1]
    ends[:, 0], ends[:, 1] = 1, 2
    weights[0, : 3 - dim, 1], weights[1, : 3 - dim, 1] = 1.0, 0.0
    for kind in range(len(tables)):
        for axis in range(dim):
            row, fraction, used = axis + 3 - dim, fractions[axis], 0
            for m in range(4):
                weight, (a, b, c, d, at_point) = weights[kind, row, m], tables[kind, axis, m]
                last = used
                if not tables[kind, axis, m].any():
                    weight[:many] = 0.0
                    continue
                for j in range(many):
                    t = fraction[j]
                    weight[j] = ((d * t + c) * t + b) * t + a if t != 0.0 else at_point
                if m == 0 or m == 3:
                    for j in range(many):
                        used += weight[j] != 0.0
            ends[row, 0], ends[row, 1] = 0 if used else ends[row, 0], max(ends[row, 1], 4 if used > last else 3)


@kernel("write1 read2 read1 read2 read4 read1 write2 flag")
def interpolate(samples, w, scale, axes, tables, g, out, transpose, start, stop):
    """out = W samples; transposed, samples += W^T g: for one thread, as points share samples.

    `tables` has the weights of the value along each axis. With those of the slope too, out[axis] = -scale g times the
    slope of the interpolant along the axis: the derivative of g . (W samples) in w.
    """
    scratch, weights, ends, dim = _scratch(), np.empty((2, 3, 4, TILE)), np.empty((3, 2), np.int64), len(axes)
    first, sums, slopes = scratch[0], scratch[2], len(tables) > 1
    value, slope = sums[0], sums[1]
    far, middle = int(axes[0, 1]) if dim > 2 else 0, int(axes[dim - 2, 1]) if dim > 1 else 0
    for left in range(start * TILE, min(stop * TILE, w.shape[1]), TILE):
        right = min(left + TILE, w.shape[1])
        many, given = right - left, g[left:right]
        _depart(w, scale, axes, left, right, scratch)
        _weigh(tables, scratch[1], many, weights, ends)
        out[:, left:right] = 0.0
        for i in range(ends[0, 0], ends[0, 1]):
            for k in range(ends[1, 0], ends[1, 1]):
                one, two = weights[0, 0, i], weights[0, 1, k]
                for j in range(given.size if transpose else 0):
                    value[j] = one[j] * two[j] * given[j]
                if not transpose:
                    sums[:] = 0.0
                for m in range(ends[2, 0], ends[2, 1], 2):
                    line, a, b = samples[i * far + k * middle + m :], weights[0, 2, m], weights[0, 2, m + 1]
                    c, d = weights[1, 2, m], weights[1, 2, m + 1]
                    if transpose:
                        for j in range(many):
                            line[first[j]] += a[j] * value[j]
                        for j in range(many):
                            line[first[j] + np.uint64(1)] += b[j] * value[j]
                    elif slopes:
                        for j in range(many):
                            before, after = line[first[j]], line[first[j] + np.uint64(1)]
                            value[j] += a[j] * before + b[j] * after
                            slope[j] += c[j] * before + d[j] * after
                    else:
                        for j in range(many):
                            value[j] += a[j] * line[first[j]] + b[j] * line[first[j] + np.uint64(1)]
                for axis in range(len(out)):  # its factor is the slope, the others are values
                    steep = axis + 3 - dim if slopes else -1
                    a, b, c = weights[int(steep == 0), 0, i], weights[int(steep == 1), 1, k], sums[int(steep == 2)]
                    result = out[axis, left:right]
                    for j in range(result.size):
                        result[j] += a[j] * b[j] * c[j]
        if slopes:
            for axis in range(dim):
                result, factor = out[axis, left:right], -scale[axis]
                for j in range(many):
                    result[j] *= factor * given[j]


@kernel("read1 read2 read1 read2 write1 write1 write1")
def extrema(samples, w, scale, axes, low, high, stencils, start, stop):
    """Least and greatest sample of the cell of each departure point, and the first sample of its stencil."""
    scratch, dim = _scratch(), len(axes)
    first = scratch[0]
    for left in range(start * TILE, min(stop * TILE, w.shape[1]), TILE):
        right = min(left + TILE, w.shape[1])
        least, greatest, numbers = low[left:right], high[left:right], stencils[left:right]
        _depart(w, scale, axes, left, right, scratch)
        least[:], greatest[:] = np.inf, -np.inf
        for corner in range(1 << dim):
            number = 0
            for axis in range(dim):
                number += (1 + (corner >> axis & 1)) * int(axes[axis, 1])
            line = samples[number:]
            for j in range(right - left):
                value = line[first[j]]
                least[j], greatest[j] = min(least[j], value), max(greatest[j], value)
        for j in range(right - left):
            numbers[j] = first[j]
