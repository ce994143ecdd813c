"""A line search for the weak Wolfe conditions; trial points are clipped to the bounds and may have an infinite loss."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparsedp.optimize.objective import SUFFICIENT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.optimize.objective import Objective
    from sparsedp.optimize.result import Evaluation

__all__ = ["line_search"]

CURVATURE = 0.9  # the (negative) slope at an accepted point is >= this number times the slope at the start
INTERIOR = (0.1, 0.9)  # the next trial point lies between these fractions of the bracket
EXPANSION = 4.0  # growth factor of the step length until the minimum is bracketed


def line_search(start: Evaluation, step: NDArray[np.float64], objective: Objective, limit: int) -> Evaluation | None:
    """Search along a step for a point that satisfies the weak Wolfe conditions.

    Parameters
    ----------
    start : Evaluation
    step : (n,) array
        A descent direction. The first trial point is start + step. Trial points are clipped to the bounds.
    objective : Objective
    limit : int
        Maximum number of trial points.

    Returns
    -------
    Evaluation or None
        The first trial point that satisfies both the sufficient decrease condition and the curvature condition. If
        there is none, the one with the longest step that satisfies the sufficient decrease condition. If there is none
        either, None.

    Notes
    -----
    The method is a bisection with quadratic interpolation. At a point that satisfies both conditions, and where no
    bound is active, the step s and the change y of the gradient have s.y > 0, which quasi-Newton updates require.

    References
    ----------
    A. S. Lewis, M. L. Overton, Nonsmooth optimization via quasi-Newton methods, Math. Program. 141, 2013.
    """
    start_slope = float(np.dot(start.gradient, step))
    # low: the end of the bracket that satisfies sufficient decrease; high: the end that does not. Lengths are multiples
    # of the step.
    low = start
    low_length = 0.0
    low_slope = start_slope
    high_value = np.inf
    high_length = np.inf
    length = 1.0
    for _ in range(limit):
        with np.errstate(over="ignore", invalid="ignore"):  # overflows if the loss has no lower bound
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
    """Return the minimizer of the interpolating parabola, as a fraction of the bracket measured from its low end.

    `predicted` is the slope at the low end times the length of the bracket. If the high end has an infinite value,
    return 1/2.
    """
    share = 0.5
    if high_value < np.inf:
        share = 0.5 * predicted / (predicted - (high_value - low_value))
    return float(np.clip(share, *INTERIOR))
