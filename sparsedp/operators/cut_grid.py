"""The geometry of the fluid around a body whose wall cuts the cells of the grid, as fields on the grid."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.tape import sample
from sparsedp.operators.cut_geometry import cut_geometry, level_at_nodes, protect, sum_at_places
from sparsedp.operators.masks_and_lift import Body

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid

__all__ = ["CutGrid"]


class CutGrid(Body):
    """The geometry of the fluid around a body with a curved wall, as fields on the grid.

    Parameters
    ----------
    grid : Grid
    level : array, shape `grid.nodes.shape`, or callable
        As `cut_cells` takes it.

    Attributes
    ----------
    fractions, volumes : arrays, shape `grid.shape`
        Fluid fraction and fluid volume [length^dim] of each cell.
    apertures : array, shape (faces.size,)
        Fluid fraction of each face.
    areas : array, shape `grid.shape`
        Area of the wall in each cell [length^(dim - 1)].
    is_fluid : bool array, shape `grid.shape`
        Whether a cell holds fluid.
    """

    def __init__(self, grid: Grid, level: Any) -> None:
        self.grid = grid
        self._geometry = cut_geometry(grid, level_at_nodes("cut_cells", grid, level))
        self.fractions = anp.reshape(self._geometry.fractions, grid.shape)
        self.volumes = self.fractions * grid.volumes
        self.apertures = self._geometry.apertures
        self.is_fluid: NDArray[np.bool_] = np.asarray(sample(self.fractions)) > 0
        self._is_open = np.asarray(sample(self.apertures)) > 0
        self._at_walls = sum_at_places(self._geometry.cut, grid.cells)  # from cut cells to a field
        self.areas = self._at_walls(self._geometry.areas)
        protect(self.fractions, self.volumes, self.apertures, self.is_fluid, self.areas)

    @cached_property
    def normals(self) -> tuple:
        """Unit normal of the wall that points into the fluid: one cell field for each axis, 0 in cells without wall."""
        normals = tuple(self._at_walls(normal) for normal in self._geometry.normals)
        protect(*normals)
        return normals

    @cached_property
    def centroids(self) -> tuple:
        """Where `values` belong: coordinates of the centroid of the wall, and of the centre in cells without wall."""
        cut = self._geometry.cut
        pairs = zip(self.grid.centres(), self._geometry.centroids, strict=True)
        centroids = tuple(centre + self._at_walls(of_wall - centre.reshape(-1)[cut]) for centre, of_wall in pairs)
        protect(*centroids)
        return centroids

    @cached_property
    def _divisors(self):
        """The fluid volumes, and 1 in cells without fluid."""
        return anp.where(self.is_fluid, self.volumes, 1.0)

    def _in_cut_cells(self, field):
        """Return the values of a cell field, or of a batch of them, in the cut cells; shape (..., m)."""
        return self._flat(field)[..., self._geometry.cut]

    def _flat(self, field):
        """Return a cell field, or a batch of them, with one axis for the cells."""
        shape = np.shape(field)
        return anp.reshape(field, (*shape[: len(shape) - self.grid.dim], self.grid.cells.size))
