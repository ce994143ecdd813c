"""The two passes of a projection without obstacles: b = D K x, the net flow out of the cells, and K x + G p.

K closes faces; along each axis D K and G are sparse 1-D matrices with two entries in a row. The transposed projection
has the same form, with G^T in the place of D K and K D^T in that of G.
"""

from math import prod, sqrt

import numpy as np
import scipy.sparse as sp

from sparsedp import kernels
from sparsedp.kernels import projection
from sparsedp.solvers.scaling import norm
from sparsedp.structure.factor import Factor

__all__ = ["Passes"]


class Passes:
    """The passes on flat float64 arrays: compiled, or axis by axis where the loops do not work.

    Parameters
    ----------
    grid : Grid
    D, G : Operator
        Divergence and gradient made of factors.
    open_faces : list of bool arrays
        For each axis, which faces along it are not closed.
    transposed : bool
    """

    def __init__(self, grid, D, G, open_faces, transposed):
        self.cells, self.axes, start = (1,) * (3 - grid.dim) + grid.shape, [], 0
        for axis, (n, free) in enumerate(zip(grid.shape, open_faces, strict=True)):
            pair = _factor(D, (0, axis), (n, free.size)), _factor(G, (axis, 0), (free.size, n))
            before, after = prod(grid.shape[:axis]), prod(grid.shape[axis + 1 :])
            stop = start + before * free.size * after
            shapes = (before, free.size, after), (before, n, after)
            factors = [Factor(matrix) for matrix in _matrices(*pair, free, transposed)]
            self.axes.append((slice(start, stop), *shapes, *factors, free * 1.0))
            start = stop
        missing = [(slice(0), (0, 0, 0), np.zeros((2, 0)), np.zeros((3, 0)))] * (3 - grid.dim)
        self.parts = missing + [self._lines(place, *axis) for place, axis in enumerate(self.axes, 3 - grid.dim)]

    def _lines(self, place, part, faces, cells, inward, outward, free):
        """Where a component is, its shape in three axes, and its coefficients for the loops."""
        shape = tuple(faces[1] if axis == place else n for axis, n in enumerate(self.cells))
        (n, m), cell, face = inward.shape, np.arange(cells[1]), np.arange(faces[1])
        inward, outward = inward.matrix, outward.matrix
        below, above = np.asarray(outward[face, (face - 1) % n]), np.asarray(outward[face, face % n])
        if m > n:  # the wall faces have a cell on one side only
            below[0] = above[-1] = 0.0
        lower, upper = np.asarray(inward[cell, cell]), np.asarray(inward[cell, (cell + 1) % m])
        return part, shape, np.stack([lower, upper]), np.stack([free, below, above])

    def net_flow(self, x, b):
        """b = D K x; the norms of b and of x."""
        if kernels.compiled() and projection.net_flow.compiled:
            components = [x[part].reshape(shape) for part, shape, _, _ in self.parts]
            lines = [line for _, _, line, _ in self.parts]
            sums = projection.net_flow.compiled(x, *components, *lines, b.reshape(self.cells), 0, self.cells[0])
            return sqrt(sums[0]), sqrt(sums[1])
        for number, (part, faces, cells, inward, *_) in enumerate(self.axes):
            kernels.along_axis(x[part].reshape(faces), b.reshape(cells), inward.rows, 1.0, number > 0)
        return norm(b), norm(x)

    def push(self, x, p, out):
        """out = K x + G p."""
        if kernels.compiled() and projection.push.compiled:
            given, found = ([array[part].reshape(shape) for part, shape, _, _ in self.parts] for array in (x, out))
            lines = [line for *_, line in self.parts]
            projection.push.compiled(*given, p.reshape(self.cells), *lines, *found, 0, 1)
            return
        for part, faces, cells, _, outward, free in self.axes:
            np.multiply(x[part].reshape(faces), free[:, None], out=out[part].reshape(faces))
            kernels.along_axis(p.reshape(cells), out[part].reshape(faces), outward.rows, 1.0, True)


def _factor(op, block, shape):
    """The matrix along the axis of a component; a block that is missing is 0: the slope along one closed cell."""
    terms = op.structure.blocks.get(block, ())
    return terms[0].factors[max(block)].scaled(terms[0].scale).matrix if terms else sp.csr_array(shape)


def _matrices(D, G, free, transposed):
    """What takes the faces along one axis to the cells, and back."""
    open_only = sp.diags_array(free * 1.0)
    return (G.T, open_only @ D.T) if transposed else (D @ open_only, G)
