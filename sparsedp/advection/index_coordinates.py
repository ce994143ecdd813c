"""Index coordinates: from a velocity and a step to the displacement of the departure point, counted in points.

The departure point of point i is i - scale d in index coordinates. On cells of equal width d is the velocity and
scale = step / spacing. On others let x(q) be the interpolant of the positions of the points, the same that the field
gets (linear or Catmull-Rom), and q(x) its inverse. Then scale = 1 and

    d_i = i - q(x_i - step m_i),    derivative of d_i in m_i = step q',

so that a field linear in x is carried exactly. q is piecewise linear for linear interpolation, and its slope jumps
at the points: there the derivative is the mean of both sides, each the slope of the field times that of q. For cubic
interpolation q is smooth, and monotone as long as neighbouring distances differ by no more than a factor of 5.
Beyond a wall the points go on at the distance of the width of the last cell.
"""

import numpy as np

from sparsedp._utils import buffers
from sparsedp._utils.validation import EPS, number_beside

__all__ = ["Coordinates"]

LAYERS = 4  # points beyond each end
STEEPEST = 5.0  # ratio of neighbouring distances up to which a Catmull-Rom curve is monotone
NEWTON = 50  # steps at most; about five are needed
BLOCK = 1 << 13  # points at a time: what is made on the way stays in the cache


class Coordinates:
    """Index coordinates of component `number` of a field."""

    def __init__(self, setting, number, interpolation):
        grid, self.shape, self.lines = setting.grid, setting.space.parts[number], []
        self.rates = np.array([1.0 / float(h[0]) for h in grid.widths])
        for axis, h in enumerate(() if all(grid.uniform) else grid.widths):
            on_faces, periodic = setting.of == "faces" and number == axis, grid.periodic[axis]
            gaps = h if on_faces else 0.5 * (h + np.roll(h, -1))[: h.size - (not periodic)]
            ends = dict(mode="wrap") if periodic else dict(constant_values=(h[0], h[-1]))
            gaps = np.pad(gaps, LAYERS, **ends)
            if interpolation == "cubic":
                _check_monotone(setting.scheme, gaps)
            self.lines.append(Line(gaps, h.size if periodic else None, interpolation == "cubic"))

    def displacement(self, m, step):
        """Velocities (axis, point), signed step -> d, its scale, the derivative of d in m.

        On cells of equal width that is 1: (). Else one, or two where it may jump: above and below.
        """
        if not self.lines:
            return m, self.rates * step, ()
        found = buffers.empty((2 if self.lines[0].cubic else 3, *m.shape), float)
        for start in range(0, m.shape[1], BLOCK):
            some = np.arange(start, min(start + BLOCK, m.shape[1]))
            for axis, (line, points) in enumerate(zip(self.lines, np.unravel_index(some, self.shape), strict=True)):
                q, *slopes = line.index(line.knots[LAYERS + points] - step * m[axis, some])
                found[:, axis, some] = points - q, *(step * slope for slope in slopes)
        return found[0], np.ones(len(m)), found[1:]


class Line:
    """Points along an axis, and the index coordinate of a place among them.

    Parameters
    ----------
    gaps : array
        Distances between the points, LAYERS beyond each end included.
    turn : int or None
        Points in a period.
    cubic : bool
        Whether the position between the points is the curve of Catmull and Rom; else straight lines.
    """

    def __init__(self, gaps, turn, cubic):
        self.knots, self.gaps, self.turn, self.cubic = np.concatenate([[0.0], np.cumsum(gaps)]), gaps, turn, cubic
        self.tangents = np.gradient(self.knots)  # slopes of the cubic at the points

    def index(self, x):
        """Places -> index coordinates, and their slopes in x: one, or two where it may jump, above and below."""
        if self.turn is None:
            x, turns = np.clip(x, self.knots[0], self.knots[-1]), 0
        else:
            start, end = self.knots[[LAYERS, LAYERS + self.turn]]
            turns = np.floor((x - start) / (end - start))
            x, turns = x - turns * (end - start), turns * self.turn
        gap = np.minimum(np.searchsorted(self.knots, x, "right") - 1, self.gaps.size - 1)
        aim, width, number = x - self.knots[gap], self.gaps[gap], gap - LAYERS + turns
        if self.cubic:
            part, slope = _inverse(aim, width, self.tangents[gap], self.tangents[gap + 1])
            return number + part, slope
        below = np.where(aim == 0, self.gaps[np.maximum(gap - 1, 0)], width)
        return number + aim / width, 1.0 / width, 1.0 / below


def _check_monotone(scheme, gaps):
    ratio = np.maximum(gaps[1:] / gaps[:-1], gaps[:-1] / gaps[1:]).max()
    if ratio > STEEPEST * (1 + 1e-9):
        raise ValueError(
            f"transport {scheme} with cubic interpolation needs points whose distances change by at most "
            f"a factor of {STEEPEST:g} from one to the next, got {number_beside(ratio, STEEPEST, digits=3)}; "
            "write interpolation='linear'"
        )


def _inverse(aim, gap, first, last):
    """t where the cubic with the ends 0, gap and the slopes first, last is aim, and the slope of t there.

    Newton's method on a cubic that grows with t. It starts where the cubic is straight, and from there on it is bent to
    one side only: the steps overshoot once at most, so that the ends of the gap are all the bounds they need.
    """
    square, cube = 3 * gap - 2 * first - last, first + last - 2 * gap
    slope = lambda t: np.maximum((3 * cube * t + 2 * square) * t + first, EPS * gap)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.fmin(np.fmax(-square / (3 * cube), 0.0), 1.0)  # 0 also where the cubic is a straight line
    for _ in range(NEWTON):
        before = t
        t = np.clip(t - (((cube * t + square) * t + first) * t - aim) / slope(t), 0.0, 1.0)
        if np.all(np.abs(t - before) <= 4 * EPS):
            break
    return t, 1.0 / slope(t)
