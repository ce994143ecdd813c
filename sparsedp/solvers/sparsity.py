"""Sparse Jacobians from products: where their entries are, and which columns one product serves together.

**The pattern of a matrix that only acts**, found with few products.

The columns are cut into blocks of equal width, 8 at first, halved until one column is left. On every
level it is known which rows each block may touch: those of the block it was cut from. Blocks that share
no such row are probed together, by one product with random numbers on their columns; a row belongs to a
block when its product is not exactly 0. A matrix with a few entries in each row needs a few products
for each of log2(n) levels.

A derivative may be 0 at one point and not at another (upwind differences, max). So each product is
taken at every point given, and the pattern is the union: an entry that is not 0 on a share s of all
points is missed with probability (1 - s)^points; random numbers cancel with probability 0.

A guess at the pattern on a grid takes fewer: what a few cells touch, moved over the whole grid. The caller checks it.

**Colouring**: columns that share no row get one colour, and one product with A serves all columns of a colour.

Two ways. On a grid the colour (a . i) mod c of the column with index i, the number of its
field first, for a lattice vector a, is valid when no a . d is a multiple of c, d the differences of two columns in a
row; stencils reach the least count this way (3 for three points, 5 for five, 7 for seven), velocity and pressure
nearly: 13 where a row has 11 entries. Where it takes twice as many, columns are coloured one by one.

Source: Curtis, Powell and Reid, On the estimation of sparse Jacobian matrices, 1974.
"""

from itertools import islice
from itertools import product as combinations
from math import prod

import numpy as np
import scipy.sparse as sp

from sparsedp.operators.structure.base import rows_of
from sparsedp.solvers.amg import coloured_graph

__all__ = [
    "WIDEST", "Coloured", "colour", "dense_pattern", "entries_at", "find_pattern", "lattice", "pattern_like",
    "pattern_of", "places", "probes", "stencil_pattern", "steps_to",
]  # fmt: skip

FIRST = 8  # blocks of the first level
SAMPLE = 3  # columns that are looked at first
ONE_BY_ONE = 2000  # up to this many columns a product for each is still worth the colours it may find
SHORT = 8  # an axis that is not longer counts kinds of values, u and v of a reaction, and no places
SMALLEST = 256  # unknowns below which a guess saves nothing
WIDEST = 64  # cells touched by one; more is no stencil
MOST_DIFFERENCES = 4096  # a pattern with more is not a stencil
MOST_TRIALS = 2_000_000  # products of a lattice vector and a difference, for each count


def find_pattern(products, rows, columns):
    """Products with the same matrix at several points -> its pattern, or None when it is not sparse.

    Parameters
    ----------
    products : list of callables
        ``product(v) -> A v``, each with the matrix at another point.
    rows, columns : int

    Returns
    -------
    csr_array of ones, or None
        None when columns that were sampled are full, or when blocks save nothing (more than columns / 2
        products are needed) and there are more than ONE_BY_ONE columns.
    """
    rng = np.random.default_rng(0)
    if _sampled_full(products[0], rows, columns, rng):
        return None
    width, spent = 1 << max(0, int(columns - 1).bit_length() - FIRST.bit_length() + 1), 0
    pattern = dense_pattern(rows, -(-columns // width))  # of blocks
    while True:
        colours = colour(pattern)
        spent += int(colours.max(initial=-1)) + 1
        if spent > max(columns // 2, 2 * FIRST):
            if columns > ONE_BY_ONE:
                return None
            pattern, width, colours = dense_pattern(rows, columns), 1, np.arange(columns)
        touched = _touched(products, np.repeat(colours, width)[:columns], rows, rng)
        row, block = rows_of(pattern), pattern.indices
        keep = touched[colours[block], row]
        pattern = pattern_of(row[keep], block[keep], pattern.shape)
        if width == 1:
            return pattern
        width //= 2
        pattern = sp.kron(pattern, np.ones((1, 2)), format="csr")[:, : -(-columns // width)]


def _sampled_full(product, rows, columns, rng):
    """Whether all of a few columns have more than a quarter of the entries: then no level can save."""
    if columns < 8 * FIRST:
        return False
    sample = rng.choice(columns, SAMPLE, replace=False)
    return min(np.count_nonzero(product(np.eye(1, columns, column)[0])) for column in sample) > rows / 4


def _touched(products, colours, rows, rng):
    """(colour, row) -> whether the columns of that colour reach the row at any of the points."""
    touched = np.zeros((int(colours.max(initial=-1)) + 1, rows), dtype=bool)
    for number in range(touched.shape[0]):
        for product in products:
            v = np.where(colours == number, rng.uniform(0.5, 1.5, colours.size), 0.0)
            touched[number] |= product(v) != 0
    return touched


def pattern_of(row, column, shape):
    """Places -> csr_array of ones, one for each different place."""
    pattern = sp.csr_array((np.ones(row.size, np.int8), (row, column)), shape=shape)
    pattern.sum_duplicates()
    pattern.sort_indices()
    pattern.data = np.ones(pattern.nnz)
    return pattern


def pattern_like(matrix):
    """Sparse matrix or 2-D array -> the pattern of its places; a stored 0 is one."""
    places = sp.coo_array(matrix)
    return pattern_of(places.row, places.col, places.shape)


def dense_pattern(rows, columns):
    """The pattern without zeros."""
    return sp.csr_array(np.ones((rows, columns)))


def stencil_pattern(products, shapes):
    """Products with one matrix at several points, on fields of these shapes -> csr_array of ones, or None.

    Parameters
    ----------
    products : list of callables
        ``product(v) -> A v``, flat.
    shapes : sequence of tuples of int
        Of the fields, one after the other, on both sides; of one dimension: cells, or faces across each axis.

    Returns
    -------
    csr_array or None
        None when the fields are small, or a cell touches too many.
    """
    index = places(shapes)
    lengths = np.max(index, axis=1, initial=0) + 1
    far = lengths > SHORT  # axes that count places; the others, and the fields, count kinds of values
    far[0] = False
    kind = np.unique(index[~far], axis=1, return_inverse=True)[1].reshape(-1)
    at, lengths, kinds = index[far], lengths[far, None], np.max(kind, initial=0) + 1
    if not far.any() or not products or kind.size < SMALLEST or kinds > SHORT:
        return None
    number = np.zeros((kinds, *lengths[:, 0]), int)
    number[(kind, *at)] = np.arange(kind.size)
    ends = [np.max(at[:, kind == one], axis=1, keepdims=True) + 1 for one in range(kinds)]
    steps, wraps, rng = set(), np.zeros(lengths.shape, dtype=bool), np.random.default_rng(0)
    for one, product, cell in probes(ends, products):
        v = np.zeros(kind.size)
        v[number[(one, *cell)]] = rng.uniform(0.5, 1.5) * rng.choice((-1.0, 1.0))
        row = np.flatnonzero(product(v))
        if row.size > WIDEST:
            return None
        found, round_ends = steps_to(one, cell, kind[row], at[:, row], lengths, True)
        wraps |= round_ends  # steps over an edge count where the field goes round
        steps |= found
    found = [(row, number[(one, *there)]) for row, one, there in entries_at(steps, kind, at, ends, wraps)]
    row, column = np.hstack([np.empty((2, 0), int), *found])
    return pattern_of(row, column, (kind.size,) * 2)


def probes(ends, products):
    """(kind, product, index) of the entries that tell of a stencil: the first, the middle and the last of each kind."""
    for (one, end), product, place in combinations(enumerate(ends), products, (0, 1, 2)):
        if np.all(end):
            yield one, product, (0 * end, end // 2, end - 1)[place]


def steps_to(one, cell, kind, at, lengths, around):
    """From an entry to those that it meets: (its kind, theirs, cells along each axis), and which axes they go round."""
    ways = at - cell
    steps = np.where(around, (ways + lengths // 2) % lengths - lengths // 2, ways)  # the short way
    found = {(one, *step) for step in np.vstack([kind, steps]).T.tolist()}
    return found, np.any(steps != ways, axis=1, keepdims=True)


def entries_at(steps, kind, at, ends, around):
    """Steps, kinds and indices of rows -> for each step the rows that have such an entry, kind and index of its column.

    `ends`: of the indices of each kind; `around`: whether an axis is periodic.
    """
    for one, other, *step in sorted(steps):
        row = np.flatnonzero(kind == other)
        there = at[:, row] - np.reshape(step, (-1, 1))
        there = np.where(around, there % np.maximum(ends[one], 1), there)
        inside = np.all((there >= 0) & (there < ends[one]), axis=0)
        yield row[inside], one, there[:, inside]


# ---------------------------------------------------------------- colours


class Coloured:
    """A pattern with colours: the matrix from as many products as there are colours.

    Parameters
    ----------
    pattern : csr_array
    shapes : sequence of tuples of int, optional
        Of the fields that rows and columns belong to, one after the other, of one dimension. Default: one line.
    by_rows : bool or None
        Whether rows are coloured and the products are A^T v. None: unless that takes more than twice as many (a column
        is full, say), for one tape serves all products with A^T, and each with A takes a run of its own.

    Attributes
    ----------
    by_rows : bool
    count : int
        Of colours: products that one matrix takes.
    seeds : int array
        The colour of each number that a product takes.

    Examples
    --------
    >>> A = np.diag([2.0, 2.0, 2.0, 2.0]) - np.diag([1.0, 1.0, 1.0], 1)
    >>> coloured = Coloured(sp.csr_array(A))
    >>> coloured.count
    2
    >>> np.array_equal(coloured.matrix(lambda v: A @ v).toarray(), A)
    True
    """

    def __init__(self, pattern, shapes=None, by_rows=False):
        if by_rows is None:  # there are as many colours as entries in the fullest row, or, by rows, column
            by_rows = np.bincount(pattern.indices).max(initial=0) <= 2 * np.diff(pattern.indptr).max(initial=0)
        self.by_rows = bool(by_rows)
        self.seeds = colour(pattern.T.tocsr() if by_rows else pattern, shapes)
        self.count = int(self.seeds.max(initial=-1)) + 1
        self._paint(pattern, self.seeds)

    def _paint(self, pattern, colours):
        self.pattern = pattern
        # Where each entry stands in the table of products: (colour of the column, row), or mirrored.
        row = rows_of(pattern)
        one, other = (row, pattern.indices) if self.by_rows else (pattern.indices, row)
        self._place = colours[one], other

    def matrix(self, product):
        """product(v) -> A v (A^T v when `by_rows`)  to  csr_array of A on the pattern."""
        table = np.empty((self.count, self.pattern.shape[int(self.by_rows)]))
        for number in range(self.count):
            table[number] = product((self.seeds == number).astype(float))
        return sp.csr_array((table[self._place], self.pattern.indices, self.pattern.indptr), shape=self.pattern.shape)

    def acts_as(self, product, share):
        """Whether that matrix gives the product along a random direction too, up to this share."""
        matrix, v = self.matrix(product), np.random.default_rng(1).uniform(0.5, 1.5, self.pattern.shape[0])
        matrix = matrix.T if self.by_rows else matrix
        return not np.any(np.abs(matrix @ v - product(v)) > share * (abs(matrix) @ v))


def colour(pattern, shapes=None):
    """Pattern -> a colour for each column; columns that share a row get different ones.

    Parameters
    ----------
    pattern : csr_array
    shapes : sequence of tuples of int, optional
        Of the fields that the columns belong to: see Coloured.

    Returns
    -------
    int array, shape (columns,)
    """
    size = pattern.shape[1]
    least = int(np.diff(pattern.indptr).max(initial=min(size, 1)))
    if least >= size:
        return np.arange(size)
    links = sp.csr_array(pattern.astype(np.int32))
    links = sp.csr_array(links.T @ links + sp.eye_array(size, dtype=np.int32))  # every column is linked to itself
    found = _lattice(links, places(shapes or [(size,)]), least)
    return found if found.max() < 2 * least else min(found, coloured_graph(links), key=np.max)


def places(shapes, starts=None):
    """Fields one after the other -> of each unknown the number of its field and its index there.

    `shapes`: of the fields, or of blocks that start at these indices.
    """
    starts = [(0,) * len(shape) for shape in shapes] if starts is None else starts
    lines = [
        np.indices(shape).reshape(len(shape), prod(shape)) + np.reshape(start, (-1, 1))
        for shape, start in zip(shapes, starts, strict=True)
    ]
    return np.vstack([np.repeat(np.arange(len(lines)), [line.shape[1] for line in lines]), np.hstack(lines)])


def _lattice(links, index, least):
    """(a . i) mod c with the smallest c that works, or a colour for each column; `index`: one row for each axis."""
    differences = _differences(links, index)
    found = None if differences is None else lattice(differences, least, 3 * least + 8)
    return np.arange(links.shape[0]) if found is None else (found[0] @ index) % found[1]


def lattice(differences, least, most):
    """Differences of the indices of columns in one row, an axis in each row -> (a, c) of the smallest c, or None."""
    apart = np.any(differences, axis=1)  # not axes of one place
    apart[-1], vector = True, np.zeros(len(differences), int)
    differences = differences[apart]
    free = len(differences) - 1
    for count in range(least, most):
        many = min(count**free, MOST_TRIALS // max(differences.shape[1], 1))
        tried = islice(combinations(range(count), repeat=free), many)
        vectors = np.array([(*a[::-1], 1) for a in tried])
        valid = np.all((vectors @ differences) % count != 0, axis=1)
        if valid.any():
            vector[apart] = vectors[np.argmax(valid)]
            return vector, count
    return None


def _differences(links, index):
    """Differences of the indices of linked columns, shape (axes, many), one of each pair; None when there are many."""
    row, reach = rows_of(links), np.max(index, axis=1, keepdims=True) + 1
    upper = links.indices > row
    number = np.ravel_multi_index(tuple(index), box := tuple(2 * reach[:, 0]))
    found = np.zeros(prod(box), dtype=bool)  # by their numbers in a box of twice the size, 0 in its middle
    found[number[links.indices[upper]] - number[row[upper]] + np.ravel_multi_index(tuple(reach[:, 0]), box)] = True
    found = np.flatnonzero(found)
    return np.array(np.unravel_index(found, box)) - reach if found.size <= MOST_DIFFERENCES else None
