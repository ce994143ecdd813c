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

__all__ = ["Stretched", "Uniform"]

LAYERS = 4  # points beyond each end
STEEPEST = 5.0  # ratio of neighbouring distances up to which a Catmull-Rom curve is monotone
NEWTON = 50  # steps at most; about four are needed


class Uniform:
    """Cells of equal width along each axis."""

    def __init__(self, grid):
        self.rates = np.array([1.0 / float(h[0]) for h in grid.widths])

    def displacement(self, m, step):
        """Velocities (axis, point), signed step -> d, its scale, and the derivative of d in m above and below: 1."""
        return m, self.rates * step, None


class Stretched:
    """Cells of any width, for component `number` of the field."""

    def __init__(self, setting, number, interpolation):
        grid, self.shape = setting.grid, setting.space.parts[number]
        self.lines = []
        for axis, h in enumerate(grid.widths):
            nodes = np.concatenate([[0.0], np.cumsum(h)])
            period = nodes[-1] if grid.periodic[axis] else None
            if setting.of == "faces" and number == axis:
                positions = nodes if period is None else nodes[:-1]
            else:
                positions = nodes[:-1] + 0.5 * h
            self.lines.append(Line(positions, h, period, setting.scheme if interpolation == "cubic" else None))

    def displacement(self, m, step):
        """See Uniform."""
        d, above, below = np.empty((3, *m.shape))
        for axis, (line, index) in enumerate(zip(self.lines, np.indices(self.shape).reshape(m.shape), strict=True)):
            q, up, down = line.index(line.positions[index] - step * m[axis])
            d[axis], above[axis], below[axis] = index - q, step * up, step * down
        return d, np.ones(len(m)), (above, below)


class Line:
    """Points along an axis, and the index coordinate of a place among them.

    Parameters
    ----------
    positions : array
    widths : array
        Of the cells; those at the ends are the distances further out.
    period : float or None
    scheme : str or None
        The scheme that asks for the cubic curve of Catmull and Rom through the points; None: straight lines.
    """

    def __init__(self, positions, widths, period, scheme):
        self.positions, self.period = positions, period
        if period is None:
            far = np.arange(1, LAYERS + 1)
            before, after = positions[0] - far[::-1] * widths[0], positions[-1] + far * widths[-1]
            self.knots = np.concatenate([before, positions, after])
        else:
            turn = np.arange(-LAYERS, positions.size + LAYERS)
            self.knots = positions[turn % positions.size] + period * (turn // positions.size)
        self.gaps = np.diff(self.knots)
        self.first = self.last = self.gaps  # slopes of the position at both ends of a gap
        if scheme is not None:
            _check_monotone(scheme, self.gaps)
            tangents = np.gradient(self.knots)
            self.first, self.last = tangents[:-1], tangents[1:]

    def index(self, x):
        """Places -> index coordinates, and their slopes in x above and below."""
        turns = 0.0
        if self.period is None:
            x = np.clip(x, self.knots[0], self.knots[-1])
        else:
            turns = np.floor((x - self.positions[0]) / self.period)
            x = x - turns * self.period
        cell = np.clip(np.searchsorted(self.knots, x, "right") - 1, 0, self.gaps.size - 1)
        part, above = _inverse(x - self.knots[cell], self.gaps[cell], self.first[cell], self.last[cell])
        below = np.where(part == 0, 1.0 / self.last[np.maximum(cell - 1, 0)], above)
        return cell - LAYERS + part + turns * self.positions.size, above, below


def _check_monotone(scheme, gaps):
    ratio = np.maximum(gaps[1:] / gaps[:-1], gaps[:-1] / gaps[1:]).max()
    if ratio > STEEPEST * (1 + 1e-9):
        raise ValueError(
            f"transport {scheme} with cubic interpolation needs points whose distances change by at most "
            f"a factor of {STEEPEST:g} from one to the next, got {ratio:.3g}; write interpolation='linear'"
        )


def _inverse(aim, gap, first, last):
    """t where the cubic with the ends 0, gap and the slopes first, last is aim, and the slope of t there.

    Newton's method on a cubic that grows with t; bisection where a step leads out of the bracket.
    """
    square, cube = 3 * gap - 2 * first - last, first + last - 2 * gap
    slope = lambda t: (3 * cube * t + 2 * square) * t + first
    t, low, high = aim / gap, np.zeros_like(aim), np.ones_like(aim)
    for _ in range(NEWTON):
        miss = ((cube * t + square) * t + first) * t - aim
        low, high = np.where(miss <= 0, t, low), np.where(miss >= 0, t, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            new = t - miss / slope(t)
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        done = np.all(np.abs(new - t) <= 4 * np.finfo(float).eps)
        t = new
        if done:
            break
    return t, 1.0 / slope(t)
