"""Departure points: where the content of each point comes from in a step along the velocity.

With s = dt / spacing, the departure point of point i is, in index coordinates,

    euler:     i - s w(i)
    midpoint:  i - s m,    m = w at i - (s / 2) w(i), linear between points.

For euler the velocity used along the step is w itself. For midpoint, with the interpolation I at i - (s / 2) w, the
cotangent of w is

    g_w = I^T g_m + (gradient of I w in w) g_m.

Everything depends on s w alone: the derivative in dt is the derivative in w along w / dt.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparsedp.advection.interpolant import InterpolatedComponent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.advection.interpolant import Interpolant

__all__ = ["Trajectory"]

EMPTY = np.empty(0)  # no inflow values


class Trajectory:
    """The paths of the points of a component in a signed step along their velocities.

    Parameters
    ----------
    interpolant : Interpolant
    w : array, shape (axes, points)
        Velocities at the points.
    step : float
        Signed time step.

    Attributes
    ----------
    displacement : Displacement
        Displacements of the departure points.
    """

    def __init__(self, interpolant: Interpolant, w: NDArray, step: float) -> None:
        self.interpolant = interpolant
        self._half_way: list[InterpolatedComponent] = []  # for midpoint: each velocity component half way
        if interpolant.half_way is not None:
            first_half = Trajectory(interpolant.half_way, w, 0.5 * step)
            self._half_way = [first_half.at_departure_points(row, EMPTY) for row in w]
            w = np.stack([row.value() for row in self._half_way])
        self.displacement = interpolant.coordinates.displacement(w, step)

    def at_departure_points(self, u: NDArray, inflow: NDArray) -> InterpolatedComponent:
        """Return a field at the departure points."""
        return InterpolatedComponent(self.interpolant, self.displacement, u, inflow)

    def vjp(self, g: NDArray) -> None:
        """Replace the cotangent of the velocity used along the step by the cotangent of w, in place."""
        if not self._half_way:
            return
        given = g.copy()
        through_points = np.zeros_like(g)
        slopes = np.empty_like(g)
        for row, part, target in zip(self._half_way, given, g, strict=True):
            row.vjp(part, target, EMPTY)
            through_points += row.velocity_slopes(part, slopes)
        g += through_points

    def jvp(self, dw: NDArray) -> NDArray:
        """Return the tangent of the velocity used along the step for the tangent of w."""
        if not self._half_way:
            return dw
        return np.stack([row.jvp(dv, EMPTY, dw) for row, dv in zip(self._half_way, dw, strict=True)])
