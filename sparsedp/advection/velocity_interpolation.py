"""Interpolation of the velocity to the points or sides where a transport scheme needs it.

Between cell centres the interpolation is linear; on a wall face it is the value of the adjacent cell. At a cell centre
it is the mean of both faces. The control volume of a face consists of halves of two cells, and so do its sides along
the axis of the face: the velocity through such a side is the mean of both cells weighted with their widths. A
divergence-free flow then preserves constant fields, on stretched grids too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from sparsedp.grid.boundary_conditions import neumann
from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import adjacent_cell, mean_of_faces, means, with_ends
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sparsedp.advection.settings import TransportSettings
    from sparsedp.grid.grid import Grid

__all__ = ["velocity_interpolation"]


def velocity_interpolation(settings: TransportSettings) -> Operator | None:
    """Return the operator that interpolates all velocity components to the points of each component of the field.

    Parameters
    ----------
    settings : TransportSettings

    Returns
    -------
    Operator or None
        Its result is ordered by component of the field, then by axis. None if the velocity is given at the points or
        sides that the scheme needs.
    """
    grid = settings.grid
    one_component = settings.of == "cells" or (settings.at_points and grid.dim == 1)
    if settings.at_points:
        needed = settings.of
    else:
        needed = "faces"
    if one_component and settings.velocity == needed:
        return None
    if settings.at_points:
        factor_along = _factor_to_points
    else:
        factor_along = _factor_to_sides
    components: Sequence[int | None] = [None] if settings.of == "cells" else range(grid.dim)
    if settings.velocity == "faces":
        given_parts = grid.faces.parts
    else:
        given_parts = (grid.shape,) * grid.dim
    blocks: dict = {}
    parts: list = []
    for component in components:
        for axis in range(grid.dim):
            factors = tuple(factor_along(settings, component, axis, along) for along in range(grid.dim))
            blocks[len(parts), axis] = (Term(1.0, factors),)
            sizes = zip(given_parts[axis], factors, strict=True)
            parts.append(tuple(n if factor is None else factor.shape[0] for n, factor in sizes))
    structure = Kronecker(parts, given_parts, blocks)
    rows, columns = structure.shape
    return Operator(structure, Space(columns), Space(rows), "velocity at the points")


def _factor_to_points(settings: TransportSettings, component: int | None, axis: int, along: int) -> Factor | None:
    """Return the 1-D matrix along one axis from velocity component `axis` to the points of a component of the field.

    `component` is None for a cell field. The result is None if no interpolation along this axis is needed.
    """
    on_faces = settings.velocity == "faces" and along == axis
    if on_faces == (along == component):
        return None
    if on_faces:
        return mean_of_faces(settings.grid, along)
    return _mean_of_cells(settings.grid, along)


def _factor_to_sides(settings: TransportSettings, component: int | None, axis: int, along: int) -> Factor | None:
    """Return the matrix of `_factor_to_points` for the sides across `axis` of the control volumes of the points."""
    grid = settings.grid
    on_faces = settings.velocity == "faces" and along == axis
    if along == component:
        if axis == component:
            return _to_sides_of_faces(grid, along, on_faces)
        return _weighted_mean_of_cells(grid, along)
    if along == axis and not on_faces:
        return _mean_of_cells(grid, along)
    return None


def _mean_of_cells(grid: Grid, axis: int) -> Factor:
    """Return the 1-D matrix from cells to faces of linear interpolation; a wall face gets the value of its cell."""
    return means(grid, axis, None if grid.periodic[axis] else (neumann, neumann))


def _weighted_mean_of_cells(grid: Grid, axis: int) -> Factor:
    """Return the 1-D matrix from cells to faces that computes the mean weighted with the cell widths."""
    below = adjacent_cell(grid, axis, False).matrix
    above = adjacent_cell(grid, axis, True).matrix
    widths = (below + above) @ sp.diags_array(grid.widths[axis])
    return Factor(sp.diags_array(1.0 / np.maximum(widths.sum(axis=1), np.finfo(float).tiny)) @ widths)


def _to_sides_of_faces(grid: Grid, axis: int, on_faces: bool) -> Factor:
    """Return the 1-D matrix from faces, or from cells, to the sides of the control volumes of faces along their axis.

    These sides are the cell centres and, on a bounded axis, the walls.
    """
    n = grid.shape[axis]
    if on_faces:
        centres = mean_of_faces(grid, axis).matrix
    else:
        centres = sp.eye_array(n, format="csr")
    if grid.periodic[axis]:  # side f is the centre of cell f - 1
        return Factor(centres[np.arange(-1, n - 1)])
    return with_ends(centres)
