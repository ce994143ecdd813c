"""Measure the noise of a loss by a table of differences of neighbouring values.

References
----------
J. J. Moré and S. M. Wild, Estimating computational noise, SIAM J. Sci. Comput. 33, 2011.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.pytree import norm
from sparsedp.check.evaluations import Line
from sparsedp.check.point import Point

__all__ = ["POINTS", "measure_noise", "noise_of_entries", "noise_steps"]

POINTS = 8  # number of values in the table
ORDER = 4  # order of the differences, which are 0 for polynomials of lower degree
# Variance of such a difference if the values have independent errors of variance 1.
VARIANCE = math.factorial(2 * ORDER) / math.factorial(ORDER) ** 2
SMALLEST_DISTANCE = 0.7320508 * 2.0**-28  # in units of x, for float64; its ratio to a step is never a power of two
GROWTH = 2.0**6  # factor by which the distance is increased while the loss does not change
MOST_DISTANCES = 4


def noise_steps(point: Point, points: int) -> list[float]:
    """Return the steps of the finest table of differences."""
    distance = SMALLEST_DISTANCE * max(1.0, point.eps / float(np.finfo(float).eps)) ** 0.5
    return [number * distance for number in range(1, points + 1)]


def noise_of_entries(values: Sequence[NDArray[Any]], base: NDArray[Any]) -> NDArray[Any]:
    """Return the noise of each entry of a vector-valued function, from its values at equidistant points.

    Parameters
    ----------
    values : list of ndarray
        Empty if the function has no values there; the noise is then 0.
    base : ndarray
        The value at x.
    """
    if not values:
        return np.zeros_like(base)
    differences = np.diff([value - base for value in values], ORDER, axis=0)
    size = float(np.max(np.abs(differences), initial=0.0)) or 1.0  # the squares of large values overflow
    return size * np.sqrt(np.mean((differences / size) ** 2, axis=0) / VARIANCE)


def measure_noise(line: Line, points: int = POINTS) -> tuple[float, float]:
    """Measure the noise of a loss: its variation that is not smooth.

    Parameters
    ----------
    line : Line
    points : int
        Number of values in the table, at least 6.

    Returns
    -------
    (float, float)
        Standard deviation in units of the rounding of the loss, and as an absolute value. Both are 0 if the loss does
        not vary.

    Notes
    -----
    The loss is evaluated at equidistant points that are so close that a smooth loss is linear there. The k-th
    differences of a linear function are 0. Those of independent errors with standard deviation s have the variance
    s^2 (2k)! / (k!)^2. A loss may be piecewise constant, for example if it is rounded to single precision. To detect
    this, the distance is increased until the loss changes from point to point, and its ratio to the steps of the sweep
    is not a power of two. All points lie on one side of x, because a kink at x is not noise.
    """
    distance = noise_steps(line.point, 1)[0]
    for _ in range(MOST_DISTANCES):
        ends = [line.end(number * distance) for number in range(1, points + 1)]
        if any(note for _, _, note in ends):
            return 0.0, 0.0
        values = np.array([value for value, _, _ in ends])
        changes = np.array([change for _, change, _ in ends])
        if np.count_nonzero(np.diff(values)) > points // 2:
            size = max(*np.abs(values).tolist(), abs(line.base), np.finfo(float).tiny)
            differences = np.diff(values - line.base - changes, ORDER)
            deviation = norm(differences) / math.sqrt((points - ORDER) * VARIANCE)
            return deviation / (line.evaluations.eps * size), deviation
        distance *= GROWTH
    return 0.0, 0.0
