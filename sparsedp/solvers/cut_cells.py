"""cut_cells: Poisson and diffusion problems around, or inside of, a body whose curved wall cuts the cells of the grid.

Finite volumes on the fluid part of each cell. With the volume V of the fluid, the open areas A_f of the faces and the
area A_w of the wall, the equation of a cell is

    shift V u - (sum of A_f k_f du/dn over the faces) - A_w k_w du/dn = V b,

where n points out of the fluid. The unknown is the value at the centre of the cell, in a cut cell too: if the centre
lies in the body, it is the smooth continuation of the solution. The slopes on faces are those of `gradient`.

Slope at the wall. For neumann it is the given value. Else a quadratic polynomial through the value u_w at the centroid
of the wall is fitted to the cells around it (weighted least squares). Its slope is (sum of c_j u_j) - C u_w, where C is
the sum of the c_j. The condition a u_w + b du/dn = g then gives

    du/dn = (a (sum of c_j u_j) - C g) / (a - b C).

Only cells in front of the wall take part, with a weight that is proportional to their fluid fraction and decreases with
the distance. No equation divides by the volume of a cell, so that tiny cells do no harm.

References: H. Johansen, P. Colella, J. Comput. Phys. 147 (1998) 60-85; P. Schwartz, M. Barad, P. Colella, T. Ligocki,
J. Comput. Phys. 211 (2006) 531-550; Y. T. Ng, C. Min, F. Gibou, J. Comput. Phys. 228 (2009) 8807-8829.
"""

from __future__ import annotations

from functools import cached_property, partial, reduce
from itertools import product
from operator import add
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.pytree import copied
from sparsedp._utils.validation import check_finite, check_kind, check_on, check_plain
from sparsedp.autodiff.program_trace import check_values, recording_trace
from sparsedp.autodiff.tape import cast, dtype_of, isbox, sample
from sparsedp.errors import DerivativeError, IncompatibleError, JitError, ShapeError
from sparsedp.grid.boundary_conditions import check_condition, neumann
from sparsedp.grid.grid import check_grid
from sparsedp.operators.cut_geometry import cut_geometry, sum_at_places
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.given import from_matrix
from sparsedp.operators.masks_and_lift import lift
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import adjacent_cell, to_faces
from sparsedp.solvers.choose_method import check_settings
from sparsedp.solvers.parametric import from_coo

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.solvers.choose_method import SolveSettings

__all__ = ["CutCells", "cut_cells"]

# The polynomial is fitted to the cells around the wall up to this distance, in cell widths. The weights go to 0 there,
# so that the solution is a continuous function of the level.
RADIUS = 2.5
REACH = 3  # number of cells on each side of a cut cell that may be within this distance
# Regularization of the fit, relative to the sum of the weights: of slopes and of curvatures. It only matters where the
# cells around do not determine them, such as in a gap of one cell.
SLOPE_DAMPING = 1e-10
CURVATURE_DAMPING = 1e-3
# The weighted sum of squared distances of cells from the wall, in cell widths, from which on the fit alone is used.
ENOUGH = 0.4
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
    laplacian, elliptic_solver, brinkman

    Notes
    -----
    **Geometry.** The level is linear in each of the 4 triangles (24 tetrahedra in 3-D) between the centre of a cell and
    its edges, so that plane walls are exact. Parts of a body that are thinner than a cell are not seen.

    **Derivatives.** In the level, the right-hand side, the wall values and the coefficients, forward and reverse, to
    every order. As a function of the level the solution is continuous, with kinks where the wall passes a node or a
    centre of a cell. Weight sums by `volumes` or `areas`: the value in a tiny cell changes fast with the level.

    **Order.** 2 in the L2 norm, and between 1.5 and 2 in the maximum norm, where the largest errors are in cells with a
    centre in the body. The slope at the wall has order 1 (dirichlet), its integral over the wall order 2.

    References
    ----------
    H. Johansen, P. Colella, J. Comput. Phys. 147 (1998) 60-85.
    P. Schwartz, M. Barad, P. Colella, T. Ligocki, J. Comput. Phys. 211 (2006) 531-550.

    Examples
    --------
    A membrane over a disc, fixed at its edge; its largest deflection is R^2 / 4:

    >>> import numpy as np
    >>> from sparsedp import Grid, dirichlet
    >>> grid = Grid((32, 32), size=2.0, origin=-1.0)
    >>> disc = cut_cells(grid, lambda x, y: 0.8 - np.sqrt(x**2 + y**2), solid_boundary=dirichlet)
    >>> u = disc.solve(np.ones(grid.shape))
    >>> print(np.round(np.max(u), 3), np.round(np.sum(disc.volumes), 2), np.round(-np.sum(disc.flux(u)), 2))
    0.159 2.01 2.01
    """
    check_grid("cut_cells", grid)
    return CutCells(grid, level, boundary, solid_boundary, check_settings(method, rtol, maxiter, nullspace, options))


class WallSlope(NamedTuple):
    """The slope at the wall, out of the fluid: sum of coefficients * u[cells], plus `of_value` times the given value.

    Attributes
    ----------
    walls, cells : int arrays, shape (pairs,)
        Number of the cut cell, and flat number of the cell of each coefficient.
    coefficients : array, shape (pairs,)
    of_value : array, shape (m,)
        For each cut cell.
    """

    walls: NDArray[np.int64]
    cells: NDArray[np.int64]
    coefficients: Any
    of_value: Any


class CutCells(Reconstructible):
    """The fluid cells around a body with a curved wall, as `cut_cells` returns them.

    Fields on cells hold the value at the centre of the cell; they have no meaning in cells without fluid, where `solve`
    returns 0.

    Parameters
    ----------
    grid, level, boundary, solid_boundary
        As `cut_cells` takes them.
    settings : SolveSettings

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
    info : SolveLog
        Records of the last solves.
    """

    info: Any = None

    def __init__(self, grid: Grid, level: Any, boundary: Any, solid_boundary: Any, settings: SolveSettings) -> None:
        check_condition("solid_boundary", solid_boundary)
        self._gradient = gradient(grid, boundary)
        level = _checked_level(grid, level)
        self._arguments = copied((grid, level, boundary, solid_boundary, settings))
        self.grid = grid
        self._condition = solid_boundary
        self._geometry = cut_geometry(grid, level)
        self.fractions = anp.reshape(self._geometry.fractions, grid.shape)
        self.volumes = self.fractions * grid.volumes
        self.apertures = self._geometry.apertures
        self.is_fluid: NDArray[np.bool_] = np.asarray(sample(self.fractions)) > 0
        self._is_open = np.asarray(sample(self.apertures)) > 0
        self._at_walls = sum_at_places(self._geometry.cut, grid.cells)
        self.areas = self._at_walls(self._geometry.areas)
        outflow = sp.diags_array(grid.volumes.reshape(-1)) @ divergence(grid).matrix
        self._outflow = from_matrix(outflow, grid.faces, grid.cells, "outflow")  # through the areas of whole faces
        self._solvers: dict[str, Any] = {}

    def recipe(self) -> tuple[type[CutCells], tuple[Any, ...]]:
        """Return the call that constructs an equal object, without its set-ups."""
        return CutCells, self._arguments

    # ------------------------------------------------------------ geometry

    @cached_property
    def normals(self) -> tuple:
        """Unit normal of the wall that points into the fluid: one cell field for each axis, 0 in cells without wall."""
        return tuple(self._at_walls(normal) for normal in self._geometry.normals)

    @cached_property
    def centroids(self) -> tuple:
        """Where `values` belong: coordinates of the centroid of the wall, and of the centre in cells without wall."""
        centres = self.grid.centres()
        places = self._geometry.cut
        pairs = zip(centres, self._geometry.centroids, strict=True)
        return tuple(centre + self._at_walls(at_wall - centre.reshape(-1)[places]) for centre, at_wall in pairs)

    # ------------------------------------------------------------ slopes and fluxes

    def gradient(self, u: Any, walls: Any = None) -> Any:
        """Return the slopes on the faces, 0 on faces without fluid.

        Parameters
        ----------
        u : array, a field on the cells
        walls : array, optional
            Values on the walls of the grid, as `lift` takes them. Default: 0.

        Returns
        -------
        array, a field on the faces
        """
        slopes = self._gradient(u)
        if walls is not None:
            slopes = slopes + self._lift(walls)
        return self._is_open * slopes

    @cached_property
    def _lift(self):
        return lift(self.grid, self._arguments[2])

    def divergence(self, v: Any) -> Any:
        """Return the divergence of a face field: its outflow through the open faces of a cell, for each fluid volume.

        Nothing flows through the wall. The sum of ``volumes * divergence(v)`` is the outflow through the walls of the
        grid, up to rounding.

        Parameters
        ----------
        v : array, a field on the faces

        Returns
        -------
        array, a field on the cells; 0 in cells without fluid
        """
        outflow = self._outflow(self.apertures * self._field("v", v, self.grid.faces))
        return _in_dtype_of(v, outflow / self._safe_volumes)

    @cached_property
    def _safe_volumes(self):
        return anp.where(self.is_fluid, self.volumes, 1.0)

    def slopes(self, u: Any, values: Any = 0.0) -> Any:
        """Return the slope du/dn at the wall, where n points out of the fluid into the body.

        Parameters
        ----------
        u : array, a field on the cells
        values : number, or array of the shape of the grid
            Values of the condition at `centroids`: u for dirichlet, du/dn for neumann, a u + b du/dn for robin.

        Returns
        -------
        array, a field on the cells; 0 in cells without wall
        """
        return _in_dtype_of(u, self._at_walls(self._slopes(self._field("u", u), self._wall_values(values))))

    def flux(self, u: Any, values: Any = 0.0, k: Any = 1.0, wall_k: Any = None) -> Any:
        """Return the integral of k du/dn over the wall in each cell; its sum is the flux into the body.

        Parameters
        ----------
        u, values
            As for `slopes`.
        k, wall_k
            As for `solve`.

        Returns
        -------
        array, a field on the cells
        """
        slopes = self._slopes(self._field("u", u), self._wall_values(values))
        return _in_dtype_of(u, self._at_walls(self._geometry.areas * self._wall_coefficient(k, wall_k) * slopes))

    def diffusion(self, u: Any, values: Any = 0.0, walls: Any = None, k: Any = 1.0, wall_k: Any = None) -> Any:
        """Return div(k grad u), averaged over the fluid of each cell: the rate of an explicit or implicit time step.

        Parameters
        ----------
        u : array, a field on the cells
        values, walls, k, wall_k
            As for `solve`.

        Returns
        -------
        array, a field on the cells
        """
        total = self._outflow(self.apertures * k * self.gradient(u, walls)) + self.flux(u, values, k, wall_k)
        return _in_dtype_of(u, total / self._safe_volumes)

    def _slopes(self, u, values):
        """Return the slopes at the wall for a field on the cells and given values on the cut cells."""
        if not self._condition.a:
            return values / self._condition.b
        slope = self._wall_slope
        terms = slope.coefficients * anp.reshape(u, (-1,))[slope.cells]
        return self._sum_of_pairs(terms) + slope.of_value * values

    # ------------------------------------------------------------ flows around the body

    def project(self, v: Any) -> Any:
        """Return the divergence-free part v - grad p of a velocity; nothing flows through the wall of the body.

        On the walls of the grid, p has the conditions `boundary`: neumann keeps v there, dirichlet lets it flow freely.

        Parameters
        ----------
        v : array, a field on the faces

        Returns
        -------
        array, a field on the faces; 0 on faces without fluid

        Raises
        ------
        ValueError
            If `solid_boundary` is not neumann.
        IncompatibleError
            If more enters a region through neumann walls than leaves it.
        """
        if self._condition != neumann:
            raise ValueError(
                f"project of cut_cells needs solid_boundary=dp.neumann, got {self._condition}; build another body"
            )
        given = v
        v = _in_double(self._field("v", v, self.grid.faces))
        pressure = self._solve(-self.divergence(v), nullspace="project")
        free = self._is_open * v - self.gradient(pressure)
        check_values(_check_balance, self._outflow(self.apertures * free), self._passing(self.apertures * abs(v)))
        return _in_dtype_of(given, free)

    @cached_property
    def _passing(self):
        """The operator that sums a face field, times the areas of the faces, over the faces of each cell."""
        return from_matrix(abs(self._outflow.matrix), self.grid.faces, self.grid.cells, "flow through faces")

    def advection(self, u: Any, v: Any, inflow: Any = 0.0) -> Any:
        """Return -div(v u) by upwind fluxes, redistributed: the rate of an explicit step.

        The sum of ``volumes * advection(u, v)`` is the flux through the walls of the grid, up to rounding.

        Parameters
        ----------
        u : array, a field on the cells
        v : array, a field on the faces
            For example of `project`: its apertures-weighted divergence should be 0.
        inflow : number, or array, a field on the faces
            The value of u that enters through the walls of the grid.

        Returns
        -------
        array, a field on the cells
        """
        below, above, at_lower, at_upper = self._beside_faces
        given = u
        u = _in_double(self._field("u", u))
        v = self._field("v", v, self.grid.faces)
        entering = self._field("inflow", inflow, self.grid.faces)
        from_below = anp.where(at_lower, entering, below(u))
        from_above = anp.where(at_upper, entering, above(u))
        flux = anp.maximum(v, 0.0) * from_below + anp.minimum(v, 0.0) * from_above
        return _in_dtype_of(given, -self.redistribute(self.divergence(flux)))

    def redistribute(self, rate: Any) -> Any:
        """Return a rate without the step limit of small cells: what a small cell cannot take goes to its neighbours.

        A cell with a fluid fraction f below 1/2 keeps the share 2 f of its rate; the rest becomes the mean over the
        cell and those behind its open faces. The difference is given to all of these, so that the sum of
        ``volumes * rate`` is kept up to rounding. Other cells keep their rate.

        Parameters
        ----------
        rate : array, a field on the cells
            An explicit rate, such as ``body.divergence(flux)``.

        Returns
        -------
        array, a field on the cells

        References
        ----------
        I-L. Chern, P. Colella, UCRL-97200, Lawrence Livermore National Laboratory (1987).
        """
        given = rate
        rate = self._field("rate", rate)
        around = self._neighbourhood(self.volumes)
        around = anp.where(self.is_fluid, around, 1.0)
        mean = self._neighbourhood(self.volumes * rate) / around
        excess = anp.maximum(1.0 - 2.0 * self.fractions, 0.0) * (rate - mean)
        result = self.is_fluid * (rate - excess + self._neighbourhood(self.volumes * excess / around))
        return _in_dtype_of(given, result)

    @cached_property
    def _neighbourhood(self):
        """The operator that sums a field over each cell and the cells behind its open faces."""
        touching = abs(self._outflow.matrix) @ sp.diags_array(self._is_open.astype(float))
        links = sp.csr_array((touching @ touching.T + sp.eye_array(touching.shape[0]) > 0).astype(float))
        return from_matrix(links, self.grid.cells, self.grid.cells, "sum over neighbours")

    @cached_property
    def _beside_faces(self):
        """Operators to the values below and above each face, and masks of the faces on lower and on upper walls."""
        grid = self.grid
        axes = range(grid.dim)
        below = to_faces("cell below", grid, [adjacent_cell(grid, axis, False) for axis in axes])
        above = to_faces("cell above", grid, [adjacent_cell(grid, axis, True) for axis in axes])
        masks = []
        for end in (0, -1):
            parts = [np.zeros(shape, bool) for shape in grid.faces.parts]
            for axis, part in enumerate(parts):
                if not grid.periodic[axis]:
                    np.moveaxis(part, axis, 0)[end] = True  # a view
            masks.append(np.concatenate([part.reshape(-1) for part in parts]))
        return below, above, *masks

    # ------------------------------------------------------------ solving

    @property
    def laplacian(self) -> Operator:
        """The Operator of ``diffusion(u)`` with wall values 0, for `inverse`, `eigenpairs` and `stepper`."""
        if isbox(self.fractions):
            raise DerivativeError(
                "the laplacian of cut_cells needs a plain level, got a traced one; write body.diffusion(u) or "
                "body.solve(b)"
            )
        return self._laplacian

    @cached_property
    def _laplacian(self):
        rows, columns, values = self._entries(1.0, None, 0.0)
        matrix = sp.coo_array((-values, (rows, columns)), shape=(self.is_fluid.size,) * 2).tocsr()
        matrix = sp.diags_array(1.0 / self._safe_volumes.reshape(-1)) @ matrix
        return from_matrix(matrix, self.grid.cells, self.grid.cells, "laplacian of cut cells")

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
        values : number, or array of the shape of the grid
            Values of `solid_boundary` at `centroids`: u for dirichlet, du/dn for neumann, a u + b du/dn for robin.
        walls : array, optional
            Values on the walls of the grid, as `lift` takes them. Default: 0.
        k : number or array, a field on the faces, >= 0
        shift : number or array, a field on the cells
        wall_k : number or array of the shape of the grid, optional
            k at the wall. Default: the mean of k over the open faces of the cell.

        Returns
        -------
        array of the shape and dtype of b; 0 in cells without fluid

        Notes
        -----
        If no condition and no shift fixes the level of the solution (only neumann), the sum of ``volumes * u`` is 0 on
        each connected part of the fluid, as for `inverse`. With nullspace="project" the mean over this part of the
        fluid is subtracted from the right-hand side.
        """
        return self._solve(b, values, walls, k, shift, wall_k, self._arguments[-1].nullspace)

    def _solve(self, b, values=0.0, walls=None, k=1.0, shift=0.0, wall_k=None, nullspace="raise"):
        """Return the solution; see `solve`."""
        check_plain("cut_cells", b, values, k, shift)
        if not isbox(b):
            b = np.asarray(b)
        shape = np.shape(b)
        if shape[max(len(shape) - self.grid.dim, 0) :] != self.grid.shape:
            raise ShapeError(f"b of cut_cells takes a field on {self.grid.cells}, got an array of shape {shape}")
        if not self.is_fluid.size:
            return 1.0 * b
        rows, columns, entries = self._entries(k, wall_k, shift)
        right = self.volumes * b + self._at_walls(self._wall_terms(values, k, wall_k))
        if walls is not None:
            right = right + self._outflow(self.apertures * k * self._lift(walls))
        solver = self._solvers.get(nullspace)
        if solver is None:  # the pattern does not depend on the coefficients
            settings = self._arguments[-1]
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
        self.info = solver.info
        u = solver.solve_with_weights(entries, self.is_fluid * right, self.volumes)
        return _in_dtype_of(b, u)

    def _wall_terms(self, values, k, wall_k):
        """Return the part of the flux through the wall that does not depend on u, for each cut cell."""
        given = self._wall_values(values)
        if self._condition.a:
            given = self._wall_slope.of_value * given
        else:
            given = given / self._condition.b
        return self._geometry.areas * self._wall_coefficient(k, wall_k) * given

    def _entries(self, k, wall_k, shift):
        """Return rows, columns and values of shift V - (fluxes), which may hold a place more than once."""
        size = self.is_fluid.size
        rows, columns, faces, factors = self._face_entries
        all_rows = [rows, np.arange(size)]
        all_columns = [columns, np.arange(size)]
        check_values(_check_not_negative, k)
        coefficient = self.apertures * self._field("k", k, self.grid.faces)
        shifts = self.volumes * self._field("shift", shift)
        entries = [factors * coefficient[faces], anp.reshape(shifts, (-1,))]
        if self._condition.a:
            slope = self._wall_slope
            weights = self._geometry.areas * self._wall_coefficient(k, wall_k)
            all_rows.append(self._geometry.cut[slope.walls])
            all_columns.append(slope.cells)
            entries.append(-(weights[slope.walls] * slope.coefficients))
        return np.concatenate(all_rows), np.concatenate(all_columns), anp.concatenate(entries)

    @cached_property
    def _face_entries(self):
        """Rows, columns, faces and factors of -(outflow @ diag(apertures k) @ gradient), for open faces."""
        outflow = sp.csr_array(self._outflow.matrix)
        slope = sp.csr_array(self._gradient.matrix)
        lengths = np.diff(slope.indptr)[outflow.indices]
        first = np.cumsum(lengths) - lengths
        of_outflow = np.repeat(np.arange(lengths.size), lengths)
        of_slope = np.arange(of_outflow.size) + (slope.indptr[outflow.indices] - first)[of_outflow]
        faces = outflow.indices[of_outflow]
        kept = self._is_open[faces]
        rows = np.repeat(np.arange(outflow.shape[0]), np.diff(outflow.indptr))[of_outflow]
        factors = -outflow.data[of_outflow] * slope.data[of_slope]
        return rows[kept], slope.indices[of_slope][kept], faces[kept], factors[kept]

    # ------------------------------------------------------------ arguments

    def _field(self, name, value, space=None):
        """Return an argument as a field on the cells, or on another space; a number is repeated."""
        space = space or self.grid.cells
        shape = np.shape(sample(value))
        if shape not in ((), space.shape):
            raise ShapeError(f"{name} of cut_cells takes a number or a field on {space}, got an array of shape {shape}")
        check_values(partial(check_finite, f"{name} of cut_cells"), value)
        return value * np.ones(space.shape) if shape == () else value

    def _wall_values(self, values):
        """Return the values of the condition on the cut cells."""
        return anp.reshape(self._field("values", values), (-1,))[self._geometry.cut]

    def _wall_coefficient(self, k, wall_k):
        """Return k at the wall, for each cut cell."""
        cut = self._geometry.cut
        if wall_k is not None:
            return anp.reshape(self._field("wall_k", wall_k), (-1,))[cut]
        if np.shape(sample(k)) == ():
            return k * np.ones(cut.size)
        openness = self.apertures * self.grid.faces.volumes
        touching = abs(self._outflow.matrix)
        around = from_matrix((touching > 0).astype(float), self.grid.faces, self.grid.cells, "sum over faces")
        total = anp.reshape(around(openness * k), (-1,))[cut]
        return total / anp.reshape(around(openness), (-1,))[cut]

    # ------------------------------------------------------------ the slope at the wall

    @cached_property
    def _sum_of_pairs(self):
        return sum_at_places(self._wall_slope.walls, self._geometry.cut.size)

    @cached_property
    def _wall_slope(self) -> WallSlope:
        """The slope at the wall; see the module docstring."""
        geometry = self._geometry
        walls, cells, positions, widths = self._cells_in_front()
        axes = range(self.grid.dim)
        r = [(positions[a] - geometry.centroids[a][walls]) / widths[a][walls] for a in axes]
        ahead = reduce(add, [r[a] * geometry.normals[a][walls] for a in axes])
        squares = reduce(add, [x**2 for x in r])
        fractions = anp.reshape(self.fractions, (-1,))[cells]
        nearness = (anp.maximum(1.0 - squares / RADIUS**2, 0.0) / (0.25 + squares)) ** 2
        weights = fractions * nearness * anp.maximum(ahead, 0.0) ** 2
        basis = r + [r[a] * r[b] for a in axes for b in range(a, self.grid.dim)]

        gather = sum_at_places(walls, geometry.cut.size)
        total = gather(weights)
        total = total + (np.asarray(sample(total)) == 0)
        matrix = []
        for i, first in enumerate(basis):
            row = [gather(weights * first * second) for second in basis[: i + 1]]
            row[i] = row[i] + (SLOPE_DAMPING if i < self.grid.dim else CURVATURE_DAMPING) * total
            matrix.append(row)
        outward: list = [-geometry.normals[a] / widths[a] for a in axes]
        solution = _solved(matrix, outward + [0.0] * (len(basis) - len(outward)))
        slopes = weights * reduce(add, [z[walls] * term for z, term in zip(solution, basis, strict=True)])

        # Where no cell is well in front of the wall, as in a gap narrower than a cell, extrapolation would be unstable:
        # there the slope goes over to that between the wall and the cell itself.
        information = gather(weights * ahead**2)
        blind = anp.maximum(1.0 - information / ENOUGH, 0.0) ** 2
        slopes = slopes * (1.0 - blind)[walls]
        own = np.flatnonzero(np.asarray(sample(blind)) > 0)
        smallest = reduce(np.minimum, widths)
        walls = np.concatenate([walls, own])
        cells = np.concatenate([cells, geometry.cut[own]])
        slopes = anp.concatenate([slopes, -blind[own] / smallest[own]])

        of_u = sum_at_places(walls, geometry.cut.size)(slopes)
        denominator = self._condition.a - self._condition.b * of_u
        return WallSlope(walls, cells, slopes * (self._condition.a / denominator)[walls], -of_u / denominator)

    def _cells_in_front(self):
        """Return pairs of a wall and a fluid cell in front of it.

        Returns
        -------
        walls, cells : int arrays, shape (pairs,)
        positions : list of arrays, shape (pairs,)
            Coordinates of the centres of the cells; across a periodic side, of the image next to the wall.
        widths : list of arrays, shape (m,)
            Widths of the cut cells.
        """
        grid = self.grid
        geometry = self._geometry
        places: Any = np.unravel_index(geometry.cut, grid.shape)
        offsets = np.array(list(product(range(-REACH, REACH + 1), repeat=grid.dim)))
        chosen = np.ones((len(offsets), geometry.cut.size), bool)
        ahead = np.zeros(chosen.shape)
        positions = []
        wrapped = []
        for axis, n in enumerate(grid.shape):
            turns, index = np.divmod(places[axis] + offsets[:, axis, None], n)
            if not grid.periodic[axis]:
                chosen &= turns == 0
            positions.append(grid.coordinates(axis)[index] + turns * grid.size[axis])
            wrapped.append(index)
            width = grid.widths[axis][places[axis]]
            distance = (positions[axis] - np.asarray(sample(geometry.centroids[axis]))) / width
            ahead += distance * np.asarray(sample(geometry.normals[axis]))
        cells: Any = np.ravel_multi_index(wrapped, grid.shape)
        chosen &= self.is_fluid.reshape(-1)[cells] & (ahead > 0)
        _, walls = np.nonzero(chosen)
        widths = [grid.widths[axis][places[axis]] for axis in range(grid.dim)]
        return walls, cells[chosen], [position[chosen] for position in positions], widths

    def __repr__(self) -> str:
        counts = f"{np.count_nonzero(self.is_fluid)} of {self.is_fluid.size} cells hold fluid"
        return f"<cut_cells: {counts}, {self._geometry.cut.size} are cut, {self._condition} on the wall>"


def _checked_level(grid, level):
    """Return the level at the nodes, traced or not, in double precision."""
    if callable(level) and not isbox(level):
        level = level(*np.meshgrid(*(grid.coordinates(a, "nodes") for a in range(grid.dim)), indexing="ij"))
    if recording_trace([level]) is not None:
        raise JitError(
            "dp.jit cannot record the level of cut_cells, whose values decide which cells are cut; call the function "
            "without dp.jit"
        )
    check_plain("cut_cells", level)
    values = np.asarray(sample(level))
    check_on("the level of cut_cells", values, grid.nodes)
    check_kind("the level of cut_cells", values.dtype, "real numbers", "; write level.real")
    check_finite("the level of cut_cells", values)
    return cast(level if isbox(level) else values, np.dtype(float))


def _in_double(field):
    """Return a field in double precision."""
    return cast(field, np.result_type(dtype_of(field), float))


def _in_dtype_of(field, result):
    """Return a real result in single precision if the field is in single precision."""
    if dtype_of(result).kind != "f" or dtype_of(field).kind not in "fc":
        return result
    return cast(result, np.result_type(dtype_of(field), np.float32))


def _check_balance(outflow, size):
    """Raise IncompatibleError if a projected velocity is not free of divergence."""
    left = np.max(np.abs(outflow), initial=0.0)
    if left > LARGEST_IMBALANCE * np.max(np.abs(size), initial=0.0):
        raise IncompatibleError(
            "project of cut_cells: more enters a region through the walls of the grid than leaves it; make the "
            "velocity on the walls balance, or open a wall with boundary=dp.dirichlet"
        )


def _check_not_negative(k):
    least = np.min(np.real(k), initial=0.0)
    if least < 0:
        raise ValueError(f"k of cut_cells must be >= 0, got {least:g}")


def _solved(matrix, right):
    """Return the solution of symmetric positive definite systems with arrays as entries, by an LDL^T factorization.

    Parameters
    ----------
    matrix : list of lists
        The lower triangle.
    right : list
    """
    size = len(right)
    lower: list[list] = []
    pivots: list = []
    x: list = []
    for i in range(size):
        row: list = []
        for j in range(i):
            known = [row[p] * lower[j][p] * pivots[p] for p in range(j)]
            row.append(reduce(lambda value, term: value - term, known, matrix[i][j]) / pivots[j])
        pivots.append(reduce(lambda value, p: value - row[p] ** 2 * pivots[p], range(i), matrix[i][i]))
        x.append(reduce(lambda value, p: value - row[p] * x[p], range(i), right[i]))
        lower.append(row)
    for i in reversed(range(size)):
        x[i] = reduce(lambda value, p: value - lower[p][i] * x[p], range(i + 1, size), x[i] / pivots[i])
    return x
