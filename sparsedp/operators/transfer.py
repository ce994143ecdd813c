"""Operators between places of a grid: average, sample, restrict, prolong, component."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.validation import check_choice, check_finite, is_whole
from sparsedp.errors import ShapeError
from sparsedp.grid.boundary_conditions import neumann, resolve
from sparsedp.grid.grid import Grid, check_grid, per_axis, real_numbers
from sparsedp.grid.space import Space
from sparsedp.operators.interpolation import linear_weights
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import along, kronecker_operator, means, to_faces
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Term

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

__all__ = ["average", "component", "prolong", "restrict", "sample"]


def average(grid: Grid, boundary: Any = neumann) -> Operator:
    """Return linear interpolation from cells to faces, between the two cells of a face.

    Parameters
    ----------
    grid : Grid
    boundary : condition, or dict of conditions
        At a wall: the value that the condition with value 0 implies (neumann: the value of the cell).

    Returns
    -------
    Operator
        in: cells [unit]; out: faces [unit]. Linear fields are reproduced between cells.

    Raises
    ------
    TypeError
        If `grid` is no Grid, or a condition is no Condition.
    ValueError
        If `boundary` names an axis that is periodic or that the grid lacks.

    See Also
    --------
    gradient, harmonic_average, component

    Examples
    --------
    >>> average(Grid(3))(np.array([1.0, 2.0, 4.0]))
    array([1. , 1.5, 3. , 4. ])
    """
    sides = resolve(grid, boundary)
    return to_faces("average", grid, [means(grid, axis, sides[axis]) for axis in range(grid.dim)])


def sample(grid: Grid, points: ArrayLike) -> Operator:
    """Return the values of a cell field at points, by linear interpolation between cell centres.

    Parameters
    ----------
    grid : Grid
    points : array, shape (m, dim) [length]
        One point for each row; in 1-D also of shape (m,). Points must lie in the box; a periodic
        axis takes any coordinate.

    Returns
    -------
    Operator
        in: cells [unit]; out: shape (m,) [unit]. Order 2; linear fields exact.

    Raises
    ------
    ShapeError
        If `points` has another shape.
    NonFiniteError
        If a coordinate is NaN or infinite.
    ValueError
        If a point lies outside the box.

    See Also
    --------
    restrict, prolong

    Examples
    --------
    >>> sample(Grid(3), [0.5, 1.25])(np.array([1.0, 2.0, 4.0]))
    array([1.  , 1.75])
    """
    check_grid("sample", grid)
    values = real_numbers(points, "points", "points=[[0.5, 1.0]]").astype(float)
    places = values
    if values.ndim == 1 and grid.dim == 1:
        places = values[:, None]
    if places.ndim != 2 or places.shape[1] != grid.dim:
        advice = ""
        if values.shape == (grid.dim,):
            advice = f"; write [{values.tolist()}] for one point"
        raise ShapeError(f"sample needs points of shape (m, {grid.dim}), got an array of shape {places.shape}{advice}")
    if not grid.cells.size:
        raise ShapeError(f"sample needs a grid with cells, got {grid}")
    check_finite("points", values, "need finite coordinates")
    ends = []  # for each axis, the two cells around each point with their weights
    for axis in range(grid.dim):
        lower, upper, weight = linear_weights(grid, axis, places[:, axis])
        ends.append(((lower, 1 - weight), (upper, weight)))
    columns = []
    entries = []
    for corner in product(*ends):
        cells = tuple(cell for cell, _ in corner)
        columns.append(np.ravel_multi_index(cells, grid.shape))
        entries.append(np.prod([weight for _, weight in corner], axis=0))
    count = len(places)
    rows = np.broadcast_to(np.arange(count), np.shape(entries))
    matrix = sp.coo_array((np.ravel(entries), (np.ravel(rows), np.ravel(columns))), (count, grid.cells.size))
    return Operator(Matrix(matrix), grid.cells, Space(count), "sample")


def restrict(grid: Grid, factor: int | Sequence[int]) -> Operator:
    """Return the mean over blocks of cells, weighted by volume, from cells to cells of a coarser grid.

    Parameters
    ----------
    grid : Grid
        The fine grid.
    factor : int or tuple of int
        Number of cells along each axis that form one coarse cell; must divide the shape.

    Returns
    -------
    Operator
        in: cells [unit]; out: cells of the coarse grid (``op.codomain.grid``) [unit]. Conserves the integral.

    Raises
    ------
    ShapeError
        If the factor is not a whole number >= 1 that divides the shape.

    See Also
    --------
    prolong, sample

    Examples
    --------
    >>> restrict(Grid(4), 2)(np.array([1.0, 3.0, 5.0, 9.0]))
    array([2., 7.])
    """
    check_grid("restrict", grid)
    coarse, factors = _coarse(grid, factor)
    lines = []
    for h, size in zip(grid.widths, factors, strict=True):
        fine = np.arange(h.size)
        weights = h / np.repeat(h.reshape(-1, size).sum(axis=1), size)
        lines.append(Factor.from_diagonals((h.size // size, h.size), (fine // size, fine, weights)))
    return kronecker_operator(grid.cells, coarse.cells, {(0, 0): (Term(1.0, tuple(lines)),)}, "restrict")


def prolong(grid: Grid, factor: int | Sequence[int], interpolation: str = "constant") -> Operator:
    """Return interpolation from cells of a coarser grid to cells, the counterpart of `restrict`.

    Parameters
    ----------
    grid : Grid
        The fine grid.
    factor : int or tuple of int
        Number of cells along each axis that form one coarse cell; must divide the shape.
    interpolation : "constant" or "linear"
        constant: each block has the coarse value; restrict @ prolong is the identity, and the
        integral is conserved. linear: order 2, exact for linear fields.

    Returns
    -------
    Operator
        in: cells of the coarse grid (``op.domain.grid``) [unit]; out: cells [unit].

    Raises
    ------
    ShapeError
        If the factor is not a whole number >= 1 that divides the shape.
    ValueError
        If `interpolation` is another word.

    See Also
    --------
    restrict, sample

    Examples
    --------
    >>> prolong(Grid(4), 2)(np.array([2.0, 7.0]))
    array([2., 2., 7., 7.])
    >>> prolong(Grid(4), 2, "linear")(np.array([1.0, 3.0]))
    array([0.5, 1.5, 2.5, 3.5])
    """
    check_grid("prolong", grid)
    check_choice("interpolation of prolong", interpolation, ("constant", "linear"))
    coarse, factors = _coarse(grid, factor)
    lines = []
    for axis, size in enumerate(factors):
        fine = np.arange(grid.shape[axis])
        shape = (fine.size, fine.size // size)
        if interpolation == "constant":
            lines.append(Factor.from_diagonals(shape, (fine, fine // size, np.ones(fine.size))))
        else:
            lower, upper, weight = linear_weights(coarse, axis, grid.coordinates(axis))
            lines.append(Factor.from_diagonals(shape, (fine, lower, 1 - weight), (fine, upper, weight)))
    return kronecker_operator(coarse.cells, grid.cells, {(0, 0): (Term(1.0, tuple(lines)),)}, "prolong")


def _coarse(grid, factor):
    """Return a coarser grid, and the number of cells of each axis that form one of its cells."""
    factors = per_axis(factor, grid.shape, "factor")
    are_positive_integers = all(is_whole(f, 1) and np.asarray(f).dtype.kind in "iu" for f in factors)
    if not are_positive_integers or any(n % f for n, f in zip(grid.shape, factors, strict=True)):
        raise ShapeError(f"a factor must be a whole number >= 1 that divides {grid.shape}, got {factor}")
    spacing = [h.reshape(-1, f).sum(axis=1) for h, f in zip(grid.widths, factors, strict=True)]
    shape = tuple(n // f for n, f in zip(grid.shape, factors, strict=True))
    coarse = Grid(shape, spacing=spacing, origin=grid.origin, periodic=grid.periodic)
    return grid.backend.place(coarse), factors


def component(grid: Grid, axis: int | str) -> Operator:
    """Return one component of a face field in its own shape; the transpose sets the other components to 0.

    Parameters
    ----------
    grid : Grid
    axis : int or "x", "y", "z"

    Returns
    -------
    Operator
        in: faces [unit]; out: shape `grid.face_shape(axis)` [unit].

    Raises
    ------
    ValueError
        If the grid has no such axis.

    See Also
    --------
    average

    Examples
    --------
    >>> component(Grid((1, 1)), "y")(np.array([1.0, 2.0, 3.0, 4.0]))
    array([[3., 4.]])
    >>> component(Grid((1, 1)), "x").T(np.array([[1.0], [2.0]]))
    array([1., 2., 0., 0.])
    """
    check_grid("component", grid)
    number = grid.axis(axis)
    blocks = {(0, number): along(number, grid.dim, None)}
    return kronecker_operator(grid.faces, grid.faces.component(number), blocks, "component")
