"""The schemes that look at the sides of cells: donor cell, van Leer and others of `sparsedp.kernels.fluxes.SCHEMES`.

Donor cell, first order: the value at a side is that of the cell it comes from.
Van Leer, second order where the field is smooth: with A and B the differences of u to the point below and above, of the
same sign, q = A / (A + B), widths h, distances d, c = 2 d_below / h and e = 2 d_above / h, the value at a side differs
from that at its point by

    s = (A + B) R(q),   R = q (1 - q) (q e^2 + (1 - q) c^2) / (q^2 e^2 + (c + e - 2) c e q (1 - q) + (1 - q)^2 c^2)

(equal cells: A B / (A + B), the harmonic mean), and s = 0 where A and B differ in sign. A step is the mean of the field
and of what two steps of Euler make of it. The sum of the Courant numbers of all sides of a point must not exceed 1/2:
then no new extrema appear (TVD in 1-D). Where one of A, B is 0 the derivative is the mean of both sides, as it is at
rest; where both are 0 it is 0.

Sources: R. Courant, E. Isaacson, M. Rees, Comm. Pure Appl. Math. 5 (1952) 243-255. B. van Leer, J. Comput. Phys. 32
(1979) 101-136; stretched grids: A. Mignone, J. Comput. Phys. 270 (2014) 784-814; stages: S. Gottlieb, C.-W. Shu, Math.
Comp. 67 (1998) 73-85.
"""

from functools import cached_property
from math import isfinite

import numpy as np

from sparsedp._utils import buffers
from sparsedp._utils.validation import check_finite
from sparsedp.advection.law import FIELD, INFLOW, VELOCITY, Law
from sparsedp.advection.loops import Loops, able
from sparsedp.advection.reference import Reference
from sparsedp.advection.stability import check_numbers, check_weights
from sparsedp.advection.values import NOTHING
from sparsedp.autodiff.tape import isbox
from sparsedp.kernels.fluxes import SCHEMES

__all__ = ["Eulerian"]


class Eulerian(Law):
    """See the head of the file: compiled loops, and `Reference` where they do not work or a value is traced."""

    def __init__(self, setting):
        super().__init__(setting)
        self.scheme = SCHEMES[setting.scheme]
        self.reference = Reference(self)
        self.linear = self.twice = self.scheme.limiter is None
        self.adds = self.between is None and able()

    @cached_property
    def loops(self):
        return Loops(self.reference)

    def forward(self, u, v, dt, inflow):
        out, wrong = u, 0.0
        if able():
            w = self.velocity(v)
            for keep in self.scheme.stages:
                x, out = out, buffers.empty(u.shape, float)
                wrong += self.loops.stage(x, self.loops.slopes(x, inflow, False), w, dt, inflow, u, keep, out)
        else:
            with np.errstate(all="ignore"):
                out, wrong = self.reference.step(u, v, dt, inflow), True
        if wrong or not isfinite(self._unseen(v, inflow)):
            self._check(u, v, dt, inflow, out)
        return out

    def _check(self, u, v, dt, inflow, out):
        """Name what a step has found wrong, and what it has not met."""
        check_numbers(self.setting, u, v, inflow)
        check_weights(self.setting, dt, self.reference.rate(v), self.scheme.most)
        check_finite(self.name, out.reshape(self.setting.space.shape), "cannot represent the result")

    def _unseen(self, v, inflow):
        """Sum over what a step may leave out: inflow values at closed walls, velocities inside solids."""
        unseen = inflow.sum() if inflow.size else 0.0
        return unseen if self.setting.solid is None else unseen + v.sum()

    def vjp(self, nums, g, u, v, dt, inflow, into=None):
        if not able() or any(map(isbox, (g, u, v, dt, inflow))):
            return self.reference.vjp(nums, g, u, v, dt, inflow), False
        w, field = self.velocity(v), FIELD in nums or INFLOW in nums
        gw, fresh = NOTHING if VELOCITY not in nums else into, into is None
        if gw is None:
            gw = buffers.empty(w.shape, float)
        of_field, of_inflow, wrong = self._stages_vjp(np.ascontiguousarray(g), u, w, dt, inflow, gw, field, fresh)
        found = {FIELD: of_field, INFLOW: of_inflow, VELOCITY: self.velocity_vjp(gw) if gw.size else None}
        seen = self.adds and not (self.scheme.limiter and field) and isfinite(of_inflow.sum())
        return tuple(found[num] for num in nums), seen and not wrong

    def _stages_vjp(self, g, u, w, dt, inflow, gw, field, fresh):
        """Cotangents of u (field: where it is wanted) and inflow; that of w goes into gw (fresh: nothing is there).

        Also how many of w in the end, and of u in each stage, are not finite.
        """
        known: list = []
        for keep in self.scheme.stages:
            x = u
            if known:
                x = buffers.empty(u.shape, float)
                self.loops.stage(*known[-1][:2], w, dt, inflow, u, known[-1][2], x)
            known.append((x, self.loops.slopes(x, inflow, True), keep))
        ginflow, rest = np.zeros(inflow.size), None
        while known:
            x, slopes, keep = known.pop()
            if keep:  # a share of the cotangent goes to the first field
                rest, g = (keep * g if rest is None else rest + keep * g), (1.0 - keep) * g
            gu = buffers.empty(u.shape, float) if known or field else NOTHING
            wrong = self.loops.vjp(g, x, slopes, w, dt, inflow, gu, ginflow, gw, fresh)
            g, fresh = gu, False
        if rest is not None and field:
            g += rest
        return g, ginflow, wrong

    def jvp(self, tangents, u, v, dt, inflow):
        return self.reference.jvp(tangents, u, v, dt, inflow)

    def matrix(self, v, dt):
        nothing = np.zeros(self.setting.space.size), v, np.zeros(self.walls.size)
        check_numbers(self.setting, *nothing)
        check_weights(self.setting, dt, self.reference.rate(v), self.scheme.most)
        return self.reference.matrix(v, dt)
