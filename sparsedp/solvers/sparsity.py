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

Two ways, and the better one is taken. On a grid the colour (a . i) mod c of the column with index i, for
a lattice vector a, is valid when no difference of two columns in a row is a multiple of c; stencils reach
the least count this way (3 for three points, 5 for five, 7 for seven). Any other pattern is coloured column by column.

Source: Curtis, Powell and Reid, On the estimation of sparse Jacobian matrices, 1974.
"""

from itertools import islice
from itertools import product as combinations

import numpy as np
import scipy.sparse as sp

from sparsedp.structure.base import rows_of

__all__ = ["Coloured", "colour", "dense_pattern", "find_pattern", "pattern_like", "pattern_of", "stencil_pattern"]

FIRST = 8  # blocks of the first level
SAMPLE = 3  # columns that are looked at first
ONE_BY_ONE = 2000  # up to this many columns a product for each is still worth the colours it may find
SHORT = 8  # an axis that is not longer counts kinds of values, u and v of a reaction, and no places
SMALLEST = 256  # unknowns below which a guess saves nothing
WIDEST = 64  # cells touched by one; more is no stencil
MOST_DIFFERENCES = 4096  # a pattern with more is not a stencil
SMALL = 20_000  # up to this many columns they are coloured one by one even if a lattice is near the best
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
    width = 1 << max(0, int(columns - 1).bit_length() - FIRST.bit_length() + 1)
    blocks = -(-columns // width)
    block, row = (pairs.ravel() for pairs in np.indices((blocks, rows)))
    spent, colours = 0, np.arange(blocks)
    while True:
        spent += int(colours.max(initial=-1)) + 1
        if spent > max(columns // 2, 2 * FIRST):
            return _column_by_column(products, rows, columns, rng) if columns <= ONE_BY_ONE else None
        touched = _touched(products, np.repeat(colours, width)[:columns], rows, rng)
        keep = touched[colours[block], row]
        block, row = block[keep], row[keep]
        if width == 1:
            return pattern_of(row, block, (rows, columns))
        width //= 2
        block, row = np.concatenate([2 * block, 2 * block + 1]), np.concatenate([row, row])
        inside = block * width < columns
        block, row = block[inside], row[inside]
        colours = colour(pattern_of(row, block, (rows, -(-columns // width))))


def _sampled_full(product, rows, columns, rng):
    """Whether all of a few columns have more than a quarter of the entries: then no level can save."""
    if columns < 8 * FIRST:
        return False
    counts = []
    for column in rng.choice(columns, SAMPLE, replace=False):
        unit = np.zeros(columns)
        unit[column] = 1.0
        counts.append(np.count_nonzero(product(unit)))
    return min(counts) > rows / 4


def _column_by_column(products, rows, columns, rng):
    column, row = np.nonzero(_touched(products, np.arange(columns), rows, rng))
    return pattern_of(row, column, (rows, columns))


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


def stencil_pattern(products, shape):
    """Products with one matrix at several points, on fields of a shape -> csr_array of ones, or None.

    Parameters
    ----------
    products : list of callables
        ``product(v) -> A v``, flat.
    shape : tuple of int
        Of the fields on both sides.

    Returns
    -------
    csr_array or None
        None when the fields are small, or a cell touches too many.
    """
    places = [axis for axis, n in enumerate(shape) if n > SHORT]
    kinds = [axis for axis, n in enumerate(shape) if n <= SHORT]
    lengths, counts = [shape[axis] for axis in places], [shape[axis] for axis in kinds]
    if not places or not products or np.prod(shape) < SMALLEST or np.prod(counts) > SHORT:
        return None
    index = np.arange(np.prod(shape)).reshape(shape).transpose(kinds + places).reshape(-1, *lengths)
    rng = np.random.default_rng(0)
    touched = [_touched_by_cell(products, index, kind, rng) for kind in range(len(index))]
    if any(found is None for found in touched):
        return None
    wraps = np.any([around for _, around in touched], axis=0)
    columns, rows = zip(
        *(_moved(index, kind, move, wraps) for kind, (moves, _) in enumerate(touched) for move in moves)
    )
    return pattern_of(np.concatenate(rows), np.concatenate(columns), (index.size, index.size))


def _touched_by_cell(products, index, kind, rng):
    """What three cells of a kind touch: {(kind, steps along the places)}, and along which axes one went round."""
    lengths, moves, around = np.array(index.shape[1:]), set(), np.zeros(index.ndim - 1, dtype=bool)
    where = np.empty((index.size, index.ndim), dtype=int)
    where[index.reshape(-1)] = np.stack(np.unravel_index(np.arange(index.size), index.shape), axis=1)
    for product, cell in combinations(products, (0 * lengths, lengths // 2, lengths - 1)):
        v = np.zeros(index.size)
        v[index[(kind, *cell)]] = rng.uniform(0.5, 1.5) * rng.choice((-1.0, 1.0))
        hit = where[np.flatnonzero(product(v))]
        if len(hit) > WIDEST:
            return None
        steps = (hit[:, 1:] - cell + lengths // 2) % lengths - lengths // 2  # the short way
        around |= np.any(steps != hit[:, 1:] - cell, axis=0)
        moves |= set(map(tuple, np.column_stack([hit[:, :1], steps]).tolist()))
    return sorted(moves), around


def _moved(index, kind, move, wraps):
    """Columns and rows of one step from every cell; steps over an edge count where the field goes round."""
    other, *steps = move
    rows = np.roll(index[other], [-step for step in steps], tuple(range(len(steps))))
    inside = np.ones(rows.shape, dtype=bool)
    for axis, (step, round_) in enumerate(zip(steps, wraps)):
        to = np.arange(rows.shape[axis]) + step
        fits = round_ | ((to >= 0) & (to < rows.shape[axis]))
        inside &= fits.reshape([-1 if a == axis else 1 for a in range(rows.ndim)])
    return index[kind][inside], rows[inside]


# ---------------------------------------------------------------- colours


class Coloured:
    """A pattern with colours: the matrix from as many products as there are colours.

    Parameters
    ----------
    pattern : csr_array
    shape : tuple of int, optional
        Shape of the fields that rows and columns belong to, when it is a grid.

    Attributes
    ----------
    by_rows : bool
        Rows are coloured and the products are A^T v, because that takes fewer (one row is full, say).
    count : int

    Examples
    --------
    >>> A = np.diag([2.0, 2.0, 2.0, 2.0]) - np.diag([1.0, 1.0, 1.0], 1)
    >>> coloured = Coloured(sp.csr_array(A))
    >>> coloured.count
    2
    >>> np.array_equal(coloured.matrix(lambda v: A @ v).toarray(), A)
    True
    """

    def __init__(self, pattern, shape=None, by_rows=None):
        self.pattern, self.shape = pattern, shape
        self.by_rows = bool(by_rows)
        self.colours = colour(pattern.T.tocsr() if by_rows else pattern, shape)
        highest = np.bincount(pattern.indices, minlength=1).max(initial=0)
        if by_rows is None and self.count > 2 * highest:  # no colouring of rows needs less than the highest column
            turned = colour(pattern.T.tocsr(), shape)
            if turned.max(initial=-1) + 1 < self.count:
                self.by_rows, self.colours = True, turned
        # Where each entry stands in the table of products: (colour of the column, row), or mirrored.
        row = rows_of(pattern)
        one, other = (row, pattern.indices) if self.by_rows else (pattern.indices, row)
        self._place = self.colours[one], other

    @property
    def count(self):
        """Number of colours: of products that one matrix takes."""
        return int(self.colours.max(initial=-1)) + 1

    def matrix(self, product):
        """product(v) -> A v (A^T v when `by_rows`)  to  csr_array of A on the pattern."""
        table = np.empty((self.count, self.pattern.shape[int(self.by_rows)]))
        for number in range(self.count):
            table[number] = product((self.colours == number).astype(float))
        return sp.csr_array((table[self._place], self.pattern.indices, self.pattern.indptr), shape=self.pattern.shape)


def colour(pattern, shape=None):
    """Pattern -> a colour for each column; columns that share a row get different ones.

    Parameters
    ----------
    pattern : csr_array
    shape : tuple of int, optional
        The grid that the columns belong to, in C order.

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
    found = _lattice(links, (size,), least)
    if shape is not None and len(shape) > 1 and np.prod(shape) == size and (found is None or found.max() >= least):
        found = _fewer(found, _lattice(links, shape, least))
    if found is None or found.max() >= (least if size <= SMALL else 2 * least):
        found = _fewer(found, _one_by_one(links))
    return found


def _fewer(one, other):
    if one is None or other is None:
        return other if one is None else one
    return one if one.max() <= other.max() else other


def _lattice(links, shape, least):
    """(a . i) mod c with the smallest c that works, or None."""
    differences = _differences(links, shape)
    if differences is None:
        return None
    index = np.stack(np.unravel_index(np.arange(links.shape[0]), shape))
    for count in range(least, 3 * least + 8):
        many = min(count ** (len(shape) - 1), MOST_TRIALS // max(differences.shape[1], 1))
        tried = islice(combinations(range(count), repeat=len(shape) - 1), many)
        vectors = np.array([(*a[::-1], 1) for a in tried])
        valid = np.all((vectors @ differences) % count != 0, axis=1)
        if valid.any():
            return (vectors[np.argmax(valid)] @ index) % count
    return None


def _differences(links, shape):
    """Differences of the indices of linked columns, shape (dim, many), one of each pair; None when there are many."""
    row = rows_of(links)
    upper = links.indices > row
    steps = [b - a for a, b in zip(np.unravel_index(row[upper], shape), np.unravel_index(links.indices[upper], shape))]
    code = np.zeros(np.count_nonzero(upper), np.int64)
    for step, n in zip(steps, shape):
        code = code * (2 * n) + (step + n)
    _, first = np.unique(code, return_index=True)
    return np.stack([step[first] for step in steps]) if first.size <= MOST_DIFFERENCES else None


def _one_by_one(links):
    """The first colour that no linked column has yet, for the columns with most links first."""
    colours = np.full(links.shape[0], -1)
    for column in np.argsort(-np.diff(links.indptr), kind="stable"):
        taken = set(colours[links.indices[links.indptr[column] : links.indptr[column + 1]]].tolist())
        colours[column] = next(number for number in range(len(taken) + 1) if number not in taken)
    return colours
