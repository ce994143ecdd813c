"""The partition of fields into one block for each rank, and reductions over all ranks.

The ranks form a Cartesian arrangement. Along an axis, the ranks at position c of the arrangement own the cells cuts[c]
to cuts[c + 1] - 1 and their lower faces; the ranks at the last position also own the upper wall. So every entry has
exactly one owner, and a sum over a field is the sum over its blocks. Blocks may be empty, so that any grid can be
distributed over any number of ranks. A box is one pair (start, stop) for each axis of a component. On a periodic axis,
start may be negative and stop may be greater than n.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import product
from math import prod
from typing import Any, NoReturn, TypeAlias, cast

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike, NDArray

from sparsedp.grid.space import Space, components
from sparsedp.parallel.agreement import Agreement

__all__ = ["Box", "Partition", "Shapes", "lengths", "partition_of", "slices"]

Box: TypeAlias = Sequence[tuple[int, int]]
Shapes: TypeAlias = Sequence[tuple[int, ...]]

MOST_COMPARED = 1000  # about this number of entries of an array is compared between ranks, which takes 5 us


class Partition:
    """The partition of a grid over the ranks of a communicator. Partitions with the same values are equal.

    Parameters
    ----------
    shape : tuple of int
        Cells along each axis.
    periodic : tuple of bool
    comm : mpi4py.MPI.Comm

    Attributes
    ----------
    ranks : tuple of int
        Number of ranks along each axis.
    cuts : list of int arrays
        For each axis, the first cell at each position of the arrangement of ranks, followed by the number of cells.
    """

    def __init__(self, shape: Sequence[int], periodic: Sequence[bool], comm: MPI.Comm) -> None:
        self.shape = tuple(shape)
        self.periodic = tuple(periodic)
        self.comm = comm
        self.ranks = _arrangement(self.shape, comm.size)
        self.cuts = [n * np.arange(p + 1) // p for n, p in zip(self.shape, self.ranks, strict=True)]
        start = tuple(a for a, _ in self.box(self.shape))
        self.agreement = Agreement(comm, f", whose block begins at cell {start}")

    @property
    def _key(self):
        return self.shape, self.periodic, self.comm.py2f()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Partition) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __reduce__(self) -> NoReturn:
        raise TypeError("a grid on ranks cannot be pickled; pickle the grid that was given to dp.distribute")

    # ------------------------------------------------------------ blocks

    def lines(self, axis: int, length: int) -> NDArray[np.integer]:
        """Return the cuts along one axis for a component that has `length` entries along it, such as cells or nodes."""
        return np.append(self.cuts[axis][:-1] * length // max(self.shape[axis], 1), length)

    @cached_property
    def places(self) -> list[tuple]:
        """For each rank, its position along each axis in the arrangement of ranks."""
        return [np.unravel_index(rank, self.ranks) for rank in range(self.comm.size)]

    def box(self, part: Sequence[int], rank: int | None = None) -> Box:
        """Return the box of one component that a rank owns. Default: this rank."""
        if rank is None:
            rank = self.comm.rank
        lines = [self.lines(axis, length) for axis, length in enumerate(part)]
        return tuple((int(line[p]), int(line[p + 1])) for line, p in zip(lines, self.places[rank]))

    def shapes(self, parts: Shapes, rank: int | None = None) -> Shapes:
        """Return the shapes of the blocks of a rank, one for each component."""
        return [lengths(self.box(part, rank)) for part in parts]

    def size(self, parts: Shapes, rank: int | None = None) -> int:
        """Return the number of entries in the blocks of a rank."""
        return sum(map(prod, self.shapes(parts, rank)))

    def blocks(self, whole: NDArray, parts: Shapes, rank: int | None = None) -> list[NDArray]:
        """Return the blocks of a rank as views of a whole flat field, one for each component."""
        fields = components(whole, parts)
        return [field[slices(self.box(part, rank))] for field, part in zip(fields, parts, strict=True)]

    def take(self, values: NDArray, parts: Shapes) -> NDArray:
        """Return a copy of the flat block of this rank, given the whole flat field."""
        return np.concatenate([values[:0], *(block.reshape(-1) for block in self.blocks(values, parts))])

    def gather(self, flat: NDArray, parts: Shapes) -> NDArray:
        """Return the whole flat field on every rank, from the flat block of this rank."""
        whole = np.empty(sum(map(prod, parts)), flat.dtype)
        for rank, rank_flat in enumerate(self.agreement.gather(flat)):
            rank_blocks = components(rank_flat, self.shapes(parts, rank))
            for block, values in zip(self.blocks(whole, parts, rank), rank_blocks, strict=True):
                block[...] = values
        return whole

    def owners(self, parts: Shapes, entries: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return, for entries given by their indices in the whole flat field, the owner and the index in its block."""
        ranks = np.zeros(entries.size, np.int64)
        places = np.zeros(entries.size, np.int64)
        first = 0  # index of the first entry of the component in the whole flat field
        starts = np.zeros(self.comm.size, np.int64)  # index of the component's first entry in the block of each rank
        for part in parts:
            inside = np.flatnonzero((entries >= first) & (entries < first + prod(part)))
            rank = np.zeros(inside.size, np.int64)
            place = np.zeros(inside.size, np.int64)
            for axis, index in enumerate(np.unravel_index(entries[inside] - first, part)):
                cuts = self.lines(axis, part[axis])
                owner = np.searchsorted(cuts, index, side="right") - 1
                rank = rank * self.ranks[axis] + owner
                place = place * np.diff(cuts)[owner] + (index - cuts[owner])
            ranks[inside] = rank
            places[inside] = place + starts[rank]
            first += prod(part)
            starts = starts + [self.size([part], r) for r in range(self.comm.size)]
        return ranks, places

    # ------------------------------------------------------------ comparisons and reductions

    def compare(self, value: ArrayLike) -> None:
        """Record a number or array that must be the same on all ranks; of large arrays only a sample is recorded."""
        value = np.asarray(value)
        description = "a number"
        if value.ndim:
            most = round(MOST_COMPARED ** (1 / value.ndim))
            description = f"an array of shape {value.shape}"
            value = value[tuple(slice(None, None, n // most + 1) for n in value.shape)]
        self.agreement.record(f"{description} combined with a field on ranks", value.tobytes())

    def sum(self, number: ArrayLike) -> Any:
        """Return the sum over all ranks, added in the order of the ranks."""
        return self.agreement.reduce(number, np.add)

    def max(self, number: ArrayLike) -> Any:
        """Return the maximum over all ranks; NaN if one value is NaN."""
        return self.agreement.reduce(number, np.maximum)

    def min(self, number: ArrayLike) -> Any:
        """Return the minimum over all ranks; NaN if one value is NaN."""
        return self.agreement.reduce(number, np.minimum)


def partition_of(space: Space) -> Partition:
    """Return the partition of a space whose fields are distributed."""
    return cast(Partition, space.backend)


def lengths(box: Box) -> tuple[int, ...]:
    """Return the shape of a box."""
    return tuple(stop - start for start, stop in box)


def slices(box: Box, origin: Box | None = None) -> tuple[slice, ...]:
    """Return one slice for each axis of a box; the indices are relative to the start of the box `origin`."""
    starts = [0] * len(box)
    if origin is not None:
        starts = [start for start, _ in origin]
    return tuple(slice(a - start, b - start) for (a, b), start in zip(box, starts))


def _arrangement(shape, count):
    """Return the number of ranks along each axis that minimizes the area of the cuts; ties prefer the first axes."""
    divisors = [p for p in range(count, 0, -1) if count % p == 0]
    arrangements = [ranks for ranks in product(divisors, repeat=len(shape)) if prod(ranks) == count]

    def cells_cut(ranks):
        return sum((p - 1) * prod(shape) / max(n, 1) for p, n in zip(ranks, shape, strict=True))

    return min(arrangements, key=cells_cut)
