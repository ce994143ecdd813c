"""Newton with truncated conjugate gradients inside a trust region, from Hessian products."""

from typing import NamedTuple

import numpy as np

from sparsedp.fields import is_whole
from sparsedp.optimize.flat import power_of_two
from sparsedp.optimize.result import Stuck, Trial
from sparsedp.tree import norm

__all__ = ["NewtonCG", "NewtonState"]

ACCEPT, POOR, GOOD = 1e-4, 0.25, 0.75
SHRINKS = 60


class NewtonState(NamedTuple):
    """State of newton_cg: the point, the radius of the trust region (0: not known), the first gradient's norm."""

    trial: Trial
    radius: float
    size: float


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
        if not is_whole(inner, 1):
            raise ValueError(f"newton_cg needs inner >= 1, a whole number, got {inner!r}; the default is 200")
        self.inner = int(inner)

    def begin(self, first):
        """State at the start."""
        return NewtonState(first, 0.0, norm(first.slope))

    def advance(self, state, trials):
        """One iteration: smaller regions until the loss falls. Raises Stuck when none is small enough."""
        here, radius = state.trial, state.radius or np.inf
        model = _Model(here, trials, self.inner, min(0.1, np.sqrt(norm(here.slope) / (state.size or 1.0))))
        for _ in range(SHRINKS):
            step, predicted, edge = model.step(radius)
            trial = trials(trials.box.inside(here.vector + step))
            length = norm(step)
            if not trial.refused and trial.value < here.value:
                gain = (here.value - trial.value) / predicted if predicted > 0 else 0.0
                if gain > ACCEPT:
                    return state._replace(trial=trial, radius=_radius(radius, length, gain, edge))
            if predicted <= 10 * here.rounding:
                break
            radius = length / 4
        raise Stuck("rounding" if predicted <= 100 * here.rounding else "no trust region gives a lower point")


def _radius(radius, length, gain, edge):
    """The region for the next step: larger where the model was good and the region was in the way."""
    if gain > GOOD and edge:
        return 2 * length
    if gain < POOR:
        return length / 4
    return radius if np.isfinite(radius) else 0.0


class _Model:
    """The quadratic model of the loss at one point, in units in which its gradient has size 1."""

    def __init__(self, here, trials, limit, forcing):
        self._height = power_of_two(norm(here.slope))
        self._free = trials.box.free(here.vector, here.slope)
        self._product, self._limit, self._forcing = trials.curvature(here), limit, forcing
        self._slope = self._masked(here.slope / self._height)

    def _masked(self, vector):
        return np.where(self._free, vector, 0.0)

    def _curved(self, d):
        return self._masked(self._product(d) / self._height)

    def step(self, radius):
        """Minimizer of the model within the radius -> step, predicted fall of the loss, whether it is on the edge."""
        p, bent, edge = self._steihaug(radius)
        return p, -float(np.dot(self._slope, p) + 0.5 * np.dot(p, bent)) * self._height, edge

    def _steihaug(self, radius):
        p, bent = np.zeros_like(self._slope), np.zeros_like(self._slope)
        r, d = self._slope, -self._slope
        goal = self._forcing * norm(r)
        for _ in range(self._limit):
            curved = self._curved(d)
            bend, square = float(np.dot(d, curved)), float(np.dot(r, r))
            t = square / bend if bend > 0 else np.inf
            if not norm(p + t * d) < radius if np.isfinite(t) else True:
                t = _to_edge(p, d, radius if np.isfinite(radius) else max(1.0, 2 * norm(p)))
                return p + t * d, bent + t * curved, True
            p, bent, r = p + t * d, bent + t * curved, r + t * curved
            if norm(r) <= goal:
                break
            d = -r + float(np.dot(r, r)) / square * d
        return p, bent, False


def _to_edge(p, d, radius):
    """t >= 0 with |p + t d| = radius."""
    a, b, c = float(np.dot(d, d)), float(np.dot(p, d)), float(np.dot(p, p)) - radius**2
    root = np.sqrt(max(b * b - a * c, 0.0))
    return (root - b) / a if b <= 0 else -c / (b + root)
