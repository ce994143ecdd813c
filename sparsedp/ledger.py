"""The ledger: how often each rule, operator and solve was called, and what it told. `explain` prints it.

Kinds of calls: forward, vjp, jvp; of solves: solve, adjoint, iterations, setup, reused, hierarchy, skipped
(nothing to solve); of operators: assembled (its matrix was built). A time loop counts its steps as forward, vjp
and recomputed (run again for the backward pass), and the bytes it keeps beside the tape.
"""

from collections import Counter
from contextlib import contextmanager
from time import perf_counter
from typing import Any

__all__ = ["Calls", "active", "count", "loops", "observers", "recording", "spent", "tally", "tell", "timed"]

active: list["Calls"] = []  # the open `recording()` blocks
observers: list[Any] = []  # who takes part in every solve, the last one first; asked inside recordings only
loops: list[Any] = []  # who is told of every time loop before it runs: called with (step, state, params, inputs, n)
_inner: list[float] = []  # for each timed call that is under way, the seconds of the calls inside it


class Tally:
    """Solves since the program began, forward and adjoint: counted always, for one addition a solve."""

    solves = 0


tally = Tally()


class Calls(Counter):
    """Counts by (name, kind). `seconds` by the same keys, without the calls inside; `told` and `actors` by name."""

    def __init__(self, *counts):
        super().__init__(*counts)
        self.seconds: Counter = Counter()
        self.told: dict[tuple, Counter] = {}
        self.actors: dict[str, dict] = {}


@contextmanager
def recording():
    """Count the calls of every rule and operator inside a `with` block.

    Yields
    ------
    Calls
        A Counter; keys are (name, kind) with kind "forward", "vjp", "jvp", "solve" ...

    Examples
    --------
    >>> with recording() as calls:
    ...     count("gradient", "forward")
    >>> dict(calls)
    {('gradient', 'forward'): 1}
    """
    calls = Calls()
    active.append(calls)
    try:
        yield calls
    finally:
        # By identity: two nested blocks with equal counts are equal Counters.
        active[:] = [other for other in active if other is not calls]


def count(name, kind, times=1):
    """Add a call of `name`, or several, to every open block. Callers test `active` first: it is on hot paths."""
    for calls in active if times else ():
        calls[name, kind] += times


def tell(name, what, value):
    """Note a fact about `name`, such as the method that was chosen. Callers test `active` first."""
    for calls in active:
        calls.told.setdefault((name, what), Counter())[value] += 1


def timed(name, kind, function, *args):
    """Count one call, run it, and add its seconds. Of a method, the object it belongs to is noted too."""
    actor = getattr(function, "__self__", None)
    for calls in active:
        calls[name, kind] += 1
        if actor is not None:
            calls.actors.setdefault(name, {})[id(actor)] = actor
    _inner.append(0.0)
    clock = perf_counter()
    try:
        return function(*args)
    finally:
        whole = perf_counter() - clock
        _add(name, kind, whole - _inner.pop(), whole)


def spent(name, kind, seconds):
    """Add the seconds of something that was not called through `timed`."""
    _add(name, kind, seconds, seconds)


def _add(name, kind, own, whole):
    if _inner:
        _inner[-1] += whole
    for calls in active:
        calls.seconds[name, kind] += own
