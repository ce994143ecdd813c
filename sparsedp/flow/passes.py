"""The two passes of a projection: b = D K x, the net flow out of the cells, and K (x + G p).

K closes faces; along each axis D and G are 1-D matrices with two entries in a row. The transposed projection has the
same form, with G^T in the place of D and D^T in that of G.
"""

from math import sqrt

import numpy as np

from sparsedp import kernels
from sparsedp.operators.structure.lazy import face_entries
from sparsedp.solvers.scaling import norm

__all__ = ["Passes", "Products"]


class Products:
    """The passes by the operators themselves.

    Parameters
    ----------
    first, second : Structure
        What takes the faces to the cells, and back.
    kept : array
        K: 0 on closed faces, else 1.
    """

    def __init__(self, first, second, kept):
        self.first, self.second, self.kept = first, second, kept

    def net_flow(self, x, b):
        """b = D K x; the norms of b and of x."""
        with np.errstate(invalid="ignore"):
            self.first.apply(self.kept * x, b)
        return norm(b), norm(x)

    def push(self, x, p, out):
        """out = K (x + G p)."""
        self.second.apply(p, out)
        out += x
        out *= self.kept


class Passes:
    """The same without obstacles, compiled.

    Parameters
    ----------
    grid : Grid
    lines : list of (kept, entries) for each axis
        The faces along the axis that are not closed; for each face what it takes from the cells below and above it, and
        what it gives to them, 0 where it is closed.
    loops : module
        kernels/projection.py, which needs numba.
    """

    def __init__(self, grid, lines, loops):
        self.loops = loops
        missing = 3 - grid.dim  # axes beside those of the grid, without faces
        self.cells = (1,) * missing + grid.shape
        self.parts = [(slice(0), (0, 0, 0))] * missing
        self.inward, self.outward = ([np.zeros((rows, 0))] * missing for rows in (2, 3))
        for axis, (kept, entries) in enumerate(lines):
            self.parts.append((slice(*grid.faces.offsets[axis : axis + 2]), (1,) * missing + grid.face_shape(axis)))
            below, above, down, up = entries
            self.inward.append(np.stack([up[:-1], down[1:]]))  # of each cell, from its lower and its upper face
            self.outward.append(np.stack([kept, below[: kept.size], above[: kept.size]]))

    def _components(self, x):
        return [x[part].reshape(shape) for part, shape in self.parts]

    def net_flow(self, x, b):
        """b = D K x; the norms of b and of x."""
        components, cells = self._components(x), b.reshape(self.cells)
        flow, size = self.loops.net_flow.compiled(x, *components, *self.inward, cells, 0, self.cells[0])
        return sqrt(flow), sqrt(size)

    def push(self, x, p, out):
        """out = K (x + G p)."""
        before, after = self._components(x), self._components(out)
        self.loops.push.compiled(*before, p.reshape(self.cells), *self.outward, *after, 0, 1)


def compiled(grid, products):
    """The Passes that do what the products do; None without numba, or where an axis has entries of another kind."""
    if not kernels.compiled():
        return None
    from sparsedp.kernels import projection

    lines = []
    for axis, faces in enumerate(grid.faces.split(products.kept)):
        n = grid.shape[axis]
        kept = np.moveaxis(faces, axis, -1).reshape(-1, faces.shape[axis])[0]  # without obstacles all lines are equal
        entries = face_entries(products.first, products.second, axis, n)
        if entries is None:
            return None
        lines.append((kept, entries * np.resize(kept, n + 1)))  # the last face of a periodic axis is the first
    return Passes(grid, lines, projection) if projection.net_flow.compiled else None
