"""Keeps the history of a run and decides when it stops."""

import time

from sparsedp.ledger import thread
from sparsedp.optimize.result import Record
from sparsedp.tree import norm

__all__ = ["Watch"]


class Watch:
    """Keeps the history and decides when to stop. Called with every accepted trial; true means stop."""

    def __init__(self, trials, packing, tolerance, callback, bar):
        self._trials, self._packing = trials, packing
        self._tolerance, self._callback, self.bar = tolerance, callback, bar
        self._clock = time.perf_counter()
        self._before, self._solves = 0.0, -thread.solves
        self.history = []
        self.stopped = ""

    def resume(self, history, stopped):
        """Go on from a history that was kept. A callback stops one run, and a tolerance that is met, this one."""
        self.history = list(history)
        self._before = self.history[-1].seconds
        self._solves = self.history[-1].solves - thread.solves
        if stopped == "converged" and (callable(self._tolerance) or self._met(self.history[-1])):
            self.stopped = stopped

    @property
    def iteration(self):
        """Number of the last recorded iteration."""
        return len(self.history) - 1

    def __call__(self, trial):
        seconds = self._before + time.perf_counter() - self._clock
        failed = self._trials.pop_failures()
        size, solves = norm(self._trials.downhill(trial)), self._solves + thread.solves
        record = Record(len(self.history), trial.value, size, seconds, self._trials.count, failed, solves)
        self.history.append(record)
        self.bar.show(record)
        if self._met(record):
            self.stopped = "converged"
        elif self._callback is not None and record.iteration > 0:
            if self._callback(record, self._packing.unpack(trial.vector)):
                self.stopped = "stopped by the callback"
        return bool(self.stopped)

    def _met(self, record):
        first = self.history[0]
        if record.gradient_norm == 0 and not self._trials.batches.varied:
            return True
        if callable(self._tolerance):
            return bool(self._tolerance(record, first))
        goal = self._tolerance * first.gradient_norm
        return record.gradient_norm < goal or (record.gradient_norm == goal and not self._trials.batches.varied)

    def reason(self, stuck):
        """(message, converged) of a run that is over; `stuck` is why the method gave up, if it did."""
        last, first = self.history[-1], self.history[0]
        if self.stopped == "converged":
            if last.gradient_norm == 0:
                return "converged: the gradient is 0", True
            return (
                f"converged: the gradient is {last.gradient_norm / first.gradient_norm:.1e} of that at the start",
                True,
            )
        if self.stopped:
            return self.stopped, False
        if stuck == "rounding":
            return "converged to rounding: the loss cannot fall further in floating point numbers", True
        if stuck:
            left = self._trials.pop_failures()
            refused = f", {len(left)} points refused ({left[-1].error}: {left[-1].message})" if left else ""
            return f"stopped: {stuck}{refused}; dp.check.gradient(loss, x) tells whether the gradient is right", False
        return f"stopped after {last.iteration} iterations, as maxiter asks", False
