"""Ghost cells around a component of a field, and solid cells that are filled with values of the fluid around them.

Ghost cells beyond a wall have the value of the nearest point (neumann) or the inflow value (dirichlet); the first of
them is one spacing beyond the last point. On a periodic axis they have the values of the other end. A ghost cell beyond
the ends of two axes is set by the condition of the later axis. On a wall with several conditions, the condition of the
nearest face applies.
"""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.settings import wall_space
from sparsedp.grid.boundary_conditions import MixedWall, dirichlet
from sparsedp.kernels.interpolation_weights import PAD
from sparsedp.operators.stencils import adjacent_cell

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.advection.settings import TransportSettings
    from sparsedp.grid.grid import Grid
    from sparsedp.kernels.interpolation_weights import Points

__all__ = ["ghost_sources", "solid_filling"]


def ghost_sources(
    settings: TransportSettings, number: int, points: Points, closed: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the ghost cells of a component and, for each of them, of the sample with the same value.

    Parameters
    ----------
    settings : TransportSettings
    number : int
        Index of the component.
    points : Points
    closed : bool
        If True, no inflow values are used: ghost cells beyond walls have the value of the nearest point.

    Returns
    -------
    ghosts, sources : int arrays
        Indices of samples. The samples are the field with its ghost cells, followed by the inflow values.
    """
    sides = settings.sides_of(number)
    samples = np.arange(points.samples).reshape(points.padded)
    nearest = []  # for each axis the point nearest to each sample
    for n, pair in zip(points.shape, sides, strict=True):
        position = np.arange(-PAD, n + PAD)
        nearest.append(position.clip(0, n - 1) if pair else position % n)
    sources = samples[np.ix_(*(PAD + position for position in nearest))]
    walls = wall_space(settings)
    wall = number * sum(2 for pair in sides if pair)
    for axis, pair in enumerate(sides):
        for beyond, condition in zip((slice(PAD), slice(-PAD, None)), pair or ()):
            if (condition == dirichlet or isinstance(condition, MixedWall)) and not closed:
                values = samples.size + np.arange(*walls.offsets[wall : wall + 2]).reshape(walls.parts[wall])
                along_wall = np.ix_(*nearest[:axis], np.zeros(1, int), *nearest[axis + 1 :])
                chosen: Any = True
                if isinstance(condition, MixedWall):
                    with_inflow = condition.faces_with(lambda on_face: on_face == dirichlet)
                    chosen = with_inflow.reshape(walls.parts[wall])[along_wall]
                target = sources[(slice(None),) * axis + (beyond,)]
                np.copyto(target, values[along_wall], where=chosen)
            wall += 1
    ghosts = np.flatnonzero(sources != samples)
    return ghosts, sources.ravel()[ghosts]


def solid_filling(grid: Grid, solid: NDArray[np.bool_]) -> sp.csr_array:
    """Return the matrix on cell fields that keeps the values of fluid cells and fills the solid cells.

    The solid is filled in layers, from the fluid inwards: a cell gets the mean of its neighbours that are fluid or
    filled before. Like a neumann wall, this extends the values of the fluid beyond its boundary.
    """
    adjacency = reduce(
        lambda first, second: sp.kronsum(second, first, "csr"), [_neighbours(grid, axis) for axis in range(grid.dim)]
    )
    filled = ~solid.ravel()
    total = sp.eye_array(solid.size, format="csr")
    while True:
        layer = sp.diags_array(1.0 * ~filled) @ adjacency @ sp.diags_array(1.0 * filled)
        count = layer.sum(axis=1)
        if not count.any():  # all cells are filled, or there is no fluid
            return total
        mean = sp.diags_array(1 / np.maximum(count, 1)) @ layer
        unchanged = sp.diags_array(1.0 * (count == 0))
        total = sp.csr_array((mean + unchanged) @ total)
        filled |= count > 0


def _neighbours(grid: Grid, axis: int) -> sp.csr_array:
    """Return the adjacency matrix of the cells along an axis; a cell at a wall is also adjacent to itself."""
    below = adjacent_cell(grid, axis, False).matrix
    above = adjacent_cell(grid, axis, True).matrix
    return below.T @ above + above.T @ below
