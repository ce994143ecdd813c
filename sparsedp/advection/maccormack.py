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

NONE = np.empty(0)
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
        """Samples of u and of f, the value before it is clamped, `extrema` of u or None."""
        n, (back, ahead) = u.size, trajectories
        first = component.pad(u, inflow, room)
        f = component.gather(first, back, room(n))
        second = component.pad(f, inflow, room)
        new = component.gather(second, ahead, room(n))
        for part in _blocks(n):
            new[part] = f[part] + 0.5 * (u[part] - new[part])
        bounds = (room(n), room(n), room(n)) if self.clamped else None
        if bounds:
            departure.extrema(component.points, first, back.displacement, back.scale, *bounds)
        return first, second, new, bounds

    def advect(self, component, u, inflow, trajectories, room, out):
        """See the base class."""
        *_, new, bounds = self._stages(component, u, inflow, trajectories, room)
        if bounds:
            np.clip(new, *bounds[:2], out=out)
        else:
            out[:] = new

    def advect_vjp(self, component, g, u, inflow, trajectories, room, into, speeds):
        """See the base class."""
        n, points, (back, ahead) = u.size, component.points, trajectories
        first, second, new, bounds = self._stages(component, u, inflow, trajectories, room)
        own, of_f, of_first, (of_u, of_inflow) = room(n), room(n), room(points.samples), into or (NONE, inflow.copy())
        of_b = new  # which is used up
        of_first[:] = 0.0
        for part in _blocks(n):
            free = 1.0
            if bounds:
                low, high, stencils = (array[part] for array in bounds)
                below, above = _step(low, new[part]), _step(new[part], high)
                free = 1.0 - below - above
                some = np.flatnonzero(free != 1.0)
                index, least, greatest = departure.bound_shares(points, first, stencils[some])
                of_bound = least * below[some] + greatest * above[some]
                np.add.at(of_first, index, of_bound * g[part][some])
            own[part] = free * g[part]
            of_b[part] = -0.5 * own[part]
        component.pad_vjp(component.scatter(of_b, ahead, room), of_f, of_inflow)
        of_f += own
        if into is not None:
            component.pad_vjp(component.scatter(of_f, back, out=of_first), of_u, of_inflow)
            for part in _blocks(n):
                of_u[part] += 0.5 * own[part]
        if speeds is not None:
            component.gradient(first, back, of_f, speeds[0])
            component.gradient(second, ahead, of_b, speeds[1])

    def advect_jvp(self, component, u, inflow, trajectories, du, dinflow, dm):
        """See the base class."""
        first, second, new, bounds = self._stages(component, u, inflow, trajectories, np.empty)
        change = component.pad(du, dinflow)
        df = component.jvp(first, change, trajectories[0], dm[0])
        db = component.jvp(second, component.pad(df, dinflow), trajectories[1], dm[1])
        total = df + 0.5 * (du - db)
        if bounds is not None:
            below, above = _step(bounds[0], new), _step(new, bounds[1])
            index, least, greatest = departure.bound_shares(component.points, first, bounds[2])
            total *= 1.0 - below - above
            total += np.sum((least * below + greatest * above) * change[index], axis=0)
        return total


def _step(a, b):
    """1, 1/2, 0 where a > b, a = b, a < b."""
    return 0.5 * (a > b) + 0.5 * (a >= b)


def _blocks(n):
    return [slice(start, start + BLOCK) for start in range(0, n, BLOCK)]
