"""With which velocity a point looks back to its departure point.

With s = dt / spacing the departure point of point i is, in index coordinates,

    euler:     i - s w(i)
    midpoint:  i - s m,    m = w at i - (s / 2) w(i), linear between points.

For euler the cotangent of m is that of w. For midpoint, with I the interpolation at i - (s / 2) w,

    g_w = I^T g_m + (gradient of I w in w) g_m,    g_dt += (the second term) . w / dt.
"""

import numpy as np

from sparsedp.advection.interpolant import Interpolant, Pass

__all__ = ["Euler", "Midpoint"]

NONE = np.empty(0)


class Euler:
    """Departure points i - s w."""

    def velocity(self, number, w, step):
        """Velocity w at the points of component `number` -> the one used all along the step, m."""
        return w

    def vjp(self, number, w, step, g):
        """Cotangent of m -> that of w; the part of it that comes from the departure points half way, or None."""
        return g, None

    def jvp(self, number, w, trajectory, dw, ddt):
        """Tangents of w and, relative, of the step -> that of step m, over the step."""
        return dw + ddt * w


class Midpoint:
    """Departure points i - s m, m being the velocity half way."""

    def __init__(self, setting):
        numbers = range(len(setting.space.parts))
        self.interpolants = [Interpolant(setting, number, "linear", closed=True) for number in numbers]

    def _half_way(self, number, w, step):
        """For each component of w the pass to the departure points half way."""
        interpolant = self.interpolants[number]
        half = interpolant.trajectory(w, 0.5 * step)
        return [Pass(interpolant, half, row, NONE) for row in w]

    def velocity(self, number, w, step):
        """See Euler."""
        return np.stack([row.value() for row in self._half_way(number, w, step)])

    def vjp(self, number, w, step, g):
        """See Euler."""
        direct, (bent, change) = np.empty_like(w), np.zeros((2, *w.shape))
        for row, part, target in zip(self._half_way(number, w, step), g, direct, strict=True):
            row.vjp(part, (target, NONE), change)
            bent += change
        return direct + bent, bent

    def jvp(self, number, w, trajectory, dw, ddt):
        """See Euler."""
        rows, dhalf = self._half_way(number, w, trajectory.step), dw + ddt * w
        moved = [row.jvp(part, NONE, dhalf) for row, part in zip(rows, dw, strict=True)]
        return np.stack(moved) + ddt * trajectory.velocity
