"""The tables of a scheme and the calls of its formulas: from named flat arrays to results and sums."""

from functools import cached_property
from math import prod

import numpy as np

from sparsedp.advection.segments import ARRAYS, Component
from sparsedp.kernels.formulas import ADVECTIVE, FLUX, FORWARD, POINTS, number_of, streams_of
from sparsedp.kernels.limited import JUMPS, LAST, PULL, PULL_ADDED, limited_number, limited_streams
from sparsedp.kernels.streams import TILE, Table, march, run

__all__ = ["Loops"]


def mode_of(matrices):
    """Which of the three formulas a setting needs."""
    if matrices.on_points:
        return POINTS
    return FLUX if matrices.setting.form == "flux" else ADVECTIVE


def _lines(matrices, limited):
    """For each (lattice, axis): the lengths by which dt is divided, repeated where one number serves a whole line."""
    for lattice in matrices.lattices:
        for number, axis in enumerate(lattice.axes):
            line = axis.gaps if matrices.on_points and not limited else axis.widths
            same = number == len(lattice.axes) - 1 and line.size and np.all(line == line[0])
            yield np.full(TILE, line[0]) if same else line, bool(same)


def factors(matrices, limited):
    """All those lengths in one array."""
    return np.concatenate([line for line, _ in _lines(matrices, limited)])


def ratios(matrices):
    """For each (lattice, axis): the distances to the points below and above over half the width; walls half away."""
    found = []
    for axis in (axis for lattice in matrices.lattices for axis in lattice.axes):
        gaps = axis.gaps.copy()
        if not axis.periodic and gaps.size:
            gaps[[0, -1]] *= 0.5
        above = (np.arange(axis.points) + 1) % max(axis.interfaces, 1)
        found += [2 * gaps[: axis.points] / axis.widths, 2 * gaps[above] / axis.widths]
    return np.concatenate(found)


def table(matrices, number, streams, ghosts, limited=False):
    """Table of a formula for all components, with or without what is outside the walls."""
    lines = iter([(line.size, same) for line, same in _lines(matrices, limited)])
    found, offsets = [], dict.fromkeys(("u", "inflow", "w", "factors", "slope", "ratios"), 0)
    for lattice in matrices.lattices:
        component = Component(lattice, mode_of(matrices), limited, offsets, lines)
        found.append(component.points())
        if ghosts:
            found += component.ghosts()
    counts = np.concatenate([count for count, _ in found])
    return Table(number, counts, [np.concatenate([s[stream.name] for _, s in found]) for stream in streams])


class Loops:
    """The tables of one setting, made when first needed, and the arrays that all calls share."""

    def __init__(self, matrices, limited=False):
        self.matrices, self.limited = matrices, limited
        self.lengths = factors(matrices, limited)
        self.kept = {}
        self.factors = {}  # dt / lengths for the last few dt
        self.zeros, self.dump, self.nothing = np.zeros(TILE), np.zeros(TILE), np.zeros(0)

    def run(self, task, dt, arrays):
        """Run a task on named flat arrays; return its sums."""
        return run(*self._prepared(task, dt, arrays))

    def march(self, task, dt, arrays, moving, n, results=None, aside=None):
        """Run a task n times in one call; return how many went well, or None where that cannot be.

        `moving` holds for the name of an array the numbers by which it moves on after even and odd runs. What
        is in `aside` after a run goes to the points it was taken from, in the row of `results` just written.
        """
        table, known = self._prepared(task, dt, arrays)
        strides = np.zeros((2, len(ARRAYS)), np.int64)
        for name, steps in moving.items():
            strides[:, ARRAYS.index(name)] = 8 * steps[0], 8 * steps[1]
        turned = self._nowhere if results is None else (results, aside, *self._turned)
        return march(table, known, strides, n, results is None, turned)

    _nowhere = np.empty((2, 0)), np.empty(0), np.empty(0, np.int64), np.empty(0, np.int64)

    @cached_property
    def _turned(self):
        """Places in the inflow, and the points that each goes back to."""
        if not self._open_walls:
            return self._nowhere[2:]
        walls = np.concatenate([np.arange(wall.start, wall.stop) for wall, _ in self._open_walls])
        return walls, np.concatenate([points for _, points in self._open_walls])

    def _prepared(self, task, dt, arrays):
        """The table of a task, and all arrays in their order."""
        if task not in self.kept:
            self.kept[task] = self._table(task)
        found = self.factors.get(dt)
        if found is None:
            found = dt / self.lengths
            self.factors = {dt: found} if len(self.factors) > 2 else {**self.factors, dt: found}
        arrays.update(factors=found, zeros=self.zeros, dump=self.dump)
        if self.limited:
            arrays.update(ratios=self.ratios, spill=self.spill)
        return self.kept[task], [arrays.get(name, self.nothing) for name in ARRAYS]

    def _table(self, task):
        dim, mode = len(self.matrices.lattices[0].axes), mode_of(self.matrices)
        if not self.limited:
            streams = streams_of(dim, mode, task)
            return table(self.matrices, number_of(dim, mode, task), streams, task != FORWARD)
        streams, ghosts = limited_streams(dim, mode, task), task in (PULL, PULL_ADDED, JUMPS, LAST)
        return table(self.matrices, limited_number(dim, mode, task), streams, ghosts, limited=True)

    @cached_property
    def ratios(self):
        return ratios(self.matrices)

    @cached_property
    def spill(self):
        return np.zeros(TILE)

    @cached_property
    def _open_walls(self):
        """For each wall that lets in the point's own value: its places in the inflow, and those points."""
        found, first, wall = [], 0, 0
        for lattice in self.matrices.lattices:
            own = np.arange(first, first + prod(lattice.shape)).reshape(lattice.shape)
            first += own.size
            for number, axis in enumerate(lattice.axes):
                for side in range(0 if axis.periodic else 2):
                    points = np.take(own, [-side], number).ravel() if own.size else np.zeros(0, int)
                    many = prod(lattice.shape[:number] + lattice.shape[number + 1 :])
                    if axis.closed[side] or not own.size:
                        found.append((slice(wall, wall + many), points))
                    wall += many
        return found

    def return_inflow(self, out, inflow):
        """Give the cotangent of what came from outside to the points it was taken from; whether they stay finite."""
        total = 0.0
        for wall, points in self._open_walls:
            found = out[points] + inflow[wall]
            out[points], inflow[wall] = found, 0.0
            total += float(np.vdot(found, np.zeros(found.size)))
        return total == 0.0
