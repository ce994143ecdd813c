"""A line search for the weak Wolfe conditions, past points that the loss refuses and along bounds."""

import numpy as np

from sparsedp.optimize.trials import ENOUGH

__all__ = ["line_search"]

FLATTER = 0.9  # the slope at the new point is at most this share of that at the start
BRACKET = (0.1, 0.9)  # the next point stays inside this part of a bracket
LONGER = 4.0  # a step grows by this when the loss still falls steeply


def line_search(start, step, trials, limit):
    """Point, step -> the first trial found that has fallen enough and is flatter, else the furthest that has fallen.

    Parameters
    ----------
    start : Trial
    step : (n,) array
        Downhill: step . slope < 0. The first point is start + step; points beyond the bounds are moved onto them.
    trials : Trials
    limit : int
        Most points.

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
    low, at, slope = start, 0.0, fall  # the end of the bracket that has fallen enough: trial, distance, slope
    high, beyond = np.inf, np.inf  # its other end: loss, distance
    t = 1.0
    for _ in range(limit):
        with np.errstate(over="ignore", invalid="ignore"):  # a loss without a lower bound; infinity is refused
            vector = start.vector + t * step
        inside = trials.box.inside(vector)
        trial = trials(inside)
        predicted = float(np.dot(start.slope, trial.vector - start.vector))
        if trial.value < start.value and trial.value - start.value <= ENOUGH * predicted:
            low, at = trial, t
            slope = float(np.dot(trial.slope, np.where(inside == vector, step, 0.0)))
            if slope >= FLATTER * fall:
                return trial
        else:
            high, beyond = trial.value, t
        if beyond == np.inf:
            t = LONGER * at
        else:  # the minimum of the parabola through both losses and the slope, not too near either end
            change = slope * (beyond - at)
            share = 0.5 * change / (change - (high - low.value)) if high < np.inf else 0.5
            t = at + (beyond - at) * float(np.clip(share, *BRACKET))
        if not at < t < beyond or -fall * t <= start.rounding:
            break
    return None if low is start else low
