"""Interpolation at departure points, its transpose and its gradient, for a field with ghost cells around it.

The departure point of the point (i, j, k) of a field is (i, j, k) - scale w, in index coordinates. The field has PAD
ghost cells beyond each end of each axis, so that no loop tests for walls. Periodic axes wrap; on others a departure
point beyond the first ghost cell gets the value of the ghost cells, and a slope of 0.

`sparsedp.kernels.interpolation` has the compiled loops. `entries`, the entries of the matrix W of the interpolation, is
their reference, runs without numba, and gives the matrix of a step. Arrays are flat, contiguous float64, and not
checked. Displacements may be NaN.
"""

from __future__ import annotations

from itertools import product
from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp import kernels

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

__all__ = ["NO_BOUNDS", "PAD", "TILE", "Points", "bound_shares", "entries", "interpolate", "scatter"]

PAD = 3  # ghost cells: what cubic interpolation reads beyond the clamped departure points
TILE = 256  # points; up to 24 rows of 2 KB are in use at a time, which fit the L1 cache together with the samples

EMPTY = np.empty(0)
NO_BOUNDS = np.empty((2, 0))

# The weights of the four samples, from the one before the cell on: coefficients of 1, t, t^2, t^3 in the fraction t of
# the cell. At a point (t = 0) only the second sample counts; the slope there is the mean of both sides.
WEIGHTS = {
    "linear": ((0, 0, 0, 0), (1, -1, 0, 0), (0, 1, 0, 0), (0, 0, 0, 0)),
    "cubic": ((0, -0.5, 1, -0.5), (1, 0, -2.5, 1.5), (0, 0.5, 2, -1.5), (0, 0, -0.5, 0.5)),
}
WEIGHTS_AT_POINTS = ((0, 1, 0, 0), (-0.5, 0, 0.5, 0))  # of value and slope


class Points(NamedTuple):
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
        For each axis: number of points, stride, whether it is periodic, and the range of the four samples that count.
    weights : array, shape (2, 4, 5)
        Of the value and of the slope: for each sample the four coefficients, and the weight at a point.
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

    @property
    def strides(self) -> NDArray[np.int64]:
        """Strides of the axes of the field among the samples."""
        return self.axes[-len(self.shape) :, 1]


def _run(name: str, points: Points, threads: int, *args: Any) -> bool:
    """Run a compiled loop over all points, and return whether it is available."""
    tiles = -(-points.size // TILE)
    return kernels.run("interpolation", name, tiles, points.size << len(points.shape), threads, *args)


def _cells(points: Points, w: NDArray, scale: NDArray, subset: Any = slice(None)) -> tuple[NDArray, NDArray]:
    """Return the first samples of the stencils of departure points, and the fractions of a cell (axis, point)."""
    n, stride, periodic = points.axes[-len(w) :, :3].T[:, :, None]
    place = np.unravel_index(np.arange(points.size)[subset], points.shape) - scale[:, None] * w[:, subset]
    with np.errstate(invalid="ignore"):
        place = np.where(periodic, place - n * np.floor(place / n), place)
        place = np.minimum(np.where(place >= 1 - PAD, place, 1 - PAD), n + PAD - 2)  # NaN goes to the lower end
    cell = np.minimum(np.floor(place), n).astype(int)
    return np.sum(stride * (cell + PAD - 1), axis=0), place - cell


def entries(points: Points, w: NDArray, scale: NDArray, along: int | None = None) -> Iterator[tuple[NDArray, NDArray]]:
    """Yield the columns of W (`along`: of the slope along an axis): for each point a sample and its weight."""
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
    out : array, shape (points,), with `g` (axes, points)
    g : array, optional
        `out` is then set to the derivative of g . (W samples) in w.
    bounds : array, shape (2, points), optional
        Set to the least and the greatest sample of the cells of the departure points.
    """
    if g is None:
        rows = out[None]
        args = (samples, w, scale, points.axes, points.weights[:1], EMPTY, rows, bounds)
    else:
        rows = out
        args = (samples, w, scale, points.axes, points.weights, g, rows, bounds)
    if _run("interpolate", points, kernels.threads(), *args):
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
    """Add W^T g, the transpose of `interpolate`, to the samples, and return them.

    Points share samples, so it runs on one thread.
    """
    if not _run("scatter", points, 1, w, scale, points.axes, points.weights[:1], g, samples):
        for index, weight in entries(points, w, scale):
            np.add.at(samples, index, weight * g)
    return samples


def _corners(points: Points, w: NDArray, scale: NDArray, subset: Any = slice(None)) -> NDArray:
    """Return the samples of the cells of departure points, one row for each corner."""
    steps = np.array(list(product((1, 2), repeat=len(w)))) @ points.strides
    return steps[:, None] + _cells(points, w, scale, subset)[0]


def bound_shares(
    points: Points, samples: NDArray, w: NDArray, scale: NDArray, subset: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the derivatives of the least and the greatest sample of the cells of some departure points.

    Returns
    -------
    corners : int array, shape (corners, points)
        Numbers of the samples of the cells.
    least, greatest : array, shape (corners, points)
        Derivative of the least and of the greatest sample in each of them; equal samples share it.
    """
    corners = _corners(points, w, scale, subset)
    cells = samples[corners]
    is_least = cells == np.min(cells, axis=0)
    is_greatest = cells == np.max(cells, axis=0)
    return corners, is_least / is_least.sum(axis=0), is_greatest / is_greatest.sum(axis=0)
