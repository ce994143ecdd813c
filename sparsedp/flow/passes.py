"""The two passes of a projection: b = D K x, the net flow out of the cells, and K (x + G p).

K closes faces; along each axis D and G are 1-D matrices with two entries in a row. The transposed projection has the
same form, with G^T in the place of D and D^T in that of G.
"""

from math import sqrt

import numpy as np
import scipy.sparse as sp

from sparsedp.kernels import projection
from sparsedp.solvers.scaling import largest, norm

__all__ = ["Passes", "Products"]

EPS = np.finfo(float).eps


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
    products : Products
        Of operators that are blocks of 1-D factors; on each axis all faces of a line are closed, or none.
    """

    def __init__(self, grid, products):
        missing = 3 - grid.dim  # axes beside those of the grid, without faces
        self.cells = (1,) * missing + grid.shape
        self.parts = [(slice(0), (0, 0, 0))] * missing
        self.inward, self.outward = ([np.zeros((rows, 0))] * missing for rows in (2, 3))
        for place, faces in enumerate(grid.faces.split(products.kept), missing):
            axis = place - missing
            line = np.moveaxis(faces, axis, -1).reshape(-1, faces.shape[axis])[0]
            shape = tuple(line.size if a == place else n for a, n in enumerate(self.cells))
            n, m = grid.shape[axis], line.size
            lines = _line(products.first, (0, axis), (n, m)), _line(products.second, (axis, 0), (m, n))
            self.parts.append((slice(*grid.faces.offsets[axis : axis + 2]), shape))
            for kept, found in zip((self.inward, self.outward), _coefficients(*lines, line), strict=True):
                kept.append(found)

    def _components(self, x):
        return [x[part].reshape(shape) for part, shape in self.parts]

    def net_flow(self, x, b):
        """b = D K x; the norms of b and of x."""
        components, cells = self._components(x), b.reshape(self.cells)
        flow, size = projection.net_flow.compiled(x, *components, *self.inward, cells, 0, self.cells[0])
        return sqrt(flow), sqrt(size)

    def push(self, x, p, out):
        """out = K (x + G p)."""
        given, found = self._components(x), self._components(out)
        projection.push.compiled(*given, p.reshape(self.cells), *self.outward, *found, 0, 1)

    def agrees(self, products):
        """Whether they are those passes, to rounding.

        Linear maps that agree on random fields agree everywhere: the residual of a solve, which the passes take, is
        then that of the operators themselves.
        """
        generator = np.random.default_rng(0)
        x, p = generator.random(products.kept.size), generator.random(np.prod(self.cells))
        flows, faces = np.empty((2, p.size)), np.empty((2, x.size))
        for passes, flow, out in zip((self, products), flows, faces, strict=True):
            passes.net_flow(x, flow)
            passes.push(x, p, out)
        return all(largest(one - two) <= 256 * EPS * (1.0 + largest(two)) for one, two in (flows, faces))


def _line(op, block, shape):
    """The 1-D matrix of a block; one that is missing is 0: the slope along one closed cell."""
    terms = op.blocks.get(block)
    return terms[0].factors[max(block)].scaled(terms[0].scale).matrix if terms else sp.csr_array(shape)


def _coefficients(inward, outward, kept):
    """What a cell takes from its lower and upper face, and (kept, below, above): what a face takes from x and p."""
    n, m = inward.shape
    cell, face = np.arange(n), np.arange(m)
    lower, upper = inward[cell, cell] * kept[cell], inward[cell, (cell + 1) % m] * kept[(cell + 1) % m]
    below, above = outward[face, (face - 1) % n] * kept, outward[face, face % n] * kept
    if m > n:  # the wall faces have a cell on one side only
        below[0] = above[-1] = 0.0
    return np.stack([lower, upper]), np.stack([kept, below, above])
