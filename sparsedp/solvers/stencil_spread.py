"""Spread: the grid of a stencil, with cells without content in between, so that it coarsens well.

Coarse cells sit on even indices. An axis of q 2^l + 1 cells (periodic: q 2^l) has them on both ends (is even)
on l levels; other axes get some cells more, all on odd indices: of no volume, linked along their axis only, so
that a face with the coefficient c becomes two with 2 c. The solution in all other cells is what it was.
"""

from itertools import product
from math import ceil, log2, prod

import numpy as np

from sparsedp.kernels.multigrid_pack import padded
from sparsedp.solvers.stencil_coarsest import Natural, merged
from sparsedp.solvers.stencil_levels import COARSEST, half_shape

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
        shape, self.coarsenings = half_shape(grid.shape), 1
        while prod(shape) > COARSEST:
            shape, self.coarsenings = half_shape(shape), self.coarsenings + 1
        self.places: list[np.ndarray] = []
        self.shape: tuple[int, ...] = ()
        for n, flag in zip(grid.shape, grid.periodic):
            total = self._total(n, flag)
            empty = 2 * (np.arange(total - n) * (total // 2) // max(total - n, 1)) + 1
            self.places.append(np.delete(np.arange(total), empty))
            self.shape += (total,)

    def _total(self, n, periodic):
        """Length of an axis of n cells."""
        steps = min(self.coarsenings, ceil(log2(n))) if n > 1 else 0
        if periodic:
            return -(-n // 2**steps) * 2**steps
        allowed = max(SPARE * n, 1 if n >= SMALL else 0)
        totals = (-(-(n - 1) // 2**step) * 2**step + 1 for step in range(steps + 1))
        return max(total for total in totals if total - n <= allowed)

    # ------------------------------------------------------------ for fields

    def widths(self, of_grid=True):
        """Three arrays whose outer product is the volume of each cell, or 1; 0 in cells without content."""
        found = []
        for place, total, h in zip(self.places, self.shape, self.grid.widths):
            out = np.zeros(total)
            out[place] = h if of_grid else 1.0
            found.append(out)
        return tuple(found) if self.dim == 3 else (found[0], np.ones(1), found[1])

    @property
    def found(self):
        """For axis 0 and 1 the index in the field (-1: none), for the last runs of columns."""
        places = (*self.places[:-1], np.zeros(1, int))[:2] if self.dim == 2 else self.places[:2]
        found = []
        for place, total in zip(places, self.shape if self.dim == 3 else (self.shape[0], 1)):
            inverse = np.full(total, -1)
            inverse[place] = np.arange(place.size)
            found.append(inverse)
        return (*found, _runs(self.places[-1]))

    # ------------------------------------------------------------ for the stencil

    def natural(self, stencil, free):
        """Stencil, flags of the cells of singular components -> the finest level."""
        extra, links = padded(self.shape), padded(self.shape, self.dim)
        self._spread(stencil.extra, extra)
        order = (1, 0) if self.dim == 2 else (2, 0, 1)
        for axis, out in zip(order, links):
            c = np.moveaxis(stencil.links[axis], axis, 0)
            c = np.roll(c, -1, 0) if self.grid.periodic[axis] else c[1:]
            self._spread(np.moveaxis(c, 0, axis), out)
            self._bridge(np.moveaxis(out, axis, 0), axis)
        periodic = tuple(flag and n > 1 for flag, n in zip(self.grid.periodic, self.shape))
        spread = np.zeros(self.shape, bool)
        spread[np.ix_(*self.places)] = free.reshape(self.grid.shape)
        return merged(Natural(self.shape, periodic, links, extra, spread))

    def _spread(self, own, out):
        """Array of the grid -> natural array."""
        for runs in product(*map(_runs, self.places)):
            source = tuple(slice(at, at + n) for at, _, n in runs)
            out[tuple(slice(1 + first, 1 + first + n) for _, first, n in runs)] = own[source]

    def _bridge(self, lines, axis):
        """Links across cells without content; none beyond a wall, nor from a cell to itself."""
        place, total, periodic = self.places[axis], self.shape[axis], self.grid.periodic[axis]
        if not periodic or total == 1:
            lines[total] = 0.0
        gap = 1 + place[np.diff(place, append=total if periodic else place[-1] + 1) == 2]
        lines[gap] *= 2.0
        lines[gap + 1] = lines[gap]


def _runs(place):
    """Places of the cells of an axis -> runs: first cell, where it is, how many follow."""
    first = np.flatnonzero(np.diff(place, prepend=-2) > 1)
    return np.stack([first, place[first], np.diff(np.append(first, place.size))], axis=1)
