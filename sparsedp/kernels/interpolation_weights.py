"""Interpolation at departure points, its transpose and its gradient, for a field with ghost cells around it.

The departure point of the point (i, j, k) of a field is (i, j, k) - scale w, in index coordinates. The field has PAD
ghost cells beyond each end of each axis, so that no loop needs to test for walls. Departure points beyond the end of a
periodic axis are shifted by its period. On other axes, a departure point beyond the first ghost cell gets the value of
the ghost cells and a slope of 0.

`sparsedp.kernels.interpolation` has the compiled loops. `entries` computes the entries of the interpolation matrix W.
It is the reference for the loops, replaces them without numba, and gives the matrix of a step. Arrays must be flat,
contiguous and of dtype float64; this is not checked. Displacements may be NaN.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp import kernels

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

__all__ = ["NO_BOUNDS", "PAD", "TILE", "Points", "bound_shares", "entries", "interpolate", "scatter"]

PAD = 3  # number of ghost cells, as cubic interpolation needs beyond the clamped departure points
TILE = 256  # points processed at a time. Up to 24 rows of 2 KB are in use, which fit into the L1 cache with the samples

EMPTY = np.empty(0)
NO_BOUNDS = np.empty((2, 0))

# The weights of the four samples, of which the second and the third are the ends of the cell: coefficients of 1, t, t^2
# and t^3, where t in [0, 1] is the position in the cell. At a point (t = 0) the value is the second sample, and the
# slope is the mean of both one-sided slopes.
WEIGHTS = {
    "linear": ((0, 0, 0, 0), (1, -1, 0, 0), (0, 1, 0, 0), (0, 0, 0, 0)),
    "cubic": ((0, -0.5, 1, -0.5), (1, 0, -2.5, 1.5), (0, 0.5, 2, -1.5), (0, 0, -0.5, 0.5)),
}
WEIGHTS_AT_POINTS = ((0, 1, 0, 0), (-0.5, 0, 0.5, 0))  # weights of the value and of the slope


@dataclass(frozen=True, eq=False)
class Points:
    """The points of a field, and the interpolation between them.

    Attributes
    ----------
    shape : tuple of int
    padded : tuple of int
        The shape with ghost cells.
    size : int
        Number of points.
    samples : int
        Number of points and ghost cells.
    axes : int array, shape (3, 5)
        For each axis: number of points, stride, whether it is periodic, and the range (begin, end) of those of the four
        samples that have a weight.
    weights : array, shape (2, 4, 5)
        Row 0 for the value and row 1 for the slope: for each sample the four coefficients and the weight at t = 0.
    """

    shape: tuple[int, ...]
    padded: tuple[int, ...]
    size: int
    samples: int
    axes: NDArray[np.int64]
    weights: NDArray[np.float64]

    @classmethod
    def of(cls, shape: Sequence[int], periodic: Sequence[bool], interpolation: str) -> Points:
        """Return the points of a field.

        Parameters
        ----------
        shape : sequence of int
        periodic : sequence of bool
            Whether each axis is periodic.
        interpolation : "linear" or "cubic"
        """
        padded = tuple(n + 2 * PAD for n in shape)
        used_samples = (1, 3) if interpolation == "linear" else (0, 4)
        axes = [(1, 0, 0, 1, 2)] * (3 - len(shape))  # axes that the field does not have
        for axis, n in enumerate(shape):
            axes.append((n, prod(padded[axis + 1 :]), periodic[axis], *used_samples))
        value = np.array(WEIGHTS[interpolation], float)
        slope = np.append(value[:, 1:] * (1, 2, 3), np.zeros((4, 1)), 1)
        weights = np.concatenate([[value, slope], np.reshape(WEIGHTS_AT_POINTS, (2, 4, 1))], 2)
        return cls(tuple(shape), padded, prod(shape), prod(padded), np.array(axes), weights)

    @cached_property
    def weights_of_value(self) -> NDArray[np.float64]:
        """The row of `weights` for the value."""
        return self.weights[:1]

    @cached_property
    def interpolate_all(self) -> Callable[..., bool]:
        """The compiled loop `interpolation.interpolate` over all points."""
        return kernels.bound("interpolation", "interpolate", -(-self.size // TILE), self.size << len(self.shape))

    @cached_property
    def scatter_all(self) -> Callable[..., bool]:
        """The compiled loop `interpolation.scatter` over all points, on one thread."""
        return kernels.bound("interpolation", "scatter", -(-self.size // TILE), self.size << len(self.shape), 1)

    @property
    def strides(self) -> NDArray[np.int64]:
        """Strides of the axes of the field in the flat array of samples."""
        return self.axes[-len(self.shape) :, 1]


def _cells(points: Points, w: NDArray, scale: NDArray, subset: Any = slice(None)) -> tuple[NDArray, NDArray]:
    """For each departure point, return the first sample of its stencil and its positions t (axis, point)."""
    n, stride, periodic = points.axes[-len(w) :, :3].T[:, :, None]
    place = np.unravel_index(np.arange(points.size)[subset], points.shape) - scale[:, None] * w[:, subset]
    with np.errstate(invalid="ignore"):
        place = np.where(periodic, place - n * np.floor(place / n), place)
        place = np.minimum(np.where(place >= 1 - PAD, place, 1 - PAD), n + PAD - 2)  # NaN becomes the lower end
    cell = np.minimum(np.floor(place), n).astype(int)
    return np.sum(stride * (cell + PAD - 1), axis=0), place - cell


def entries(points: Points, w: NDArray, scale: NDArray, along: int | None = None) -> Iterator[tuple[NDArray, NDArray]]:
    """Yield the entries of W, one sample of the stencil at a time: for each point the sample index and the weight.

    If `along` is an axis, yield the entries of the matrix of the slope along this axis instead.
    """
    first, fractions = _cells(points, w, scale)
    rows = []
    for axis, t in enumerate(fractions):
        a, b, c, d, at_point = points.weights[int(axis == along)].T[:, :, None]
        rows.append(np.where(t != 0, ((d * t + c) * t + b) * t + a, at_point))
    used_samples = [[m for m in range(4) if row[m].any()] for row in rows]
    for steps in product(*used_samples):
        yield first + points.strides @ steps, prod(row[m] for m, row in zip(steps, rows, strict=True))


def interpolate(
    points: Points,
    samples: NDArray,
    w: NDArray,
    scale: NDArray,
    out: NDArray,
    g: NDArray | None = None,
    bounds: NDArray = NO_BOUNDS,
) -> NDArray:
    """Set `out` to the interpolated values W samples at the departure points, and return it.

    Parameters
    ----------
    points : Points
    samples : array
        The field with its ghost cells.
    w : array, shape (axes, points)
        Displacements.
    scale : array, shape (axes,)
    out : array, shape (points,), or (axes, points) if `g` is given
    g : array, optional
        If it is given, `out` is set to the derivative of g . (W samples) in w instead.
    bounds : array, shape (2, points), optional
        Set to the least and the greatest sample of the cell of each departure point.
    """
    if g is None:
        rows = out[None]
        done = points.interpolate_all(samples, w, scale, points.axes, points.weights_of_value, EMPTY, rows, bounds)
    else:
        rows = out
        done = points.interpolate_all(samples, w, scale, points.axes, points.weights, g, rows, bounds)
    if done:
        return out
    for axis, row in enumerate(rows):
        along = None if g is None else axis
        row[:] = sum(weight * samples[index] for index, weight in entries(points, w, scale, along))
        row *= 1.0 if g is None else -scale[axis] * g
    if bounds.size:
        cells = samples[_corners(points, w, scale)]
        bounds[:] = np.min(cells, axis=0), np.max(cells, axis=0)
    return out


def scatter(points: Points, w: NDArray, scale: NDArray, g: NDArray, samples: NDArray) -> NDArray:
    """Add W^T g, the transpose of `interpolate`, to `samples`, and return `samples`.

    It runs on one thread, because several points add to the same sample.
    """
    if not points.scatter_all(w, scale, points.axes, points.weights_of_value, g, samples):
        for index, weight in entries(points, w, scale):
            np.add.at(samples, index, weight * g)
    return samples


def _corners(points: Points, w: NDArray, scale: NDArray, subset: Any = slice(None)) -> NDArray:
    """Return the indices of the samples at the corners of the cells of departure points, one row for each corner."""
    steps = np.array(list(product((1, 2), repeat=len(w)))) @ points.strides
    return steps[:, None] + _cells(points, w, scale, subset)[0]


def bound_shares(
    points: Points, samples: NDArray, w: NDArray, scale: NDArray, subset: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the derivatives of the least and the greatest sample of the cells of some departure points.

    Returns
    -------
    corners : int array, shape (corners, points)
        Indices of the samples of the cells.
    least, greatest : array, shape (corners, points)
        Derivatives of the least and of the greatest sample with respect to each of these samples. If several samples
        are the least (or the greatest), they get equal parts.
    """
    corners = _corners(points, w, scale, subset)
    cells = samples[corners]
    is_least = cells == np.min(cells, axis=0)
    is_greatest = cells == np.max(cells, axis=0)
    return corners, is_least / is_least.sum(axis=0), is_greatest / is_greatest.sum(axis=0)
