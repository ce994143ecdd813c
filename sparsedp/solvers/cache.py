"""Cache: the last few values that were made from arrays, found again by the content of those arrays."""

import numpy as np

__all__ = ["Cache"]


class Cache:
    """Values keyed by content. Holds copies of the keys; keys must be plain, never traced.

    The list of entries is replaced, never changed: other threads may be looking through it.

    Parameters
    ----------
    most : int
        The value that was used longest ago is dropped first. Two serve a forward and a backward pass,
        or two alternating sets of data.
    """

    def __init__(self, most=2):
        self.most = most
        self._entries: list = []  # (key, value), last used first

    def find(self, key):
        """The value of an equal key, or None."""
        entries = self._entries
        for entry in entries:
            if len(entry[0]) == len(key) and all(map(_same, entry[0], key)):
                self._entries = [entry, *(other for other in entries if other is not entry)]
                return entry[1]
        return None

    def put(self, key, value):
        """Keep a value; returns it."""
        key = tuple(np.array(part) if isinstance(part, np.ndarray) else part for part in key)
        self._entries = [(key, value), *self._entries[: self.most - 1]]
        return value

    def __len__(self):
        return len(self._entries)

    @property
    def last(self):
        """The value that was used last, or None."""
        return next((value for _, value in self._entries), None)


def _same(one, other):
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        # By type and dtype too: float32 and float64 data of equal value have different derivatives.
        return getattr(one, "dtype", None) == getattr(other, "dtype", None) and np.array_equal(one, other)
    if one is other:
        return True
    return type(one) is type(other) and isinstance(one, (int, float, complex, str, bytes)) and one == other
