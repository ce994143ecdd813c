"""Semi-Lagrangian transport: every point takes the value of the place its content comes from.

With E the extended field (see `places`), m the velocity with which point i looks back and s = dt / spacing,

    u'_i     = sum over k of W_ik E_k,     W_ik = product over the axes of weights at i - s m_i
    g_E      = W^T g,                      folded back onto u and inflow
    g_m      = -s g_i (slope of the interpolant at i - s m_i),    g_dt = sum of g_m . m / dt
    tangent  = W dE + g_m(g = 1) . dm + (g_m(g = 1) . m) ddt / dt,

then on to the velocity as it is given, see `wind`. Linear weights have kinks at the points: there the
slope is the mean of both sides. Cubic ones are those of Catmull and Rom (cubic convolution, Keys 1981): order 3
a step, so order 2 and more at a fixed ratio of dt to spacing, exact for quadratics away from walls.
Source: A. Staniforth, J. Cote, Monthly Weather Review 119 (1991) 2206-2223;
R. Keys, IEEE Trans. Acoustics, Speech and Signal Processing 29 (1981) 1153-1160.
"""

from functools import cached_property

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY, Law
from sparsedp.advection.look_matrix import block
from sparsedp.advection.places import filling, points_of
from sparsedp.advection.ruler import ruler_of, three
from sparsedp.advection.scratch import FEW, Scratch
from sparsedp.advection.wind import Euler, Midpoint, wind_of
from sparsedp.fields import check_finite
from sparsedp.kernels import sampling
from sparsedp.operators.boundary import solid_faces

__all__ = ["SemiLagrangian"]

NOTHING = np.empty(0)


class SemiLagrangian(Law):
    """See the head of the file."""

    forms: tuple[str, ...] = ("midpoint", "euler")
    linear = True
    ways: tuple[int, ...] = (1,)  # one look: backwards in time

    def __init__(self, setting):
        super().__init__(setting)
        grid = setting.grid
        self.empty = not setting.space.size
        if self.empty:
            return
        self.points = points_of(setting, setting.interpolation)
        self.spans = [slice(*ends) for ends in zip(setting.space.offsets, setting.space.offsets[1:])]
        self.scratch = Scratch()
        self.bent = setting.form.endswith("midpoint")
        self.trace = (Midpoint if self.bent else Euler)(setting)
        self.wind = wind_of(setting)
        absent, n = 3 - grid.dim, setting.space.size
        # One component that looks back along its own velocity: two calls of the kernels do all the work.
        self.stretched = not all(grid.uniform)
        self.direct = len(self.spans) == 1 and not self.bent and self.ways == (1,) and self.solids[0] is None
        self.direct = self.direct and not self.stretched
        self.ruler = ruler_of(setting, setting.interpolation)
        self.rows = (slice(n),) * absent + tuple(slice(a * n, (a + 1) * n) for a in range(grid.dim))

    @cached_property
    def solids(self):
        """For each component its solid points, or None."""
        setting = self.setting
        if setting.solid is None or not setting.solid.any():
            return [None] * len(self.points)
        if setting.of == "cells":
            return [setting.solid.ravel()]
        below, above = solid_faces(setting.grid, setting.solid)
        return [(below | above)[span] for span in self.spans]

    @cached_property
    def fill(self):
        """The map that fills solid cells, and its transpose, or None."""
        if self.setting.of == "faces" or self.solids[0] is None:
            return None
        forward = filling(self.setting.solid, self.setting.grid.periodic)
        return forward, sp.csr_array(forward.T)

    # ------------------------------------------------------------ one component

    def samples(self, number, u, outside):
        """Component of a field and values from outside -> samples."""
        return sampling.extend(self.points[number], u if self.fill is None else self.fill[0] @ u, outside)

    def fold(self, number, samples, u, outside, fresh=False):
        """The transpose of `samples`, added to u and outside, or written there when they are fresh."""
        if self.fill is None:
            sampling.fold(self.points[number], samples, u, outside, fresh)
        else:
            filled = np.zeros_like(u)
            sampling.fold(self.points[number], samples, filled, outside)
            u += self.fill[1] @ filled

    def value(self, number, samples, look, out=None):
        """Samples -> values at the places of a look."""
        w, scale = look
        return sampling.gather(self.points[number], samples, w, scale, np.empty(w[0].size) if out is None else out)

    def steepness(self, number, samples, look, g):
        """g times the derivative of `value` in the velocity of the look."""
        return self.ruler.steepness(self.points[number], samples, look, g)

    def carry(self, number, u, outside, looks, out):
        """The moved component -> out; whether all that it came from is finite."""
        u = u if self.fill is None else self.fill[0] @ u
        w, scale = looks[0]
        return sampling.advance(self.points[number], u, outside, w, scale, out)

    def carry_back(self, number, g, u, outside, looks, into, wanted):
        """Add cotangents to `into` (u, outside; or None).

        Returns, if wanted, those of the velocities of the looks, one for all where the looks share them, and their
        product with these velocities.
        """
        field, aside = (NOTHING, NOTHING) if into is None else into
        if wanted and self.stretched:
            speeds = self.steepness(number, self.samples(number, u, outside), looks[0], g)
            if into is not None:
                self.carry_back(number, g, u, outside, looks, into, False)
            return (speeds,), float(np.sum(speeds * looks[0].speeds))
        speeds = np.empty((self.setting.grid.dim, g.size)) if wanted else None
        filled = self.fill is not None and into is not None
        u, target = u if self.fill is None else self.fill[0] @ u, np.zeros_like(field) if filled else field
        axes = (NOTHING,) * 3 if speeds is None else three(speeds)
        w, scale = looks[0]
        rate = sampling.retreat(self.points[number], u, outside, w, scale, g, target, aside, axes, (False, True))
        if filled:
            field += self.fill[1] @ target
        return (speeds,), rate

    def carry_tangent(self, number, u, outside, looks, changes, speeds):
        """Tangents of (u, outside), or None, and of the velocities of the looks, or None -> tangent."""
        total = np.zeros(u.size)
        if changes is not None:
            total += self.value(number, self.samples(number, *changes), looks[0])
        if speeds is not None:
            total += np.sum(self.steepness(number, self.samples(number, u, outside), looks[0], _ones(u)) * speeds[0], 0)
        return total

    # ------------------------------------------------------------ the whole field

    def _speeds(self, v):
        """Velocity as it is given -> for each component an array (axis, point)."""
        w, found, start = v if self.wind is None else self.wind.apply(v), [], 0
        for span in self.spans:
            size = (span.stop - span.start) * self.setting.grid.dim
            found.append(w[start : start + size].reshape(self.setting.grid.dim, -1))
            start += size
        return found

    def _looks(self, number, w, dt):
        """For each look the velocities that are used, and where they lead."""
        steps = [dt * way for way in self.ways]
        return [self.ruler.look(number, self.trace.used(number, w, step), step) for step in steps]

    def _refuse(self, u, v, inflow):
        """Name the first number that is not finite; what only overflows on the way is let through."""
        check_finite(self.name, u.reshape(self.setting.space.shape), "needs a finite field")
        check_finite(self.name, v.reshape(self.setting.velocity_shapes[-1]), "needs a finite velocity")
        check_finite(self.name, inflow, "needs finite inflow values")

    def forward(self, u, v, dt, inflow, out=None):
        """The moved field."""
        out = np.empty(u.size) if out is None else out
        if self.empty:
            return out
        if self.direct:
            w = v if self.wind is None else self.wind.apply(v)
            if not sampling.advance(self.points[0], u, inflow, self._axes(w), self.ruler.scale(dt), out):
                self._refuse(u, v, inflow)
            return out
        if (self.bent or self.stretched) and not sampling.finite(v):  # a place may hide what is not finite
            self._refuse(u, v, inflow)
        good = True
        for number, (span, w) in enumerate(zip(self.spans, self._speeds(v), strict=True)):
            solid = self.solids[number]
            good &= self.carry(number, u[span], inflow, self._looks(number, w, dt), out[span])
            if solid is not None:
                np.copyto(out[span], u[span], where=solid)
        if not good:
            self._refuse(u, v, inflow)
        return out

    def pull(self, nums, g, u, v, dt, inflow, into=None):
        """Cotangent of the moved field -> those of the arguments `nums`."""
        g, into = np.ascontiguousarray(g), into or {}
        if not self.empty and self.direct and not (STEP in nums and into):
            return self._pull_direct(nums, g, u, v, dt, inflow, into)
        sizes = {FIELD: u.size, VELOCITY: v.size, INFLOW: inflow.size}
        found = {num: into[num] if num in into else np.zeros(n) for num, n in sizes.items()}
        found[STEP] = 0.0 if self.empty else self._pull(found, set(nums), g, u, v, dt, inflow)
        return tuple(found[num] for num in nums)

    def _axes(self, w):
        """Flat velocities -> one array for each of three axes."""
        one, two, three = self.rows
        return w[one], w[two], w[three]

    def _pull_direct(self, nums, g, u, v, dt, inflow, into):
        """The same in one call of the kernels."""
        found, fresh = dict(into), FIELD not in into and INFLOW not in into
        for num, size in ((FIELD, u.size), (INFLOW, inflow.size)):
            if num not in found:
                found[num] = (np.empty if fresh else np.zeros)(size) if FIELD in nums or INFLOW in nums else NOTHING
        taken: list[np.ndarray] = []
        room = self.scratch.lender(taken) if u.size > FEW else np.empty
        w = v if self.wind is None else self.wind.apply(v, out=room(self.wind.shape[0]) if u.size > FEW else None)
        speeds = NOTHING
        added = self.wind is None and VELOCITY in into
        if VELOCITY in nums or STEP in nums:
            speeds = into[VELOCITY] if added else (np.empty if self.wind is None else room)(w.size)
        targets = found[FIELD], found[INFLOW], self._axes(speeds), (fresh, not added)
        rate = sampling.retreat(self.points[0], u, inflow, self._axes(w), self.ruler.scale(dt), g, *targets, room)
        found[STEP] = rate / dt
        if VELOCITY in nums:
            back = speeds if self.wind is None else self.wind.T.apply(speeds)
            if VELOCITY in into and back is not into[VELOCITY]:
                into[VELOCITY] += back
                back = into[VELOCITY]
            found[VELOCITY] = back
        if taken:
            self.scratch.give(*taken)
        return tuple(found[num] for num in nums)

    def _pull(self, found, nums, g, u, v, dt, inflow):
        field, speed = bool(nums & {FIELD, INFLOW}), bool(nums & {VELOCITY, STEP})
        rate, backs = 0.0, []
        for number, (span, w) in enumerate(zip(self.spans, self._speeds(v), strict=True)):
            solid, part = self.solids[number], g[span]
            if solid is not None:
                found[FIELD][span] += np.where(solid, part, 0.0)
                part = np.where(solid, 0.0, part)
            looks = self._looks(number, w, dt)
            targets = (found[FIELD][span], found[INFLOW]) if field else None
            steep, gain = self.carry_back(number, part, u[span], inflow, looks, targets, speed)
            if speed:
                back, extra = self._against(number, w, looks, steep)
                backs.append(back)
                rate += gain + extra
        if VELOCITY in nums:
            flat = np.concatenate([b.ravel() for b in backs]) if len(backs) > 1 else backs[0].reshape(-1)
            found[VELOCITY] += flat if self.wind is None else self.wind.T.apply(flat)
        return rate / dt

    def _against(self, number, w, looks, steep):
        """Cotangents of the velocities of the looks -> that of w, and what dt adds to it by bending the looks."""
        total, rate = None, 0.0
        for look, change in zip(looks, steep):
            back, extra = self.trace.pull(number, w, look.step, change)
            total = back if total is None else total + back
            rate += extra
        return total, rate

    def push(self, tangents, u, v, dt, inflow):
        """{argument: tangent} -> tangent of the moved field."""
        tangents = {num: np.ascontiguousarray(t) if num != STEP else t for num, t in tangents.items()}
        out = np.zeros(u.size)
        if self.empty:
            return out
        du, dinflow = tangents.get(FIELD, np.zeros(u.size)), tangents.get(INFLOW, np.zeros(inflow.size))
        turns = self._speeds(tangents[VELOCITY]) if VELOCITY in tangents else [None] * len(self.spans)
        for number, (span, w) in enumerate(zip(self.spans, self._speeds(v), strict=True)):
            looks = self._looks(number, w, dt)
            speeds = self._turns(number, w, looks, turns[number], tangents.get(STEP), dt)
            changes = (du[span], dinflow) if {FIELD, INFLOW} & set(tangents) else None
            out[span] = self.carry_tangent(number, u[span], inflow, looks, changes, speeds)
            if self.solids[number] is not None:
                np.copyto(out[span], du[span], where=self.solids[number])
        return out

    def _turns(self, number, w, looks, dw, ddt, dt):
        """Tangents of s m for each look, in units of s."""
        if dw is None and ddt is None:
            return None
        found = []
        for look in looks:
            total = np.zeros_like(w) if dw is None else self.trace.push(number, w, look.step, dw)
            if ddt is not None:
                total = total + (look.speeds + self.trace.faster(number, w, look.step)) * (ddt / dt)
            found.append(total)
        return found

    def matrix(self, v, dt):
        """The step as a csr_array in u."""
        if self.empty:
            return sp.csr_array((0, 0))
        blocks = [block(self, number, self._looks(number, w, dt)[0]) for number, w in enumerate(self._speeds(v))]
        return sp.csr_array(sp.block_diag(blocks, format="csr"))


def _ones(u):
    return np.ones(u.size)
