"""Compiled elimination along the first axis: tridiagonal systems, bounded or cyclic, one in each column."""

from sparsedp.kernels.team import kernel

__all__ = ["eliminate"]

BAND = 32768  # numbers of a band of columns that is worked on at a time: solution and pivots stay in the L2 cache


@kernel("write2 read1 read1 read2 read2 read2 index1")
def eliminate(x, lower, upper, inverses, column, row, ends, start, stop):
    """Down the rows and up again, in place, for the columns from `start` to `stop`; see `sparsedp.kernels.sweep`."""
    n, cyclic = x.shape[0], 1 if row.size else 0
    width = max(32, BAND // n)
    for left in range(start, stop, width):
        right = min(left + width, stop)
        filled = ends[left:right].max()
        final = x[n - 1, left:right]
        for i in range(n - cyclic):
            here, pivots, low = x[i, left:right], inverses[i, left:right], lower[i] if i else 0.0
            before = x[max(i - 1, 0), left:right]
            for j in range(here.size):
                here[j] = (here[j] - low * before[j]) * pivots[j]
            if cyclic and (i < filled or i == n - 2):
                links = row[i, left:right]
                for j in range(here.size):
                    final[j] -= links[j] * here[j]
        if cyclic:
            pivots = inverses[n - 1, left:right]
            for j in range(final.size):
                final[j] *= pivots[j]
        for i in range(n - 2, -1, -1):
            here, pivots, after = x[i, left:right], inverses[i, left:right], x[i + 1, left:right]
            high = upper[i] if i < n - 1 - cyclic else 0.0
            for j in range(here.size):
                here[j] -= high * after[j] * pivots[j]
            if cyclic and (i < filled or i == n - 2):
                links = column[i, left:right]
                for j in range(here.size):
                    here[j] -= links[j] * final[j] * pivots[j]
