"""Interpolation at departure points, its transpose and its gradient, for a field with ghost cells around it.

The point (i, j, k) of a field looks back to its departure point (i, j, k) - scale w, in index coordinates. The field
has PAD ghost cells beyond each end of each axis, so that no loop asks what lies beyond a wall. Periodic axes wrap;
on others a departure point further out than the first ghost cell gets the value of the ghost cells, and no slope.

The loops are in `interpolation`. Beside them stands one NumPy form, the entries of the matrix W of the interpolation:
it is their test, what runs without numba, and the matrix of a step. Arrays are flat, contiguous float64, not checked;
NaN among the displacements does no harm.
"""

from itertools import product
from math import prod
from typing import Any, NamedTuple

import numpy as np

from sparsedp import kernels

__all__ = ["PAD", "Points", "depart", "entries", "equal_shares", "extrema", "gather", "gradient", "scatter"]

PAD = 3  # what cubic interpolation reads beyond the clamped departure points

# The weights of the four samples from the one before the cell on: coefficients of 1, t, t^2, t^3 in the fraction t of
# the cell, and the weight at a point (t = 0): for the value and for the slope. A linear slope jumps at the points.
_ZERO = (0.0,) * 5
WEIGHTS = {
    "linear": (
        (_ZERO, (1, -1, 0, 0, 1), (0, 1, 0, 0, 0), _ZERO),
        ((0, 0, 0, 0, -0.5), (-1, 0, 0, 0, 0), (1, 0, 0, 0, 0.5), _ZERO),
    ),
    "cubic": (
        ((0, -0.5, 1, -0.5, 0), (1, 0, -2.5, 1.5, 1), (0, 0.5, 2, -1.5, 0), (0, 0, -0.5, 0.5, 0)),
        ((-0.5, 2, -1.5, 0, -0.5), (0, -5, 4.5, 0, 0), (0.5, 4, -4.5, 0, 0.5), (0, -1, 1.5, 0, 0)),
    ),
}


class Points(NamedTuple):
    """The points of a field, and how it is interpolated between them."""

    shape: tuple
    padded: tuple  # the shape with ghost cells
    axes: Any  # for each axis: points, stride, first point, least and greatest place, last cell, whether periodic
    weights: Any  # the table of each axis: for the slope along axis 0, 1, ..., and for the value

    @classmethod
    def of(cls, shape, periodic, interpolation):
        """Shape, whether each axis is periodic, linear or cubic -> Points."""
        padded = tuple(n + 2 * PAD for n in shape)
        beyond = 1.5 if interpolation == "linear" else 2.0
        axes = [
            (n, prod(padded[axis + 1 :]), PAD, *((PAD, PAD + n) if wraps else (PAD - beyond, PAD + n - 1 + beyond)))
            for axis, (n, wraps) in enumerate(zip(shape, periodic, strict=True))
        ]
        ends = [(PAD + n, wraps) for n, wraps in zip(shape, periodic, strict=True)]
        value, slope = WEIGHTS[interpolation]
        dim = range(len(shape))
        tables = [np.array([slope if axis == along else value for axis in dim], float) for along in (*dim, -1)]
        return cls(tuple(shape), padded, np.hstack([np.array(axes, float), np.array(ends, float)]), tables)

    @property
    def size(self):
        """Number of points."""
        return prod(self.shape)

    @property
    def samples(self):
        """Number of points and ghost cells."""
        return prod(self.padded)


def _run(loop, points, *args, one_thread=False):
    from sparsedp.kernels.interpolation import TILE

    work = points.size << len(points.shape)
    loop.run(-(-points.size // TILE), work, 1 if one_thread else kernels.threads(), *args)


def depart(points, w, scale, out):
    """Displacements (axis, point), their scale along each axis -> departure points, written to out (axis + 1, point).

    The last row has the number of the first sample that has a weight, the others the fraction of a cell beyond it.
    """
    loop = kernels._loop("interpolation", "depart")
    if loop is not None:
        _run(loop, points, w, scale, points.axes, out)
        return out
    n, stride, origin, low, high, last, periodic = points.axes.T[:, :, None]
    place = np.indices(points.shape, float).reshape(w.shape) - scale[:, None] * w
    with np.errstate(invalid="ignore"):
        place = np.where(periodic != 0, place - n * np.floor(place / n), place) + origin
        place = np.minimum(np.where(place >= low, place, low), high)  # NaN goes to the lower end
    cell = np.minimum(np.floor(place), last)
    np.subtract(place, cell, out=out[:-1])
    np.sum(stride * (cell - 1), axis=0, out=out[-1])
    return out


def entries(points, departures, along=-1):
    """Numbers of samples and their weights in the value (along an axis: in the slope), one pair for each column of W."""
    first, rows = departures[-1].astype(np.int64), []
    for table, t in zip(points.weights[along], departures, strict=False):
        a, b, c, d, at_point = table.T[:, :, None]
        rows.append(np.where(t != 0, ((d * t + c) * t + b) * t + a, at_point))
    used = [[m for m, weight in enumerate(row) if weight.any()] for row in rows]
    for steps in product(*used):
        index = first + sum(m * int(stride) for m, stride in zip(steps, points.axes[:, 1], strict=True))
        yield index, prod(row[m] for m, row in zip(steps, rows, strict=True))


def _interpolate(points, samples, departures, along, factor, g, out, transpose):
    loop = kernels._loop("interpolation", "interpolate")
    if loop is not None:
        args = samples, departures, points.axes, points.weights[along], factor, g, out, transpose
        _run(loop, points, *args, one_thread=transpose)
        return
    given, pairs = factor * g if g.size else factor, entries(points, departures, along)
    if transpose:
        for index, weight in pairs:
            samples += np.bincount(index, weight * given, samples.size)
    else:
        out[:] = given * sum((weight * samples[index] for index, weight in pairs), np.zeros(out.size))


def gather(points, samples, departures, out):
    """Interpolated values at the departure points -> out."""
    _interpolate(points, samples, departures, -1, 1.0, NONE, out, False)
    return out


def scatter(points, departures, g, samples):
    """The transpose of `gather`, added to the samples."""
    _interpolate(points, samples, departures, -1, 1.0, g, NONE, True)
    return samples


def gradient(points, samples, departures, scale, g, out):
    """g times the derivative of `gather` in the displacements -> out (axis, point)."""
    for axis, row in enumerate(out):
        _interpolate(points, samples, departures, axis, -scale[axis], g, row, False)
    return out


def _corners(points, first):
    """Samples of the cells whose stencils begin at `first`, one row for each corner."""
    steps = np.array(list(product((1, 2), repeat=len(points.shape)))) @ points.axes[:, 1]
    return (steps[:, None] + first).astype(np.int64)


def extrema(points, samples, departures, low, high):
    """Least and greatest sample of the cell around each departure point -> low, high."""
    loop = kernels._loop("interpolation", "extrema")
    if loop is not None:
        _run(loop, points, samples, departures, points.axes, low, high)
    else:
        cells = samples[_corners(points, departures[-1])]
        np.min(cells, axis=0, out=low)
        np.max(cells, axis=0, out=high)


def equal_shares(points, samples, stencils, pick):
    """First samples of some stencils -> samples of their cells (corner, point), and the weight of each in the mean of
    those that are the least (pick: np.min) or the greatest (np.max) of the cell."""
    corners = _corners(points, stencils)
    cells = samples[corners]
    equal = cells == pick(cells, axis=0)
    return corners, equal / equal.sum(axis=0)


NONE = np.empty(0)
