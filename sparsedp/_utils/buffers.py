"""Memory for large results: the buffers of garbage-collected results are recycled.

To allocate a large array can take longer than the arithmetic that fills it, because the operating system provides each
memory page at its first access. The buffer of a result is recycled when the array and all its views have been deleted.
"""

from __future__ import annotations

import weakref
from functools import partial
from math import prod
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import DTypeLike

__all__ = ["allocator", "empty", "zeros"]

LARGE = 1 << 18  # bytes; smaller arrays are recycled by the C library
SPARE = 1 << 30  # largest total size of free buffers in bytes; a field on 256^3 cells and one on the faces take half


class _Buffer(np.ndarray):
    """The memory of a result, as an array of bytes.

    A subclass is needed so that a view of a result has the result as its base. The base of a view of a plain array
    would be this array of bytes, and the result could be deleted while views of it exist.
    """


_free: dict[int, _Buffer] = {}  # id -> free buffer, the oldest first; only atomic operations are used (threads)


def empty(shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """Return an uninitialised array like np.empty, for large sizes in recycled memory.

    Examples
    --------
    >>> empty((2, 3), float).shape
    (2, 3)
    """
    size = prod(shape) * np.dtype(dtype).itemsize
    if size < LARGE:
        return np.empty(shape, dtype)
    buffer = _take(size)
    result: np.ndarray = np.ndarray(shape, dtype, buffer)
    weakref.finalize(result, _release, buffer).atexit = False
    return result


def allocator(shape: tuple[int, ...], dtype: DTypeLike = float, filled: bool = False) -> Callable[[], np.ndarray]:
    """Return a function without arguments that returns a new array: zeros if `filled`, else uninitialised.

    The function does not compare the size of the array with LARGE: this is done here, once.
    """
    if prod(shape) * np.dtype(dtype).itemsize < LARGE:
        return partial(np.zeros if filled else np.empty, shape, dtype)
    return partial(zeros if filled else empty, shape, dtype)


def zeros(shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """Return an array of zeros, in recycled memory if it is large."""
    if prod(shape) * np.dtype(dtype).itemsize < LARGE:
        return np.zeros(shape, dtype)
    result = empty(shape, dtype)
    result.fill(0)
    return result


def _take(size):
    """Return a free buffer of this size, or a new one."""
    for key, buffer in _free.copy().items():
        if buffer.size == size and _free.pop(key, None) is not None:  # None: another thread took it
            return buffer
    return _Buffer(size, np.uint8)


def _release(buffer):
    """Keep a buffer for later results; delete the oldest free buffers if their total size exceeds SPARE."""
    _free[id(buffer)] = buffer
    buffers = _free.copy()
    total = sum(other.size for other in buffers.values())
    for key, oldest in buffers.items():
        if total <= SPARE:
            return
        total -= oldest.size
        _free.pop(key, None)
