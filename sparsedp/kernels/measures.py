"""Compiled sums over flat arrays, fused with the pass that makes the array: one look at memory, not three.

Each chunk of the array leaves its own sums, added up at the end: the bits do not depend on the
number of threads. Within a chunk the sums may be taken in any order, so that they fill the lanes.
"""

from numba import njit, prange, types

from sparsedp.kernels.layout import CHUNK, LOWERED, REMAINDER

__all__ = ["SIGNATURE", "run"]

_REORDER = {"reassoc", "contract", "nsz"}  # NaN and infinity must stay what they are
_inner = njit(error_model="numpy", fastmath=_REORDER, no_cpython_wrapper=True, no_cfunc_wrapper=True)


@_inner
def _totals(x):
    total = squares = 0.0
    for i in range(x.size):
        total += x[i]
        squares += x[i] * x[i]
    return total, squares


@_inner
def _lowered(x, number, out):
    squares = 0.0
    for i in range(x.size):
        out[i] = x[i] - number
        squares += out[i] * out[i]
    return 0.0, squares


@_inner
def _lowered_here(out, number):
    """For the compiler, which would not fill the lanes for fear that two arrays overlap."""
    squares = 0.0
    for i in range(out.size):
        out[i] -= number
        squares += out[i] * out[i]
    return 0.0, squares


@_inner
def _remainder(b, x, out):
    others = squares = 0.0
    for i in range(x.size):
        out[i] = b[i] - out[i]
        others += x[i] * x[i]
        squares += out[i] * out[i]
    return others, squares


@_inner
def _piece(mode, b, x, number, out, sums, chunk):
    start, stop = chunk * CHUNK, min(x.size, (chunk + 1) * CHUNK)
    if mode == REMAINDER:
        found = _remainder(b[start:stop], x[start:stop], out[start:stop])
    elif mode == LOWERED and x.ctypes.data == out.ctypes.data:
        found = _lowered_here(out[start:stop], number)
    elif mode == LOWERED:
        found = _lowered(x[start:stop], number, out[start:stop])
    else:
        found = _totals(x[start:stop])
    sums[0, chunk], sums[1, chunk] = found


def _constant(dimensions):
    return types.Array(types.float64, dimensions, "C", readonly=True)


SIGNATURE = types.UniTuple(types.float64, 2)(
    types.int64,
    _constant(1),
    _constant(1),
    types.float64,
    types.Array(types.float64, 1, "C"),
    types.Array(types.float64, 2, "C"),
    types.int64,
)


def run(mode, b, x, number, out, sums, parts):
    """One pass: TOTALS of x, x^2; LOWERED out = x - number, of out^2; REMAINDER out = b - out, of x^2 and out^2."""
    chunks = sums.shape[1]
    if parts == 1:
        for chunk in range(chunks):
            _piece(mode, b, x, number, out, sums, chunk)
    else:
        for part in prange(parts):
            member = types.int64(part)
            for chunk in range(chunks * member // parts, chunks * (member + 1) // parts):
                _piece(mode, b, x, number, out, sums, chunk)
    first = second = 0.0
    for chunk in range(chunks):
        first += sums[0, chunk]
        second += sums[1, chunk]
    return first, second
