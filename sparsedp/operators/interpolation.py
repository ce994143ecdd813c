"""Linear interpolation between cell centres along one axis. Used by sample and prolong."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparsedp._utils.validation import EPS, number_beside

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid

__all__ = ["linear_weights"]


def linear_weights(grid: Grid, axis: int, x: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return, for each coordinate along an axis, the cells below and above it and the weight of the upper cell.

    Between a wall and the nearest cell centre, values are extrapolated from the two nearest centres, so that linear
    fields are reproduced up to the wall. On an axis of one cell the field is constant.

    Parameters
    ----------
    grid : Grid
    axis : int
    x : array, shape (m,) [length]
        Finite.

    Returns
    -------
    lower, upper : int arrays, shape (m,)
        Indices of the cells.
    weight : array, shape (m,)
        Weight of the upper cell; the lower cell has 1 - weight.

    Raises
    ------
    ValueError
        If a coordinate lies outside a bounded axis.
    """
    n = grid.shape[axis]
    start = grid.origin[axis]
    extent = grid.size[axis]
    periodic = grid.periodic[axis]
    rounding = 8 * EPS * (abs(start) + extent)
    outside = (x < start - rounding) | (x > start + extent + rounding)
    if not periodic and np.any(outside):
        name = grid.axes[axis]
        got = number_beside(x[outside][0], start, start + extent)
        raise ValueError(f"points need {name} from {start:g} to {start + extent:g}, got {name} = {got}")
    if n < 2:
        index = np.zeros(x.shape, dtype=np.int64)
        return index, index, np.zeros(x.shape)
    centres = grid.coordinates(axis)
    if periodic:  # add a copy of the last cell before the first, and of the first after the last
        x = start + np.mod(x - start, extent)
        centres = np.concatenate([centres[-1:] - extent, centres, centres[:1] + extent])
    lower = np.clip(np.searchsorted(centres, x, side="right") - 1, 0, centres.size - 2)
    weight = (x - centres[lower]) / (centres[lower + 1] - centres[lower])
    return (lower - periodic) % n, (lower + 1 - periodic) % n, weight
