"""The two passes of a projection without obstacles, each one loop over memory: D K v, and K v + G p.

    b[i] = upper[i] v[i + 1] + lower[i] v[i]              summed over the axes
    w[i] = keep[i] v[i] + below[i] p[i - 1] + above[i] p[i]

with one coefficient for each cell (face) along its axis. The transposed projection has the same form,
with the coefficients of G^T and K D^T.
"""

from math import sqrt

import numpy as np
import scipy.sparse as sp

from sparsedp.kernels import passes

__all__ = ["Passes"]


class Passes:
    """Coefficients along the axes, and the passes with them, on flat float64 arrays.

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
        pad = 3 - grid.dim
        cells, faces = (1,) * pad + grid.shape, (0,) * pad + tuple(free.size for free in open_faces)
        self.shape = cells + faces
        self.cells, self.faces = np.zeros((2, sum(cells))), np.zeros((3, sum(faces)))
        ends = np.cumsum(cells), np.cumsum(faces)
        for axis, (n, free) in enumerate(zip(grid.shape, open_faces, strict=True)):
            pair = _factor(D, (0, axis), (n, free.size)), _factor(G, (axis, 0), (free.size, n))
            lines = _lines(*pair, free, transposed)
            for table, some, stop in zip((self.cells, self.faces), (lines[:2], lines[2:]), ends, strict=True):
                table[:, stop[pad + axis] - some[0].size : stop[pad + axis]] = some

    def net_flow(self, x, b):
        """b = D K x; the norms of b and of x."""
        flow, whole = passes.net_flow(x, self.shape, self.cells, b)
        return sqrt(flow), sqrt(whole)

    def push(self, x, p, out):
        """out = K x + G p."""
        passes.push(x, p, self.shape, self.faces, out)


def _factor(op, block, shape):
    """The matrix along the axis of a component; a block that is missing is 0: the slope along one closed cell."""
    terms = op.structure.blocks.get(block, ())
    return terms[0].factors[max(block)].scaled(terms[0].scale).matrix if terms else sp.csr_array(shape)


def _lines(D, G, free, transposed):
    """Factors of one axis -> (lower, upper) for cells, (keep, below, above) for faces."""
    n, m = D.shape
    cell, face, zero = np.arange(n), np.arange(m), np.zeros(m)
    lower, upper = np.asarray(D[cell, cell]), np.asarray(D[cell, (cell + 1) % m])
    above, below = zero.copy(), np.asarray(G[face, (face - 1) % n])
    above[:n] = G[cell, cell]
    if m > n:  # the wall faces have a cell on one side only
        below[0] = 0.0
        above[-1] = 0.0
    if transposed:
        turned = zero.copy(), zero.copy()
        turned[0][:n] = lower
        turned[1][(cell + 1) % m] = upper
        return above[:n], below[(cell + 1) % m], free * 1.0, turned[1] * free, turned[0] * free
    return lower * free[:n], upper * free[(cell + 1) % m], free * 1.0, below, above
