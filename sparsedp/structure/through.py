"""Products L diag(k) R with faces between cells, in one pass: the differences of the catalogue, and their likes."""

import numpy as np

from sparsedp import kernels
from sparsedp.structure.base import rows_of
from sparsedp.structure.kronecker import Kronecker

__all__ = ["ThroughFaces", "entries_beside", "through_faces"]


def entries_beside(left, right, axis, n, periodic):
    """Entries of L (cells <- faces) and of R (faces <- cells) at each face across an axis, for the cells beside it.

    Parameters
    ----------
    left, right : Kronecker
    axis, n : int
        n cells along the axis.
    periodic : bool

    Returns
    -------
    ((r_below, r_above), (l_below, l_above)), arrays of one number for each face, or None
        None where another axis, a second term or a further cell takes part.
    """
    terms, slopes = left.blocks.get((0, axis), ()), right.blocks.get((axis, 0), ())
    if len(terms) != 1 or len(slopes) != 1 or terms[0].axes != (axis,) or slopes[0].axes != (axis,):
        return None
    faces = n if periodic else n + 1
    there = _beside(slopes[0].factors[axis], slopes[0].scale, n, faces, periodic)
    back = _beside(terms[0].factors[axis].T, terms[0].scale, n, faces, periodic)
    return None if there is None or back is None else (there, back)


def _beside(factor, scale, n, faces, periodic):
    """A factor from cells to faces -> its entries for the cell below and the cell above each face, or None."""
    m = factor.matrix
    row = rows_of(m)
    below, above = np.zeros(faces), np.zeros(faces)
    is_above = m.indices == row
    is_below = (m.indices == row - 1) | (periodic & (row == 0) & (m.indices == n - 1))
    if not np.all(is_above ^ is_below):  # further cells; or one periodic cell, on both sides of its face
        return None
    above[row[is_above]], below[row[is_below]] = scale * m.data[is_above], scale * m.data[is_below]
    return below, above


class ThroughFaces:
    """L diag(k) R on fields of float64.

    Parameters
    ----------
    shape : tuple
        Of the cells, in 2-D or 3-D.
    lines : four arrays for each axis
        Entries of R for the cells below and above each face, then those of L.
    k : array
        A number for each face.
    closed : bool
        Whether faces with k = 0 carry 0, whatever the cells hold.
    """

    def __init__(self, shape, lines, k, closed):
        self.closed, none = closed, np.zeros((0, 0, 0))
        counts = [n + (line[0].size > n) for n, line in zip(shape, lines)]
        sizes = [(*shape[:axis], count, *shape[axis + 1 :]) for axis, count in enumerate(counts)]
        pieces = np.split(k, np.cumsum([np.prod(size, dtype=int) for size in sizes])[:-1])
        parts, lines = [part.reshape(size) for part, size in zip(pieces, sizes)], [tuple(line) for line in lines]
        if len(shape) == 2:
            shape, lines = (shape[0], 1, shape[1]), [lines[0], (np.zeros(1),) * 4, lines[1]]
            parts = [parts[0][:, None], none, parts[1][:, None]]
        self.shape, self.parts = shape, tuple(parts)
        ends = [side for line in lines for side in line]
        cells = np.repeat(shape, 4)
        wide = [np.append(side, side[0]) if side.size == n else side for n, side in zip(cells, ends)]
        self.lines = tuple(np.stack(wide[4 * axis : 4 * axis + 4]) for axis in range(3))

    def apply(self, x, out):
        """Write the product into `out` -> whether it could be done."""
        fields, rows = (
            (x.reshape(self.shape), *self.parts, *self.lines, out.reshape(self.shape)),
            np.prod(self.shape[:2]),
        )
        return kernels.run("stencil", "through_faces", rows, x.size, kernels.threads(), *fields, self.closed)


def through_faces(left, middle, right):
    """Structures L (faces -> cells), the diagonals between, R (cells -> faces) -> ThroughFaces, or None."""
    if not (isinstance(left, Kronecker) and isinstance(right, Kronecker) and middle):
        return None
    if len(right.in_parts) != 1 or left.out_parts != right.in_parts or left.in_parts != right.out_parts:
        return None
    shape = right.in_parts[0]
    if len(shape) not in (2, 3) or len(left.in_parts) != len(shape) or min(shape) < 2:
        return None
    lines = [_line(left, right, shape, axis) for axis in range(len(shape))]
    if any(line is None for line in lines):
        return None
    closed = [hasattr(member, "keep") for member in middle]
    if any(closed) and not all(one or np.all(member.values != 0) for one, member in zip(closed, middle)):
        return None  # 0 times NaN is NaN for some of the zeros, and 0 for others
    k = middle[0].values
    for member in middle[1:]:
        k = k * member.values
    return ThroughFaces(shape, lines, k, any(closed)) if k.dtype == float else None


def _line(left, right, shape, axis):
    """Entries of R and of L at the faces across an axis; None where they are not of that kind."""
    n, faces = shape[axis], right.out_parts[axis][axis]
    if faces not in (n, n + 1) or right.out_parts[axis] != (*shape[:axis], faces, *shape[axis + 1 :]):
        return None
    found = entries_beside(left, right, axis, n, faces == n)
    if found is None:
        return None
    (there, back), inner = found, slice(1, n)
    whole = all(np.all(side[inner] != 0) for side in (*there, *back))  # else what is not read could be NaN
    return (*there, *back) if whole else None
