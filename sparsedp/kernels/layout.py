"""Plain records of arrays that the kernels read, and words for what they do. No classes with behaviour."""

from typing import NamedTuple

import numpy as np

__all__ = ["CHUNK", "LOWERED", "REMAINDER", "TOTALS", "Rows", "Tridiagonal"]

CHUNK = 4096  # numbers whose sums are kept apart
TOTALS, LOWERED, REMAINDER = range(3)  # what is done on the way over an array that is summed up


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
    """

    lower: np.ndarray  # float64, n
    centre: np.ndarray  # float64, n
    upper: np.ndarray  # float64, n
