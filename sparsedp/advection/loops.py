"""The compiled loops of `sparsedp.kernels.fluxes` on all components of a field."""

from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import numpy as np

from sparsedp import kernels, results
from sparsedp.advection.lattice import beside, lattices
from sparsedp.kernels import fluxes

__all__ = ["Loops", "able"]

ROUNDING = 8 * np.finfo(float).eps  # a Courant number of exactly 1 leaves a weight of about -1e-16


def able():
    """Whether the compiled loops work here."""
    return kernels.compiled() and fluxes.stage.compiled is not None


class Component(NamedTuple):
    """One component of the field as the loops take it; see `sparsedp.kernels.fluxes`."""

    field: slice  # its numbers in the field, in the inflow, in the velocity
    inflow: slice
    speed: slice
    free: Any
    table: Any
    axes: Any
    tiles: int

    def run(self, loop, *args):
        """A loop over the tiles."""
        loop.run(self.tiles, self.field.stop - self.field.start, kernels.threads(), *args)


class Loops:
    """The loops of one setting, on velocities as they are on the sides (or in the cells) of its components."""

    def __init__(self, reference):
        self.scheme = reference.scheme
        self.points, self.flux, self.setting = reference.points, reference.flux, reference.setting
        self.limiter = fluxes.slopes.get(self.setting.scheme)
        self.many = 1 if self.scheme.symmetric else 2  # arrays of slopes for each axis
        self.least = 1.0 - self.scheme.most - ROUNDING

    @cached_property
    def components(self):
        found, starts = [], [0, 0, 0]
        for lattice in lattices(self.setting):
            rows, cells, speed, wall = [], prod(lattice.shape), 0, 0
            tables: list = []
            for number, axis in enumerate(lattice.axes):
                stride, points = prod(lattice.shape[number + 1 :]), axis.widths.size
                walls, ends = cells // points, [fluxes.ROUND] * 2
                extra = 0 if self.points else stride * (axis.sides - points)
                if not axis.periodic:
                    ends = [fluxes.ITSELF if shut else at for shut, at in zip(axis.closed, (wall, wall + walls))]
                    wall += 2 * walls
                lines = self._lines(axis)
                rows.append([points, stride, not self.points, speed, extra, *ends])
                rows[-1] += [sum(len(table) for table in tables), len(lines) > 1, False]
                tables.append(lines)
                speed += cells + extra * (walls // stride)
            stops = [starts[0] + cells, starts[1] + wall, starts[2] + speed]
            shape = 2 * len(lattice.axes), -1 if lattice.solid is not None else 0
            free = np.reshape([] if lattice.solid is None else lattice.open, shape).astype(bool)
            tiles = cells // lattice.shape[-1] * -(-lattice.shape[-1] // fluxes.TILE)
            table, axes = np.concatenate(tables).T.copy(), np.array(rows, np.int64)
            axes[:, fluxes.UNEVEN] = free.size or any(np.any(x[:, :4] != x[0, 0]) for x in tables)
            field, inflow, speeds = map(slice, starts, stops)
            found.append(Component(field, inflow, speeds, free, table, axes, tiles))
            starts = stops
        return found

    def _lines(self, axis):
        """The columns of an axis in the table: one for each place along it, or one for all."""
        between = self.points and self.limiter is None  # lengths between points, not of control volumes
        own = axis.around if between else (axis.widths, axis.widths)
        theirs = own if between else beside(axis.widths, 0)
        lines = np.transpose([*(1.0 / length for length in (*own, *theirs)), *(axis.distances if self.limiter else ())])
        return lines if np.any(lines != lines[0]) else lines[:1]

    def slopes(self, u, inflow, steep):
        """For each component the slopes and (steep) their derivatives in a and b; empty for a scheme of first order."""
        found = []
        for part in self.components:
            axes, cells = len(part.axes), part.field.stop - part.field.start if self.limiter else 0
            shapes = (axes, self.many, cells), (axes, self.many, 2, cells * steep)
            arrays = [results.empty(shape, float) for shape in shapes]
            if self.limiter:
                part.run(self.limiter, u[part.field], inflow[part.inflow], part.free, part.table, part.axes, *arrays)
            found.append(arrays)
        return found

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

    def pull(self, g, u, slopes, w, dt, inflow, gu, ginflow, gw, fresh):
        """The cotangent of u + dt du/dt -> that of u into gu, those of the rest added to theirs.

        gu, gw: empty where they are not wanted; fresh: there is nothing in gw. The derivatives in `slopes` are
        overwritten.
        """
        for part, (values, steep) in zip(self.components, slopes, strict=True):
            given = self._given(part, u, inflow, w, values, dt)
            targets = gu[part.field], ginflow[part.inflow], gw[part.speed]
            part.run(fluxes.pull, g[part.field], *given, *targets, fresh, steep)
            if steep.size and gu.size:
                part.run(fluxes.jumps, steep, part.free, part.axes, *targets[:2])
