"""The ledger: how often each rule, operator and solve was called, and what was noted of it. `explain` prints it.

Kinds of calls: forward, vjp, jvp; of solves: solve, adjoint, iterations, setup, reused, hierarchy, skipped
(nothing to solve); of operators: assembled (its matrix was built). A time loop counts its steps as forward, vjp
and recomputed (run again for the backward pass), and the bytes it keeps beside the tape.

Each thread has a ledger of its own: what other threads do at the same time is neither counted nor changed.
"""

from collections import Counter
from contextlib import contextmanager
from threading import local
from time import perf_counter
from typing import Any

__all__ = ["Calls", "active", "count", "recording", "note", "spent", "thread", "timed"]


class Thread(local):
    """The ledger of the thread that asks.

    Attributes
    ----------
    calls : list of Calls
        The open `recording()` blocks.
    solve_hooks : list
        Who takes part in every solve, the last one first.
    loop_hooks : list of callables
        Called for every time loop before it runs, with (step, state, params, inputs, n).
    witnesses : list of callables
        Called for every node of a tape when it is made: see `Recorder`.
    solves : int
        Since the thread began, forward and adjoint: counted always, for one addition a solve.
    controlled : int
        Intervals under error control since the thread began.
    grown : int
        Warnings of cotangents that grew, since the thread began; what warnings do is one for all threads.
    quiet : int
        Open blocks whose caller refuses derivatives that are not finite: no warning is needed.
    inner : list of float
        For each timed call that is under way, the seconds of the calls inside it.
    """

    def __init__(self):
        self.calls: list[Calls] = []
        self.solve_hooks: list[Any] = []
        self.loop_hooks: list[Any] = []
        self.witnesses: list[Any] = []
        self.inner: list[float] = []
        self.solves = self.controlled = self.grown = self.quiet = 0


thread = Thread()
active: list[None] = []  # one for each open block of any thread: while it is empty, nobody need look at `thread`


class Calls(Counter):
    """Counts by (name, kind). `seconds` by the same keys, without the calls inside; `notes` and `actors` by name."""

    def __init__(self, *counts):
        super().__init__(*counts)
        self.seconds: Counter = Counter()
        self.notes: dict[tuple, Counter] = {}
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
    active.append(None)
    thread.calls.append(calls)
    try:
        yield calls
    finally:
        # By identity: two nested blocks with equal counts are equal Counters.
        thread.calls[:] = [other for other in thread.calls if other is not calls]
        active.pop()


def count(name, kind, times=1):
    """Add a call of `name`, or several, to every open block. While none is open it takes a function call."""
    if active and times:
        for calls in thread.calls:
            calls[name, kind] += times


def note(name, what, value):
    """Note a fact about `name`, such as the method that was chosen."""
    for calls in thread.calls if active else ():
        calls.notes.setdefault((name, what), Counter())[value] += 1


def timed(name, kind, function, *args):
    """Run a call; where somebody records, count it and add its seconds. Of a method, its object is noted too."""
    if not active:
        return function(*args)
    actor = getattr(function, "__self__", None)
    for calls in thread.calls:
        calls[name, kind] += 1
        if actor is not None:
            calls.actors.setdefault(name, {})[id(actor)] = actor
    thread.inner.append(0.0)
    clock = perf_counter()
    try:
        return function(*args)
    finally:
        whole = perf_counter() - clock
        spent(name, kind, whole - thread.inner.pop(), whole)


def spent(name, kind, exclusive, inclusive):
    """Add the seconds of a call: without those of the calls inside it, and with them."""
    if thread.inner:
        thread.inner[-1] += inclusive
    for calls in thread.calls:
        calls.seconds[name, kind] += exclusive
