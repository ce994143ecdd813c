"""The projection of a velocity whose density varies: v - grad p / rho, with a divergence of 0.

With the mask K of open faces, the divergence D, the pressure gradient G and the density rho on faces,

    w = K v + G q / rho,    -D (G q / rho) = D K v.

The density of a face is the mean density of its control volume: half of each adjacent cell. 1 / rho on faces is then
the harmonic average of 1 / rho in the cells. Both cells of a face through which fluid flows are fluid; the density of
solid cells, and of faces that touch one, has no effect.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.validation import check_in_range, check_kind, check_plain
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import cast, dtype_of, isbox, real_dtype, sample
from sparsedp.errors import NonFiniteError, ShapeError
from sparsedp.flow.fluid_cells import FluidPart
from sparsedp.flow.variable_diffusion import solved_in_batch
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.harmonic import lower_share
from sparsedp.operators.masks_and_lift import check_solid, mask, solid_faces
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import adjacent_cell, to_faces
from sparsedp.operators.structure.factor import Factor
from sparsedp.solvers.parametric import EllipticSolver

if TYPE_CHECKING:
    from sparsedp.flow.projection_setup import ProjectionSetup
    from sparsedp.grid.grid import Grid

__all__ = ["WeightedProjection", "density_on_faces"]


def density_on_faces(grid: Grid) -> Operator:
    """Return the Operator from a density in cells to the density of the control volumes of faces.

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
        self._setup = setup
        self._to_faces = density_on_faces(grid)
        self._open = mask(grid.faces, setup.open)
        self._fluid_cells = FluidPart.of_cells(grid, setup.solid)
        self._fluid_faces = FluidPart(grid.faces, np.logical_or(*solid_faces(grid, check_solid(grid, setup.solid))))
        self._divergence = divergence(grid)
        self._gradient = gradient(grid, setup.pressure_conditions, setup.solid)
        self.solver = EllipticSolver(self._divergence, self._gradient, setup.settings)

    def face_density(self, density: Any, dtype: np.dtype) -> Any:
        """Return the density of the control volumes of faces, or a number.

        Parameters
        ----------
        density : number or array
            > 0 in the fluid; an array on cells or on faces, with one leading axis or without.
        dtype : dtype
            Dtype of the velocity, whose precision the result has.

        Returns
        -------
        number or array on faces

        Raises
        ------
        ShapeError
            If an array has neither the shape of the cells nor of the faces.
        TypeError
            If the density does not hold real numbers.
        ValueError, NonFiniteError
            If the density is not > 0 and finite in the fluid.
        """
        grid = self._open.domain.grid
        grid.backend.check("density in projection")
        value = density
        check_plain("density of projection", density)
        if not isbox(density):
            value = np.asarray(density)
        shape = np.shape(sample(value))
        fields = (grid.cells.shape, grid.faces.shape)
        if shape != () and shape not in fields and shape[1:] not in fields:
            raise ShapeError(
                f"projection takes a density that is a number or a field on {grid.cells} or {grid.faces}, got an array "
                f"of shape {shape}"
            )
        check_kind("density of projection", dtype_of(value), "real numbers", "; write its .real")
        if shape == ():
            check_values(partial(check_in_range, "density of projection", needs="> 0"), value)
        elif grid.cells.shape in (shape, shape[1:]):
            value = self._fluid_values(self._fluid_cells, value, "in cell")
            if np.shape(sample(value)) != ():
                value = self._to_faces(value)
        else:
            value = self._fluid_values(self._fluid_faces, value, "on face")
        return cast(value, real_dtype(dtype))

    def _fluid_values(self, fluid: FluidPart, density: Any, where: str) -> Any:
        """Return a density with values outside of the fluid replaced; 1 where there is no fluid."""
        check_values(partial(_check_density_of_fluid, fluid, where), density)
        if fluid.empty:
            return 1.0
        return fluid.filled(density)

    def split(self, v: Any, density: Any) -> tuple[Any, Any]:
        """Return the velocity without divergence, and the q of the module docstring.

        They are computed in double precision and rounded once, because ratios of densities multiply rounding errors.

        Parameters
        ----------
        v : array on faces; leading axes are a batch
        density : number or array on faces
            As `face_density` returns it.

        Returns
        -------
        w : array like v
        q : array on cells
            With the leading axes of v.

        Raises
        ------
        NonFiniteError
            If v contains NaN or infinity, or the reciprocal of the density overflows or is 0.
        """
        check_values(self._setup.check_faces, v)  # on walls too, where the values are not used
        check_values(_check_reciprocal, density)
        batches = np.shape(v)[:-1], np.shape(density)[:-1]
        if all(batches) and batches[0] != batches[1]:
            raise ShapeError(
                f"projection needs one size of the batch, got {batches[0][0]} velocities and {batches[1][0]} "
                "densities; give both the same leading axis, or only one of them"
            )
        v = self._open(v)
        dtype = dtype_of(v)
        v = cast(v, np.result_type(dtype, float))
        density = cast(density, np.dtype(float))
        q = solved_in_batch(self.solver, 1.0 / density, self._divergence(v))
        return cast(v + self._gradient(q) / density, dtype), cast(q, dtype)


def _check_reciprocal(density):
    """Raise an error for a density that is 0 or infinite in its dtype, or whose reciprocal is."""
    density = np.asarray(density)
    with np.errstate(divide="ignore", over="ignore"):
        reciprocal = 1.0 / density
    usable = np.logical_and(reciprocal > 0, reciprocal < np.inf)
    if not np.all(usable):
        raise NonFiniteError(
            f"the density and its reciprocal must be finite in {density.dtype}, got a density of "
            f"{density.flat[np.argmin(usable)]:.6g}; write the density in other units"
        )


def _check_density_of_fluid(fluid, where, density):
    check_in_range("density of projection", fluid.with_ones(density), "> 0", where)
