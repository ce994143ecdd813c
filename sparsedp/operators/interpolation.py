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
    """Return the cells between which coordinates along an axis are, and the weight of the upper one.

    Between a wall and the first centre the line through the two nearest centres is continued, so linear
    fields are reproduced up to the wall. An axis of one cell is constant.

    Parameters
    ----------
    grid : Grid
    axis : int
    x : array, shape (m,) [length]
        Finite.

    Returns
    -------
    lower, upper : int arrays, shape (m,)
    weight : array, shape (m,)
        Of the upper cell.

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
    if periodic:  # the last cell is beside the first one, and the first beside the last
        x = start + np.mod(x - start, extent)
        centres = np.concatenate([centres[-1:] - extent, centres, centres[:1] + extent])
    lower = np.clip(np.searchsorted(centres, x, side="right") - 1, 0, centres.size - 2)
    weight = (x - centres[lower]) / (centres[lower + 1] - centres[lower])
    return (lower - periodic) % n, (lower + 1 - periodic) % n, weight
