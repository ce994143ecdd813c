"""Interpolation and transfer between locations of a grid: average, sample, restrict, prolong, component."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.validation import check_choice, check_finite, is_whole
from sparsedp.errors import ShapeError
from sparsedp.grid.boundary_conditions import describe_patches, neumann, resolve
from sparsedp.grid.grid import Grid, check_grid, per_axis, real_numbers
from sparsedp.grid.space import Space
from sparsedp.operators.interpolation import linear_weights
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import along, kronecker_operator, mean_terms, to_faces
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Term

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

__all__ = ["average", "component", "prolong", "restrict", "sample"]


def average(grid: Grid, boundary: Any = neumann) -> Operator:
    """Return the operator that interpolates linearly from cells to faces.

    Parameters
    ----------
    grid : Grid
    boundary : condition, or dict of conditions
        Boundary condition, with boundary value 0, that determines the values on walls. With neumann a wall face has the
        value of its cell.

    Returns
    -------
    Operator
        in: cells [unit]; out: faces [unit]. Exact for linear fields on faces between two cells.

    Raises
    ------
    TypeError
        If `grid` is not a Grid, or a condition is not a Condition.
    ValueError
        If `boundary` names an axis that is periodic or that the grid does not have.

    See Also
    --------
    gradient, harmonic_average, component

    Examples
    --------
    >>> average(Grid(3))(np.array([1.0, 2.0, 4.0]))
    array([1. , 1.5, 3. , 4. ])
    """
    sides = resolve(grid, boundary, patches=True)
    name = f"average{describe_patches(sides)}"
    return to_faces(name, grid, [mean_terms(grid, axis, sides[axis]) for axis in range(grid.dim)])


def sample(grid: Grid, points: ArrayLike) -> Operator:
    """Return the operator that evaluates a cell field at points, by linear interpolation between cell centres.

    Parameters
    ----------
    grid : Grid
    points : array, shape (m, dim) [length]
        One point for each row; on a 1-D grid the shape (m,) is also allowed. Points must lie in the grid; along a
        periodic axis any coordinate is allowed.

    Returns
    -------
    Operator
        in: cells [unit]; out: shape (m,) [unit]. Second-order accurate, and exact for linear fields.

    Raises
    ------
    ShapeError
        If `points` has another shape.
    NonFiniteError
        If a coordinate is NaN or infinite.
    ValueError
        If a point lies outside the grid.

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
    """Return the operator that maps a cell field to a coarser grid by volume-weighted means over blocks of cells.

    Parameters
    ----------
    grid : Grid
        The fine grid.
    factor : int or tuple of int
        Number of cells along each axis that form one coarse cell. It must divide the number of cells.

    Returns
    -------
    Operator
        in: cells [unit]; out: cells of the coarse grid, which is ``op.codomain.grid`` [unit]. The integral of the field
        is conserved.

    Raises
    ------
    ShapeError
        If a factor is not an integer >= 1 that divides the number of cells.

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
    """Return the operator that interpolates a cell field from a coarser grid, the counterpart of `restrict`.

    Parameters
    ----------
    grid : Grid
        The fine grid.
    factor : int or tuple of int
        Number of cells along each axis that form one coarse cell. It must divide the number of cells.
    interpolation : "constant" or "linear"
        "constant": all fine cells of a coarse cell get its value, so that restrict @ prolong is the identity and the
        integral of the field is conserved. "linear": second-order accurate, and exact for linear fields.

    Returns
    -------
    Operator
        in: cells of the coarse grid, which is ``op.domain.grid`` [unit]; out: cells [unit].

    Raises
    ------
    ShapeError
        If a factor is not an integer >= 1 that divides the number of cells.
    ValueError
        If `interpolation` is neither "constant" nor "linear".

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
    """Return the coarser grid, and for each axis the number of fine cells in a coarse cell."""
    factors = per_axis(factor, grid.shape, "factor")
    are_positive_integers = all(is_whole(f, 1) and np.asarray(f).dtype.kind in "iu" for f in factors)
    if not are_positive_integers or any(n % f for n, f in zip(grid.shape, factors, strict=True)):
        raise ShapeError(f"a factor must be a whole number >= 1 that divides {grid.shape}, got {factor}")
    spacing = [h.reshape(-1, f).sum(axis=1) for h, f in zip(grid.widths, factors, strict=True)]
    shape = tuple(n // f for n, f in zip(grid.shape, factors, strict=True))
    coarse = Grid(shape, spacing=spacing, origin=grid.origin, periodic=grid.periodic)
    return grid.backend.place(coarse), factors


def component(grid: Grid, axis: int | str) -> Operator:
    """Return the operator that extracts one component of a face field, as an array of shape `grid.face_shape(axis)`.

    The transpose is a face field whose other components are 0.

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
