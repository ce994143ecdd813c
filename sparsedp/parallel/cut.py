"""How a linear map that is defined once, for the whole grid, acts on the blocks of the ranks.

Every rank has the whole definition, and cuts out the rows of its own block:

    y[block] = A[block, reach] x[reach],        x[reach] by one exchange.

The transpose is the transposed map, cut in the same way: it gathers too, so nothing is added up across ranks, and
the bits of the result do not depend on how many there are.
"""

from functools import partial
from math import prod

import numpy as np
import scipy.sparse as sp

from sparsedp.parallel.exchange import of_boxes, of_entries
from sparsedp.parallel.partition import lengths, slices
from sparsedp.solvers.choose_method import Solution
from sparsedp.solvers.nullspace import Projector
from sparsedp.space import components
from sparsedp.structure.base import Matrix, Structure, rows_of
from sparsedp.structure.factor import Factor
from sparsedp.structure.kronecker import Kronecker, Term
from sparsedp.structure.lazy import Chain, Diagonal, Mask, Sum

__all__ = ["Entries", "Rows", "OnBlocks", "between", "localized"]


def localized(structure, given, made):
    """Structure of whole fields -> Structure of blocks.

    Parameters
    ----------
    structure : Structure
    given, made : (layout, parts) or None
        Where the field and the result lie; None: every rank has all of it.

    Raises
    ------
    TypeError
        If the structure cannot be cut.
    """
    if isinstance(structure, Kronecker) and given and made and _fits(structure, given[1], made[1]):
        return Rows(structure, given[0], made[0])
    if isinstance(structure, Diagonal) and given:
        take = partial(given[0].take, parts=given[1])
        given[0].tell(structure.values)
        values = take(structure.values)
        return Mask(take(structure.keep), values) if isinstance(structure, Mask) else Diagonal(values)
    if isinstance(structure, Chain):
        sides = between(structure.members, given, made)
        return Chain([localized(m, b, a) for m, a, b in zip(structure.members, sides, sides[1:])])
    if isinstance(structure, Sum):
        return Sum([localized(member, given, made) for member in structure.members])
    if isinstance(structure, (Solution, Projector)):
        return OnBlocks(structure, given[0].size(given[1]))
    if isinstance(structure, (Kronecker, Matrix)):
        return Entries(structure.explicit(), given, made)
    if isinstance(structure, Diagonal):
        return structure
    raise TypeError(
        f"{getattr(structure, 'name', type(structure).__name__)} cannot be cut for ranks, for no rank knows its rows; "
        "make it of operators of the grid or of a matrix"
    )


def _fits(structure, given, made):
    """Whether it is defined on these components: else it counts flat, as one from a space without a grid."""
    return structure.in_parts == tuple(given) and structure.out_parts == tuple(made)


def between(members, given, made):
    """The sides of the members of a product from left to right: where neither knows, every rank has all of it."""
    layout = (given or made)[0]
    sides = [made, *[None] * (len(members) - 1), given]
    known = lambda parts: (layout, parts) if len(parts[0]) == len(layout.shape) else None
    for place in range(len(members) - 1, 0, -1):
        left, right = members[place - 1], members[place]
        if isinstance(right, (Diagonal, Projector)):
            sides[place] = sides[place + 1]
        elif isinstance(right, Kronecker):
            sides[place] = known(right.out_parts)
        elif isinstance(right, Solution):
            sides[place] = right.solver.system.side
        elif isinstance(left, Kronecker):
            sides[place] = known(left.in_parts)
    for place, member in enumerate(members[:-1]):
        if isinstance(member, (Diagonal, Projector)):
            sides[place + 1] = sides[place]
    return sides


# ---- products of 1-D factors ----


class Rows(Structure):
    """The rows of a Kronecker structure that make the blocks of this rank."""

    takes_complex = False

    def __init__(self, structure, given, made):
        own = [made.box(part) for part in structure.out_parts]
        out, reach = _boxes(structure, own, given.periodic)
        self.exchange, self.cut = of_boxes(given, structure.in_parts, reach), _Cut(structure, given, out, reach)
        self.shape = sum(map(prod, map(lengths, own))), self.exchange.roots
        self.windows = [slices(inner, wide) for inner, wide in zip(own, out)]

    def entries(self):
        """The rows as a csr_array; its columns are what the exchange brings."""
        numbers = components(np.arange(self.cut.shape[0]), self.cut.out_parts)
        blocks = [part[window].reshape(-1) for part, window in zip(numbers, self.windows)]
        return self.cut.explicit()[np.concatenate(blocks)]

    def act(self, x, out):
        wide = components(self.cut.product(self.exchange.forward(x)), self.cut.out_parts)
        blocks = [part[window] for part, window in zip(wide, self.windows)]
        for block, target in zip(blocks, components(out, [block.shape for block in blocks])):
            target[...] = block


class _Cut(Kronecker):
    """A Kronecker structure between boxes: the same arithmetic in the same order, wherever the boxes lie."""

    def __init__(self, structure, layout, out, reach):
        self.out_parts, self.in_parts = tuple(map(lengths, out)), tuple(map(lengths, reach))
        self.blocks = {
            (r, c): [
                Term(
                    term.scale,
                    tuple(
                        factor and _cut_factor(factor, rows, columns, wraps, prod(part[axis + 1 :]) == 1)
                        for axis, (factor, rows, columns, wraps) in enumerate(
                            zip(term.factors, out[r], reach[c], layout.periodic)
                        )
                    ),
                )
                for term in terms
            ]
            for (r, c), terms in structure.blocks.items()
            for part in [structure.in_parts[c]]
        }
        self.shape = sum(map(prod, self.out_parts)), sum(map(prod, self.in_parts))


def _boxes(structure, own, periodic):
    """Boxes of the result to compute, and boxes of the field that they read.

    Where a term has no factor along an axis, both have the same side there. What is computed beyond the block itself is
    not complete, and left out.
    """
    out: list = [list(box) for box in own]
    reach: list = [[None] * len(part) for part in structure.in_parts]
    same = []
    for (r, c), terms in structure.blocks.items():
        if not prod(lengths(own[r])):
            continue
        for term in terms:
            for axis, factor in enumerate(term.factors):
                if factor is None:
                    same.append((axis, out[r], reach[c]))
                else:
                    columns = _entries(factor, own[r][axis], periodic[axis])[1]
                    side = (int(columns.min()), int(columns.max()) + 1) if columns.size else None
                    reach[c][axis] = _around(reach[c][axis], side)
        last, n = len(own[r]) - 1, structure.in_parts[c][-1]
        if len(terms) > 1 and all(term.factors[-1] is None for term in terms):
            # One pass adds up the ends of a row in another order: no end but that of the grid may be in the block.
            low, high = own[r][last][0] - 1, own[r][last][1] + 1
            reach[c][last] = _around(reach[c][last], (low, high) if periodic[last] else (max(low, 0), min(high, n)))
    before = None
    while before != (out, reach):
        before = [list(box) for box in out], [list(box) for box in reach]
        for axis, one, other in same:
            one[axis] = other[axis] = _around(one[axis], other[axis])
    return [tuple(box) for box in out], [tuple(side or (0, 0) for side in box) for box in reach]


def _around(one, other):
    """The smallest side around two; None and empty ones do not count."""
    if not one or one[0] == one[1]:
        return other or one
    if not other or other[0] == other[1]:
        return one
    return min(one[0], other[0]), max(one[1], other[1])


def _entries(factor, side, wraps):
    """Rows and columns of the entries in some rows of a factor, and their values; unbroken on a periodic axis."""
    (n, columns), rows = factor.shape, np.arange(*side)
    matrix = factor.matrix[rows % max(n, 1)]
    row = rows_of(matrix)
    column = matrix.indices.astype(np.int64)
    if wraps and columns:
        near = (rows[row] + 0.5) * (columns / n) - 0.5
        column = column + columns * np.rint((near - column) / columns).astype(np.int64)
    return row, column, matrix.data


def _cut_factor(factor, rows, columns, wraps, along):
    """Some rows and columns of a factor. It takes the loops that the whole one takes: others round in another way."""
    row, column, data = _entries(factor, rows, wraps)
    inside = (column >= columns[0]) & (column < columns[1])
    entries = data[inside], (row[inside], column[inside] - columns[0])
    found = Factor(sp.csr_array(entries, shape=(rows[1] - rows[0], columns[1] - columns[0])))
    whole_row, whole_column, _ = _entries(factor, (0, factor.shape[0]), wraps)
    if factor.shape[0] != factor.shape[1] or np.any(np.abs(whole_column - whole_row) > 1):
        vars(found)["tridiagonal"] = None
    if not (along and factor.rows.offsets.size):
        none = np.zeros(0, np.int64)
        vars(found)["rows"] = found.rows._replace(offsets=none, start=none, stop=none, values=np.zeros((0, 0)))
    return found


# ---- solves and matrices ----


class OnBlocks(Structure):
    """What acts on blocks as it is: a solve on ranks, a projection of its data."""

    def __init__(self, whole, size):
        self.apply, self.shape = whole.apply, (size, size)  # type: ignore[method-assign]


class Entries(Structure):
    """The rows of a matrix that make the blocks of this rank, or all rows where every rank has the result."""

    def __init__(self, matrix, given, made):
        self.dtype = matrix.dtype
        (given or made)[0].tell(matrix.data)
        rows = np.arange(matrix.shape[0])
        matrix = matrix[made[0].take(rows, made[1])] if made else matrix
        self.read, columns = (lambda x: x), matrix.shape[1]
        if given:
            layout, parts = given
            entries, place = np.unique(matrix.indices, return_inverse=True)
            exchange = of_entries(layout, parts, entries.astype(np.int64))
            held = matrix.data, place.reshape(-1), matrix.indptr
            matrix = sp.csr_array(held, shape=(matrix.shape[0], entries.size))
            self.read, columns = exchange.forward, exchange.roots
        self.matrix, self.shape = matrix, (matrix.shape[0], columns)

    def act(self, x, out):
        out[...] = self.matrix @ self.read(x)
