"""Keeps the history of a run and decides when it stops."""

import time

from sparsedp.ledger import thread
from sparsedp.optimize.result import Minimum, Record
from sparsedp.tree import norm

__all__ = ["Watch"]


class Watch:
    """Keeps the history and decides when to stop. Called with every accepted trial.

    Attributes
    ----------
    history : list of Record
    message : str
        Why the run is over; empty while it goes on.
    converged : bool
    """

    def __init__(self, trials, packing, tolerance, callback):
        self._trials, self._packing, self._tolerance, self._callback = trials, packing, tolerance, callback
        self._seconds, self._solves = -time.perf_counter(), -thread.solves  # at the start, taken off
        self.history, self.message, self.converged = [], "", False

    def resume(self, history):
        """Go on from a history that was kept. A callback stops one run, and a tolerance that is met, this one."""
        self.history, last = history, history[-1]
        self._seconds, self._solves = self._seconds + last.seconds, last.solves - thread.solves
        self._judge(last)

    @property
    def iteration(self):
        """Number of the last recorded iteration."""
        return len(self.history) - 1

    def __call__(self, trial):
        record = Record(
            len(self.history),
            trial.value,
            norm(self._trials.downhill(trial)),
            self._seconds + time.perf_counter(),
            self._trials.count,
            self._trials.pop_failures(),
            self._solves + thread.solves,
        )
        self.history.append(record)
        self._judge(record)
        if not self.converged and self._callback is not None and record.iteration > 0:
            if self._callback(record, self._packing.unpack(trial.vector)):
                self.message = "stopped by the callback"

    def _judge(self, record):
        first, size = self.history[0], record.gradient_norm
        if size == 0:
            met = not self._trials.batches.varied  # a batch may have the gradient 0 alone
        elif callable(self._tolerance):
            met = self._tolerance(record, first)
        else:
            met = size <= self._tolerance * first.gradient_norm
        if met:
            share = f"{size / (first.gradient_norm or 1.0):.1e} of that at the start" if size else 0
            self.converged, self.message = True, f"converged: the gradient is {share}"

    def minimum(self, x, method, **more):
        """What the run comes to."""
        return Minimum(
            x=x, value=self._trials.best.value, history=tuple(self.history), method=method,
            message=self.message or f"stopped after {self.iteration} iterations, as maxiter asks",
            converged=self.converged, evaluations=self._trials.count, **more,
        )  # fmt: skip

    def give_up(self, reason):
        """The method found no admissible point."""
        self.converged = reason == "rounding"
        if self.converged:
            self.message = "converged to rounding: the loss cannot fall further in floating point numbers"
            return
        left = self._trials.pop_failures()
        refused = f", {len(left)} points refused ({left[-1].error}: {left[-1].message})" if left else ""
        hint = "dp.check.gradient(loss, x) tells whether the gradient is right"
        self.message = f"stopped: {reason}{refused}; {hint}"
