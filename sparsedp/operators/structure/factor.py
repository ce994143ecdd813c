"""Factor: a small sparse matrix along one axis. The only thing a catalogue operator defines."""

from functools import cached_property

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.reconstruction import Uncached
from sparsedp._utils.validation import check_finite
from sparsedp.errors import NonFiniteError
from sparsedp.kernels.reference import Rows, Tridiagonal
from sparsedp.operators.structure.base import rows_of

__all__ = ["Factor"]

MOST_DIAGONALS = 8  # more than this and the row form is at least as fast
TINY = 2.0**-1000  # products below this would lose digits to underflow


class Factor(Uncached):
    """A 1-D matrix. Frozen; products and sums give new ones.

    Parameters
    ----------
    matrix : sparse matrix or array, shape (rows, columns)
        Real and finite.
    """

    def __init__(self, matrix):
        matrix = sp.csr_array(matrix, dtype=float)
        matrix.sum_duplicates()
        matrix.eliminate_zeros()
        matrix.sort_indices()
        check_finite("coefficients on a grid", matrix.data, advice="; its spacing is too small, rescale its lengths")
        self.matrix = matrix

    @classmethod
    def from_diagonals(cls, shape, *diagonals):
        """Triples (rows, columns, values) of index arrays -> Factor."""
        rows, columns, values = (np.concatenate(part) for part in zip(*diagonals, strict=True))
        return cls(sp.coo_array((values, (rows, columns)), shape=shape))

    @property
    def shape(self):
        return self.matrix.shape

    @cached_property
    def T(self):
        turned = Factor(self.matrix.T)
        turned.__dict__["T"] = self
        return turned

    def __matmul__(self, other):
        product = Factor(self.matrix @ other.matrix)
        mine, theirs = self.largest, other.largest
        if mine > 0 and theirs > 0 and mine * theirs < TINY:
            raise NonFiniteError("coefficients underflow: the spacing is too large; rescale the lengths of the grid")
        return product

    def __add__(self, other):
        return Factor(self.matrix + other.matrix)

    def scaled(self, factor):
        """factor * matrix."""
        return self if factor == 1 else Factor(self.matrix * factor)

    @cached_property
    def largest(self):
        """Largest magnitude of an entry."""
        return float(np.max(np.abs(self.matrix.data), initial=0.0))

    @cached_property
    def key(self):
        """Content: equal factors have equal keys."""
        m = self.matrix
        return m.shape, m.indptr.tobytes(), m.indices.tobytes(), m.data.tobytes()

    @cached_property
    def rows(self):
        """The record that the kernels read (see kernels/reference.py)."""
        m, row = self.matrix, rows_of(self.matrix)
        offsets, first, diagonal = np.unique(m.indices - row, return_index=True, return_inverse=True)
        start, stop = row[first], np.zeros(offsets.size, np.int64)
        np.maximum.at(stop, diagonal, row + 1)
        few = offsets.size if offsets.size <= MOST_DIAGONALS else 0
        values = np.zeros((few, m.shape[0]))
        if few:
            values[diagonal, row] = m.data
        lists = m.indptr.astype(np.int64), m.indices.astype(np.int64), m.data
        return Rows(m.shape[0], m.shape[1], *lists, offsets[:few], start[:few], stop[:few], values)

    @cached_property
    def tridiagonal(self):
        """The three-point record of the fused kernel, or None when a row reaches further."""
        (n, columns), m, row = self.shape, self.matrix, rows_of(self.matrix)
        offset = (m.indices - row) % max(n, 1)
        if n != columns or np.any((offset > 1) & (offset < n - 1)):
            return None
        bands = np.zeros((3, n))
        # With one or two cells the neighbours coincide: what is not centre counts as upper, then lower.
        bands[np.where(offset > 1, 0, offset + 1), row] = m.data
        return Tridiagonal(*bands)
