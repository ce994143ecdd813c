"""Compiled elimination along the first axis: tridiagonal systems, one in each column."""

from sparsedp.kernels.team import kernel

__all__ = ["eliminate"]

BAND = 32768  # numbers of a band of columns that is worked on at a time: solution and pivots stay in the L2 cache


@kernel("write2 read1 read1 read2")
def eliminate(x, lower, upper, inverses, start, stop):
    """Down the rows and up again, in place, for the columns from `start` to `stop`; see `sparsedp.kernels.sweep`."""
    n = x.shape[0]
    width = max(32, BAND // n)
    for left in range(start, stop, width):
        right = min(left + width, stop)
        for i in range(n):
            here, pivots, low = x[i, left:right], inverses[i, left:right], lower[i] if i else 0.0
            before = x[max(i - 1, 0), left:right]
            for j in range(here.size):
                here[j] = (here[j] - low * before[j]) * pivots[j]
        for i in range(n - 2, -1, -1):
            here, pivots, after = x[i, left:right], inverses[i, left:right], x[i + 1, left:right]
            for j in range(here.size):
                here[j] -= upper[i] * after[j] * pivots[j]
