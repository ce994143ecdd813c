"""Van Leer transport: limited slopes in each cell and two stages, second order where the field is smooth.

With A and B the differences of u to the point below and above, of the same sign, q = A / (A + B), widths h,
distances d, c = 2 d_below / h and e = 2 d_above / h, the value at a face differs from that at its point by

    s = (A + B) R(q),   R = q (1 - q) (q e^2 + (1 - q) c^2) / (q^2 e^2 + (c + e - 2) c e q (1 - q) + (1 - q)^2 c^2)

(uniform: A B / (A + B), the harmonic mean), and s = 0 where A and B differ in sign. On interfaces, from below
x+ = u + s and from above x- = u - s. With the matrices of `lattice`, p = max(w, 0), m = min(w, 0),

    L(u) = -C (p * x+ + m * x-)  [+ u * C w in advective form],   u1 = u + dt L(u),   u' = (u + u1 + dt L(u1)) / 2.

The sum of the CFL numbers of all sides of a point must not exceed 1/2. Then no new extrema appear (TVD in 1-D).
ds/dA = R + (1 - q) R', ds/dB = R - q R'. Where one of A, B is 0 the derivative is the mean of both sides,
as it is at w = 0; where both are 0 it is 0.
Source: B. van Leer, J. Comput. Phys. 32 (1979) 101-136; stretched grids: A. Mignone, J. Comput. Phys. 270
(2014) 784-814; stages: S. Gottlieb, C.-W. Shu, Math. Comp. 67 (1998) 73-85.
"""

from functools import cached_property
from math import isfinite

import numpy as np

from sparsedp.advection.eulerian import Eulerian
from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY
from sparsedp.advection.reconstruction import Reconstruction
from sparsedp.advection.scratch import Scratch
from sparsedp.kernels.limited import FIRST, JUMPS, LAST, PULL, PULL_ADDED, SECOND, SLOPES, STEEP

__all__ = ["VanLeer"]


class VanLeer(Eulerian):
    """See the head of the file."""

    limited = True

    def __init__(self, setting):
        super().__init__(setting)
        self.scratch = Scratch()

    @cached_property
    def _faces(self):
        return Reconstruction(self.setting, self.walls)

    def _arrays(self, u, v, inflow):
        return {"u": u, "w": self._needed(v), "inflow": inflow, "slope": self.scratch.take(self._slopes)}

    @cached_property
    def _slopes(self):
        return self.setting.space.size * self.setting.grid.dim

    def _first(self, arrays, dt):
        """The field after the first stage, and what is wrong."""
        self._loops.run(SLOPES, dt, arrays)
        arrays["out"] = self.scratch.take(arrays["u"].size)
        return arrays["out"], self._loops.run(FIRST, dt, arrays)[0]

    def forward(self, u, v, dt, inflow, out=None):
        arrays = self._arrays(u, v, inflow)
        first, wrong = self._first(arrays, dt)
        arrays.update(u=first, u0=u, out=np.empty(u.size) if out is None else out)
        self._loops.run(SLOPES, dt, arrays)
        wrong += self._loops.run(SECOND, dt, arrays)[0]
        self.scratch.give(first, arrays["slope"])
        self._check(wrong, u, v, dt, inflow, arrays["out"], share=0.5)
        return arrays["out"]

    def pull(self, nums, g, u, v, dt, inflow, into=None):
        kept, g = (into or {}).get(VELOCITY), np.ascontiguousarray(g)
        arrays, take = self._arrays(u, v, inflow), self.scratch.take
        first, _ = self._first(arrays, dt)
        added = self.bilinear.between is None and kept is not None
        arrays["gw"] = kept if added else np.empty(arrays["w"].size)
        arrays.update(u=first, g=g, a=take(self._slopes), b=take(self._slopes), out=take(u.size))
        of_inflow, by_second, _ = self._pull_stage(PULL_ADDED if added else PULL, JUMPS, dt, arrays, g, 0.5)
        of_first = arrays["out"]
        arrays.update(u=u, g=of_first, out=np.empty(u.size))
        more, by_first, good = self._pull_stage(PULL_ADDED, LAST, dt, arrays, g)
        self.scratch.give(first, of_first, arrays["slope"], arrays["a"], arrays["b"])
        found = {FIELD: arrays["out"], INFLOW: of_inflow + more, STEP: (by_first + by_second) / dt}
        if VELOCITY in nums:
            found[VELOCITY] = self._of_velocity(arrays["gw"], kept, added)
        return self._cotangents(nums, found, good and isfinite(found[INFLOW].sum()))

    def _pull_stage(self, task, jumps, dt, arrays, g, share=1.0):
        """Cotangent of u + dt L(u) -> that of u to out, of w to gw; that of the inflow, g . dt L(u), whether finite.

        A share of the cotangent is asked for by a share of dt, and what is too much of g itself taken away by `jumps`.
        """
        arrays["ginflow"] = np.empty(arrays["inflow"].size)
        self._loops.run(STEEP, dt, arrays)
        total, spoiled = self._loops.run(task, share * dt, arrays)
        arrays["g"] = g
        spoiled += self._loops.run(jumps, dt, arrays)[0]
        good = self._loops.return_inflow(arrays["out"], arrays["ginflow"])
        return arrays["ginflow"], total, good and spoiled == 0.0

    def _velocity(self, v):
        """w, p, m and the derivative of p."""
        w = self._needed(v)
        step = np.heaviside(w, 0.5)
        return w, w * step, w * (1 - step), step

    def _rate(self, u, velocity, inflow):
        """L(u)."""
        w, p, m, _ = velocity
        faces = self._faces
        below, above = faces.values(np.concatenate([u, inflow]))
        rate = -(faces.divide @ (p * below + m * above))
        return rate + u * (faces.divide @ (faces.opened * w)) if faces.advective else rate

    def push(self, tangents, u, v, dt, inflow):
        velocity, between = self._velocity(v), self.bilinear.between
        du, dq = tangents.get(FIELD, np.zeros(u.size)), tangents.get(INFLOW, np.zeros(inflow.size))
        dw = tangents.get(VELOCITY, np.zeros(v.size))
        dw = dw if between is None else between[0] @ dw
        ddt = tangents.get(STEP, 0.0)
        rate = self._rate(u, velocity, inflow)
        first = u + dt * rate
        dfirst = du + dt * self._push_rate(du, dw, dq, u, velocity, inflow) + ddt * rate
        second = self._push_rate(dfirst, dw, dq, first, velocity, inflow)
        return 0.5 * (du + dfirst + dt * second + ddt * self._rate(first, velocity, inflow))

    def _push_rate(self, du, dw, dq, u, velocity, inflow):
        w, p, m, step = velocity
        faces, z = self._faces, np.concatenate([u, inflow])
        below, above = faces.values(z)
        dbelow, dabove = faces.push(z, np.concatenate([du, dq]))
        flux = p * dbelow + m * dabove + dw * (step * below + (1 - step) * above)
        change = -(faces.divide @ flux)
        if faces.advective:
            change += du * (faces.divide @ (faces.opened * w)) + u * (faces.divide @ (faces.opened * dw))
        return change
