"""Cache: the last few values that were computed from arrays, looked up by the content of those arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["Cache"]


class Cache:
    """Values by the content of their keys. It holds copies of the keys; keys must be plain, never traced.

    The list of entries is replaced, never changed, because other threads may be reading it.

    Parameters
    ----------
    most : int
        Number of values that are kept; the least recently used one is dropped. Two serve a forward and a backward
        pass, or two alternating sets of data.
    """

    def __init__(self, most: int = 2) -> None:
        self.most = most
        self._entries: list[tuple[tuple, Any]] = []  # (key, value), the last used first

    def find(self, key: tuple) -> Any:
        """Return the value of an equal key, or None."""
        entries = self._entries
        for entry in entries:
            entry_key, value = entry
            if len(entry_key) == len(key) and all(map(_are_equal, entry_key, key)):
                self._entries = [entry, *(other for other in entries if other is not entry)]
                return value
        return None

    def put(self, key: tuple, value: Any) -> Any:
        """Keep a value, and return it."""
        key = tuple(np.array(part) if isinstance(part, np.ndarray) else part for part in key)
        self._entries = [(key, value), *self._entries[: self.most - 1]]
        return value

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def last(self) -> Any:
        """The value that was used last, or None."""
        entries = self._entries
        if not entries:
            return None
        _, value = entries[0]
        return value


def _are_equal(one: Any, other: Any) -> bool:
    """Return whether two parts of keys are equal, in type and dtype too."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        # float32 and float64 data of equal value have different derivatives.
        return getattr(one, "dtype", None) == getattr(other, "dtype", None) and np.array_equal(one, other)
    if one is other:
        return True
    return type(one) is type(other) and isinstance(one, (int, float, complex, str, bytes)) and one == other
