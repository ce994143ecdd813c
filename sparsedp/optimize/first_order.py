"""Gradient descent and Adam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_choice, check_number, is_number
from sparsedp.optimize.method import Method
from sparsedp.optimize.metric import EUCLIDEAN
from sparsedp.optimize.result import Evaluation, NoStepFound
from sparsedp.solvers.scaling import largest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from sparsedp.optimize.metric import Euclidean
    from sparsedp.optimize.objective import Objective

__all__ = ["Adam", "AdamState", "DescentState", "GradientDescent", "admissible", "backtracked", "first_length"]

HALVINGS = 60


class DescentState(NamedTuple):
    """State of gradient descent.

    Attributes
    ----------
    current : Evaluation
    velocity : (n,) array
        The last step.
    rate : float
        Learning rate of the next step, which multiplies gradient / gradient_unit.
    share : float
        Fraction of the next step that is tried first.
    gradient_unit : float
        A power of two near the norm of the first gradient, so that the rate neither overflows nor underflows at any
        scale of x and the loss; 1 if the user gave the rate.
    """

    current: Evaluation
    velocity: np.ndarray
    rate: float
    share: float
    gradient_unit: float


@dataclass
class GradientDescent(Method):
    """Gradient descent with momentum.

    Parameters
    ----------
    rate : float, optional
        Learning rate. Default: found by backtracking.
    momentum : float
        Factor of the previous step that is added to the new one, 0 <= momentum < 1.
    line_search : None or "backtracking"
        "backtracking": halve the step until the loss decreases sufficiently (Armijo condition). If the first trial is
        accepted, the rate is doubled for the next iteration.

    Notes
    -----
    Each iteration computes v <- momentum v - rate M^-1 g and x <- x + v, where g is the gradient of the loss at x, and
    M is the metric.

    References
    ----------
    B. T. Polyak, Some methods of speeding up the convergence of iteration methods, USSR Comput. Math. Math. Phys. 4,
    1964; L. Armijo, Minimization of functions having Lipschitz continuous first partial derivatives, Pacific J. Math.
    16, 1966.
    """

    name: ClassVar[str] = "gd"
    uses_metric: ClassVar[bool] = True
    rate: float | None = None
    momentum: float = 0.0
    line_search: str | None = None

    def __post_init__(self) -> None:
        if self.rate is not None:
            check_number("rate of gd", self.rate, "> 0", "; leave it out and it is searched for")
        check_number("momentum of gd", self.momentum, "from 0 to below 1", "; leave it out for none")
        check_choice("line_search of gd", self.line_search, (None, "backtracking"), "; leave it out for none")

    @property
    def compares_losses(self) -> bool:
        """Whether the step is halved until the loss decreases."""
        return self.line_search is not None or self.rate is None

    def begin(self, first: Evaluation) -> DescentState:
        """Return the state at the start."""
        velocity = np.zeros_like(first.point)
        if self.rate is not None:
            return DescentState(first, velocity, self.rate, 1.0, 1.0)
        gradient_unit = power_of_two(norm(first.gradient))
        rate = first_length(first, self.metric) / (self.metric.dual_norm(first.gradient / gradient_unit) or 1.0)
        return DescentState(first, velocity, rate, 1.0, gradient_unit)

    def advance(self, state: DescentState, objective: Objective) -> DescentState:
        """Return the state after one iteration. Raises NoStepFound if no admissible point is found."""
        gradient = objective.projected_gradient(state.current) / state.gradient_unit
        direction = self.metric.representer(gradient)
        step = self.momentum * state.velocity - state.rate * direction
        if not self.compares_losses:
            evaluation, share, next_share = admissible(state.current.point, step, state.share, objective)
            return state._replace(current=evaluation, velocity=share * step, share=next_share)
        if np.dot(step, gradient) >= 0:
            step = -state.rate * direction  # momentum made this an ascent direction: restart without it
        name = "the projected gradient" if objective.box.bounded else "the gradient"
        evaluation, share, _ = backtracked(state.current, step, objective, name)
        factor = share if share < 1 else 2.0
        return state._replace(current=evaluation, velocity=share * step, rate=state.rate * factor)


def first_length(first: Evaluation, metric: Euclidean = EUCLIDEAN) -> float:
    """Return the length of the first step: the smaller of |f| / |g|, with which a linear loss becomes 0, and |x|.

    A length that is 0 or infinite is ignored. If neither can be used, return the length of a step whose Euclidean norm
    is 1. The other norms are those of the metric.
    """
    gradient_norm = metric.dual_norm(first.gradient)
    lengths = [metric.norm(first.point)]
    if gradient_norm:
        lengths.append(abs(first.value) / gradient_norm)
    lengths = [length for length in lengths if 0 < length < np.inf]
    if lengths:
        return min(lengths)
    return gradient_norm / norm(metric.representer(first.gradient)) if gradient_norm else 1.0


def backtracked(
    current: Evaluation,
    step: NDArray[np.float64],
    objective: Objective,
    direction: str,
    most: int = HALVINGS,
) -> tuple[Evaluation, float, float]:
    """Halve a step until the loss decreases sufficiently (Armijo condition).

    Parameters
    ----------
    current : Evaluation
    step : (n,) array
    objective : Objective
    direction : str
        Name of the step in the error message.
    most : int
        Maximum number of trial points.

    Returns
    -------
    evaluation : Evaluation
        The accepted point.
    share : float
        The fraction of the step that was accepted.
    share_of_decrease : float
        The actual decrease of the loss divided by the decrease that the gradient predicts; 1/2 at the minimum of a
        parabola.

    Raises
    ------
    NoStepFound
        If no trial point decreases the loss sufficiently.
    """

    def candidates() -> Iterator[tuple[NDArray[np.float64], float, float]]:
        for count in range(most):
            share = 0.5**count
            point = objective.box.moved(current.point, share * step)
            yield point, float(np.dot(current.point - point, current.gradient)), share

    evaluation, share_of_decrease, share = objective.first_lower(
        current, candidates(), f"no lower point along {direction}"
    )
    return evaluation, share, share_of_decrease


def admissible(
    point: NDArray[np.float64], step: NDArray[np.float64], share: float, objective: Objective
) -> tuple[Evaluation, float, float]:
    """Halve a step until the loss is finite and raises no error; losses are not compared.

    Parameters
    ----------
    point, step : (n,) array
    share : float
        The fraction of the step that is tried first.
    objective : Objective

    Returns
    -------
    evaluation : Evaluation
        The accepted point.
    share : float
        The fraction of the step that was accepted.
    next_share : float
        The fraction to try first in the next iteration: min(1, 2 share). Starting from the last accepted fraction
        avoids repeating all halvings near a region in which the loss cannot be evaluated.

    Raises
    ------
    NoStepFound
        If the loss cannot be evaluated at any of the trial points.
    """
    for _ in range(HALVINGS):
        evaluation = objective(objective.box.nearest(point + share * step))
        if not evaluation.refused:
            return evaluation, share, min(1.0, 2 * share)
        share *= 0.5
    raise NoStepFound("no admissible point along the step")


class AdamState(NamedTuple):
    """State of Adam.

    Attributes
    ----------
    current : Evaluation
    mean, mean_square : (n,) array
        Running means of gradient / gradient_unit and of its square.
    steps : int
        Number of iterations so far.
    gradient_unit : float
        A power of two near the largest absolute entry of the first gradient.
    share : float
        Fraction of the next step that is tried first.
    """

    current: Evaluation
    mean: np.ndarray
    mean_square: np.ndarray
    steps: int
    gradient_unit: float
    share: float


@dataclass
class Adam(Method):
    """Adam: gradient descent with a step of about `rate` in every entry of x.

    Parameters
    ----------
    rate : float or callable
        Learning rate, the typical size of a step in every entry. A schedule ``rate(step)`` returns the rate of a step;
        the first step has the number 0, as in optax.
    betas : (float, float)
        Decay rates b1 and b2 of the running means of the gradient and of its square, each in [0, 1).
    epsilon : float
        Added to the root mean square of the gradient in the denominator. It is relative to the first gradient, so that
        the steps do not change when the loss is multiplied by a small number such as 1e-12.
    max_norm : float, optional
        A gradient whose Euclidean norm over all entries of x exceeds this number is scaled to this norm. Default, and
        for infinity: no clipping.

    Notes
    -----
    Iteration k computes m <- b1 m + (1 - b1) g,  q <- b2 q + (1 - b2) g^2,  x <- x - rate m' / (sqrt(q') + epsilon)
    with m' = m / (1 - b1^k) and q' = q / (1 - b2^k). Here g is the gradient divided by a power of two near the largest
    entry of the first gradient, both after clipping. If the loss cannot be evaluated at the new point, the step is
    halved.

    References
    ----------
    D. P. Kingma, J. Ba, Adam: a method for stochastic optimization, ICLR 2015; R. Pascanu, T. Mikolov, Y. Bengio, On
    the difficulty of training recurrent neural networks, ICML 2013: clipping by the norm.
    """

    name: ClassVar[str] = "adam"
    rate: float | Callable[[int], Any] = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    epsilon: float = 1e-8
    max_norm: float | None = None

    def __post_init__(self) -> None:
        if not callable(self.rate):
            check_number("rate of adam", self.rate, "> 0", "; the default is 1e-3")
        if np.shape(self.betas) != (2,) or not all(is_number(beta) and 0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"adam needs two betas from 0 to below 1, got {self.betas}; the default is (0.9, 0.999)")
        check_number("epsilon of adam", self.epsilon, "> 0", "; the default is 1e-8")
        if self.max_norm is not None and not (is_number(self.max_norm) and self.max_norm == np.inf):
            check_number("max_norm of adam", self.max_norm, "> 0", "; leave it out for no clipping")

    @property
    def compares_losses(self) -> bool:
        """False: every step to a point with a finite loss is accepted."""
        return False

    def begin(self, first: Evaluation) -> AdamState:
        """Return the state at the start."""
        zero = np.zeros_like(first.point)
        return AdamState(first, zero, zero, 0, power_of_two(largest(self._clipped(first.gradient))), 1.0)

    def advance(self, state: AdamState, objective: Objective) -> AdamState:
        """Return the state after one iteration. Raises NoStepFound if no admissible point is found."""
        b1, b2 = self.betas
        count = state.steps + 1
        gradient = self._clipped(state.current.gradient) / state.gradient_unit
        mean = b1 * state.mean + (1 - b1) * gradient
        mean_square = b2 * state.mean_square + (1 - b2) * gradient**2
        unbiased_mean = mean / (1 - b1**count)
        root_mean_square = np.sqrt(mean_square / (1 - b2**count))
        step = -self._rate_of(state.steps) * unbiased_mean / (root_mean_square + self.epsilon)
        evaluation, _, next_share = admissible(state.current.point, step, state.share, objective)
        return AdamState(evaluation, mean, mean_square, count, state.gradient_unit, next_share)

    def _rate_of(self, step: int) -> float:
        """Return the rate of a step, given its number from 0."""
        if not callable(self.rate):
            return self.rate
        return check_number(f"rate({step}) of adam", self.rate(step), ">= 0", "; return the rate for the step")

    def _clipped(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradient, scaled to the norm `max_norm` if it is longer."""
        if self.max_norm is None:
            return gradient
        size = norm(gradient)
        if not size > self.max_norm:
            return gradient
        return gradient / size * self.max_norm
