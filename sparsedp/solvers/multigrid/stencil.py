"""Stencil: a symmetric 5- or 7-point matrix on the cells of a grid; read off the entries of an operator."""

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

__all__ = ["CLEAN", "Stencil", "Unfit", "cleaned", "components", "forward", "stencil_of"]

CLEAN = 16 * np.finfo(float).eps  # what is left of a diagonal is 0 below this share of the links at it
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
        factor = sign * 2.0 ** -int(np.frexp(np.max(np.abs(values), initial=0.0))[1])
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


def cleaned(extra, total):
    """Set to 0 what is rounding, compared with the magnitudes that it is the sum of."""
    return np.where(np.abs(extra) <= CLEAN * total, 0.0, extra)


def forward(faces, axis, periodic):
    """A field on the faces across an axis -> for each cell that of the face to the next one; 0 for a wall."""
    faces = np.roll(faces, -1, axis) if periodic else np.delete(faces, 0, axis)
    if not periodic or faces.shape[axis] == 1:  # a cell is not linked to itself
        np.moveaxis(faces, axis, 0)[-1:] = 0.0
    return faces


def stencil_of(system):
    """System -> Stencil; raises Unfit with the reason in words."""
    grid, structure = system.grid, system.op.structure
    if grid is None:
        raise Unfit("it does not act on the cells of a grid")
    if grid.dim == 1:
        raise Unfit("the grid is 1-D")
    if system.faces is not None:
        return system.faces
    if not structure.has_entries or system.complex:
        raise Unfit("it is not made of differences over single faces")
    active = np.ones(grid.shape, bool) if system.active is None else system.active.reshape(grid.shape)
    stencil = _of_entries(system, system.entries, active).checked()
    x, volumes = active * np.random.default_rng(0).uniform(0.5, 1.5, grid.shape), grid.volumes
    wanted = volumes * system.product(x.reshape(-1)).reshape(grid.shape)
    size = 1.5 * volumes * system.sums[False].reshape(grid.shape)
    if np.any(np.abs(stencil.apply(x) / stencil.scale - wanted)[active] > AGREES * size[active]):
        raise Unfit("it is not a symmetric 5- or 7-point stencil")
    return stencil


def _of_entries(system, matrix, active):
    """The stencil of volumes times a matrix, of any sign, from the diagonals on which neighbours are."""
    grid, volumes, size = system.grid, system.grid.volumes, system.size
    links, used, pitch = [], np.count_nonzero(matrix.diagonal()), size
    for axis, (n, flag) in enumerate(zip(grid.shape, grid.periodic)):
        pitch //= n
        ends = np.arange(n).reshape([-1 if a == axis else 1 for a in range(grid.dim)]) == n - 1
        total = np.zeros(grid.shape)
        # the distance of the next cell, and of the first one from the last; of two cells it is the same one
        for far, place in ((pitch, ~ends), *([((1 - n) * pitch, ends)] if flag and n > 2 else [])):
            for sign in (1, -1):
                entries = np.zeros(size)
                start = max(0, -far)
                diagonal = matrix.diagonal(sign * far)
                entries[start : start + diagonal.size] = diagonal
                here = np.where(place, entries.reshape(grid.shape), 0.0)
                used += np.count_nonzero(here)
                total += here if sign > 0 else 0.0
        links.append(np.where(active & np.roll(active, -1, axis), -volumes * total, 0.0))
    if used != np.count_nonzero(matrix.data):
        raise Unfit("a row reaches beyond the neighbours")
    rows = volumes * system.product(np.ones(size)).reshape(grid.shape)
    return Stencil(grid, links, cleaned(rows, volumes * system.sums[False].reshape(grid.shape)))
