"""Counters: how often each rule, operator and solve was called, and facts about it. `explain` prints them.

Kinds of calls: forward, vjp, jvp; of solves: solve, adjoint, iterations, setup, reused, hierarchy, skipped
(nothing to solve); of operators: assembled (its matrix was built). A time loop counts its steps as forward, vjp
and recomputed (computed again for the backward pass), and the bytes it keeps beside the tape.

Each thread has counters of its own: simultaneous calls of other threads are neither counted nor changed.
"""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from threading import local
from time import perf_counter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

__all__ = ["Calls", "active", "count", "recording", "note", "spent", "thread", "timed"]


class Thread(local):
    """Counters and hooks of the current thread.

    Attributes
    ----------
    calls : list of Calls
        The open `recording()` blocks.
    solve_hooks : list
        Objects that take part in every solve, the last one first.
    loop_hooks : list of callables
        Called for every time loop before it runs, with (step, state, params, inputs, n).
    witnesses : list of callables
        Called for every new node of a tape: see `Recorder`.
    solves : int
        Number of solves of the thread, forward and adjoint, also without an open block.
    controlled : int
        Number of intervals under error control.
    grown : int
        Number of warnings of growing cotangents; whether Python shows a warning is decided for all threads together.
    quiet : int
        Number of open blocks whose caller handles derivatives that are not finite: no warning is needed.
    inner : list of float
        For each open timed call, the seconds of the calls inside it.
    """

    def __init__(self) -> None:
        self.calls: list[Calls] = []
        self.solve_hooks: list[Any] = []
        self.loop_hooks: list[Any] = []
        self.witnesses: list[Any] = []
        self.inner: list[float] = []
        self.solves = 0
        self.controlled = 0
        self.grown = 0
        self.quiet = 0


thread = Thread()
active: list[None] = []  # an entry for each open block of any thread: if it is empty, there is nothing to count


class Calls(Counter):
    """Counts by (name, kind).

    Attributes
    ----------
    seconds : Counter
        By the same keys, without the calls inside.
    notes : dict of Counter
        Noted values by (name, fact).
    actors : dict of dict
        By name, the objects whose methods were called, by identity.
    """

    def __init__(self, *counts: Any) -> None:
        super().__init__(*counts)
        self.seconds: Any = Counter()
        self.notes: dict[tuple, Counter] = {}
        self.actors: dict[str, dict] = {}


@contextmanager
def recording() -> Iterator[Calls]:
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


def count(name: str, kind: str, times: int = 1) -> None:
    """Add a call of `name`, or several, to every open block. Without an open block it costs one function call."""
    if active and times:
        for calls in thread.calls:
            calls[name, kind] += times


def note(name: str, fact: str, value: Any) -> None:
    """Note a fact about `name`, such as the chosen method."""
    if not active:
        return
    for calls in thread.calls:
        calls.notes.setdefault((name, fact), Counter())[value] += 1


def timed(name: str, kind: str, function: Callable, *args: Any) -> Any:
    """Call a function; if a block is open, count the call, add its seconds, and note the object of a method."""
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
        inclusive = perf_counter() - clock
        exclusive = inclusive - thread.inner.pop()
        spent(name, kind, exclusive, inclusive)


def spent(name: str, kind: str, exclusive: float, inclusive: float) -> None:
    """Add the seconds of a call, without and with those of the calls inside it."""
    if thread.inner:
        thread.inner[-1] += inclusive
    for calls in thread.calls:
        calls.seconds[name, kind] += exclusive
