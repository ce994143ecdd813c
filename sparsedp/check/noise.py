"""How much a loss varies where it should not: its noise, from a table of differences of neighbouring values.

Values at equal distances h, so close that a smooth loss is a straight line there. The k-th differences of a line
are 0; those of independent errors of standard deviation s have the variance s^2 (2k)! / (k!)^2. The distance is no
power of two times the others, and it grows until the loss changes from point to point: else the steps of a loss
that was rounded (to single precision, by a table) fall on the points of the sweep and hide.

Source: the table is that of J. J. Moré and S. M. Wild, SIAM J. Sci. Comput. 33, 2011.
"""

from math import factorial

import numpy as np

__all__ = ["POINTS", "noise_of"]

POINTS = 8  # of a table
ORDERS = (4, 5, 6)  # of the differences that are read: parabolas leave them alone
FIRST = 0.7320508 * 2.0**-28  # least distance, in units of x, of double precision
GROWTH = 2.0**6  # of the distance, while the loss stands still
MOST = 4  # distances tried


def noise_of(lines, point, trials, base):
    """Lines through a point -> noise of the loss, in units of its rounding; 0 where nothing varies.

    Parameters
    ----------
    lines : sequence of Line
        The noise belongs to the loss, not to a direction: the largest counts for all.
    point : Point
    trials : Trials
    base : float
        The loss at the point.
    """
    return max((_along(line, point, trials, base) for line in lines), default=0.0)


def _along(line, point, trials, base):
    distance = FIRST * max(1.0, point.eps / np.finfo(float).eps) ** 0.5
    for _ in range(MOST):
        values, rests = _values(line, point, trials, base, distance)
        if values is None:
            return 0.0
        if np.count_nonzero(np.diff(values)) > POINTS // 2:
            return _spread(rests) / (trials.eps * max(np.max(np.abs(values)), abs(base), np.finfo(float).tiny))
        distance *= GROWTH
    return 0.0


def _values(line, point, trials, base, distance):
    """The loss at neighbours, and what remains when the gradient is taken off; None where the loss refuses one."""
    values, rests = [], []
    for place in range(POINTS):
        end = point.moved(line.direction, (place + 1) * distance)  # on one side: a kink at x is no noise
        value, note = trials.attempt(point.tree(end))
        if note:
            return None, None
        values.append(value)
        rests.append(value - base - line.expected(point.away(end)))
    return np.array(values), np.array(rests)


def _spread(rests):
    """Standard deviation of independent errors, by the differences of each order; the least is nearest to noise."""
    largest = float(np.max(np.abs(rests)))
    if not largest > 0:
        return 0.0
    found, table = [], rests / largest
    for order in range(1, max(ORDERS) + 1):
        table = np.diff(table)
        if order in ORDERS:
            share = factorial(order) ** 2 / factorial(2 * order)
            found.append(np.sqrt(share * np.mean(table**2)))
    return largest * float(min(found))
