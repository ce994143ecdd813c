"""The compiled loops as NumPy formulas of a few lines: their tests, and what runs without numba."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

__all__ = [
    "Rows",
    "Tridiagonal",
    "eliminate",
    "kronecker_sum",
    "product_along",
]


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


def kronecker_sum(u, out, axes, shift):
    """See `sparsedp.kernels.kronecker_sum`."""
    out[...] = shift * u
    for axis, line in enumerate(axes):
        if line is not None:
            field, total = np.moveaxis(u, axis, 0), np.moveaxis(out, axis, 0)
            lower, centre, upper = (band.reshape(-1, 1, 1) for band in line)
            total += centre * field
            total[1:] += lower[1:] * field[:-1]
            total[:-1] += upper[:-1] * field[1:]
            for end, band, other in ((0, lower, -1), (-1, upper, 0)):
                if band[end] != 0:  # else the far end must not be read: 0 times NaN is NaN
                    total[end] += band[end] * field[other]


def product_along(u, out, rows, scale, add):
    """See `sparsedp.kernels.along_axis`."""
    matrix = sp.csr_array((rows.data, rows.indices, rows.indptr), shape=(rows.rows, rows.cols))
    across = len(u), u.shape[2]
    flat = np.moveaxis(u, 1, 0).reshape(rows.cols, across[0] * across[1])
    product = np.moveaxis((scale * (matrix @ flat)).reshape(rows.rows, *across), 0, 1)
    np.copyto(out, out + product if add else product)


def eliminate(x, lower, upper, inverses):
    """See `sparsedp.kernels.sweep`."""
    for i, pivots in enumerate(inverses):
        x[i] = (x[i] - lower[i] * x[i - 1] if i else x[i]) * pivots
    for i in range(len(x) - 2, -1, -1):
        x[i] -= upper[i] * x[i + 1] * inverses[i]
