"""With which velocity a point looks back to its departure point.

With s = dt / spacing the departure point of point i is, in index coordinates,

    euler:     i - s w(i)
    midpoint:  i - s m,    m = w at i - (s / 2) w(i), linear between points.

For euler the cotangent of m is that of w. For midpoint, with I the interpolation at i - (s / 2) w,

    g_w = I^T g_m + (gradient of I w in w) g_m,    g_dt += (the second term) . w / dt.
"""

import numpy as np

from sparsedp.advection.interpolant import Interpolant

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
        """Interpolant, trajectory half way, samples of each component of w."""
        interpolant = self.interpolants[number]
        return interpolant, interpolant.trajectory(w, 0.5 * step), [interpolant.pad(row, NONE) for row in w]

    def velocity(self, number, w, step):
        """See Euler."""
        interpolant, half, samples = self._half_way(number, w, step)
        return np.stack([interpolant.gather(row, half, np.empty(w.shape[1])) for row in samples])

    def vjp(self, number, w, step, g):
        """See Euler."""
        (interpolant, half, samples), direct, bent = self._half_way(number, w, step), np.empty_like(w), np.zeros_like(w)
        for row, part, target in zip(samples, g, direct, strict=True):
            interpolant.pad_vjp(interpolant.gather_vjp(part, half, np.empty), target, NONE)
            bent += interpolant.gradient(row, half, part, np.empty_like(w))
        return direct + bent, bent

    def jvp(self, number, w, trajectory, dw, ddt):
        """See Euler."""
        interpolant, half, samples = self._half_way(number, w, trajectory.step)
        changes, dhalf = [interpolant.pad(row, NONE) for row in dw], dw + ddt * w
        moved = [interpolant.jvp(*pair, half, dhalf) for pair in zip(samples, changes, strict=True)]
        return np.stack(moved) + ddt * trajectory.velocity
