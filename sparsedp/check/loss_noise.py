"""Measure the noise of a loss by a table of differences of neighbouring values.

References
----------
J. J. Moré and S. M. Wild, Estimating computational noise, SIAM J. Sci. Comput. 33, 2011.
"""

from __future__ import annotations

import math

import numpy as np

from sparsedp._utils.pytree import norm
from sparsedp.check.evaluations import Line

__all__ = ["POINTS", "measure_noise"]

POINTS = 8  # values of a table
ORDER = 4  # of the differences that are read: those of a parabola are 0
VARIANCE = math.factorial(2 * ORDER) / math.factorial(ORDER) ** 2  # of such a difference of errors of variance 1
SMALLEST_DISTANCE = 0.7320508 * 2.0**-28  # in units of x, double precision; never a power of two times a step
GROWTH = 2.0**6  # of the distance while the loss does not change
MOST_DISTANCES = 4


def measure_noise(line: Line) -> tuple[float, float]:
    """Measure how much a loss varies beside its smooth part.

    Parameters
    ----------
    line : Line

    Returns
    -------
    (float, float)
        Standard deviation in units of the rounding of the loss, and in units of the loss; 0 where nothing varies.

    Notes
    -----
    Values at equal distances, so close that a smooth loss is a straight line there. The k-th differences of a line
    are 0; those of independent errors of standard deviation s have the variance s^2 (2k)! / (k!)^2. The distance is
    no power of two times a step of the sweep, and it grows until the loss changes from point to point: otherwise the
    steps of a rounded loss (to single precision, by a table) may coincide with points of the sweep and stay unseen.
    The points lie on one side, since a kink at x is no noise.
    """
    distance = SMALLEST_DISTANCE * max(1.0, line.point.eps / float(np.finfo(float).eps)) ** 0.5
    for _ in range(MOST_DISTANCES):
        ends = [line.end(number * distance) for number in range(1, POINTS + 1)]
        if any(note for _, _, note in ends):
            return 0.0, 0.0
        values = np.array([value for value, _, _ in ends])
        changes = np.array([change for _, change, _ in ends])
        if np.count_nonzero(np.diff(values)) > POINTS // 2:
            size = max(*np.abs(values).tolist(), abs(line.base), np.finfo(float).tiny)
            differences = np.diff(values - line.base - changes, ORDER)
            deviation = norm(differences) / math.sqrt((POINTS - ORDER) * VARIANCE)
            return deviation / (line.evaluations.eps * size), deviation
        distance *= GROWTH
    return 0.0, 0.0
