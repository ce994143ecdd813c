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

import numpy as np
import scipy.sparse as sp

from sparsedp import results
from sparsedp.advection.back_trajectory import Euler, Midpoint, velocity_at_points
from sparsedp.advection.interpolant import components
from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY, Law
from sparsedp.advection.scratch import FEW, Scratch
from sparsedp.fields import check_finite, surely_finite

__all__ = ["SemiLagrangian"]


class SemiLagrangian(Law):
    """See the head of the file."""

    options: tuple[str, ...] = ("interpolation", "backtrace")
    linear = True
    signs: tuple[int, ...] = (1,)  # of the steps along which points look: backwards in time

    def __init__(self, setting):
        super().__init__(setting)
        self.components = components(setting)
        self.backtrace = Midpoint(setting) if setting.backtrace == "midpoint" else Euler()
        self.to_points = velocity_at_points(setting)
        self.scratch, dim, ends = Scratch(), setting.grid.dim, [setting.grid.dim * n for n in setting.space.offsets]
        self.parts = [(slice(*pair), (dim, -1)) for pair in zip(ends, ends[1:], strict=False)]  # of the velocity

    # ------------------------------------------------------------ one component, which `maccormack` does in its own way

    def advect(self, component, u, inflow, trajectories, room, out):
        """The advected component -> out."""
        component.gather(component.pad(u, inflow, room), trajectories[0], out)

    def advect_vjp(self, component, g, u, inflow, trajectories, room, into, speeds):
        """Cotangent of the advected component -> that of u is written, that of inflow added to the pair `into`.

        Those of the velocities of the trajectories are written to the arrays `speeds`; None leaves a part out.
        """
        if into is not None:
            component.pad_vjp(component.scatter(g, trajectories[0], room), *into)
        if speeds is not None:
            component.gradient(component.pad(u, inflow, room), trajectories[0], g, speeds[0])

    def advect_jvp(self, component, u, inflow, trajectories, du, dinflow, dm):
        """Tangents of u, of inflow and of the velocity of each trajectory (or None) -> tangent."""
        samples, change = component.pad(u, inflow), component.pad(du, dinflow)
        return component.jvp(samples, change, trajectories[0], dm[0])

    # ------------------------------------------------------------ the whole field

    def _room(self, u):
        """A function from sizes to arrays, and the list of those to give back to the scratch arrays afterwards."""
        borrowed: list = []
        return (np.empty if u.size <= FEW else self.scratch.lender(borrowed)), borrowed

    def _velocities(self, v, room=np.empty):
        """Velocity as it is given -> for each component an array (axis, point)."""
        if self.to_points is not None:
            v = self.to_points.apply(v, out=room(self.to_points.shape[0]))
        return [v[part].reshape(shape) for part, shape in self.parts]

    def _trajectories(self, number, w, dt):
        steps, component = [dt * sign for sign in self.signs], self.components[number]
        return [component.trajectory(self.backtrace.velocity(number, w, step), step) for step in steps]

    def _check(self, u, v, inflow):
        """Name the first number that is not finite; the trajectories would hide it."""
        if not surely_finite(u):
            check_finite(self.name, u.reshape(self.setting.space.shape), "needs a finite field")
        if not surely_finite(v):
            check_finite(self.name, v.reshape(self.setting.velocity_shapes[-1]), "needs a finite velocity")
        if inflow.size:
            check_finite(self.name, inflow, "needs finite inflow values")

    def forward(self, u, v, dt, inflow):
        """The advected field."""
        self._check(u, v, inflow)
        out, (room, borrowed) = results.empty(u.shape, float), self._room(u)
        for number, (component, w) in enumerate(zip(self.components, self._velocities(v, room), strict=True)):
            span, solid = component.span, component.solid
            trajectories = self._trajectories(number, w, dt)
            self.advect(component, u[span], inflow, trajectories, room, out[span])
            if solid is not None:
                np.copyto(out[span], u[span], where=solid)
        self.scratch.give(*borrowed)
        return out

    def pull(self, nums, g, u, v, dt, inflow):
        """Cotangent of the advected field -> those of the arguments `nums`."""
        field, speed = FIELD in nums or INFLOW in nums, VELOCITY in nums or STEP in nums
        (room, borrowed), g, rate, of_w = self._room(u), np.ascontiguousarray(g), 0.0, []
        of_u, of_inflow = np.empty(u.size if field else 0), np.zeros(inflow.size)
        own = np.empty if self.to_points is None else room  # then they are handed out
        for number, (component, w) in enumerate(zip(self.components, self._velocities(v, room), strict=True)):
            span, solid, trajectories = component.span, component.solid, self._trajectories(number, w, dt)
            part = g[span] if solid is None else np.where(solid, 0.0, g[span])
            targets = (of_u[span], of_inflow) if field else None
            changes = [own(w.size).reshape(w.shape) for _ in trajectories] if speed else None
            self.advect_vjp(component, part, u[span], inflow, trajectories, room, targets, changes)
            if field and solid is not None:
                of_u[span] += np.where(solid, g[span], 0.0)
            if changes is not None:
                back, gain = self._of_velocity(number, w, trajectories, changes, STEP in nums)
                of_w.append(back.reshape(-1))
                rate += gain
        found = {FIELD: of_u, INFLOW: of_inflow, STEP: rate / dt}
        if VELOCITY in nums:
            flat = of_w[0] if len(of_w) == 1 else np.concatenate(of_w)
            found[VELOCITY] = flat if self.to_points is None else self.to_points.T.apply(flat)
        self.scratch.give(*borrowed)
        return tuple(found[num] for num in nums)

    def _of_velocity(self, number, w, trajectories, changes, timed):
        """Cotangents of the velocities of the trajectories -> that of w, and dt times that of dt if it is asked for."""
        total, rate = None, 0.0
        for change, trajectory in zip(changes, trajectories, strict=True):
            rate += _dot(change, trajectory.velocity) if timed else 0.0
            back, bent = self.backtrace.vjp(number, w, trajectory.step, change)
            rate += _dot(bent, w) if timed and bent is not None else 0.0
            total = back if total is None else np.add(total, back, out=total)
        return total, rate

    def push(self, tangents, u, v, dt, inflow):
        """{argument: tangent} -> tangent of the advected field."""
        tangents = {num: np.ascontiguousarray(t) if num != STEP else t for num, t in tangents.items()}
        du, dinflow = tangents.get(FIELD, np.zeros(u.size)), tangents.get(INFLOW, np.zeros(inflow.size))
        dv, ddt, out = tangents.get(VELOCITY, np.zeros(v.size)), tangents.get(STEP, 0.0) / dt, np.empty(u.size)
        moves, velocities = VELOCITY in tangents or STEP in tangents, (self._velocities(v), self._velocities(dv))
        for number, (component, w, dw) in enumerate(zip(self.components, *velocities, strict=True)):
            span, trajectories = component.span, self._trajectories(number, w, dt)
            dm = [self.backtrace.jvp(number, w, t, dw, ddt) if moves else None for t in trajectories]
            out[span] = self.advect_jvp(component, u[span], inflow, trajectories, du[span], dinflow, dm)
            if component.solid is not None:
                np.copyto(out[span], du[span], where=component.solid)
        return out

    def matrix(self, v, dt):
        """The step as a csr_array in u."""
        blocks = []
        for number, (component, w) in enumerate(zip(self.components, self._velocities(v), strict=True)):
            block, solid = component.matrix(*self._trajectories(number, w, dt)), component.solid
            if solid is not None:
                block = sp.diags_array(1.0 - solid) @ block + sp.diags_array(1.0 * solid)
            blocks.append(block)
        return sp.csr_array(sp.block_diag(blocks, format="csr"))


def _dot(a, b):
    with np.errstate(over="ignore", invalid="ignore"):  # the rule refuses what is not finite
        return float(np.einsum("ij,ij", a, b))
