"""The history of a run of `minimize`, and its convergence test."""

from __future__ import annotations

import time
from math import inf
from typing import TYPE_CHECKING, Any

from sparsedp._utils.counters import thread
from sparsedp.optimize.result import (
    NO_RESIDUALS,
    Evaluation,
    Minimum,
    NoStepFound,
    Record,
    RoundingReached,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from sparsedp.autodiff.flattening import Packing
    from sparsedp.optimize.objective import Objective

__all__ = ["Monitor"]

STATIONARY = 1e-6  # a run that ends by rounding has converged if the relative gradient is below this


class Monitor:
    """Records the history of a run and decides when it stops. It is called with every accepted point.

    Parameters
    ----------
    objective : Objective
    packing : Packing
    tolerance : float or callable
        As for `minimize`.
    callback : callable or None
        As for `minimize`.

    Attributes
    ----------
    history : list of Record
    message : str
        The reason why the run stopped; empty while it continues.
    converged : bool
    """

    def __init__(
        self,
        objective: Objective,
        packing: Packing,
        tolerance: float | Callable[[Record, Record], Any],
        callback: Callable[[Record, Any], Any] | None,
    ):
        self._objective = objective
        self._packing = packing
        self._tolerance = tolerance
        self._callback = callback
        # Added to the clock and to the global counter of solves, these give the time and the solves of this run.
        self._seconds_offset = -time.perf_counter()
        self._solves_offset = -thread.solves
        self.history: list[Record] = []
        self.message = ""
        self.converged = False
        self._first: Any = None  # the evaluation at the start
        self._last: Any = None  # the last accepted evaluation
        self._first_gradient_norm = 0.0

    def resume(self, history: list[Record], first: Evaluation, last: Evaluation) -> None:
        """Continue from the history of a checkpoint.

        Parameters
        ----------
        history : list of Record
        first, last : Evaluation
            The points of the first and of the last record.

        Notes
        -----
        The callback is not called for the last point, so that a run that it stopped continues. If the tolerance is
        already met, the run stops at once.
        """
        self.history = history
        self._seconds_offset += history[-1].seconds
        self._solves_offset = history[-1].solves - thread.solves
        self._first = first
        self._last = last
        self._first_gradient_norm = self._gradient_norm(first)
        self._test_convergence(self._gradient_norm(last))

    @property
    def iteration(self) -> int:
        """Number of the last recorded iteration."""
        return len(self.history) - 1

    def __call__(self, evaluation: Evaluation) -> None:
        """Record an accepted point, and set `message` if the run should stop."""
        gradient_norm = self._gradient_norm(evaluation)
        record = Record(
            len(self.history),
            self._objective.in_units_of_loss(evaluation.value),
            self._objective.in_units_of_loss(gradient_norm),
            self._seconds_offset + time.perf_counter(),
            self._objective.count,
            self._objective.pop_failures(),
            self._solves_offset + thread.solves,
        )
        self.history.append(record)
        if record.iteration == 0:
            self._first = evaluation
            self._first_gradient_norm = gradient_norm
        self._last = evaluation
        self._test_convergence(gradient_norm)
        if self.converged or self._callback is None or record.iteration == 0:
            return
        if self._callback(record, self._packing.unpack(evaluation.point)):
            self.message = "stopped by the callback"

    def _gradient_norm(self, evaluation):
        """Return the norm of the projected gradient, in the units of the evaluations."""
        return self._objective.gradient_norm(evaluation)

    def _test_convergence(self, gradient_norm):
        """Set `converged` and `message` if the tolerance is met.

        `gradient_norm` is in the units of the evaluations, because in the units of the records it may overflow or
        underflow.
        """
        if self._objective.batches.varied:
            self._test_convergence_of_batches()
            return
        if gradient_norm == 0:
            met = True
        elif callable(self._tolerance):
            met = self._tolerance(*self._comparable_records(gradient_norm))
        else:
            met = gradient_norm <= self._tolerance * self._first_gradient_norm
        if not met:
            return
        share = "0"
        if gradient_norm:
            share = f"{gradient_norm / (self._first_gradient_norm or 1.0):.1e} of that at the start"
        gradient = "projected gradient" if self._objective.box.bounded else "gradient"
        self.converged = True
        self.message = f"converged: the {gradient} is {share}"

    def _test_convergence_of_batches(self):
        """Test convergence over all batches: the gradient of a single batch may be small by chance."""
        period = self._objective.batches.period
        first = self.history[0]
        recent = self.history[-period:]
        out_of_range = not 0 < first.gradient_norm < inf
        if out_of_range and self._first_gradient_norm > 0:
            return  # the first gradient norm overflows or underflows, so the records cannot be compared
        if len(recent) < period:
            return
        if callable(self._tolerance):
            met = all(self._tolerance(record, first) for record in recent)
        else:
            met = all(record.gradient_norm <= self._tolerance * first.gradient_norm for record in recent)
        if not met:
            return
        share = max(record.gradient_norm for record in recent) / (first.gradient_norm or 1.0)
        self.converged = True
        self.message = f"converged: the gradients of the last {period} batches are {share:.1e} of that at the start"

    def _comparable_records(self, gradient_norm):
        """Return the last record and the first one, with comparable losses and gradient norms.

        If one of the gradient norms overflows or underflows, which can occur in least-squares problems, the values of
        both records are given in the units of the scaled objective.
        """
        last, first = self.history[-1], self.history[0]
        if 0 < last.gradient_norm < inf and 0 < first.gradient_norm < inf:
            return last, first
        last = last._replace(value=self._last.value, gradient_norm=gradient_norm)
        first = first._replace(value=self._first.value, gradient_norm=self._first_gradient_norm)
        return last, first

    def _is_stationary(self):
        """Return whether the gradient is small relative to that at the start, or relative to |loss| / |x|.

        A run that ends because steps no longer change the loss has not always converged: if the loss has kinks or is
        badly scaled, steps become very short although the gradient is not small.
        """
        gradient_norm = self._gradient_norm(self._last)
        if gradient_norm <= STATIONARY * self._first_gradient_norm:
            return True
        x = self._last.point
        metric = self._objective.metric
        length = max(metric.norm(x), metric.norm(x - self._first.point))
        return length > 0 and gradient_norm <= STATIONARY * (abs(self._last.value) / length)

    def minimum(self, x: Any, method: str, resumed: str = "", covariance: Any = NO_RESIDUALS) -> Minimum:
        """Return the result of the run.

        Parameters
        ----------
        x : tree
            The best point.
        method : str
        resumed : str
        covariance : array or str
            The covariance, or a sentence that says why it is not available.
        """
        return Minimum(
            x=x,
            value=self._objective.in_units_of_loss(self._objective.best.value),
            history=tuple(self.history),
            method=method,
            message=self.message or f"stopped after {self.iteration} iterations, the limit maxiter",
            converged=self.converged,
            evaluations=self._objective.count,
            resumed=resumed,
            _covariance=covariance,
        )

    def stop(self, error: NoStepFound) -> None:
        """End the run after a method has found no acceptable point."""
        if isinstance(error, RoundingReached):
            self.converged = self._is_stationary()
            self.message = self._message_of_rounding()
            return
        refused = ""
        failures = self._objective.pop_failures()
        if failures:
            last = failures[-1]
            refused = f", {len(failures)} points refused ({last.error}: {last.message})"
        advice = "dp.check.gradient(loss, x) tells whether the gradient is right"
        if self._objective.residual_scale:
            advice = f"with loss = lambda x: np.sum(residuals(x) ** 2), {advice}"
        self.message = f"stopped: {error}{refused}; {advice}"

    def _message_of_rounding(self):
        """Return the message of a run that ended because steps change the loss by less than its rounding error."""
        if self.converged:
            return "converged to rounding: the loss cannot fall further in floating point numbers"
        share = self._gradient_norm(self._last) / (self._first_gradient_norm or 1.0)
        return (
            f"stopped: a step changes the loss by less than its rounding, but the gradient is {share:.1e} of "
            "that at the start; smooth the kinks of the loss, subtract a large constant from it, or scale the "
            "unknowns, for fields by metric="
        )
