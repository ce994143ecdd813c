"""Evaluations of a loss and its gradient: counted, refused ones kept apart, the best one remembered."""

from typing import NamedTuple

import numpy as np

from sparsedp.derivative import value_and_grad
from sparsedp.errors import ConvergenceError, NonFiniteError, ShapeError, UnstableStepError

__all__ = ["Failure", "Trial", "Trials", "norm"]

REFUSED = (UnstableStepError, ConvergenceError, NonFiniteError)


class Failure(NamedTuple):
    """A trial point that the loss refused."""

    error: str
    message: str


class Trial(NamedTuple):
    """A point, the loss and the flat gradient there. A refused point has the value infinity and no gradient."""

    vector: np.ndarray
    value: float
    slope: np.ndarray | None
    rounding: float = 0.0  # a smaller change of the loss is not seen

    @property
    def refused(self):
        """Whether the loss has no value here."""
        return self.slope is None


class Trials:
    """The loss on flat vectors.

    Parameters
    ----------
    loss : callable
    gradient : callable or None
        None: reverse mode.
    packing : Packing
    """

    best: Trial

    def __init__(self, loss, gradient, packing):
        self._loss, self._gradient = loss, gradient
        self._packing = packing
        self.count = 0
        self.failures = []

    def first(self, vector):
        """The trial at the start; what the loss raises there is not caught."""
        self.best = self._evaluate(vector)
        return self.best

    def __call__(self, vector):
        """The trial at a point. An error that is part of searching counts as the value infinity."""
        try:
            trial = self._evaluate(vector)
        except REFUSED as error:
            self.failures.append(Failure(type(error).__name__, str(error)))
            return Trial(np.array(vector), np.inf, None)
        if trial.value < self.best.value:
            self.best = trial
        return trial

    def _evaluate(self, vector):
        self.count += 1
        value, gradient = self._both(vector)
        if not np.isfinite(value):
            raise NonFiniteError(f"the loss is {value}; it must be finite at the start, and elsewhere it is avoided")
        slope = self._packing.pack_gradient(gradient)
        rounded = self._packing.pack(self._packing.unpack(vector))  # single-precision leaves round
        return Trial(rounded, value, slope, self._packing.eps * abs(value))

    def _both(self, vector):
        """Loss and gradient, each from a fresh tree."""
        tree = self._packing.unpack(vector)
        if self._gradient is None:
            return value_and_grad(self._loss)(tree)
        value = self._loss(tree)
        if np.shape(value) != ():
            raise ShapeError(f"the loss must be a scalar, got an array of shape {np.shape(value)}; sum it")
        return float(value), self._gradient(self._packing.unpack(vector))

    def pop_failures(self):
        """The refused points since the last call."""
        failures, self.failures = tuple(self.failures), []
        return failures


def norm(vector):
    """Euclidean norm without overflow or underflow."""
    largest = float(np.max(np.abs(vector), initial=0.0))
    return largest * float(np.linalg.norm(vector / largest)) if 0 < largest < np.inf else largest
