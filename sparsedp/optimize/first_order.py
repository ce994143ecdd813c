"""Gradient descent and Adam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_choice, check_number, is_number
from sparsedp.optimize.method import Method
from sparsedp.optimize.result import Evaluation, NoStepFound
from sparsedp.solvers.scaling import largest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

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
        For the next step, per gradient divided by `gradient_unit`.
    share : float
        Of the next step, which is tried first.
    gradient_unit : float
        A power of two where the rate is searched for, so that the quotient of a length and a gradient is a float at any
        scale of x and the loss; 1 where the rate is given.
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
        Step per gradient. Default: found by backtracking.
    momentum : float
        Share of the last step that is added, from 0 to below 1.
    line_search : None or "backtracking"
        "backtracking": halve the step until the loss falls sufficiently (Armijo), and try twice the length next time.

    Notes
    -----
    v <- momentum v - rate g,  x <- x + v, with the gradient g of the loss at x.

    References
    ----------
    B. T. Polyak, Some methods of speeding up the convergence of iteration methods, USSR Comput. Math. Math. Phys. 4,
    1964; L. Armijo, Minimization of functions having Lipschitz continuous first partial derivatives, Pacific J. Math.
    16, 1966.
    """

    name: ClassVar[str] = "gd"
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
        """Whether the step is halved until the loss falls."""
        return self.line_search is not None or self.rate is None

    def begin(self, first: Evaluation) -> DescentState:
        """Return the state at the start."""
        velocity = np.zeros_like(first.point)
        if self.rate is not None:
            return DescentState(first, velocity, self.rate, 1.0, 1.0)
        gradient_unit = power_of_two(norm(first.gradient))
        rate = first_length(first) / (norm(first.gradient / gradient_unit) or 1.0)
        return DescentState(first, velocity, rate, 1.0, gradient_unit)

    def advance(self, state: DescentState, objective: Objective) -> DescentState:
        """Return the state after one iteration. Raises NoStepFound if no admissible point is found."""
        gradient = objective.projected_gradient(state.current) / state.gradient_unit
        step = self.momentum * state.velocity - state.rate * gradient
        if not self.compares_losses:
            evaluation, share, next_share = admissible(state.current.point, step, state.share, objective)
            return state._replace(current=evaluation, velocity=share * step, share=next_share)
        if np.dot(step, gradient) >= 0:
            step = -state.rate * gradient  # momentum that goes uphill is dropped
        direction = "the projected gradient" if objective.box.bounded else "the gradient"
        evaluation, share, _ = backtracked(state.current, step, objective, direction)
        factor = share if share < 1 else 2.0
        return state._replace(current=evaluation, velocity=share * step, rate=state.rate * factor)


def first_length(first: Evaluation) -> float:
    """Return the length of a first step: |f| / |g|, which brings a linear loss to 0, but at most |x|.

    A length that is 0 or infinite is ignored; 1 if both are.
    """
    gradient_norm = norm(first.gradient)
    lengths = [norm(first.point)]
    if gradient_norm:
        lengths.append(abs(first.value) / gradient_norm)
    return min((length for length in lengths if 0 < length < np.inf), default=1.0)


def backtracked(
    current: Evaluation,
    step: NDArray[np.float64],
    objective: Objective,
    direction: str,
    most: int = HALVINGS,
) -> tuple[Evaluation, float, float]:
    """Halve a step until the loss falls sufficiently.

    Parameters
    ----------
    current : Evaluation
    step : (n,) array
    objective : Objective
    direction : str
        Name of the step in the message.
    most : int
        Number of lengths that are tried.

    Returns
    -------
    evaluation : Evaluation
    share : float
        Of the step that was taken.
    share_of_decrease : float
        Of the decrease that the gradient predicted; 1/2 at the minimum of a parabola.

    Raises
    ------
    NoStepFound
        If no length gives a lower point.
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
    """Halve a step until the loss has a value, without comparing losses.

    Parameters
    ----------
    point, step : (n,) array
    share : float
        Of the step, which is tried first.
    objective : Objective

    Returns
    -------
    evaluation : Evaluation
    share : float
        Of the step that was taken.
    next_share : float
        To try first in the next iteration: twice as much, at most 1. So a region without a value does not cost all
        halvings every time.

    Raises
    ------
    NoStepFound
        If the loss has no value at any of the points.
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
        Running means of the gradient and of its square, in units of `gradient_unit`.
    steps : int
    gradient_unit : float
        A power of two near the largest entry of the first gradient.
    share : float
        Of the next step, which is tried first.
    """

    current: Evaluation
    mean: np.ndarray
    mean_square: np.ndarray
    steps: int
    gradient_unit: float
    share: float


@dataclass
class Adam(Method):
    """Adam: steps of about `rate` in every entry.

    Parameters
    ----------
    rate : float
        Size of a step in every entry.
    betas : (float, float)
        Memory of the running means of the gradient and of its square, each from 0 to below 1.
    epsilon : float
        Smallest root mean square that divides, relative to the first gradient. So a loss times 1e-12 takes the same
        steps.

    Notes
    -----
    m <- b1 m + (1 - b1) g,  q <- b2 q + (1 - b2) g^2,  x <- x - rate m' / (sqrt(q') + epsilon) with
    m' = m / (1 - b1^k) and q' = q / (1 - b2^k) in iteration k. A step to a refused point is halved.

    References
    ----------
    D. P. Kingma, J. Ba, Adam: a method for stochastic optimization, ICLR 2015.
    """

    name: ClassVar[str] = "adam"
    rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        check_number("rate of adam", self.rate, "> 0", "; the default is 1e-3")
        if np.shape(self.betas) != (2,) or not all(is_number(beta) and 0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"adam needs two betas from 0 to below 1, got {self.betas}; the default is (0.9, 0.999)")
        check_number("epsilon of adam", self.epsilon, "> 0", "; the default is 1e-8")

    @property
    def compares_losses(self) -> bool:
        """Never: every admissible step is taken."""
        return False

    def begin(self, first: Evaluation) -> AdamState:
        """Return the state at the start."""
        zero = np.zeros_like(first.point)
        return AdamState(first, zero, zero, 0, power_of_two(largest(first.gradient)), 1.0)

    def advance(self, state: AdamState, objective: Objective) -> AdamState:
        """Return the state after one iteration. Raises NoStepFound if no admissible point is found."""
        b1, b2 = self.betas
        count = state.steps + 1
        gradient = state.current.gradient / state.gradient_unit
        mean = b1 * state.mean + (1 - b1) * gradient
        mean_square = b2 * state.mean_square + (1 - b2) * gradient**2
        unbiased_mean = mean / (1 - b1**count)
        root_mean_square = np.sqrt(mean_square / (1 - b2**count))
        step = -self.rate * unbiased_mean / (root_mean_square + self.epsilon)
        evaluation, _, next_share = admissible(state.current.point, step, state.share, objective)
        return AdamState(evaluation, mean, mean_square, count, state.gradient_unit, next_share)
