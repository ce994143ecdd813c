"""The 1-D factors of the catalogue, a few diagonals each, and how operators are built from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from sparsedp.grid.grid import Grid
from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term

__all__ = [
    "along",
    "cell_beside",
    "differences",
    "kronecker_operator",
    "mean_of_faces",
    "means",
    "one_sided",
    "pick",
    "slopes",
    "to_faces",
    "wall_slopes",
    "with_ends",
]


def along(axis: int, dim: int, factor: Factor | None, scale: float = 1.0) -> tuple[Term]:
    """Return the terms (one) of a factor along one axis and the identity along the others."""
    factors: list[Factor | None] = [None] * dim
    factors[axis] = factor
    return (Term(scale, tuple(factors)),)


def kronecker_operator(domain: Space, codomain: Space, blocks: dict, name: str) -> Operator:
    """Return the Operator with these terms for each pair (component of the result, component of the field)."""
    return Operator(Kronecker(codomain.parts, domain.parts, blocks), domain, codomain, name)


def to_faces(name: str, grid: Grid, factors: Sequence[Factor]) -> Operator:
    """Return an Operator from cells to faces, given the factor of each axis from cells to the faces across it."""
    blocks = {(axis, 0): along(axis, grid.dim, factor) for axis, factor in enumerate(factors)}
    return kronecker_operator(grid.cells, grid.faces, blocks, name)


def differences(grid: Grid, axis: int) -> Factor:
    """Return the factor (v[i + 1] - v[i]) / h[i] from nodes (or faces) to cells."""
    h = grid.widths[axis]
    cells = np.arange(h.size)
    nodes = grid.node_count(axis)
    return Factor.from_diagonals((h.size, nodes), (cells, (cells + 1) % max(nodes, 1), 1 / h), (cells, cells, -1 / h))


def slopes(grid: Grid, axis: int, sides: Any) -> Factor:
    """Return the factor (u[i] - u[i - 1]) / d[i] from cells to faces; at a wall by the condition with value 0."""
    face, lower, upper = _between(grid, axis)
    step = 1 / grid.spacings(axis)[face]

    def slope(sign, a, b, half):
        return -sign * a / (a * half + b)

    walls = _walls(grid, axis, sides, slope)
    return Factor.from_diagonals(_cells_to_faces(grid, axis), (face, upper, step), (face, lower, -step), *walls)


def means(grid: Grid, axis: int, sides: Any) -> Factor:
    """Return linear interpolation from cells to faces; at a wall the value that the condition with value 0 implies."""
    face, lower, upper = _between(grid, axis)
    h = grid.widths[axis]
    both = h[lower] + h[upper]

    def value(sign, a, b, half):
        return b / (a * half + b)

    walls = _walls(grid, axis, sides, value)
    return Factor.from_diagonals(
        _cells_to_faces(grid, axis), (face, upper, h[lower] / both), (face, lower, h[upper] / both), *walls
    )


def wall_slopes(grid: Grid, axis: int, side: int, condition: Any) -> Factor:
    """Return the part of the slope on faces that depends on the value on one wall (0: lower, 1: upper)."""
    nodes = grid.node_count(axis)
    widths = grid.widths[axis]
    half = 0.5 * (widths[-1:] if side else widths[:1])
    row = np.full(half.size, side * (nodes - 1))
    slope = (2 * side - 1) / (condition.a * half + condition.b)
    return Factor.from_diagonals((nodes, 1), (row, np.zeros_like(row), slope))


def one_sided(grid: Grid, axis: int, upper: bool, condition: Any) -> Factor:
    """Return the slope from cells to faces, computed from the lower (upper) cell, with a wall on the face."""
    slope = condition.a / (0.5 * condition.a * grid.widths[axis] + condition.b)
    if not upper:
        slope = -slope
    return Factor(pick(grid, axis, not upper).matrix.T * slope)


def pick(grid: Grid, axis: int, upper: bool) -> Factor:
    """Return the value on the lower (upper) face of each cell, from faces to cells."""
    cell = np.arange(grid.shape[axis])
    nodes = grid.node_count(axis)
    return Factor.from_diagonals((cell.size, nodes), (cell, (cell + upper) % max(nodes, 1), np.ones(cell.size)))


def mean_of_faces(grid: Grid, axis: int) -> Factor:
    """Return the mean of the lower and the upper face of each cell, from faces to cells."""
    return (pick(grid, axis, False) + pick(grid, axis, True)).scaled(0.5)


def with_ends(matrix: sp.csr_array) -> Factor:
    """Return a matrix with two more rows: its result is put between the first and the last entry of its argument."""
    ends = sp.eye_array(matrix.shape[1], format="csr")
    return Factor(sp.vstack([ends[[0]], matrix, ends[[-1]]], format="csr"))


def cell_beside(grid: Grid, axis: int, upper: bool) -> Factor:
    """Return the value of the cell below (above) each face, from cells to faces; at a wall, of its only cell."""
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
    """Return the faces with a cell on both sides, and these two cells."""
    n = grid.shape[axis]
    face = np.arange(0 if grid.periodic[axis] else 1, n)
    return face, (face - 1) % max(n, 1), face


def _walls(grid, axis, sides, entry):
    """Return the diagonals of the two wall faces; none on a periodic axis or one without cells."""
    n = grid.shape[axis]
    if sides is None or n == 0:
        return []
    diagonals = []
    for cell, face, sign, condition in ((0, 0, -1.0, sides[0]), (n - 1, n, 1.0, sides[1])):
        value = entry(sign, condition.a, condition.b, 0.5 * grid.widths[axis][cell])
        diagonals.append((np.array([face]), np.array([cell]), np.array([value])))
    return diagonals
