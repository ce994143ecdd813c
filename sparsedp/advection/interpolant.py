"""One component of a field between its points: padded, interpolated at departure points, and back."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.ghost_cells import GhostCells, filling
from sparsedp.advection.index_coordinates import Stretched, Uniform
from sparsedp.advection.law import component_shapes
from sparsedp.kernels import departure
from sparsedp.operators.boundary import solid_faces

__all__ = ["Interpolant", "Trajectory", "components"]


class Trajectory(NamedTuple):
    """Where the points of a component go in a signed step."""

    velocity: Any  # (axis, point), used all along the step
    step: float
    displacement: Any  # (axis, point): the departure point is, in index coordinates, point - scale * displacement
    scale: Any  # one number for each axis
    slopes: Any  # derivative of the displacement in the velocity, above and below; None: 1


def components(setting):
    """Setting -> an Interpolant for each component of the moved field."""
    solids: list = [None] * setting.grid.dim
    if setting.solid is not None and setting.solid.any():
        if setting.of == "cells":
            solids = [setting.solid.ravel()]
        else:
            below, above = solid_faces(setting.grid, setting.solid)
            solids = [(below | above)[slice(*ends)] for ends in _ends(setting)]
    return [
        Interpolant(setting, number, setting.interpolation, solids[number]) for number in range(len(_ends(setting)))
    ]


def _ends(setting):
    return list(zip(setting.space.offsets, setting.space.offsets[1:], strict=False))


class Interpolant:
    """Component `number` of a field: linear or cubic; `closed`: walls repeat the nearest value, nothing flows in.

    Attributes
    ----------
    span : slice
        Where the component stands in the flat field.
    solid : bool array or None
        Its points that keep their value.
    """

    def __init__(self, setting, number, interpolation, solid=None, closed=False):
        shapes, grid, sides = component_shapes(setting), setting.grid, setting.sides
        self.setting, self.solid = setting, solid
        self.span = slice(*_ends(setting)[number])
        wall = sum(2 * np.prod(s) // n for s in shapes[:number] for n, pair in zip(s, sides, strict=True) if pair)
        self.ghosts = GhostCells(shapes[number], sides, int(wall), closed)
        self.points = departure.Points.of(shapes[number], grid.periodic, interpolation)
        uniform = all(grid.uniform)
        self.coordinates = Uniform(grid) if uniform else Stretched(setting, number, interpolation)

    @cached_property
    def fill(self):
        """The map that fills solid cells, and its transpose; None where there is nothing to fill.

        Faces that touch a solid keep their value and lend it to others.
        """
        if self.setting.of == "faces" or self.solid is None:
            return None
        forward = filling(self.setting.solid, self.setting.grid.periodic)
        return forward, sp.csr_array(forward.T)

    def trajectory(self, velocity, step):
        """Velocities (axis, point), signed step -> Trajectory."""
        return Trajectory(velocity, step, *self.coordinates.displacement(velocity, step))

    def pad(self, u, inflow, room=np.empty):
        """Component, inflow values -> samples: the field with its ghost cells."""
        return self.ghosts.pad(u if self.fill is None else self.fill[0] @ u, inflow, room(self.points.samples))

    def pad_vjp(self, samples, of_u, of_inflow):
        """Cotangent of samples, which is used up -> written to of_u, added to of_inflow."""
        self.ghosts.pad_vjp(samples, of_u, of_inflow)
        if self.fill is not None:
            of_u[:] = self.fill[1] @ of_u

    def gather(self, samples, trajectory, out):
        """Values at the departure points -> out."""
        return departure.gather(self.points, samples, trajectory.displacement, trajectory.scale, out)

    def scatter(self, g, trajectory, room=np.empty, out=None):
        """The transpose of `gather` -> samples, added to `out` if it is given."""
        if out is None:
            out = room(self.points.samples)
            out[:] = 0.0
        return departure.scatter(self.points, trajectory.displacement, trajectory.scale, g, out)

    def gradient(self, samples, trajectory, g, out=None):
        """g times the derivative of `gather` in the velocity of the trajectory -> (axis, point)."""
        velocity, _, d, scale, slopes = trajectory
        out = np.empty(velocity.shape) if out is None else out
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

    def jvp(self, samples, change, trajectory, dm):
        """Samples and their tangent, that of the velocity of the trajectory or None -> tangent of `gather`."""
        total, ones = self.gather(change, trajectory, np.empty(self.points.size)), np.ones(self.points.size)
        return total if dm is None else total + np.sum(self.gradient(samples, trajectory, ones) * dm, axis=0)

    def matrix(self, trajectory):
        """`gather` after `pad` as a csr_array in the component, without inflow."""
        n = self.points.size
        numbers = self.ghosts.pad(
            np.arange(float(n)), np.full(self.ghosts.inflow_end, -1.0), np.empty(self.points.samples)
        )
        found = sp.csr_array((n, n))
        for index, weight in departure.entries(self.points, trajectory.displacement, trajectory.scale):
            columns = numbers[index].astype(np.int64)
            inside = columns >= 0
            found = found + sp.csr_array((weight[inside], (np.flatnonzero(inside), columns[inside])), (n, n))
        return found if self.fill is None else found @ self.fill[0]
