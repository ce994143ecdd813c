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

import numpy as np

from sparsedp.advection.eulerian import Eulerian
from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY
from sparsedp.advection.reconstruction import Reconstruction
from sparsedp.kernels.limited import FIRST, JUMPS, PULL, PULL_ADDED, SECOND, SLOPES

__all__ = ["VanLeer"]


class VanLeer(Eulerian):
    """See the head of the file."""

    limited = True

    @cached_property
    def _faces(self):
        return Reconstruction(self.setting, self.walls)

    def _arrays(self, u, v, inflow):
        return {"u": u, "w": self._needed(v), "inflow": inflow, "slope": np.empty(self._slopes)}

    @cached_property
    def _slopes(self):
        return self.setting.space.size * self.setting.grid.dim

    def _first(self, arrays, dt):
        """The field after the first stage, and what is wrong."""
        self._loops.run(SLOPES, dt, arrays)
        arrays["out"] = np.empty(arrays["u"].size)
        return arrays["out"], self._loops.run(FIRST, dt, arrays)[0]

    def forward(self, u, v, dt, inflow, out=None):
        arrays = self._arrays(u, v, inflow)
        first, wrong = self._first(arrays, dt)
        arrays.update(u=first, u0=u, out=np.empty(u.size) if out is None else out)
        self._loops.run(SLOPES, dt, arrays)
        wrong += self._loops.run(SECOND, dt, arrays)[0]
        self._check(wrong, u, v, dt, inflow, arrays["out"], share=0.5)
        return arrays["out"]

    def pull(self, nums, g, u, v, dt, inflow, into=None):
        kept, half = (into or {}).get(VELOCITY), 0.5 * g
        arrays = self._arrays(u, v, inflow)
        first, _ = self._first(arrays, dt)
        added = self.bilinear.between is None and kept is not None
        arrays["gw"] = kept if added else np.empty(arrays["w"].size)
        arrays.update(u=first, g=half, a=np.empty(self._slopes), b=np.empty(self._slopes))
        self._loops.run(SLOPES, dt, arrays)
        of_first, of_inflow, by_second = self._pull_stage(PULL_ADDED if added else PULL, dt, arrays)
        arrays.update(u=u, g=of_first)
        self._loops.run(SLOPES, dt, arrays)
        of_u, more, by_first = self._pull_stage(PULL_ADDED, dt, arrays)
        found = {FIELD: of_u + half, INFLOW: of_inflow + more, STEP: (by_first + by_second) / dt}
        if VELOCITY in nums:
            found[VELOCITY] = self._of_velocity(arrays["gw"], kept, added)
        return tuple(found[num] for num in nums)

    def _pull_stage(self, task, dt, arrays):
        """Cotangent g of u + dt L(u) -> those of u and the inflow, and g . dt L(u); that of w goes to gw."""
        arrays.update(out=np.empty(arrays["u"].size), ginflow=np.empty(arrays["inflow"].size))
        total = self._loops.run(task, dt, arrays)[0]
        self._loops.run(JUMPS, dt, arrays)
        self._loops.return_inflow(arrays["out"], arrays["ginflow"])
        return arrays["out"], arrays["ginflow"], total

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
