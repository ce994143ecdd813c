"""The compiled kernels behind plain functions of arrays: compiling, threads, complex fields.

Only float64 and float32 are compiled: a complex field is a real one with two numbers a cell. A
kernel is compiled for a dtype at its first use and kept on disk where that is possible.
"""

import functools
import os
import threading

import numpy as np
from numba import cfunc, njit, prange, types

from sparsedp.kernels import lanes, lines, measures, plain, plain_measures, pointers, sums
from sparsedp.kernels.lanes import ADD, STORE, STREAM
from sparsedp.kernels.layout import CHUNK
from sparsedp.kernels.lines import line_worker
from sparsedp.kernels.pointers import address, call
from sparsedp.kernels.sums import sum_worker, sweep_worker
from sparsedp.kernels.unable import warn_unable

__all__ = ["along_axis", "in_team", "kronecker_sum", "measure", "sweep"]

SERIAL = (
    1 << 19
)  # below this many numbers (a few tenths of a millisecond) waiting for a busy core costs more than it brings
PAST_CACHE = 1 << 25  # bytes of output from which stores bypass the caches
NARROW = 64  # numbers: shorter lines are always stored the ordinary way

_REAL = {"d": "d", "f": "f", "D": "d", "F": "f"}
_NONE = (np.zeros(1),) * 3  # coefficients of an axis without a matrix


# ---------------------------------------------------------------- compiling


def _sum_team(stamp):
    def kronecker_sum(worker, out, u, far, middle, along, shape, span, shift, stream, parts):
        fields = address(out), address(u)
        a = address(far[0]), address(far[1]), address(far[2]), far[0].size
        b = address(middle[0]), address(middle[1]), address(middle[2]), middle[0].size
        c = address(along[0]), address(along[1]), address(along[2]), along[0].size
        rest = shape + span + (shift, stream + stamp * 0)
        if parts == 1:
            call(worker, fields + a + b + c + rest + (parts - 1, parts))
        else:
            for part in prange(parts):
                call(worker, fields + a + b + c + rest + (types.int64(part), parts))

    return kronecker_sum


def _line_team(stamp):
    def along_axis(worker, out, u, starts, indices, numbers, crossing, values, shape, scale, mode, parts):
        fields = address(out), address(u)
        matrix = address(starts), address(indices), address(numbers)
        diagonals = values.size // shape[1], address(crossing[0]), address(crossing[1]), address(crossing[2])
        rest = (address(values),) + shape + (scale, mode + stamp * 0)
        if parts == 1:
            call(worker, fields + matrix + diagonals + rest + (parts - 1, parts))
        else:
            for part in prange(parts):
                call(worker, fields + matrix + diagonals + rest + (types.int64(part), parts))

    return along_axis


def _sweep_team(stamp):
    def sweep(worker, x, inverses, lower, upper, column, row, ends, n, m, cyclic, parts):
        fields = address(x), address(inverses), address(lower), address(upper), address(column), address(row)
        rest = address(ends), n, m, cyclic + stamp * 0
        if parts == 1:
            call(worker, fields + rest + (parts - 1, parts))
        else:
            for part in prange(parts):
                call(worker, fields + rest + (types.int64(part), parts))

    return sweep


def _constant(item):
    """Read-only, because a writable array is accepted in its place but not the other way round."""
    return types.Array(item, 1, "C", readonly=True)


_whole, _reals, _int, _real = _constant(types.int64), _constant(types.float64), types.int64, types.float64
_line, _threes, _fours = types.UniTuple(_reals, 3), types.UniTuple(_int, 3), types.UniTuple(_int, 4)
_FORMS = {  # name: team, its arguments after worker, out, u; worker, its arguments
    "sum": (
        _sum_team,
        (_line, _line, _line, _threes, _fours, _real, _int, _int),
        sum_worker,
        (*[_int] * 21, _real, *[_int] * 3),
    ),
    "line": (
        _line_team,
        (_whole, _whole, _reals, types.UniTuple(_whole, 3), _reals, _fours, _real, _int, _int),
        line_worker,
        (*[_int] * 14, _real, *[_int] * 3),
    ),
    "sweep": (_sweep_team, (*[_reals] * 4, _whole, *[_int] * 4), sweep_worker, [_int] * 12),
}


def _stamp():
    """Changes with the files whose code ends up in a kernel: numba looks only at one of them."""
    return sum(os.stat(str(module.__file__)).st_mtime_ns for module in (lanes, lines, pointers, sums)) % (1 << 40)


def _kept(compiler, function, **options):
    """Compile and keep on disk, or only compile where there is no place to keep it."""
    try:
        return compiler(cache=True, error_model="numpy", **options)(function)
    except (OSError, RuntimeError):
        return compiler(error_model="numpy", **options)(function)


@functools.cache
def _kernel(name, letter):
    """Function that runs a kernel for a dtype, or None when it cannot be compiled here.

    The loops are C functions. The team, a small parallel function, calls them by address: compiled
    into it, they would be optimised several times over.
    """
    team, rest, worker, numbers = _FORMS[name]
    item = types.float64 if letter == "d" else types.float32
    signature = types.void(types.int64, types.Array(item, 1, "C"), _constant(item), *rest)
    try:
        loops = _kept(functools.partial(cfunc, types.void(*numbers)), worker(np.dtype(letter).type, _stamp()))
        run = _kept(functools.partial(njit, [signature]), team(_stamp()), nogil=True, parallel=True)
    except Exception as error:  # whatever LLVM or numba object to on this machine
        return warn_unable(error, 5)
    return functools.partial(run, loops.address), loops


@functools.cache
def _measures():
    """The sums of `measures`, in the form of `_kernel`."""
    try:
        return (_kept(functools.partial(njit, [measures.SIGNATURE]), measures.run, nogil=True, parallel=True),)
    except Exception as error:
        return warn_unable(error, 5)


# ---------------------------------------------------------------- threads


_lock, _home = threading.Lock(), os.getpid()


def _run(kernel, arguments, size, threads):
    """Run a kernel with a team of threads where it is worth one."""
    return in_team(kernel[0], arguments, threads if size >= SERIAL else 1)


def in_team(kernel, arguments, threads):
    """Run a kernel with a team of threads, or alone where a team is not safe.

    Some threading layers of numba end the process when a second Python thread enters, or when a
    forked child does. Who finds the team taken, or is a child, works alone; the bits are the same.
    """
    if threads == 1 or os.getpid() != _home or not _lock.acquire(blocking=False):
        return kernel(*arguments, 1)
    try:
        return kernel(*arguments, threads)
    finally:
        _lock.release()


# ---------------------------------------------------------------- entry


def _flat(array, letter):
    """Field -> its numbers in a row; two a cell when it is complex."""
    flat = array.reshape(-1)
    return flat.view(letter) if array.dtype.kind == "c" else flat


def _row(axis, n, pair):
    """Tridiagonal of the last axis -> coefficients and span (see `sums`) for numbers instead of cells."""
    if axis is None:
        return _NONE, (0, 0, 0, n * (1 + pair))
    low, high = min(1, n), max(1, n - 1)
    first = min(max(axis.first, low), high)
    last = min(max(axis.last, first), high)
    if not pair:
        return axis[:3], (1, 0, first, last)
    if last - first == high - low:
        return axis[:3], (2, 1, 2 * first, 2 * last)
    return tuple(np.repeat(x, 2) for x in axis[:3]), (2, 0, 2 * first, 2 * last)


def kronecker_sum(u, out, axes, shift, threads):
    """See `sparsedp.kernels.kronecker_sum`."""
    if not u.size:
        return
    letter = _REAL[u.dtype.char]
    kernel = _kernel("sum", letter)
    if kernel is None:
        plain.kronecker_sum(u, out, axes, shift)
        return
    n0, n1, n = u.shape
    pair = u.dtype.kind == "c"
    far, middle = (_NONE if axis is None else axis[:3] for axis in axes[:2])
    along, span = _row(axes[2], n, pair)
    n *= 1 + pair
    stream = int(out.nbytes >= PAST_CACHE and n >= NARROW)
    arguments = (_flat(out, letter), _flat(u, letter), far, middle, along, (n0, n1, n), span, shift, stream)
    _run(kernel, arguments, n0 * n1 * n, threads)


def along_axis(u, out, rows, scale, accumulate, threads):
    """See `sparsedp.kernels.along_axis`."""
    if not out.size:
        return
    letter = _REAL[u.dtype.char]
    kernel = _kernel("line", letter)
    if kernel is None:
        plain.along_axis(u, out, rows, scale, accumulate)
        return
    count, n, length = out.shape
    m, pair = u.shape[1], u.dtype.kind == "c"
    crossing, values = (rows.offsets, rows.start, rows.stop), rows.values
    if length > 1 or not len(rows.offsets):
        values, length = values[:0], length * (1 + pair)
    elif pair:
        crossing, values, n, m = tuple(2 * x for x in crossing), np.repeat(values, 2, axis=1), 2 * n, 2 * m
    long = max(n, length) if len(values) else length
    mode = ADD if accumulate else STREAM if out.nbytes >= PAST_CACHE and long >= NARROW else STORE
    arguments = (
        _flat(out, letter),
        _flat(u, letter),
        rows.indptr,
        rows.indices,
        rows.data,
        crossing,
        values.reshape(-1),
        (count, n, m, length),
        scale,
        mode,
    )
    _run(kernel, arguments, max(u.size, out.size), threads)


def sweep(x, lower, upper, inverses, column, row, ends, threads):
    """See `sparsedp.kernels.sweep`."""
    kernel = _kernel("sweep", "d")
    if kernel is None:
        plain.sweep(x, lower, upper, inverses, column, row, ends)
        return
    n, m = x.shape
    numbers = [array.reshape(-1) for array in (inverses, lower, upper, column, row)]
    _run(kernel, (x.reshape(-1), *numbers, ends, n, m, int(row.size > 0)), x.size, threads)


def measure(mode, b, x, number, out, threads):
    """See `sparsedp.kernels.plain_measures.measure`."""
    kernel = _measures()
    if kernel is None:
        return plain_measures.measure(mode, b, x, number, out)
    sums = np.empty((2, -(-x.size // CHUNK)))
    return _run(kernel, (mode, b, x, number, out, sums), x.size, threads)
