"""Ghost cells around a component of a field, and a solid filled from the fluid around it.

Beyond a wall the field goes on with the value of the nearest point (neumann) or with the inflow value (dirichlet), as
if that stood one spacing away from the last point; a periodic axis wraps. Where two axes meet, the later one decides.
"""

from math import prod

import numpy as np
import scipy.sparse as sp

from sparsedp.conditions import neumann
from sparsedp.kernels.departure import PAD

__all__ = ["GhostCells", "filling"]


class GhostCells:
    """The linear map from (field, inflow values) to the field with ghost cells, and its transpose.

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

    def __init__(self, shape, sides, wall=0, closed=False):
        self.shape, self.sides = shape, sides
        self.padded = tuple(n + 2 * PAD for n in shape)
        self.inside = tuple(slice(PAD, PAD + n) for n in shape)
        self.steps = []  # axis, what is written, where it comes from: other samples, or the numbers of inflow values
        for axis, (n, pair) in enumerate(zip(shape, sides, strict=True)):
            for start in range(0, PAD, n) if pair is None else ():  # an axis of few points wraps more than once
                stop = min(start + n, PAD)
                low, high = slice(PAD - stop, PAD - start), slice(PAD + n + start, PAD + n + stop)
                self._copy(axis, low, slice(low.start + n, low.stop + n))
                self._copy(axis, high, slice(high.start - n, high.stop - n))
            for side, condition in enumerate(pair or ()):
                layers, last = ((slice(PAD), PAD), (slice(PAD + n, None), PAD + n - 1))[side]
                if closed or condition == neumann:
                    self._copy(axis, layers, slice(last, last + 1))
                else:
                    self.steps.append((axis, self._layers(axis, layers), self._plate(axis, wall)))
                wall += prod(shape) // n
        self.inflow_end = wall  # the first inflow value after those of this field

    def _layers(self, axis, layers):
        """Index of layers along an axis; earlier axes have their ghost cells already, later ones not."""
        return (slice(None),) * axis + (layers,) + self.inside[axis + 1 :]

    def _copy(self, axis, target, source):
        self.steps.append((axis, self._layers(axis, target), self._layers(axis, source)))

    def _plate(self, axis, wall):
        """Numbers of the inflow values of a wall, which go on beyond the ends of the earlier axes."""
        plate = tuple(1 if a == axis else n for a, n in enumerate(self.shape))
        numbers = wall + np.arange(prod(plate)).reshape(plate)
        for a in range(axis):
            around = [(PAD, PAD) if b == a else (0, 0) for b in range(len(plate))]
            numbers = np.pad(numbers, around, mode="wrap" if self.sides[a] is None else "edge")
        return numbers

    def pad(self, u, inflow, out):
        """Field, inflow values -> samples, flat, written to out."""
        samples = out.reshape(self.padded)
        samples[self.inside] = u.reshape(self.shape)
        for _, target, source in self.steps:
            samples[target] = samples[source] if type(source) is tuple else inflow[source]
        return out

    def pad_vjp(self, samples, of_u, of_inflow):
        """The transpose of `pad`: written to of_u, added to of_inflow. The samples are used up."""
        samples = samples.reshape(self.padded)
        for axis, target, source in self.steps[::-1]:
            given = samples[target]
            if type(source) is not tuple:
                np.add.at(of_inflow, source, given.sum(axis, keepdims=True))
            else:
                into = samples[source]
                into += given if into.shape == given.shape else given.sum(axis, keepdims=True)
        of_u.reshape(self.shape)[...] = samples[self.inside]


def filling(solid, periodic):
    """Solid cells -> csr_array that leaves fluid cells alone and fills the others from them.

    A solid cell gets the mean of the cells next to it that are fluid or filled already, layer by layer inwards: what
    a neumann wall does too.
    """
    known, total = ~solid.ravel(), sp.eye_array(solid.size, format="csr")
    here, there = _neighbours(solid.shape, periodic)
    while True:
        new = ~known[here] & known[there]
        if not new.any():  # all is filled, or there is no fluid to fill it from
            return total
        layer = sp.csr_array((np.ones(np.count_nonzero(new)), (here[new], there[new])), (solid.size,) * 2)
        count = layer @ np.ones(solid.size)
        mean, rest = sp.diags_array(1 / np.maximum(count, 1)) @ layer, sp.diags_array((count == 0).astype(float))
        total = sp.csr_array((mean + rest) @ total)
        known |= count > 0


def _neighbours(shape, periodic):
    """Cells and cells beside them, each pair both ways round."""
    cells, pairs = np.arange(prod(shape)).reshape(shape), []
    for axis, wraps in enumerate(periodic):
        line = np.arange(shape[axis] if wraps else shape[axis] - 1)
        one, two = (np.take(cells, (line + k) % shape[axis], axis).ravel() for k in (0, 1))
        pairs += [(one, two), (two, one)]
    return (np.concatenate(side) for side in zip(*pairs, strict=True))
