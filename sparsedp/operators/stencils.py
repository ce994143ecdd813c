"""The 1-D factors from which the catalogue is built, a few diagonals each, and how operators are made of them."""

import numpy as np
import scipy.sparse as sp

from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term

__all__ = [
    "along", "cell_beside", "differences", "kronecker_operator", "mean_of_faces", "means", "one_sided", "pick",
    "slopes", "to_faces", "wall_slopes", "with_ends",
]  # fmt: skip


def along(axis, dim, factor, scale=1.0):
    """A factor along one axis, the identity along the others -> tuple with one Term."""
    return (Term(scale, tuple(factor if a == axis else None for a in range(dim))),)


def kronecker_operator(domain, codomain, blocks, name):
    """Two spaces and the terms for each pair (component of the result, component of the field) -> Operator."""
    return Operator(Kronecker(codomain.parts, domain.parts, blocks), domain, codomain, name)


def to_faces(grid, name, factor, *args):
    """``factor(grid, axis, *args)``, from cells to the faces across that axis -> Operator from cells to all faces."""
    blocks = {(axis, 0): along(axis, grid.dim, factor(grid, axis, *args)) for axis in range(grid.dim)}
    return kronecker_operator(grid.cells, grid.faces, blocks, name)


def differences(grid, axis):
    """Nodes (or faces) -> cells: (v[i + 1] - v[i]) / h[i]."""
    h = grid.widths[axis]
    cells, nodes = np.arange(h.size), grid.node_count(axis)
    return Factor.from_diagonals((h.size, nodes), (cells, (cells + 1) % max(nodes, 1), 1 / h), (cells, cells, -1 / h))


def slopes(grid, axis, sides):
    """Cells -> faces: (u[i] - u[i - 1]) / d[i], at a wall what the condition with value 0 says."""
    face, lower, upper = _between(grid, axis)
    step = 1 / grid.spacings(axis)[face]
    walls = _walls(grid, axis, sides, lambda sign, a, b, half: -sign * a / (a * half + b))
    return Factor.from_diagonals(_cells_to_faces(grid, axis), (face, upper, step), (face, lower, -step), *walls)


def means(grid, axis, sides):
    """Cells -> faces: linear interpolation, at a wall the value the condition with value 0 implies."""
    face, lower, upper = _between(grid, axis)
    h = grid.widths[axis]
    both = h[lower] + h[upper]
    walls = _walls(grid, axis, sides, lambda sign, a, b, half: b / (a * half + b))
    return Factor.from_diagonals(
        _cells_to_faces(grid, axis), (face, upper, h[lower] / both), (face, lower, h[upper] / both), *walls
    )


def wall_slopes(grid, axis, side, condition):
    """Wall value -> faces: the part of the slope that comes from the value on one wall."""
    nodes, half = grid.node_count(axis), 0.5 * (grid.widths[axis][-1:] if side else grid.widths[axis][:1])
    row = np.full(half.size, side * (nodes - 1))
    slope = (2 * side - 1) / (condition.a * half + condition.b)
    return Factor.from_diagonals((nodes, 1), (row, np.zeros_like(row), slope))


def one_sided(grid, axis, upper, condition):
    """Cells -> faces: the slope seen from the lower (upper) cell when a wall stands on the face."""
    slope = condition.a / (0.5 * condition.a * grid.widths[axis] + condition.b)
    return Factor(pick(grid, axis, not upper).matrix.T * (slope if upper else -slope))


def pick(grid, axis, upper):
    """Faces -> cells: the value on the lower (upper) face of each cell."""
    cell, nodes = np.arange(grid.shape[axis]), grid.node_count(axis)
    return Factor.from_diagonals((cell.size, nodes), (cell, (cell + upper) % max(nodes, 1), np.ones(cell.size)))


def mean_of_faces(grid, axis):
    """Faces -> cells: the mean of the lower and the upper face of each cell."""
    return (pick(grid, axis, False) + pick(grid, axis, True)).scaled(0.5)


def with_ends(matrix):
    """A sparse matrix -> the factor that has the first number it takes before its rows, and the last one after them."""
    ends = sp.eye_array(matrix.shape[1], format="csr")
    return Factor(sp.vstack([ends[[0]], matrix, ends[[-1]]], format="csr"))


def cell_beside(grid, axis, upper):
    """Cells -> faces: the value of the cell below (above) each face; at a wall, of the only cell."""
    n, nodes = _cells_to_faces(grid, axis)[::-1]
    face = np.arange(nodes if n else 0)
    cell = face if upper else face - 1
    cell = cell % max(n, 1) if grid.periodic[axis] else np.clip(cell, 0, max(n - 1, 0))
    return Factor.from_diagonals((nodes, n), (face, cell, np.ones(face.size)))


def _cells_to_faces(grid, axis):
    return grid.node_count(axis), grid.shape[axis]


def _between(grid, axis):
    """Faces with a cell on both sides, and those two cells."""
    n = grid.shape[axis]
    face = np.arange(n) if grid.periodic[axis] else np.arange(1, n)
    return face, (face - 1) % max(n, 1), face


def _walls(grid, axis, sides, entry):
    """Entries on the two wall faces; none on a periodic axis or one without cells."""
    n = grid.shape[axis]
    if sides is None or n == 0:
        return []
    found = []
    for cell, face, sign, condition in ((0, 0, -1.0, sides[0]), (n - 1, n, 1.0, sides[1])):
        value = entry(sign, condition.a, condition.b, 0.5 * grid.widths[axis][cell])
        found.append((np.array([face]), np.array([cell]), np.array([value])))
    return found
