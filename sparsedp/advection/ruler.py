"""From lengths to numbers of points: where, in units of points, a place lies that a velocity and a step lead to.

The loops of `sampling` look at i - scale w. On cells of equal width w is the velocity and scale = step / spacing.
On others let x(q) be the interpolant of the positions of the points, the same that the field gets (linear or
Catmull-Rom), and q(x) its inverse. Then scale = 1 and

    w_i = i - q(x_i - step m_i),    d w_i / d m_i = step q',

so that a field linear in x is carried exactly. q is piecewise linear for linear interpolation, and its slope jumps
at the points: there the derivative is the mean of both sides, each the slope of the field times that of q. For cubic
interpolation q is smooth, and monotone as long as neighbouring distances differ by no more than a factor of 5.
Beyond a wall the points go on at the distance of the width of the last cell.
"""

from typing import Any

import numpy as np

from sparsedp.advection.law import component_shapes
from sparsedp.kernels import sampling

__all__ = ["Look", "ruler_of", "three"]

LAYERS = 4  # points beyond each end
STEEPEST = 5.0
NEWTON = 50  # at most; about four are needed


def ruler_of(setting, interpolation):
    """Setting, linear or cubic -> Uniform or Stretched."""
    return Uniform(setting) if all(setting.grid.uniform) else Stretched(setting, interpolation)


def three(w):
    """One array for each of three axes; those that are not there get the first one, and nothing comes of it."""
    return (w[0],) * (3 - len(w)) + tuple(w)


class Look(tuple):
    """What the loops take, (three arrays, their scale), and what it comes from: velocities and a signed step."""

    speeds: Any
    step: float
    sides: Any = None  # on stretched grids: step times the slope of q above and below each place

    def __new__(cls, arrays, scale, speeds, step, sides=None):
        found = super().__new__(cls, (three(arrays), scale))
        found.speeds, found.step, found.sides = speeds, step, sides
        return found


class Uniform:
    """Cells of equal width along each axis."""

    def __init__(self, setting):
        self.rates = (0.0,) * (3 - setting.grid.dim) + tuple(1.0 / float(h[0]) for h in setting.grid.widths)

    def scale(self, step):
        """Points that a velocity of 1 leads across in a step."""
        return self.rates[0] * step, self.rates[1] * step, self.rates[2] * step

    def look(self, number, speeds, step):
        """Velocities (axis, point) of component `number`, signed step -> Look."""
        return Look(speeds, self.scale(step), speeds, step)

    def steepness(self, points, samples, look, g):
        """g times the derivative of what is found, in the velocities of the look."""
        return _slopes(points, samples, look.speeds, look[1], g)


class Stretched:
    """Cells of any width."""

    def __init__(self, setting, interpolation):
        self.lines = [
            [_line(setting, axis, number, interpolation) for axis in range(setting.grid.dim)]
            for number in range(len(component_shapes(setting)))
        ]
        self.shapes = component_shapes(setting)

    def look(self, number, speeds, step):
        """See Uniform."""
        shape, places, above, below = self.shapes[number], *np.empty((3, *speeds.shape))
        for axis, line in enumerate(self.lines[number]):
            points = np.arange(shape[axis]).reshape([-1 if a == axis else 1 for a in range(len(shape))])
            points = np.broadcast_to(points, shape).ravel()
            index, up, down = line.index(line.positions[points] - step * speeds[axis])
            places[axis], above[axis], below[axis] = points - index, step * up, step * down
        return Look(places, (1.0,) * 3, speeds, step, (above, below))

    def steepness(self, points, samples, look, g):
        """See Uniform."""
        (above, below), arrays = look.sides, np.stack(look[0][3 - len(look.speeds) :])
        kinks = above != below
        if not kinks.any():
            return above * _slopes(points, samples, arrays, look[1], g)
        nudge = np.where(kinks, 16 * np.finfo(float).eps * (max(points.shape) + LAYERS), 0.0)
        upper, lower = (_slopes(points, samples, arrays + sign * nudge, look[1], g) for sign in (-1, 1))
        return 0.5 * (above * upper + below * lower)


def _slopes(points, samples, arrays, scale, g):
    """g times the slope of the samples along each axis, where arrays (axis, point) and their scale lead to."""
    found = np.zeros_like(arrays)
    sampling.slopes(points, samples, three(arrays), scale, g, three(found))
    return found


def _line(setting, axis, number, interpolation):
    """The points of a component along an axis."""
    grid, h = setting.grid, setting.grid.widths[axis]
    nodes = np.concatenate([[0.0], np.cumsum(h)])
    on_nodes = setting.of == "faces" and number == axis
    if not on_nodes:
        positions = nodes[:-1] + 0.5 * h
    else:
        positions = nodes[:-1] if grid.periodic[axis] else nodes
    period = nodes[-1] if grid.periodic[axis] else None
    return (Line if interpolation == "linear" else Curve)(positions, h, period, setting)


class Line:
    """Points along an axis, and the way from a place to its number: linear between points.

    Parameters
    ----------
    positions : array
    widths : array
        Of the cells; those at the ends are the distances further out.
    period : float or None
    setting : Setting
    """

    def __init__(self, positions, widths, period, setting):
        self.positions, self.period, n = positions, period, positions.size
        far = np.arange(1, LAYERS + 1)
        if period is None:
            before, after = positions[0] - far[::-1] * widths[0], positions[-1] + far * widths[-1]
        else:
            turn = np.arange(-LAYERS, n + LAYERS)
            wrapped = positions[turn % n] + period * (turn // n)
            before, after = wrapped[:LAYERS], wrapped[LAYERS + n :]
        self.knots = np.concatenate([before, positions, after])
        self.gaps = np.diff(self.knots)

    def index(self, x):
        """Places -> numbers of points, and the slopes above and below."""
        turns, n = 0.0, self.positions.size
        if self.period is None:
            x = np.clip(x, self.knots[0], self.knots[-1])
        else:
            turns = np.floor((x - self.positions[0]) / self.period)
            x = x - turns * self.period
        cell = np.clip(np.searchsorted(self.knots, x, "right") - 1, 0, self.gaps.size - 1)
        part, above, below = self.inside(cell, x)
        return cell - LAYERS + part + turns * n, above, below

    def inside(self, cell, x):
        """Gap and place -> the part of the gap below it, and the slopes."""
        part = (x - self.knots[cell]) / self.gaps[cell]
        above = 1.0 / self.gaps[cell]
        return part, above, np.where(part == 0, 1.0 / self.gaps[np.maximum(cell - 1, 0)], above)


class Curve(Line):
    """The same, by the cubic curve of Catmull and Rom through the points."""

    def __init__(self, positions, widths, period, setting):
        super().__init__(positions, widths, period, setting)
        ratio = np.maximum(self.gaps[1:] / self.gaps[:-1], self.gaps[:-1] / self.gaps[1:]).max()
        if ratio > STEEPEST * (1 + 1e-9):
            raise ValueError(
                f"transport {setting.scheme} with cubic interpolation needs points whose distances change by at most "
                f"a factor of {STEEPEST:g} from one to the next, got {ratio:.3g}; write interpolation='linear'"
            )
        self.tangents = np.gradient(self.knots)
        self.tangents[1:-1] = 0.5 * (self.knots[2:] - self.knots[:-2])

    def inside(self, cell, x):
        """Newton's method on x(t) = x, which grows with t; bisection where a step leads out of the bracket."""
        start, gap = self.knots[cell], self.gaps[cell]
        first, last = self.tangents[cell], self.tangents[cell + 1]
        square, cube = 3 * gap - 2 * first - last, first + last - 2 * gap
        aim = x - start
        t, low, high = aim / gap, np.zeros_like(aim), np.ones_like(aim)
        for _ in range(NEWTON):
            miss = ((cube * t + square) * t + first) * t - aim
            low, high = np.where(miss <= 0, t, low), np.where(miss >= 0, t, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                new = t - miss / ((3 * cube * t + 2 * square) * t + first)
            new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
            done = np.all(np.abs(new - t) <= 4 * np.finfo(float).eps)
            t = new
            if done:
                break
        slope = 1.0 / ((3 * cube * t + 2 * square) * t + first)
        return t, slope, slope
