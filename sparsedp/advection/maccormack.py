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

from sparsedp.advection.semi_lagrangian import SemiLagrangian
from sparsedp.kernels import departure

__all__ = ["MacCormack"]

BLOCK = 1 << 14  # points that NumPy works on at a time: what is made on the way stays in the cache


class MacCormack(SemiLagrangian):
    """See the head of the file."""

    options = ("interpolation", "backtrace", "clamp")
    linear = False
    signs = (1, -1)

    def __init__(self, setting):
        super().__init__(setting)
        self.clamped = setting.clamp

    def _stages(self, part):
        """Both passes, the value before it is clamped, least and greatest sample of u (if they count)."""
        n, first = part.u.size, part.look()
        bounds = part.room(2 * n).reshape(2, n) if self.clamped else departure.NO_BOUNDS
        f = first.value(bounds=bounds)
        second = part.look(1, f)
        new = second.value()
        for start in range(0, n, BLOCK):
            some = slice(start, start + BLOCK)
            new[some] = f[some] + 0.5 * (part.u[some] - new[some])
        return first, second, new, bounds

    def _clamps(self, part, first, new, bounds):
        """Points where the clamp acts: which, the share of the value that stays, samples and shares of the bounds."""
        some = np.flatnonzero((new <= bounds[0]) | (new >= bounds[1]))
        (low, high), value = bounds[:, some], new[some]
        below, above = _step(low, value), _step(value, high)
        points, (displacement, scale) = part.component.points, first.places
        index, least, greatest = departure.bound_shares(points, first.samples, displacement, scale, some)
        return some, 1.0 - below - above, index, least * below + greatest * above

    def advect(self, part, out):
        """See the base class."""
        *_, new, bounds = self._stages(part)
        np.clip(new, *(bounds if self.clamped else (-np.inf, np.inf)), out=out)

    def advect_vjp(self, part, g, into, speeds):
        """See the base class."""
        (first, second, new, bounds), clamped = self._stages(part), None
        own, of_f = part.room(g.size), part.room(g.size)
        of_inflow = into[1] if into else part.inflow.copy()
        own[:] = g
        if self.clamped:
            some, free, index, shares = self._clamps(part, first, new, bounds)
            own[some] *= free
            clamped = index, shares * g[some]
        of_b = np.multiply(-0.5, own, out=new)
        second.vjp(of_b, (of_f, of_inflow), speeds[1])
        of_f += own
        first.vjp(of_f, into, speeds[0], clamped)
        if into is not None:
            np.subtract(into[0], of_b, out=into[0])

    def advect_jvp(self, part, du, dinflow, dm):
        """See the base class."""
        first, second, new, bounds = self._stages(part)
        df = first.jvp(du, dinflow, dm[0])
        total = df + 0.5 * (du - second.jvp(df, dinflow, dm[1]))
        if self.clamped:
            some, free, index, shares = self._clamps(part, first, new, bounds)
            total[some] = free * total[some] + np.sum(shares * part.component.pad(du, dinflow)[index], axis=0)
        return total


def _step(a, b):
    """1, 1/2, 0 where a > b, a = b, a < b."""
    return 0.5 * (a > b) + 0.5 * (a >= b)
