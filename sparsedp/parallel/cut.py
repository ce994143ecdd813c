"""Restriction of a linear map, defined once for the whole grid, to the blocks of the ranks.

Every rank has the whole definition, and cuts out the rows of its own block:

    y[block] = A[block, reach] x[reach],        x[reach] by one exchange.

The transpose is the transposed map, cut in the same way: it gathers too, so nothing is added up across ranks, and
the bits of the result do not depend on the number of ranks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from math import prod
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from sparsedp.grid.space import Space, components
from sparsedp.kernels.reference import Rows as RowRecord
from sparsedp.kernels.reference import Tridiagonal
from sparsedp.operators.structure.base import Matrix, Structure, Transposable, rows_of
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term
from sparsedp.operators.structure.lazy import Chain, Diagonal, Mask, Sum
from sparsedp.parallel.exchange import Exchange, exchange_of_boxes
from sparsedp.parallel.partition import Box, Partition, Shapes, lengths, partition_of, slices
from sparsedp.solvers.inverse import Solution
from sparsedp.solvers.nullspace import Projector

__all__ = ["Columns", "OwnRows", "Rows", "Storage", "local_structure", "reading", "storage"]

# Where fields are stored: (partition, shapes of the components); None if every rank has all entries.
Storage: TypeAlias = tuple[Partition, Shapes] | None
Map: TypeAlias = Callable[[NDArray], NDArray]

UNLIMITED = np.iinfo(int).max  # as an end of a side that nothing has limited yet


def storage(space: Space) -> Storage:
    """Return where the fields on a space are stored."""
    if space.backend.whole_fields:
        return None
    return partition_of(space), space.parts


def local_structure(structure: Structure, source: Storage, target: Storage) -> Structure:
    """Return the structure on blocks of a structure on whole fields.

    Parameters
    ----------
    structure : Structure
    source, target : Storage
        Of the field that it is applied to, and of the result.

    Raises
    ------
    TypeError
        If the rows of the structure are not known.
    """
    if isinstance(structure, Chain):
        stages = _storage_between(structure.members, source, target)
        pairs = zip(structure.members, stages[1:], stages[:-1], strict=True)
        return Chain([local_structure(member, before, after) for member, before, after in pairs])
    if isinstance(structure, Sum):
        return Sum([local_structure(member, source, target) for member in structure.members])
    if isinstance(structure, Diagonal):
        if source is None:
            return structure
        return _local_diagonal(structure, *source)
    rows, columns = structure.shape
    shape = (_local_size(target, rows), _local_size(source, columns))
    if isinstance(structure, OwnRows):
        return structure.inner[structure.transposed]
    if isinstance(structure, (Solution, Projector)):
        return OnBlocks(structure, shape)
    if isinstance(structure, Kronecker) and source is not None and target is not None:
        if (structure.in_parts, structure.out_parts) == (tuple(source[1]), tuple(target[1])):
            return _local_kronecker(structure, shape, source[0], target[0])
    if isinstance(structure, (Kronecker, Matrix)):  # of other components: a map of flat arrays
        return _local_matrix(structure.explicit(), shape, source, target)
    raise TypeError(
        f"{getattr(structure, 'name', type(structure).__name__)} cannot be applied to fields on ranks, because its "
        "rows are not known; build it from operators of the grid or from a matrix"
    )


def _local_size(stored, size):
    """Return the number of entries that this rank holds of a field of some size."""
    if stored is None:
        return size
    partition, parts = stored
    return partition.size(parts)


def _storage_between(members, source, target):
    """Return the storage before and after each factor of a product, left to right.

    Where it is not known, every rank holds all entries.
    """
    layout, _ = source or target
    stages = [target, *[None] * (len(members) - 1), source]

    def beside(member, attribute, beyond):
        """Return the storage on one side of a factor; `beyond`: the storage on its other side."""
        if isinstance(member, (Diagonal, Projector)):
            return beyond
        if isinstance(member, Solution):
            return storage(member.solver.system.op.domain)
        parts = getattr(member, attribute, ((),))
        if len(parts[0]) == len(layout.shape):
            return layout, parts
        return None

    for place in range(len(members) - 1, 0, -1):
        left, right = members[place - 1 : place + 1]
        stages[place] = beside(right, "out_parts", stages[place + 1]) or beside(left, "in_parts", None)
    for place, member in enumerate(members[:-1]):
        if isinstance(member, (Diagonal, Projector)):
            stages[place + 1] = stages[place]
    return stages


class OnBlocks(Structure):
    """A structure that acts on blocks as it is: a solve on ranks, or a projection of its data."""

    def __init__(self, whole: Structure, shape: tuple[int, int]) -> None:
        self.whole = whole
        self.shape = shape

    def apply(self, x: NDArray, out: NDArray) -> None:
        self.whole.apply(x, out)

    def explicit(self) -> sp.csr_array:
        raise _no_matrix(self.whole)


def _no_matrix(structure):
    name = type(structure).__name__
    return TypeError(f"{name} has no matrix on ranks; invert a sum or product of operators")


class Rows(Structure):
    """The rows of a structure for the blocks of this rank: windows of its result on the entries that are read.

    Parameters
    ----------
    inner : Structure
    shape : (rows, columns), of blocks
    read : function or None
        Maps a flat block to the argument of `inner`. None: every rank has all entries.
    windows : sequence
        One for each component of the result of `inner`.
    """

    def __init__(self, inner: Structure, shape: tuple[int, int], read: Map | None, windows: Sequence = (...,)) -> None:
        self.inner = inner
        self.shape = shape
        self.read = read
        self.windows = windows
        self.parts = getattr(inner, "out_parts", (inner.shape[:1],))
        self.dtype = inner.dtype
        self.takes_complex = inner.takes_complex

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write the product with x into `out`."""
        if self.read:
            x = self.read(x)
        blocks = self._windows_of(self.inner.product(x))
        for block, target in zip(blocks, components(out, [block.shape for block in blocks]), strict=True):
            target[...] = block

    def _windows_of(self, wide):
        """Return the blocks of this rank of a result of `inner`."""
        return [part[window] for part, window in zip(components(wide, self.parts), self.windows, strict=True)]

    def explicit(self) -> sp.csr_array:
        """Return the rows as a csr_array; its columns are the entries that are read."""
        if self.read is None:
            raise _no_matrix(self.inner)
        blocks = self._windows_of(np.arange(self.inner.shape[0]))
        return self.inner.explicit()[np.concatenate([block.reshape(-1) for block in blocks])]

    def magnitude(self) -> Map:
        """Return the function that applies the absolute values of the entries."""
        entries = abs(self.explicit())
        read: Any = self.read

        def bound(x: NDArray) -> NDArray:
            return entries @ read(x)

        return bound


def _local_diagonal(structure, layout, parts):
    """Return the block of this rank of a diagonal."""
    layout.compare(structure.values)
    values = layout.take(structure.values, parts)
    if isinstance(structure, Mask):
        return Mask(layout.take(structure.keep, parts), values)
    return Diagonal(values)


def _local_matrix(matrix, shape, source, target):
    """Return the rows of a matrix for the blocks of this rank, or all rows if every rank has the result."""
    layout, _ = source or target
    layout.compare(matrix.data)
    if target is not None:
        target_layout, parts = target
        matrix = matrix[target_layout.take(np.arange(matrix.shape[0]), parts)]
    if source is None:
        return Rows(Matrix(matrix), shape, None)
    exchange, places = reading(matrix.indices, *source)
    inner = sp.csr_array((matrix.data, places, matrix.indptr), shape=(matrix.shape[0], exchange.read.size))
    return Rows(Matrix(inner), shape, exchange.forward)


def reading(entries: NDArray[np.integer], layout: Partition, parts: Shapes) -> tuple[Exchange, NDArray[np.integer]]:
    """Return the Exchange that reads some entries of a whole field, and the place of each entry in its result."""
    entries, places = np.unique(entries, return_inverse=True)
    return Exchange(layout, parts, entries.size, np.arange(entries.size), entries), places.reshape(-1)


class OwnRows(Transposable):
    """A square matrix of which each rank holds only the rows of its own block.

    Attributes
    ----------
    inner : tuple
        The matrix as Rows, its transpose as Columns, and its Stencil.
    """

    @property
    def stencil(self) -> Any:
        """The Stencil from which the matrix was assembled."""
        return self.inner[2]


class Columns(Structure):
    """The transpose of Rows: the product with a block is added to the entries that the rows read.

    Parameters
    ----------
    inner : Structure
        Maps a flat block to cotangents of the entries that were read.
    shape : (rows, columns), of blocks
    add_back : function
        Sends these cotangents to the ranks that hold the entries, and adds them there.
    """

    def __init__(self, inner: Structure, shape: tuple[int, int], add_back: Map) -> None:
        self.inner = inner
        self.shape = shape
        self.add_back = add_back

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write the product with x into `out`."""
        out[...] = self.add_back(self.inner.product(x))

    def magnitude(self) -> Map:
        """Return the function that applies the absolute values of the entries."""
        entries = abs(self.inner.explicit())

        def bound(x: NDArray) -> NDArray:
            return self.add_back(entries @ x)

        return bound


# ---- products of 1-D factors ----


def _local_kronecker(structure, shape, source, target):
    """Return the rows of a Kronecker structure for the blocks of this rank on the layout `target`, by one exchange."""
    own = [target.box(part) for part in structure.out_parts]
    computed, reach = _boxes(structure, own, source.periodic)
    read = exchange_of_boxes(source, structure.in_parts, reach).forward
    windows = [slices(inner, wide) for inner, wide in zip(own, computed, strict=True)]
    return Rows(KroneckerOfBoxes(structure, source.periodic, computed, reach), shape, read, windows)


class KroneckerOfBoxes(Kronecker):
    """A Kronecker structure between boxes: the same arithmetic in the same order, wherever the boxes are.

    Parameters
    ----------
    structure : Kronecker
    periodic : tuple of bool
    computed, reach : lists of boxes
        The rows and the columns to keep, one box for each component of the result and of the argument.
    """

    def __init__(
        self, structure: Kronecker, periodic: tuple[bool, ...], computed: Sequence[Box], reach: Sequence[Box]
    ) -> None:
        self.out_parts = tuple(map(lengths, computed))
        self.in_parts = tuple(map(lengths, reach))
        self.shape = (sum(map(prod, self.out_parts)), sum(map(prod, self.in_parts)))
        self.blocks = {}
        for (r, c), terms in structure.blocks.items():
            sides = list(zip(computed[r], reach[c], periodic, strict=True))
            self.blocks[r, c] = tuple(Term(term.scale, _factors_of_boxes(term.factors, sides)) for term in terms)


def _factors_of_boxes(factors, sides):
    """Return the factors of a term between the sides of two boxes; None stands for the identity."""
    last_axis = len(sides) - 1
    block_factors: list[FactorOfBlock | None] = []
    for axis, (factor, (rows, columns, wraps)) in enumerate(zip(factors, sides, strict=True)):
        block_factor = None
        if factor is not None:
            block_factor = FactorOfBlock(factor, rows, columns, wraps, axis == last_axis)
        block_factors.append(block_factor)
    return tuple(block_factors)


def _boxes(structure, own, periodic):
    """Return boxes of the result to compute, and boxes of the field that they read.

    Where a term has no factor along an axis, both have the same side there. Entries beyond the block itself are not
    complete and are dropped by the caller.
    """
    # A side from a to b is stored as (a, -b): then the minimum of several is the side around all of them.
    computed = np.array([[(a, -b) for a, b in box] for box in own])
    reach = np.full((len(structure.in_parts), len(periodic), 2), UNLIMITED)
    same = []
    for (r, c), terms in structure.blocks.items():
        if not prod(lengths(own[r])):
            continue
        for axis, factors in enumerate(zip(*(term.factors for term in terms))):
            same += [(c, r, axis)] * (None in factors)
            columns = [_entries(factor, own[r][axis], periodic[axis])[1] for factor in factors if factor]
            for read in filter(np.size, columns):
                np.minimum(reach[c, axis], (read.min(), -read.max() - 1), out=reach[c, axis])
        if len(terms) > 1:
            # One pass adds up the ends of a row in another order: only the ends of the grid itself may be in the block.
            low = own[r][-1][0] - 1
            high = own[r][-1][1] + 1
            if not periodic[-1]:
                low = max(low, 0)
                high = min(high, structure.in_parts[c][-1])
            np.minimum(reach[c, -1], (low, -high), out=reach[c, -1])
    for _ in range(len(computed) + len(reach)):
        for c, r, axis in same:
            common = np.minimum(computed[r, axis], reach[c, axis])
            computed[r, axis] = common
            reach[c, axis] = common
    return _as_boxes(computed), _as_boxes(reach)


def _as_boxes(sides):
    """Return boxes from arrays of sides (a, -b); an unlimited side is empty."""
    limited = np.where(sides == UNLIMITED, 0, sides).tolist()
    return [tuple((a, -b) for a, b in box) for box in limited]


def _entries(factor, side, wraps):
    """Return rows, columns and values of the entries in some rows of a factor, contiguous on a periodic axis."""
    n, columns = factor.shape
    rows = np.arange(*side)
    matrix = factor.matrix[rows % max(n, 1)]
    row = rows_of(matrix)
    column = matrix.indices.astype(np.int64)
    if wraps and columns:
        near = (rows[row] + 0.5) * (columns / n) - 0.5
        column = column + columns * np.rint((near - column) / columns).astype(np.int64)
    return row, column, matrix.data


class FactorOfBlock(Factor):
    """Some rows and columns of a factor, applied by the loops of the whole factor, so that rounding is the same.

    Parameters
    ----------
    whole : Factor
    rows, columns : (start, stop)
    wraps : bool
        Whether the axis is periodic.
    is_last : bool
        Whether it acts along the last axis.
    """

    def __init__(
        self, whole: Factor, rows: tuple[int, int], columns: tuple[int, int], wraps: bool, is_last: bool
    ) -> None:
        row, column, values = _entries(whole, rows, wraps)
        inside = (column >= columns[0]) & (column < columns[1])
        entries = (values[inside], (row[inside], column[inside] - columns[0]))
        super().__init__(sp.csr_array(entries, shape=(rows[1] - rows[0], columns[1] - columns[0])))
        self._is_tridiagonal = whole.tridiagonal is not None
        self._has_diagonals = is_last and whole.rows.offsets.size > 0

    @cached_property
    def tridiagonal(self) -> Tridiagonal | None:
        """See `Factor`; None if the whole factor has none."""
        if self._is_tridiagonal:
            return super().tridiagonal
        return None

    @cached_property
    def rows(self) -> RowRecord:
        """See `Factor`; without diagonals where the whole factor is not applied by them."""
        record = super().rows
        if self._has_diagonals:
            return record
        none = np.zeros(0, np.int64)
        return record._replace(offsets=none, start=none, stop=none, values=np.zeros((0, 0)))
