"""Newton's method in a trust region, by truncated conjugate gradients with Hessian-vector products."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from sparsedp._utils.validation import check_whole
from sparsedp.optimize.first_order import first_length
from sparsedp.optimize.method import Method
from sparsedp.optimize.metric import EUCLIDEAN
from sparsedp.optimize.result import Evaluation

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.optimize.metric import Euclidean
    from sparsedp.optimize.objective import Objective

__all__ = ["NewtonCG", "NewtonState", "truncated_cg"]

# Limits of the actual decrease divided by the predicted one, for a change of the radius.
SHRINKS_BELOW = 0.25
GROWS_ABOVE = 0.75
MOST_REGIONS = 60  # maximum number of radii tried in one iteration


class NewtonState(NamedTuple):
    """State of newton_cg.

    Steps and the radius are divided by `length_unit`, and gradients by another power of two, so that products of them
    neither overflow nor underflow.

    Attributes
    ----------
    current : Evaluation
    radius : float
        Radius of the trust region; 0 means unlimited.
    first_gradient_norm : float
    length_unit : float
        A power of two near |x| at the start; with a metric, |x| itself.
    """

    current: Evaluation
    radius: float
    first_gradient_norm: float
    length_unit: float


@dataclass
class NewtonCG(Method):
    """Newton's method in a trust region, by Steihaug's truncated conjugate gradients with Hessian-vector products.

    Parameters
    ----------
    inner : int
        Maximum number of Hessian-vector products for one trial step.

    Notes
    -----
    The step p approximately minimizes the model g.p + p.H p / 2 subject to |p| <= radius. Inside the region, the
    conjugate gradient iteration stops when |g + H p| <= min(0.1, sqrt(|g| / |g0|)) |g|, where g0 is the gradient at the
    start. The radius is increased or decreased according to the ratio of the actual and the predicted decrease. Norms
    are those of the metric, which is also the preconditioner of the conjugate gradients.

    References
    ----------
    T. Steihaug, The conjugate gradient method and trust regions in large scale optimization, SIAM J. Numer. Anal. 20,
    1983; J. Nocedal, S. J. Wright, Numerical Optimization, 2006, algorithms 4.1 and 7.2.
    """

    name: ClassVar[str] = "newton_cg"
    uses_metric: ClassVar[bool] = True
    inner: int = 200

    def __post_init__(self) -> None:
        self.inner = check_whole("inner of newton_cg", self.inner, 1, "; the default is 200")

    def begin(self, first: Evaluation) -> NewtonState:
        """Return the state at the start."""
        length_unit = self.metric.unit(self.metric.norm(first.point) or first_length(first, self.metric))
        return NewtonState(first, 0.0, self.metric.dual_norm(first.gradient), length_unit)

    def advance(self, state: NewtonState, objective: Objective) -> NewtonState:
        """Return the state after one iteration. Raises NoStepFound if no trust region gives a lower point."""
        current = state.current
        hessian_product = objective.hessian_product(current)
        metric = self.metric
        gradient_norm = metric.dual_norm(current.gradient)
        gradient_unit = metric.unit(gradient_norm)
        gradient = objective.projected_gradient(current) / gradient_unit
        accuracy = min(0.1, np.sqrt(gradient_norm / (state.first_gradient_norm or 1.0)))

        def scaled_product(direction):
            return hessian_product(state.length_unit * direction) / gradient_unit

        def candidates():
            """Yield the minimizer of the model in trust regions of decreasing radius."""
            radius = state.radius or np.inf
            for _ in range(MOST_REGIONS):
                step, decrease, on_boundary = truncated_cg(
                    gradient, scaled_product, radius, accuracy, self.inner, metric
                )
                length = metric.norm(step)
                point = objective.box.nearest(current.point + state.length_unit * step)
                yield point, decrease * gradient_unit * state.length_unit, (radius, length, on_boundary)
                radius = length / 4

        failure = "no trust region gives a lower point"
        evaluation, share_of_decrease, region = objective.first_lower(current, candidates(), failure)
        radius, length, on_boundary = region
        if share_of_decrease > GROWS_ABOVE and on_boundary:
            radius = 2 * length
        elif share_of_decrease < SHRINKS_BELOW:
            radius = length / 4
        if not np.isfinite(radius):
            radius = 0.0
        return state._replace(current=evaluation, radius=radius)


def truncated_cg(
    gradient: NDArray[np.float64],
    hessian_product: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    radius: float,
    accuracy: float,
    limit: int,
    metric: Euclidean = EUCLIDEAN,
) -> tuple[NDArray[np.float64], float, bool]:
    """Minimize the model g.p + p.H p / 2 subject to |p| <= radius, by conjugate gradients.

    Parameters
    ----------
    gradient : (n,) array
        The gradient g.
    hessian_product : callable
        ``hessian_product(p)`` returns H p.
    radius : float
        May be infinite.
    accuracy : float
        The iteration stops when |g + H p| is at most this multiple of |g|.
    limit : int
        Maximum number of products.
    metric : Euclidean or Metric
        The norms of p and of gradients, and the preconditioner.

    Returns
    -------
    p : (n,) array
    decrease : float
        Decrease of the model at p.
    on_boundary : bool
        Whether |p| is the radius.
    """
    p = np.zeros_like(gradient)
    p_image = p  # M p; the recursions below need no product with M
    residual = gradient
    representer = metric.representer(residual)
    direction = -representer
    direction_image = -residual
    square = metric.square(residual, representer)
    goal = accuracy * metric.length(gradient, representer)
    decrease = 0.0
    on_boundary = False
    for _ in range(limit):
        product = hessian_product(direction)
        curvature = float(np.dot(direction, product))
        t = np.inf
        if curvature > 0:
            t = square / curvature
        on_boundary = not (np.isfinite(t) and metric.length(p + t * direction, p_image + t * direction_image) < radius)
        if on_boundary:
            # If the curvature is not positive and the region is unlimited, stop at twice the current length of p.
            boundary = radius
            if not np.isfinite(radius):
                boundary = max(1.0, 2 * metric.length(p, p_image))
            # t is the larger root of |p + t d|^2 = boundary^2.
            coefficients = [
                np.dot(direction, direction_image),
                2 * np.dot(p, direction_image),
                np.dot(p, p_image) - boundary**2,
            ]
            t = np.max(np.roots(coefficients).real)
        p = p + t * direction
        p_image = p_image + t * direction_image
        residual = residual + t * product
        representer = metric.representer(residual)
        decrease = decrease + t * (square - 0.5 * t * curvature)
        if on_boundary or metric.length(residual, representer) <= goal:
            break
        next_square = metric.square(residual, representer)
        direction = -representer + next_square / square * direction
        direction_image = -residual + next_square / square * direction_image
        square = next_square
    return p, decrease, on_boundary
