"""Evaluations of a loss and its gradient: counted, refused ones kept apart, the best one remembered."""

from typing import Any

import numpy as np

from sparsedp._utils.pytree import norm, safe_unit
from sparsedp.autodiff.derivative import check_loss, judged, pullback, unwarned, value_and_grad
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, UnstableStepError
from sparsedp.optimize.linearised import Linearised
from sparsedp.optimize.result import NO_RESIDUALS, Failure, Stuck, Trial
from sparsedp.solvers.cache import Cache

__all__ = ["Trials"]

ENOUGH = 1e-4  # share of the predicted fall that is asked for (Armijo)
SMALLEST = 5e-324  # float: no loss changes by less
REFUSED = (UnstableStepError, ConvergenceError, NonFiniteError)


class Trials:
    """The loss on flat vectors.

    Parameters
    ----------
    loss : callable
    gradient : callable or None
        None: reverse mode.
    packing : Packing
    box : Box
        The points that are allowed.
    batches : Batches
        What the loss is given after x.
    squares : method of least squares, or None
        With one, the loss returns residuals r, and what falls is |r / s|^2 / 2 with a power of two s, so that small
        residuals do not underflow when they are squared, nor large ones overflow; its `apart` and `dense` say how
        their Jacobian is found.

    Attributes
    ----------
    iteration : int
        The present one, whose batch new points see; moved by the loop.
    best : Trial
    count : int
        Evaluations so far.
    residual_scale : float or None
        The power of two that residuals are divided by; None until the first residuals are known.
    """

    best: Trial

    def __init__(self, loss, gradient, packing, box, batches, squares=None):
        self._loss, self._gradient, self._packing = loss, gradient, packing
        self._squares, self._linearised = squares, Cache(1)
        self.residual_scale: Any = None
        self.box, self.batches, self.iteration = box, batches, 0
        self.count, self.failures = 0, []

    def first(self, vector):
        """The trial at the start; what the loss raises there is not caught."""
        self.best = self._evaluate(vector)
        return self.best

    def __call__(self, vector, below=np.inf):
        """The trial at a point. An error that is part of searching counts as the value infinity.

        The gradient of residuals is left out unless their loss is below what is asked for.
        """
        try:
            trial = self._evaluate(vector, below)
        except REFUSED as error:
            self.failures.append(Failure(type(error).__name__, str(error)))
            return Trial(np.array(vector), np.inf, np.full_like(vector, np.nan))
        if self.batches.varied or trial.value < self.best.value:
            self.best = trial  # losses of two batches cannot be compared: the last point stands
        return trial

    def lower(self, here, tries, unless):
        """The first of some points where the loss is lower than here by enough.

        Parameters
        ----------
        here : Trial
        tries : iterable of (vector, fall, anything)
            A point, how far the loss should fall, and what tells one try from the next; they come ever closer.
        unless : str
            Why a method gives up that finds none.

        Returns
        -------
        (Trial, gain, anything)
            gain: the share of the fall that was predicted.

        Raises
        ------
        Stuck
            When there is none; "rounding" when the first was not expected to fall by more than that.
        """
        falls: list = []
        for vector, fall, mark in tries:
            trial = self(vector, here.value)
            if trial.value < here.value and here.value - trial.value >= ENOUGH * fall:
                return trial, (here.value - trial.value) / fall if fall > 0 else 0.0, mark
            falls.append(abs(fall))
            if falls[-1] <= here.rounding:  # below 0 where bounds turn a long step uphill: a shorter one may do
                break
        hopeless = falls[0] <= 100 * here.rounding and not self.failures
        raise Stuck("rounding" if hopeless else unless)

    def seen_to_fall(self, here, step):
        """Return whether the gradient predicts that the loss falls along a step by far more than its rounding."""
        return -float(np.dot(here.slope, step)) > 2000 * here.rounding

    def _evaluate(self, vector, below=np.inf):
        self.count += 1
        value, slope = self._both(vector) if self._squares is None else self._summed(vector, below)
        if not np.isfinite(value):
            raise NonFiniteError(f"the loss is {value}; it must be finite at the start, and elsewhere it is avoided")
        rounded = self._packing.pack(self._packing.unpack(vector))  # single-precision leaves round
        return Trial(rounded, value, slope, max(self._packing.eps * abs(value), SMALLEST), self.iteration)

    def _summed(self, vector, below):
        """Return half the sum of squares of the scaled residuals, and its gradient J^T r."""
        here = self._linearise(vector, self.iteration)
        with np.errstate(over="ignore"):  # infinity is refused
            value = 0.5 * float(np.dot(here.flat, here.flat))
        return value, here.pull(here.flat) if value < below else None

    def as_given(self, number):
        """Return a loss, or the norm of a gradient, in the units of the user's loss: trials have scaled residuals."""
        scale = self.residual_scale or 1.0
        return number * scale * scale

    def _linearise(self, vector, iteration):
        """The residuals and their Jacobian at a point, on the batch of an iteration; kept for the last point."""
        batch, squares = self.batches.at(iteration), self._squares
        key = vector, iteration if batch else 0
        known = self._linearised.find(key)
        if known:
            return known
        linearised = Linearised(self._loss, self._packing, vector, batch, squares.apart, squares.dense)
        if self.residual_scale is None:
            self.residual_scale = safe_unit(norm(linearised.flat))
        return self._linearised.put(key, linearised.rescaled(self.residual_scale))

    def _both(self, vector):
        """Loss and flat gradient, each from a fresh tree."""
        with unwarned():  # a gradient that is not finite is refused below
            return self._value_and_gradient(vector)

    def _value_and_gradient(self, vector):
        tree, batch = self._packing.unpack(vector), self.batches.at(self.iteration)
        if self._gradient is None:
            value, gradient = value_and_grad(self._loss)(tree, *batch)
        else:
            value, gradient = self._loss(tree, *batch), self._gradient(self._packing.unpack(vector), *batch)
        check_loss(value)
        try:
            return float(value), self._packing.pack_gradient(gradient)
        except NonFiniteError:
            if self._gradient is None:
                with judged():  # a second run tells the call that is to blame, if one is
                    value_and_grad(self._loss)(self._packing.unpack(vector), *batch)
            raise

    def linearised(self, trial):
        """Return the residuals at a point and their Jacobian, on the batch that saw it."""
        return self._linearise(trial.vector, trial.iteration)

    def covariance(self, trial):
        """Return the covariance at a point as an array, or a sentence that says why there is none."""
        if self._squares is None:
            return NO_RESIDUALS
        if self.batches.varied:
            return "no batch holds all residuals; call minimize without batches"
        return self._linearise(trial.vector, trial.iteration).covariance(self._squares.absolute_sigma)

    def curvature(self, trial):
        """Function from a flat vector to the Hessian times it, in what the bounds leave free at a point.

        One tape, and one backward pass for each product.
        """
        if self._gradient is not None:
            raise TypeError("newton_cg differentiates the loss twice and takes no gradient of yours; leave it out")
        batch, packing, free = self.batches.at(trial.iteration), self._packing, self.free(trial)
        if packing.complex:
            raise DerivativeError("newton_cg takes real numbers, got complex ones; split them into two real arrays")
        slope, pull = pullback(
            lambda x: packing.traced(value_and_grad(self._loss)(x, *batch)[1]), packing.unpack(trial.vector)
        )
        return lambda v: np.where(free, packing.pack_gradient(pull(np.asarray(v, dtype=slope.dtype))), 0.0)

    def free(self, trial):
        """Which unknowns the bounds let go downhill at a point."""
        return self.box.free(trial.vector, trial.slope)

    def downhill(self, trial):
        """The gradient, 0 where the bounds hold an unknown."""
        return np.where(self.free(trial), trial.slope, 0.0)

    def pop_failures(self):
        """The refused points since the last call."""
        failures, self.failures = tuple(self.failures), []
        return failures
