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

    def _stages(self, component, u, inflow, trajectories, room):
        """Samples of u and of f, the value before it is clamped, least and greatest sample of u (if they count)."""
        n, (back, ahead) = u.size, trajectories
        first = component.pad(u, inflow, room)
        bounds = room(2 * n).reshape(2, n) if self.clamped else departure.NO_BOUNDS
        f = component.gather(first, back, room(n), bounds)
        second = component.pad(f, inflow, room)
        new = component.gather(second, ahead, room(n))
        for start in range(0, n, BLOCK):
            part = slice(start, start + BLOCK)
            new[part] = f[part] + 0.5 * (u[part] - new[part])
        return first, second, new, bounds

    def _clamps(self, component, first, back, new, bounds):
        """Points where the clamp acts: which, the share of the value that stays, samples and shares of the bounds."""
        some = np.flatnonzero((new <= bounds[0]) | (new >= bounds[1]))
        (low, high), value = bounds[:, some], new[some]
        below, above = _step(low, value), _step(value, high)
        index, least, greatest = departure.bound_shares(component.points, first, back.displacement, back.scale, some)
        return some, 1.0 - below - above, index, least * below + greatest * above

    def advect(self, component, u, inflow, trajectories, room, out):
        """See the base class."""
        *_, new, bounds = self._stages(component, u, inflow, trajectories, room)
        np.clip(new, *(bounds if self.clamped else (-np.inf, np.inf)), out=out)

    def advect_vjp(self, component, g, u, inflow, trajectories, room, into, speeds):
        """See the base class."""
        back, ahead = trajectories
        first, second, new, bounds = self._stages(component, u, inflow, trajectories, room)
        own, of_f, of_first, (of_u, of_inflow) = room(u.size), room(u.size), None, into or (None, inflow.copy())
        own[:] = g
        if self.clamped:
            some, free, index, shares = self._clamps(component, first, back, new, bounds)
            own[some] *= free
            of_first = room(first.size)
            of_first[:] = 0.0
            np.add.at(of_first, index, shares * g[some])
        of_b = np.multiply(-0.5, own, out=new)
        component.pad_vjp(component.gather_vjp(of_b, ahead, room), of_f, of_inflow)
        of_f += own
        if into is not None:
            component.pad_vjp(component.gather_vjp(of_f, back, room, of_first), of_u, of_inflow)
            of_u -= of_b
        if speeds is not None:
            component.gradient(first, back, of_f, speeds[0])
            component.gradient(second, ahead, of_b, speeds[1])

    def advect_jvp(self, component, u, inflow, trajectories, du, dinflow, dm):
        """See the base class."""
        first, second, new, bounds = self._stages(component, u, inflow, trajectories, np.empty)
        change = component.pad(du, dinflow)
        df = component.jvp(first, change, trajectories[0], dm[0])
        total = df + 0.5 * (du - component.jvp(second, component.pad(df, dinflow), trajectories[1], dm[1]))
        if self.clamped:
            some, free, index, shares = self._clamps(component, first, trajectories[0], new, bounds)
            total[some] = free * total[some] + np.sum(shares * change[index], axis=0)
        return total


def _step(a, b):
    """1, 1/2, 0 where a > b, a = b, a < b."""
    return 0.5 * (a > b) + 0.5 * (a >= b)
