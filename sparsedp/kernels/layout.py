"""Plain records of arrays that the kernels read. No classes with behaviour, no autograd."""

from typing import NamedTuple

import numpy as np

__all__ = ["CHUNK", "LOWERED", "REMAINDER", "SQUARES", "TOTALS", "Rows", "Tridiagonal"]

CHUNK = 4096  # numbers whose sums are kept apart, so that they do not depend on the number of threads
SQUARES, TOTALS, LOWERED, REMAINDER = range(4)  # what `measure` does on its way over an array


class Rows(NamedTuple):
    """A sparse 1-D matrix of `rows` x `cols`, stored twice: by rows and by diagonals.

    By rows (CSR): entries of row i are `data[indptr[i]:indptr[i + 1]]` at columns `indices[...]`.
    By diagonals: `out[i] += values[d, i] * u[i + offsets[d]]` for `start[d] <= i < stop[d]`.
    One contiguous array per diagonal, because an (n, 3) array halves the speed. When the matrix
    has too many diagonals to be worth it, `offsets` is empty and only the rows are there.
    """

    rows: int
    cols: int
    indptr: np.ndarray  # int64, rows + 1
    indices: np.ndarray  # int64
    data: np.ndarray  # float64
    offsets: np.ndarray  # int64, m
    start: np.ndarray  # int64, m
    stop: np.ndarray  # int64, m
    values: np.ndarray  # float64, (m, rows)


class Tridiagonal(NamedTuple):
    """A square 1-D matrix whose row i holds only columns i - 1, i, i + 1 (cyclic).

    Row i of the product is `lower[i] u[i - 1] + centre[i] u[i] + upper[i] u[i + 1]`, indices modulo n.
    Where `lower[0]` or `upper[-1]` is zero, the far end must not be read: 0 * NaN is NaN.
    Rows `first <= i < last` have identical coefficients (empty range when the grid is stretched).
    """

    lower: np.ndarray  # float64, n
    centre: np.ndarray  # float64, n
    upper: np.ndarray  # float64, n
    first: int
    last: int
