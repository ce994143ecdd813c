"""Count the calls of each derivative rule, operator and linear solver, and store properties such as methods.

`explain` prints these counters.

The kinds of calls are forward, vjp and jvp. Solves also count: solve, adjoint, iterations, setup, reused, hierarchy,
skipped (no solve was needed). Operators also count: assembled (the matrix was built). A time loop counts its steps as
forward, vjp and recomputed (run again for the backward pass), and the bytes of the states that it keeps.

Each thread has its own counters, so that a block counts only the calls of its thread.
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
        Objects that are called in every solve, the last one first.
    loop_hooks : list of callables
        Called with (step, state, params, inputs, n) before a time loop runs.
    node_hooks : list of callables
        Called for every new node of a tape: see `Recorder`.
    solves : int
        Number of forward and adjoint solves of the thread; also counted if no `recording()` block is open.
    controlled : int
        Number of intervals with error control.
    grown : int
        Number of warnings of growing cotangents. It is counted here because Python may suppress repeated warnings.
    quiet : int
        Number of open blocks that suppress warnings of derivatives that are not finite.
    inner : list of float
        For each active call of `timed` the total seconds of the timed calls inside it.
    """

    def __init__(self) -> None:
        self.calls: list[Calls] = []
        self.solve_hooks: list[Any] = []
        self.loop_hooks: list[Any] = []
        self.node_hooks: list[Any] = []
        self.inner: list[float] = []
        self.solves = 0
        self.controlled = 0
        self.grown = 0
        self.quiet = 0


thread = Thread()
active: list[None] = []  # one entry for each open block of any thread, for a fast test whether anything is counted


class Calls(Counter):
    """Number of calls for each key (name, kind).

    Attributes
    ----------
    seconds : Counter
        For the same keys the time of the calls, without the time of timed calls inside them.
    notes : dict of Counter
        For each key (name, fact) the number of times that each value was noted.
    method_objects : dict of dict
        For each name the objects whose methods were called; the inner keys are their ids.
    """

    def __init__(self, *counts: Any) -> None:
        super().__init__(*counts)
        self.seconds: Any = Counter()
        self.notes: dict[tuple, Counter] = {}
        self.method_objects: dict[str, dict] = {}


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
        # Compare by identity, because two nested blocks with equal counts are equal Counters.
        thread.calls[:] = [other for other in thread.calls if other is not calls]
        active.pop()


def count(name: str, kind: str, times: int = 1) -> None:
    """Add one or more calls of `name` to every open block of this thread."""
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
    """Call a function; if a block is open, count the call, measure its time, and record the object of a method."""
    if not active:
        return function(*args)
    method_object = getattr(function, "__self__", None)
    for calls in thread.calls:
        calls[name, kind] += 1
        if method_object is not None:
            calls.method_objects.setdefault(name, {})[id(method_object)] = method_object
    thread.inner.append(0.0)
    clock = perf_counter()
    try:
        return function(*args)
    finally:
        inclusive = perf_counter() - clock
        exclusive = inclusive - thread.inner.pop()
        spent(name, kind, exclusive, inclusive)


def spent(name: str, kind: str, exclusive: float, inclusive: float) -> None:
    """Add the time of a call; `exclusive` does not contain the time of timed calls inside it, `inclusive` does."""
    if thread.inner:
        thread.inner[-1] += inclusive
    for calls in thread.calls:
        calls.seconds[name, kind] += exclusive
