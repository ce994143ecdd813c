"""Ghost cells around a component of a field, and a solid filled from the fluid around it.

Beyond a wall the field goes on with the value of the nearest point (neumann) or with the inflow value (dirichlet), as
if that stood one spacing away from the last point; a periodic axis wraps. Where two axes meet, the later one decides.
"""

from functools import reduce
from math import prod

import numpy as np
import scipy.sparse as sp

from sparsedp.conditions import neumann
from sparsedp.kernels.departure import PAD
from sparsedp.operators.stencils import cell_beside

__all__ = ["filling", "sample_sources"]


def sample_sources(shape, sides, wall, closed):
    """Where the field with ghost cells comes from: numbers of points, and after them of inflow values.

    Parameters
    ----------
    shape : tuple
        Of the field.
    sides : sequence
        For each axis the conditions of its two walls; None where it is periodic.
    wall : int
        The first inflow value of this field.
    closed : bool
        Go on with the nearest point at all walls.
    """
    found = np.arange(prod(shape)).reshape(shape)
    wall += found.size
    for axis, pair in enumerate(sides):
        plate, beyond = tuple(1 if a == axis else n for a, n in enumerate(shape)), []
        for side, condition in enumerate(pair or ()):
            layer = np.take(found, [-side], axis)
            if not closed and condition != neumann:
                layer = wall + np.arange(prod(plate)).reshape(plate)
                for earlier in range(axis):
                    layer = _extended(layer, earlier, "wrap" if sides[earlier] is None else "edge")
            wall += prod(plate)
            beyond.append(np.repeat(layer, PAD, axis))
        found = np.concatenate([beyond[0], found, beyond[1]], axis) if pair else _extended(found, axis, "wrap")
    return found.ravel()


def _extended(numbers, axis, mode):
    return np.pad(numbers, [(PAD, PAD) if a == axis else (0, 0) for a in range(numbers.ndim)], mode)


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
