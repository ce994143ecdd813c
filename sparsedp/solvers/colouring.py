"""Colouring: columns that share no row get one colour, and one product with A serves all columns of a colour.

Two ways, and the better one is taken. On a grid the colour (a . i) mod c of the column with index i, for
a lattice vector a, is valid when no difference of two columns in a row is a multiple of c; stencils reach
the least count this way (3 for three points, 5 for five, 7 for seven). Any other pattern is coloured by
independent sets, one after the other.

Source: Curtis, Powell and Reid, On the estimation of sparse Jacobian matrices, 1974; Luby, A simple
parallel algorithm for the maximal independent set problem, 1986.
"""

from itertools import islice
from itertools import product as combinations

import numpy as np
import scipy.sparse as sp

__all__ = ["Coloured", "colour"]

MOST_DIFFERENCES = 4096  # a pattern with more is not a stencil
SMALL = 20_000  # up to this many columns independent sets are tried even if a lattice is near the best
MOST_TRIALS = 2_000_000  # products of a lattice vector and a difference, for each count


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
        row = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
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
        found = _fewer(found, _independent_sets(links))
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
    row = np.repeat(np.arange(links.shape[0]), np.diff(links.indptr))
    upper = links.indices > row
    steps = [b - a for a, b in zip(np.unravel_index(row[upper], shape), np.unravel_index(links.indices[upper], shape))]
    code = np.zeros(np.count_nonzero(upper), np.int64)
    for step, n in zip(steps, shape):
        code = code * (2 * n) + (step + n)
    _, first = np.unique(code, return_index=True)
    return np.stack([step[first] for step in steps]) if first.size <= MOST_DIFFERENCES else None


def _independent_sets(links):
    """Colour after colour, a maximal set of columns without links, grown from random priorities."""
    size = links.shape[0]
    priority = np.random.default_rng(0).permutation(size) + size * np.diff(links.indptr).astype(float)
    colours, number = np.full(size, -1), 0
    while np.any(colours < 0):
        left = np.flatnonzero(colours < 0)
        part = links[left][:, left]
        colours[left[_independent(part, priority[left])]] = number
        number += 1
    return colours


def _independent(links, priority):
    """A maximal set of vertices without links, every one of which is linked to itself."""
    free, chosen = np.ones(priority.size, dtype=bool), np.zeros(priority.size, dtype=bool)
    while free.any():
        weight = np.where(free, priority, -1.0)
        best = np.maximum.reduceat(weight[links.indices], links.indptr[:-1])
        fresh = free & (weight == best)
        chosen |= fresh
        free &= ~((links @ fresh.astype(np.int32)) > 0)
    return chosen
