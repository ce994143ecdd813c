"""Sparsity patterns of matrices that are known by their products, and their assembly from few products.

Notes
-----
**Pattern.** The columns are divided into blocks of equal width, 8 at first, which are halved until each holds one
column. On every level the rows that a block can reach are among those of the block it was cut from. Blocks without a
common row are probed together, by one product with random numbers on their columns; a block reaches a row if the
product there is not exactly 0. A matrix with a few entries in each row needs a few products for each of log2(n)
levels.

A derivative may be 0 at one point and not at another (upwind differences, max). So each product is taken at several
points, and the pattern is the union. An entry that is not 0 on a share s of all points is missed with probability
(1 - s)^points; random numbers cancel with probability 0.

On a grid fewer products suffice for a guess: the neighbours of a few cells, repeated over the whole grid. The caller
verifies it.

**Colouring.** Columns without a common row get one colour, and one product serves all columns of a colour. On a grid
the colour (a . i) mod c of the column with index i, whose first component is the number of its field, is valid for a
lattice vector a if no a . d is a multiple of c, for all differences d of two columns in one row. Stencils reach the
smallest possible c this way (3 for three points, 5 for five, 7 for seven); velocity and pressure together nearly (13
where a row has 11 entries). Where it takes twice as many, the columns are coloured one by one.

References
----------
A. R. Curtis, M. J. D. Powell, J. K. Reid, On the estimation of sparse Jacobian matrices, IMA J. Appl. Math. 13 (1974)
117-119.
"""

from __future__ import annotations

from itertools import islice
from itertools import product as combinations
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp.operators.structure.base import compact, rows_of
from sparsedp.solvers.algebraic_multigrid import colour_graph

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    Product = Callable[[NDArray[Any]], NDArray[Any]]
    Shapes = Sequence[tuple[int, ...]]

__all__ = [
    "LARGEST_STENCIL",
    "ColouredPattern",
    "colour_columns",
    "dense_pattern",
    "field_indices",
    "find_lattice",
    "find_pattern",
    "pattern_like",
    "pattern_of",
    "probe_positions",
    "stencil_entries",
    "stencil_pattern",
    "stencil_steps",
]

FIRST_BLOCKS = 8  # number of blocks on the first level
SAMPLED_COLUMNS = 3  # columns that are looked at first
ONE_BY_ONE_UP_TO = 2000  # columns: a product for each may still be worth the colours that it finds
SHORT_AXIS = 8  # an axis of at most this length counts kinds of values, such as two species, and not places
STENCIL_FROM = 256  # unknowns below which a guess saves nothing
LARGEST_STENCIL = 64  # cells that a value may reach; more are not a stencil
COLUMNS_AT_ONCE = 2**16  # whose links are computed at once
MOST_DIFFERENCES = 4096  # a pattern with more is not a stencil
MOST_TRIALS = 2_000_000  # products of a lattice vector and a difference, for each number of colours


def find_pattern(products: Sequence[Product], rows: int, columns: int) -> sp.csr_array | None:
    """Find the sparsity pattern of a matrix by products.

    Parameters
    ----------
    products : sequence of callables
        ``product(v)`` returns A v, each with the matrix at another point.
    rows, columns : int

    Returns
    -------
    csr_array of ones, or None
        None if sampled columns are full, or if blocks save nothing (more than columns / 2 products are needed) and
        there are more than `ONE_BY_ONE_UP_TO` columns.
    """
    rng = np.random.default_rng(0)
    if _has_full_columns(products[0], rows, columns, rng):
        return None
    width = 1 << max(0, int(columns - 1).bit_length() - FIRST_BLOCKS.bit_length() + 1)
    pattern = dense_pattern(rows, -(-columns // width))  # of blocks
    product_count = 0
    while True:
        colours = colour_columns(pattern)
        product_count += _count_of(colours)
        if product_count > max(columns // 2, 2 * FIRST_BLOCKS):
            if columns > ONE_BY_ONE_UP_TO:
                return None
            pattern = dense_pattern(rows, columns)
            width = 1
            colours = np.arange(columns)
        column_colours = np.repeat(colours, width)[:columns]
        is_reached = _rows_reached(products, column_colours, rows, rng)
        row = rows_of(pattern)
        block = pattern.indices
        keep = is_reached[colours[block], row]
        pattern = pattern_of(row[keep], block[keep], pattern.shape)
        if width == 1:
            return pattern
        width //= 2
        pattern = sp.kron(pattern, np.ones((1, 2)), format="csr")[:, : -(-columns // width)]


def _has_full_columns(product, rows, columns, rng):
    """Whether each of a few columns has more than a quarter of all entries: then blocks save nothing."""
    if columns < 8 * FIRST_BLOCKS:
        return False
    for column in rng.choice(columns, SAMPLED_COLUMNS, replace=False):
        unit_vector = np.eye(1, columns, column)[0]
        if np.count_nonzero(product(unit_vector)) <= rows / 4:
            return False
    return True


def _count_of(colours):
    return int(colours.max(initial=-1)) + 1


def _rows_reached(products, colours, rows, rng):
    """Return for each colour and row whether the columns of the colour reach the row at any of the points."""
    is_reached = np.zeros((_count_of(colours), rows), dtype=bool)
    for number in range(is_reached.shape[0]):
        for product in products:
            v = np.where(colours == number, rng.uniform(0.5, 1.5, colours.size), 0.0)
            is_reached[number] |= product(v) != 0
    return is_reached


def pattern_of(row: NDArray[Any], column: NDArray[Any], shape: tuple[int, int]) -> sp.csr_array:
    """Return a csr_array with a one at each of the places, which may be repeated."""
    pattern = compact(sp.coo_array((np.ones(row.size, np.int8), (row, column)), shape=shape))
    pattern.data = np.ones(pattern.nnz)
    return pattern


def pattern_like(matrix: Any) -> sp.csr_array:
    """Return the pattern of a sparse matrix or a 2-D array; a stored 0 is an entry."""
    entries = sp.coo_array(matrix)
    return pattern_of(entries.row, entries.col, entries.shape)


def dense_pattern(rows: int, columns: int) -> sp.csr_array:
    """Return the pattern without zeros."""
    return sp.csr_array(np.ones((rows, columns)))


# ---------------------------------------------------------------- stencils


def stencil_pattern(products: Sequence[Product], shapes: Shapes) -> sp.csr_array | None:
    """Guess the pattern of a matrix that acts as a stencil on fields.

    Parameters
    ----------
    products : sequence of callables
        ``product(v)`` returns A v, flat, each with the matrix at another point.
    shapes : sequence of tuples of int
        Shapes of the fields, one after the other, of rows and of columns. All have the same dimension: cells, or the
        faces across each axis.

    Returns
    -------
    csr_array of ones, or None
        None if the fields are small, or if a value reaches more than `LARGEST_STENCIL` others.
    """
    index = field_indices(shapes)
    lengths = np.max(index, axis=1, initial=0) + 1
    is_spatial = lengths > SHORT_AXIS  # the other axes, and the number of the field, count kinds of values
    is_spatial[0] = False
    kind = np.unique(index[~is_spatial], axis=1, return_inverse=True)[1].reshape(-1)
    kinds = np.max(kind, initial=0) + 1
    if not is_spatial.any() or not products or kind.size < STENCIL_FROM or kinds > SHORT_AXIS:
        return None
    position = index[is_spatial]
    axis_lengths = lengths[is_spatial, None]
    unknown_at = np.zeros((kinds, *axis_lengths[:, 0]), int)
    unknown_at[(kind, *position)] = np.arange(kind.size)
    ends = [np.max(position[:, kind == one], axis=1, keepdims=True) + 1 for one in range(kinds)]
    steps = set()
    is_periodic = np.zeros(axis_lengths.shape, dtype=bool)
    rng = np.random.default_rng(0)
    for one, product, probed in probe_positions(ends, products):
        v = np.zeros(kind.size)
        v[unknown_at[(one, *probed)]] = rng.uniform(0.5, 1.5) * rng.choice((-1.0, 1.0))
        row = np.flatnonzero(product(v))
        if row.size > LARGEST_STENCIL:
            return None
        new_steps, crosses_ends = stencil_steps(one, probed, kind[row], position[:, row], axis_lengths, True)
        is_periodic |= crosses_ends
        steps |= new_steps
    rows = [np.empty(0, int)]
    columns = [np.empty(0, int)]
    for row, one, column_position in stencil_entries(steps, kind, position, ends, is_periodic):
        rows.append(row)
        columns.append(unknown_at[(one, *column_position)])
    return pattern_of(np.concatenate(rows), np.concatenate(columns), (kind.size, kind.size))


def probe_positions(ends: Sequence[NDArray[Any]], products: Sequence[Any]) -> Iterator[tuple[int, Any, NDArray[Any]]]:
    """Iterate over the values to probe for a stencil: the first, the middle and the last of each kind.

    Parameters
    ----------
    ends : sequence of int arrays, shape (axes, 1)
        For each kind of values the lengths of its axes.
    products : sequence

    Yields
    ------
    kind : int
    product : one of the products
    position : int array, shape (axes, 1)
    """
    for (kind, end), product, place in combinations(enumerate(ends), products, (0, 1, 2)):
        if np.all(end):
            yield kind, product, (0 * end, end // 2, end - 1)[place]


def stencil_steps(
    kind: int,
    position: NDArray[Any],
    row_kinds: NDArray[Any],
    row_positions: NDArray[Any],
    lengths: NDArray[Any],
    periodic: NDArray[Any] | bool,
) -> tuple[set[tuple[int, ...]], NDArray[Any]]:
    """List the steps from one value to those that its column reaches.

    Parameters
    ----------
    kind, position : int, int array of shape (axes, 1)
        Of the value that was probed.
    row_kinds, row_positions : int arrays, shape (rows,) and (axes, rows)
        Of the values where its image is not 0.
    lengths : int array, shape (axes, 1)
        Of the axes.
    periodic : bool array, shape (axes, 1), or bool
        Whether a step may cross the ends of an axis; then the shorter way is taken.

    Returns
    -------
    steps : set of tuples of int
        (kind, kind of the row, cells from the column to the row along each axis).
    crosses_ends : bool array, shape (axes, 1)
        Whether a step crosses the ends of an axis.
    """
    direct = row_positions - position
    shortest = np.where(periodic, (direct + lengths // 2) % lengths - lengths // 2, direct)
    steps = {(kind, *step) for step in np.vstack([row_kinds, shortest]).T.tolist()}
    return steps, np.any(shortest != direct, axis=1, keepdims=True)


def stencil_entries(
    steps: set[tuple[int, ...]],
    kind: NDArray[Any],
    position: NDArray[Any],
    ends: Sequence[NDArray[Any]],
    periodic: NDArray[Any],
) -> Iterator[tuple[NDArray[Any], int, NDArray[Any]]]:
    """Iterate over the steps of a stencil, with the entries of each.

    Parameters
    ----------
    steps : set of tuples of int
        As `stencil_steps` returns them.
    kind, position : int arrays, shape (rows,) and (axes, rows)
    ends : sequence of int arrays, shape (axes, 1)
        For each kind of values the lengths of its axes.
    periodic : bool array, shape (axes, 1)

    Yields
    ------
    rows : int array
        The rows that have an entry for this step.
    kind : int
        Of its columns.
    positions : int array, shape (axes, rows)
        Of its columns.
    """
    for column_kind, row_kind, *step in sorted(steps):
        row = np.flatnonzero(kind == row_kind)
        column_position = position[:, row] - np.reshape(step, (-1, 1))
        end = ends[column_kind]
        column_position = np.where(periodic, column_position % np.maximum(end, 1), column_position)
        is_inside = np.all((column_position >= 0) & (column_position < end), axis=0)
        yield row[is_inside], column_kind, column_position[:, is_inside]


# ---------------------------------------------------------------- colours


class ColouredPattern:
    """A sparsity pattern with colours: the matrix from one product for each colour.

    Parameters
    ----------
    pattern : csr_array
    shapes : sequence of tuples of int, optional
        Shapes of the fields that rows and columns belong to, one after the other, of one dimension. Default: one line.
    by_rows : bool or None
        Whether rows are coloured and the products are A^T v. None: by rows, unless that takes more than twice as many
        colours (a column is full, for example), because one tape serves all products with A^T, while each product
        with A takes a run of its own.

    Attributes
    ----------
    by_rows : bool
    count : int
        Number of colours, and of products for one matrix.
    seeds : int array
        The colour of each entry of the vectors that are multiplied.

    Examples
    --------
    >>> A = np.diag([2.0, 2.0, 2.0, 2.0]) - np.diag([1.0, 1.0, 1.0], 1)
    >>> coloured = ColouredPattern(sp.csr_array(A))
    >>> coloured.count
    2
    >>> np.array_equal(coloured.matrix(lambda v: A @ v).toarray(), A)
    True
    """

    def __init__(self, pattern: sp.csr_array, shapes: Shapes | None = None, by_rows: bool | None = False) -> None:
        if by_rows is None:
            # The number of colours is about the number of entries of the fullest row; by rows, of the fullest column.
            fullest_column = np.bincount(pattern.indices).max(initial=0)
            fullest_row = np.diff(pattern.indptr).max(initial=0)
            by_rows = fullest_column <= 2 * fullest_row
        self.by_rows = bool(by_rows)
        self.shapes = shapes
        self.seeds = colour_columns(pattern.T.tocsr() if by_rows else pattern, shapes)
        self.count = _count_of(self.seeds)
        self._set_pattern(pattern, self.seeds)

    def _set_pattern(self, pattern, colours):
        """Store the pattern, and where each of its entries stands in the table of products (colour, row)."""
        # Ones of one byte, and short indices: large patterns are kept beside their matrices.
        ones = np.ones(pattern.nnz, dtype=np.int8)
        self.pattern = sp.csr_array((ones, pattern.indices, pattern.indptr), shape=pattern.shape)
        colours = colours.astype(np.min_scalar_type(_count_of(colours)))
        if self.by_rows:
            self._entry_colours = colours[rows_of(pattern)]
        else:
            self._entry_colours = colours[pattern.indices]

    def matrix(self, product: Product) -> sp.csr_array:
        """Return A on the pattern, given the function of products A v, or A^T v if `by_rows`."""
        table = np.empty((self.count, self.pattern.shape[int(self.by_rows)]))
        for number in range(self.count):
            table[number] = product((self.seeds == number).astype(float))
        if self.by_rows:
            entries = table[self._entry_colours, self.pattern.indices]
        else:
            entries = table[self._entry_colours, rows_of(self.pattern)]
        return sp.csr_array((entries, self.pattern.indices, self.pattern.indptr), shape=self.pattern.shape)

    def acts_as(self, product: Product, tolerance: float) -> bool:
        """Whether the matrix on the pattern gives the product along a random direction, to a relative tolerance."""
        matrix = self.matrix(product)
        if self.by_rows:
            matrix = matrix.T
        v = np.random.default_rng(1).uniform(0.5, 1.5, self.pattern.shape[0])
        return not np.any(np.abs(matrix @ v - product(v)) > tolerance * (abs(matrix) @ v))


def colour_columns(pattern: sp.csr_array, shapes: Shapes | None = None) -> NDArray[Any]:
    """Give each column of a pattern a colour, such that columns of one colour have no common row.

    Parameters
    ----------
    pattern : csr_array
    shapes : sequence of tuples of int, optional
        Shapes of the fields that the columns belong to: see `ColouredPattern`.

    Returns
    -------
    int array, shape (columns,)
    """
    size = pattern.shape[1]
    fullest_row = int(np.diff(pattern.indptr).max(initial=min(size, 1)))
    if fullest_row >= size:
        return np.arange(size)
    ones = sp.csr_array(pattern.astype(np.int32))
    colours = _colour_by_lattice(ones, field_indices(shapes or [(size,)]), fullest_row)
    if colours.max() < 2 * fullest_row:
        return colours
    links = sp.csr_array(ones.T @ ones + sp.eye_array(size, dtype=np.int32))  # every column is linked to itself
    return min(colours, colour_graph(links), key=np.max)


def field_indices(shapes: Shapes, starts: Sequence[Sequence[int]] | None = None) -> NDArray[Any]:
    """Return for each value of several fields the number of its field and its index there.

    Parameters
    ----------
    shapes : sequence of tuples of int
        Shapes of the fields, one after the other, of one dimension; or of blocks of them.
    starts : sequence of tuples of int, optional
        The index of the first value of each block. Default: zeros.

    Returns
    -------
    int array, shape (1 + dim, values)
    """
    if starts is None:
        starts = [(0,) * len(shape) for shape in shapes]
    indices = []
    for shape, start in zip(shapes, starts, strict=True):
        index = np.indices(shape).reshape(len(shape), prod(shape))
        indices.append(index + np.reshape(start, (-1, 1)))
    field_number = np.repeat(np.arange(len(indices)), [index.shape[1] for index in indices])
    return np.vstack([field_number, np.hstack(indices)])


def _colour_by_lattice(ones, index, fullest_row):
    """Return (a . i) mod c with the smallest valid c for columns with the given indices, or a colour for each."""
    differences = _index_differences(ones, index)
    if differences is not None:
        lattice = find_lattice(differences, fullest_row, 3 * fullest_row + 8)
        if lattice is not None:
            vector, count = lattice
            return (vector @ index) % count
    return np.arange(ones.shape[1])


def find_lattice(differences: NDArray[Any], smallest: int, end: int) -> tuple[NDArray[Any], int] | None:
    """Find a lattice vector a and the smallest number c of colours with which (a . i) mod c is a colouring.

    Parameters
    ----------
    differences : int array, shape (axes, many)
        Differences of the indices of two columns in one row.
    smallest, end : int
        The range of c, without its end.

    Returns
    -------
    (vector, count) or None
    """
    is_varied = np.any(differences, axis=1)  # axes along which columns differ
    is_varied[-1] = True
    vector = np.zeros(len(differences), int)
    differences = differences[is_varied]
    free_components = len(differences) - 1  # the last component is 1
    for count in range(smallest, end):
        trials = min(count**free_components, MOST_TRIALS // max(differences.shape[1], 1))
        candidates = islice(combinations(range(count), repeat=free_components), trials)
        vectors = np.array([(*components[::-1], 1) for components in candidates])
        is_valid = np.all((vectors @ differences) % count != 0, axis=1)
        if is_valid.any():
            vector[is_varied] = vectors[np.argmax(is_valid)]
            return vector, count
    return None


def _index_differences(ones, index):
    """Return the different index differences of columns with a common row, shape (axes, many); None if too many.

    Of two opposite differences one is returned.
    """
    extent = np.max(index, axis=1, keepdims=True) + 1
    # Differences are numbered in a box of twice the extent, whose middle is the difference 0.
    box = tuple(2 * extent[:, 0])
    middle = np.ravel_multi_index(tuple(extent[:, 0]), box)
    number = np.ravel_multi_index(tuple(index), box)
    occurs = np.zeros(prod(box), dtype=bool)
    by_columns = ones.T.tocsr()
    for first in range(0, ones.shape[1], COLUMNS_AT_ONCE):  # all links of a flow in 3-D at once take gigabytes
        links = sp.csr_array(by_columns[first : first + COLUMNS_AT_ONCE] @ ones)
        column = rows_of(links) + first
        is_upper = links.indices > column
        occurs[number[links.indices[is_upper]] - number[column[is_upper]] + middle] = True
    numbers = np.flatnonzero(occurs)
    if numbers.size > MOST_DIFFERENCES:
        return None
    return np.array(np.unravel_index(numbers, box)) - extent
