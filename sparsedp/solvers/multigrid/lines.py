"""The stencil of D diag(k) G where D and G are differences along the axes: read off their 1-D factors.

Along an axis, D has two entries for each face (one for each cell beside it), and so has G: four numbers a
face, which do not depend on the place along the other axes. Only k does.
"""

from math import prod
from typing import NamedTuple

import numpy as np

from sparsedp.solvers.multigrid.stencil import CLEAN, Stencil, Unfit, cleaned, forward
from sparsedp.structure.base import Scaled
from sparsedp.structure.kronecker import Kronecker
from sparsedp.structure.lazy import Chain, Diagonal
from sparsedp.structure.through import entries_beside

__all__ = ["faces_of"]


class Lines(NamedTuple):
    """For each face of an axis: the link, and what is left on the cells below and above, for k = 1."""

    link: np.ndarray
    below: np.ndarray
    above: np.ndarray


def _read_lines(left, middle, right, grid):
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


def _stencil(lines, k, grid, factor, shift):
    """Lines of each axis and one value for each face -> Stencil of shift + factor D diag(k) G."""
    links, extra = [], shift * grid.volumes
    widths = np.ix_(*grid.widths)
    for axis, faces in enumerate(grid.split(k)):
        area = factor * prod(h for other, h in enumerate(widths) if other != axis)
        link = lines[axis].link.reshape([-1 if a == axis else 1 for a in range(grid.dim)])
        links.append(forward(faces * (link * area), axis, grid.periodic[axis]))
        cells, faces, areas = (np.moveaxis(array, axis, 0) for array in (extra, faces, area))
        for values, beside in ((lines[axis].below, -1), (lines[axis].above, 0)):
            for f in np.flatnonzero(values):
                cells[(f + beside) % cells.shape[0]] += values[f] * faces[f] * areas[0]
    return Stencil(grid, links, extra)


def faces_of(structure, grid, factor=1.0):
    """Structure -> the Stencil of shift + factor D diag(k) G, or None where it is not of that kind."""
    if isinstance(structure, Scaled):
        return faces_of(structure.inner, grid, factor * structure.factor)
    if isinstance(structure, Chain) and structure.members[0].shape == (grid.cells.size, grid.faces.size):
        members, shift = structure.members, 0.0
    elif hasattr(structure, "assembly"):  # shift - D diag(k) G
        D, G = structure.assembly.D.structure, structure.assembly.G.structure
        D, G = (G.transpose(), D.transpose()) if structure.transposed else (D, G)
        members, shift, factor = (D, Diagonal(structure.k), G), factor * structure.shift, -factor
    else:
        return None
    lines, k = _read_lines(members[0], members[1:-1], members[-1], grid) or ((), np.zeros(0))
    if any(np.iscomplexobj(values) for values in (factor, k, *(line.link for line in lines))):
        return None
    if not k.size or not 0 <= k.min() <= k.max() < np.inf:
        return None
    try:
        return _stencil(lines, k, grid, factor, shift).checked()
    except Unfit:
        return None
