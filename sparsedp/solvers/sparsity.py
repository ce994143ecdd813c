"""The pattern of a matrix that only acts, found with few products.

The columns are cut into blocks of equal width, 8 at first, halved until one column is left. On every
level it is known which rows each block may touch: those of the block it was cut from. Blocks that share
no such row are probed together, by one product with random numbers on their columns; a row belongs to a
block when its product is not exactly 0. A matrix with a few entries in each row needs a few products
for each of log2(n) levels.

A derivative may be 0 at one point and not at another (upwind differences, max). So each product is
taken at every point given, and the pattern is the union: an entry that is not 0 on a share s of all
points is missed with probability (1 - s)^points; random numbers cancel with probability 0.
"""

import numpy as np
import scipy.sparse as sp

from sparsedp.solvers.colouring import colour

__all__ = ["dense_pattern", "find_pattern", "pattern_of"]

FIRST = 8  # blocks of the first level
SAMPLE = 3  # columns that are looked at first
ONE_BY_ONE = 2000  # up to this many columns a product for each is still worth the colours it may find


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


def dense_pattern(rows, columns):
    """The pattern without zeros."""
    return sp.csr_array(np.ones((rows, columns)))
