"""The faces on the walls of the grid next to a body.

In a narrow gap between the body and such a face with a dirichlet condition, both are walls of the gap; see
cut_wall_slope.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp.autodiff.tape import sample
from sparsedp.grid.boundary_conditions import MixedWall, walls_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.operators.cut_geometry import CutGeometry

__all__ = ["GridWalls", "are_near", "grid_walls"]


class GridWalls(NamedTuple):
    """Open faces on dirichlet walls of the grid, near cells that the body cuts; shape (q,) each.

    Attributes
    ----------
    faces, cells : int arrays
        Flat numbers of the faces and of their cells.
    sides : int array
        2 axis + side, where side is 0 for the lower and 1 for the upper wall of an axis.
    a : array
        The condition a u = value.
    areas : array
        Open area of the face.
    normals, centroids : lists of arrays, one for each axis
        Unit normal that points into the grid, and the centre of the face.
    """

    faces: NDArray[np.int64]
    cells: NDArray[np.int64]
    sides: NDArray[np.int64]
    a: NDArray[np.float64]
    areas: Any
    normals: list
    centroids: list


def grid_walls(grid: Grid, geometry: CutGeometry, sides: tuple, reach: int) -> GridWalls:
    """Return the open faces on dirichlet walls whose cell is up to `reach` cells from a cut cell, along each axis.

    Parameters
    ----------
    grid : Grid
    geometry : CutGeometry
    sides : tuple
        The conditions, as `resolve` returns them.
    reach : int
    """
    is_near = are_near(grid, geometry.cut, reach)
    all_cells = np.arange(grid.cells.size).reshape(grid.shape)
    apertures = np.asarray(sample(geometry.apertures))
    faces, cells, of_sides, a = [], [], [], []
    for axis, side, wall in walls_of(sides):
        first, last = grid.faces.offsets[axis : axis + 2]
        of_wall: Any = np.arange(first, last).reshape(grid.faces.parts[axis]).take(-side, axis)
        of_cells: Any = all_cells.take(-side, axis)
        is_open = is_near.take(-side, axis) & (apertures[of_wall] > 0)
        regions = wall.regions if isinstance(wall, MixedWall) else ((wall, np.ones(of_wall.shape, bool)),)
        for condition, region in regions:
            chosen = is_open & region
            if not condition.a or condition.b or not chosen.any():
                continue
            faces.append(of_wall[chosen])
            cells.append(of_cells[chosen])
            of_sides.append(np.full(faces[-1].size, 2 * axis + side))
            a.append(np.full(faces[-1].size, float(condition.a)))
    joined = [np.concatenate([np.zeros(0, int), *parts]) for parts in (faces, cells, of_sides)]
    return _with_geometry(grid, geometry, joined, np.concatenate([np.zeros(0), *a]))


def _with_geometry(grid, geometry, numbers, a):
    """Return the faces with their areas, normals and centres; `numbers` are faces, cells and sides."""
    faces, cells, sides = numbers
    places: Any = np.unravel_index(cells, grid.shape)
    across, upper = sides // 2, sides % 2
    areas = geometry.apertures[faces]
    normals, centroids = [], []
    for axis in range(grid.dim):
        is_across = across == axis
        areas = areas * np.where(is_across, 1.0, grid.widths[axis][places[axis]])
        normals.append(np.where(is_across, 1.0 - 2.0 * upper, 0.0))
        nodes = grid.coordinates(axis, "nodes")
        ends = nodes[0] + upper * grid.size[axis]
        centroids.append(np.where(is_across, ends, grid.coordinates(axis)[places[axis]]))
    return GridWalls(faces, cells, sides, a, areas, normals, centroids)


def are_near(grid: Grid, cells: NDArray[np.int64], reach: int) -> NDArray[np.bool_]:
    """Return the mask of the cells that are up to `reach` cells from one of some cells, along each axis."""
    mask = np.zeros(grid.cells.size, bool)
    mask[cells] = True
    mask = mask.reshape(grid.shape)
    for axis, n in enumerate(grid.shape):
        result = mask.copy()
        for step in range(1, min(reach, n - 1) + 1):
            for direction in (-step, step):
                moved = np.roll(mask, direction, axis)
                if not grid.periodic[axis]:
                    entering = slice(0, step) if direction > 0 else slice(n - step, n)
                    moved[(slice(None),) * axis + (entering,)] = False
                result |= moved
        mask = result
    return mask
