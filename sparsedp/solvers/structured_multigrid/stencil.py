"""Symmetric 5- and 7-point stencils on the cells of a grid, identified by products with an operator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sparsedp._utils.validation import EPS
from sparsedp.operators.structure.base import Matrix
from sparsedp.solvers.scaling import exponent_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.operators.operator import Operator

__all__ = ["Stencil", "UnsuitableOperator", "component_labels", "stencil_of_system", "stencil_without_entries"]

ROW_SUM_ROUNDING = 16 * EPS  # a row sum below this share of the magnitudes in its row is 0
LARGEST_EXPONENT = 1000  # of a power of two that scales: 2^1024 is infinite
AGREEMENT = 1e-12  # largest relative difference between stencil and operator that counts as rounding


class UnsuitableOperator(Exception):
    """An operator is not a symmetric 5- or 7-point stencil; the message says why."""


class Stencil(NamedTuple):
    """S = scale V A, V the cell volumes: (S x)_i = sum over neighbours j of c_ij (x_i - x_j) + extra_i x_i.

    Attributes
    ----------
    grid : Grid
        2-D or 3-D. Its lengths may differ from those of the user's grid by powers of two.
    links : list of arrays, one for each axis, shape `grid.shape`
        c >= 0 between each cell and the next one along the axis. The last cell holds 0, or, along a periodic axis,
        the link to the first one.
    extra : array, shape `grid.shape`
        Row sums, >= 0: conductance to walls and Dirichlet obstacles, and shift times volume.
    scale : float
        A power of two, or minus a power of two.
    """

    grid: Grid
    links: list[NDArray[Any]]
    extra: NDArray[Any]
    scale: float = 1.0

    def apply(self, x: NDArray[Any]) -> NDArray[Any]:
        """Return S x for a field x."""
        out = self.extra * x
        for axis, c in enumerate(self.links):
            flux = c * (np.roll(x, -1, axis) - x)
            out += np.roll(flux, 1, axis) - flux
        return out

    @property
    def connected(self) -> bool:
        """Whether every cell is linked to all of its neighbours."""
        size = self.extra.size
        if size <= 1:
            return False
        possible_links = 0
        for n, periodic in zip(self.grid.shape, self.grid.periodic):
            possible_links += size if periodic and n > 1 else size - size // n
        return sum(map(np.count_nonzero, self.links)) == possible_links

    def within(self, exponent: int) -> bool:
        """Whether |A|_inf certainly lies between 2^-exponent and 2^exponent; for a stencil scaled by `scaled`."""
        largest_factor = abs(self.scale) * np.max(self.grid.volumes)
        smallest_factor = abs(self.scale) * np.min(self.grid.volumes)
        largest_row_sum = 4 * self.grid.dim + 1
        return 0.5 / largest_factor > 2.0**-exponent and largest_row_sum / smallest_factor < 2.0**exponent

    def scaled(self) -> Stencil:
        """Return the stencil times the power of two, of either sign, that makes it positive and near 1.

        Raises
        ------
        UnsuitableOperator
            If coefficients differ in sign: multigrid cannot smooth such an operator.
        """
        coefficients = (*self.links, self.extra)
        largest = np.array([array.flat[np.argmax(np.abs(array))] for array in coefficients if array.size])
        sign = -1.0 if np.all(largest <= 0) and np.any(largest) else 1.0
        exponent = exponent_of(np.max(np.abs(largest), initial=0.0))
        # Subnormal coefficients cannot be scaled up to 1 by one power of two.
        factor = sign * 2.0 ** -np.clip(exponent, -LARGEST_EXPONENT, LARGEST_EXPONENT)
        links = [factor * c for c in self.links]
        extra = factor * self.extra
        if any(np.any(c < 0) for c in links):
            raise UnsuitableOperator("a face has a coefficient of the wrong sign")
        if np.any(extra < 0):
            raise UnsuitableOperator("a row sums to less than 0: a shift of the wrong sign")
        return Stencil(self.grid, links, extra, factor * self.scale)


def component_labels(stencil: Stencil) -> tuple[NDArray[Any] | None, int]:
    """Find the connected components of the cells.

    Parameters
    ----------
    stencil : Stencil

    Returns
    -------
    labels : int array, shape (cells,), or None
        None where there is one component.
    count : int
    """
    number = np.arange(stencil.extra.size).reshape(stencil.extra.shape)
    cells = []
    neighbours = []
    for axis, c in enumerate(stencil.links):
        is_linked = c > 0
        cells.append(number[is_linked])
        neighbours.append(np.roll(number, -1, axis)[is_linked])
    row = np.concatenate(cells)
    column = np.concatenate(neighbours)
    graph = coo_array((np.ones(row.size), (row, column)), shape=(number.size, number.size))
    count, labels = connected_components(graph, directed=False)
    if count == 1:
        return None, 1
    return labels, count


def stencil_of_system(system: Any) -> Stencil:
    """Return the stencil of the operator of a `System`.

    Raises
    ------
    UnsuitableOperator
        If the operator is not a symmetric 5- or 7-point stencil.
    """
    grid = system.grid
    if grid is None:
        raise UnsuitableOperator("it does not act on the cells of a grid")
    if grid.dim == 1:
        raise UnsuitableOperator("the grid is 1-D")
    if system.faces is not None:
        return system.faces
    if not system.op.structure.has_entries or system.complex:
        raise UnsuitableOperator("it is not a sum of differences between neighbouring cells")
    active = True if system.active is None else system.active.reshape(grid.shape)
    return _probe(system.product, grid, active)


def stencil_without_entries(op: Operator, grid: Grid) -> Stencil | None:
    """Return the stencil of an operator that is cheaper to apply than to assemble; None of any other operator."""
    structure = op.structure
    if not op.domain.size or structure.separable or isinstance(structure, Matrix):
        return None
    if not structure.has_entries or op.dtype.kind == "c":
        return None
    try:
        return _probe(op._flat.apply, grid, True)
    except UnsuitableOperator:
        return None


def _probe(product, grid, active):
    """Read a stencil off the products of a matrix with a few fields of zeros and ones.

    The result is verified by the product with a random field: it agrees only if the matrix, with its rows scaled by
    the cell volumes, is symmetric and has no other entries.
    """
    weights = active * grid.volumes

    def apply(x):
        return weights * product(x.reshape(-1)).reshape(grid.shape)

    links = []
    magnitude = np.zeros(grid.shape)  # of the entries of each row, without its extra
    for axis in range(grid.dim):
        link = _probe_axis(apply, grid, axis)
        magnitude += 2.0 * (np.abs(link) + np.roll(np.abs(link), 1, axis))
        links.append(link)
    row_sums = apply(np.ones(grid.shape))
    extra = np.where(np.abs(row_sums) <= ROW_SUM_ROUNDING * magnitude, 0.0, row_sums)
    stencil = Stencil(grid, links, extra)
    x = np.random.default_rng(0).uniform(0.5, 1.5, grid.shape)
    difference = np.abs(stencil.apply(x) - apply(x))
    if not np.all(difference <= AGREEMENT * (magnitude + np.abs(row_sums))):
        raise UnsuitableOperator("it is not a symmetric 5- or 7-point stencil")
    return stencil.scaled()


def _probe_axis(apply, grid, axis):
    """Return the links along one axis.

    The image of a field that is 1 on every fourth plane shows the links of these planes on their two sides. Along a
    periodic axis plane 0 has a field of its own, because it is next to the last one.
    """
    n = grid.shape[axis]
    periodic = grid.periodic[axis]
    links = np.zeros(grid.shape)
    link_of_plane = np.moveaxis(links, axis, 0)
    if periodic:
        choices = [np.array([0]), np.arange(2, n, 4), np.arange(4, n, 4)]
    else:
        choices = [np.arange(0, n, 4), np.arange(2, n, 4)]
    for planes in choices:
        if not planes.size:
            continue
        x = np.zeros(grid.shape)
        np.moveaxis(x, axis, 0)[planes] = 1.0
        image = np.moveaxis(apply(x), axis, 0)
        if np.any(image[planes[planes >= 4] - 2]):
            raise UnsuitableOperator("a row reaches beyond the neighbours")
        link_of_plane[planes - 1] = -image[planes - 1]
        planes_before_the_last = planes[planes < n - 1]
        link_of_plane[planes_before_the_last] = -image[planes_before_the_last + 1]
    if not periodic or n <= 2:  # no link beyond a wall; two cells of a periodic axis are linked already
        link_of_plane[-1:] = 0.0
    return links
