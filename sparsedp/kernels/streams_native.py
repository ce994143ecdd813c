"""The compiled streams: one small C function for each formula, one team of threads for all of them."""

import functools
import os

import numpy as np
from numba import cfunc, njit, prange, types

from sparsedp.kernels import emit, formulas, limited, native, streams_plain
from sparsedp.kernels.pointers import address, call
from sparsedp.kernels.unable import warn_unable

__all__ = ["run"]


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


def _stamp():
    """Changes with the files whose code ends up in a kernel: numba looks only at one of them."""
    return sum(os.stat(str(module.__file__)).st_mtime_ns for module in (emit, formulas, limited)) % (1 << 40)


@functools.cache
def _run():
    signature = types.void(types.int64, types.int64[:, ::1], types.int64[::1], types.float64[:, ::1], types.int64)
    return native._kept(functools.partial(njit, [signature]), _team(_stamp()), nogil=True, parallel=True)


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
    bases, sums = np.zeros(len(arrays), np.int64), np.empty((len(table.rows), table.formula.sums))
    for number in table.arrays:
        bases[number] = arrays[number].__array_interface__["data"][0]
    arguments = loops[0].address, table.rows, bases, sums
    native._run((loops[1],), arguments, table.points, threads)
    return sums.sum(axis=0)
