"""A line search for the weak Wolfe conditions, past points that the loss refuses and along bounds."""

from typing import NamedTuple

import numpy as np

from sparsedp.optimize.trials import Trial

__all__ = ["line_search"]

ENOUGH = 1e-4  # share of the predicted fall that is asked for (Armijo)
FLATTER = 0.9  # the slope at the new point is at most this share of that at the start
BRACKET = (0.1, 0.9)  # the next point stays inside this part of a bracket
LONGER = 4.0  # a step grows by this when the loss still falls steeply


class _Point(NamedTuple):
    """A place on the line: distance, change of the loss, slope along the line; no slope where the loss has no value."""

    t: float
    change: float
    slope: float | None
    trial: Trial | None


def line_search(start, step, trials, limit, box):
    """Point, step -> the first trial found that has fallen enough and is flatter, else the lowest that has fallen.

    Parameters
    ----------
    start : Trial
    step : (n,) array
        Downhill: step . slope < 0. The first point is start + step.
    trials : callable
    limit : int
        Most points.
    box : Box
        Points beyond it are moved onto it.

    Returns
    -------
    Trial or None
        None: no point that has fallen enough.

    Notes
    -----
    Bisection with interpolation; every accepted step has step . (change of the gradient) > 0, which a
    quasi-Newton memory needs. Source: A. S. Lewis, M. L. Overton, Math. Program. 141, 2013.
    """
    fall = float(np.dot(start.slope, step))
    low, high, best, t = _Point(0.0, 0.0, fall, start), None, None, 1.0
    for _ in range(limit):
        point, enough = _at(start, step, t, trials, box)
        if enough:
            best = point if best is None or point.change < best.change else best
            if point.slope >= FLATTER * fall:
                return point.trial
            low = point
        else:
            high = point
        t = _next(low, high)
        if not low.t < t < (high.t if high else np.inf) or -fall * t <= start.rounding:
            break
    return None if best is None else best.trial


def _at(start, step, t, trials, box):
    """The point at a distance, and whether the loss has fallen enough there."""
    with np.errstate(over="ignore", invalid="ignore"):  # a loss without a lower bound; infinity is refused
        vector = box.inside(start.vector + t * step)
    trial = trials(vector)
    if trial.refused:
        return _Point(t, np.inf, None, None), False
    moving = step if box.open else np.where(vector == start.vector + t * step, step, 0.0)
    change = trial.value - start.value
    predicted = float(np.dot(start.slope, trial.vector - start.vector))
    enough = trial.value < start.value and change <= ENOUGH * predicted
    return _Point(t, change, float(np.dot(trial.slope, moving)), trial), enough


def _next(low, high):
    """The next distance: inside the bracket, or further out while there is none."""
    if high is None:
        return LONGER * low.t
    width = high.t - low.t
    if high.slope is None:
        return low.t + 0.5 * width
    share = _cubic(low, high, width)
    return low.t + width * min(max(share, BRACKET[0]), BRACKET[1])


def _cubic(low, high, width):
    """Share of the bracket at which the cubic through values and slopes has its minimum."""
    ratio = high.slope / low.slope  # in units of the slope at the lower end nothing over- or underflows
    middle = 1.0 + ratio - 3.0 * ((high.change - low.change) / width / low.slope)
    inner = middle * middle - ratio
    if not (inner >= 0 and np.isfinite(inner)):
        return 0.5
    root = np.sqrt(inner)
    divisor = 2.0 * root + 1.0 - ratio
    return (root + 1.0 - middle) / divisor if divisor > 0 else 0.5
