"""The ledger: how often each rule, operator and solve was called. `explain` prints it."""

from collections import Counter
from contextlib import contextmanager

__all__ = ["active", "count", "recording"]

active: list[Counter] = []  # the open `recording()` blocks


@contextmanager
def recording():
    """Count the calls of every rule and operator inside a `with` block.

    Yields
    ------
    collections.Counter
        Keys are (name, kind) with kind "forward", "vjp" or "jvp".

    Examples
    --------
    >>> with recording() as calls:
    ...     count("gradient", "forward")
    >>> dict(calls)
    {('gradient', 'forward'): 1}
    """
    calls: Counter = Counter()
    active.append(calls)
    try:
        yield calls
    finally:
        # By identity: two nested blocks with equal counts are equal Counters.
        active[:] = [other for other in active if other is not calls]


def count(name, kind):
    """Add one call of `name` to every open block. Callers test `active` first: it is on hot paths."""
    for calls in active:
        calls[name, kind] += 1
