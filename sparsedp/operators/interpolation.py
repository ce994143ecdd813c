"""Linear interpolation between cell centres along one axis. Used by sample and prolong."""

import numpy as np

__all__ = ["linear_weights"]


def linear_weights(grid, axis, x):
    """Coordinates along an axis -> (lower cell, upper cell, weight of the upper one).

    Between a wall and the first centre the line through the two nearest centres goes on, so linear
    fields are reproduced up to the wall. An axis of one cell is constant.

    Parameters
    ----------
    grid : Grid
    axis : int
    x : array, shape (m,) [length]
        Finite.

    Raises
    ------
    ValueError
        If a coordinate lies outside a bounded axis.
    """
    n, start, extent = grid.shape[axis], grid.origin[axis], grid.size[axis]
    centres = grid.coordinates(axis)
    if n < 2:
        index = np.zeros(x.shape, dtype=np.int64)
        _check_inside(grid, axis, x)
        return index, index, np.zeros(x.shape)
    if grid.periodic[axis]:
        x = start + np.mod(x - start, extent)
        lower = np.searchsorted(centres, x, side="right") - 1
        upper = (lower + 1) % n
        distance = np.where(upper > lower, centres[upper] - centres[lower], centres[0] + extent - centres[-1])
        return lower % n, upper, np.mod(x - centres[lower], extent) / np.mod(distance, extent)
    _check_inside(grid, axis, x)
    lower = np.clip(np.searchsorted(centres, x, side="right") - 1, 0, n - 2)
    return lower, lower + 1, (x - centres[lower]) / (centres[lower + 1] - centres[lower])


def _check_inside(grid, axis, x):
    start, extent = grid.origin[axis], grid.size[axis]
    slack = 8 * np.finfo(float).eps * (abs(start) + extent)
    outside = (x < start - slack) | (x > start + extent + slack)
    if not grid.periodic[axis] and np.any(outside):
        name = grid.axes[axis]
        raise ValueError(f"points need {name} from {start:g} to {start + extent:g}, got {name} = {x[outside][0]:g}")
