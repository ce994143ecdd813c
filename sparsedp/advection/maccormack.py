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

    forms = ("unclamped midpoint", "clamped midpoint", "unclamped", "clamped")
    linear = False
    signs = (1, -1)

    def __init__(self, setting):
        super().__init__(setting)
        self.clamped = setting.form.startswith("clamped")

    def _stages(self, component, u, inflow, trajectories, room):
        """Samples of u and of f, the value before it is clamped, least and greatest sample (None: not clamped)."""
        n, (back, ahead) = u.size, trajectories
        first = component.pad(u, inflow, room)
        f = component.gather(first, back, room(n))
        second = component.pad(f, inflow, room)
        new = component.gather(second, ahead, room(n))
        for part in _blocks(n):
            new[part] = f[part] + 0.5 * (u[part] - new[part])
        bounds = (room(n), room(n)) if self.clamped else None
        if bounds:
            departure.extrema(component.points, first, back.departures, *bounds)
        return first, second, new, bounds

    def advect(self, component, u, inflow, trajectories, room, out):
        """See the base class."""
        *_, new, bounds = self._stages(component, u, inflow, trajectories, room)
        if bounds:
            np.clip(new, *bounds, out=out)
        else:
            out[:] = new

    def advect_vjp(self, component, g, u, inflow, trajectories, room, into, wanted):
        """See the base class."""
        n, (back, ahead) = u.size, trajectories
        first, second, of_b, bounds = self._stages(component, u, inflow, trajectories, room)
        own, of_f, (of_u, of_inflow) = room(n), room(n), into or (None, np.zeros(inflow.size))
        for part in _blocks(n):
            share = 1.0
            if bounds:  # they become the cotangents of the bounds
                low, high, new = bounds[0][part], bounds[1][part], of_b[part]
                at_low, at_high = np.heaviside(low - new, 0.5), np.heaviside(new - high, 0.5)
                low[:], high[:], share = at_low * g[part], at_high * g[part], 1.0 - at_low - at_high
            own[part] = share * g[part]
            of_b[part] = -0.5 * own[part]
        component.pad_vjp(component.scatter(of_b, ahead, room), of_f, of_inflow)
        of_f += own
        if into is not None:
            of_first = component.scatter(of_f, back, room)
            for pick, of_bound in zip((np.min, np.max), bounds or (), strict=False):
                _add_at_bounds(component.points, first, back.departures[-1], pick, of_bound, of_first)
            component.pad_vjp(of_first, of_u, of_inflow)
            for part in _blocks(n):
                of_u[part] += 0.5 * own[part]
        if not wanted:
            return []
        return [component.gradient(first, back, of_f), component.gradient(second, ahead, of_b)]

    def advect_jvp(self, component, u, inflow, trajectories, du, dinflow, dm):
        """See the base class."""
        first, second, new, bounds = self._stages(component, u, inflow, trajectories, np.empty)
        change = component.pad(du, dinflow)
        df = component.jvp(first, change, trajectories[0], dm[0])
        db = component.jvp(second, component.pad(df, dinflow), trajectories[1], dm[1])
        total = df + 0.5 * (du - db)
        if bounds is None:
            return total
        low, high = (np.heaviside(sign * (bound - new), 0.5) for sign, bound in zip((1, -1), bounds, strict=True))
        total *= 1.0 - low - high
        for pick, share in ((np.min, low), (np.max, high)):
            samples, weights = departure.equal_shares(component.points, first, trajectories[0].departures[-1], pick)
            total += share * np.sum(weights * change[samples], axis=0)
        return total


def _blocks(n):
    return [slice(start, start + BLOCK) for start in range(0, n, BLOCK)]


def _add_at_bounds(points, samples, stencils, pick, of_bound, back):
    """Cotangent of the least (pick: np.min) or greatest sample of each cell -> added to back at those that equal it."""
    for part in _blocks(of_bound.size):
        some = np.flatnonzero(of_bound[part]) + part.start
        if some.size:
            index, weights = departure.equal_shares(points, samples, stencils[some], pick)
            np.add.at(back, index, weights * of_bound[some])
