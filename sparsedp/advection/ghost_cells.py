"""Ghost cells around a component of a field, and a solid filled from the fluid around it.

Beyond a wall the field goes on with the value of the nearest point (neumann) or with the inflow value (dirichlet), as
if that stood one spacing away from the last point; a periodic axis wraps. Where two axes meet, the later one decides.
"""

from functools import reduce

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.law import wall_space
from sparsedp.grid.boundary_conditions import dirichlet
from sparsedp.kernels.departure_samples import PAD
from sparsedp.operators.stencils import cell_beside

__all__ = ["filling", "ghost_origins"]


def ghost_origins(setting, number, points, closed):
    """The ghost cells of component `number`, and the sample that each repeats, as numbers of samples.

    After the samples of the field with its ghost cells stand the inflow values. `closed`: none of them is used.
    """
    sides, walls, samples = setting.sides, wall_space(setting), np.arange(points.samples).reshape(points.padded)
    nearest = []
    for n, pair in zip(points.shape, sides, strict=True):
        place = np.arange(-PAD, n + PAD)
        nearest.append(place.clip(0, n - 1) if pair else place % n)
    origins = samples[np.ix_(*(PAD + p for p in nearest))]
    wall = number * sum(2 for pair in sides if pair)
    for axis, pair in enumerate(sides):
        for beyond, condition in zip((slice(PAD), slice(-PAD, None)), pair or ()):
            if condition == dirichlet and not closed:
                values = samples.size + np.arange(*walls.offsets[wall : wall + 2]).reshape(walls.parts[wall])
                along = [*nearest[:axis], [0], *nearest[axis + 1 :]]
                origins[(slice(None),) * axis + (beyond,)] = values[np.ix_(*along)]
            wall += 1
    ghosts = np.flatnonzero(origins != samples)
    return ghosts, origins.ravel()[ghosts]


def filling(grid, solid):
    """Solid cells -> csr_array that leaves fluid cells alone and fills the others from them.

    A solid cell gets the mean of the cells next to it that are fluid or filled already, layer by layer inwards: what
    a neumann wall does too.
    """
    lines = [_beside(grid, axis) for axis in range(grid.dim)]
    beside = reduce(lambda first, second: sp.kronsum(second, first, "csr"), lines)
    known, total = ~solid.ravel(), sp.eye_array(solid.size, format="csr")
    while True:
        layer = sp.diags_array(1.0 * ~known) @ beside @ sp.diags_array(1.0 * known)
        count = layer.sum(axis=1)
        if not count.any():  # all is filled, or there is no fluid to fill it from
            return total
        mean, rest = sp.diags_array(1 / np.maximum(count, 1)) @ layer, sp.diags_array(1.0 * (count == 0))
        total = sp.csr_array((mean + rest) @ total)
        known |= count > 0


def _beside(grid, axis):
    """Cells along an axis -> the sum of the cells beside each of them; a link to itself, at a wall, does no harm."""
    below, above = (cell_beside(grid, axis, upper).matrix for upper in (False, True))
    return below.T @ above + above.T @ below
