"""Restriction of a linear map, defined once for the whole grid, to the blocks of the ranks.

Every rank has the whole definition, and cuts out the rows of its own block:

    y[block] = A[block, reach] x[reach],        x[reach] by one exchange.

The transpose is the transposed map, cut in the same way: it gathers too, so nothing is added up across ranks, and
the bits of the result do not depend on how many there are.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import scipy.sparse as sp

from sparsedp.grid.space import components
from sparsedp.operators.structure.base import Matrix, Structure, Turning, rows_of
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term
from sparsedp.operators.structure.lazy import Chain, Diagonal, Mask, Sum
from sparsedp.parallel.exchange import Exchange, of_boxes
from sparsedp.parallel.partition import lengths, slices
from sparsedp.solvers.inverse import Solution
from sparsedp.solvers.nullspace import Projector

__all__ = ["Columns", "OwnRows", "Rows", "localized", "reads"]


NOTHING = np.iinfo(int).max  # as an end of a side: there is none


def localized(structure: Any, given: Any, made: Any) -> Any:
    """Return the structure on blocks of a structure on whole fields.

    Parameters
    ----------
    structure : Structure
    given, made : (layout, parts) or None
        Where the field and the result are stored; None: every rank has all of it.

    Raises
    ------
    TypeError
        If the structure cannot be cut.
    """
    if isinstance(structure, Chain):
        sides = _between(structure.members, given, made)
        return Chain([localized(m, b, a) for m, a, b in zip(structure.members, sides, sides[1:])])
    if isinstance(structure, Sum):
        return Sum([localized(member, given, made) for member in structure.members])
    if isinstance(structure, Diagonal):
        if given:
            return _of_diagonal(structure, *given)
        return structure
    shape = tuple(side[0].size(side[1]) if side else n for side, n in zip((made, given), structure.shape))
    if isinstance(structure, OwnRows):
        return structure.inner[structure.transposed]
    if isinstance(structure, (Solution, Projector)):
        return OnBlocks(structure, shape)
    if isinstance(structure, Kronecker) and given and made:
        if (structure.in_parts, structure.out_parts) == (tuple(given[1]), tuple(made[1])):
            return _of_factors(structure, shape, given[0], made[0])
    if isinstance(structure, (Kronecker, Matrix)):  # of other components: it counts flat
        return _of_matrix(structure.explicit(), shape, given, made)
    raise TypeError(
        f"{getattr(structure, 'name', type(structure).__name__)} cannot be cut for ranks, for no rank knows its rows; "
        "make it of operators of the grid or of a matrix"
    )


def _between(members, given, made):
    """Return the sides of the members of a product, left to right; an unknown side is held whole by every rank."""
    layout = (given or made)[0]
    sides = [made, *[None] * (len(members) - 1), given]

    def side(member, parts, beyond):
        if isinstance(member, (Diagonal, Projector)):
            return beyond
        if isinstance(member, Solution):
            return member.solver.system.side
        found = getattr(member, parts, ((),))
        if len(found[0]) == len(layout.shape):
            return layout, found
        return None

    for place in range(len(members) - 1, 0, -1):
        left, right = members[place - 1 : place + 1]
        sides[place] = side(right, "out_parts", sides[place + 1]) or side(left, "in_parts", None)
    for place, member in enumerate(members[:-1]):
        if isinstance(member, (Diagonal, Projector)):
            sides[place + 1] = sides[place]
    return sides


class OnBlocks(Structure):
    """What acts on blocks as it is: a solve on ranks, a projection of its data."""

    def __init__(self, whole: Any, shape: tuple) -> None:
        self.whole = whole
        self.shape = shape

    def apply(self, x: Any, out: Any) -> None:
        self.whole.apply(x, out)

    def explicit(self) -> None:
        raise _no_matrix(self.whole)


def _no_matrix(structure):
    name = type(structure).__name__
    return TypeError(f"{name} has no matrix on ranks; invert a sum or product of operators")


class Rows(Structure):
    """The rows that make the blocks of this rank: windows of what a structure makes of the numbers that are read.

    Parameters
    ----------
    inner : Structure
    shape : (rows, columns), of blocks
    read : function or None
        Flat block -> what `inner` takes. None: every rank has all of it.
    windows : list, one for each component of what `inner` makes
    """

    def __init__(self, inner: Any, shape: tuple, read: Any, windows: Any = (...,)) -> None:
        self.inner = inner
        self.shape = shape
        self.read = read
        self.windows = windows
        self.parts = getattr(inner, "out_parts", (inner.shape[:1],))
        self.dtype = inner.dtype
        self.takes_complex = inner.takes_complex

    def act(self, x: Any, out: Any) -> None:
        """Write the product with x into `out`."""
        if self.read:
            x = self.read(x)
        blocks = self._own(self.inner.product(x))
        for block, target in zip(blocks, components(out, [block.shape for block in blocks])):
            target[...] = block

    def _own(self, wide):
        return [part[window] for part, window in zip(components(wide, self.parts), self.windows)]

    def explicit(self) -> Any:
        """Return the rows as a csr_array; its columns are the entries that are read."""
        if self.read is None:
            raise _no_matrix(self.inner)
        blocks = self._own(np.arange(self.inner.shape[0]))
        return self.inner.explicit()[np.concatenate([block.reshape(-1) for block in blocks])]

    def magnitude(self) -> Any:
        """Return the structure of the absolute values of the entries."""
        entries = abs(self.explicit())
        return lambda x: entries @ self.read(x)


def _of_diagonal(structure, layout, parts):
    layout.tell(structure.values)
    values = layout.take(structure.values, parts)
    return Mask(layout.take(structure.keep, parts), values) if isinstance(structure, Mask) else Diagonal(values)


def _of_matrix(matrix, shape, given, made):
    """Return the rows of a matrix that make the blocks of this rank, or all rows where every rank has the result."""
    (given or made)[0].tell(matrix.data)
    if made:
        matrix = matrix[made[0].take(np.arange(matrix.shape[0]), made[1])]
    if not given:
        return Rows(Matrix(matrix), shape, None)
    places, exchange = reads(matrix.indices, *given)
    inner = sp.csr_array((matrix.data, places, matrix.indptr), shape=(matrix.shape[0], exchange.read[0]))
    return Rows(Matrix(inner), shape, exchange.forward)


def reads(entries: np.ndarray, layout: Any, parts: Any) -> Any:
    """Return the Exchange that reads some entries of a whole field, and the place of each entry in its result."""
    entries, places = np.unique(entries, return_inverse=True)
    return places.reshape(-1), Exchange(layout, parts, entries.size, np.arange(entries.size), entries)


class OwnRows(Turning):
    """A square matrix of which each rank holds only the rows of its own block.

    `inner`: Rows; Columns, which send what the rows make to whom it belongs, where it is added; and the Stencil.
    """

    stencil = property(lambda self: self.inner[2])


class Columns(Structure):
    """The transpose of Rows: what a structure makes of a block is sent back to where they read it."""

    def __init__(self, inner: Any, shape: tuple, back: Any) -> None:
        self.inner = inner
        self.shape = shape
        self.back = back

    def act(self, x: Any, out: Any) -> None:
        """Write the product with x into `out`."""
        out[...] = self.back(self.inner.product(x))

    def magnitude(self) -> Any:
        """Return the structure of the absolute values of the entries."""
        entries = abs(self.inner.explicit())
        return lambda x: self.back(entries @ x)


# ---- products of 1-D factors ----


def _of_factors(structure, shape, layout, there):
    """Return the rows of a Kronecker structure for the blocks of this rank on the layout `there`, by one exchange."""
    own = [there.box(part) for part in structure.out_parts]
    out, reach = _boxes(structure, own, layout.periodic)
    read = of_boxes(layout, structure.in_parts, reach).forward
    windows = [slices(inner, wide) for inner, wide in zip(own, out)]
    return Rows(_Cut(structure, layout.periodic, out, reach), shape, read, windows)


class _Cut(Kronecker):
    """A Kronecker structure between boxes: the same arithmetic in the same order, wherever the boxes lie."""

    def __init__(self, structure, periodic, out, reach):
        self.out_parts, self.in_parts = tuple(map(lengths, out)), tuple(map(lengths, reach))
        self.shape = (sum(map(prod, self.out_parts)), sum(map(prod, self.in_parts)))
        self.blocks = {}
        for (r, c), terms in structure.blocks.items():
            sides = list(zip(out[r], reach[c], periodic, [*[False] * (len(periodic) - 1), True]))
            self.blocks[r, c] = tuple(
                Term(term.scale, tuple(f and _cut_factor(f, *side) for f, side in zip(term.factors, sides)))
                for term in terms
            )


def _boxes(structure, own, periodic):
    """Boxes of the result to compute, and boxes of the field that they read.

    Where a term has no factor along an axis, both have the same side there. What is computed beyond the block itself is
    not complete, and left out.
    """
    # A side from a to b is held as (a, -b): then the minimum of several is the side around all of them.
    out = np.array([[(a, -b) for a, b in box] for box in own])
    reach = np.full((len(structure.in_parts), len(periodic), 2), NOTHING)
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
    for _ in range(len(out) + len(reach)):
        for c, r, axis in same:
            out[r, axis] = reach[c, axis] = np.minimum(out[r, axis], reach[c, axis])
    sides = [np.where(side == NOTHING, 0, side).tolist() for side in (out, reach)]
    return [[tuple((a, -b) for a, b in box) for box in side] for side in sides]


def _entries(factor, side, wraps):
    """Return rows, columns and values of the entries in some rows of a factor, contiguous on a periodic axis."""
    (n, columns), rows = factor.shape, np.arange(*side)
    matrix = factor.matrix[rows % max(n, 1)]
    row = rows_of(matrix)
    column = matrix.indices.astype(np.int64)
    if wraps and columns:
        near = (rows[row] + 0.5) * (columns / n) - 0.5
        column = column + columns * np.rint((near - column) / columns).astype(np.int64)
    return row, column, matrix.data


def _cut_factor(factor, rows, columns, wraps, last):
    """Return some rows and columns of a factor. It uses the loops of the whole factor, so that rounding is the same."""
    row, column, data = _entries(factor, rows, wraps)
    inside = (column >= columns[0]) & (column < columns[1])
    entries = data[inside], (row[inside], column[inside] - columns[0])
    found = Factor(sp.csr_array(entries, shape=(rows[1] - rows[0], columns[1] - columns[0])))
    if factor.tridiagonal is None:
        vars(found)["tridiagonal"] = None
    if not (last and factor.rows.offsets.size):
        none = np.zeros(0, np.int64)
        vars(found)["rows"] = found.rows._replace(offsets=none, start=none, stop=none, values=np.zeros((0, 0)))
    return found
