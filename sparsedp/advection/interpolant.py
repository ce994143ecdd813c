"""One component of a field between its points: padded, interpolated at departure points, and back."""

from functools import cached_property

import numpy as np
import scipy.sparse as sp

from sparsedp._utils import buffers
from sparsedp._utils.validation import EPS
from sparsedp.advection.ghost_cells import filling, ghost_origins
from sparsedp.advection.index_coordinates import Coordinates
from sparsedp.kernels import departure_samples
from sparsedp.kernels.departure_samples import PAD

__all__ = ["Interpolant", "Pass"]


class Interpolant:
    """Component `number` of a field: linear or cubic; `closed`: linear, and walls repeat the nearest value.

    Attributes
    ----------
    span : slice
        Where the component stands in the flat field.
    half_way : Interpolant or None
        Of the velocity half way to a departure point; None: points keep their own velocity (euler).
    """

    def __init__(self, setting, number, closed=False):
        interpolation = "linear" if closed else setting.interpolation
        self.setting, self.span = setting, slice(*setting.space.offsets[number : number + 2])
        self.points = departure_samples.Points.of(setting.space.parts[number], setting.grid.periodic, interpolation)
        self.inside = tuple(slice(PAD, PAD + n) for n in self.points.shape)
        self.ghosts, self.origins = ghost_origins(setting, number, self.points, closed)
        self.coordinates = Coordinates(setting, number, interpolation)
        midpoint = setting.backtrace == "midpoint" and not closed
        self.half_way = Interpolant(setting, number, closed=True) if midpoint else None
        self.fill = None  # the map that fills solid cells, and its transpose
        if setting.of == "cells" and setting.solid is not None and not closed:  # faces lend their value to others
            forward = filling(setting.grid, setting.solid)
            self.fill = forward, sp.csr_array(forward.T)

    def pad(self, u, inflow):
        """Component, inflow values -> samples: the field with its ghost cells, and after them the inflow values."""
        cells = self.points.samples
        samples = buffers.empty((cells + inflow.size,), float)
        samples[:cells].reshape(self.points.padded)[self.inside] = u.reshape(self.points.shape)
        samples[cells:] = inflow
        samples[self.ghosts] = samples[self.origins]
        return samples

    def pad_vjp(self, samples, of_u, of_inflow):
        """Cotangent of samples, which is used up -> written to of_u, added to of_inflow."""
        cells = self.points.samples
        np.add.at(samples, self.origins, samples[self.ghosts])
        of_u.reshape(self.points.shape)[...] = samples[:cells].reshape(self.points.padded)[self.inside]
        of_inflow += samples[cells:]


class Pass:
    """A component of a field at the departure points of a trajectory, and the derivatives of that."""

    def __init__(self, trajectory, u, inflow):
        self.trajectory, self.component, self.u, self.inflow = trajectory, trajectory.component, u, inflow
        self.points, self.departure = self.component.points, (trajectory.displacement, trajectory.scale)

    @cached_property
    def samples(self):
        """The component with its ghost cells."""
        fill = self.component.fill
        return self.component.pad(self.u if fill is None else fill[0] @ self.u, self.inflow)

    def value(self, out=None, bounds=departure_samples.NO_BOUNDS):
        """Values at the departure points; least and greatest sample of the cells around them -> bounds."""
        out = buffers.empty((self.points.size,), float) if out is None else out
        return departure_samples.interpolate(self.points, self.samples, *self.departure, out, bounds=bounds)

    def vjp(self, g, into, of_w, clamped=None):
        """Cotangent of the values -> that of u is written, that of inflow added to the pair `into`.

        That of the velocity is written to `of_w`; None leaves a part out. `clamped`: samples, and their cotangents.
        """
        if into is not None:
            samples = buffers.empty((self.points.samples + self.inflow.size,), float)
            samples[:] = 0.0
            if clamped is not None:
                np.add.at(samples, *clamped)
            self.component.pad_vjp(departure_samples.scatter(self.points, *self.departure, g, samples), *into)
            if self.component.fill is not None:
                into[0][:] = self.component.fill[1] @ into[0]
        if of_w is not None:
            self.trajectory.vjp(self.slopes(g, of_w))

    def slopes(self, g, out):
        """g times the derivative of the values in the velocity all along the trajectory -> out (axis, point)."""
        (displacement, scale), sides = self.departure, self.trajectory.sides
        if not len(sides):
            return departure_samples.interpolate(self.points, self.samples, displacement, scale, out, g)
        nudge = 32 * EPS * max(self.points.shape) * (sides[0] != sides[-1])  # to the side that is meant
        total = 0.0
        for slope, shift in zip(sides, (-nudge, nudge)):
            found = buffers.empty(out.shape, float)
            total += slope * departure_samples.interpolate(
                self.points, self.samples, displacement + shift, scale, found, g
            )
        return np.divide(total, len(sides), out=out)

    def jvp(self, du, dinflow, dw):
        """Tangents of u, of inflow and of the velocity (or None) -> that of the values."""
        total = Pass(self.trajectory, du, dinflow).value()
        if dw is None:
            return total
        return total + np.sum(self.slopes(np.ones(total.size), np.empty(dw.shape)) * self.trajectory.jvp(dw), axis=0)

    def matrix(self):
        """The values as a csr_array in u, without what flows in."""
        n, fill = self.points.size, self.component.fill
        sources = self.component.pad(np.arange(n), np.full(self.inflow.size, n)).astype(int)  # n: inflow
        entries = departure_samples.entries(self.points, *self.departure)
        columns = (sp.csr_array((weight, sources[index], np.arange(n + 1)), (n, n + 1)) for index, weight in entries)
        moved = sum(columns)[:, :n]
        return moved if fill is None else moved @ fill[0]
