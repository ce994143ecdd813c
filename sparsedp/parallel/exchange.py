"""Exchange of field entries between ranks: each rank gathers the entries that it needs, by a PetscSF."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from sparsedp._utils import buffers
from sparsedp._utils.counters import count
from sparsedp.operators.structure.kronecker import components
from sparsedp.parallel.partition import Box, Partition, Shapes, lengths, slices

__all__ = ["Exchange", "Windows", "exchange_of_boxes", "keep_petsc_communicator"]

KINDS = {"f": MPI.FLOAT, "d": MPI.DOUBLE, "D": MPI.C_DOUBLE_COMPLEX}  # PETSc cannot add complex64

PETSC_COMMUNICATOR = MPI.Comm.Create_keyval()


def keep_petsc_communicator(comm: MPI.Comm) -> None:
    """Keep PETSc's duplicate of a communicator alive. All ranks must call this function together.

    Otherwise PETSc would free the duplicate together with the last object that uses it. Python deletes that object at
    different times on different ranks, so that some ranks would have to create a new duplicate, which is a collective
    operation, and would wait forever for the others.
    """
    if comm.Get_attr(PETSC_COMMUNICATOR) is None:
        comm.Set_attr(PETSC_COMMUNICATOR, PETSc.Comm(comm).duplicate())


class Windows(NamedTuple):
    """A rectangular window in each component of a flat array.

    Attributes
    ----------
    size : int
        Size of the flat array.
    shapes : list of tuples of int
        Shapes of the components.
    windows : list of tuples of slices
        One window for each component.
    """

    size: int
    shapes: Shapes
    windows: Sequence[tuple[slice, ...]]


class Exchange:
    """The linear map from the block of this rank to the entries of the whole field that this rank needs.

    All ranks must create it together. Entries can be given in two ways: by index, which are communicated, and by
    windows of this rank's own block, which are copied.

    Parameters
    ----------
    layout : Partition
    parts : list of shapes
        Shapes of the components of the whole field.
    size : int
        Number of entries in the result.
    leaves, entries : int arrays
        The communicated entries: their indices in the result, and their indices in the whole flat field.
    shapes : list of tuples of int
        The copied entries: the shapes of the components of the result.
    windows, block_windows : lists of tuples of slices
        The copied entries: their windows in the components of the result and of the block.
    """

    def __init__(
        self,
        layout: Partition,
        parts: Shapes,
        size: int,
        leaves: NDArray[np.integer],
        entries: NDArray[np.integer],
        shapes: Shapes = (),
        windows: Sequence[tuple[slice, ...]] = (),
        block_windows: Sequence[tuple[slice, ...]] = (),
    ) -> None:
        ranks, places = layout.owners(parts, entries)
        counts = np.array([leaves.size, np.count_nonzero(ranks != layout.comm.rank)])
        self.agreement = layout.agreement
        self.entry_count, self.sent_count = map(int, layout.sum(counts))  # sums over all ranks
        self.read = Windows(size, shapes, windows)
        self.block = Windows(layout.size(parts), layout.shapes(parts), block_windows)
        if self.entry_count:
            PETSc.garbage_cleanup(layout.comm)  # frees PETSc objects without references, a collective operation
            self._star_forest = PETSc.SF().create(layout.comm)
            remote = np.stack([ranks, places], axis=1).astype(PETSc.IntType)
            self._star_forest.setGraph(self.block.size, leaves.astype(PETSc.IntType), remote)
            self._star_forest.setUp()

    def forward(self, flat: NDArray) -> NDArray:
        """Return the needed entries as a flat array, given the flat block of this rank."""
        return self._exchange("bcast", MPI.REPLACE, flat, self.placed(flat))

    def backward(self, read: NDArray) -> NDArray:
        """Apply the transpose of `forward`: send cotangents back to the owners of the entries, and add them there."""
        return self._exchange("reduce", MPI.SUM, read, self.taken(read))

    def placed(self, flat: NDArray) -> NDArray:
        """Return the result of `forward` without communication: entries of other ranks are 0."""
        return _copied(flat, self.block, self.read)

    def taken(self, read: NDArray) -> NDArray:
        """Apply the transpose of `placed`."""
        return _copied(read, self.read, self.block)

    def _exchange(self, operation: str, combine: Any, values: NDArray, out: NDArray) -> NDArray:
        """Communicate entries by an operation of PetscSF, and combine them with the entries of `out`."""
        if self.entry_count:
            self.agreement.synchronize("exchange")
            if np.may_share_memory(out, values):
                out = out.copy()
            for stage in ("Begin", "End"):
                getattr(self._star_forest, operation + stage)(KINDS[values.dtype.char], values, out, combine)
        if self.sent_count:
            count("ranks", "exchange")
            count("ranks", "sent", self.sent_count * values.itemsize)
        return out


def _copied(flat: NDArray, source: Windows, target: Windows) -> NDArray:
    """Copy windows of a flat array into windows of a new one, which is 0 elsewhere.

    If a single contiguous window fills the whole target, return a view of it without copying.
    """
    parts = components(flat, source.shapes)
    pieces = [part[window] for part, window in zip(parts, source.windows)]
    if len(pieces) == 1 and pieces[0].size == target.size and pieces[0].flags.c_contiguous:
        return pieces[0].reshape(-1)
    out = buffers.empty((target.size,), flat.dtype)
    if sum(piece.size for piece in pieces) < target.size:
        out[:] = 0
    for piece, part, window in zip(pieces, components(out, target.shapes), target.windows):
        part[window] = piece
    return out


def exchange_of_boxes(layout: Partition, parts: Shapes, boxes: Sequence[Box]) -> Exchange:
    """Return the Exchange that reads one box of each component; the boxes may extend into blocks of other ranks."""
    leaves = [np.zeros(0, np.int64)]
    entries = [np.zeros(0, np.int64)]
    windows = []
    block_windows = []
    start = 0  # index of the component's first entry in the result
    first = 0  # index of the component's first entry in the whole flat field
    for part, box in zip(parts, boxes, strict=True):
        own = layout.box(part)
        inner = [(max(a, c), max(min(b, d), a, c)) for (a, b), (c, d) in zip(box, own)]
        windows.append(slices(inner, box))
        block_windows.append(slices(inner, own))
        is_away = np.ones(lengths(box), dtype=bool)
        is_away[windows[-1]] = False
        index = tuple(line + a for line, (a, _) in zip(np.nonzero(is_away), box))
        leaves.append(start + np.flatnonzero(is_away))
        entries.append(first + np.ravel_multi_index(index, part, mode="wrap"))
        start += is_away.size
        first += prod(part)
    shapes = [lengths(box) for box in boxes]
    return Exchange(
        layout, parts, start, np.concatenate(leaves), np.concatenate(entries), shapes, windows, block_windows
    )
