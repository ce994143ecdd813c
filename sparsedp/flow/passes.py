"""The two passes of a projection without obstacles, each one loop over memory: D K v, and K v + G p.

    b[i] = upper[i] v[i + 1] + lower[i] v[i]              summed over the axes
    w[i] = keep[i] v[i] + below[i] p[i - 1] + above[i] p[i]

with one coefficient for each cell (face) along its axis. The transposed projection has the same form,
with the coefficients of G^T and K D^T.
"""

import numpy as np

from sparsedp.kernels import passes

__all__ = ["Passes"]


class Passes:
    """Coefficients along the axes, and the passes with them.

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
        self.cells = (1,) * pad + grid.shape
        self.spans: list = [None] * pad
        self.spans += [
            (start, stop, (1,) * pad + part)
            for start, stop, part in zip(grid.faces.offsets, grid.faces.offsets[1:], grid.faces.parts, strict=False)
        ]
        none = np.zeros(0)
        table: list[list] = [[none] * 3 for _ in range(5)]
        for axis, free in enumerate(open_faces):
            lines = _lines(_factor(D, (0, axis), axis), _factor(G, (axis, 0), axis), free, transposed)
            for column, line in zip(table, lines, strict=True):
                column[pad + axis] = np.ascontiguousarray(line)
        self.lower, self.upper, self.keep, self.below, self.above = map(tuple, table)

    def _parts(self, x):
        return [np.zeros((0, 0, 0)) if span is None else x[span[0] : span[1]].reshape(span[2]) for span in self.spans]

    def net_flow(self, x, b):
        """b = D K x, and its norm."""
        return float(np.sqrt(passes.net_flow(self._parts(x), self.lower, self.upper, b.reshape(self.cells))))

    def push(self, x, p, out):
        """out = K x + G p."""
        p, pairs = p.reshape(self.cells), zip(self._parts(x), self._parts(out), strict=True)
        for axis, (given, found) in enumerate(pairs):
            if given.size:
                passes.push(given, p, self.keep, self.below, self.above, axis, found)


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
