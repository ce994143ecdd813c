"""NumPy implementations of compiled loops: the reference for their tests, and the fallback without numba."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.sparse as sp

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = [
    "Rows",
    "Tridiagonal",
    "eliminate",
    "kronecker_sum",
    "product_along",
]


class Rows(NamedTuple):
    """A sparse matrix of shape (rows, cols), stored twice: by rows and by diagonals.

    By rows (CSR): entries of row i are `data[indptr[i]:indptr[i + 1]]` at columns `indices[...]`.
    By diagonals: `out[i] += values[d, i] * u[i + offsets[d]]` for `start[d] <= i < stop[d]`.
    Each diagonal is contiguous, because with an (n, 3) array the loop is half as fast. If a matrix has too many
    diagonals, `offsets` is empty, and the matrix is stored only by rows.
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
    """A square matrix whose row i has entries only in the columns i - 1, i and i + 1 (cyclic).

    Row i of the product is `lower[i] u[i - 1] + centre[i] u[i] + upper[i] u[i + 1]`, indices modulo n.
    If `lower[0]` or `upper[-1]` is 0, the value at the other end must not be read, because 0 * NaN is NaN.
    """

    lower: np.ndarray  # float64, n
    centre: np.ndarray  # float64, n
    upper: np.ndarray  # float64, n


def kronecker_sum(u: NDArray, out: NDArray, axes: Sequence[Tridiagonal | None], shift: float) -> None:
    """Set out = shift u + sum over a of T_a u; see `sparsedp.kernels.summed`."""
    out[...] = shift * u
    for axis, line in enumerate(axes):
        if line is None:
            continue
        field = np.moveaxis(u, axis, 0)
        total = np.moveaxis(out, axis, 0)
        lower, centre, upper = (band.reshape(-1, 1, 1) for band in line)
        total += centre * field
        total[1:] += lower[1:] * field[:-1]
        total[:-1] += upper[:-1] * field[1:]
        for end, band, far_end in ((0, lower, -1), (-1, upper, 0)):
            if band[end] != 0:  # if it is 0, the other end must not be read, as it may be NaN
                total[end] += band[end] * field[far_end]


def product_along(u: NDArray, out: NDArray, rows: Rows, scale: float, accumulate: bool) -> None:
    """Set `out` to scale M u, or add scale M u to it; see `sparsedp.kernels.along_axis`."""
    matrix = sp.csr_array((rows.data, rows.indices, rows.indptr), shape=(rows.rows, rows.cols))
    other_axes = (len(u), u.shape[2])
    flat = np.moveaxis(u, 1, 0).reshape(rows.cols, other_axes[0] * other_axes[1])
    product = np.moveaxis((scale * (matrix @ flat)).reshape(rows.rows, *other_axes), 0, 1)
    np.copyto(out, out + product if accumulate else product)


def eliminate(x: NDArray, lower: NDArray, upper: NDArray, inverses: NDArray) -> None:
    """Solve tridiagonal systems in place; see `sparsedp.kernels.sweep`."""
    for i, pivots in enumerate(inverses):
        if i:
            x[i] = (x[i] - lower[i] * x[i - 1]) * pivots
        else:
            x[i] = x[i] * pivots
    for i in range(len(x) - 2, -1, -1):
        x[i] -= upper[i] * x[i + 1] * inverses[i]
