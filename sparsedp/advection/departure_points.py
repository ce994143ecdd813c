"""Departure points: the position from which the value of each point is transported in a step.

With s = dt / spacing, the departure point of point i is, in index coordinates,

    euler:     i - s w(i)
    midpoint:  i - s m,    m = w at i - (s / 2) w(i), linear between points.

For euler the velocity along the step is w itself. For midpoint it is m. Let I be the interpolation at i - (s / 2) w; it
depends on w too, so that the cotangent of w is

    g_w = I^T g_m + (derivative of I w with respect to the positions) g_m.

Departure points depend on the product s w only. The derivative in dt is therefore the derivative in w along w / dt.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparsedp.advection.interpolant import InterpolatedComponent

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from sparsedp.advection.interpolant import Interpolant

__all__ = ["Trajectory"]

EMPTY = np.empty(0)  # the inflow values of a velocity: it has none


class Trajectory:
    """The displacement from each point of a component to its departure point, for a signed time step.

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
        Displacements of the departure points from the points.
    """

    __slots__ = ("_half_way", "displacement", "interpolant")

    def __init__(self, interpolant: Interpolant, w: NDArray, step: float) -> None:
        self.interpolant = interpolant
        self._half_way: Sequence[InterpolatedComponent] = ()  # for midpoint: the velocity components at the midpoints
        if interpolant.half_way is not None:
            first_half = Trajectory(interpolant.half_way, w, 0.5 * step)
            self._half_way = [first_half.at_departure_points(row, EMPTY) for row in w]
            w = np.stack([row.value() for row in self._half_way])
        self.displacement = interpolant.coordinates.displacement(w, step)

    def at_departure_points(self, u: NDArray, inflow: NDArray) -> InterpolatedComponent:
        """Return the object that interpolates a field at the departure points."""
        return InterpolatedComponent(self.interpolant, self.displacement, u, inflow)

    def vjp(self, g: NDArray) -> None:
        """Replace g, the cotangent of the velocity along the step, by the cotangent of w, in place."""
        if not self._half_way:
            return
        cotangents = g.copy()
        through_points = np.zeros_like(g)
        slopes = np.empty_like(g)
        for row, part, target in zip(self._half_way, cotangents, g, strict=True):
            row.vjp(part, target, EMPTY)
            through_points += row.velocity_slopes(part, slopes)
        g += through_points

    def jvp(self, dw: NDArray) -> NDArray:
        """Return the tangent of the velocity along the step for the tangent dw of w."""
        if not self._half_way:
            return dw
        return np.stack([row.jvp(dv, EMPTY, dw) for row, dv in zip(self._half_way, dw, strict=True)])
