"""The loss of `minimize` on flat vectors: evaluations are counted, refused points listed, the best point kept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import norm, safe_unit
from sparsedp.autodiff.derivative import check_loss, checking_derivatives, pullback, unwarned, value_and_grad
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, UnstableStepError
from sparsedp.optimize.linearization import Linearization
from sparsedp.optimize.result import NO_RESIDUALS, Evaluation, Failure, NoStepFound, RoundingReached
from sparsedp.solvers.cache import Cache

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing
    from sparsedp.optimize.batches import Batches
    from sparsedp.optimize.box import Box

__all__ = ["SMALLEST", "SUFFICIENT", "Objective"]

SUFFICIENT = 1e-4  # share of the predicted decrease that a step must reach (Armijo)
SMALLEST = 5e-324  # smallest positive float: no loss changes by less
ROUNDINGS = 100  # a predicted decrease below this multiple of the rounding of the loss is not visible
CLEAR_ROUNDINGS = 2000  # one above this multiple is visible
REFUSALS = (UnstableStepError, ConvergenceError, NonFiniteError)  # errors that mark a point as not admissible


class Objective:
    """The loss on flat vectors.

    Parameters
    ----------
    loss : callable
        ``loss(x, *batch)`` of trees.
    gradient : callable or None
        ``gradient(x, *batch)``; None: reverse mode.
    packing : Packing
        Maps trees to flat vectors.
    box : Box
        The admissible points.
    batches : Batches
    residual_options : least-squares method, optional
        If given, the loss returns residuals r, and the objective is |r / s|^2 / 2 with a power of two s, so that
        squares of small residuals do not underflow and those of large ones do not overflow. Its attributes `apart`,
        `forms_jacobian` and `absolute_sigma` say how their Jacobian is computed.

    Attributes
    ----------
    iteration : int
        Number of the current iteration, which selects the batch of new points; set by the loop.
    best : Evaluation
    count : int
        Evaluations so far.
    failures : list of Failure
        Points refused since the last call of `pop_failures`.
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
    ):
        self._loss = loss
        self._gradient = gradient
        self._packing = packing
        self._residual_options = residual_options
        self._linearizations = Cache(1)
        self.box = box
        self.batches = batches
        self.iteration = 0
        self.count = 0
        self.failures: list[Failure] = []
        self.residual_scale: float | None = None

    def evaluate_start(self, vector: NDArray[np.float64]) -> Evaluation:
        """Return the evaluation at the start; errors of the loss are not caught."""
        self.best = self._evaluate(vector)
        return self.best

    def __call__(self, vector: NDArray[np.float64], below: float = np.inf) -> Evaluation:
        """Return the evaluation at a point; errors that mark it as not admissible count as the value infinity.

        Parameters
        ----------
        vector : (n,) array
        below : float
            The gradient of residuals is omitted unless the value is below this bound.
        """
        try:
            evaluation = self._evaluate(vector, below)
        except REFUSALS as error:
            self.failures.append(Failure(type(error).__name__, str(error)))
            return Evaluation(np.array(vector), np.inf, np.full_like(vector, np.nan))
        # Losses of two batches cannot be compared: then the last point is the result.
        if self.batches.varied or evaluation.value < self.best.value:
            self.best = evaluation
        return evaluation

    def first_lower(
        self, current: Evaluation, candidates: Iterable[tuple[Any, float, Any]], failure: str
    ) -> tuple[Evaluation, float, Any]:
        """Return the first of some points at which the loss is sufficiently lower than at the current one.

        Parameters
        ----------
        current : Evaluation
        candidates : iterable of (vector, decrease, label)
            A point, the predicted decrease of the loss, and any value that tells candidates apart. They approach the
            current point.
        failure : str
            The message if there is none.

        Returns
        -------
        (Evaluation, float, label)
            With the share of the predicted decrease that was reached.

        Raises
        ------
        RoundingReached
            If there is none, and the first predicted decrease is lost in the rounding of the loss.
        NoStepFound
            If there is none for another reason.
        """
        decreases: list[float] = []
        for vector, decrease, label in candidates:
            evaluation = self(vector, current.value)
            if evaluation.value < current.value and current.value - evaluation.value >= SUFFICIENT * decrease:
                share = (current.value - evaluation.value) / decrease if decrease > 0 else 0.0
                return evaluation, share, label
            decreases.append(abs(decrease))  # bounds can make it negative for a long step; a shorter one may do
            if decreases[-1] <= current.rounding:
                break
        lost_in_rounding = decreases[0] <= ROUNDINGS * current.rounding
        if lost_in_rounding and not self.failures:
            raise RoundingReached(failure)
        raise NoStepFound(failure)

    def decrease_is_visible(self, current: Evaluation, step: NDArray[np.float64]) -> bool:
        """Return whether the gradient predicts a decrease along a step that exceeds the rounding of the loss by far."""
        return -float(np.dot(current.gradient, step)) > CLEAR_ROUNDINGS * current.rounding

    def _evaluate(self, vector, below=np.inf):
        """Return the evaluation at a point, or raise the error of the loss."""
        self.count += 1
        if self._residual_options is None:
            value, gradient = self._value_and_gradient(vector)
        else:
            value, gradient = self._sum_of_squares(vector, below)
        if not np.isfinite(value):
            raise NonFiniteError(f"the loss is {value}; start where it is finite")
        rounded = self._packing.pack(self._packing.unpack(vector))  # single-precision leaves round
        rounding = max(self._packing.eps * abs(value), SMALLEST)
        return Evaluation(rounded, value, gradient, rounding, self.iteration)

    def _sum_of_squares(self, vector, below):
        """Return half the sum of squares of the scaled residuals, and its gradient J^T r."""
        linearization = self._linearize(vector, self.iteration)
        with np.errstate(over="ignore"):  # infinity is refused
            value = 0.5 * float(np.dot(linearization.flat, linearization.flat))
        if not value < below:
            return value, None
        return value, linearization.vjp(linearization.flat)

    def _linearize(self, vector, iteration):
        """Return the residuals and their Jacobian at a point, on the batch of an iteration; kept for the last point."""
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
        """Return the loss and its flat gradient. Each call of the user's functions gets a fresh tree."""
        with unwarned():  # a gradient that is not finite is refused below
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
        """Return a loss, or the norm of a gradient, of scaled residuals in the units of the user's loss."""
        scale = self.residual_scale or 1.0
        return number * scale * scale

    def linearization(self, evaluation: Evaluation) -> Linearization:
        """Return the scaled residuals at a point and their Jacobian, on the batch of that evaluation."""
        return self._linearize(evaluation.point, evaluation.iteration)

    def covariance(self, evaluation: Evaluation) -> NDArray[np.float64] | str:
        """Return the covariance of the unknowns at a point, or the reason why it is not known."""
        if self._residual_options is None:
            return NO_RESIDUALS
        if self.batches.varied:
            return "no batch holds all residuals; call minimize without batches"
        return self.linearization(evaluation).covariance(self._residual_options.absolute_sigma)

    def hessian_product(self, evaluation: Evaluation) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """Return the product of the Hessian at a point with flat vectors, 0 in entries that bounds hold.

        The gradient is recorded once; each product is one backward pass.
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
        """Return which unknowns can follow the negative gradient at a point without leaving the bounds."""
        return self.box.free(evaluation.point, evaluation.gradient)

    def projected_gradient(self, evaluation: Evaluation) -> Any:
        """Return the gradient, 0 in entries that bounds hold."""
        return np.where(self.free(evaluation), evaluation.gradient, 0.0)

    def pop_failures(self) -> tuple[Failure, ...]:
        """Return the points refused since the last call."""
        failures = tuple(self.failures)
        self.failures = []
        return failures
