"""Compiled loops of semi-Lagrangian transport: interpolation at departure points, its slope and its transpose.

The departure point of the point (i, j, k) is (i, j, k) - scale w, in index coordinates. The flat array `samples` is a
field with ghost cells; `axes` and `tables` are those of `interpolation_weights.Points`.

The loops process tiles of TILE points; `start` and `stop` are a range of tiles. The data of a tile stay in the L1
cache. Every inner loop runs over the points of a tile, for one axis or one sample of the stencil, so that the same code
is used in 1-D to 3-D and for linear and cubic interpolation. Indices are unsigned, because numba tests whether signed
indices are negative.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from sparsedp.kernels.interpolation_weights import PAD, TILE
from sparsedp.kernels.team import INNER, kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["interpolate", "scatter"]


@njit(**INNER)
def _stencils(w, scale, axes, tables, left, right, first, begin, weights, rows):
    """Set `first`, the first sample of the stencil of each point in left:right, and `weights` of the samples by axis.

    There are always three axes: the weights of axes that the field does not have are 1. `begin` is set to the position
    among the four samples of the first one with a weight. It is 0 if slopes at points are needed, because the mean of
    the one-sided slopes uses the sample before the cell.
    """
    count = right - left
    dim = len(w)
    number = rows[0, :count]
    rest = rows[1, :count]
    fraction = rows[2, :count]
    for j in range(number.size):
        rest[j] = left + j
        number[j] = 0.0
    for line in range(3 - dim):
        begin[line] = 1
        weight = weights[0, line, 1]
        for j in range(number.size):
            weight[j] = 1.0
    for axis in range(dim - 1, -1, -1):
        line = axis + 3 - dim
        n, stride, periodic, start, _ = axes[line]
        displacement = w[axis, left:right]
        s = scale[axis]
        inverse = 1.0 / n
        at_points = 0
        low = 1.0 - PAD
        high = n + PAD - 2.0
        for j in range(number.size):  # index along this axis: a remainder; adding 0.5 makes it exact
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
        if at_points and len(tables) > 1:
            begin[line] = 0
        else:
            begin[line] = start
        for kind in range(len(tables)):
            for m in range(begin[line], 4 - begin[line]):
                weight, (a, b, c, d, at_point) = weights[kind, line, m, :count], tables[kind, m]
                for j in range(number.size):
                    t = fraction[j]
                    weight[j] = ((d * t + c) * t + b) * t + a if t != 0.0 else at_point
    for j in range(number.size):
        first[j] = np.int64(number[j])


@kernel("read1 read2 read1 index2 read3 read1 write2 write2")
def interpolate(
    samples: NDArray,
    w: NDArray,
    scale: NDArray,
    axes: NDArray,
    tables: NDArray,
    g: NDArray,
    out: NDArray,
    bounds: NDArray,
    start: int,
    stop: int,
) -> None:
    """Set out = W samples and, unless it is empty, `bounds` to the least and greatest sample of the cell of each point.

    `tables` holds the weights of the value. If it also holds the weights of the slope, out[axis] is set instead to
    -scale g times the slope of the interpolant along the axis, which is the derivative of g . (W samples) in w.
    """
    first = np.empty(TILE, np.int64)
    begin = np.empty(3, np.int64)
    # of value and slope by axis and sample
    weights = np.empty((2, 3, 4, TILE))
    rows = np.empty((1, 1, 3, TILE))[0, 0]
    dim = len(w)
    slopes = len(tables) > 1
    value, slope, _ = rows
    for left in range(start * TILE, min(stop * TILE, w.shape[1]), TILE):
        right = min(left + TILE, w.shape[1])
        _stencils(w, scale, axes, tables, left, right, first, begin, weights, rows)
        count = right - left
        least = bounds[0, left:right]
        greatest = bounds[1, left:right]
        for axis in range(len(out)):
            for j in range(left, right):
                out[axis, j] = 0.0
        for j in range(least.size):
            least[j] = np.inf
            greatest[j] = -np.inf
        for i in range(begin[0], axes[0, 4]):
            for k in range(begin[1], axes[1, 4]):
                for j in range(count):
                    value[j] = slope[j] = 0.0
                near = samples[i * axes[0, 1] + k * axes[1, 1] :]
                for m in range(begin[2], 4 - begin[2], 2):  # two samples at a time, to halve the passes over the sums
                    line = near[m:]
                    a = weights[0, 2, m]
                    b = weights[0, 2, m + 1]
                    c = weights[1, 2, m]
                    d = weights[1, 2, m + 1]
                    for j in range(count):
                        index = np.uint64(first[j])
                        one = line[index]
                        two = line[index + np.uint64(1)]
                        value[j] += a[j] * one + b[j] * two
                        if slopes:
                            slope[j] += c[j] * one + d[j] * two
                corner_end = 1
                if 0 < i < 3 and 0 < k < 3:  # samples at the corners of the cell
                    corner_end = 3
                for m in range(1, corner_end):
                    line = near[m:]
                    for j in range(least.size):
                        sample = line[np.uint64(first[j])]
                        least[j] = sample if sample < least[j] else least[j]
                        greatest[j] = sample if sample > greatest[j] else greatest[j]
                for axis in range(len(out)):  # slope weights along this axis, value weights along others
                    if slopes:
                        steep = axis + 3 - dim
                    else:
                        steep = -1
                    a = weights[int(steep == 0), 0, i]
                    b = weights[int(steep == 1), 1, k]
                    c = rows[int(steep == 2)]
                    result = out[axis, left:right]
                    for j in range(result.size):
                        result[j] += a[j] * b[j] * c[j]
        if slopes:
            for axis in range(dim):
                result = out[axis, left:right]
                cotangents = g[left:right]
                factor = -scale[axis]
                for j in range(result.size):
                    result[j] *= factor * cotangents[j]


@kernel("read2 read1 index2 read3 read1 write1")
def scatter(
    w: NDArray, scale: NDArray, axes: NDArray, tables: NDArray, g: NDArray, samples: NDArray, start: int, stop: int
) -> None:
    """Add W^T g to `samples`; for one thread only, because several points add to the same sample."""
    first = np.empty(TILE, np.int64)
    begin = np.empty(3, np.int64)
    # of value and slope by axis and sample
    weights = np.empty((2, 3, 4, TILE))
    rows = np.empty((1, 1, 3, TILE))[0, 0]
    for left in range(start * TILE, min(stop * TILE, w.shape[1]), TILE):
        right = min(left + TILE, w.shape[1])
        _stencils(w, scale, axes, tables, left, right, first, begin, weights, rows)
        cotangents = g[left:right]
        share = rows[0]
        for i in range(begin[0], axes[0, 4]):
            for k in range(begin[1], axes[1, 4]):
                a = weights[0, 0, i]
                b = weights[0, 1, k]
                for j in range(cotangents.size):
                    share[j] = a[j] * b[j] * cotangents[j]
                for m in range(begin[2], axes[2, 4]):
                    line = samples[i * axes[0, 1] + k * axes[1, 1] + m :]
                    weight = weights[0, 2, m]
                    for j in range(cotangents.size):
                        line[np.uint64(first[j])] += weight[j] * share[j]
