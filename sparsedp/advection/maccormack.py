"""MacCormack transport: a semi-Lagrangian step, one back again, and half of what that misses added.

With f = W u (looking back along the velocity) and b = V f (looking ahead along it),

    u' = f + (u - b) / 2,     clamped to the least and greatest sample of the cell around the departure point.

    g_f = c g - V^T (c g) / 2,    g_u = c g / 2 + W^T g_f + (cotangents of the bounds),    c = 1 where not clamped.

Clamped values pass their cotangent on to the samples that equal the bound, in equal parts. Where the
value equals a bound the derivative is the mean of both sides: c = 1/2 and half goes to the bound.
Second order in space and time for smooth data; clamping lowers that at extrema.
Source: A. Selle, R. Fedkiw, B. Kim, Y. Liu, J. Rossignac, J. Scientific Computing 35 (2008) 350-371.
"""

import numpy as np

from sparsedp._utils import buffers
from sparsedp.advection.interpolant import Pass
from sparsedp.advection.semi_lagrangian import SemiLagrangian
from sparsedp.kernels import departure_samples

__all__ = ["MacCormack"]


class Corrected:
    """Two passes of a component, back in time and ahead again, and what becomes of them; used like a `Pass`, once."""

    def __init__(self, back, ahead, u, inflow):
        self.first, self.clamp = Pass(back, u, inflow), back.component.setting.clamp
        self.bounds = buffers.empty((2, u.size), float) if self.clamp else departure_samples.NO_BOUNDS
        f = self.first.value(bounds=self.bounds)
        self.second = Pass(ahead, f, inflow)
        self.new = self.second.value()  # what comes back, and then the new value before it is clamped
        np.subtract(u, self.new, out=self.new)
        self.new *= 0.5
        self.new += f

    def _clamps(self):
        """Points where the clamp acts: which, the share of the value that stays, samples and shares of the bounds."""
        first, new = self.first, self.new
        some = np.flatnonzero((new <= self.bounds[0]) | (new >= self.bounds[1]))
        (low, high), value = self.bounds[:, some], new[some]
        below, above = np.heaviside(low - value, 0.5), np.heaviside(value - high, 0.5)
        index, least, greatest = departure_samples.bound_shares(first.points, first.samples, *first.departure, some)
        return some, 1.0 - below - above, index, least * below + greatest * above

    def value(self, out):
        """See `Pass`."""
        np.clip(self.new, *(self.bounds if self.clamp else (-np.inf, np.inf)), out=out)

    def vjp(self, g, into, of_w):
        """See `Pass`."""
        own, of_f, clamped = buffers.empty(g.shape, float), buffers.empty(g.shape, float), None
        own[:] = g
        if self.clamp:
            some, free, index, shares = self._clamps()
            own[some] *= free
            clamped = index, shares * g[some]
        of_b, ahead = np.multiply(-0.5, own, out=self.new), None if of_w is None else buffers.empty(of_w.shape, float)
        self.second.vjp(of_b, (of_f, into[1] if into else np.zeros_like(self.first.inflow)), ahead)
        of_f += own
        self.first.vjp(of_f, into, of_w, clamped)
        if into is not None:
            np.subtract(into[0], of_b, out=into[0])
        if ahead is not None:
            of_w += ahead

    def jvp(self, du, dinflow, dw):
        """See `Pass`."""
        df = self.first.jvp(du, dinflow, dw)
        total = df + 0.5 * (du - self.second.jvp(df, dinflow, dw))
        if self.clamp:
            some, free, index, shares = self._clamps()
            samples = Pass(self.first.trajectory, du, dinflow).samples
            total[some] = free * total[some] + np.sum(shares * samples[index], axis=0)
        return total


class MacCormack(SemiLagrangian):
    """See the head of the file."""

    options = ("interpolation", "backtrace", "clamp")
    linear = False
    signs, passage = (1, -1), Corrected
