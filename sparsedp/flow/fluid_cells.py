"""Coefficients beside obstacles: the values of a viscosity, diffusivity or density in solid cells have no effect.

The values of fluid cells enter fluxes through the faces between two fluid cells, and the stress on edges with a fluid
cell. Values in solid cells, which may be NaN, are replaced by one of a fluid cell before anything is computed from
them; their derivative is therefore 0.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp.operators.masks_and_lift import check_solid
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.grid.space import Space

__all__ = ["CellsAround", "FluidPart"]


class FluidPart:
    """The entries of fields on a space that belong to the fluid.

    Parameters
    ----------
    space : Space
    solid : bool array of the size of the space, or None
        The other entries; None stands for none.

    Attributes
    ----------
    empty : bool
        Whether the fluid has no entry.
    """

    def __init__(self, space: Space, solid: NDArray | None) -> None:
        self._space = space
        self._fluid: Any = None
        if solid is not None and np.any(solid):
            self._fluid = ~np.asarray(solid).reshape(space.shape)
            self.empty = not np.any(self._fluid)
        else:
            self.empty = space.size == 0

    @classmethod
    def of_cells(cls, grid: Grid, solid: ArrayLike | None) -> FluidPart:
        """Return the fluid cells of a grid with solid cells, or without (None)."""
        return cls(grid.cells, None if solid is None else check_solid(grid, solid))

    def filled(self, values: Any) -> Any:
        """Return values in which all entries outside of the fluid have the value of the first entry in the fluid."""
        if self._fluid is None:
            return values
        return self._fill(values)

    @cached_property
    def _fill(self) -> Operator:
        """The Operator of `filled`."""
        size = self._space.size
        fluid = self._fluid.reshape(-1)
        source = np.where(fluid, np.arange(size), np.argmax(fluid))
        matrix = sp.csr_array((np.ones(size), source, np.arange(size + 1)), shape=(size, size))
        return Operator(Matrix(matrix), self._space, self._space, "fluid values")

    def with_ones(self, values: NDArray) -> NDArray:
        """Return plain values in which all entries outside of the fluid are 1, for checks."""
        if self._fluid is None:
            return values
        return np.where(self._fluid, values, 1.0)


class CellsAround:
    """The four cells around edges, of which solid ones are replaced by fluid ones.

    A solid cell is replaced by the other cell of its pair along the first direction. If both are solid, the pair is
    replaced by the other pair. With `share`, the harmonic average of the pairs equals the average of the fluid cells,
    weighted by their areas: 1 / k = (sum of w_i / k_i) / (sum of w_i).

    Parameters
    ----------
    cells : dict
        Maps (whether above along the first direction, whether above along the second one) to the Operator that takes
        this cell, with one entry 1 in each row.
    solid : bool array on cells
    shares : pair of arrays
        The weights of the lower cells along the first and along the second direction.

    Attributes
    ----------
    cells : dict
        As the argument. The value is 0 on edges whose cells are all solid.
    share : array
        The weight of the lower pair along the second direction.
    """

    def __init__(
        self, cells: dict[tuple[bool, bool], Operator], solid: NDArray, shares: tuple[NDArray, NDArray]
    ) -> None:
        self._solid = np.concatenate([[True], solid.reshape(-1)])  # number 0: no cell
        numbers = {sides: _cell_numbers(op) for sides, op in cells.items()}
        self.share = self._share(numbers, *shares)
        pairs = {}
        for above in (False, True):
            lower = numbers[False, above]
            upper = numbers[True, above]
            pairs[False, above] = np.where(self._solid[lower], upper, lower)
            pairs[True, above] = np.where(self._solid[upper], lower, upper)
        self.cells = {}
        for (side, above), number in pairs.items():
            fluid = np.where(self._solid[number], pairs[side, not above], number)
            self.cells[side, above] = self._picking(fluid, cells[side, above])

    def _share(self, numbers, first, second):
        """Return the weight of the lower pair, by the areas of the fluid cells."""
        areas = {}
        for above, weight in ((False, second), (True, 1 - second)):
            lower = ~self._solid[numbers[False, above]]
            upper = ~self._solid[numbers[True, above]]
            areas[above] = weight * (first * lower + (1 - first) * upper)
        total = areas[False] + areas[True]
        return np.divide(areas[False], total, out=np.zeros_like(total), where=total > 0)

    def _picking(self, numbers, op):
        """Return the Operator that takes the cells of these numbers, in the place of `op`."""
        rows = np.flatnonzero(~self._solid[numbers])
        matrix = sp.csr_array((np.ones(rows.size), (rows, numbers[rows] - 1)), shape=op.shape)
        return Operator(Matrix(matrix), op.domain, op.codomain, "fluid cells around sites")


def _cell_numbers(op):
    """Return 1 + the index of the cell that each row takes, 0 for a row without a cell."""
    return (op.matrix @ np.arange(1.0, op.domain.size + 1)).astype(np.int64)
