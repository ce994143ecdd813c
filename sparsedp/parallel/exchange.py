"""Exchange of numbers between ranks: each rank gathers the numbers that it reads, by a PetscSF."""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from sparsedp._utils import buffers
from sparsedp._utils.counters import count
from sparsedp.operators.structure.kronecker import components
from sparsedp.parallel.partition import lengths, slices

__all__ = ["Exchange", "hold", "of_boxes"]

KINDS = {"f": MPI.FLOAT, "d": MPI.DOUBLE, "D": MPI.C_DOUBLE_COMPLEX}  # PETSc adds up no floats

HELD = MPI.Comm.Create_keyval()


def hold(comm: Any) -> None:
    """Keep PETSc's own copy of a communicator. Called by all ranks together.

    Otherwise PETSc frees the copy with the last object on it. Python drops that object at different times on different
    ranks, so a rank that has to build a new copy would wait for the others.
    """
    if comm.Get_attr(HELD) is None:
        comm.Set_attr(HELD, PETSc.Comm(comm).duplicate())


class Exchange:
    """The linear map from a flat block to the numbers that this rank reads. Built by all ranks together.

    Parameters
    ----------
    layout : Partition
    parts : list of shapes
        Shapes of the components of the whole field.
    size : int
        Number of entries that are read.
    leaves, entries : int arrays
        For the entries that are exchanged: their places in the result, and their numbers in the whole flat field.
    shapes, windows : lists
        For the entries that are copied, by component: the shape of the result, and their windows in the result and in
        the block.
    """

    def __init__(
        self,
        layout: Any,
        parts: Any,
        size: int,
        leaves: np.ndarray,
        entries: np.ndarray,
        shapes: Any = (),
        windows: Any = (),
    ) -> None:
        ranks, places = layout.owners(parts, entries)
        counts = np.array([leaves.size, np.count_nonzero(ranks != layout.comm.rank)])
        self.agreement = layout.agreement
        self.busy, self.crossing = map(int, layout.sum(counts))  # sums over all ranks
        self.read = size, shapes, [there for there, _ in windows]
        self.block = layout.size(parts), layout.shapes(parts), [here for _, here in windows]
        if self.busy:
            PETSc.garbage_cleanup(layout.comm)  # frees the objects that Python has dropped, on all ranks together
            self._forest = PETSc.SF().create(layout.comm)
            remote = np.stack([ranks, places], axis=1).astype(PETSc.IntType)
            self._forest.setGraph(self.block[0], leaves.astype(PETSc.IntType), remote)
            self._forest.setUp()

    def forward(self, flat: np.ndarray) -> Any:
        """Return the numbers that are read, flat, for a flat block."""
        return self._sent("bcast", MPI.REPLACE, flat, self.placed(flat))

    def backward(self, read: Any) -> Any:
        """Apply the transpose: add the cotangents of the numbers read to the entries that they were read from."""
        return self._sent("reduce", MPI.SUM, read, self.taken(read))

    def placed(self, flat: np.ndarray) -> Any:
        """Return the numbers that are read from the block of this rank itself, zeros elsewhere."""
        return _copied(flat, self.block, self.read)

    def taken(self, read: Any) -> Any:
        """Apply the transpose of `placed`."""
        return _copied(read, self.read, self.block)

    def _sent(self, word, act, given, out):
        """Exchange entries with other ranks, combining them with the entries of `out` by `act`."""
        if self.busy:
            self.agreement.meet("exchange")
            if np.may_share_memory(out, given):
                out = out.copy()
            for part in ("Begin", "End"):
                getattr(self._forest, word + part)(KINDS[given.dtype.char], given, out, act)
        if self.crossing:
            count("ranks", "exchange")
            count("ranks", "sent", self.crossing * given.itemsize)
        return out


def _copied(flat, given, made):
    """Copy windows of a flat array into windows of another, zero elsewhere; without a copy if one fills the other."""
    (_, shapes, windows), (size, others, places) = given, made
    pieces = [part[window] for part, window in zip(components(flat, shapes), windows)]
    if len(pieces) == 1 and pieces[0].size == size and pieces[0].flags.c_contiguous:
        return pieces[0].reshape(-1)
    out = buffers.empty((size,), flat.dtype)
    if sum(piece.size for piece in pieces) < size:
        out[:] = 0
    for piece, part, place in zip(pieces, components(out, others), places):
        part[place] = piece
    return out


def of_boxes(layout: Any, parts: Any, boxes: Any) -> Any:
    """Return the Exchange for a box of each component, which may reach into other blocks."""
    leaves = [np.zeros(0, np.int64)]
    entries = [np.zeros(0, np.int64)]
    windows = []
    start = first = 0
    for part, box in zip(parts, boxes):
        here = layout.box(part)
        inner = [(max(a, c), max(min(b, d), a, c)) for (a, b), (c, d) in zip(box, here)]
        windows.append((slices(inner, box), slices(inner, here)))
        away = np.ones(lengths(box), dtype=bool)
        away[windows[-1][0]] = False
        index = [line + a for line, (a, _) in zip(np.nonzero(away), box)]
        leaves.append(start + np.flatnonzero(away))
        entries.append(first + np.ravel_multi_index(index, part, mode="wrap"))
        start = start + away.size
        first = first + prod(part)
    shapes = list(map(lengths, boxes))
    return Exchange(layout, parts, start, np.concatenate(leaves), np.concatenate(entries), shapes, windows)
