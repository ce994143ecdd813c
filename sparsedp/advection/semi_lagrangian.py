"""Semi-Lagrangian transport: every point takes the value at its departure point.

With E the field with ghost cells, m the velocity with which point i looks back and s = dt / spacing,

    u'_i     = sum over k of W_ik E_k,     W_ik = product over the axes of weights at i - s m_i
    g_E      = W^T g,                      folded back onto u and inflow
    g_m      = -s g_i (gradient of the interpolant at i - s m_i)
    tangent  = W dE + g_m(g = 1) . dm,

then on to the velocity v as it is given, see `departure_points`. A step depends on v dt alone: g_dt = g_v . v / dt, and
ddt counts as the tangent v ddt / dt of v. Linear weights have kinks at the points: there the
slope is the mean of both sides. Cubic ones are those of Catmull and Rom (cubic convolution, Keys 1981): order 3
a step, so order 2 and more at a fixed ratio of dt to spacing, exact for quadratics away from walls.
Source: A. Staniforth, J. Cote, Monthly Weather Review 119 (1991) 2206-2223;
R. Keys, IEEE Trans. Acoustics, Speech and Signal Processing 29 (1981) 1153-1160.
"""

from typing import Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils import buffers
from sparsedp._utils.validation import surely_finite
from sparsedp.advection.departure_points import Trajectory
from sparsedp.advection.interpolant import Interpolant, Pass
from sparsedp.advection.law import FIELD, INFLOW, VELOCITY, Law
from sparsedp.advection.stability import check_numbers

__all__ = ["SemiLagrangian"]


class SemiLagrangian(Law):
    """See the head of the file."""

    options: tuple[str, ...] = ("interpolation", "backtrace")
    linear = True
    signs: tuple[int, ...] = (1,)  # of the steps along which points look: backwards in time
    passage: Any = Pass  # made of the trajectories of a component, one for each sign, the component, inflow values

    def __init__(self, setting):
        super().__init__(setting)
        self.components = [Interpolant(setting, number) for number in range(len(setting.space.parts))]
        self.solid = setting.solid_points  # they keep their value

    def _velocities(self, v):
        """Velocity as it is given -> for each component an array (axis, point)."""
        return self._by_component(self.velocity(v))

    def _by_component(self, v):
        dim = self.setting.grid.dim
        return [v[dim * c.span.start : dim * c.span.stop].reshape(dim, -1) for c in self.components]

    def _passes(self, u, v, dt, inflow):
        """For each component where it stands in the field, and its pass to the departure points."""
        for component, w in zip(self.components, self._velocities(v), strict=True):
            trajectories = [Trajectory(component, w, dt * sign) for sign in self.signs]
            yield component.span, self.passage(*trajectories, u[component.span], inflow)

    def _keep_solid(self, moved, u):
        """What is in a solid stays: written to the moved field."""
        if self.solid is not None:
            np.copyto(moved, u, where=self.solid)
        return moved

    def forward(self, u, v, dt, inflow):
        """The advected field."""
        if not all(map(surely_finite, (u, v, inflow))):
            check_numbers(self.setting, u, v, inflow)  # names the first one; the trajectories would hide it
        out = buffers.empty(u.shape, float)
        for span, passage in self._passes(u, v, dt, inflow):
            passage.value(out[span])
        return self._keep_solid(out, u)

    def vjp(self, nums, g, u, v, dt, inflow):
        """Cotangent of the advected field -> those of the arguments `nums`."""
        field, speed, g = FIELD in nums or INFLOW in nums, VELOCITY in nums, np.ascontiguousarray(g)
        moved = g if self.solid is None else np.where(self.solid, 0.0, g)
        of_u, of_inflow = buffers.empty((u.size if field else 0,), float), np.zeros(inflow.size)
        of_w = buffers.empty((u.size * self.setting.grid.dim if speed else 0,), float)
        for (span, passage), change in zip(self._passes(u, v, dt, inflow), self._by_component(of_w), strict=True):
            passage.vjp(moved[span], (of_u[span], of_inflow) if field else None, change if speed else None)
        if field and self.solid is not None:
            of_u += g - moved
        found = {FIELD: of_u, INFLOW: of_inflow}
        if speed:
            found[VELOCITY] = self.velocity_vjp(of_w)
        return tuple(found[num] for num in nums), False

    def jvp(self, tangents, u, v, dt, inflow):
        """{argument: tangent} -> tangent of the advected field."""
        given = {FIELD: u, VELOCITY: v, INFLOW: inflow}
        du, dv, dinflow = (np.ascontiguousarray(tangents.get(num, np.zeros(x.size))) for num, x in given.items())
        out = np.empty(u.size)
        for (span, passage), dw in zip(self._passes(u, v, dt, inflow), self._velocities(dv), strict=True):
            out[span] = passage.jvp(du[span], dinflow, dw if VELOCITY in tangents else None)
        return self._keep_solid(out, du)

    def matrix(self, v, dt):
        """The step as a csr_array in u."""
        nothing = np.zeros(self.setting.space.size), v, dt, np.zeros(self.walls.size)
        moved = sp.csr_array(sp.block_diag([passage.matrix() for _, passage in self._passes(*nothing)], format="csr"))
        if self.solid is None:
            return moved
        return sp.csr_array(sp.diags_array(1.0 * ~self.solid) @ moved + sp.diags_array(1.0 * self.solid))
