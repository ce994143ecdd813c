"""Compiled product of a sparse 1-D matrix with all lines of a field along one axis.

Arrays come as pointers. `shape` is (L, rows, columns, R): u is (L, columns, R) and
out (L, rows, R). `mode` says what is done with the product: STORE, ADD, or STREAM past the caches.
"""

import numpy as np
from numba import njit

from sparsedp.kernels.lanes import ADD, STREAM, combine, combine_varying
from sparsedp.kernels.pointers import claim, fence, get, pointer, put
from sparsedp.kernels.sums import TILE, share

__all__ = ["line_worker"]

THIN = 64  # lines with at most so many numbers are joined where their rows are alike
SHORT = 4  # lines with fewer numbers are not worth a vector
PIECE = 256  # numbers summed at a time in a buffer when a row has many entries

_inner = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
_inlined = njit(error_model="numpy", inline="always")  # a compiled function is optimised again wherever it is called


@_inner
def _finish(out, place, total, scale, mode):
    total *= scale
    put(out, place, get(out, place) + total if mode == ADD else total)


@_inner
def _short(out, u, matrix, at, base, stride, length, first, last, scale, mode):
    """Any number of entries, one number at a time."""
    indices, values = matrix[1], matrix[2]
    for r in range(length):
        total = 0.0
        for k in range(first, last):
            total += get(values, k) * get(u, base + get(indices, k) * stride + r)
        _finish(out, at + r, total, scale, mode)


@_inner
def _many(out, u, matrix, at, base, stride, length, first, last, scale, mode):
    """More than three entries: sum in a buffer, entry by entry."""
    indices, values = matrix[1], matrix[2]
    total = np.empty(PIECE)
    for left in range(0, length, PIECE):
        size = min(PIECE, length - left)
        total[:size] = 0.0
        for k in range(first, last):
            weight, place = get(values, k), base + get(indices, k) * stride + left
            for r in range(size):
                total[r] += weight * get(u, place + r)
        for r in range(size):
            _finish(out, at + left + r, total[r], scale, mode)


@_inlined
def _row(out, u, matrix, at, base, stride, length, i, scale, mode):
    """Row i of the matrix times `length` numbers that follow `base + column * stride`."""
    starts, indices, values = matrix
    first, last = get(starts, i), get(starts, i + 1)
    count = last - first
    if length < SHORT or count == 0:
        _short(out, u, matrix, at, base, stride, length, first, last, scale, mode)
    elif count > 3:
        _many(out, u, matrix, at, base, stride, length, first, last, scale, mode)
    else:
        second, third = min(first + 1, last - 1), last - 1
        a, b, c = get(indices, first), get(indices, second), get(indices, third)
        places = (at, base + a * stride, base + b * stride, base + c * stride, 0, 0, 0, length)
        weights = (get(values, first), get(values, second), get(values, third), scale)
        combine(out, u, values, places, weights, mode + 4 * (count - 1))


@_inner
def _alike(matrix, i, most):
    """Number of rows from i on, up to `most`, that are row i moved along: their lines are one long line."""
    starts, indices, values = matrix
    first, last = get(starts, i), get(starts, i + 1)
    for k in range(1, most):
        here = get(starts, i + k)
        if get(starts, i + k + 1) - here != last - first:
            return k
        for e in range(last - first):
            if get(indices, here + e) != get(indices, first + e) + k or get(values, here + e) != get(values, first + e):
                return k
    return max(most, 1)


@_inlined
def _rows(out, u, matrix, shape, scale, mode, part, parts):
    """Lines of the output in the order L, piece of R, row: neighbouring rows read the same lines."""
    lines, n, m, length = shape
    wide = share(length, TILE)
    bands = -(-length // wide)
    total = lines * bands * n
    task, stop = total * part // parts, total * (part + 1) // parts
    while task < stop:
        band, i = divmod(task, n)
        line, band = divmod(band, bands)
        left, rows = band * wide, 1
        if length <= THIN:
            rows = _alike(matrix, i, min(n - i, stop - task, TILE // length))
        at = (line * n + i) * length + left
        if mode == STREAM:
            claim(out, at + 2 * length)
        _row(out, u, matrix, at, line * m * length + left, length, min(wide, length - left) * rows, i, scale, mode)
        task += rows


@_inner
def _crossing(out, u, diagonals, at, base, i, stop, scale, mode):
    """More than three diagonals over rows i <= j < stop: sum in a buffer."""
    count, n, offsets, starts, stops, values = diagonals
    total = np.empty(PIECE)
    for left in range(i, stop, PIECE):
        size = min(PIECE, stop - left)
        total[:size] = 0.0
        for d in range(count):
            if get(starts, d) <= i < get(stops, d):
                weight, place = d * n + left, base + get(offsets, d) + left
                for r in range(size):
                    total[r] += get(values, weight + r) * get(u, place + r)
        for r in range(size):
            _finish(out, at + left + r, total[r], scale, mode)


@_inlined
def _run(out, u, diagonals, at, base, i, stop, scale, mode):
    """Rows from i on, as far as the same diagonals reach -> where that ends."""
    count, n, offsets, starts, stops, values = diagonals
    active, first, second, third = 0, 0, 0, 0
    for d in range(count):
        start, end = get(starts, d), get(stops, d)
        if start <= i < end:
            stop = min(stop, end)
            first, second, third = (d if active == 0 else first), (d if active == 1 else second), d
            active += 1
        elif i < start < end:
            stop = min(stop, start)
    if active > 3:
        _crossing(out, u, diagonals, at, base, i, stop, scale, mode)
    elif active == 0:
        if mode != ADD:
            for j in range(i, stop):
                put(out, at + j, 0.0)
    else:
        a, b, c = get(offsets, first), get(offsets, second), get(offsets, third)
        places = (
            at + i,
            base + a + i,
            base + b + i,
            base + c + i,
            first * n + i,
            second * n + i,
            third * n + i,
            stop - i,
        )
        combine_varying(out, u, values, places, (0.0, 0.0, 0.0, scale), mode + 4 * (active - 1))
    return stop


@_inlined
def _diagonals(out, u, diagonals, shape, scale, mode, part, parts):
    """Lines along the last axis, each in runs of rows that the same diagonals cross."""
    lines, n, m = shape[0], shape[1], shape[2]
    wide = share(n, TILE)
    bands = -(-n // wide)
    total = lines * bands
    for task in range(total * part // parts, total * (part + 1) // parts):
        line, band = divmod(task, bands)
        i, stop = band * wide, min(n, (band + 1) * wide)
        if mode == STREAM:
            claim(out, line * n + stop)
        while i < stop:
            i = _run(out, u, diagonals, line * n, line * m, i, stop, scale, mode)


def line_worker(like, stamp):
    """C function for the numbers that `along_axis` in `native` passes: part of out = scale M u or out += scale M u."""
    zero = like(stamp * 0)

    def worker(
        out,
        u,
        starts,
        indices,
        numbers,
        count,
        offsets,
        first,
        last,
        values,
        lines,
        n,
        m,
        length,
        scale,
        mode,
        part,
        parts,
    ):
        shape = (lines, n, m, length)
        to, place = pointer(out, zero), pointer(u, zero)
        if count:
            crossing = (count, n, pointer(offsets, 0), pointer(first, 0), pointer(last, 0), pointer(values, 1.0))
            _diagonals(to, place, crossing, shape, scale, mode, part, parts)
        else:
            matrix = (pointer(starts, 0), pointer(indices, 0), pointer(numbers, 1.0))
            _rows(to, place, matrix, shape, scale, mode, part, parts)
        if mode == STREAM:
            fence()

    return worker
