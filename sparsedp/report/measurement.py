"""One row of an error-against-time table: a loss and its gradient run warm, timed, weighed and counted."""

import statistics
import tracemalloc
from collections import Counter
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from sparsedp.derivative import value_and_grad
from sparsedp.errors import SparsedpError
from sparsedp.ledger import recording
from sparsedp.tree import leaves

__all__ = ["Task", "failure_word", "measured_row", "task_of", "warmed"]

SETTLED = 2.0  # a run that is not faster than the last one by more is warm
MOST_WARM_UPS = 6
SHORT = 2e-3  # [s]: below, times differ for other reasons
FAILURES = (SparsedpError, ArithmeticError, ValueError, MemoryError, np.linalg.LinAlgError)


class Task(NamedTuple):
    """What a problem gives: a loss with its point, or without a point a run of its own; and facts about it."""

    loss: Any
    x: Any
    facts: dict

    @property
    def runs(self):
        """(function that gives the value or answer, function that gives it with the gradient, or None)."""
        if self.x is None:
            return self.loss, None
        return (lambda: self.loss(self.x)), (lambda: value_and_grad(self.loss)(self.x))

    def answer(self, value):
        """What the forward error is about: the output if the facts name one, else the value."""
        output = self.facts.get("output")
        return np.asarray(value if output is None else output(self.x), float)


def task_of(given):
    """(loss, x) or (loss, x, facts) -> Task."""
    if not isinstance(given, tuple) or len(given) not in (2, 3):
        raise TypeError(
            f"a problem gives (loss, x) or (loss, x, facts), got {type(given).__name__}; write return loss, x"
        )
    loss, x, facts = (*given, {})[:3]
    return Task(loss, x, facts)


def failure_word(error):
    """Status of a run that failed: the word of the solve, or the name of the error."""
    info = getattr(error, "info", None)
    return info.status if info is not None and info.status else type(error).__name__


def measured_row(problem, settings, repeats):
    """Settings of one run -> (row of figures, value, answer, gradient). What fails keeps a row with its status."""
    row: dict[str, Any] = {"status": "ok"}
    try:
        clock = perf_counter()
        task = task_of(problem(**settings))
        row["seconds_setup"] = perf_counter() - clock
        value, gradient = _run(task, row, repeats)
        answer = task.answer(value)
    except FAILURES as error:
        return {"status": failure_word(error)}, None, None
    facts = {name: fact for name, fact in task.facts.items() if name != "output"}
    size = sum(np.size(leaf) for leaf in leaves(task.x)) if task.x is not None else np.size(answer)
    finite = np.all(np.isfinite(answer))
    return {"unknowns": size, **facts, **row, **({} if finite else {"status": "nonfinite"})}, answer, gradient


def _run(task, row, repeats):
    forward, both = task.runs
    calls = warmed(both or forward, row)
    row["solves_forward"] = _sum(calls, "solve")
    row["solves_adjoint"] = _sum(calls, "adjoint")
    row["iterations"] = _sum(calls, "iterations")
    ahead, value = _times(forward, repeats)
    _note(row, "seconds_forward", ahead)
    gradient = None
    if both is not None:
        whole, (value, gradient) = _times(both, repeats)
        _note(row, "seconds_backward", [max(total - min(ahead), 0.0) for total in whole])
    row["peak_bytes"] = _peak(both or forward)
    return value, gradient


def warmed(run, row):
    """Run until the time has settled: compiled code, kept set-ups, imports. Returns the calls of a warm run."""
    with recording() as first:
        before = _seconds(run)
    row["seconds_setup"] = row.get("seconds_setup", 0.0) + _setup(first)
    for _ in range(MOST_WARM_UPS):
        with recording() as calls:
            now = _seconds(run)
        if before <= SETTLED * now + SHORT:  # it does not fall any more
            return calls
        before = now
    row["status"] = "not_warm"
    return calls


def _setup(calls):
    return sum(seconds for (_, kind), seconds in calls.seconds.items() if kind == "setup")


def _seconds(run):
    clock = perf_counter()
    run()
    return perf_counter() - clock


def _times(run, repeats):
    found, result = [], None
    for _ in range(repeats):
        clock = perf_counter()
        result = run()
        found.append(perf_counter() - clock)
    return found, result


def _note(row, name, seconds):
    """The least, the median and the largest of the repeats; NaN when the caches never got warm."""
    known = row["status"] == "ok"
    row[name] = min(seconds) if known else np.nan
    row[f"{name}_median"] = statistics.median(seconds) if known else np.nan
    row[f"{name}_max"] = max(seconds) if known else np.nan


def _peak(run):
    """Bytes that a run holds at most, beyond what there was before, as Python's allocator sees it."""
    running = tracemalloc.is_tracing()
    if not running:
        tracemalloc.start()
    try:
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        run()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        if not running:
            tracemalloc.stop()


def _sum(calls, wanted):
    totals: Counter = Counter()
    for (_, kind), many in calls.items():
        totals[kind] += many
    return totals[wanted]
