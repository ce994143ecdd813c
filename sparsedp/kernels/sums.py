"""Compiled sum of tridiagonal matrices along the axes of a field, in one pass over memory; the solve with one.

Arrays come as pointers. A field has `shape` (n0, n1, n2); n2 counts the numbers of a
row, two a cell when the field is complex. `span` is (near, half, first, last): distance of the
neighbours along the row (0: no matrix there), number of bits to shift a place right to get the
index of its coefficient, and the part of the row whose coefficients are constant.
"""

from numba import njit

from sparsedp.kernels.lanes import stencil
from sparsedp.kernels.pointers import claim, fence, get, pointer, put

__all__ = ["TILE", "share", "sum_worker", "sweep_worker"]

TILE = 16384  # numbers of a line handled at a time, so that neighbouring lines stay in cache
BAND = 32768  # numbers of a band of columns that is eliminated at a time: solution and pivots stay in L2
PLANE = 32768  # numbers of a plane handled at a time: three planes and the output fit in L2

_inner = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
_inlined = njit(error_model="numpy", inline="always")  # a compiled function is optimised again wherever it is called


@_inner
def share(n, most):
    """Size of equal pieces of n, none larger than `most`; long pieces are whole cache lines."""
    pieces = -(-n // most)
    size = -(-n // pieces)
    return size if size < 64 else min(n, -(-size // 16) * 16)


@_inner
def _ends(out, u, along, places, weights, near, half, n, start, stop):
    """Cells start <= j < stop at an end of their row: the neighbour may be at the other end."""
    lower, centre, upper, size = along
    row, before1, after1, before0, after0 = places
    base, b1, a1, b0, a0 = weights
    for j in range(start, stop):
        k = j >> half
        low, high = get(lower, k), get(upper, k)
        left, right = j - near, j + near
        if left < 0:
            left = left + n if low != 0.0 else j
        if right >= n:
            right = right - n if high != 0.0 else j
        total = (base + get(centre, k)) * get(u, row + j)
        total += low * get(u, row + left) + high * get(u, row + right)
        total += b1 * get(u, before1 + j) + a1 * get(u, after1 + j)
        if b0 != 0.0 or a0 != 0.0:
            total += b0 * get(u, before0 + j) + a0 * get(u, after0 + j)
        put(out, row + j, total)


@_inner
def _row(out, u, along, places, weights, span, n, start, stop, stream):
    """Cells start <= j < stop of a row: an end, then array, constant, array coefficients, an end."""
    near, half, first, last = span
    row, before1, after1, before0, after0 = places
    base, b1, a1, b0, a0 = weights
    head, tail = min(near, n), max(near, n - near)
    if start < head:
        _ends(out, u, along, places, weights, near, half, n, start, min(head, stop))
    lower, centre, upper, size = along
    numbers = (base, 0.0, base, 0.0, b1, a1, b0, a0)
    if first < last:
        k = first >> half if near else 0
        numbers = (base, get(lower, k), base + get(centre, k), get(upper, k), b1, a1, b0, a0)
    flags = stream + (4 if b0 != 0.0 or a0 != 0.0 else 0)
    cuts = (head, first, last, tail)
    for part in range(3):
        left, right = max(cuts[part], start), min(cuts[part + 1], stop)
        if left < right:
            where = (row + left, before1 + left, after1 + left, before0 + left, after0 + left, near, left, right - left)
            stencil(out, u, along[:3], where, numbers, flags + (0 if part == 1 else 2))
    if stop > tail:
        _ends(out, u, along, places, weights, near, half, n, max(tail, start), stop)


@_inner
def _neighbours(axis, n, i):
    """Rows before and after row i of an axis, and their coefficients: (before, after, lower, upper, centre)."""
    lower, centre, upper, size = axis
    k = i if size == n else 0
    low, high = get(lower, k), get(upper, k)
    before = i if low == 0.0 else (i - 1 if i > 0 else n - 1)
    after = i if high == 0.0 else (i + 1 if i < n - 1 else 0)
    return before, after, low, high, get(centre, k)


@_inlined
def _slab(out, u, axes, shape, span, shift, i, rows, columns, stream):
    """Rows rows[0] <= j < rows[1] of plane i, between two columns."""
    n1, n2 = shape[1], shape[2]
    before, after, b0, a0, centre = _neighbours(axes[0], shape[0], i)
    for j in range(rows[0], rows[1]):
        below, above, b1, a1, middle = _neighbours(axes[1], n1, j)
        row = (i * n1 + j) * n2
        if stream:
            claim(out, row + 2 * n2)
        places = (row, (i * n1 + below) * n2, (i * n1 + above) * n2, (before * n1 + j) * n2, (after * n1 + j) * n2)
        weights = (shift + centre + middle, b1, a1, b0, a0)
        _row(out, u, axes[2], places, weights, span, n2, columns[0], columns[1], stream)


@_inlined
def _axis(axis):
    lower, centre, upper, size = axis
    return pointer(lower, 1.0), pointer(centre, 1.0), pointer(upper, 1.0), size


@_inlined
def _slabs(out, u, axes, shape, span, shift, stream, part, parts):
    """One part of the work: slabs in the order columns, rows, planes, so that planes stay in cache."""
    n0, n1, n2 = shape
    wide = share(n2, TILE)
    high = share(n1, max(1, PLANE // wide))
    bands, strips = -(-n2 // wide), -(-n1 // high)
    total = bands * strips * n0
    for slab in range(total * part // parts, total * (part + 1) // parts):
        strip, i = divmod(slab, n0)
        band, strip = divmod(strip, strips)
        rows = (strip * high, min(n1, (strip + 1) * high))
        columns = (band * wide, min(n2, (band + 1) * wide))
        _slab(out, u, axes, shape, span, shift, i, rows, columns, stream)
    if stream:
        fence()


def sum_worker(like, stamp):
    """C function for the numbers that `kronecker_sum` in `native` passes: part of out = shift u + sum of T_a u."""
    zero = like(stamp * 0)

    # Three axes (addresses of lower, centre, upper; size), shape, span, shift, stream, part, parts.
    def worker(
        out,
        u,
        l0,
        c0,
        u0,
        s0,
        l1,
        c1,
        u1,
        s1,
        l2,
        c2,
        u2,
        s2,
        n0,
        n1,
        n2,
        near,
        half,
        first,
        last,
        shift,
        stream,
        p,
        parts,
    ):
        axes = (_axis((l0, c0, u0, s0)), _axis((l1, c1, u1, s1)), _axis((l2, c2, u2, s2)))
        shape, span = (n0, n1, n2), (near, half, first, last)
        _slabs(pointer(out, zero), pointer(u, zero), axes, shape, span, shift, stream, p, parts)

    return worker


# ---------------------------------------------------------------- elimination along the first axis


@_inner
def _downwards(x, inverses, low, here, before, width):
    """x = (x - low * x of the row before) * inverses, from one place on."""
    for j in range(width):
        put(x, here + j, (get(x, here + j) - low * get(x, before + j)) * get(inverses, here + j))


@_inner
def _gather(x, row, end, here, width):
    """Take the filled part of the last row times a row that is done from the last one."""
    for j in range(width):
        put(x, end + j, get(x, end + j) - get(row, here + j) * get(x, here + j))


@_inner
def _upwards(x, inverses, high, here, after, width):
    for j in range(width):
        put(x, here + j, get(x, here + j) - high * get(x, after + j) * get(inverses, here + j))


@_inner
def _upwards_filled(x, inverses, column, high, here, after, end, width):
    for j in range(width):
        others = high * get(x, after + j) + get(column, here + j) * get(x, end + j)
        put(x, here + j, get(x, here + j) - others * get(inverses, here + j))


@_inlined
def _eliminate(x, lines, inverses, fills, shape, cyclic, filled, start, width):
    """A band of columns, from the first row to the last and back. A cyclic last row is gathered on the way."""
    lower, upper = lines
    column, row = fills
    n, m = shape
    end = (n - 1) * m + start
    for i in range(n - cyclic):
        here = i * m + start
        _downwards(x, inverses, get(lower, i) if i else 0.0, here, max(here - m, start), width)
        if cyclic and (i < filled or i == n - 2):
            _gather(x, row, end, here, width)
    if cyclic:
        _downwards(x, inverses, 0.0, end, end - m, width)
    for i in range(n - 2, -1, -1):
        here = i * m + start
        if cyclic and (i < filled or i == n - 2):
            high = get(upper, i) if i < n - 2 else 0.0
            _upwards_filled(x, inverses, column, high, here, here + m, end, width)
        else:
            _upwards(x, inverses, get(upper, i), here, here + m, width)


def sweep_worker(like, stamp):
    """C function for the numbers that `sweep` in `native` passes: some bands of columns."""
    zero = like(stamp * 0)

    def worker(x, inverses, lower, upper, column, row, ends, n, m, cyclic, part, parts):
        lines = pointer(lower, 1.0), pointer(upper, 1.0)
        fills = pointer(column, 1.0), pointer(row, 1.0)
        band = share(m, max(32, BAND // n))
        bands = -(-m // band)
        for number in range(bands * part // parts, bands * (part + 1) // parts):
            start = number * band
            width, filled = min(band, m - start), 0
            for j in range(start, start + width):
                filled = max(filled, get(pointer(ends, n), j))
            _eliminate(pointer(x, zero), lines, pointer(inverses, zero), fills, (n, m), cyclic, filled, start, width)

    return worker
