"""Newton with truncated conjugate gradients inside a trust region, from Hessian products."""

from typing import NamedTuple

import numpy as np

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_whole
from sparsedp.optimize.first_order import first_length
from sparsedp.optimize.result import Trial

__all__ = ["NewtonCG", "NewtonState"]

POOR, GOOD = 0.25, 0.75  # shares of the predicted fall below and above which the region changes
SHRINKS = 60


class NewtonState(NamedTuple):
    """State of newton_cg: the point, the radius of the trust region (0: not known), the first gradient's norm.

    Steps and the radius are in units of `length`, a power of two near |x| at the start, and gradients in units of a
    power of two of their own: no product of two of them leaves the range of floating-point numbers.
    """

    trial: Trial
    radius: float
    size: float
    length: float


class NewtonCG:
    """Trust-region Newton: Steihaug's conjugate gradients on products with the Hessian.

    Parameters
    ----------
    inner : int
        Most Hessian products in one iteration.

    Notes
    -----
    Source: T. Steihaug, SIAM J. Numer. Anal. 20, 1983; J. Nocedal, S. J. Wright, Numerical Optimization, 2006,
    algorithms 4.1 and 7.2.
    """

    residuals, searches = False, True

    def __init__(self, inner=200):
        self.inner = check_whole("inner of newton_cg", inner, 1, "; the default is 200")

    def begin(self, first):
        """State at the start."""
        length = power_of_two(norm(first.vector) or first_length(first))
        return NewtonState(first, 0.0, norm(first.slope), length)

    def advance(self, state, trials):
        """One iteration: smaller regions until the loss falls. Raises Stuck when none is small enough."""
        here, product = state.trial, trials.curvature(state.trial)
        height = power_of_two(norm(here.slope))
        slope = trials.downhill(here) / height  # of size 1, about
        forcing = min(0.1, np.sqrt(norm(here.slope) / (state.size or 1.0)))

        def scaled_product(direction):
            return product(state.length * direction) / height

        def regions():
            radius = state.radius or np.inf
            for _ in range(SHRINKS):
                step, fall, edge = steihaug(slope, scaled_product, radius, forcing, self.inner)
                point = trials.box.inside(here.vector + state.length * step)
                yield point, fall * height * state.length, (radius, norm(step), edge)
                radius = norm(step) / 4

        trial, gain, (radius, length, edge) = trials.lower(here, regions(), "no trust region gives a lower point")
        # The region for the next step: larger where the model was good and the region was in the way.
        if gain > GOOD and edge:
            radius = 2 * length
        elif gain < POOR:
            radius = length / 4
        return state._replace(trial=trial, radius=radius if np.isfinite(radius) else 0.0)


def steihaug(slope, curved, radius, forcing, limit):
    """Conjugate gradients on slope.p + p.curved(p) / 2 where |p| <= radius.

    Returns
    -------
    p : (n,) array
    fall : float
        How far the model falls.
    edge : bool
        Whether |p| is the radius.
    """
    p, r, d, fall, edge = np.zeros_like(slope), slope, -slope, 0.0, False
    for _ in range(limit):
        curvature, square = curved(d), float(np.dot(r, r))
        bend = float(np.dot(d, curvature))
        t = square / bend if bend > 0 else np.inf
        edge = not (np.isfinite(t) and norm(p + t * d) < radius)
        if edge:
            far = radius if np.isfinite(radius) else max(1.0, 2 * norm(p))
            t = np.max(np.roots([np.dot(d, d), 2 * np.dot(p, d), np.dot(p, p) - far**2]).real)  # |p + t d| = far
        p, r, fall = p + t * d, r + t * curvature, fall + t * (square - 0.5 * t * bend)
        if edge or norm(r) <= forcing * norm(slope):
            break
        d = -r + float(np.dot(r, r)) / square * d
    return p, fall, edge
