"""Memory for large fresh results: that of results which nobody sees any more serves again.

A new large array costs more than the arithmetic that fills it, for the system hands out its pages one by one, at the
first touch. The memory of a result comes back when the array and all its views are gone, not before.
"""

import weakref
from math import prod

import numpy as np

__all__ = ["empty"]

LARGE = 1 << 18  # bytes: what is smaller, the C library itself keeps when it is freed, and hands out again as fast
SPARE = 1 << 30  # most bytes that wait for later results: a field of 256^3 cells and its faces take half of that


class _Memory(np.ndarray):
    """Bytes of a result. A type of its own: NumPy lets a view of a view of an array hold the array alone, and the
    result in between would be gone while its views are still seen."""


_spare: dict[int, _Memory] = {}  # by identity, the oldest first; single steps are safe among threads


def empty(shape, dtype):
    """Shape, dtype -> an array that nobody else sees, its numbers not set; like np.empty.

    Examples
    --------
    >>> empty((2, 3), float).shape
    (2, 3)
    """
    size = prod(shape) * np.dtype(dtype).itemsize
    if size < LARGE:
        return np.empty(shape, dtype)
    memory = _taken(size)
    result = np.ndarray(shape, dtype, memory)
    weakref.finalize(result, _give_back, memory).atexit = False
    return result


def _taken(size):
    for key, memory in _spare.copy().items():
        if memory.size == size and _spare.pop(key, None) is not None:  # else another thread was first
            return memory
    return _Memory(size, np.uint8)


def _give_back(memory):
    _spare[id(memory)] = memory
    waiting = _spare.copy()
    total = sum(other.size for other in waiting.values())
    for key, oldest in waiting.items():
        if total <= SPARE:
            return
        total -= oldest.size
        _spare.pop(key, None)
