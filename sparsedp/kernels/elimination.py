"""Compiled elimination along the first axis: tridiagonal systems, one in each column."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sparsedp.kernels.team import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["eliminate"]

BAND = 32768  # number of values in a band of columns: its solution and pivots stay in the L2 cache


@kernel("write2 read1 read1 read2")
def eliminate(x: NDArray, lower: NDArray, upper: NDArray, inverses: NDArray, start: int, stop: int) -> None:
    """Forward elimination and back substitution in columns `start` to `stop`; see `sparsedp.kernels.sweep`."""
    n = x.shape[0]
    width = max(32, BAND // n)
    for left in range(start, stop, width):
        right = min(left + width, stop)
        for i in range(n):
            row = x[i, left:right]
            pivots = inverses[i, left:right]
            if i:
                low = lower[i]
            else:
                low = 0.0
            row_above = x[max(i - 1, 0), left:right]
            for j in range(row.size):
                row[j] = (row[j] - low * row_above[j]) * pivots[j]
        for i in range(n - 2, -1, -1):
            row = x[i, left:right]
            pivots = inverses[i, left:right]
            row_below = x[i + 1, left:right]
            for j in range(row.size):
                row[j] -= upper[i] * row_below[j] * pivots[j]
