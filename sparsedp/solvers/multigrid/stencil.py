"""Stencil: a symmetric 5- or 7-point matrix on the cells of a grid; read off the products of an operator."""

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sparsedp._utils.validation import EPS
from sparsedp.operators.structure.base import Matrix
from sparsedp.solvers.scaling import exponent_of

__all__ = ["Stencil", "Unfit", "components", "faces_of", "stencil_of"]

CLEAN = 16 * EPS  # what is left of a diagonal is 0 below this share of the links at it
MOST_EXPONENT = 1000  # of a power of two that scales: 2^1024 is infinite
AGREES = 1e-12  # relative difference to the operator on a random field that is taken for rounding


class Unfit(Exception):
    """An operator is not a stencil; the message is the reason in words."""


class Stencil(NamedTuple):
    """S = scale V A, with V the cell volumes: (S x)_i = sum over neighbours of c (x_i - x_j) + extra_i x_i.

    Attributes
    ----------
    grid : Grid
        2-D or 3-D. Its lengths may be those of the user up to powers of two.
    links : list of arrays, one for each axis, shape `grid.shape`
        c >= 0 between each cell and the next one along the axis; in the last cell 0, or the link to the first one.
    extra : array, shape `grid.shape`
        >= 0: conductance to walls and Dirichlet obstacles, shift times volume.
    scale : float
        A power of two, or minus one.
    """

    grid: Any
    links: list
    extra: np.ndarray
    scale: float = 1.0

    def apply(self, x):
        """S x, for a field x."""
        out = self.extra * x
        for axis, c in enumerate(self.links):
            flux = c * (np.roll(x, -1, axis) - x)
            out += np.roll(flux, 1, axis) - flux
        return out

    @property
    def connected(self):
        """Whether every cell is linked to all of its neighbours."""
        size, grid = self.extra.size, self.grid
        whole = sum(size if flag and n > 1 else size - size // n for n, flag in zip(grid.shape, grid.periodic))
        return size > 1 and sum(map(np.count_nonzero, self.links)) == whole

    def within(self, exponent):
        """Whether |A|_inf is certainly between 2^-exponent and 2^exponent; where it is known to be near 1."""
        low, high = (abs(self.scale) * bound(self.grid.volumes) for bound in (np.max, np.min))
        return 0.5 / low > 2.0**-exponent and (4 * self.grid.dim + 1) / high < 2.0**exponent

    def checked(self):
        """The stencil times the number that makes it positive and near 1; refuses what multigrid cannot smooth."""
        values = np.array([array.flat[np.argmax(np.abs(array))] for array in (*self.links, self.extra) if array.size])
        sign = -1.0 if np.all(values <= 0) and np.any(values) else 1.0
        exponent = exponent_of(np.max(np.abs(values), initial=0.0))
        factor = sign * 2.0 ** -np.clip(exponent, -MOST_EXPONENT, MOST_EXPONENT)  # of subnormals: as near as it gets
        links, extra = [factor * c for c in self.links], factor * self.extra
        if any(np.any(c < 0) for c in links):
            raise Unfit("a face has a coefficient of the wrong sign")
        if np.any(extra < 0):
            raise Unfit("a row sums to less than 0: a shift of the wrong sign")
        return Stencil(self.grid, links, extra, factor * self.scale)


def components(stencil):
    """(labels, count) of the connected components; what is not active is linked to nothing. One: labels None."""
    number = np.arange(stencil.extra.size).reshape(stencil.extra.shape)
    pairs = [(number[c > 0], np.roll(number, -1, axis)[c > 0]) for axis, c in enumerate(stencil.links)]
    one, two = map(np.concatenate, zip(*pairs))
    graph = coo_array((np.ones(one.size), (one, two)), shape=(number.size, number.size))
    count, labels = connected_components(graph, directed=False)
    return (None, 1) if count == 1 else (labels, count)


def stencil_of(system):
    """System -> Stencil; raises Unfit with the reason in words."""
    grid = system.grid
    if grid is None:
        raise Unfit("it does not act on the cells of a grid")
    if grid.dim == 1:
        raise Unfit("the grid is 1-D")
    if system.faces is not None:
        return system.faces
    if not system.op.structure.has_entries or system.complex:
        raise Unfit("it is not made of differences over single faces")
    active = True if system.active is None else system.active.reshape(grid.shape)
    return _probed(system.product, grid, active)


def faces_of(op, grid):
    """The Stencil of an operator that takes less to apply than to assemble; else, or if it is none, None."""
    structure = op.structure
    if not op.domain.size or structure.separable or isinstance(structure, Matrix):
        return None
    if not structure.has_entries or op.dtype.kind == "c":
        return None
    try:
        return _probed(op._flat.apply, grid, True)
    except Unfit:
        return None


def _probed(product, grid, active):
    """Product with a matrix, cells that are unknowns -> Stencil, read off the images of a few fields of 0 and 1.

    Along an axis, the image of every fourth plane shows on its two sides the links to it, and nothing else. On a
    periodic axis plane 0 has a field of its own, for it is next to the last one. What has been read must then explain
    the image of a random field: the matrix is symmetric and has no other entries.
    """
    weights = active * grid.volumes

    def image(x):
        return weights * product(x.reshape(-1)).reshape(grid.shape)

    links, magnitude = [], np.zeros(grid.shape)  # of a row without its extra
    for axis, (n, flag) in enumerate(zip(grid.shape, grid.periodic)):
        link = np.zeros(grid.shape)
        to_next = np.moveaxis(link, axis, 0)
        end = 1 if flag else n  # of the planes in one field with plane 0
        for planes in filter(np.size, (np.arange(0, end, 4), np.arange(2, n, 4), np.arange(end + 3, n, 4))):
            x = np.zeros(grid.shape)
            np.moveaxis(x, axis, 0)[planes] = 1.0
            y, inner = np.moveaxis(image(x), axis, 0), planes[planes < n - 1]
            if np.any(y[planes[planes >= 4] - 2]):
                raise Unfit("a row reaches beyond the neighbours")
            to_next[planes - 1], to_next[inner] = -y[planes - 1], -y[inner + 1]
        if not flag or n <= 2:  # a wall; or the one neighbour is linked already, or is the cell itself
            to_next[-1:] = 0.0
        magnitude += 2.0 * (np.abs(link) + np.roll(np.abs(link), 1, axis))
        links.append(link)
    rows = image(np.ones(grid.shape))
    stencil = Stencil(grid, links, np.where(np.abs(rows) <= CLEAN * magnitude, 0.0, rows))
    x = np.random.default_rng(0).uniform(0.5, 1.5, grid.shape)
    if not np.all(np.abs(stencil.apply(x) - image(x)) <= AGREES * (magnitude + np.abs(rows))):
        raise Unfit("it is not a symmetric 5- or 7-point stencil")
    return stencil.checked()
