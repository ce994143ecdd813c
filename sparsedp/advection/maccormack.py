"""MacCormack transport: a semi-Lagrangian step, corrected by half the error of stepping forward and back.

With the step f = W u and the step backwards in time b = V f,

    u' = f + (u - b) / 2,     clamped to the least and greatest sample of the cell around the departure point.

The cotangents of f and u for a cotangent g of u' are

    g_f = c g - V^T (c g) / 2,    g_u = c g / 2 + W^T g_f + (cotangents of the bounds),    c = 1 where not clamped.

The cotangent of a clamped value is distributed in equal parts over the samples that equal the bound. If the unclamped
value equals a bound, the derivative is the mean of both one-sided derivatives: c = 1/2, and the other half of the
cotangent goes to the samples of the bound. The scheme is second-order accurate in space and time for smooth data;
clamping lowers the order at extrema.

References
----------
A. Selle, R. Fedkiw, B. Kim, Y. Liu, J. Rossignac, J. Scientific Computing 35 (2008) 350-371.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sparsedp._utils import buffers
from sparsedp.advection.departure_points import Trajectory
from sparsedp.advection.semi_lagrangian import SemiLagrangian
from sparsedp.kernels import interpolation_weights

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.advection.interpolant import Interpolant

__all__ = ["CorrectedStep", "MacCormack"]


class _Clamped(NamedTuple):
    """The points at which the value is clamped or equals a bound."""

    points: NDArray
    free_share: NDArray  # derivative of the result in the unclamped value
    samples: NDArray  # indices of the samples of the cells around the departure points, a row for each corner
    sample_shares: NDArray  # derivatives of the result in these samples


class CorrectedStep:
    """The MacCormack step of one component of the field, with the methods of `ComponentStep`.

    `vjp` may be called only once, because it reuses the arrays of the step.

    Parameters
    ----------
    interpolant : Interpolant
    w : array, shape (axes, points)
        Velocities at the points.
    dt : float
    u : array
        The component as a flat array.
    inflow : array
        All inflow values.
    """

    def __init__(self, interpolant: Interpolant, w: NDArray, dt: float, u: NDArray, inflow: NDArray) -> None:
        self.clamp = interpolant.settings.clamp
        self.back = Trajectory(interpolant, w, dt)
        self.ahead = Trajectory(interpolant, w, -dt)
        if self.clamp:
            self.bounds = buffers.empty((2, u.size), float)
        else:
            self.bounds = interpolation_weights.NO_BOUNDS
        self.first = self.back.at_departure_points(u, inflow)
        f = self.first.value(bounds=self.bounds)
        self.second = self.ahead.at_departure_points(f, inflow)
        self.unclamped = self.second.value()
        np.subtract(u, self.unclamped, out=self.unclamped)
        self.unclamped *= 0.5
        self.unclamped += f

    def _clamped(self) -> _Clamped:
        points = np.flatnonzero((self.unclamped <= self.bounds[0]) | (self.unclamped >= self.bounds[1]))
        value = self.unclamped[points]
        below = np.heaviside(self.bounds[0, points] - value, 0.5)
        above = np.heaviside(value - self.bounds[1, points], 0.5)
        values, scale, _ = self.first.displacement
        samples, least, greatest = interpolation_weights.bound_shares(
            self.first.points, self.first.samples, values, scale, points
        )
        return _Clamped(points, 1.0 - below - above, samples, least * below + greatest * above)

    def value(self, out: NDArray) -> None:
        """Set `out` to the component after the step."""
        if self.clamp:
            np.clip(self.unclamped, self.bounds[0], self.bounds[1], out=out)
        else:
            out[:] = self.unclamped

    def vjp(self, g: NDArray, of_u: NDArray | None, of_inflow: NDArray, of_w: NDArray | None) -> None:
        """Compute the cotangents of u, inflow and w; see `ComponentStep.vjp`."""
        of_unclamped = buffers.empty(g.shape, float)
        of_unclamped[:] = g
        of_samples = None
        if self.clamp:
            clamped = self._clamped()
            of_unclamped[clamped.points] *= clamped.free_share
            of_samples = (clamped.samples, clamped.sample_shares * g[clamped.points])
        of_b = np.multiply(-0.5, of_unclamped, out=self.unclamped)
        of_f = buffers.empty(g.shape, float)
        self.second.vjp(of_b, of_f, of_inflow if of_u is not None else np.zeros_like(of_inflow))
        if of_w is not None:
            of_w_ahead = buffers.empty(of_w.shape, float)
            self.ahead.vjp(self.second.velocity_slopes(of_b, of_w_ahead))
        of_f += of_unclamped
        if of_u is not None:
            self.first.vjp(of_f, of_u, of_inflow, of_samples)
            np.subtract(of_u, of_b, out=of_u)
        if of_w is not None:
            self.back.vjp(self.first.velocity_slopes(of_f, of_w))
            of_w += of_w_ahead

    def jvp(self, du: NDArray, dinflow: NDArray, dw: NDArray | None) -> NDArray:
        """Return the tangent; see `ComponentStep.jvp`."""
        df = self.first.jvp(du, dinflow, None if dw is None else self.back.jvp(dw))
        db = self.second.jvp(df, dinflow, None if dw is None else self.ahead.jvp(dw))
        total = df + 0.5 * (du - db)
        if self.clamp:
            clamped = self._clamped()
            samples = self.first.with_field(du, dinflow).samples
            through_bounds = np.sum(clamped.sample_shares * samples[clamped.samples], axis=0)
            total[clamped.points] = clamped.free_share * total[clamped.points] + through_bounds
        return total


class MacCormack(SemiLagrangian):
    """The MacCormack scheme; the module docstring has its formulas."""

    options = ("interpolation", "backtrace", "clamp")
    linear = False
    component_step = CorrectedStep
