"""Keeps the history of a run and decides when it stops."""

import time
from math import inf
from typing import Any

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import norm
from sparsedp.optimize.result import Minimum, Record

__all__ = ["Watch"]

FLAT = 1e-6  # share of a gradient below which a search that ends in rounding is at a stationary point


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
        self._first_size = 0.0  # of the gradient at the start
        self._first: Any = None  # the trial there
        self._last: Any = None  # the last accepted trial

    def resume(self, history, first, last):
        """Continue from a history that was kept, and the trials at its ends.

        A callback stops one run only; a tolerance that is met stops this one too.
        """
        self.history, record = history, history[-1]
        self._seconds, self._solves = self._seconds + record.seconds, record.solves - thread.solves
        self._first_size, self._first, self._last = self._size(first), first, last
        self._judge(self._size(last))

    @property
    def iteration(self):
        """Number of the last recorded iteration."""
        return len(self.history) - 1

    def __call__(self, trial):
        size = self._size(trial)
        record = Record(
            len(self.history),
            self._trials.as_given(trial.value),
            self._trials.as_given(size),
            self._seconds + time.perf_counter(),
            self._trials.count,
            self._trials.pop_failures(),
            self._solves + thread.solves,
        )
        self.history.append(record)
        if record.iteration == 0:
            self._first_size, self._first = size, trial
        self._last = trial
        self._judge(size)
        if not self.converged and self._callback is not None and record.iteration > 0:
            if self._callback(record, self._packing.unpack(trial.vector)):
                self.message = "stopped by the callback"

    def _size(self, trial):
        """Return the norm of the gradient without the entries that bounds hold, in the units of the trials."""
        return norm(self._trials.downhill(trial))

    def _judge(self, size):
        """Decide by the size of the last gradient; that of its record may have left the range of floats."""
        if self._trials.batches.varied:
            self._judge_batches()
            return
        if size == 0:
            met = True
        elif callable(self._tolerance):
            met = self._tolerance(*self._comparable(size))
        else:
            met = size <= self._tolerance * self._first_size
        if met:
            share = f"{size / (self._first_size or 1.0):.1e} of that at the start" if size else 0
            gradient = "projected gradient" if self._trials.box.bounded else "gradient"
            self.converged, self.message = True, f"converged: the {gradient} is {share}"

    def _judge_batches(self):
        """Decide by the last pass over the batches: one of them alone may have a small gradient."""
        first, recent = self.history[0], self.history[-self._trials.batches.period :]
        if self._first_size > 0 and not 0 < first.gradient_norm < inf:
            return  # the gradients of the records have left the range of floats and cannot be compared
        if callable(self._tolerance):
            met = all(self._tolerance(record, first) for record in recent)
        else:
            met = all(record.gradient_norm <= self._tolerance * first.gradient_norm for record in recent)
        if met and len(recent) == self._trials.batches.period:
            share = max(record.gradient_norm for record in recent) / (first.gradient_norm or 1.0)
            self.converged = True
            self.message = (
                f"converged: the gradients of the last {len(recent)} batches are {share:.1e} of that at the start"
            )

    def _comparable(self, size):
        """Return the last record and the first one, with losses and gradients that can be compared.

        Where those of least squares have left the range of floats, both are in the units of the trials.
        """
        ends = self.history[-1], self.history[0]
        if all(0 < record.gradient_norm < inf for record in ends):
            return ends
        values = zip(ends, (self._last, self._first), (size, self._first_size), strict=True)
        return tuple(record._replace(value=trial.value, gradient_norm=gradient) for record, trial, gradient in values)

    def _is_flat(self):
        """Return whether the gradient is small beside that at the start, or beside the loss per length of x.

        Where a loss has kinks, or is badly scaled, steps become so short that no change of the loss is seen although
        the gradient is not small.
        """
        size, x = self._size(self._last), self._last.vector
        if size <= FLAT * self._first_size:
            return True
        length = max(norm(x), norm(x - self._first.vector))
        return length > 0 and size <= FLAT * (abs(self._last.value) / length)

    def minimum(self, x, method, **more):
        """What the run comes to."""
        return Minimum(
            x=x, value=self._trials.as_given(self._trials.best.value), history=tuple(self.history), method=method,
            message=self.message or f"stopped after {self.iteration} iterations, as maxiter asks",
            converged=self.converged, evaluations=self._trials.count, **more,
        )  # fmt: skip

    def give_up(self, reason):
        """End the run of a method that found no admissible point."""
        if reason == "rounding":
            self.converged = self._is_flat()
            if self.converged:
                self.message = "converged to rounding: the loss cannot fall further in floating point numbers"
            else:
                share = self._size(self._last) / (self._first_size or 1.0)
                self.message = (
                    f"stopped: a step changes the loss by less than its rounding, but the gradient is {share:.1e} of "
                    "that at the start; smooth the kinks of the loss, or subtract a large constant from it"
                )
            return
        left = self._trials.pop_failures()
        refused = f", {len(left)} points refused ({left[-1].error}: {left[-1].message})" if left else ""
        summed = "with loss = lambda x: np.sum(residuals(x) ** 2), " if self._trials.residual_scale else ""
        hint = f"{summed}dp.check.gradient(loss, x) tells whether the gradient is right"
        self.message = f"stopped: {reason}{refused}; {hint}"
