"""Factor: a sparse matrix that is applied along one axis. Grid operators are Kronecker products of factors."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.base_classes import Uncached
from sparsedp._utils.validation import check_finite
from sparsedp.errors import NonFiniteError
from sparsedp.kernels.reference import Rows, Tridiagonal
from sparsedp.operators.structure.base import rows_of

__all__ = ["Factor"]

MOST_DIAGONALS = 8  # a matrix with more diagonals is applied row by row, which is then at least as fast
TINY = 2.0**-1000  # products of factors below this would lose digits by underflow


class Factor(Uncached):
    """An immutable sparse matrix that is applied along one axis of a field.

    Parameters
    ----------
    matrix : sparse matrix or array, shape (rows, columns)
        Real and finite.
    """

    def __init__(self, matrix: Any) -> None:
        matrix = sp.csr_array(matrix, dtype=float)
        matrix.sum_duplicates()
        matrix.eliminate_zeros()
        matrix.sort_indices()
        check_finite("coefficients on a grid", matrix.data, advice="; its spacing is too small, rescale its lengths")
        self.matrix = matrix

    @classmethod
    def from_diagonals(cls, shape: tuple[int, int], *diagonals: tuple) -> Factor:
        """Return the Factor with the given entries: each argument is a triple of arrays (rows, columns, values)."""
        rows = np.concatenate([diagonal[0] for diagonal in diagonals])
        columns = np.concatenate([diagonal[1] for diagonal in diagonals])
        values = np.concatenate([diagonal[2] for diagonal in diagonals])
        return cls(sp.coo_array((values, (rows, columns)), shape=shape))

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.matrix.shape

    @cached_property
    def T(self) -> Factor:
        """The transpose."""
        transposed = Factor(self.matrix.T)
        transposed.__dict__["T"] = self
        return transposed

    def __matmul__(self, other: Factor) -> Factor:
        product = Factor(self.matrix @ other.matrix)
        if self.largest > 0 and other.largest > 0 and self.largest * other.largest < TINY:
            raise NonFiniteError("coefficients underflow: the spacing is too large; rescale the lengths of the grid")
        return product

    def __add__(self, other: Factor) -> Factor:
        return Factor(self.matrix + other.matrix)

    def scaled(self, factor: float) -> Factor:
        """Return factor * matrix."""
        if factor == 1:
            return self
        return Factor(self.matrix * factor)

    @cached_property
    def largest(self) -> float:
        """Largest magnitude of an entry."""
        return float(np.max(np.abs(self.matrix.data), initial=0.0))

    @cached_property
    def key(self) -> tuple:
        """A hashable value for comparisons: equal factors have equal keys."""
        matrix = self.matrix
        return matrix.shape, matrix.indptr.tobytes(), matrix.indices.tobytes(), matrix.data.tobytes()

    @cached_property
    def rows(self) -> Rows:
        """The entries in the format of the kernels: see kernels/reference.py."""
        matrix = self.matrix
        row = rows_of(matrix)
        offsets, first, diagonal = np.unique(matrix.indices - row, return_index=True, return_inverse=True)
        start = row[first]
        stop = np.zeros(offsets.size, np.int64)
        np.maximum.at(stop, diagonal, row + 1)
        count = offsets.size
        if count > MOST_DIAGONALS:
            count = 0
        values = np.zeros((count, matrix.shape[0]))
        if count:
            values[diagonal, row] = matrix.data
        return Rows(
            matrix.shape[0],
            matrix.shape[1],
            matrix.indptr.astype(np.int64),
            matrix.indices.astype(np.int64),
            matrix.data,
            offsets[:count],
            start[:count],
            stop[:count],
            values,
        )

    @cached_property
    def tridiagonal(self) -> Tridiagonal | None:
        """The entries in the format of the fused kernel, or None if the factor is not (periodic) tridiagonal."""
        n, columns = self.shape
        matrix = self.matrix
        row = rows_of(matrix)
        offset = (matrix.indices - row) % max(n, 1)
        if n != columns or np.any((offset > 1) & (offset < n - 1)):
            return None
        bands = np.zeros((3, n))
        # With two cells, the lower and the upper neighbour are the same cell, and its entry counts as the upper one.
        bands[np.where(offset > 1, 0, offset + 1), row] = matrix.data
        return Tridiagonal(*bands)
