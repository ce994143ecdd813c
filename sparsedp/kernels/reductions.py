"""Compiled sums over flat arrays, fused with the pass that makes the array: memory is read once, not three times.

Each chunk leaves its own sums, added up at the end: the bits do not depend on the number of threads. Within a chunk
the sums may be taken in any order, so that they fill the vector units.
"""

from sparsedp.kernels.reference import CHUNK, LOWERED, TOTALS
from sparsedp.kernels.team import kernel

__all__ = ["measure"]


@kernel(
    "int read1 read1 real write1 write2", fastmath={"reassoc", "contract", "nsz"}
)  # NaN and infinity stay what they are
def measure(mode, b, x, number, out, sums, start, stop):
    """Two sums of each chunk. TOTALS: of x, x^2; LOWERED: out -= number, of out^2; REMAINDER: out = b - out,
    of x^2 and out^2."""
    for chunk in range(start, stop):
        low, high = chunk * CHUNK, (chunk + 1) * CHUNK
        first = second = 0.0
        if mode == LOWERED:
            part = out[low:high]
            for i in range(part.size):
                part[i] -= number
                second += part[i] * part[i]
        elif mode == TOTALS:
            part = x[low:high]
            for i in range(part.size):
                first += part[i]
                second += part[i] * part[i]
        else:
            rest, part, given = out[low:high], x[low:high], b[low:high]
            for i in range(part.size):
                rest[i] = given[i] - rest[i]
                first += part[i] * part[i]
                second += rest[i] * rest[i]
        sums[0, chunk], sums[1, chunk] = first, second
