"""What goes from rank to rank: every rank gathers the numbers that it reads, by a PetscSF."""

from math import prod

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from sparsedp import results
from sparsedp.ledger import active, count
from sparsedp.parallel.partition import lengths, slices

__all__ = ["Exchange", "hold", "of_boxes", "of_entries"]

KINDS = {"f": MPI.FLOAT, "d": MPI.DOUBLE, "D": MPI.C_DOUBLE_COMPLEX}  # PETSc adds up no floats

HELD = MPI.Comm.Create_keyval()


def hold(comm):
    """Keep PETSc's own copy of a communicator. Called by all ranks together.

    Without a holder it is freed with the last object on it, which Python drops sooner on one rank than on another: the
    one would then wait for the others to make a new one.
    """
    if comm.Get_attr(HELD) is None:
        comm.Set_attr(HELD, PETSc.Comm(comm).duplicate())


class Exchange:
    """Flat block -> the numbers that this rank reads, a linear map. Made by all ranks together.

    Parameters
    ----------
    layout : Partition
    roots, size : int
        Count of numbers in the block, and of those that are read.
    copies : list of pairs of (slice, its shape, window of that)
        What this rank holds itself: where it goes in the result, and where it is in the block.
    leaves, ranks, places : int arrays
        Of what others hold: where it goes in the result, who holds it, and where in the flat block there.
    """

    def __init__(self, layout, roots, size, copies, leaves, ranks, places):
        self.roots, self.size, self.copies = roots, size, copies
        leaves, ranks, places = (numbers.astype(PETSc.IntType) for numbers in (leaves, ranks, places))
        self.agreement = layout.agreement
        counts = np.array([leaves.size, np.count_nonzero(ranks != layout.comm.rank)])
        self.busy, self.crossing = map(int, layout.sum(counts))  # of all ranks
        if self.busy:
            PETSc.garbage_cleanup(layout.comm)  # what Python has dropped is freed here, on all ranks together
            self._forest = PETSc.SF().create(layout.comm)
            self._forest.setGraph(roots, leaves, np.stack([ranks, places], axis=1))
            self._forest.setUp()

    def forward(self, flat):
        """Flat block -> what is read, flat."""
        return self._sent("bcast", MPI.REPLACE, flat, self.placed(flat))

    def backward(self, read):
        """The transpose: what stands beside the numbers read is added where they came from."""
        return self._sent("reduce", MPI.SUM, read, self.taken(read))

    def placed(self, flat):
        """Flat block -> what is read of it on this rank, zeros elsewhere."""
        return _copied([(_window(flat, *here), there) for there, here in self.copies], self.size, flat.dtype)

    def taken(self, read):
        """The transpose of that."""
        return _copied([(_window(read, *there), here) for there, here in self.copies], self.roots, read.dtype)

    def _sent(self, word, act, given, out):
        """What comes from others, or goes to them, added to what stays here."""
        if self.busy:
            self.agreement.meet("exchange")
            out = out.copy() if np.may_share_memory(out, given) else out
            for part in ("Begin", "End"):
                getattr(self._forest, word + part)(KINDS[given.dtype.char], given, out, act)
        if self.crossing and active:
            count("ranks", "exchange")
            count("ranks", "sent", self.crossing * given.itemsize)
        return out


def _window(flat, part, shape, window):
    return flat[part].reshape(shape)[window]


def _copied(pieces, size, dtype):
    """Arrays, and where they go in a flat one of this size, with zeros in between; an array that fills it is it."""
    if len(pieces) == 1 and pieces[0][0].size == size and pieces[0][0].flags.c_contiguous:
        return pieces[0][0].reshape(-1)
    out = results.empty((size,), dtype)
    if sum(values.size for values, _ in pieces) < size:
        out[:] = 0
    for values, place in pieces:
        _window(out, *place)[...] = values
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
            there, place = (result, shape, slices(inner, box)), (block, lengths(here), slices(inner, here))
            copies.append((there, place))
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
