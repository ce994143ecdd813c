"""Memory for large results: the buffers of garbage-collected results are recycled.

A new large array costs more than the arithmetic that fills it, because the system provides its pages one by one, at the
first access. The buffer of a result is free again once the array and all its views are deleted.
"""

from __future__ import annotations

import weakref
from math import prod
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import DTypeLike

__all__ = ["empty"]

LARGE = 1 << 18  # bytes: the C library itself recycles smaller arrays as fast
SPARE = 1 << 30  # largest total of free buffers in bytes: a field of 256^3 cells and its faces takes half of it


class _Buffer(np.ndarray):
    """The bytes of a result.

    It needs a type of its own: the base of a view of a result would otherwise be the array of bytes, and the result
    could be deleted while views of it exist.
    """


_free: dict[int, _Buffer] = {}  # by identity, the oldest first; each operation on it is atomic


def empty(shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """Return an uninitialised array of its own memory, like np.empty.

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


def _take(size):
    """Return a free buffer of this size, or a new one."""
    for key, buffer in _free.copy().items():
        if buffer.size == size and _free.pop(key, None) is not None:  # else another thread was first
            return buffer
    return _Buffer(size, np.uint8)


def _release(buffer):
    """Keep a buffer for later results, and delete the oldest ones if they exceed SPARE."""
    _free[id(buffer)] = buffer
    buffers = _free.copy()
    total = sum(other.size for other in buffers.values())
    for key, oldest in buffers.items():
        if total <= SPARE:
            return
        total -= oldest.size
        _free.pop(key, None)
