"""The stencil of D diag(k) G where D and G are differences along the axes: read off their 1-D factors.

Along an axis, D has two entries for each face (one for each cell beside it), and so has G: four numbers a
face, which do not depend on the place along the other axes. Only k does.
"""

from typing import NamedTuple

import numpy as np

from sparsedp.solvers.multigrid.stencil import CLEAN, Stencil, cleaned, forward
from sparsedp.structure.base import Scaled
from sparsedp.structure.kronecker import Kronecker
from sparsedp.structure.lazy import Chain, Diagonal
from sparsedp.structure.through import entries_beside

__all__ = ["Faces", "faces_of", "of_lines", "read_lines"]


class Lines(NamedTuple):
    """For each face of an axis: the link, and what is left on the cells below and above, for k = 1."""

    link: np.ndarray
    below: np.ndarray
    above: np.ndarray


def read_lines(left, middle, right, grid):
    """Structures D (faces -> cells), G and the diagonals between -> (Lines of each axis, k), or None."""
    if not (isinstance(left, Kronecker) and isinstance(right, Kronecker)):
        return None
    if not all(isinstance(member, Diagonal) for member in middle):
        return None
    if left.in_parts != right.out_parts or len(left.in_parts) != grid.dim:
        return None
    lines = [_of_axis(left, right, grid, axis) for axis in range(grid.dim)]
    if any(line is None for line in lines):
        return None
    k = np.ones(left.shape[1]) if not middle else middle[0].values
    for member in middle[1:]:
        k = k * member.values
    return lines, k


def _of_axis(left, right, grid, axis):
    found = entries_beside(left, right, axis, grid.shape[axis], grid.periodic[axis])
    if found is None:
        return None
    ((g_below, g_above), (d_below, d_above)), h, faces = found, grid.widths[axis], grid.node_count(axis)
    d_below, d_above = d_below * np.take(h, np.arange(faces) - 1, mode="wrap"), d_above * np.append(h, h)[:faces]
    one, two = d_below * g_above, d_above * g_below
    if not np.all(np.abs(one - two) <= CLEAN * np.abs(one)):  # not symmetric
        return None
    linked = (g_below != 0) & (g_above != 0)
    link = np.where(linked, -0.5 * (one + two), 0.0)
    size = np.abs(link)
    return Lines(link, cleaned(d_below * g_below - link, size), cleaned(d_above * g_above - link, size))


def of_lines(lines, k, grid, unit=1.0):
    """Lines of each axis and one value for each face -> Stencil of `unit` V D diag(k) G."""
    links, extra = [], np.zeros(grid.shape)
    for axis, part in enumerate(grid.split(k)):
        line, faces = lines[axis], np.moveaxis(part, axis, 0)
        area = unit * _area(grid, axis)
        factor = line.link.reshape((-1,) + (1,) * (grid.dim - 1)) * area
        links.append(forward(np.moveaxis(faces * factor, 0, axis), axis, grid.periodic[axis]))
        cells = np.moveaxis(extra, axis, 0)
        for values, shift in ((line.below, -1), (line.above, 0)):
            for f in np.flatnonzero(values):
                cells[(f + shift) % cells.shape[0]] += values[f] * faces[f] * area
    return Stencil(grid, tuple(links), extra)


def _area(grid, axis):
    """Areas of the faces across an axis: one number where they are equal."""
    others = [h for other, h in enumerate(grid.widths) if other != axis]
    if grid.cells.size and all(np.all(h == h[0]) for h in others):
        return float(np.prod([h[0] for h in others]))
    return others[0][:, None] * others[1] if len(others) > 1 else others[0]


class Faces:
    """An operator shift + factor D diag(k) G whose coefficients are known, with k >= 0: it needs no probing.

    Parameters
    ----------
    grid : Grid
    lines : Lines of each axis
    k : array
        A field on the faces.
    factor, shift : float
    """

    def __init__(self, grid, lines, k, factor=1.0, shift=0.0):
        self.grid, self.lines, self.k, self.factor, self.shift = grid, lines, k, factor, shift
        self.smallest, self.largest = float(k.min()), float(k.max())
        self.sizes = [
            float(np.max(np.abs(line.link)) + np.max(np.abs(line.below) + np.abs(line.above))) for line in lines
        ]

    @property
    def usable(self):
        """Whether it is what multigrid takes: links of the right sign, none below 0."""
        signed = [self.factor * part for line in self.lines for part in line]
        return 0 <= self.smallest <= self.largest < np.inf and all(np.all(v >= 0) for v in signed) and self.shift >= 0

    @property
    def connected(self):
        """Whether every cell is linked to all of its neighbours."""
        return self.smallest > 0 and self.grid.cells.size > 1 and all(map(np.all, self._between))

    @property
    def held(self):
        """Whether something holds the level, where `connected`."""
        return self.shift > 0 or any(np.any(line.below != 0) or np.any(line.above != 0) for line in self.lines)

    @property
    def _between(self):
        """The links of each axis without those of walls."""
        return [line.link if flag else line.link[1:-1] for line, flag in zip(self.lines, self.grid.periodic)]

    def within(self, exponent):
        """Whether |A|_inf is certainly between 2^-exponent and 2^exponent."""
        least = [np.min(np.abs(part)) / np.max(h) for part, h in zip(self._between, self.grid.widths) if part.size]
        low = abs(self.factor) * self.smallest * min(least, default=0.0)
        most = max(size / np.min(h) for size, h in zip(self.sizes, self.grid.widths))
        high = 8 * self.grid.dim * abs(self.factor) * self.largest * most + abs(self.shift)
        return 2.0**-exponent < low and high < 2.0**exponent

    def stencil(self):
        """The stencil, near 1."""
        areas = [np.max(_area(self.grid, axis), initial=0.0) for axis in range(self.grid.dim)]
        most = abs(self.factor) * self.largest * max(size * area for size, area in zip(self.sizes, areas))
        shift = self.shift * np.max(areas) if self.shift else 0.0
        scale = 2.0 ** -int(np.frexp(max(most, shift))[1])
        links = of_lines(self.lines, self.k, self.grid, scale * self.factor)
        if self.shift:
            links = links._replace(extra=links.extra + scale * self.shift * self.grid.volumes)
        return links._replace(scale=scale)


def faces_of(structure, grid, factor=1.0):
    """Structure -> Faces, or None where it is not of that kind."""
    if isinstance(structure, Scaled):
        found = faces_of(structure.inner, grid, factor * structure.factor)
    elif isinstance(structure, Chain) and structure.members[0].shape == (grid.cells.size, grid.faces.size):
        found = _faces(structure.members, grid, factor)
    elif hasattr(structure, "assembly"):  # shift - D diag(k) G
        D, G = structure.assembly.D.structure, structure.assembly.G.structure
        D, G = (G.transpose(), D.transpose()) if structure.transposed else (D, G)
        found = _faces((D, Diagonal(structure.k), G), grid, -factor, factor * structure.shift)
    else:
        return None
    return found if found is not None and found.usable else None


def _faces(members, grid, factor, shift=0.0):
    read = read_lines(members[0], members[1:-1], members[-1], grid)
    numbers = () if read is None else (factor, read[1], *(line.link for line in read[0]))
    if not numbers or any(np.iscomplexobj(values) for values in numbers) or not read[1].size:
        return None
    return Faces(grid, read[0], read[1], factor, shift)
