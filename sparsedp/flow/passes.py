"""The two passes of a projection without obstacles, each one loop over memory: D K v, and K v + G p.

    b[i] = upper[i] v[i + 1] + lower[i] v[i]              summed over the axes
    w[i] = keep[i] v[i] + below[i] p[i - 1] + above[i] p[i]

with one coefficient for each cell (face) along its axis. The transposed projection has the same form,
with the coefficients of G^T and K D^T.
"""

from math import sqrt

import numpy as np

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
        for axis, free in enumerate(open_faces):
            lines = _lines(_factor(D, (0, axis), axis), _factor(G, (axis, 0), axis), free, transposed)
            for table, some, stop in zip((self.cells, self.faces), (lines[:2], lines[2:]), ends, strict=True):
                table[:, stop[pad + axis] - some[0].size : stop[pad + axis]] = some

    def net_flow(self, x, b):
        """b = D K x; the norms of b and of x."""
        flow, whole = passes.net_flow(x, self.shape, self.cells, b)
        return sqrt(flow), sqrt(whole)

    def push(self, x, p, out):
        """out = K x + G p."""
        passes.push(x, p, self.shape, self.faces, out)


def _factor(op, block, axis):
    terms = op.structure.blocks.get(block, ())
    return terms[0].factors[axis].scaled(terms[0].scale).matrix if terms else None


def _lines(D, G, free, transposed):
    """Factors of one axis -> (lower, upper) for cells, (keep, below, above) for faces."""
    m, n = free.size, free.size if D is None else D.shape[0]
    cell, face = np.arange(n), np.arange(m)
    zero = np.zeros(m)
    if D is None or G is None:  # one periodic cell: what leaves comes in
        return zero[:n], zero[:n], free * 1.0, zero, zero
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
