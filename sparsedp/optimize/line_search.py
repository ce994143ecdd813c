"""A line search for the weak Wolfe conditions that steps past refused points and along bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparsedp.optimize.objective import SUFFICIENT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.optimize.objective import Objective
    from sparsedp.optimize.result import Evaluation

__all__ = ["line_search"]

CURVATURE = 0.9  # the slope at the new point is at most this share of the slope at the start
INTERIOR = (0.1, 0.9)  # the next point lies in this part of a bracket
EXPANSION = 4.0  # factor of the step while the loss still falls steeply


def line_search(start: Evaluation, step: NDArray[np.float64], objective: Objective, limit: int) -> Evaluation | None:
    """Return a point along a step that satisfies the weak Wolfe conditions, or the best one that is lower.

    Parameters
    ----------
    start : Evaluation
    step : (n,) array
        A direction of descent. The first trial point is start + step; points beyond the bounds are moved onto them.
    objective : Objective
    limit : int
        Most trial points.

    Returns
    -------
    Evaluation or None
        The first point that has fallen sufficiently and is flatter than the start; if there is none, the furthest that
        has fallen sufficiently; None if there is none either.

    Notes
    -----
    Bisection with quadratic interpolation. Every accepted step s and change y of the gradient have s.y > 0, which the
    memory of a quasi-Newton method needs.

    References
    ----------
    A. S. Lewis, M. L. Overton, Nonsmooth optimization via quasi-Newton methods, Math. Program. 141, 2013.
    """
    start_slope = float(np.dot(start.gradient, step))
    # The end of the bracket that has fallen sufficiently, and the other end, as multiples of the step.
    low = start
    low_length = 0.0
    low_slope = start_slope
    high_value = np.inf
    high_length = np.inf
    length = 1.0
    for _ in range(limit):
        with np.errstate(over="ignore", invalid="ignore"):  # a loss without a lower bound; infinity is refused
            unbounded = start.point + length * step
        point = objective.box.nearest(unbounded)
        trial = objective(point)
        predicted = float(np.dot(start.gradient, trial.point - start.point))
        if trial.value < start.value and trial.value - start.value <= SUFFICIENT * predicted:
            low = trial
            low_length = length
            low_slope = float(np.dot(trial.gradient, np.where(point == unbounded, step, 0.0)))
            if low_slope >= CURVATURE * start_slope:
                return trial
        else:
            high_value = trial.value
            high_length = length
        if high_length == np.inf:
            length = EXPANSION * low_length
        else:
            share = _interpolated(low.value, low_slope * (high_length - low_length), high_value)
            length = low_length + (high_length - low_length) * share
        if not low_length < length < high_length or -start_slope * length <= start.rounding:
            break
    if low is start:
        return None
    return low


def _interpolated(low_value, predicted, high_value):
    """Return where a parabola through both ends of a bracket has its minimum, as a share of the bracket.

    `predicted` is the change of the loss across the bracket that the slope at the lower end predicts.
    """
    share = 0.5
    if high_value < np.inf:
        share = 0.5 * predicted / (predicted - (high_value - low_value))
    return float(np.clip(share, *INTERIOR))
