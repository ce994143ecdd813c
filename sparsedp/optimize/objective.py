"""The loss of `minimize` as a function of a flat vector, with its evaluation count, failed points and best point."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import norm, safe_unit
from sparsedp.autodiff.derivative import check_loss, checking_derivatives, pullback, unwarned, value_and_grad
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, UnstableStepError
from sparsedp.optimize.linearization import Linearization
from sparsedp.optimize.metric import EUCLIDEAN
from sparsedp.optimize.result import NO_RESIDUALS, Evaluation, Failure, NoStepFound, RoundingReached
from sparsedp.solvers.cache import Cache

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing
    from sparsedp.optimize.batches import Batches
    from sparsedp.optimize.box import Box
    from sparsedp.optimize.metric import Euclidean

__all__ = ["SMALLEST", "SUFFICIENT", "Objective"]

SUFFICIENT = 1e-4  # minimum of actual / predicted decrease for an accepted step (Armijo condition)
SMALLEST = 5e-324  # smallest positive float, the minimum of the estimated rounding error of a loss
ROUNDINGS = 100  # a predicted decrease below this multiple of the rounding error cannot be observed
CLEAR_ROUNDINGS = 2000  # a predicted decrease above this multiple of the rounding error can be observed
TRIAL_ERRORS = (UnstableStepError, ConvergenceError, NonFiniteError)  # at trial points they count as an infinite loss


class Objective:
    """The loss as a function of a flat vector.

    Parameters
    ----------
    loss : callable
        ``loss(x, *batch)``, where x is a tree.
    gradient : callable or None
        ``gradient(x, *batch)``; None: reverse-mode differentiation.
    packing : Packing
        The map between trees and flat vectors.
    box : Box
        The bounds.
    batches : Batches
    residual_options : least-squares method, optional
        If given, the loss returns residuals r, and the objective is |r / s|^2 / 2. The power of two s prevents
        underflow and overflow of squared residuals. The attributes `apart`, `forms_jacobian` and `absolute_sigma` of
        this object are the options for the Jacobian and the covariance.
    metric : Euclidean or Metric

    Attributes
    ----------
    iteration : int
        Number of the current iteration, which determines the batch. The loop of `minimize` sets it.
    best : Evaluation
        The best point so far; with batches, the last point.
    count : int
        Number of evaluations so far.
    failures : list of Failure
        Points at which the loss could not be evaluated, since the last call of `pop_failures`.
    residual_scale : float or None
        The power of two s; None until the first residuals are known.
    """

    best: Evaluation

    def __init__(
        self,
        loss: Callable[..., Any],
        gradient: Callable[..., Any] | None,
        packing: Packing,
        box: Box,
        batches: Batches,
        residual_options: Any = None,
        metric: Euclidean = EUCLIDEAN,
    ):
        self._loss = loss
        self._gradient = gradient
        self._packing = packing
        self._residual_options = residual_options
        self._linearizations = Cache(1)
        self.metric = metric
        self.box = box
        self.batches = batches
        self.iteration = 0
        self.count = 0
        self.failures: list[Failure] = []
        self.residual_scale: float | None = None

    def evaluate_start(self, vector: NDArray[np.float64]) -> Evaluation:
        """Return the evaluation at the start. Exceptions of the loss are not caught."""
        self.best = self._evaluate(vector)
        return self.best

    def __call__(self, vector: NDArray[np.float64], below: float = np.inf) -> Evaluation:
        """Return the evaluation at a point; the value is infinity if the loss raises one of `TRIAL_ERRORS`.

        Parameters
        ----------
        vector : (n,) array
        below : float
            In least-squares problems the gradient is computed only if the value is below this bound.
        """
        try:
            evaluation = self._evaluate(vector, below)
        except TRIAL_ERRORS as error:
            self.failures.append(Failure(type(error).__name__, str(error)))
            return Evaluation(np.array(vector), np.inf, np.full_like(vector, np.nan))
        # Losses of different batches cannot be compared; with batches the last point is the result.
        if self.batches.varied or evaluation.value < self.best.value:
            self.best = evaluation
        return evaluation

    def first_lower(
        self, current: Evaluation, candidates: Iterable[tuple[Any, float, Any]], failure: str
    ) -> tuple[Evaluation, float, Any]:
        """Return the first candidate at which the loss is sufficiently lower than at the current point.

        Parameters
        ----------
        current : Evaluation
        candidates : iterable of (vector, decrease, label)
            Trial points that approach the current point. `decrease` is the predicted decrease of the loss; `label` is
            any value, which is returned for the accepted candidate.
        failure : str
            The message of the exception if no candidate is accepted.

        Returns
        -------
        (Evaluation, float, label)
            The accepted point, its actual decrease divided by the predicted one, and its label.

        Raises
        ------
        RoundingReached
            If no candidate is accepted, and the first predicted decrease is too small to be observed beside the
            rounding error of the loss.
        NoStepFound
            If no candidate is accepted for another reason.
        """
        decreases: list[float] = []
        for vector, decrease, label in candidates:
            evaluation = self(vector, current.value)
            if evaluation.value < current.value and current.value - evaluation.value >= SUFFICIENT * decrease:
                share = (current.value - evaluation.value) / decrease if decrease > 0 else 0.0
                return evaluation, share, label
            decreases.append(abs(decrease))  # clipping can make it negative for a long step but not for a shorter one
            if decreases[-1] <= current.rounding:
                break
        lost_in_rounding = decreases[0] <= ROUNDINGS * current.rounding
        if lost_in_rounding and not self.failures:
            raise RoundingReached(failure)
        raise NoStepFound(failure)

    def decrease_is_visible(self, current: Evaluation, step: NDArray[np.float64]) -> bool:
        """Return whether the decrease that the gradient predicts for a step is far above the rounding error."""
        return -float(np.dot(current.gradient, step)) > CLEAR_ROUNDINGS * current.rounding

    def _evaluate(self, vector, below=np.inf):
        """Return the evaluation at a point; exceptions of the loss are not caught."""
        self.count += 1
        if self._residual_options is None:
            value, gradient = self._value_and_gradient(vector)
        else:
            value, gradient = self._sum_of_squares(vector, below)
        if not np.isfinite(value):
            raise NonFiniteError(f"the loss is {value}; start where it is finite")
        rounded = self._packing.pack(self._packing.unpack(vector))  # rounds the entries of single-precision leaves
        rounding = max(self._packing.eps * abs(value), SMALLEST)
        return Evaluation(rounded, value, gradient, rounding, self.iteration)

    def _sum_of_squares(self, vector, below):
        """Return half the sum of squares of the scaled residuals, and its gradient J^T r."""
        linearization = self._linearize(vector, self.iteration)
        with np.errstate(over="ignore"):  # the caller raises NonFiniteError for infinity
            value = 0.5 * float(np.dot(linearization.flat, linearization.flat))
        if not value < below:
            return value, None
        return value, linearization.vjp(linearization.flat)

    def _linearize(self, vector, iteration):
        """Return the linearization at a point, with the batch of an iteration. The last one is cached."""
        batch = self.batches.at(iteration)
        key = vector, iteration if batch else 0
        cached = self._linearizations.find(key)
        if cached:
            return cached
        options = self._residual_options
        linearization = Linearization(self._loss, self._packing, vector, batch, options.apart, options.forms_jacobian)
        if self.residual_scale is None:
            self.residual_scale = safe_unit(norm(linearization.flat))
        return self._linearizations.put(key, linearization.rescaled(self.residual_scale))

    def _value_and_gradient(self, vector):
        """Return the loss and its flat gradient. Each call of a user's function gets a new tree that it may modify."""
        with unwarned():  # pack_gradient raises NonFiniteError for a gradient that is not finite
            batch = self.batches.at(self.iteration)
            tree = self._packing.unpack(vector)
            if self._gradient is None:
                value, gradient = value_and_grad(self._loss)(tree, *batch)
            else:
                value = self._loss(tree, *batch)
                gradient = self._gradient(self._packing.unpack(vector), *batch)
            check_loss(value)
            try:
                return float(value), self._packing.pack_gradient(gradient)
            except NonFiniteError:
                if self._gradient is None:
                    with checking_derivatives():  # a second run raises at the function whose derivative is not finite
                        value_and_grad(self._loss)(self._packing.unpack(vector), *batch)
                raise

    def in_units_of_loss(self, number: float) -> float:
        """Convert a value or gradient norm of the scaled objective to the value or norm of the user's loss."""
        scale = self.residual_scale or 1.0
        return number * scale * scale

    def linearization(self, evaluation: Evaluation) -> Linearization:
        """Return the linearization of the scaled residuals at a point, with the batch of its evaluation."""
        return self._linearize(evaluation.point, evaluation.iteration)

    def covariance(self, evaluation: Evaluation) -> NDArray[np.float64] | str:
        """Return the covariance of the unknowns at a point, or a sentence that says why it is not available."""
        if self._residual_options is None:
            return NO_RESIDUALS
        if self.batches.varied:
            return "no batch holds all residuals; call minimize without batches"
        return self.linearization(evaluation).covariance(self._residual_options.absolute_sigma)

    def hessian_product(self, evaluation: Evaluation) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """Return a function that multiplies the Hessian at a point by flat vectors.

        Entries of the product are 0 if the unknown is held at a bound (see `free`). The gradient computation is
        recorded once, so that each product is one backward pass.
        """
        if self._gradient is not None:
            raise TypeError("newton_cg differentiates the loss twice and does not use gradient; leave it out")
        packing = self._packing
        if packing.complex:
            raise DerivativeError("newton_cg takes real numbers, got complex ones; split them into two real arrays")
        batch = self.batches.at(evaluation.iteration)
        free = self.free(evaluation)

        def flat_gradient(x):
            return packing.traced(value_and_grad(self._loss)(x, *batch)[1])

        gradient, pull = pullback(flat_gradient, packing.unpack(evaluation.point))

        def product(vector):
            cotangent = np.asarray(vector, dtype=gradient.dtype)
            return np.where(free, packing.pack_gradient(pull(cotangent)), 0.0)

        return product

    def free(self, evaluation: Evaluation) -> NDArray[np.bool_]:
        """Return False for unknowns at a bound that a step along the negative gradient would violate, else True."""
        return self.box.free(evaluation.point, evaluation.gradient)

    def projected_gradient(self, evaluation: Evaluation) -> Any:
        """Return the gradient with entries set to 0 for unknowns that are held at a bound (see `free`)."""
        return np.where(self.free(evaluation), evaluation.gradient, 0.0)

    def gradient_norm(self, evaluation: Evaluation) -> float:
        """Return the norm of the projected gradient, in the units of the evaluations; see `Record`."""
        return self.metric.dual_norm(self.projected_gradient(evaluation))

    def pop_failures(self) -> tuple[Failure, ...]:
        """Return the failed points since the last call, and clear the list."""
        failures = tuple(self.failures)
        self.failures = []
        return failures
