"""cut_cells: Poisson and diffusion problems around, or inside of, a body whose curved wall cuts the cells of the grid.

The geometry is in cut_geometry.py, the slope at the wall in cut_wall_slope.py, and the operators of finite volumes are
in cut_operators.py. This module solves with them. The equation of a cell with the fluid volume V is

    V (shift u - div(k grad u)) = V b.

No equation divides by the volume of a cell, so that tiny cells do no harm.

References: H. Johansen, P. Colella, J. Comput. Phys. 147 (1998) 60-85; P. Schwartz, M. Barad, P. Colella, T. Ligocki,
J. Comput. Phys. 211 (2006) 531-550; Y. T. Ng, C. Min, F. Gibou, J. Comput. Phys. 228 (2009) 8807-8829.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import copied
from sparsedp._utils.validation import check_in_range, check_plain
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import isbox
from sparsedp.errors import IncompatibleError, ShapeError
from sparsedp.grid.boundary_conditions import neumann
from sparsedp.grid.grid import check_grid
from sparsedp.operators.cut_operators import CutOperators, in_dtype_of
from sparsedp.solvers.choose_method import check_settings
from sparsedp.solvers.parametric import from_coo

if TYPE_CHECKING:
    from sparsedp.grid.grid import Grid
    from sparsedp.solvers.choose_method import SolveSettings
    from sparsedp.solvers.parametric import MatrixSolver

__all__ = ["CutCells", "cut_cells"]

LARGEST_IMBALANCE = 1e-6  # outflow of a cell that `project` may leave, relative to the flow through its faces


def cut_cells(
    grid: Grid,
    level: Any,
    boundary: Any = neumann,
    solid_boundary: Any = neumann,
    method: str = "auto",
    rtol: float = 1e-10,
    maxiter: int | None = None,
    nullspace: str = "raise",
    **options: Any,
) -> CutCells:
    """Return the fluid cells around a body with a curved wall, with their solver, fluxes and operators.

    The wall cuts the cells, instead of following their faces as with a mask of solid cells. Poisson problems have
    order 2, and everything is differentiable in the shape.

    Parameters
    ----------
    grid : Grid
    level : array, shape `grid.nodes.shape`, or callable
        A level set at the nodes [any unit]: > 0 in the fluid, <= 0 in the body, ideally the signed distance to the
        wall. A callable is a function of the coordinates of the nodes, such as ``lambda x, y: ...``.
    boundary : condition, or dict of conditions
        Conditions on the walls of the grid, as for `gradient`.
    solid_boundary : condition
        The condition on the wall of the body: dirichlet, neumann or robin(a, b).
    method, rtol, maxiter, nullspace, **options
        As in `inverse`.

    Returns
    -------
    CutCells
        ``body.solve(b, values)`` solves -div grad u = b, and ``body.flux(u, values)`` is the flux through the wall.

    Raises
    ------
    ShapeError
        If the level does not have the shape of the nodes.
    TypeError
        If the level does not hold real numbers, or `solid_boundary` is not one condition.
    NonFiniteError
        If the level holds NaN or infinity.
    JitError
        If `dp.jit` records the level: which cells are cut depends on its values.

    See Also
    --------
    laplacian, elliptic_solver, projection, transport, brinkman, cut_flow

    Notes
    -----
    **Geometry.** The level is linear in each of the 4 triangles (24 tetrahedra in 3-D) between the centre of a cell and
    its edges, so that plane walls are exact. Parts of a body that are thinner than a cell are not resolved. In gaps
    narrower than about 1.5 cells, u is the mean over the fluid of the cell, and the slope at the wall is that of a
    parabola between two walls. In gaps of up to 2 cells between the body and a wall of the grid (0.6 cells if the body
    has a neumann condition), the mean of u over the gap and the slopes at both walls are those of a parabola, too.

    **Derivatives.** In the level, the right-hand side, the wall values and the coefficients, forward and reverse, to
    every order. As a function of the level the solution is continuous, with kinks where the wall passes a node or a
    centre of a cell; at a node, derivatives are those for a level that sinks. Weight sums by `volumes` or `areas`: the
    value in a tiny cell changes fast with the level.

    **Order.** 2 in the L2 norm, and between 1.5 and 2 in the maximum norm, where the largest errors are in cells with a
    centre in the body. The slope at the wall has order 1 (dirichlet), its integral over the wall order 2.

    References
    ----------
    H. Johansen, P. Colella, J. Comput. Phys. 147 (1998) 60-85.
    P. Schwartz, M. Barad, P. Colella, T. Ligocki, J. Comput. Phys. 211 (2006) 531-550.

    Examples
    --------
    A membrane over a disc, fixed at its edge; its largest deflection is R^2 / 4:

    >>> import autograd.numpy as np
    >>> from sparsedp import Grid, dirichlet, grad
    >>> grid = Grid((32, 32), size=2.0, origin=-1.0)
    >>> disc = cut_cells(grid, lambda x, y: 0.8 - np.sqrt(x**2 + y**2), solid_boundary=dirichlet)
    >>> u = disc.solve(np.ones(grid.shape))
    >>> print(np.round(np.max(u), 3), np.round(np.sum(disc.volumes), 2), np.round(-np.sum(disc.flux(u)), 2))
    0.159 2.01 2.01

    The derivative of the area in the radius R, 2 pi R:

    >>> def area(radius):
    ...     return np.sum(cut_cells(grid, lambda x, y: radius - np.sqrt(x**2 + y**2)).volumes)
    >>> print(np.round(grad(area)(0.8), 2))
    5.03
    """
    check_grid("cut_cells", grid)
    return CutCells(grid, level, boundary, solid_boundary, check_settings(method, rtol, maxiter, nullspace, options))


class CutCells(CutOperators):
    """The fluid cells around a body with a curved wall, as `cut_cells` returns them: geometry, operators and solves.

    Fields on cells hold the value at the centre of the cell; they have no meaning in cells without fluid, where `solve`
    returns 0.

    Parameters
    ----------
    grid, level, boundary, solid_boundary
        As `cut_cells` takes them.
    settings : SolveSettings

    Attributes
    ----------
    info : SolveLog
        Records of the last solves.

    Notes
    -----
    `CutGrid` describes the fields of the geometry: fractions, volumes, apertures, areas, is_fluid, normals, centroids.
    `Body` describes the conditions: boundary, solid_boundary.
    """

    info: Any = None

    def __init__(self, grid: Grid, level: Any, boundary: Any, solid_boundary: Any, settings: SolveSettings) -> None:
        super().__init__(grid, level, boundary, solid_boundary)
        self._settings = settings
        self._arguments = copied((grid, level, boundary, solid_boundary, settings))
        self._solvers: dict[str, MatrixSolver] = {}

    def recipe(self) -> tuple[type[CutCells], tuple[Any, ...]]:
        """Return the call that constructs an equal object, without its set-ups."""
        return CutCells, self._arguments

    def with_settings(self, settings: SolveSettings) -> CutCells:
        """Return the same body with other settings of its solves."""
        grid, level, boundary, solid_boundary, _ = self._arguments
        return CutCells(grid, level, boundary, solid_boundary, settings)

    def with_conditions(self, boundary: Any, solid_boundary: Any, settings: SolveSettings) -> CutCells:
        """Return a body of the same shape with other conditions and other settings of its solves."""
        grid, level, *_ = self._arguments
        return CutCells(grid, level, boundary, solid_boundary, settings)

    def solve(
        self,
        b: Any,
        values: Any = 0.0,
        walls: Any = None,
        k: Any = 1.0,
        shift: Any = 0.0,
        wall_k: Any = None,
    ) -> Any:
        """Solve shift u - div(k grad u) = b in the fluid. Differentiable in all arguments and in the level.

        Parameters
        ----------
        b : array, a field on the cells; leading axes are a batch
            Not used in cells without fluid.
        values : number, or array of the shape of the grid; leading axes are a batch
            Values of `solid_boundary` at `centroids`: u for dirichlet, du/dn for neumann, a u + b du/dn for robin. Not
            used in cells without wall.
        walls : array, optional
            Values on the walls of the grid, as `lift` takes them. Default: 0.
        k : number or array, a field on the faces, >= 0
        shift : number or array, a field on the cells
        wall_k : number or array of the shape of the grid, >= 0, optional
            k at the wall. Default: the mean of k over the open faces of the cell, weighted by their open areas. k,
            shift and wall_k are the same for a whole batch.

        Returns
        -------
        array of the shape and precision of b; 0 in cells without fluid
            With the leading axes of `values` or `walls` if these have some.

        Raises
        ------
        ShapeError
            If an argument has the wrong shape, or k, shift or wall_k leading axes.
        ValueError
            If k or wall_k is negative.
        NonFiniteError
            If an argument contains NaN or infinity where it is used.
        IncompatibleError
            If all conditions are neumann, there is no shift, and sources and fluxes of a connected region do not
            balance, unless nullspace="project".
        ConvergenceError
            If an iterative solver does not reach rtol.

        Notes
        -----
        If no condition and no shift determines the constant of the solution (only neumann), the sum of ``volumes * u``
        is 0 on each connected part of the fluid, as for `inverse`. With nullspace="project" the mean over this part of
        the fluid is subtracted from the right-hand side.
        """
        return self._solve(b, values, walls, k, shift, wall_k, self._settings.nullspace)

    def _solve(self, b, values=0.0, walls=None, k=1.0, shift=0.0, wall_k=None, nullspace="raise"):
        """Return the solution; see `solve`."""
        check_plain("cut_cells", b)
        if not isbox(b):
            b = np.asarray(b)
        shape = np.shape(b)
        if shape[max(len(shape) - self.grid.dim, 0) :] != self.grid.shape:
            raise ShapeError(f"b of cut_cells takes a field on {self.grid.cells}, got an array of shape {shape}")
        if not self.is_fluid.size:
            return 1.0 * b
        for name, value, space in (
            ("k", k, self.grid.faces),
            ("shift", shift, self.grid.cells),
            ("wall_k", wall_k, self.grid.cells),
        ):
            if value is not None and np.ndim(value) > len(space.shape):
                raise ShapeError(
                    f"solve of cut_cells takes one {name} for all right-hand sides, got an array of shape "
                    f"{np.shape(value)}; call solve once for each {name}"
                )
        self._check_batches_of_diffusion("b", b, values, walls, k, wall_k)
        rows, columns, entries = self._entries(k, wall_k, shift)
        right = self.volumes * self._cell_field("b", b) + self._at_walls(
            self._terms_of_values(values, k, wall_k, walls)
        )
        slopes = self._slopes_of_values(walls, values)
        if slopes is not None:
            right = right + self._outflow(self.apertures * self._coefficient(k) * slopes)
        solver = self._solver(rows, columns, nullspace)
        self.info = solver.info
        return in_dtype_of(b, solver.solve_with_weights(entries, self.is_fluid * right, self.volumes))

    def _solver(self, rows, columns, nullspace) -> MatrixSolver:
        """Return the solver for the entries at these places, which do not depend on the coefficients."""
        solver = self._solvers.get(nullspace)
        if solver is None:
            settings = self._settings
            solver = from_coo(
                rows,
                columns,
                self.grid.cells,
                method=settings.method,
                rtol=settings.rtol,
                maxiter=settings.maxiter,
                nullspace=nullspace,
                **settings.options,
            )
            solver.name = "cut_cells"
            self._solvers[nullspace] = solver
        return solver

    def project(self, v: Any, density: Any = None) -> Any:
        """Return the divergence-free part v - grad p / density of a velocity; nothing flows through the body.

        On the walls of the grid, p has the conditions `boundary`: neumann keeps v there, dirichlet lets it flow freely.

        Parameters
        ----------
        v : array, a field on the faces; leading axes are a batch
        density : number, or array on faces, > 0, optional
            Default: 1.

        Returns
        -------
        array, a field on the faces; 0 on faces without fluid

        Raises
        ------
        ValueError
            If `solid_boundary` is not neumann, or the density is not > 0.
        IncompatibleError
            If inflow and outflow through the neumann walls of a connected region differ.
        """
        mobility = self._mobility(density)
        field = self._face_field("v", v)
        result = field - mobility * self.gradient(self._potential(field, mobility))
        remainder = self._outflow(self.apertures * result)
        through_faces = self._sum_over_faces(self.apertures * anp.abs(field))
        check_values(partial(_check_balance, self.grid.dim), remainder, through_faces)
        return in_dtype_of(v, result)

    def potential(self, v: Any, density: Any = None) -> Any:
        """Return the p of `project` [velocity length, times the unit of density], with mean 0 if it is free.

        Parameters
        ----------
        v, density
            As for `project`.

        Returns
        -------
        array, a field on the cells; 0 in cells without fluid
        """
        return in_dtype_of(v, self._potential(self._face_field("v", v), self._mobility(density)))

    def _potential(self, v, mobility):
        return self._solve(-self.divergence(v), k=mobility, nullspace="project")

    def _mobility(self, density):
        """Return 1 / density as a number or a field on the faces; check that the body has a potential."""
        if self.solid_boundary != neumann:
            raise ValueError(
                f"project of cut_cells needs solid_boundary=dp.neumann, got {self.solid_boundary}; build another body"
            )
        if density is None:
            return 1.0
        if np.ndim(density) > 1:
            raise ShapeError(
                f"project of cut_cells takes a number or one field on faces as density, got an array of shape "
                f"{np.shape(density)}"
            )
        density = self._face_field("density", density, "real numbers", "; write density.real")
        density = anp.where(self._is_open, density, 1.0)
        check_values(partial(check_in_range, "density of cut_cells", needs="> 0", where="on face"), density)
        return 1.0 / density

    def __repr__(self) -> str:
        counts = f"{np.count_nonzero(self.is_fluid)} of {self.is_fluid.size} cells hold fluid"
        return f"<cut_cells: {counts}, {self._geometry.cut.size} are cut, {self.solid_boundary} on the wall>"


def _check_balance(dim, outflow, size):
    """Raise IncompatibleError if a projected velocity, or one of a batch, is not free of divergence."""
    cells = tuple(range(-dim, 0))
    remainder = np.max(np.abs(outflow), axis=cells, initial=0.0)
    if np.any(remainder > LARGEST_IMBALANCE * np.max(np.abs(size), axis=cells, initial=0.0)):
        raise IncompatibleError(
            "project of cut_cells: inflow and outflow through the walls of a connected region differ; make the "
            "velocity on the walls balance, or open a wall with boundary=dp.dirichlet"
        )
