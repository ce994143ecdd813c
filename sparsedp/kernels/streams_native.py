"""The compiled streams: one small C function for each formula, one team of threads for all of them."""

import functools
import os

import numpy as np
from numba import cfunc, njit, prange, types

from sparsedp.kernels import emit, formulas, limited, native, streams_plain
from sparsedp.kernels.pointers import address, call
from sparsedp.kernels.unable import warn_unable

__all__ = ["march", "run"]


def _worker(number, stamp):
    """C function that runs formula `number` on a part of the segments of a table."""

    def worker(table, first, last, bases, sums):
        emit.run(number, table, first, last, bases, sums + stamp * 0)

    return worker


def _team(stamp):
    def streams(worker, table, bases, sums, parts):
        rows, places = address(table), address(bases)
        if parts == 1:
            call(worker, (rows, stamp * 0, table.shape[0], places, address(sums)))
        else:
            for part in prange(parts):
                first = table.shape[0] * part // parts
                last = table.shape[0] * (part + 1) // parts
                call(worker, (rows, types.int64(first), types.int64(last), places, address(sums)))

    return streams


def _time_loop(stamp):
    def time_loop(worker, table, bases, strides, sums, n, checked, results, aside, places, points):
        rows, starts = address(table), address(bases)
        for step in range(n):
            call(worker, (rows, stamp * 0, table.shape[0], starts, address(sums)))
            if checked:
                for row in range(sums.shape[0]):
                    if not sums[row, 0] == 0.0:
                        return step
            for k in range(places.size):
                results[(step + 1) & 1, points[k]] += aside[places[k]]
                aside[places[k]] = 0.0
            for k in range(bases.size):
                bases[k] += strides[step & 1, k]
        return n

    return time_loop


def _stamp():
    """Changes with the files whose code ends up in a kernel: numba looks only at one of them."""
    return sum(os.stat(str(module.__file__)).st_mtime_ns for module in (emit, formulas, limited)) % (1 << 40)


@functools.cache
def _run():
    signature = types.void(types.int64, types.int64[:, ::1], types.int64[::1], types.float64[:, ::1], types.int64)
    return native._kept(functools.partial(njit, [signature]), _team(_stamp()), nogil=True, parallel=True)


@functools.cache
def _march():
    whole, real = types.int64[::1], types.float64[:, ::1]
    rest = real, types.int64, types.boolean, real, types.float64[::1], whole, whole
    signature = types.int64(types.int64, types.int64[:, ::1], whole, types.int64[:, ::1], *rest)
    return native._kept(functools.partial(njit, [signature]), _time_loop(_stamp()), nogil=True)


@functools.cache
def _loops(number):
    """The C function of a formula, or None when it cannot be compiled here."""
    signature = types.void(*[types.int64] * 5)
    try:
        return native._kept(functools.partial(cfunc, signature), _worker(number, _stamp())), _run()
    except Exception as error:  # whatever LLVM or numba object to on this machine
        warn_unable(error, 5)
        return None


def run(table, arrays, threads):
    """See `sparsedp.kernels.streams.run`."""
    loops = _loops(table.number)
    if loops is None:
        return streams_plain.run(table, arrays)
    bases, sums = _bases(table, arrays), np.empty((len(table.rows), table.formula.sums))
    arguments = loops[0].address, table.rows, bases, sums
    native._run((loops[1],), arguments, table.points, threads)
    return sums.sum(axis=0)


def march(table, arrays, strides, n, checked, turned):
    """See `sparsedp.kernels.streams.march`."""
    loops = _loops(table.number)
    if loops is None:
        return None
    sums = np.empty((len(table.rows), table.formula.sums))
    return _march()(loops[0].address, table.rows, _bases(table, arrays), strides, sums, n, checked, *turned)


def _bases(table, arrays):
    """Addresses of the arrays that a table uses."""
    bases = np.zeros(len(arrays), np.int64)
    for number in table.arrays:
        bases[number] = arrays[number].__array_interface__["data"][0]
    return bases
