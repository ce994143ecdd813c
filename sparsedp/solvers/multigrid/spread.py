"""Spread: the grid of a stencil, with cells without content in between, so that it coarsens well.

Coarse cells sit on even indices. An axis of q 2^l + 1 cells (periodic: q 2^l) has them on both ends (is even)
on l levels; other axes get some cells more, all on odd indices: of no volume, linked along their axis only, so
that a face with the coefficient c becomes two with 2 c. The solution in all other cells is what it was.
"""

from functools import reduce
from itertools import product
from math import ceil, log2, prod

import numpy as np

from sparsedp.solvers.multigrid.levels import COARSEST

__all__ = ["Spread"]

SPARE = 0.03  # largest share of an axis that is not periodic for such cells
SMALL = 16  # an axis of so many cells may have one in any case


class Spread:
    """Where the cells of a grid are.

    Parameters
    ----------
    grid : Grid

    Attributes
    ----------
    shape : tuple
        With the cells without content.
    coarsenings : int
        Number of coarse levels.
    """

    def __init__(self, grid):
        self.grid, self.dim = grid, grid.dim
        self.coarsenings = 1
        while prod(-(-n // 2**self.coarsenings) for n in grid.shape) > COARSEST:
            self.coarsenings += 1
        self.places: list[np.ndarray] = []
        self.shape: tuple[int, ...] = ()
        for n, flag in zip(grid.shape, grid.periodic):
            total = self._total(n, flag)
            empty = 2 * (np.arange(total - n) * (total // 2) // max(total - n, 1)) + 1
            self.places.append(np.delete(np.arange(total), empty))
            self.shape += (total,)
        pieces = list(product(*map(_runs, self.places)))  # what is without gaps in the field, and where it is
        self.pieces = [tuple(zip(*runs)) for runs in pieces]

    def _total(self, n, periodic):
        """Length of an axis of n cells."""
        steps = min(self.coarsenings, ceil(log2(n))) if n > 1 else 0
        if periodic:
            return -(-n // 2**steps) * 2**steps
        allowed = max(SPARE * n, 1 if n >= SMALL else 0)
        totals = (-(-(n - 1) // 2**step) * 2**step + 1 for step in range(steps + 1))
        return max(total for total in totals if total - n <= allowed)

    def volumes(self):
        """Volumes of the cells; those without content have one like their neighbours, to measure residuals with."""
        places = zip(self.shape, self.places, self.grid.widths)
        return reduce(np.multiply.outer, [np.interp(np.arange(total), place, h) for total, place, h in places])

    def put(self, field, out):
        """Field -> the cells of the grid in natural order."""
        for own, here in self.pieces:
            out[here] = field[own]

    def taken(self, array):
        """The reverse."""
        out = np.empty(self.grid.shape)
        for own, here in self.pieces:
            out[own] = array[here]
        return out

    def links(self, stencil, layout):
        """The links of a stencil, as fields of a layout."""
        links = layout.zeros(self.dim)
        for axis, (c, out) in enumerate(zip(stencil.links, layout.cells(links))):
            self.put(c, out)
            self._bridge(np.moveaxis(out, axis, 0), axis)
        return links

    def _bridge(self, lines, axis):
        """Links across cells without content."""
        place, total, periodic = self.places[axis], self.shape[axis], self.grid.periodic[axis]
        gap = place[np.diff(place, append=total if periodic else place[-1] + 1) == 2]
        lines[gap] *= 2.0
        lines[gap + 1] = lines[gap]


def _runs(place):
    """Places of the cells of an axis -> slices without gaps: of the cells, of their places."""
    first = np.flatnonzero(np.diff(place, prepend=-2) > 1)
    counts = np.diff(np.append(first, place.size))
    return [(slice(at, at + n), slice(here, here + n)) for at, here, n in zip(first, place[first], counts)]
