"""One component of a field between its points: padded, interpolated at departure points, and back."""

from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.ghost_cells import filling, sample_sources
from sparsedp.advection.index_coordinates import Stretched, Uniform
from sparsedp.kernels import departure
from sparsedp.kernels.departure import PAD

__all__ = ["Interpolant", "Pass", "Trajectory"]


class Trajectory(NamedTuple):
    """Where the points of a component go in a signed step."""

    velocity: Any  # (axis, point), used all along the step
    step: float
    displacement: Any  # (axis, point): the departure point is, in index coordinates, point - scale * displacement
    scale: Any  # one number for each axis
    slopes: Any  # derivative of the displacement in the velocity, above and below; None: 1


class Interpolant:
    """Component `number` of a field: linear or cubic; `closed`: walls repeat the nearest value, nothing flows in.

    Attributes
    ----------
    span : slice
        Where the component stands in the flat field.
    """

    def __init__(self, setting, number, interpolation, closed=False):
        shapes, grid, sides = setting.space.parts, setting.grid, setting.sides
        self.setting, self.closed = setting, closed
        self.span = slice(*setting.space.offsets[number : number + 2])
        wall = sum(2 * prod(s) // n for s in shapes[:number] for n, pair in zip(s, sides, strict=True) if pair)
        self.points = departure.Points.of(shapes[number], grid.periodic, interpolation)
        self.inside = tuple(slice(PAD, PAD + n) for n in self.points.shape)
        self.sources = sample_sources(shapes[number], sides, wall, closed)
        outside = np.flatnonzero(np.pad(np.zeros(shapes[number], bool), PAD, constant_values=True))
        inflow = self.sources[outside] >= self.points.size
        self.copies, self.plates = outside[~inflow], outside[inflow]
        self.copied, self.entering = self.sources[self.copies], self.sources[self.plates] - self.points.size
        self.coordinates = Uniform(grid) if all(grid.uniform) else Stretched(setting, number, interpolation)

    @cached_property
    def fill(self):
        """The map that fills solid cells, and its transpose; None where there is nothing to fill.

        Faces that touch a solid keep their value and lend it to others.
        """
        if self.setting.of == "faces" or self.setting.solid is None or self.closed:
            return None
        forward = filling(self.setting.grid, self.setting.solid)
        return forward, sp.csr_array(forward.T)

    def trajectory(self, velocity, step):
        """Velocities (axis, point), signed step -> Trajectory."""
        return Trajectory(velocity, step, *self.coordinates.displacement(velocity, step))

    def pad(self, u, inflow, room=np.empty):
        """Component, inflow values -> samples: the field with its ghost cells."""
        u, samples = u if self.fill is None else self.fill[0] @ u, room(self.points.samples)
        samples.reshape(self.points.padded)[self.inside] = u.reshape(self.points.shape)
        samples[self.copies] = u[self.copied]
        samples[self.plates] = inflow[self.entering]
        return samples

    def pad_vjp(self, samples, of_u, of_inflow):
        """Cotangent of samples -> written to of_u, added to of_inflow."""
        of_u.reshape(self.points.shape)[...] = samples.reshape(self.points.padded)[self.inside]
        np.add.at(of_u, self.copied, samples[self.copies])
        np.add.at(of_inflow, self.entering, samples[self.plates])
        if self.fill is not None:
            of_u[:] = self.fill[1] @ of_u

    def gradient(self, samples, trajectory, g, out):
        """g times the derivative of `gather` in the velocity of the trajectory -> out (axis, point)."""
        _, _, d, scale, slopes = trajectory
        departure.gradient(self.points, samples, d, scale, g, out)
        if slopes is None:
            return out
        above, below = slopes
        kinks = above != below
        if not kinks.any():
            return np.multiply(out, above, out=out)
        nudge = np.where(kinks, 32 * np.finfo(float).eps * max(self.points.shape), 0.0)
        upper, lower = (
            departure.gradient(self.points, samples, d + way * nudge, scale, g, np.empty_like(out)) for way in (-1, 1)
        )
        return np.multiply(0.5, above * upper + below * lower, out=out)

    def matrix(self, trajectory):
        """`gather` after `pad` as a csr_array in the component, without inflow."""
        n = self.points.size
        found = sp.csr_array((n, n))
        for index, weight in departure.entries(self.points, trajectory.displacement, trajectory.scale):
            columns = self.sources[index]
            weight = np.where(columns < n, weight, 0.0)
            found = found + sp.csr_array((weight, np.minimum(columns, n - 1), np.arange(n + 1)), (n, n))
        return found if self.fill is None else found @ self.fill[0]


class Pass:
    """A component between its points, at the departure points of a trajectory, and the derivatives of that.

    Parameters
    ----------
    interpolant : Interpolant
    trajectory : Trajectory
    u, inflow : array
    room : function
        Size -> array.
    """

    def __init__(self, interpolant, trajectory, u, inflow, room=np.empty):
        self.interpolant, self.trajectory, self.given, self.room = interpolant, trajectory, (u, inflow), room
        self.places = trajectory.displacement, trajectory.scale

    @cached_property
    def samples(self):
        """The component with its ghost cells."""
        return self.interpolant.pad(*self.given, self.room)

    def value(self, out=None, bounds=departure.NO_BOUNDS):
        """Values at the departure points; least and greatest sample of the cells around them -> bounds."""
        points = self.interpolant.points
        out = self.room(points.size) if out is None else out
        return departure.gather(points, self.samples, *self.places, out, bounds)

    def vjp(self, g, into, speed, clamped=None):
        """Cotangent of the values -> that of u is written, that of inflow added to the pair `into`.

        That of the velocity is written to `speed`; None leaves a part out. `clamped`: samples, and their cotangents.
        """
        if into is not None:
            points = self.interpolant.points
            samples = self.room(points.samples)
            samples[:] = 0.0
            if clamped is not None:
                np.add.at(samples, *clamped)
            self.interpolant.pad_vjp(departure.scatter(points, *self.places, g, samples), *into)
        if speed is not None:
            self.interpolant.gradient(self.samples, self.trajectory, g, speed)

    def jvp(self, du, dinflow, dm):
        """Tangents of u, of inflow and of the velocity (or None) -> that of the values."""
        total = Pass(self.interpolant, self.trajectory, du, dinflow).value()
        if dm is None:
            return total
        slopes = self.interpolant.gradient(self.samples, self.trajectory, np.ones(total.size), np.empty(dm.shape))
        return total + np.sum(slopes * dm, axis=0)
