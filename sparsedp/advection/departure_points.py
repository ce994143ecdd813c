"""From the velocity at the points to their departure points.

With s = dt / spacing the departure point of point i is, in index coordinates,

    euler:     i - s w(i)
    midpoint:  i - s m,    m = w at i - (s / 2) w(i), linear between points.

For euler the cotangent of m is that of w. For midpoint, with I the interpolation at i - (s / 2) w,

    g_w = I^T g_m + (gradient of I w in w) g_m.

Everything depends on s w alone: the derivative in dt is that in w along w / dt.
"""

import numpy as np

from sparsedp.advection.interpolant import Pass

__all__ = ["Trajectory"]

NONE = np.empty(0)


class Trajectory:
    """Where the points of a component come from in a signed step along w, their velocities (axis, point).

    Parameters
    ----------
    component : Interpolant
    w : array
    step : float

    Attributes
    ----------
    displacement, scale, sides
        The departure point is point - scale * displacement; see `index_coordinates`.
    """

    def __init__(self, component, w, step):
        self.component, self.rows = component, []
        if component.half_way is not None:
            half_way = Trajectory(component.half_way, w, 0.5 * step)
            self.rows = [Pass(half_way, row, NONE) for row in w]
            w = np.stack([row.value() for row in self.rows])
        self.displacement, self.scale, self.sides = component.coordinates.displacement(w, step)

    def vjp(self, g):
        """Cotangent of the velocity used all along the step -> that of w, in its place."""
        if not self.rows:
            return
        given, bent, change = g.copy(), np.zeros_like(g), np.empty_like(g)
        for row, part, target in zip(self.rows, given, g, strict=True):
            row.vjp(part, (target, NONE), change)
            bent += change
        g += bent

    def jvp(self, dw):
        """Tangent of w -> that of the velocity used all along the step."""
        return np.stack([row.jvp(dv, NONE, dw) for row, dv in zip(self.rows, dw, strict=True)]) if self.rows else dw
