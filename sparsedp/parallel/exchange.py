"""What goes from rank to rank: every rank gathers the numbers that it reads, by a PetscSF."""

from math import prod

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from sparsedp.parallel.partition import lengths, slices

__all__ = ["Exchange", "of_boxes", "of_entries"]

KINDS = {"d": MPI.DOUBLE, "D": MPI.C_DOUBLE_COMPLEX}


class Exchange:
    """Flat block -> the numbers that this rank reads, a linear map. Made by all ranks together.

    Parameters
    ----------
    layout : Partition
    roots, size : int
        Count of numbers in the block, and of those that are read.
    copies : list of (slice of the result, its shape, its window, slice of the block, its shape, its window)
        What this rank holds itself.
    leaves, ranks, places : int arrays
        Of what others hold: where it goes in the result, who holds it, and where in the flat block there.
    """

    def __init__(self, layout, roots, size, copies, leaves, ranks, places):
        self.roots, self.size, self.copies = roots, size, copies
        self.foreign = int(np.count_nonzero(ranks != layout.comm.rank))
        self.busy = int(layout.max(leaves.size)) > 0
        if self.busy:
            PETSc.garbage_cleanup(layout.comm)  # what Python has dropped is freed here, on all ranks together
            remote = np.stack([ranks, places], axis=1).astype(PETSc.IntType)
            self._forest = PETSc.SF().create(layout.comm)
            self._forest.setGraph(roots, leaves.astype(PETSc.IntType), remote)
            self._forest.setUp()

    def forward(self, flat):
        """Flat block -> what is read, flat."""
        out = np.empty(self.size, flat.dtype)
        for target, shape, window, source, held, inner in self.copies:
            out[target].reshape(shape)[window] = flat[source].reshape(held)[inner]
        if self.busy:
            kind = KINDS[flat.dtype.char]
            self._forest.bcastBegin(kind, flat, out, MPI.REPLACE)
            self._forest.bcastEnd(kind, flat, out, MPI.REPLACE)
        return out


def of_boxes(layout, parts, boxes):
    """The Exchange for a box of each component, which may reach into other blocks."""
    copies: list[tuple] = []
    found: list = [np.zeros((3, 0), np.int64)]
    start = first = 0
    for number, (part, box) in enumerate(zip(parts, boxes)):
        here, shape = layout.box(part), lengths(box)
        inner = tuple((max(a, c), max(min(b, d), max(a, c))) for (a, b), (c, d) in zip(box, here))
        result, block = slice(start, start + prod(shape)), slice(first, first + prod(lengths(here)))
        if prod(lengths(inner)):
            copies.append((result, shape, slices(inner, box), block, lengths(here), slices(inner, here)))
        away = np.ones(shape, dtype=bool)
        away[slices(inner, box)] = not prod(lengths(inner))
        index = [line + a for line, (a, _) in zip(np.nonzero(away), box)]
        ranks, places = layout.owners(parts, number, index)
        found.append((start + np.flatnonzero(away), ranks, places))
        start, first = result.stop, block.stop
    return Exchange(layout, first, start, copies, *map(np.concatenate, zip(*found)))


def of_entries(layout, parts, entries):
    """The Exchange for entries of the whole flat field, by number."""
    ends = np.cumsum([prod(part) for part in parts])
    ranks, places = np.zeros((2, entries.size), np.int64)
    for number, (part, end) in enumerate(zip(parts, ends)):
        here = (entries >= end - prod(part)) & (entries < end)
        index = np.unravel_index(entries[here] - (end - prod(part)), part)
        ranks[here], places[here] = layout.owners(parts, number, index)
    return Exchange(layout, layout.size(parts), entries.size, [], np.arange(entries.size), ranks, places)
