"""The projection of a velocity whose density varies: v - grad p / rho, with a divergence of 0.

With the mask K of open faces, the divergence D, the pressure gradient G and the density rho on faces,

    w = K v + G q / rho,    -D (G q / rho) = D K v.

The density of a face is that of its control volume: half of each adjacent cell. 1 / rho on faces is then the harmonic
average of 1 / rho in the cells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import scipy.sparse as sp

from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.harmonic import lower_share
from sparsedp.operators.masks_and_lift import mask
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import adjacent_cell, to_faces
from sparsedp.operators.structure.factor import Factor
from sparsedp.solvers.parametric import EllipticSolver

if TYPE_CHECKING:
    from sparsedp.flow.projection_setup import ProjectionSetup
    from sparsedp.grid.grid import Grid

__all__ = ["WeightedProjection", "density_on_faces"]


def density_on_faces(grid: Grid) -> Operator:
    """Return the Operator from a density in cells to that of the control volumes of faces.

    Parameters
    ----------
    grid : Grid
    """
    factors = []
    for axis in range(grid.dim):
        lower = lower_share(grid, axis).reshape(-1)
        below = adjacent_cell(grid, axis, False).matrix
        above = adjacent_cell(grid, axis, True).matrix
        factors.append(Factor(sp.diags_array(lower) @ below + sp.diags_array(1 - lower) @ above))
    return to_faces("density on faces", grid, factors)


class WeightedProjection:
    """The projection for a density on faces, differentiable in both; see the module docstring.

    Parameters
    ----------
    setup : ProjectionSetup
        Conditions, obstacles and solver settings.
    """

    def __init__(self, setup: ProjectionSetup) -> None:
        grid = setup.grid
        self._open = mask(grid.faces, setup.open)
        self._divergence = divergence(grid)
        self._gradient = gradient(grid, setup.pressure_conditions, setup.solid)
        self.solver = EllipticSolver(self._divergence, self._gradient, setup.settings)

    def split(self, v: Any, density: Any) -> tuple[Any, Any]:
        """Return the velocity without divergence, and the q of the module docstring."""
        v = self._open(v)
        q = self.solver(1.0 / density, self._divergence(v))
        return v + self._gradient(q) / density, q
