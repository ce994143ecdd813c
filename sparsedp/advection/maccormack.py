"""MacCormack transport: a semi-Lagrangian step, one back again, and half of what that misses added.

With f = W u (looking back along the velocity) and b = V f (looking ahead along it),

    u' = f + (u - b) / 2,     clamped to the least and greatest sample of the cell the content comes from.

    g_f = c g - V^T (c g) / 2,    g_u = c g / 2 + W^T g_f + (cotangents of the bounds),    c = 1 where not clamped.

Clamped values pass their cotangent on to the samples that equal the bound, in equal parts. Where the
value equals a bound the derivative is the mean of both sides: c = 1/2 and half goes to the bound.
Second order in space and time for smooth data; clamping lowers that at extrema.
Source: A. Selle, R. Fedkiw, B. Kim, Y. Liu, J. Rossignac, J. Scientific Computing 35 (2008) 350-371.
"""

import numpy as np

from sparsedp.advection.ruler import three
from sparsedp.advection.semi_lagrangian import SemiLagrangian
from sparsedp.kernels import sampling

__all__ = ["MacCormack"]


class MacCormack(SemiLagrangian):
    """See the head of the file."""

    forms = ("unclamped midpoint", "clamped midpoint", "unclamped", "clamped")
    linear = False
    ways = (1, -1)

    def __init__(self, setting):
        super().__init__(setting)
        self.clamped = setting.form.startswith("clamped")

    def _both(self, number, u, outside, looks):
        """Samples of u, those of f, f, and the value before it is clamped."""
        first = self.samples(number, u, outside)
        f = self.value(number, first, looks[0])
        second = self.samples(number, f, outside)
        return first, second, f + 0.5 * (u - self.value(number, second, looks[1]))

    def carry(self, number, u, outside, looks, out):
        """See the base class."""
        if not all(map(sampling.finite, (u, outside, *looks[0][0]))):
            return False
        first, _, new = self._both(number, u, outside, looks)
        if self.clamped:
            low, high = sampling.extrema(self.points[number], first, *looks[0])
            np.minimum(np.maximum(new, low, out=new), high, out=out)
        else:
            out[...] = new
        return True

    def _bounds(self, number, first, new, look):
        """Share that is not clamped, and pairs (bound, share that comes from it)."""
        if not self.clamped:
            return np.ones(new.size), ()
        low, high = sampling.extrema(self.points[number], first, *look)
        at_low, at_high = np.heaviside(low - new, 0.5), np.heaviside(new - high, 0.5)
        return 1.0 - at_low - at_high, ((low, at_low), (high, at_high))

    def carry_back(self, number, g, u, outside, looks, into, wanted):
        """See the base class."""
        points, first, inside = self.points[number], self.samples(number, u, outside), wanted and not self.stretched
        f, *bounds = (
            sampling.sides(points, first, *looks[0]) if self.clamped else (self.value(number, first, looks[0]),)
        )
        second, steep = self.samples(number, f, outside), self._room(g.size if inside else 0)
        own, back, rate = sampling.miss(points, second, looks[1], f, u, g, bounds, three(steep[1]))
        of_f, outer = own.copy(), np.zeros(outside.size) if into is None else into[1]
        self.fold(number, back, of_f, outer)
        if into is not None or inside:
            fresh = steep[0] is not steep[1]
            back, more = sampling.way_back(points, first, looks[0], of_f, bounds, three(steep[0]), fresh)
            rate += more
        if into is not None:
            self.fold(number, back, *into)
            np.add(into[0], 0.5 * own, out=into[0])
        if not wanted or inside:
            return steep[: 1 + fresh] if inside else (), rate
        own *= -0.5
        steep = self.steepness(number, first, looks[0], of_f), self.steepness(number, second, looks[1], own)
        return steep, sum(float(np.sum(change * look.speeds)) for change, look in zip(steep, looks, strict=True))

    def _room(self, size):
        """Arrays for the cotangents of the velocities of both looks; the same one where these are the same."""
        first = np.empty((self.setting.grid.dim, size))
        return first, np.empty_like(first) if self.bent else first

    def carry_tangent(self, number, u, outside, looks, changes, speeds):
        """See the base class."""
        first, second, new = self._both(number, u, outside, looks)
        free, bounds = self._bounds(number, first, new, looks[0])
        du, doutside = changes or (np.zeros(u.size), np.zeros(outside.size))
        moved = self.samples(number, du, doutside)
        df = self._moved(number, first, moved, looks[0], speeds and speeds[0])
        db = self._moved(number, second, self.samples(number, df, doutside), looks[1], speeds and speeds[1])
        total = free * (df + 0.5 * (du - db))
        for bound, share in bounds:
            total += share * sampling.mean_of_equal(self.points[number], first, bound, moved, *looks[0])
        return total

    def _moved(self, number, samples, changes, look, speed):
        """Tangent of one look."""
        total = self.value(number, changes, look)
        if speed is not None:
            total = total + np.sum(self.steepness(number, samples, look, np.ones(total.size)) * speed, axis=0)
        return total
