"""The banded 1-D matrices (factors) that define the grid operators, and functions that combine them to operators."""

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
    "adjacent_cell",
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
    """Return a tuple of one Kronecker term: a factor along one axis, and the identity along the others."""
    factors: list[Factor | None] = [None] * dim
    factors[axis] = factor
    return (Term(scale, tuple(factors)),)


def kronecker_operator(domain: Space, codomain: Space, blocks: dict, name: str) -> Operator:
    """Return the Operator whose blocks are Kronecker terms.

    The keys of `blocks` are pairs (component of the result, component of the argument); the values are tuples of terms.
    """
    return Operator(Kronecker(codomain.parts, domain.parts, blocks), domain, codomain, name)


def to_faces(name: str, grid: Grid, factors: Sequence[Factor]) -> Operator:
    """Return an Operator from cells to faces, given for each axis the factor from its cells to its faces."""
    blocks = {(axis, 0): along(axis, grid.dim, factor) for axis, factor in enumerate(factors)}
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

    def slope(sign, a, b, half):
        return -sign * a / (a * half + b)

    walls = _walls(grid, axis, sides, slope)
    return Factor.from_diagonals(_cells_to_faces(grid, axis), (face, upper, step), (face, lower, -step), *walls)


def means(grid: Grid, axis: int, sides: Any) -> Factor:
    """Return the 1-D matrix (a factor of a Kronecker product) that interpolates linearly from cells to faces.

    On a wall it computes the value that the boundary condition with value 0 implies.
    """
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
    """Return the factor from the boundary value on one wall (side 0: lower, 1: upper) to the slope on the faces."""
    nodes = grid.node_count(axis)
    widths = grid.widths[axis]
    half = 0.5 * (widths[-1:] if side else widths[:1])
    row = np.full(half.size, side * (nodes - 1))
    slope = (2 * side - 1) / (condition.a * half + condition.b)
    return Factor.from_diagonals((nodes, 1), (row, np.zeros_like(row), slope))


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


def _walls(grid, axis, sides, entry):
    """Return the (rows, columns, values) of the entries on the two walls; an empty list if there are no walls."""
    n = grid.shape[axis]
    if sides is None or n == 0:
        return []
    diagonals = []
    for cell, face, sign, condition in ((0, 0, -1.0, sides[0]), (n - 1, n, 1.0, sides[1])):
        value = entry(sign, condition.a, condition.b, 0.5 * grid.widths[axis][cell])
        diagonals.append((np.array([face]), np.array([cell]), np.array([value])))
    return diagonals
