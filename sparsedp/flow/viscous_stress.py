"""The viscous stress of a flow whose viscosity varies in space: div(mu (grad v + grad v^T)) on faces.

The stress has one entry for each component c of the velocity and each axis a, on the sides across a of the control
volumes of c: 2 mu dv_c/dx_c in the cells for a = c, otherwise mu (dv_c/dx_a + dv_a/dx_c) on the edges (in 2-D: on the
corners of cells). With the slopes S v, the walls' contribution W and the transposed slopes T v,

    L(mu) v = C (mu (S v + W walls + T v)),    shear rate = sqrt(2 D : D),    D = (grad v + grad v^T) / 2,

where C is the divergence over the control volumes. On edges mu is the harmonic average of the four cells, with which
the stress between two layers of fluid is exact. Beside obstacles it is the average of the fluid cells among them,
so that the values of mu in solid cells have no effect.

T v affects only faces whose velocity is unknown. On the ends of an axis it is chosen so that C T v is the gradient of
the divergence, which is 0: there dv_a/dx_c = 0, and dv_c/dx_c is as in the last cell. For a constant viscosity L(mu)
therefore equals mu times `face_laplacian`, at outflow boundaries too.
"""

from __future__ import annotations

from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp.flow.fluid_cells import CellsAround, FluidPart
from sparsedp.flow.momentum import (
    MomentumFluxes,
    WallSide,
    at_wall,
    conditions_along,
    free_face_mask,
    gradient_around,
    wall_sides,
    wall_velocities,
)
from sparsedp.flow.variable_diffusion import DiffusionForm
from sparsedp.grid.boundary_conditions import dirichlet, neumann
from sparsedp.grid.space import Space
from sparsedp.operators.harmonic import harmonic_pair, lower_share
from sparsedp.operators.masks_and_lift import check_solid, mask, solid_faces
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import (
    adjacent_cell,
    along,
    differences,
    kronecker_operator,
    mean_of_faces,
    slope_terms,
    slopes,
    wall_slopes,
)
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Term

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.flow.settings import FlowSettings
    from sparsedp.grid.grid import Grid

__all__ = ["ViscousStress"]


class ViscousStress(DiffusionForm):
    """The factors of L(mu), and the shear rate; see the module docstring.

    Parameters
    ----------
    settings : FlowSettings
    sides : tuple
        The flow conditions as `resolve` returns them.
    """

    def __init__(self, settings: FlowSettings, sides: tuple) -> None:
        grid = settings.grid
        grid.backend.check("a viscosity that varies in flow_step")
        gain = MomentumFluxes(grid, sides).gain
        free = mask(grid.faces, free_face_mask(grid, sides, settings.solid))
        self._grid = grid
        self._sites = gain.domain
        self._number = {pair: number for number, pair in enumerate(product(range(grid.dim), repeat=2))}
        self._velocity_slopes = self._slopes(sides, settings.solid, settings.solid_boundary)
        self.wall_slopes = self._slopes_at_walls(sides)
        self.slopes = self._velocity_slopes + self._transposed_slopes()
        self.divergence = free @ gain
        self._fluid = FluidPart.of_cells(grid, settings.solid)
        self._cells: dict[Any, Operator] = {
            ends: self._cells_beside(*ends) for ends in product((False, True), repeat=2)
        }
        share_along_component = self._shares(0)
        share_along_axis = self._shares(1)
        if settings.solid is not None:
            solid = check_solid(grid, settings.solid)
            around = CellsAround(self._cells, solid, (share_along_component, share_along_axis))
            self._cells = around.cells
            share_along_axis = around.share
        self._across_component = harmonic_pair(share_along_component)
        self._across_axis = harmonic_pair(share_along_axis)
        self._strain, self._to_cells = self._invariant()
        self.at_sites = self._harmonic_average

    def _harmonic_average(self, mu: Any) -> Any:
        """Return the viscosity on the sites of the stress, from one value for each cell."""
        lower, upper = (
            self._across_component(self._cells[False, side](mu), self._cells[True, side](mu)) for side in (False, True)
        )
        return self._across_axis(lower, upper)

    def shear_rate(self, v: Any, walls: Any = None) -> Any:
        """Return the shear rate in each cell, for a velocity on faces and the velocities of walls (None: 0).

        Its derivative is 0 where the shear rate is 0. Solid cells have the value of a fluid cell, so that a viscosity
        that is infinite at rest is finite there.
        """
        slopes_of_v = self._velocity_slopes(v)
        if walls is not None:
            slopes_of_v = slopes_of_v + self.wall_slopes(walls)
        square = self._fluid.filled(self._to_cells(self._strain(slopes_of_v) ** 2))
        at_rest = square == 0
        return anp.where(at_rest, 0.0, anp.sqrt(anp.where(at_rest, 1.0, square)))

    def _slopes(self, sides: tuple, solid: Any, solid_boundary: Any) -> Operator:
        """Return S: dv_c/dx_a, with walls and obstacles at rest; 0 on the outer sides of the control volumes at walls.

        Around obstacles the faces of a component are taken as the cells of an auxiliary grid, as in `face_laplacian`.
        """
        grid = self._grid
        blocks: dict = {}
        for (c, a), number in self._number.items():
            if a == c:
                blocks[number, c] = along(c, grid.dim, _between_ends(grid, c, repeated=False))
            else:
                blocks[number, c] = slope_terms(grid, a, conditions_along(grid, sides, a, c))
        op = kronecker_operator(grid.faces, self._sites, blocks, "slopes")
        if solid is None:
            return op
        closed = grid.faces.split(np.logical_or(*solid_faces(grid, check_solid(grid, solid))))
        rows = self._sites.offsets
        columns = grid.faces.offsets
        blocks_of_rows = []
        for (c, a), number in self._number.items():
            block = op.matrix[rows[number] : rows[number + 1]]
            if a != c:
                around = gradient_around(grid, c, sides, closed[c], solid_boundary.along)
                first, last = around.codomain.offsets[a : a + 2]
                before = sp.csr_array((last - first, columns[c]))
                after = sp.csr_array((last - first, columns[-1] - columns[c + 1]))
                block = sp.hstack([before, around.matrix[first:last], after])
            blocks_of_rows.append(block)
        return Operator(Matrix(sp.vstack(blocks_of_rows, format="csr")), grid.faces, self._sites, "slopes")

    def _slopes_at_walls(self, sides: tuple) -> Operator:
        """Return W: the contribution of the tangential wall velocities to the slopes."""
        grid = self._grid
        blocks: dict = {}
        for part, (axis, side, component) in enumerate(wall_sides(grid, sides)):
            factor = wall_slopes(grid, axis, side, dirichlet)
            entry = WallSide(axis, side, component)
            blocks[self._number[component, axis], part] = at_wall(grid, sides, entry, factor)
        return kronecker_operator(wall_velocities(grid, sides), self._sites, blocks, "wall slopes")

    def _transposed_slopes(self) -> Operator:
        """Return T: dv_a/dx_c on the sites of component c and axis a."""
        grid = self._grid
        blocks: dict = {}
        for (c, a), number in self._number.items():
            if a == c:
                factor = _between_ends(grid, c, repeated=True)
            else:
                factor = slopes(grid, c, None if grid.periodic[c] else (neumann, neumann))
            blocks[number, a] = along(c, grid.dim, factor)
        return kronecker_operator(grid.faces, self._sites, blocks, "transposed slopes")

    def _cells_beside(self, above_component: bool, above_axis: bool) -> Operator:
        """Return the Operator that takes one of the four cells around each edge, and the cell itself in cells."""
        grid = self._grid
        blocks: dict = {}
        for (c, a), number in self._number.items():
            factors: list[Factor | None] = [None] * grid.dim
            if a == c:
                factors[c] = _cells_with_ends(grid, c)
            else:
                factors[c] = adjacent_cell(grid, c, above_component)
                factors[a] = adjacent_cell(grid, a, above_axis)
            blocks[number, 0] = (Term(1.0, tuple(factors)),)
        return kronecker_operator(grid.cells, self._sites, blocks, "cells around sites")

    def _shares(self, place: int) -> NDArray:
        """Return the weight of the lower cell on each site, along its component (place 0) or its axis (place 1)."""
        grid = self._grid
        shares = []
        for pair, shape in zip(self._number, self._sites.parts, strict=True):
            if pair[0] == pair[1]:
                share: Any = 0.5
            else:
                share = lower_share(grid, pair[place])
            shares.append(np.broadcast_to(share, shape).reshape(-1))
        return np.concatenate(shares)

    def _invariant(self) -> tuple[Operator, Operator]:
        """Return the Operators F and M with shear rate^2 = M (F slopes)^2.

        F takes dv_c/dx_c in cells and dv_c/dx_a + dv_a/dx_c on edges; M sums their squares, those on edges averaged to
        cells.
        """
        grid = self._grid
        strain: dict = {}
        to_cells: dict = {}
        parts = []
        for c in range(grid.dim):
            number = self._number[c, c]
            strain[c, number] = along(c, grid.dim, Factor(_cells_with_ends(grid, c).matrix.T * _inside(grid, c)))
            to_cells[0, c] = along(c, grid.dim, None, 2.0)
            parts.append(grid.shape)
        for part, (c, a) in enumerate(combinations(range(grid.dim), 2), grid.dim):
            for number in (self._number[c, a], self._number[a, c]):
                strain[part, number] = along(c, grid.dim, None)
            factors: list[Factor | None] = [None] * grid.dim
            factors[c] = mean_of_faces(grid, c)
            factors[a] = mean_of_faces(grid, a)
            to_cells[0, part] = (Term(1.0, tuple(factors)),)
            parts.append(self._sites.parts[self._number[c, a]])
        strains = Space(None, "strains", grid, parts)
        return (
            kronecker_operator(self._sites, strains, strain, "strain"),
            kronecker_operator(strains, grid.cells, to_cells, "squares to cells"),
        )


def _between_ends(grid: Grid, axis: int, repeated: bool) -> Factor:
    """Return the differences in cells, and at each end of a bounded axis 0 or the difference in the last cell."""
    inner = differences(grid, axis).matrix
    if grid.periodic[axis]:
        return Factor(inner)
    if repeated and grid.shape[axis]:
        return Factor(sp.vstack([inner[[0]], inner, inner[[-1]]], format="csr"))
    zero = sp.csr_array((1, inner.shape[1]))
    return Factor(sp.vstack([zero, inner, zero], format="csr"))


def _cells_with_ends(grid: Grid, axis: int) -> Factor:
    """Return the values in cells; on a bounded axis, the first and the last value are repeated at the ends."""
    cells = np.arange(grid.shape[axis])
    if not grid.periodic[axis] and cells.size:
        cells = np.concatenate([cells[:1], cells, cells[-1:]])
    rows = np.arange(cells.size)
    return Factor.from_diagonals(
        (max(cells.size, 2 * (not grid.periodic[axis])), grid.shape[axis]), (rows, cells, np.ones(rows.size))
    )


def _inside(grid: Grid, axis: int) -> NDArray:
    """Return 1 for cells and 0 for the ends of a bounded axis."""
    if grid.periodic[axis]:
        return np.ones(grid.shape[axis])
    return np.pad(np.ones(grid.shape[axis]), 1)
