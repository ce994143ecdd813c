"""Index coordinates: positions measured in point indices, and the displacement of departure points in them.

The departure point of point i has the index coordinate i - scale d. On cells of equal width, d is the velocity and
scale = step / spacing. Otherwise let x(q) be the interpolant of the positions of the points at index q (linear or
Catmull-Rom, as for the field), and q(x) its inverse. Then scale = 1 and, with the velocity m,

    d_i = i - q(x_i - step m_i),    derivative of d_i in m_i = step q',

so that a field that is linear in x is transported exactly. For linear interpolation q is piecewise linear, and its
slope jumps at the points. The derivative there is the mean of two one-sided derivatives, each of which is the slope of
the field times the slope of q on that side. For cubic interpolation q is smooth, and monotone if neighbouring distances
differ by at most a factor of 5. Beyond a wall, the distance between points is the width of the last cell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sparsedp._utils import buffers
from sparsedp._utils.validation import EPS, number_beside

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.advection.settings import TransportSettings

__all__ = ["Displacement", "IndexCoordinates"]

LAYERS = 4  # number of additional points beyond each end
STEEPEST = 5.0  # largest ratio of neighbouring distances for which a Catmull-Rom curve is monotone
NEWTON_STEPS = 50  # upper limit; about five are needed
BLOCK = 1 << 13  # number of points processed at a time, so that intermediate arrays stay in the cache


class Displacement(NamedTuple):
    """Displacements of departure points in index coordinates.

    Attributes
    ----------
    values : array, shape (axes, points)
    scale : array, shape (axes,)
        The departure point of point i is at i - scale * values.
    slopes : array, shape (0, 1 or 2, axes, points)
        Derivatives of `values` in the velocity. Empty if they are 1 (cells of equal width). Two arrays if the
        derivative may jump at the departure point: from above and from below.
    """

    values: NDArray
    scale: NDArray
    slopes: NDArray | tuple


class IndexCoordinates:
    """The index coordinates for one component of the field.

    Parameters
    ----------
    settings : TransportSettings
    number : int
        Index of the component.
    interpolation : "linear" or "cubic"
    """

    def __init__(self, settings: TransportSettings, number: int, interpolation: str) -> None:
        grid = settings.grid
        self.shape = settings.space.parts[number]
        self.inverse_widths = np.array([1.0 / float(widths[0]) for widths in grid.widths])
        self._last_scale = 0.0, self.inverse_widths * 0.0
        self.axes: list[PointsOfAxis] = []
        if all(grid.uniform):
            return
        cubic = interpolation == "cubic"
        for axis, widths in enumerate(grid.widths):
            periodic = grid.periodic[axis]
            if settings.of == "faces" and number == axis:
                gaps = widths
            else:
                gaps = 0.5 * (widths + np.roll(widths, -1))[: widths.size - (not periodic)]
            if periodic:
                gaps = np.pad(gaps, LAYERS, mode="wrap")
            else:
                gaps = np.pad(gaps, LAYERS, constant_values=(widths[0], widths[-1]))
            if cubic:
                _check_monotone(settings.scheme, gaps)
            self.axes.append(PointsOfAxis(gaps, widths.size if periodic else None, cubic))

    def scale(self, step: float) -> NDArray:
        """Return the time step divided by the widths of the cells. The array of the last step is reused."""
        last_step, scale = self._last_scale  # one attribute, so that threads read matching values
        if last_step != step:
            scale = self.inverse_widths * step
            self._last_scale = step, scale
        return scale

    def displacement(self, m: NDArray, step: float) -> Displacement:
        """Return the displacements for velocities m (axis, point) and a signed time step."""
        if not self.axes:
            return Displacement(m, self.scale(step), ())
        if self.axes[0].cubic:
            slopes_per_point = 1
        else:
            slopes_per_point = 2
        result = buffers.empty((1 + slopes_per_point, *m.shape), float)
        for start in range(0, m.shape[1], BLOCK):
            block = np.arange(start, min(start + BLOCK, m.shape[1]))
            positions = np.unravel_index(block, self.shape)
            for number, (axis, points) in enumerate(zip(self.axes, positions, strict=True)):
                q, *slopes = axis.index_of(axis.knots[LAYERS + points] - step * m[number, block])
                result[0, number, block] = points - q
                for row, slope in enumerate(slopes, 1):
                    result[row, number, block] = step * slope
        return Displacement(result[0], np.ones(len(m)), result[1:])


class PointsOfAxis:
    """The points along an axis, and the map from positions to index coordinates.

    Parameters
    ----------
    gaps : array
        Distances between the points, including LAYERS points beyond each end.
    period : int or None
        Number of points in a period; None if the axis is not periodic.
    cubic : bool
        Whether x(q) is a Catmull-Rom curve; if False, it is piecewise linear.
    """

    def __init__(self, gaps: NDArray, period: int | None, cubic: bool) -> None:
        self.gaps = gaps
        self.period = period
        self.cubic = cubic
        self.knots = np.concatenate([[0.0], np.cumsum(gaps)])
        self.tangents = np.gradient(self.knots)  # slopes of the cubic at the points

    def index_of(self, x: NDArray) -> tuple[NDArray, ...]:
        """Return the index coordinates of positions x and their derivative: one array, or two if it may jump."""
        turns: NDArray | int = 0
        if self.period is None:
            x = np.clip(x, self.knots[0], self.knots[-1])
        else:
            start, end = self.knots[[LAYERS, LAYERS + self.period]]
            periods = np.floor((x - start) / (end - start))
            x = x - periods * (end - start)
            turns = periods * self.period
        gap = np.minimum(np.searchsorted(self.knots, x, "right") - 1, self.gaps.size - 1)
        offset = x - self.knots[gap]
        width = self.gaps[gap]
        number = gap - LAYERS + turns
        if self.cubic:
            fraction, slope = _inverse_of_cubic(offset, width, self.tangents[gap], self.tangents[gap + 1])
            return number + fraction, slope
        width_below = np.where(offset == 0, self.gaps[np.maximum(gap - 1, 0)], width)
        return number + offset / width, 1.0 / width, 1.0 / width_below


def _check_monotone(scheme: str, gaps: NDArray) -> None:
    ratio = np.maximum(gaps[1:] / gaps[:-1], gaps[:-1] / gaps[1:]).max()
    if ratio > STEEPEST * (1 + 1e-9):
        raise ValueError(
            f"transport {scheme} with cubic interpolation needs points whose distances change by at most "
            f"a factor of {STEEPEST:g} from one to the next, got {number_beside(ratio, STEEPEST, digits=3)}; "
            "write interpolation='linear'"
        )


def _inverse_of_cubic(target: NDArray, gap: NDArray, first: NDArray, last: NDArray) -> tuple[NDArray, NDArray]:
    """Return the t at which a cubic has the value `target`, and the derivative of t in `target`.

    The cubic increases from 0 at t = 0 to `gap` at t = 1, with the slopes `first` and `last` there. Newton's method
    starts at the inflection point. On each side of it the curvature has one sign, so that the iteration overshoots at
    most once and converges without other bounds than 0 <= t <= 1.
    """
    square = 3 * gap - 2 * first - last
    cube = first + last - 2 * gap

    def slope(t):
        return np.maximum((3 * cube * t + 2 * square) * t + first, EPS * gap)

    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.fmin(np.fmax(-square / (3 * cube), 0.0), 1.0)  # fmax also maps the NaN of a straight line to 0
    for _ in range(NEWTON_STEPS):
        previous = t
        t = np.clip(t - (((cube * t + square) * t + first) * t - target) / slope(t), 0.0, 1.0)
        if np.all(np.abs(t - previous) <= 4 * EPS):
            break
    return t, 1.0 / slope(t)
