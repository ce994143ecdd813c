"""The stencil of D diag(k) G where D and G are differences along the axes: read off their 1-D factors.

Along an axis, D has two entries for each face (one for each cell beside it), and so has G: four numbers a
face, which do not depend on the place along the other axes. Only k does.
"""

from typing import NamedTuple

import numpy as np

from sparsedp.solvers.stencil import Stencil, cleaned
from sparsedp.structure.kronecker import Kronecker
from sparsedp.structure.lazy import Diagonal

__all__ = ["of_lines", "read_lines"]


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
    terms, slopes = left.blocks.get((0, axis), ()), right.blocks.get((axis, 0), ())
    if len(terms) != 1 or len(slopes) != 1 or terms[0].axes != (axis,) or slopes[0].axes != (axis,):
        return None
    n, faces = grid.shape[axis], grid.node_count(axis)
    areas = _beside(terms[0].factors[axis].T, terms[0].scale, n, faces, grid.periodic[axis])
    slopes = _beside(slopes[0].factors[axis], slopes[0].scale, n, faces, grid.periodic[axis])
    if areas is None or slopes is None:
        return None
    (d_below, d_above), (g_below, g_above), h = areas, slopes, grid.widths[axis]
    d_below, d_above = d_below * np.take(h, np.arange(faces) - 1, mode="wrap"), d_above * np.append(h, h)[:faces]
    linked = (g_below != 0) & (g_above != 0)
    link = np.where(linked, -0.5 * (d_below * g_above + d_above * g_below), 0.0)
    size = np.abs(link)
    return Lines(link, cleaned(d_below * g_below - link, size), cleaned(d_above * g_above - link, size))


def _beside(factor, scale, n, faces, periodic):
    """A factor from cells to faces -> its entries for the cell below and the cell above each face, or None."""
    m = factor.matrix
    row = np.repeat(np.arange(faces), np.diff(m.indptr))
    below, above = np.zeros(faces), np.zeros(faces)
    is_above = m.indices == row
    is_below = (m.indices == row - 1) | (periodic & (row == 0) & (m.indices == n - 1))
    if not np.all(is_above ^ is_below):  # further cells; or one periodic cell, on both sides of its face
        return None
    above[row[is_above]], below[row[is_below]] = scale * m.data[is_above], scale * m.data[is_below]
    return below, above


def of_lines(lines, k, grid):
    """Lines of each axis and one value for each face -> Stencil of V D diag(k) G."""
    links, extra = [], np.zeros(grid.shape)
    for axis, part in enumerate(grid.split(k)):
        line, faces = lines[axis], np.moveaxis(part, axis, 0)
        area = np.take(np.moveaxis(grid.volumes, axis, 0), 0, 0) / grid.widths[axis][0]
        if area.size and np.all(area == area.flat[0]):
            area = area.flat[0]
        links.append(np.moveaxis(_along(line.link, faces) * area, 0, axis))
        cells = np.moveaxis(extra, axis, 0)
        for values, shift in ((line.below, -1), (line.above, 0)):
            for f in np.flatnonzero(values):
                cells[(f + shift) % cells.shape[0]] += values[f] * faces[f] * area
    return Stencil(grid, tuple(links), extra)


def _along(line, faces):
    """line[f] * faces[f, ...]."""
    if line.size > 2 and np.all(line[1:-1] == line[1]):  # equal cells: one number, and the two ends
        out = faces * line[1]
        out[0], out[-1] = faces[0] * line[0], faces[-1] * line[-1]
        return out
    return faces * line.reshape((-1,) + (1,) * (faces.ndim - 1))
