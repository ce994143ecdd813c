"""NumPy twin of `measures`: sums over flat arrays on the way over them, in pieces that stay in cache."""

import numpy as np

from sparsedp.kernels.layout import LOWERED, SQUARES, TOTALS

__all__ = ["measure"]

SMALL, LARGE = 8192, 65536  # numbers for which BLAS takes no threads (they would stall compiled teams); L2


def measure(mode, b, x, number, out):
    """Flat float64 arrays -> two sums: see `totals`, `lowered` and `remainder` in `sparsedp.kernels`."""
    first = second = 0.0
    for start in range(0, x.size, LARGE):
        here = slice(start, start + LARGE)
        part, last = x[here], x[here]
        if mode == LOWERED:
            last = np.subtract(part, number, out=out[here])
        elif mode == TOTALS:
            first += part.sum()
        elif mode != SQUARES:
            last = np.subtract(b[here], out[here], out=out[here])
            first += _square(part)
        second += _square(last)
    return first, second


def _square(x):
    with np.errstate(over="ignore"):  # as the compiled twin: the caller sees inf, or did not ask for the sum
        return sum(part.dot(part) for part in (x[start : start + SMALL] for start in range(0, x.size, SMALL)))
