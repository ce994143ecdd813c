"""From the velocity as the user gives it to the velocity where a scheme needs it: one sparse matrix for each block.

Linear interpolation between centres, at a wall the only cell; the mean of both ends inside a cell. The flow through
the side of the control volume of a face, which covers half of two cells, is the mean of both weighted with their
widths: then constants are kept by a flow without divergence, on stretched grids too.
"""

import numpy as np
import scipy.sparse as sp

from sparsedp.grid.boundary_conditions import neumann
from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import cell_beside, mean_of_faces, means, with_ends
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term

__all__ = ["interpolation"]


def interpolation(setting):
    """Setting -> Operator from the velocity as it is given to that where the scheme needs it, for each component of the
    field axis by axis. None where that is the same."""
    at_points = setting.at_points
    alone = setting.of == "cells" or at_points and setting.grid.dim == 1
    if alone and setting.velocity == (setting.of if at_points else "faces"):
        return None
    return _operator(setting, _between if at_points else _onto_sides)


def _operator(setting, line):
    """Operator from the given velocity to all its components at each component of the field, axis by axis.

    ``line(setting, own, axis, along)`` is the factor along one axis for velocity component `axis` and field component
    `own` (None: cells); None where nothing is done.
    """
    grid = setting.grid
    components, axes = [None] if setting.of == "cells" else range(grid.dim), range(grid.dim)
    blocks: dict = {}
    parts: list = []
    given = grid.faces.parts if setting.velocity == "faces" else (grid.shape,) * grid.dim
    for own in components:
        for axis in axes:
            factors = tuple(line(setting, own, axis, along) for along in axes)
            blocks[len(parts), axis] = (Term(1.0, factors),)
            parts.append(tuple(n if f is None else f.shape[0] for n, f in zip(given[axis], factors, strict=True)))
    structure = Kronecker(parts, given, blocks)
    rows, columns = structure.shape
    return Operator(structure, Space(columns), Space(rows), "velocity at the points")


def _between(setting, own, axis, along):
    """To the points of the field."""
    grid, on_faces = setting.grid, setting.velocity == "faces" and along == axis
    if on_faces == (along == own):
        return None
    return mean_of_faces(grid, along) if on_faces else _mean_of_cells(grid, along)


def _onto_sides(setting, own, axis, along):
    """To the sides across `axis` of the control volumes of the field."""
    grid, on_faces = setting.grid, setting.velocity == "faces" and along == axis
    if along == own:
        return _inside(grid, along, on_faces) if axis == own else _shared(grid, along)
    return _mean_of_cells(grid, along) if along == axis and not on_faces else None


def _mean_of_cells(grid, axis):
    return means(grid, axis, None if grid.periodic[axis] else (neumann, neumann))


def _shared(grid, axis):
    """Cells -> faces of an axis: the mean weighted with the widths."""
    lower, upper = (cell_beside(grid, axis, side).matrix for side in (False, True))
    both = (lower + upper) @ sp.diags_array(grid.widths[axis])
    return Factor(sp.diags_array(1.0 / np.maximum(both.sum(axis=1), np.finfo(float).tiny)) @ both)


def _inside(grid, axis, on_faces):
    """Faces (or cells) of an axis -> the cell centres, as interfaces between faces, and the walls."""
    n = grid.shape[axis]
    centres = mean_of_faces(grid, axis).matrix if on_faces else sp.eye_array(n, format="csr")
    if grid.periodic[axis]:  # interface f is cell f - 1
        return Factor(centres[np.arange(-1, n - 1)])
    return with_ends(centres)
