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

__all__ = ["NO_BOUNDS", "PAD", "TILE", "Points", "bound_shares", "entries", "interpolate", "scatter"]

PAD = 3  # what cubic interpolation reads beyond the clamped departure points
TILE = 256  # points; up to 24 rows of 2 KB are in use at a time, which fits the L1 cache with what is read

NONE, NO_BOUNDS = np.empty(0), np.empty((2, 0))

# The weights of the four samples from the one before the cell on: coefficients of 1, t, t^2, t^3 in the fraction t of
# the cell. At a point (t = 0) the second sample counts alone; the slope there is the mean of both sides.
WEIGHTS = {
    "linear": ((0, 0, 0, 0), (1, -1, 0, 0), (0, 1, 0, 0), (0, 0, 0, 0)),
    "cubic": ((0, -0.5, 1, -0.5), (1, 0, -2.5, 1.5), (0, 0.5, 2, -1.5), (0, 0, -0.5, 0.5)),
}
AT_POINTS = ((0, 1, 0, 0), (-0.5, 0, 0.5, 0))


class Points(NamedTuple):
    """The points of a field, and how it is interpolated between them."""

    shape: tuple
    padded: tuple  # the shape with ghost cells
    size: int  # number of points
    samples: int  # number of points and ghost cells
    axes: Any  # for each of three axes: points, stride, periodic, which of the four samples count, from and to
    weights: Any  # of the value and of the slope: for each sample the four coefficients, and the weight at a point

    @classmethod
    def of(cls, shape, periodic, interpolation):
        """Shape, whether each axis is periodic, linear or cubic -> Points."""
        padded, used = tuple(n + 2 * PAD for n in shape), (1, 3) if interpolation == "linear" else (0, 4)
        strides = [prod(padded[axis + 1 :]) for axis in range(len(shape))]
        axes = [(n, stride, wraps, *used) for n, stride, wraps in zip(shape, strides, periodic, strict=True)]
        axes = [(1, 0, 0, 1, 2)] * (3 - len(shape)) + axes
        value = np.array(WEIGHTS[interpolation], float)
        slope = np.append(value[:, 1:] * (1, 2, 3), np.zeros((4, 1)), 1)
        weights = np.concatenate([[value, slope], np.reshape(AT_POINTS, (2, 4, 1))], 2)
        return cls(tuple(shape), padded, prod(shape), prod(padded), np.array(axes), weights)

    @property
    def strides(self):
        """Of the axes that there are."""
        return self.axes[-len(self.shape) :, 1]


def _run(name, points, threads, *args):
    """Run a compiled loop over all points -> whether there is one."""
    return kernels.run("interpolation", name, -(-points.size // TILE), points.size << len(points.shape), threads, *args)


def _cells(points, w, scale, some=slice(None)):
    """Departure points (of some points) -> first samples of their stencils, fractions of a cell (axis, point)."""
    n, stride, periodic = points.axes[-len(w) :, :3].T[:, :, None]
    place = np.unravel_index(np.arange(points.size)[some], points.shape) - scale[:, None] * w[:, some]
    with np.errstate(invalid="ignore"):
        place = np.where(periodic, place - n * np.floor(place / n), place)
        place = np.minimum(np.where(place >= 1 - PAD, place, 1 - PAD), n + PAD - 2)  # NaN goes to the lower end
    cell = np.minimum(np.floor(place), n).astype(int)
    return np.sum(stride * (cell + PAD - 1), axis=0), place - cell


def entries(points, w, scale, along=None):
    """Columns of W, the value (along an axis: the slope), as pairs: for each point a sample and its weight."""
    (first, fractions), rows = _cells(points, w, scale), []
    for axis, t in enumerate(fractions):
        a, b, c, d, at_point = points.weights[int(axis == along)].T[:, :, None]
        rows.append(np.where(t != 0, ((d * t + c) * t + b) * t + a, at_point))
    for steps in product(*([m for m in range(4) if row[m].any()] for row in rows)):
        yield first + points.strides @ steps, prod(row[m] for m, row in zip(steps, rows, strict=True))


def interpolate(points, samples, w, scale, out, g=None, bounds=NO_BOUNDS):
    """Interpolated values at the departure points, W samples -> out; least and greatest sample of their cells.

    With g, its product with the derivative of them in w -> out (axis, point).
    """
    rows, tables = (out[None], points.weights[:1]) if g is None else (out, points.weights)
    args = samples, w, scale, points.axes, tables, NONE if g is None else g, rows, bounds
    if _run("interpolate", points, kernels.threads(), *args):
        return out
    for axis, row in enumerate(rows):
        row[:] = sum(
            weight * samples[index] for index, weight in entries(points, w, scale, None if g is None else axis)
        )
        row *= 1.0 if g is None else -scale[axis] * g
    if bounds.size:
        cells = samples[_corners(points, w, scale)]
        bounds[:] = np.min(cells, axis=0), np.max(cells, axis=0)
    return out


def scatter(points, w, scale, g, samples):
    """The transpose of the values of `interpolate`: samples += W^T g. Points share samples, so one thread does it."""
    if not _run("scatter", points, 1, w, scale, points.axes, points.weights[:1], g, samples):
        for index, weight in entries(points, w, scale):
            np.add.at(samples, index, weight * g)
    return samples


def _corners(points, w, scale, some=slice(None)):
    """Samples of the cells of departure points, one row for each corner."""
    steps = np.array(list(product((1, 2), repeat=len(w)))) @ points.strides
    return steps[:, None] + _cells(points, w, scale, some)[0]


def bound_shares(points, samples, w, scale, some):
    """Samples of the cells of some departure points (corner, point), and the weight of each in the mean of those that
    are the least of the cell, and in that of the greatest."""
    corners = _corners(points, w, scale, some)
    cells = samples[corners]
    least, greatest = cells == np.min(cells, axis=0), cells == np.max(cells, axis=0)
    return corners, least / least.sum(axis=0), greatest / greatest.sum(axis=0)
