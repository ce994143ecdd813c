"""Cache: a small cache of values that were computed from arrays, looked up by the content of those arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["Cache"]


class Cache:
    """A least-recently-used cache whose keys are compared by content.

    The cache stores copies of the arrays in the keys. These arrays must not be traced by autograd. The list of entries
    is replaced by a new list and never modified in place, because other threads may be reading it.

    Parameters
    ----------
    most : int
        Largest number of values; beyond it the least recently used value is dropped. Two values are enough for a
        forward and a backward pass, or for two data sets that alternate.
    """

    def __init__(self, most: int = 2) -> None:
        self.most = most
        self._entries: list[tuple[tuple, Any]] = []  # (key, value), the most recently used first

    def find(self, key: tuple) -> Any:
        """Return the value that is stored under an equal key, or None."""
        entries = self._entries
        for entry in entries:
            entry_key, value = entry
            if len(entry_key) == len(key) and all(map(_are_equal, entry_key, key)):
                self._entries = [entry, *(other for other in entries if other is not entry)]
                return value
        return None

    def put(self, key: tuple, value: Any) -> Any:
        """Store a value under a key, and return the value."""
        key = tuple(np.array(part) if isinstance(part, np.ndarray) else part for part in key)
        self._entries = [(key, value), *self._entries[: self.most - 1]]
        return value

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def last(self) -> Any:
        """The most recently used value, or None if the cache is empty."""
        entries = self._entries
        if not entries:
            return None
        _, value = entries[0]
        return value


def _are_equal(one: Any, other: Any) -> bool:
    """Return whether two parts of keys have equal values, and the same type or dtype."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        # Compare dtypes too: the derivatives for float32 and float64 data differ even if the values are equal.
        return getattr(one, "dtype", None) == getattr(other, "dtype", None) and np.array_equal(one, other)
    if one is other:
        return True
    return type(one) is type(other) and isinstance(one, (int, float, complex, str, bytes)) and one == other
