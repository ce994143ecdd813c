"""The parts of a projection, set up once, and its solve, forward and transposed.

With K the mask of the faces that are not closed, D the divergence, G the gradient of the pressure (0 on closed faces
and on faces with a given velocity), and A = -D G,

    A p   = D K x,      w = K x + G p,
    A^T q = G^T g,      z = K (g + D^T q).

The second line is the transpose of the map from x to w. For the transpose of the map from x to p, replace G^T g by the
cotangent s of p, which is a cell field, and set g = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.validation import check_finite, place
from sparsedp.errors import NonFiniteError
from sparsedp.flow.projection_passes import CompiledPasses, OperatorPasses, compiled_passes
from sparsedp.grid.boundary_conditions import MixedWall, inflow, mapped_wall, no_slip, occurring, resolve, walls_of
from sparsedp.grid.grid import Grid
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.masks_and_lift import check_solid, solid_faces
from sparsedp.operators.structure.base import Transposable
from sparsedp.solvers.inverse import build
from sparsedp.solvers.scaling import exponent_of, in_range, largest, shifted

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from sparsedp.operators.operator import Operator
    from sparsedp.operators.structure.base import Structure
    from sparsedp.solvers.choose_method import SolveSettings

__all__ = ["ProjectionSetup", "mask_of_faces", "pressure_conditions"]

FEW_CELLS = 1024  # on grids with fewer cells, transforms are tried first, where `inverse` would factor the matrix


class ProjectionSetup(Reconstructible):
    """The closed faces, D, G and the inverse of A = -D G of a projection.

    The operators are built on a copy of the grid whose lengths are scaled to about 1, so that squares of lengths do not
    overflow or underflow. This does not change P, which is independent of the unit of length.

    Parameters
    ----------
    grid : Grid
    solid, boundary
        As `projection` takes them.
    settings : SolveSettings
        Settings of the pressure solve.

    Attributes
    ----------
    sides : tuple
        The flow conditions as `resolve` returns them.
    open : bool array on faces
        The mask K of the faces that are not closed.
    exponent : int
        The lengths of `grid` are 2**exponent times the lengths of the scaled grid.
    inverse : Inverse
        The inverse of A.
    products : tuple of two OperatorPasses
        The passes of the forward and of the transposed projection.
    passes : tuple
        The passes that are used: compiled loops if available, else `products`.
    """

    passes: tuple[OperatorPasses | CompiledPasses, ...]

    def __init__(self, grid: Grid, solid: ArrayLike | None, boundary: Any, settings: SolveSettings) -> None:
        self.grid = grid
        self.sides = resolve(grid, boundary, no_slip, patches=True)
        if solid is None:
            self.solid = None
        else:
            self.solid = check_solid(grid, solid).copy()
        self.settings = settings
        self.pressure_conditions = pressure_conditions(grid, self.sides)
        self.open = mask_of_faces(grid, self.sides, self.solid, lambda condition: not condition.closed)
        self.exponent = exponent_of(max((float(h.max(initial=0.0)) for h in grid.widths), default=1.0))
        spacing = [np.ldexp(h, -self.exponent) for h in grid.widths]
        scaled_grid = grid.backend.place(Grid(grid.shape, spacing=spacing, periodic=grid.periodic))
        D = divergence(scaled_grid)
        G = gradient(scaled_grid, self.pressure_conditions, self.solid)
        self._divergence = D
        self._gradient = G
        self.inverse = self._pressure_inverse(-D @ G)
        self._check_inflow_can_leave()
        self._set_up_passes()

    def _pressure_inverse(self, op: Operator) -> Any:
        """Return the inverse of A.

        On small grids too, transforms are preferred to a factorization, because only with transforms the compiled
        passes can be used.
        """
        settings = self.settings
        if settings.method == "auto" and op.domain.size < FEW_CELLS and op.separable:
            with suppress(ValueError):  # raised if an axis cannot be diagonalised accurately
                return build(op, replace(settings, method="separable"), "pressure solve")
        return build(op, settings, "pressure solve")

    def _set_up_passes(self) -> None:
        """Set up the passes of the forward and of the transposed projection."""
        D = self._divergence
        G = self._gradient
        kept = self.open.astype(float)
        self.products = (
            OperatorPasses(D.structure, G.structure, kept),
            OperatorPasses(G.T.structure, D.T.structure, kept),
        )
        ones = np.ones(self.grid.faces.size)
        self._magnitudes = [largest(products.first.magnitude()(ones)) for products in self.products]
        self.passes = self.products
        if self._is_separable:
            forward, transposed = (compiled_passes(self.grid, products) for products in self.products)
            if forward is not None and transposed is not None:
                self.passes = (forward, transposed)

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        conditions = {axis: pair for axis, pair in zip(self.grid.axes, self.sides, strict=True) if pair}
        return type(self), (self.grid, self.solid, conditions, self.settings)

    @property
    def info(self) -> Any:
        """SolveLog of the pressure solves."""
        return self.inverse.info

    def structure(self) -> Structure:
        """Return the linear map P on flat face fields."""
        size = self.grid.faces.size
        return ProjectionStructure(self, (size, size))

    def pressure_structure(self) -> Structure:
        """Return the linear map from flat face fields to the pressure."""
        return PressureStructure(self, (self.grid.cells.size, self.grid.faces.size))

    @property
    def _is_separable(self) -> bool:
        return self.inverse.method == "separable" and self.grid.cells.size > 0

    def split(self, x: NDArray, out: NDArray, transposed: bool = False) -> NDArray:
        """Set `out` to w for a flat face field x, and return p; if `transposed`, set it to z and return q."""
        p = self._split(x, out, transposed)
        if self.nothing_flows:
            out[:] = 0.0
        return p

    def _split(self, x: NDArray, out: NDArray, transposed: bool) -> NDArray:
        solver = self.inverse.solver
        solve_transposed = transposed and not self.symmetric
        passes = self.passes[transposed]
        b = np.empty(self.grid.cells.size)

        def residual_norm(p):
            """Return the norm of the residual of the solve, which is the net flow of the result."""
            passes.push(x, p, out)
            return passes.net_flow(out, b)[0]

        b_norm, x_norm = passes.net_flow(x, b)
        scale = self._magnitudes[transposed] * x_norm
        if in_range(scale):
            if self._is_separable:
                p = solver.solve_once(b, b_norm, scale, residual_norm, transposed, solve_transposed)
                if p is not None:
                    return p
                passes.net_flow(x, b)
        else:
            largest_entry = largest(x)
            if 0 < largest_entry < np.inf and not in_range(largest_entry):  # squares would overflow or underflow
                exponent = exponent_of(largest_entry)
                p = self._split(shifted(x, -exponent), out, transposed)
                out[:] = shifted(out, exponent)
                return shifted(p, exponent)
        forward_record = self.info.forward
        try:
            p = solver.solve(b, solve_transposed, checked=False)
        except NonFiniteError:
            self.check_faces(x, transposed)
            raise
        if transposed and self.symmetric:
            self.info.adjoint = self.info.forward
            self.info.forward = forward_record
        passes.push(x, p, out)
        return p

    def pressure_transpose(self, source: NDArray, out: NDArray) -> None:
        """Apply the transpose of the map from x to p: set `out` to z = K D^T q, where A^T q = s for the source s."""
        q = self.inverse.solver.solve(source, True, checked=False)
        self.passes[True].push(np.zeros(out.size), q, out)

    def check_faces(self, x: NDArray, transposed: bool = False) -> None:
        """Raise NonFiniteError that names the first face with a velocity, or cotangent, that is not finite."""
        space = self.grid.faces

        def place_of_face(index):
            axis = int(np.searchsorted(space.offsets, index, side="right")) - 1
            return f"{self.grid.axes[axis]}-face {place(index - space.offsets[axis], space.parts[axis])}"

        if transposed:
            name = "the cotangent of projection"
        else:
            name = "the velocity in projection"
        check_finite(name, x, where=place_of_face)

    @cached_property
    def nothing_flows(self) -> bool:
        """Whether 0 is the only divergence-free flow: a line of cells with closed ends. P is then 0 up to rounding."""
        closed = all(self.sides) and all(condition.closed for condition in occurring(self.sides))
        return closed and sum(n > 1 for n in self.grid.shape) <= 1

    @cached_property
    def symmetric(self) -> bool:
        """Whether P equals its transpose."""
        return all(self.grid.uniform) and all(condition.closed for condition in occurring(self.sides))

    def _check_inflow_can_leave(self) -> None:
        """Raise ValueError if an inflow enters a region without an outflow."""
        system = self.inverse.solver.system
        if not system.size:
            return
        closed = system.null_space.right != 0
        if system.active is not None:  # inactive: cells without a free face
            closed = closed | ~system.active
        closed = system.whole(closed).reshape(self.grid.shape)
        if self.solid is not None:
            closed = closed & ~self.solid
        for axis, side, wall in walls_of(self.sides):
            enters = np.take(closed, -side, axis)
            if isinstance(wall, MixedWall):
                enters = enters & wall.faces_with(lambda condition: condition == inflow)
            elif wall != inflow:
                continue
            if enters.any():
                name = f"{('lower', 'upper')[side]} {self.grid.axes[axis]} side"
                raise ValueError(f"the inflow on the {name} enters a region without an outflow; open a side of it")


class ProjectionStructure(Transposable):
    """P or P^T on flat face fields, for a `ProjectionSetup`; computed in float64 and rounded once to the dtype of x."""

    def act(self, x: NDArray, out: NDArray) -> None:
        """Set `out` to the projection of x."""
        self.inner.split(x, out, self.transposed)


class PressureStructure(Transposable):
    """The map from a face field v to the p with P v = v + G p, or its transpose.

    In a region where p is determined only up to a constant, its average is set to 0.
    """

    def act(self, x: NDArray, out: NDArray) -> None:
        """Set `out` to the pressure of x."""
        setup = self.inner
        scale = 2.0**setup.exponent
        if self.transposed:
            setup.pressure_transpose(scale * x, out)
        else:
            p = setup.split(x, np.empty(x.size))
            np.multiply(scale, setup.inverse.solver.system.null_space.project(p), out=out)


def pressure_conditions(grid: Grid, sides: tuple) -> dict[str, tuple]:
    """Return the pressure conditions as `gradient` takes them: p = 0 at outflows, a slope of 0 on all other sides."""
    pairs = zip(grid.axes, sides, strict=True)
    return {axis: tuple(mapped_wall(wall, _pressure_condition) for wall in pair) for axis, pair in pairs if pair}


def _pressure_condition(condition: Any) -> Any:
    return condition.pressure


def mask_of_faces(
    grid: Grid, sides: tuple, solid: ArrayLike | None, open_side: Callable[[Any], bool]
) -> NDArray[np.bool_]:
    """Return the flat mask of the faces in the interior and on the sides with a condition that `open_side` accepts.

    Faces that touch an obstacle are False.

    Parameters
    ----------
    grid : Grid
    sides : tuple
        The flow conditions as `resolve` returns them.
    solid : bool array or None
    open_side : callable
        ``open_side(condition)`` returns whether faces on a side with this condition are True.
    """
    flat = np.ones(grid.faces.size, dtype=bool)
    parts = grid.split(flat)
    for axis, side, wall in walls_of(sides):
        if isinstance(wall, MixedWall):
            is_open: Any = wall.faces_with(open_side)
        else:
            is_open = open_side(wall)
        np.moveaxis(parts[axis], axis, 0)[-side] = is_open  # a view: this sets `flat`
    if solid is None:
        return flat
    return flat & ~np.logical_or(*solid_faces(grid, check_solid(grid, solid)))
