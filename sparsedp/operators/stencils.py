"""The banded 1-D matrices (factors) that define the grid operators, and functions that combine them to operators."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from sparsedp._utils.validation import check_type
from sparsedp.grid.boundary_conditions import MixedWall
from sparsedp.grid.grid import Grid
from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term

__all__ = [
    "along",
    "adjacent_cell",
    "check_order",
    "differences",
    "differences_4",
    "kronecker_operator",
    "mean_of_faces",
    "mean_terms",
    "means",
    "on_faces",
    "one_sided",
    "pick",
    "slope_terms",
    "slopes",
    "slopes_4",
    "to_faces",
    "wall_slope_terms",
    "wall_slopes",
    "wall_slopes_4",
    "with_ends",
]


def along(axis: int, dim: int, factor: Factor | None, scale: float = 1.0) -> tuple[Term, ...]:
    """Return a tuple of one Kronecker term: a factor along one axis, and the identity along the others."""
    factors: list[Factor | None] = [None] * dim
    factors[axis] = factor
    return (Term(scale, tuple(factors)),)


def kronecker_operator(domain: Space, codomain: Space, blocks: dict, name: str) -> Operator:
    """Return the Operator whose blocks are Kronecker terms.

    The keys of `blocks` are pairs (component of the result, component of the argument); the values are tuples of terms.
    """
    return Operator(Kronecker(codomain.parts, domain.parts, blocks), domain, codomain, name)


def to_faces(name: str, grid: Grid, parts: Sequence[Factor | tuple[Term, ...]]) -> Operator:
    """Return an Operator from cells to faces, given for each axis the factor from its cells to its faces, or terms."""
    blocks = {}
    for axis, part in enumerate(parts):
        if isinstance(part, Factor):
            blocks[axis, 0] = along(axis, grid.dim, part)
        else:
            blocks[axis, 0] = part
    return kronecker_operator(grid.cells, grid.faces, blocks, name)


def differences(grid: Grid, axis: int) -> Factor:
    """Return the factor from nodes (or faces) to cells that computes (v[i + 1] - v[i]) / h[i]."""
    h = grid.widths[axis]
    cells = np.arange(h.size)
    nodes = grid.node_count(axis)
    return Factor.from_diagonals((h.size, nodes), (cells, (cells + 1) % max(nodes, 1), 1 / h), (cells, cells, -1 / h))


def slopes(grid: Grid, axis: int, sides: Any) -> Factor:
    """Return the factor from cells to faces that computes (u[i] - u[i - 1]) / d[i].

    On a wall it computes the slope, in the direction of the axis, that the boundary condition with value 0 implies.
    """
    face, lower, upper = _between(grid, axis)
    step = 1 / grid.spacings(axis)[face]
    walls = _walls(grid, axis, sides, _slope_of_cell)
    return Factor.from_diagonals(_cells_to_faces(grid, axis), (face, upper, step), (face, lower, -step), *walls)


def means(grid: Grid, axis: int, sides: Any) -> Factor:
    """Return the 1-D matrix (a factor of a Kronecker product) that interpolates linearly from cells to faces.

    On a wall it computes the value that the boundary condition with value 0 implies.
    """
    face, lower, upper = _between(grid, axis)
    h = grid.widths[axis]
    both = h[lower] + h[upper]
    walls = _walls(grid, axis, sides, _share_of_cell)
    return Factor.from_diagonals(
        _cells_to_faces(grid, axis), (face, upper, h[lower] / both), (face, lower, h[upper] / both), *walls
    )


# ---- order 4 on staggered points: (27 (u[i] - u[i - 1]) - (u[i + 1] - u[i - 2])) / (24 h) between the points ----

CENTRED = (1 / 24, -27 / 24, 27 / 24, -1 / 24)
FEWEST = 4  # cells between two walls, so that the rows next to one wall do not reach the other one
# Next to a wall the slope of a cubic polynomial. Its error of order 3 keeps solutions at order 4. Rows: the wall face
# and the next face; columns: the value on the wall and in the first three cells.
AT_WALL = ((-46 / 15, 15 / 4, -5 / 6, 3 / 20), (2 / 15, -5 / 4, 7 / 6, -1 / 20))
FIRST_CELL = (-23 / 24, 7 / 8, 1 / 8, -1 / 24)  # from the first four faces


def check_order(name: str, grid: Grid, order: Any, solid: Any = None) -> None:
    """Raise an error if `order` is neither 2 nor 4, or if the function `name` has no stencil of order 4 on the grid."""
    if not isinstance(order, (int, np.integer)) or isinstance(order, bool) or order not in (2, 4):
        raise ValueError(f"order of {name} must be 2 or 4, got {order!r}")
    if order == 2:
        return
    check_type(name, grid, Grid, "a Grid", "dp.Grid((64, 64), size=1.0)")
    grid.backend.check(f"{name} with order=4")
    if solid is not None:
        raise ValueError(f"{name} with order=4 takes no solid cells; leave solid out or take order=2")
    for axis, uniform, periodic, n in zip(grid.axes, grid.uniform, grid.periodic, grid.shape, strict=True):
        if not uniform:
            raise ValueError(f"{name} with order=4 needs cells of one width, but {axis} is stretched; take order=2")
        if not periodic and n < FEWEST:
            raise ValueError(
                f"{name} with order=4 needs at least {FEWEST} cells between two walls, got {n} along {axis}; take "
                "order=2"
            )


def differences_4(grid: Grid, axis: int) -> Factor:
    """Return the factor of `differences` of order 4, for an axis of equal widths; of order 3 in the cells at walls."""
    n = grid.shape[axis]
    nodes = grid.node_count(axis)
    cells = np.arange(n) if grid.periodic[axis] else np.arange(1, n - 1)
    ends = []
    if not grid.periodic[axis]:
        ends = [(0, np.arange(4), FIRST_CELL), (n - 1, n - np.arange(4), [-weight for weight in FIRST_CELL])]
    return _four_points(grid, axis, (n, nodes), cells, -1, ends)


def slopes_4(grid: Grid, axis: int, sides: Any) -> Factor:
    """Return the factor of `slopes` of order 4, for an axis of equal widths; of order 3 on two faces at each wall."""
    n = grid.shape[axis]
    nodes = grid.node_count(axis)
    if grid.periodic[axis]:
        return _four_points(grid, axis, (nodes, n), np.arange(n), -2, [])
    ends = []
    for side, condition in enumerate(sides):
        sign = 1 - 2 * side  # from the wall inwards
        for row, (at_wall, *at_cells) in enumerate(AT_WALL):
            weights = np.array(at_cells) + at_wall * _shares_on_wall(grid, axis, condition)
            if row == 0 and condition.a == 0:
                weights = np.zeros(3)  # exactly, without the rounding of the line above
            cells = np.arange(3) if side == 0 else n - 1 - np.arange(3)
            ends.append((row if side == 0 else n - row, cells, sign * weights))
    return _four_points(grid, axis, (nodes, n), np.arange(2, n - 1), -2, ends)


def wall_slopes_4(grid: Grid, axis: int, side: int, condition: Any) -> Factor:
    """Return the factor of `wall_slopes` that belongs to `slopes_4`."""
    nodes = grid.node_count(axis)
    h = grid.widths[axis][0]
    rows = np.array([0, 1]) if side == 0 else np.array([nodes - 1, nodes - 2])
    slope = (1 - 2 * side) * np.array([row[0] for row in AT_WALL]) / h * _value_on_wall(h, condition)
    if condition.a == 0:
        slope[0] = (2 * side - 1) / condition.b
    return Factor.from_diagonals((nodes, 1), (rows, np.zeros_like(rows), slope))


def _shares_on_wall(grid, axis, condition):
    """Return the weights of the first three cells in the value on a wall that a condition with value 0 implies."""
    h = grid.widths[axis][0]
    return condition.b / h * np.array(AT_WALL[0][1:]) * _value_on_wall(h, condition)


def _value_on_wall(h, condition):
    """Return the value on a wall for a condition with value 1, where the field is 0 in the cells."""
    return 1 / (condition.a - condition.b * AT_WALL[0][0] / h)


def _four_points(grid, axis, shape, rows, first, ends):
    """Return a factor with the weights CENTRED / h, and the rows `ends` = (row, columns, weights times h) at walls.

    `first` is the first column of a row minus the number of the row.
    """
    columns = max(shape[1], 1)
    if columns == 1:  # one periodic cell: differences are exactly 0
        rows = rows[:0]
    h = grid.widths[axis][:1]
    diagonals = [
        (rows, (rows + first + place) % columns, np.full(rows.size, weight) / h) for place, weight in enumerate(CENTRED)
    ]
    for row, cells, weights in ends:
        diagonals.append((np.full(len(cells), row), cells, np.array(weights) / h))
    return Factor.from_diagonals(shape, *diagonals)


def wall_slopes(grid: Grid, axis: int, side: int, condition: Any) -> Factor:
    """Return the factor from the boundary value on one wall (side 0: lower, 1: upper) to the slope on the faces."""
    nodes = grid.node_count(axis)
    widths = grid.widths[axis]
    half = 0.5 * (widths[-1:] if side else widths[:1])
    row = np.full(half.size, side * (nodes - 1))
    slope = (2 * side - 1) / (condition.a * half + condition.b)
    return Factor.from_diagonals((nodes, 1), (row, np.zeros_like(row), slope))


def slope_terms(grid: Grid, axis: int, sides: Any) -> tuple[Term, ...]:
    """Return the Kronecker terms of `slopes`, for walls on which conditions may differ from face to face."""
    return _terms(grid, axis, sides, slopes, _slope_of_cell)


def mean_terms(grid: Grid, axis: int, sides: Any) -> tuple[Term, ...]:
    """Return the Kronecker terms of `means`, for walls on which conditions may differ from face to face."""
    return _terms(grid, axis, sides, means, _share_of_cell)


def wall_slope_terms(grid: Grid, axis: int, side: int, wall: Any) -> tuple[Term, ...]:
    """Return the Kronecker terms of `wall_slopes`, for a wall on which conditions may differ from face to face."""
    if not isinstance(wall, MixedWall):
        return along(axis, grid.dim, wall_slopes(grid, axis, side, wall))
    terms: list[Term] = []
    for condition, faces in wall.regions:
        terms += on_faces(axis, wall_slopes(grid, axis, side, condition), faces)
    return tuple(terms)


def _terms(grid, axis, sides, factor, entry):
    """Return the terms of a factor from cells to faces: ``factor(grid, axis, sides)`` where no wall is mixed.

    A mixed wall has no entries in this factor. Each of its conditions adds terms that are restricted to its faces.
    """
    if not any(isinstance(wall, MixedWall) for wall in sides or ()):
        return along(axis, grid.dim, factor(grid, axis, sides))
    plain = tuple(None if isinstance(wall, MixedWall) else wall for wall in sides)
    terms = list(along(axis, grid.dim, factor(grid, axis, plain)))
    for side, wall in enumerate(sides):
        if not isinstance(wall, MixedWall):
            continue
        for condition, faces in wall.regions:
            pair = (condition, None) if side == 0 else (None, condition)
            entries = _walls(grid, axis, pair, entry)
            if entries:  # none on an axis without cells
                terms += on_faces(axis, Factor.from_diagonals(_cells_to_faces(grid, axis), *entries), faces)
    return tuple(terms)


def on_faces(axis: int, factor: Factor, faces: NDArray[np.bool_]) -> list[Term]:
    """Return the terms of a factor along `axis` that acts on some lines along this axis only.

    Parameters
    ----------
    axis : int
    factor : Factor
    faces : bool array
        The lines, in the shape of a wall without the axis across it.
    """
    terms = []
    for selections in _boxes(faces):
        factors: list[Factor | None] = [_selection(chosen) for chosen in selections]
        factors.insert(axis, factor)
        terms.append(Term(1.0, tuple(factors)))
    return terms


def _boxes(faces: NDArray[np.bool_]) -> Iterator[list[NDArray[np.bool_]]]:
    """Yield sets of faces that together make up `faces`, each as one boolean array for each axis of the wall.

    Rows that are equal share one set.
    """
    if faces.ndim < 2:
        yield [faces] * faces.ndim
        return
    patterns, number = np.unique(faces, axis=0, return_inverse=True)
    for index, pattern in enumerate(patterns):
        if pattern.any():
            yield [number.reshape(-1) == index, pattern]


def _selection(chosen):
    """Return the factor that keeps the chosen entries of an axis; None, the identity, if it keeps all."""
    if np.all(chosen):
        return None
    return Factor(sp.diags_array(chosen.astype(float), format="csr"))


def one_sided(grid: Grid, axis: int, upper: bool, condition: Any) -> Factor:
    """Return the factor from cells to faces that computes the slope as if each face were a wall.

    The slope is computed from the upper cell of the face if `upper`, else from the lower one, with boundary value 0.
    """
    slope = condition.a / (0.5 * condition.a * grid.widths[axis] + condition.b)
    if not upper:
        slope = -slope
    return Factor(pick(grid, axis, not upper).matrix.T * slope)


def pick(grid: Grid, axis: int, upper: bool) -> Factor:
    """Return the factor from faces to cells that takes the value on the upper (or lower) face of each cell."""
    cell = np.arange(grid.shape[axis])
    nodes = grid.node_count(axis)
    return Factor.from_diagonals((cell.size, nodes), (cell, (cell + upper) % max(nodes, 1), np.ones(cell.size)))


def mean_of_faces(grid: Grid, axis: int) -> Factor:
    """Return the factor from faces to cells that computes the mean of the two faces of each cell."""
    return (pick(grid, axis, False) + pick(grid, axis, True)).scaled(0.5)


def with_ends(matrix: sp.csr_array) -> Factor:
    """Return `matrix` with the first row of the identity added above it, and the last row of the identity below it."""
    ends = sp.eye_array(matrix.shape[1], format="csr")
    return Factor(sp.vstack([ends[[0]], matrix, ends[[-1]]], format="csr"))


def adjacent_cell(grid: Grid, axis: int, upper: bool) -> Factor:
    """Return the factor from cells to faces that takes the value of the upper (or lower) cell of each face.

    A wall face has only one cell, whose value is taken in both cases.
    """
    nodes, n = _cells_to_faces(grid, axis)
    face = np.arange(nodes if n else 0)
    cell = face if upper else face - 1
    if grid.periodic[axis]:
        cell = cell % max(n, 1)
    else:
        cell = np.clip(cell, 0, max(n - 1, 0))
    return Factor.from_diagonals((nodes, n), (face, cell, np.ones(face.size)))


def _cells_to_faces(grid, axis):
    """Return the shape of a factor from cells to faces."""
    return grid.node_count(axis), grid.shape[axis]


def _between(grid, axis):
    """Return the indices of the faces between two cells, and those of their lower and upper cells."""
    n = grid.shape[axis]
    face = np.arange(0 if grid.periodic[axis] else 1, n)
    return face, (face - 1) % max(n, 1), face


def _slope_of_cell(sign, a, b, half):
    """Return the entry of the cell at a wall in the slope along the axis; `sign`: the sign of the outward normal."""
    return -sign * a / (a * half + b)


def _share_of_cell(sign, a, b, half):
    """Return the entry of the cell at a wall in the value on the wall."""
    return b / (a * half + b)


def _walls(grid, axis, sides, entry):
    """Return the (rows, columns, values) of the entries on the two walls; a wall with condition None has none."""
    n = grid.shape[axis]
    if sides is None or n == 0:
        return []
    diagonals = []
    for cell, face, sign, condition in ((0, 0, -1.0, sides[0]), (n - 1, n, 1.0, sides[1])):
        if condition is None:
            continue
        value = entry(sign, condition.a, condition.b, 0.5 * grid.widths[axis][cell])
        diagonals.append((np.array([face]), np.array([cell]), np.array([value])))
    return diagonals
