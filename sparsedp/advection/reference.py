"""The Eulerian schemes by sparse matrices: what runs without numba, second derivatives, and the test of the loops.

All numbers stand on the lower or upper side of a point along an axis. With C the velocity times dt over the length
there, H = 1, 1/2, 0 for C > 0, = 0, < 0, and p = H C, m = (1 - H) C,

    u'     = (1 - sum of leaves) u + sum of enters
    leaves = p_lower - m_upper  [+ C_upper - C_lower in flux form]
    enters = p_lower (u_below + ahead_below) - m_upper (u_above - behind_above) - p_upper ahead - m_lower behind

over the axes; `ahead` and `behind` are what the limiter of a scheme of second order adds at the sides of a point. H and
the slopes of the limiter are constants to the tape: that is exact away from kinks, and the mean of both sides at rest.
A stage of a scheme with several is followed by a mean with the first field.
"""

from functools import cached_property

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.pytree import placed
from sparsedp.advection.control_volumes import components
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.autodiff.tape import isbox, linear, plain
from sparsedp.kernels.fluxes import OWN

__all__ = ["Reference"]


class Reference:
    """The formula in the head of this file, for plain and for traced flat arguments."""

    def __init__(self, law):
        self.setting, self.scheme, self.law = law.setting, law.scheme, law
        self.limited = self.scheme.limiter
        self.flux = 1.0 if self.setting.form == "flux" else 0.0

    @cached_property
    def components(self):
        return components(self.setting, self.limited)

    @cached_property
    def _sides(self):
        """For lower and upper sides (rows) of the points of all axes: where the points are, what is beyond the sides in
        (field, inflow), whose slope acts there, the velocity, 1 / length, the distances c and e."""
        found, rows = [], 0
        for part in self.components:
            for a in range(len(part.axes)):
                own, sides = np.arange(part.field.start, part.field.stop), part.sides(a)
                table = part.table[:, sides.column]
                is_open = part.free[2 * a : 2 * a + 2] if part.free.size else np.ones((2, own.size), bool)
                z = np.where(is_open, part.field.start + sides.beyond, own)
                z = np.where(is_open & (sides.wall >= 0), self.setting.space.size + part.inflow.start + sides.wall, z)
                slope = np.where(is_open & ~sides.at_wall, rows + sides.beyond, -1)
                w, weights = part.speed.start + sides.speed, is_open * table[OWN : OWN + 2]
                found.append((own[None], z, slope, w, weights, table[-2:]))
                rows += own.size
        return [np.concatenate(parts, 1) for parts in zip(*found, strict=True)]

    @cached_property
    def matrices(self):
        """From (field, inflow) to what is below and above, from the velocity to that over length, from points ..."""
        (own,), z, slope, w, weight, _ = self._sides
        size, rows = self.setting.space.size, own.size

        def pick(columns, many, values):
            keep = (columns >= 0) & (values != 0)
            at = np.flatnonzero(keep), columns[keep].astype(np.int32)
            return sp.csr_array((values[keep], at), (rows, many))

        ones, speeds = np.ones(rows), [pick(w[side], 1 + w.max(), weight[side]) for side in range(2)]
        return {
            "own": pick(own, size, ones),
            "z": [pick(side, size + self.law.walls.size, ones) for side in z],
            "slope": [pick(side, rows, ones) for side in slope],
            "speed": [x if self.law.between is None else sp.csr_array(x @ self.law.between.matrix) for x in speeds],
        }

    @cached_property
    def _maps(self):
        """The matrices as functions of plain and traced arrays; total: sums over what stands at the sides of points."""
        found = {name: [_applied(x) for x in pair] for name, pair in self.matrices.items() if name != "own"}
        own = self.matrices["own"]
        return {**found, "own": _applied(own), "total": _applied(sp.csr_array(own.T))}

    def _given(self, low, high):
        """p and m on the lower sides, then on the upper ones, and what leaves the points through both."""
        shares = [np.heaviside(plain(c), 0.5) for c in (low, high)]
        p, m = zip(*((c * share, c * (1.0 - share)) for c, share in zip((low, high), shares)))
        leaves = p[0] - m[1] + high - low if self.flux else p[0] - m[1]
        return p, m, leaves

    def _stage(self, u, low, high, inflow):
        maps, z = self._maps, anp.concatenate([u, inflow])
        (p_low, p_high), (m_low, m_high), leaves = self._given(low, high)
        below, above = (side(z) for side in maps["z"])
        enters = p_low * below - m_high * above
        if self.limited:
            own = maps["own"](u)
            ahead, behind = self._slopes(own - below, above - own)
            enters = enters + p_low * maps["slope"][0](ahead) + m_high * maps["slope"][1](behind)
            enters = enters - p_high * ahead - m_low * behind
        return (1.0 - maps["total"](leaves)) * u + maps["total"](enters)

    def _slopes(self, a, b):
        with np.errstate(all="ignore"):
            given = plain(a), plain(b)
            ahead, behind, *slopes = self.limited(*given, *self._sides[-1])
        if isbox(a) or isbox(b):
            da, db = a - given[0], b - given[1]
            ahead, behind = ahead + slopes[0] * da + slopes[1] * db, behind + slopes[2] * da + slopes[3] * db
        return ahead, behind

    def _courant(self, v, dt):
        """The velocity times dt over length, on lower and upper sides."""
        return [dt * side(v) for side in self._maps["speed"]]

    def step(self, u, v, dt, inflow):
        """The moved field."""
        (low, high), found = self._courant(v, dt), u
        for keep in self.scheme.stages:
            new = self._stage(found, low, high, inflow)
            found = keep * u + (1.0 - keep) * new if keep else new
        return found

    def vjp(self, nums, g, *args):
        """Cotangent of the moved field -> those of the arguments `nums`."""
        return pullback(lambda some: self.step(*placed(args, nums, some)), tuple(args[num] for num in nums))[1](g)

    def jvp(self, tangents, *args):
        """{number of an argument: tangent} -> tangent of the moved field."""
        given = tuple(args[num] for num in tangents)
        return pushforward(lambda some: self.step(*placed(args, tangents, some)), given, tuple(tangents.values()))[1]

    def rate(self, v):
        """What the weight 1 - dt * rate of each point is made of."""
        return self._maps["total"](self._given(*self._courant(v, 1.0))[2])

    def matrix(self, v, dt):
        """The step in the columns of u."""
        (p, _), (_, m), _ = self._given(*self._courant(v, dt))
        n, total = self.setting.space.size, self.matrices["own"].T
        below, above = (side[:, :n] for side in self.matrices["z"])
        enters = sp.diags_array(p) @ below - sp.diags_array(m) @ above
        return sp.csr_array(sp.diags_array(1.0 - dt * self.rate(v)) + total @ enters)


def _applied(matrix):
    rule = linear("transport", matrix.__matmul__, sp.csr_array(matrix.T).__matmul__)[0]
    return lambda x: rule(x) if isbox(x) else matrix @ x
