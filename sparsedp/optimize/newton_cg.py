"""Newton with truncated conjugate gradients inside a trust region, from Hessian products."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_whole
from sparsedp.optimize.first_order import first_length
from sparsedp.optimize.method import Method
from sparsedp.optimize.result import Evaluation

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.optimize.objective import Objective

__all__ = ["NewtonCG", "NewtonState", "truncated_cg"]

POOR, GOOD = 0.25, 0.75  # shares of the predicted decrease below and above which the region changes
MOST_REGIONS = 60  # radii that are tried in one iteration


class NewtonState(NamedTuple):
    """State of newton_cg.

    Steps and the radius are in units of `length_unit`, and gradients in units of another power of two, so that no
    product of two of them leaves the range of floating-point numbers.

    Attributes
    ----------
    current : Evaluation
    radius : float
        Of the trust region; 0 while it is unknown.
    first_gradient_norm : float
    length_unit : float
        A power of two near |x| at the start.
    """

    current: Evaluation
    radius: float
    first_gradient_norm: float
    length_unit: float


@dataclass
class NewtonCG(Method):
    """Newton in a trust region: Steihaug's conjugate gradients on products with the Hessian.

    Parameters
    ----------
    inner : int
        Most Hessian products in one iteration.

    Notes
    -----
    The step p approximately minimizes g.p + p.H p / 2 where |p| is at most the radius, to the relative accuracy
    min(0.1, sqrt(|g| / |g0|)) of the residual. The radius follows the ratio of the actual and the predicted decrease.

    References
    ----------
    T. Steihaug, The conjugate gradient method and trust regions in large scale optimization, SIAM J. Numer. Anal. 20,
    1983; J. Nocedal, S. J. Wright, Numerical Optimization, 2006, algorithms 4.1 and 7.2.
    """

    name: ClassVar[str] = "newton_cg"
    inner: int = 200

    def __post_init__(self) -> None:
        self.inner = check_whole("inner of newton_cg", self.inner, 1, "; the default is 200")

    def begin(self, first: Evaluation) -> NewtonState:
        """Return the state at the start."""
        length_unit = power_of_two(norm(first.point) or first_length(first))
        return NewtonState(first, 0.0, norm(first.gradient), length_unit)

    def advance(self, state: NewtonState, objective: Objective) -> NewtonState:
        """Return the state after one iteration. Raises NoStepFound if no trust region gives a lower point."""
        current = state.current
        hessian_product = objective.hessian_product(current)
        gradient_unit = power_of_two(norm(current.gradient))
        gradient = objective.projected_gradient(current) / gradient_unit
        accuracy = min(0.1, np.sqrt(norm(current.gradient) / (state.first_gradient_norm or 1.0)))

        def scaled_product(direction):
            return hessian_product(state.length_unit * direction) / gradient_unit

        def candidates():
            """Yield the minimum of the model in ever smaller regions."""
            radius = state.radius or np.inf
            for _ in range(MOST_REGIONS):
                step, decrease, on_boundary = truncated_cg(gradient, scaled_product, radius, accuracy, self.inner)
                point = objective.box.nearest(current.point + state.length_unit * step)
                yield point, decrease * gradient_unit * state.length_unit, (radius, norm(step), on_boundary)
                radius = norm(step) / 4

        failure = "no trust region gives a lower point"
        evaluation, share_of_decrease, region = objective.first_lower(current, candidates(), failure)
        radius, length, on_boundary = region
        if share_of_decrease > GOOD and on_boundary:
            radius = 2 * length
        elif share_of_decrease < POOR:
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
) -> tuple[NDArray[np.float64], float, bool]:
    """Minimize the model g.p + p.H p / 2 where |p| <= radius, by conjugate gradients.

    Parameters
    ----------
    gradient : (n,) array
        g.
    hessian_product : callable
        ``hessian_product(p)`` returns H p.
    radius : float
        May be infinite.
    accuracy : float
        Relative to |g|, of the residual g + H p.
    limit : int
        Most products.

    Returns
    -------
    p : (n,) array
    decrease : float
        Of the model.
    on_boundary : bool
        Whether |p| is the radius.
    """
    p = np.zeros_like(gradient)
    residual = gradient
    direction = -gradient
    decrease = 0.0
    on_boundary = False
    for _ in range(limit):
        product = hessian_product(direction)
        square = float(np.dot(residual, residual))
        curvature = float(np.dot(direction, product))
        t = np.inf
        if curvature > 0:
            t = square / curvature
        on_boundary = not (np.isfinite(t) and norm(p + t * direction) < radius)
        if on_boundary:
            # Along a direction of negative curvature an infinite region is cut at twice the present length.
            boundary = radius
            if not np.isfinite(radius):
                boundary = max(1.0, 2 * norm(p))
            # The larger root t of |p + t d|^2 = boundary^2.
            coefficients = [np.dot(direction, direction), 2 * np.dot(p, direction), np.dot(p, p) - boundary**2]
            t = np.max(np.roots(coefficients).real)
        p = p + t * direction
        residual = residual + t * product
        decrease = decrease + t * (square - 0.5 * t * curvature)
        if on_boundary or norm(residual) <= accuracy * norm(gradient):
            break
        direction = -residual + float(np.dot(residual, residual)) / square * direction
    return p, decrease, on_boundary
