"""The compiled loops of `sparsedp.kernels.fluxes` on all components of a field."""

import numpy as np

from sparsedp import kernels
from sparsedp._utils import buffers
from sparsedp.advection.stability import ROUNDING
from sparsedp.kernels import fluxes

__all__ = ["Loops", "able"]


def able():
    """Whether the compiled loops work here."""
    return kernels.compiled() and fluxes.stage.compiled is not None


class Loops:
    """The loops of one setting, on velocities as they are on the sides (or in the cells) of its components."""

    def __init__(self, reference):
        self.scheme = reference.scheme
        self.flux, self.components = reference.flux, reference.components
        self.limiter = fluxes.slopes.get(reference.setting.scheme)
        self.many = 1 if self.scheme.symmetric else 2  # arrays of slopes for each axis
        self.least = 1.0 - self.scheme.most - ROUNDING
        self.none = [self._empty(part, 0, 0) for part in self.components]  # the slopes of a scheme of first order

    def slopes(self, u, inflow, partials):
        """For each component the slopes and (partials) their derivatives in a and b; empty for a first-order scheme."""
        found = []
        for part in self.components if self.limiter else ():
            arrays = self._empty(part, part.field.stop - part.field.start, partials)
            part.run(self.limiter, u[part.field], inflow[part.inflow], part.free, part.table, part.axes, *arrays)
            found.append(arrays)
        return found or self.none

    def _empty(self, part, cells, partials):
        shapes = (len(part.axes), self.many, cells), (len(part.axes), self.many, 2, cells * partials)
        return [buffers.empty(shape, float) for shape in shapes]

    def _given(self, part, u, inflow, w, slopes, dt):
        """What the loops over fields and velocities begin with."""
        return (
            u[part.field],
            inflow[part.inflow],
            w[part.speed],
            part.free,
            slopes,
            dt,
            part.table,
            part.axes,
            self.flux,
        )

    def stage(self, u, slopes, w, dt, inflow, u0, keep, out):
        """out = keep u0 + (1 - keep) (u + dt du/dt); how many points have too small a weight or an infinite value."""
        total = 0.0
        for part, (values, _) in zip(self.components, slopes, strict=True):
            wrong = np.empty(part.tiles)
            given = self._given(part, u, inflow, w, values, dt)
            part.run(fluxes.stage, *given, self.least, u0[part.field], keep, out[part.field], wrong)
            total += wrong.sum()
        return total

    def vjp(self, g, u, slopes, w, dt, inflow, gu, ginflow, gw, fresh):
        """The cotangent of u + dt du/dt -> that of u into gu, those of the rest added to theirs; how many are infinite.

        Not counted: what slopes add to that of u, and the inflow. gu, gw: empty where they are not wanted; fresh:
        there is nothing in gw. The derivatives in `slopes` are overwritten.
        """
        total = 0.0
        for part, (values, partials) in zip(self.components, slopes, strict=True):
            given, wrong = self._given(part, u, inflow, w, values, dt), np.empty(part.tiles)
            targets = gu[part.field], ginflow[part.inflow], gw[part.speed]
            part.run(fluxes.vjp, g[part.field], *given, *targets, fresh, partials, wrong)
            total += wrong.sum()
            if partials.size and gu.size:
                part.run(fluxes.jumps, partials, part.free, part.axes, *targets[:2])
        return total
