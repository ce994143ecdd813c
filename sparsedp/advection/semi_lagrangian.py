"""Semi-Lagrangian transport: every point takes the value at its departure point.

With E the field with ghost cells, m the velocity with which point i looks back and s = dt / spacing,

    u'_i     = sum over k of W_ik E_k,     W_ik = product over the axes of weights at i - s m_i
    g_E      = W^T g,                      folded back onto u and inflow
    g_m      = -s g_i (gradient of the interpolant at i - s m_i),    g_dt = sum of g_m . m / dt
    tangent  = W dE + g_m(g = 1) . dm + (g_m(g = 1) . m) ddt / dt,

then on to the velocity as it is given, see `back_trajectory`. Linear weights have kinks at the points: there the
slope is the mean of both sides. Cubic ones are those of Catmull and Rom (cubic convolution, Keys 1981): order 3
a step, so order 2 and more at a fixed ratio of dt to spacing, exact for quadratics away from walls.
Source: A. Staniforth, J. Cote, Monthly Weather Review 119 (1991) 2206-2223;
R. Keys, IEEE Trans. Acoustics, Speech and Signal Processing 29 (1981) 1153-1160.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from sparsedp import results
from sparsedp.advection.back_trajectory import Euler, Midpoint
from sparsedp.advection.interpolant import Interpolant, Pass
from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY, Law
from sparsedp.advection.scratch import FEW, Scratch
from sparsedp.advection.stability import check_numbers
from sparsedp.advection.velocities import velocity_at_points
from sparsedp.fields import surely_finite
from sparsedp.operators.boundary import solid_faces

__all__ = ["Part", "SemiLagrangian"]


class Part(NamedTuple):
    """One component in a step."""

    number: int
    component: Interpolant
    u: Any
    inflow: Any
    w: Any  # velocity at the points (axis, point)
    trajectories: list  # one for each sign of the scheme
    room: Any  # size -> array

    def look(self, number=0, u=None):
        """The pass along a trajectory, of u itself or of another field."""
        u = self.u if u is None else u
        return Pass(self.component, self.trajectories[number], u, self.inflow, self.room)


class SemiLagrangian(Law):
    """See the head of the file."""

    options: tuple[str, ...] = ("interpolation", "backtrace")
    linear = True
    signs: tuple[int, ...] = (1,)  # of the steps along which points look: backwards in time

    def __init__(self, setting):
        super().__init__(setting)
        numbers, solid = range(len(setting.space.parts)), setting.solid
        self.components = [Interpolant(setting, number, setting.interpolation) for number in numbers]
        self.backtrace = Midpoint(setting) if setting.backtrace == "midpoint" else Euler()
        self.to_points, self.scratch = velocity_at_points(setting), Scratch()
        self.solid = None  # points that keep their value
        if solid is not None:
            self.solid = solid.ravel() if setting.of == "cells" else np.logical_or(*solid_faces(setting.grid, solid))

    # ------------------------------------------------------------ one component, which `maccormack` does in its own way

    def advect(self, part, out):
        """The advected component -> out."""
        part.look().value(out)

    def advect_vjp(self, part, g, into, speeds):
        """Cotangent of the advected component -> that of u is written, that of inflow added to the pair `into`.

        Those of the velocities of the trajectories are written to the arrays `speeds`; None leaves a part out.
        """
        part.look().vjp(g, into, speeds[0])

    def advect_jvp(self, part, du, dinflow, dm):
        """Tangents of u, of inflow and of the velocity of each trajectory (or None) -> tangent."""
        return part.look().jvp(du, dinflow, dm[0])

    # ------------------------------------------------------------ the whole field

    def _room(self, u):
        """A function from sizes to arrays, and the list of those to give back to the scratch arrays afterwards."""
        borrowed: list = []
        return (np.empty if u.size <= FEW else self.scratch.lender(borrowed)), borrowed

    def _velocities(self, v):
        """Velocity as it is given -> for each component an array (axis, point)."""
        return self._by_component(v if self.to_points is None else self.to_points.apply(v))

    def _by_component(self, v):
        dim = self.setting.grid.dim
        return [v[dim * c.span.start : dim * c.span.stop].reshape(dim, -1) for c in self.components]

    def _parts(self, u, v, dt, inflow, room=np.empty):
        """The components of a step, one after the other."""
        for number, (component, w) in enumerate(zip(self.components, self._velocities(v), strict=True)):
            steps = [dt * sign for sign in self.signs]
            looks = [component.trajectory(self.backtrace.velocity(number, w, step), step) for step in steps]
            yield Part(number, component, u[component.span], inflow, w, looks, room)

    def _keep_solid(self, moved, u):
        """What is in a solid stays: written to the moved field."""
        if self.solid is not None:
            np.copyto(moved, u, where=self.solid)
        return moved

    def _check(self, u, v, inflow):
        """Name the first number that is not finite; the trajectories would hide it."""
        if not all(map(surely_finite, (u, v, inflow))):
            check_numbers(self.setting, u, v, inflow)

    def forward(self, u, v, dt, inflow):
        """The advected field."""
        self._check(u, v, inflow)
        out, (room, borrowed) = results.empty(u.shape, float), self._room(u)
        for part in self._parts(u, v, dt, inflow, room):
            self.advect(part, out[part.component.span])
        self.scratch.give(*borrowed)
        return self._keep_solid(out, u)

    def pull(self, nums, g, u, v, dt, inflow):
        """Cotangent of the advected field -> those of the arguments `nums`."""
        field, speed = FIELD in nums or INFLOW in nums, VELOCITY in nums or STEP in nums
        (room, borrowed), g, rate = self._room(u), np.ascontiguousarray(g), 0.0
        moved = g if self.solid is None else np.where(self.solid, 0.0, g)
        of_u, of_inflow = np.empty(u.size if field else 0), np.zeros(inflow.size)
        of_w = (np.empty if self.to_points is None else room)(u.size * self.setting.grid.dim if speed else 0)
        for part, change in zip(self._parts(u, v, dt, inflow, room), self._by_component(of_w), strict=True):
            span, changes = part.component.span, [None] * len(self.signs)
            if speed:
                changes = [change, *(room(change.size).reshape(change.shape) for _ in self.signs[1:])]
            self.advect_vjp(part, moved[span], (of_u[span], of_inflow) if field else None, changes)
            rate += self._of_velocity(part, changes, STEP in nums) if speed else 0.0
        if field and self.solid is not None:
            of_u += g - moved
        found = {FIELD: of_u, INFLOW: of_inflow, STEP: rate / dt}
        if VELOCITY in nums:
            found[VELOCITY] = of_w if self.to_points is None else self.to_points.T.apply(of_w)
        self.scratch.give(*borrowed)
        return tuple(found[num] for num in nums)

    def _of_velocity(self, part, changes, timed):
        """Cotangents of the velocities of the trajectories -> that of w, in the first of them; dt times that of dt."""
        rate = 0.0
        for change, trajectory in zip(changes, part.trajectories, strict=True):
            rate += _dot(change, trajectory.velocity) if timed else 0.0
            back, bent = self.backtrace.vjp(part.number, part.w, trajectory.step, change)
            rate += _dot(bent, part.w) if timed and bent is not None else 0.0
            if change is not changes[0]:
                changes[0] += back
            elif back is not change:
                change[:] = back
        return rate

    def push(self, tangents, u, v, dt, inflow):
        """{argument: tangent} -> tangent of the advected field."""
        zeros = {FIELD: np.zeros(u.size), VELOCITY: np.zeros(v.size), STEP: 0.0, INFLOW: np.zeros(inflow.size)}
        given = {num: np.ascontiguousarray(t) if num != STEP else t for num, t in tangents.items()}
        du, dv, ddt, dinflow = (given.get(num, zero) for num, zero in zeros.items())
        moves, out = VELOCITY in tangents or STEP in tangents, np.empty(u.size)
        for part, dw in zip(self._parts(u, v, dt, inflow), self._velocities(dv), strict=True):
            span, vary = part.component.span, self.backtrace.jvp
            dm = [vary(part.number, part.w, t, dw, ddt / dt) if moves else None for t in part.trajectories]
            out[span] = self.advect_jvp(part, du[span], dinflow, dm)
        return self._keep_solid(out, du)

    def matrix(self, v, dt):
        """The step as a csr_array in u."""
        nothing = np.zeros(self.setting.space.size), v, dt, np.zeros(self.walls.size)
        blocks = [part.component.matrix(*part.trajectories) for part in self._parts(*nothing)]
        moved = sp.csr_array(sp.block_diag(blocks, format="csr"))
        if self.solid is None:
            return moved
        return sp.csr_array(sp.diags_array(1.0 * ~self.solid) @ moved + sp.diags_array(1.0 * self.solid))


def _dot(a, b):
    with np.errstate(over="ignore", invalid="ignore"):  # the rule refuses what is not finite
        return float(np.einsum("ij,ij", a, b))
