"""Which rank holds which block of a field, and the numbers that all ranks agree on.

Along an axis, the ranks at place c hold the cells cuts[c] to cuts[c + 1] and their lower faces; those at the last place
hold the upper wall too. So every number has one owner, and sums over blocks are sums. Blocks may be empty: any grid
lies on any number of ranks. A box is one (start, stop) for each axis of a component; on a periodic axis it may reach
beyond 0 and n.
"""

from __future__ import annotations

from functools import cached_property
from itertools import product
from math import prod
from typing import Any

import numpy as np

from sparsedp.operators.structure.kronecker import components
from sparsedp.parallel.agreement import Agreement

__all__ = ["Partition"]


class Partition:
    """The cuts of a grid for the ranks of a communicator. Equal by value.

    Parameters
    ----------
    shape : tuple of int
        Cells along each axis.
    periodic : tuple of bool
    comm : mpi4py.MPI.Comm
    """

    def __init__(self, shape: tuple, periodic: Any, comm: Any) -> None:
        self.shape, self.periodic, self.comm = tuple(shape), tuple(periodic), comm
        self.ranks = _arrangement(self.shape, comm.size)
        self.cuts = [n * np.arange(p + 1) // p for n, p in zip(self.shape, self.ranks)]
        start = tuple(a for a, _ in self.box(self.shape))
        self.agreement = Agreement(comm, f", whose block begins at cell {start}")

    @property
    def _key(self):
        return self.shape, self.periodic, self.comm.py2f()

    def __eq__(self, other):
        return isinstance(other, Partition) and self._key == other._key

    def __hash__(self):
        return hash(self._key)

    def __reduce__(self):
        raise TypeError("a grid on ranks cannot be pickled; pickle the grid that was given to dp.distribute")

    # ------------------------------------------------------------ blocks

    def lines(self, axis: int, length: int) -> Any:
        """Return the cuts along one axis of a component with `length` entries: cells, nodes, or any other number."""
        return np.append(self.cuts[axis][:-1] * length // max(self.shape[axis], 1), length)

    @cached_property
    def places(self) -> Any:
        """Along each axis, the place of every rank."""
        return [np.unravel_index(rank, self.ranks) for rank in range(self.comm.size)]

    def box(self, part: Any, rank: Any = None) -> Any:
        """Return the box of one component that a rank (default: this one) holds."""
        place = self.places[self.comm.rank if rank is None else rank]
        lines = [self.lines(axis, length) for axis, length in enumerate(part)]
        return tuple((int(line[p]), int(line[p + 1])) for line, p in zip(lines, place))

    def shapes(self, parts: Any, rank: Any = None) -> Any:
        """Shapes of the blocks of a rank, one for each component."""
        return [lengths(self.box(part, rank)) for part in parts]

    def size(self, parts: Any, rank: Any = None) -> Any:
        """Count of numbers in the blocks of a rank."""
        return sum(map(prod, self.shapes(parts, rank)))

    def blocks(self, whole: Any, parts: Any, rank: Any = None) -> Any:
        """Return what a rank holds of a whole flat field, as views, one for each component."""
        return [field[slices(self.box(part, rank))] for field, part in zip(components(whole, parts), parts)]

    def take(self, values: Any, parts: Any) -> Any:
        """Return the flat block of this rank of a whole flat field, a copy."""
        return np.concatenate([values[:0], *(block.reshape(-1) for block in self.blocks(values, parts))])

    def gather(self, flat: np.ndarray, parts: Any) -> Any:
        """Return the whole flat field on every rank, from the flat block of this rank."""
        whole = np.empty(sum(map(prod, parts)), flat.dtype)
        for rank, given in enumerate(self.agreement.gathered(flat)):
            for block, values in zip(self.blocks(whole, parts, rank), components(given, self.shapes(parts, rank))):
                block[...] = values
        return whole

    def owners(self, parts: Any, entries: np.ndarray) -> Any:
        """Return the rank that holds each of some entries of a whole flat field, and the places in its flat block."""
        ranks, places = np.zeros((2, entries.size), np.int64)
        first, starts = 0, np.zeros(self.comm.size, np.int64)
        for part in parts:
            here = np.flatnonzero((entries >= first) & (entries < first + prod(part)))
            rank = place = np.zeros(here.size, np.int64)
            for axis, i in enumerate(np.unravel_index(entries[here] - first, part)):
                cuts = self.lines(axis, part[axis])
                owner = np.searchsorted(cuts, i, side="right") - 1
                rank = rank * self.ranks[axis] + owner
                place = place * np.diff(cuts)[owner] + (i - cuts[owner])
            ranks[here], places[here] = rank, place + starts[rank]
            first, starts = first + prod(part), starts + [self.size([part], r) for r in range(self.comm.size)]
        return ranks, places

    # ------------------------------------------------------------ numbers that all ranks agree on

    def sum(self, number: Any) -> Any:
        """Sum over the ranks, in their order."""
        return self.agreement.reduced(number, np.add)

    def max(self, number: Any) -> Any:
        """Return the largest of all ranks; NaN when one is NaN."""
        return self.agreement.reduced(number, np.maximum)

    def min(self, number: Any) -> Any:
        """Return the least of all ranks; NaN when one is NaN."""
        return self.agreement.reduced(number, np.minimum)


def lengths(box: Any) -> Any:
    """Shape of a box."""
    return tuple(stop - start for start, stop in box)


def slices(box: Any, origin: Any = None) -> Any:
    """Return one slice for each axis of a box, relative to the start of another box."""
    starts = [0] * len(box) if origin is None else [start for start, _ in origin]
    return tuple(slice(a - start, b - start) for (a, b), start in zip(box, starts))


def _arrangement(shape, count):
    """Return the number of ranks along each axis for which the fewest cells are cut; ties prefer the first axes."""
    divisors = [p for p in range(count, 0, -1) if count % p == 0]
    found = [ranks for ranks in product(divisors, repeat=len(shape)) if prod(ranks) == count]
    return min(found, key=lambda ranks: sum((p - 1) * prod(shape) / max(n, 1) for p, n in zip(ranks, shape)))
