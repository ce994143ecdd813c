"""Values of a cell field on both sides of each open face, of order 1 or 2, for upwind fluxes in cut cells.

With order 1 the value of a side is the value of its cell. With order 2 it is extrapolated over half the width of the
cell, with van Leer's mean s of the slopes a and b on both faces of the cell along an axis,

    s = 2 a b / (a + b) where a b > 0, and 0 elsewhere.

The slope is 0 on faces that the body closes and where the fluid leaves through a wall of the grid; where it enters, the
slope is that to the entering value. If it enters slower than a tenth of the speed on the opposite face of the cell,
this slope is multiplied by ten times the quotient of both speeds, so that all fluxes are continuous in the velocity.
Cells beside the body have order 1, without new extrema.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp.autodiff.tape import sample
from sparsedp.operators.given import from_matrix
from sparsedp.operators.stencils import adjacent_cell, to_faces

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.operators.operator import Operator

__all__ = ["FaceValues"]

# The slope on a wall of the grid is used without reduction if the inflow is at least 1 / FULL of the speed on the
# opposite face.
FULL = 10.0


class FaceValues:
    """The values of a cell field on both sides of each face.

    Parameters
    ----------
    grid : Grid
    is_open : bool array, shape (faces.size,)
        Whether a face holds fluid.

    Attributes
    ----------
    below, above : Operator
        From a cell field to the value of the cell below and above each face.
    at_lower, at_upper : bool arrays, shape (faces.size,)
        The faces on lower and on upper walls of the grid, which have no cell below or above.
    """

    def __init__(self, grid: Grid, is_open: NDArray[np.bool_]) -> None:
        axes = range(grid.dim)
        self.below = to_faces("cell below", grid, [adjacent_cell(grid, axis, False) for axis in axes])
        self.above = to_faces("cell above", grid, [adjacent_cell(grid, axis, True) for axis in axes])
        self.at_lower = _faces_of_walls(grid, 0)
        self.at_upper = _faces_of_walls(grid, -1)
        self._grid = grid
        self._is_open = is_open

    def of_order_1(self, u: Any, entering: Any) -> tuple[Any, Any]:
        """Return the values below and above each face, given a cell field and the values that enter at walls."""
        below = anp.where(self.at_lower, entering, self.below(u))
        above = anp.where(self.at_upper, entering, self.above(u))
        return below, above

    def of_order_2(self, u: Any, v: Any, entering: Any) -> tuple[Any, Any]:
        """Return the values below and above each face, extrapolated from the centres of the cells.

        Parameters
        ----------
        u : array, a real field on the cells; leading axes are a batch
        v, entering : arrays, fields on the faces
            The velocity, and the values that enter at walls.
        """
        below, above = self.of_order_1(u, entering)
        slopes = self._shares_of_slopes(v) * anp.where(self._is_open, (above - below) / self._distances, 0.0)
        for axis in self._axes:
            slope = _van_leer(axis.to_above.T(slopes), axis.to_below.T(slopes))
            change = axis.half_widths * slope
            below = below + axis.to_below(change)
            above = above - axis.to_above(change)
        return below, above

    def _shares_of_slopes(self, v):
        """Return the share of the slope on each face that counts: 1, except on walls of the grid."""
        speeds = anp.abs(v)
        entering = anp.maximum(anp.where(self.at_lower, v, anp.where(self.at_upper, -v, 0.0)), 0.0)
        opposite: Any = 0.0
        for axis in self._axes:
            from_lower = axis.to_above(axis.to_below.T(speeds))
            from_upper = axis.to_below(axis.to_above.T(speeds))
            opposite = opposite + self.at_lower * from_lower + self.at_upper * from_upper
        moves = np.asarray(sample(opposite)) > 0
        full = np.asarray(sample(entering)) > 0
        share = anp.where(moves, anp.minimum(FULL * entering / anp.where(moves, opposite, 1.0), 1.0), full)
        return anp.where(self.at_lower | self.at_upper, share, 1.0)

    @cached_property
    def _axes(self) -> list[_Axis]:
        grid = self._grid
        axes = []
        for axis in range(grid.dim):
            is_of_axis = np.zeros(grid.faces.size)
            is_of_axis[grid.faces.offsets[axis] : grid.faces.offsets[axis + 1]] = 1.0
            has_below = sp.diags_array(is_of_axis * ~self.at_lower)
            has_above = sp.diags_array(is_of_axis * ~self.at_upper)
            shape = [-1 if other == axis else 1 for other in range(grid.dim)]
            axes.append(
                _Axis(
                    from_matrix(has_below @ self.below.matrix, grid.cells, grid.faces, "from the cell below"),
                    from_matrix(has_above @ self.above.matrix, grid.cells, grid.faces, "from the cell above"),
                    0.5 * np.broadcast_to(np.reshape(grid.widths[axis], shape), grid.shape),
                )
            )
        return axes

    @cached_property
    def _distances(self) -> NDArray:
        """The distance between the points of both values of each face: two centres, or a centre and a wall."""
        return np.sum([a.to_below(a.half_widths) + a.to_above(a.half_widths) for a in self._axes], axis=0)


class _Axis(NamedTuple):
    """What belongs to one axis: operators from cells to the faces above and below them, and half of their widths."""

    to_below: Operator
    to_above: Operator
    half_widths: NDArray


def _faces_of_walls(grid, end):
    """Return a mask of the faces on the lower (end 0) or upper (end -1) walls of the grid."""
    parts = [np.zeros(shape, bool) for shape in grid.faces.parts]
    for axis, part in enumerate(parts):
        if not grid.periodic[axis]:
            np.moveaxis(part, axis, 0)[end] = True  # a view
    return np.concatenate([part.reshape(-1) for part in parts])


def _van_leer(a, b):
    """Return van Leer's mean of two slopes."""
    agree = anp.sign(a) * anp.sign(b) > 0
    return anp.where(agree, 2.0 * a * (b / anp.where(agree, a + b, 1.0)), 0.0)
