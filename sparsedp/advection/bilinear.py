"""The bilinear law of `lattice` with its derivatives, by sparse matrices: the reference of the fused loops.

With p = max(w, 0), m = min(w, 0), w = S v, z = (u, inflow), and H = 1, 1/2, 0 for w > 0, = 0, < 0,

    u'       = u - dt [ C+ (p * A+ z) + C- (m * A- z) ]
    l+-      = -dt C+-^T g
    g_z      = (g, 0) + A+^T (p * l+) + A-^T (m * l-)
    g_v      = S^T [ H * l+ * A+ z + (1 - H) * l- * A- z ]
    g_dt     = -g . [ C+ (p * A+ z) + C- (m * A- z) ]
    tangent  = du - dt [ C+ (p * A+ dz + H dw * A+ z) + C- (m * A- dz + (1 - H) dw * A- z) ] - ddt [ ... ].

At w = 0 the derivative is the mean of both sides. Away from it H is constant, so derivatives of every
order follow from these formulas.
"""

from functools import cached_property

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp.advection.lattice import Matrices
from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY
from sparsedp.advection.velocities import interpolation
from sparsedp.tape import linear, plain

__all__ = ["Bilinear"]


class Bilinear:
    """The formulas in the head of this file, for plain and for traced arguments."""

    def __init__(self, setting, walls):
        self.setting, self.walls = setting, walls

    @cached_property
    def matrices(self):
        return Matrices(self.setting, self.walls)

    @cached_property
    def between(self):
        """S and its transpose, or None where v is used as it is given."""
        found = interpolation(self.setting)
        return None if found is None else (found, sp.csr_array(found.T))

    @cached_property
    def _maps(self):
        """A+, A-, C+, C-, S: each a pair of rules, the map and its transpose."""
        turned = zip(self.matrices.parts, self.matrices.turned, strict=True)
        maps = [linear("upwind", forward.__matmul__, back.__matmul__) for forward, back in turned]
        if self.between is None:
            return (*maps, (_same, _same))
        return (*maps, linear("upwind", self.between[0].__matmul__, self.between[1].__matmul__))

    def _given(self, u, v, inflow):
        """A+ z, A- z, p, m and H."""
        lower, upper, _, _, between = self._maps
        z, w = anp.concatenate([u, inflow]), between[0](v)
        positive = np.heaviside(plain(w), 0.5)
        return lower[0](z), upper[0](z), w * positive, w * (1 - positive), positive

    def rate(self, v):
        """What the weight 1 - dt * rate of each point is made of."""
        left, right = self.matrices.own
        w = self._maps[4][0](v)
        return left @ np.maximum(w, 0.0) + right @ np.minimum(w, 0.0)

    def _rate(self, below, above, p, m):
        left, right = self._maps[2:4]
        return left[0](p * below) + right[0](m * above)

    def pull(self, nums, g, u, v, dt, inflow):
        below, above, p, m, positive = self._given(u, v, inflow)
        lower, upper, left, right, between = self._maps
        found = {}
        if FIELD in nums or INFLOW in nums or VELOCITY in nums:
            first, second = left[1](g) * -dt, right[1](g) * -dt
        if FIELD in nums or INFLOW in nums:
            z = lower[1](p * first) + upper[1](m * second)
            found[FIELD], found[INFLOW] = g + z[: u.size], z[u.size :]
        if VELOCITY in nums:
            found[VELOCITY] = between[1](positive * first * below + (1 - positive) * second * above)
        if STEP in nums:
            found[STEP] = -anp.sum(g * self._rate(below, above, p, m))
        return tuple(found[num] for num in nums)

    def push(self, tangents, u, v, dt, inflow):
        below, above, p, m, positive = self._given(u, v, inflow)
        lower, upper, left, right, between = self._maps
        change, first, second = 0.0, None, None
        if FIELD in tangents or INFLOW in tangents:
            du, dq = tangents.get(FIELD, np.zeros(u.size)), tangents.get(INFLOW, np.zeros(inflow.size))
            dz = anp.concatenate([du, dq])
            change, first, second = du, p * lower[0](dz), m * upper[0](dz)
        if VELOCITY in tangents:
            dw = between[0](tangents[VELOCITY])
            by_v = positive * dw * below, (1 - positive) * dw * above
            first, second = by_v if first is None else (first + by_v[0], second + by_v[1])
        if first is not None:
            change = change - dt * (left[0](first) + right[0](second))
        if STEP in tangents:
            change = change - tangents[STEP] * self._rate(below, above, p, m)
        return change

    def matrix(self, v, dt):
        """I - dt [C+ diag(p) A+ + C- diag(m) A-] in the columns of u."""
        lower, upper, left, right = self.matrices.parts
        w, size = self._maps[4][0](v), self.setting.space.size
        p, m = (sp.diags_array(side(w, 0.0)) for side in (np.maximum, np.minimum))
        return sp.eye_array(size, format="csr") - dt * (left @ p @ lower + right @ m @ upper)[:, :size]


def _same(x):
    return x
