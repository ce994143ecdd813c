"""The compiled loops of `sparsedp.kernels.fluxes` on all components of a field."""

from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import numpy as np

from sparsedp import kernels, results
from sparsedp.advection.lattice import lattices, opened
from sparsedp.kernels import fluxes

__all__ = ["Loops", "able"]

ROUNDING = 8 * np.finfo(float).eps  # a Courant number of exactly 1 leaves a weight of about -1e-16
NOTHING, OPEN = np.zeros(0), np.zeros(0, bool)


def able():
    """Whether the compiled loops work here."""
    return kernels.compiled() and fluxes.stage.compiled is not None


class Component(NamedTuple):
    """One component of the field as the loops take it."""

    field: (
        slice  # its numbers in the field, in the inflow, in the velocity, in the arrays that have a row for each axis
    )
    inflow: slice
    speed: slice
    rows: slice
    axes: Any  # see `sparsedp.kernels.fluxes`
    lengths: Any  # by which the velocity along each axis is to be divided
    parts: int


class Loops:
    """The loops of one setting.

    Where all lengths along each axis are equal the loops take the velocity on the sides (or in the cells) as it is,
    else one that is divided by the lengths, on the lower and on the upper side of each cell. Obstacles make it 0.
    """

    def __init__(self, reference, scratch):
        self.reference, self.scratch, self.scheme = reference, scratch, reference.scheme
        self.points, self.flux = reference.points, reference.flux
        self.lattices = lattices(reference.setting)
        self._limiter = fluxes.slopes.get(reference.setting.scheme)
        lines = [self._line(axis) for lattice in self.lattices for axis in lattice.axes]
        self.even = all(np.all(line == line[0]) for line in lines) and not (self.points and self._solid)
        self.lift = int(self.even and not self.points)

    def _line(self, axis):
        """The lengths by which the velocity along an axis is divided."""
        return axis.gaps if self.points and not self.reference.limited else axis.widths

    @property
    def _solid(self):
        return self.reference.setting.solid is not None

    @cached_property
    def components(self):
        found, starts = [], [0, 0, 0, 0]
        for lattice in self.lattices:
            cells, rows, speed, wall = prod(lattice.shape), [], 0, 0
            for number, axis in enumerate(lattice.axes):
                stride, walls = prod(lattice.shape[number + 1 :]), cells // axis.points
                count, last = axis.sides if self.lift else axis.points, number == len(lattice.axes) - 1
                given = [not (axis.periodic or closed) for closed in axis.closed]
                rows.append((axis.points, count, stride, last, axis.periodic, speed, wall, wall + walls, *given))
                speed, wall = speed + walls * count, wall + (0 if axis.periodic else 2 * walls)
            ends = [start + size for start, size in zip(starts, (cells, wall, speed, cells * len(rows)), strict=True)]
            lengths = np.array([self._line(axis)[0] if self.even else 1.0 for axis in lattice.axes])
            parts = cells // lattice.shape[-1] * -(-lattice.shape[-1] // fluxes.TILE)
            slices = [slice(start, end) for start, end in zip(starts, ends, strict=True)]
            found.append(
                Component(slices[0], slices[1], slices[2], slices[3], np.array(rows, np.int64), lengths, parts)
            )
            starts = ends
        return found

    @cached_property
    def _open(self):
        """1 on the sides that let something through, 0 on the others; None where all do."""
        if not self._solid:
            return None
        free = [opened(lattice, a).ravel() for lattice in self.lattices for a in range(len(lattice.axes))]
        return np.concatenate(free).astype(float)

    def speeds(self, v):
        """Velocity as given -> that on the lower and on the upper sides; where it is one array, the same twice."""
        if not self.even:
            return tuple(self.reference.matrices[f"speed {side}"] @ v for side in ("lower", "upper"))
        w = v if self.reference.between is None else self.reference.between[0] @ v
        w = w if self._open is None else w * self._open
        return w, w

    def blank(self):
        """Arrays for the cotangents of `speeds`."""
        size = self.components[-1].speed.stop
        low = results.empty((size,), float)
        return low, low if self.even else results.empty((size,), float)

    def of_velocity(self, low, high):
        """Cotangents of `speeds` -> that of the velocity as given."""
        if not self.even:
            lower, upper = self._turned
            return lower @ low + upper @ high
        low = low if self._open is None else low * self._open
        return low if self.reference.between is None else self.reference.between[1] @ low

    @cached_property
    def _turned(self):
        return tuple(self.reference.matrices[f"speed {side}"].T.tocsr() for side in ("lower", "upper"))

    def stage(self, u, slopes, speeds, dt, inflow, u0, keep, out):
        """out = keep u0 + (1 - keep) (u + dt du/dt); how many points have too small a weight or an infinite value."""
        least, wrong = 1.0 - self.scheme.most - ROUNDING, 0.0
        for field, q, w, rows, axes, lengths, parts in self.components:
            found = np.empty(parts)
            given = u[field], inflow[q], speeds[0][w], speeds[1][w], slopes[0][rows], slopes[1][rows], dt / lengths
            rest = axes, self.lift, self.flux, least, u0[field], keep, out[field], found
            fluxes.stage.run(parts, given[0].size, kernels.threads(), *given, *rest)
            wrong += found.sum()
        return wrong

    def slopes(self, u, inflow, steep, spare):
        """ahead, behind and (steep) their derivatives in a and b, in arrays that are put into the list `spare` too.

        Empty arrays for a scheme of first order, and for the second one of two that are the same.
        """
        if self._limiter is None:
            return (NOTHING,) * 6
        size, symmetric, lend = self.components[-1].rows.stop, self.scheme.symmetric, self.scratch.lender(spare)
        wanted = True, not symmetric, steep, steep, steep and not symmetric, steep and not symmetric
        found = [lend(size) if flag else NOTHING for flag in wanted]
        for (field, q, _, rows, axes, _, parts), (free, distances) in zip(self.components, self._around, strict=True):
            targets = [array[rows] for array in found]
            given = u[field], inflow[q], free, distances, axes, steep
            self._limiter.run(parts, given[0].size, kernels.threads(), *given, *targets)
        return (found[0], found[0] if symmetric else found[1], *found[2:])

    @cached_property
    def _around(self):
        """For each component: which lower and upper sides are open, axis by axis; distances over half a width."""
        found = []
        for (_, _, _, rows, *_), lattice in zip(self.components, self.lattices, strict=True):
            tables, dim = self.reference.tables, len(lattice.axes)
            free = OPEN
            if self._solid:
                sides = [tables[f"open {side}"][rows].reshape(dim, -1) for side in ("lower", "upper")]
                free = np.stack(sides, axis=1).ravel()
            lines = []
            for number in range(dim):
                for side in ("lower", "upper"):
                    all_of = tables[f"distance {side}"][rows].reshape(dim, *lattice.shape)[number]
                    lines.append(np.moveaxis(all_of, number, 0).reshape(lattice.shape[number], -1)[:, 0])
            found.append((free, np.concatenate(lines)))
        return found

    def pull(self, g, u, slopes, speeds, dt, inflow, gu, ginflow, gspeeds, added):
        """The cotangent of u + dt du/dt -> that of u into gu (None: not wanted), those of the rest added to theirs.

        gspeeds: None where those of the velocity are not wanted; added: whether there is something in them. The
        derivatives in `slopes` are overwritten. Returns how many values are not finite.
        """
        if self._limiter is not None and gspeeds is None:
            gspeeds, added = self.blank(), False
        wrong, modes = 0.0, (not self.even, not added)
        for number, (field, q, w, rows, axes, lengths, parts) in enumerate(self.components):
            found, work = np.zeros((3, parts)), (parts, field.stop - field.start, kernels.threads())
            low, high, ratios = speeds[0][w], speeds[1][w], dt / lengths
            if gu is not None:
                rest = axes, self.lift, self.flux, gu[field], ginflow[q], found[0]
                fluxes.pull_field.run(*work, g[field], low, high, ratios, *rest)
            if gspeeds is not None:
                targets = gspeeds[0][w], gspeeds[1][w]
                given = g[field], u[field], inflow[q], low, high, ratios
                fluxes.pull_velocity.run(*work, *given, axes, self.lift, self.flux, *targets, *modes, found[1])
            if self._limiter is not None:
                ahead, behind, *steep = (array[rows] for array in slopes)
                given = g[field], low, high, ahead, behind, ratios
                fluxes.pull_slopes.run(*work, *given, axes, self.lift, *targets, *steep, found[1])
                if gu is not None:
                    free = self._around[number][0]
                    fluxes.jumps.run(*work, *steep[:2], free, axes, gu[field], ginflow[q], found[0])
            wrong += found.sum()
        return wrong
