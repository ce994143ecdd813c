"""Donor-cell transport, first order: the bilinear law of `lattice` in one pass over memory.

The formulas are in `bilinear`; here they run point by point, compiled where numba is there, with the checks
of the numbers and of the step in the same pass.
Source: R. Courant, E. Isaacson, M. Rees, Comm. Pure Appl. Math. 5 (1952) 243-255.
"""

from math import isfinite

import numpy as np

from sparsedp.advection.eulerian import Eulerian
from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY
from sparsedp.advection.stability import check_numbers, check_weights
from sparsedp.kernels.formulas import BOTH, BOTH_ADDED, FORWARD
from sparsedp.kernels.formulas import FIELD as OF_FIELD
from sparsedp.kernels.formulas import VELOCITY as OF_VELOCITY
from sparsedp.tape import isbox

__all__ = ["Upwind"]

ADDED = BOTH_ADDED - BOTH


class Upwind(Eulerian):
    """See the head of the file."""

    linear = True
    twice = True

    def forward(self, u, v, dt, inflow, out=None):
        out = np.empty(u.size) if out is None else out
        sums = self._loops.run(FORWARD, dt, {"u": u, "inflow": inflow, "w": self._needed(v), "out": out})
        self._check(sums[0], u, v, dt, inflow, out)
        return out

    def pull(self, nums, g, u, v, dt, inflow, into=None):
        if any(map(isbox, (g, u, v, dt, inflow))):
            return self.bilinear.pull(nums, g, u, v, dt, inflow)
        g = np.ascontiguousarray(g)
        kept, found = (into or {}).get(VELOCITY), {}
        added = self.bilinear.between is None and kept is not None
        of_field, of_velocity = FIELD in nums or INFLOW in nums, VELOCITY in nums
        task = (BOTH if of_field else OF_VELOCITY) + (ADDED if added else 0) if of_velocity else OF_FIELD
        arrays = {"u": u, "inflow": inflow, "w": self._needed(v), "g": g, "ginflow": np.empty(inflow.size)}
        if of_field or not of_velocity:
            arrays["out"] = np.empty(u.size)
        if of_velocity:
            arrays["gw"] = kept if added else np.empty(arrays["w"].size)
        total, spoiled = self._loops.run(task, dt, arrays)
        good = spoiled == 0.0
        if of_field:
            good &= self._loops.return_inflow(arrays["out"], arrays["ginflow"])
            found[FIELD], found[INFLOW] = arrays["out"], arrays["ginflow"]
        if of_velocity:
            found[VELOCITY] = self._of_velocity(arrays["gw"], kept, added)
        found[STEP] = total / dt
        return self._cotangents(nums, found, good)

    def march(self, states, v, dt, inflow):
        size, first, last = states.shape[1], 0, len(states) - 1
        arrays, moving = {"inflow": inflow, "w": self._needed(v)}, {"u": (size, size), "out": (size, size)}
        if last and not isfinite(self._unseen(v, inflow)):
            self._step_along(states, first, v, dt, inflow)
            first = 1
        while first < last:
            arrays.update(u=states[first], out=states[first + 1])
            done = self._loops.march(FORWARD, dt, arrays, moving, last - first)
            if done is None:
                return super().march(states[first:], v, dt, inflow)
            first += done
            if first < last:  # a point objects: name what is wrong, or go on where that is allowed
                self._step_along(states, first, v, dt, inflow)
                first += 1

    def _step_along(self, states, first, v, dt, inflow):
        self.forward(states[first], v, dt, inflow, out=states[first + 1])

    def retreat(self, states, g, v, dt, inflow, into=None):
        size, last = states.shape[1], len(states) - 1
        turns, aside = np.empty((2, size)), np.empty(inflow.size)
        turns[0] = g
        arrays = {"inflow": inflow, "w": self._needed(v), "g": turns[0], "out": turns[1], "ginflow": aside}
        arrays.update(u=states[max(last - 1, 0)], gw=into)
        moving = {"u": (-size, -size), "g": (size, -size), "out": (-size, size)}
        if into is None or self.bilinear.between is None:
            task = OF_FIELD if into is None else BOTH_ADDED
            if self._loops.march(task, dt, arrays, moving, last, turns, aside) is not None:
                return turns[last % 2]
        return super().retreat(states, g, v, dt, inflow, into)

    def push(self, tangents, u, v, dt, inflow):
        return self.bilinear.push(tangents, u, v, dt, inflow)

    def matrix(self, v, dt):
        nothing = np.zeros(self.setting.space.size), v, np.zeros(self.walls.size)
        check_numbers(self.setting, *nothing)
        check_weights(self, dt, self.bilinear.rate(v))
        return self.bilinear.matrix(v, dt)
