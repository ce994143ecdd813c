"""How the loops that run as teams of numba's own threads are compiled and called."""

import os
import threading

from sparsedp.kernels.team import SERIAL

__all__ = ["in_team"]


def _kept(compiler, function, **options):
    """Compile and keep on disk, or only compile where there is no place to keep it."""
    try:
        return compiler(cache=True, error_model="numpy", **options)(function)
    except (OSError, RuntimeError):
        return compiler(error_model="numpy", **options)(function)


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
