"""Differences, fluxes and averages on the fluid cells around a body whose wall cuts the cells of the grid.

Finite volumes on the fluid part of each cell. With the fluid volume V of a cell, the open areas A_f of its faces and
the area A_w of the wall in it, the mean of div(k grad u) over the fluid of the cell is

    (sum of A_f k_f du/dn over the faces + A_w k_w du/dn) / V,

where n points out of the fluid. The slopes on faces are computed by `gradient`, the slope at the wall by
`wall_slope`. A field holds the value at the centre of each cell, in a cut cell too: if the centre lies in the body, it
is the smooth continuation of the field.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.validation import check_choice, check_finite, check_kind, check_plain, check_precision
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import cast, dtype_of, isbox, real_dtype, sample
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.grid.boundary_conditions import check_condition, resolve
from sparsedp.operators.cut_face_values import FaceValues
from sparsedp.operators.cut_geometry import sum_at_places
from sparsedp.operators.cut_grid import CutGrid
from sparsedp.operators.cut_wall_slope import wall_slope
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.given import from_matrix
from sparsedp.operators.masks_and_lift import lift

if TYPE_CHECKING:
    from sparsedp.grid.grid import Grid
    from sparsedp.grid.space import Space
    from sparsedp.operators.cut_wall_slope import WallSlope
    from sparsedp.operators.operator import Operator

__all__ = ["CutOperators", "check_batches", "checked_field", "in_dtype_of"]


class CutOperators(CutGrid):
    """Operators on the fluid cells around a body with a curved wall.

    Fields may have leading axes, which are a batch. Values in cells and on faces without fluid are not used, and
    may be NaN; their derivatives are 0.

    Parameters
    ----------
    grid, level, boundary, solid_boundary
        As `cut_cells` takes them. All but the level are attributes, see `Body`; `CutGrid` has the others.
    """

    def __init__(self, grid: Grid, level: Any, boundary: Any, solid_boundary: Any) -> None:
        check_condition("solid_boundary", solid_boundary)
        self._gradient = gradient(grid, boundary)
        self._sides = resolve(grid, boundary, patches=True)
        self.boundary = boundary
        self.solid_boundary = solid_boundary
        super().__init__(grid, level)

    # ------------------------------------------------------------ slopes and fluxes

    def gradient(self, u: Any, walls: Any = None, values: Any = 0.0) -> Any:
        """Return the slopes on the faces, 0 on faces without fluid.

        Parameters
        ----------
        u : array, a field on the cells
        walls : array, optional
            Values on the walls of the grid, as `lift` takes them. Default: 0.
        values : number, or array of the shape of the grid
            As for `slopes`. Used on walls of the grid with a condition on u, in a narrow gap between them and the body.

        Returns
        -------
        array, a field on the faces

        Raises
        ------
        ShapeError
            If an argument has the wrong shape.
        NonFiniteError
            If an argument contains NaN or infinity where it is used.

        Notes
        -----
        The slope of a face is the difference of the values in the centres of both cells, divided by their distance,
        also if the wall cuts the face. It is second-order accurate in the middle of the whole face.
        """
        self._check_batches("u", u, values, walls)
        return in_dtype_of(u, self._slopes_on_faces(self._cell_field("u", u), walls, values))

    def _slopes_on_faces(self, u, walls, values):
        slopes = self._is_simple * self._gradient(u)
        slope = self._wall_slope
        if slope.faces.size:
            terms = slope.coefficients * self._flat(u)[..., slope.cells]
            of_faces = self._sum_of_pairs(terms)[..., self._geometry.cut.size :] * slope.signs
            slopes = slopes + self._on_gap_faces(of_faces)
        terms = self._slopes_of_values(walls, values)
        return slopes if terms is None else slopes + terms

    def _slopes_of_values(self, walls, values):
        """Return the part of the slopes on the faces that values on walls add, or None if there is none."""
        slope = self._wall_slope
        lifted = self._lifted(walls)
        terms = None if walls is None else self._is_simple * lifted
        if slope.faces.size:
            _, on_faces = slope.terms_of_values(self._wall_values(values), lifted)
            in_gaps = self._on_gap_faces(on_faces)
            terms = in_gaps if terms is None else terms + in_gaps
        return terms

    @cached_property
    def _is_simple(self):
        """The open faces whose slope is that of the operator `gradient`: all but those of `_wall_slope`."""
        is_simple = self._is_open.copy()
        is_simple[self._wall_slope.faces] = False
        return is_simple

    @cached_property
    def _on_gap_faces(self) -> Operator:
        return sum_at_places(self._wall_slope.faces, self.grid.faces)

    def _lifted(self, walls):
        """Return what values on the walls of the grid add to the operator `gradient`, a field on the faces, or 0."""
        if walls is None:
            return 0.0
        check_plain("walls of cut_cells", walls)
        slopes = anp.where(self._is_open, self._lift(walls), 0.0)
        check_values(partial(check_finite, "walls of cut_cells, on their faces,"), slopes)
        return slopes

    @cached_property
    def _lift(self) -> Operator:
        return lift(self.grid, self.boundary)

    @cached_property
    def _outflow(self) -> Operator:
        """The operator from a face field to the outflow of each cell, through whole faces."""
        matrix = sp.diags_array(self.grid.volumes.reshape(-1)) @ divergence(self.grid).matrix
        return from_matrix(matrix, self.grid.faces, self.grid.cells, "outflow")

    @cached_property
    def _sum_over_faces(self) -> Operator:
        """The operator that sums a face field, times the areas of the whole faces, over the faces of each cell."""
        return from_matrix(abs(self._outflow.matrix), self.grid.faces, self.grid.cells, "sum over faces")

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

        Raises
        ------
        ShapeError
            If an argument has the wrong shape.
        NonFiniteError
            If an argument contains NaN or infinity where it is used.
        """
        return in_dtype_of(v, self._outflow(self.apertures * self._face_field("v", v)) / self._divisors)

    def slopes(self, u: Any, values: Any = 0.0, walls: Any = None) -> Any:
        """Return the slope du/dn at the wall, where n points out of the fluid into the body.

        Parameters
        ----------
        u : array, a field on the cells
        values : number, or array of the shape of the grid
            Values of the condition at `centroids`: u for dirichlet, du/dn for neumann, a u + b du/dn for robin. Not
            used in cells without wall.
        walls : array, optional
            As for `gradient`. Used in narrow gaps between the body and a wall of the grid with a condition on u.

        Returns
        -------
        array, a field on the cells; 0 in cells without wall

        Raises
        ------
        ShapeError
            If an argument has the wrong shape.
        NonFiniteError
            If an argument contains NaN or infinity where it is used.
        """
        self._check_batches("u", u, values, walls)
        slopes = self._slopes_at_walls(self._cell_field("u", u), self._wall_values(values), self._lifted(walls))
        return in_dtype_of(u, self._at_walls(slopes))

    def flux(self, u: Any, values: Any = 0.0, k: Any = 1.0, wall_k: Any = None, walls: Any = None) -> Any:
        """Return the integral of k du/dn over the wall in each cell; its sum is what enters the fluid through the wall.

        The diffusive flux into the body is minus this sum.

        Parameters
        ----------
        u, values, walls
            As for `slopes`.
        k : number or array, a field on the faces, >= 0
        wall_k : number or array of the shape of the grid, >= 0, optional
            k at the wall. Default: the mean of k over the open faces of the cell, weighted by their open areas.

        Returns
        -------
        array, a field on the cells

        Raises
        ------
        ShapeError
            If an argument has the wrong shape.
        NonFiniteError
            If an argument contains NaN or infinity where it is used.
        ValueError
            If k or wall_k is negative.
        """
        self._check_batches_of_diffusion("u", u, values, walls, k, wall_k)
        return in_dtype_of(u, self._flux_into_walls(self._cell_field("u", u), values, k, wall_k, walls))

    def diffusion(self, u: Any, values: Any = 0.0, walls: Any = None, k: Any = 1.0, wall_k: Any = None) -> Any:
        """Return div(k grad u), averaged over the fluid of each cell: the rate of an explicit or implicit time step.

        Parameters
        ----------
        u, values, k, wall_k
            As for `flux`.
        walls : array, optional
            As for `gradient`.

        Returns
        -------
        array, a field on the cells

        Raises
        ------
        ShapeError
            If an argument has the wrong shape.
        NonFiniteError
            If an argument contains NaN or infinity where it is used.
        ValueError
            If k or wall_k is negative.
        """
        self._check_batches_of_diffusion("u", u, values, walls, k, wall_k)
        field = self._cell_field("u", u)
        through_faces = self.apertures * self._coefficient(k) * self._slopes_on_faces(field, walls, values)
        total = self._outflow(through_faces) + self._flux_into_walls(field, values, k, wall_k, walls)
        return in_dtype_of(u, total / self._divisors)

    def _check_batches_of_diffusion(self, name, field, values, walls, k, wall_k):
        cells, faces = self.grid.cells, self.grid.faces
        arguments = [("k", k, faces)]
        if wall_k is not None:
            arguments.append(("wall_k", wall_k, cells))
        self._check_batches(name, field, values, walls, *arguments)

    def _check_batches(self, name, field, values, walls, *arguments):
        cells = self.grid.cells
        of_walls = [] if walls is None else [("walls", walls, self._lift.domain)]
        check_batches((name, field, cells), ("values", values, cells), *of_walls, *arguments)

    def _flux_into_walls(self, u, values, k, wall_k, walls):
        slopes = self._slopes_at_walls(u, self._wall_values(values), self._lifted(walls))
        return self._at_walls(self._geometry.areas * self._wall_coefficient(k, wall_k) * slopes)

    def _slopes_at_walls(self, u, values, lifted):
        """Return the slopes in the cut cells, for a checked field and given values in the cut cells and on the grid."""
        if not self.solid_boundary.a:
            return values / self.solid_boundary.b + 0.0 * self._in_cut_cells(u)  # of the shape of a batch
        slope = self._wall_slope
        terms = slope.coefficients * self._flat(u)[..., slope.cells]
        return self._sum_of_pairs(terms)[..., : self._geometry.cut.size] + slope.terms_of_values(values, lifted)[0]

    @cached_property
    def _wall_slope(self) -> WallSlope:
        return wall_slope(self.grid, self._geometry, self.solid_boundary, self._sides)

    @cached_property
    def _sum_of_pairs(self) -> Operator:
        return sum_at_places(self._wall_slope.walls, self._wall_slope.scales.size)

    # ------------------------------------------------------------ the matrix of diffusion

    @property
    def laplacian(self) -> Operator:
        """The Operator of ``diffusion(u)`` with wall values 0, for `inverse`, `eigenpairs` and `stepper`.

        Cells without fluid are not unknowns: ``inverse(-body.laplacian)(b)`` needs b = 0 there, as
        ``b * body.is_fluid``, and returns 0 there.

        Raises
        ------
        DerivativeError
            If the level is traced: the Operator is constant.
        """
        if isbox(self.fractions):
            raise DerivativeError(
                "the laplacian of cut_cells needs a plain level, got a traced one; write body.diffusion(u) or "
                "body.solve(b)"
            )
        return self._laplacian

    @cached_property
    def _laplacian(self):
        rows, columns, values = self._entries(1.0, None, 0.0)
        matrix = sp.coo_array((-values, (rows, columns)), shape=(self.grid.cells.size,) * 2).tocsr()
        matrix = sp.diags_array(1.0 / self._divisors.reshape(-1)) @ matrix
        return from_matrix(matrix, self.grid.cells, self.grid.cells, "laplacian of cut cells")

    def _entries(self, k, wall_k, shift):
        """Return rows, columns and values of the matrix of V (shift u - div(k grad u)); places may be repeated."""
        size = self.grid.cells.size
        rows, columns, faces, factors = self._entries_of_faces
        all_rows = [rows, np.arange(size)]
        all_columns = [columns, np.arange(size)]
        coefficient = self.apertures * self._coefficient(k)
        shifts = self.volumes * self._cell_field("shift", shift)
        entries = [factors * coefficient[faces], anp.reshape(shifts, (-1,))]
        slope = self._wall_slope
        if slope.walls.size:
            cells_of_faces, areas = self._cells_and_areas_of_gap_faces
            in_cells = self._geometry.areas * self._wall_coefficient(k, wall_k)
            weights = anp.concatenate([in_cells, coefficient[slope.faces] * areas])
            rows_of_walls = np.concatenate([self._geometry.cut, cells_of_faces])
            all_rows.append(rows_of_walls[slope.walls])
            all_columns.append(slope.cells)
            entries.append(-(weights[slope.walls] * slope.coefficients))
        return np.concatenate(all_rows), np.concatenate(all_columns), anp.concatenate(entries)

    @cached_property
    def _cells_and_areas_of_gap_faces(self):
        """The flat numbers of the cells, and the areas of the whole faces."""
        entries = sp.csc_array(abs(self._outflow.matrix))[:, self._wall_slope.faces]
        return entries.indices, entries.data

    @cached_property
    def _entries_of_faces(self):
        """Rows, columns, faces and factors of -(outflow @ diag(apertures k) @ gradient), for the faces `_is_simple`."""
        outflow = sp.csr_array(self._outflow.matrix)
        slope = sp.csr_array(self._gradient.matrix)
        lengths = np.diff(slope.indptr)[outflow.indices]
        first = np.cumsum(lengths) - lengths
        of_outflow = np.repeat(np.arange(lengths.size), lengths)
        of_slope = np.arange(of_outflow.size) + (slope.indptr[outflow.indices] - first)[of_outflow]
        faces = outflow.indices[of_outflow]
        is_open = self._is_simple[faces]
        rows = np.repeat(np.arange(outflow.shape[0]), np.diff(outflow.indptr))[of_outflow]
        factors = -outflow.data[of_outflow] * slope.data[of_slope]
        return rows[is_open], slope.indices[of_slope][is_open], faces[is_open], factors[is_open]

    def _terms_of_values(self, values, k, wall_k, walls):
        """Return the part of the flux through the wall that does not depend on u, for each cut cell."""
        values = self._wall_values(values)
        if self.solid_boundary.a:
            slopes, _ = self._wall_slope.terms_of_values(values, self._lifted(walls))
        else:
            slopes = values / self.solid_boundary.b
        return self._geometry.areas * self._wall_coefficient(k, wall_k) * slopes

    # ------------------------------------------------------------ transport

    def advection(self, u: Any, v: Any, inflow: Any = 0.0, order: int = 1) -> Any:
        """Return -div(v u) by upwind fluxes, redistributed: the rate of an explicit step.

        The sum of ``volumes * advection(u, v)`` is the net inflow through the walls of the grid, up to rounding.

        Parameters
        ----------
        u : array, a field on the cells; real for order 2
        v : array, a field on the faces, real
            A velocity whose `divergence` is 0, such as the result of `project`.
        inflow : number, or array, a field on the faces
            The value of u that enters through the walls of the grid.
        order : 1 or 2
            Order of accuracy in space. 2: values on faces are extrapolated with van Leer's slopes, except in cells with
            a face that the body closes. Use it with Runge-Kutta steps of order 2 or more, such as
            ``dp.stepper("ssprk3", ...)``, and a CFL number of at most 1/2. Derivatives have kinks where slopes change
            their sign.

        Returns
        -------
        array, a field on the cells

        Raises
        ------
        ValueError
            If `order` is neither 1 nor 2.

        References
        ----------
        B. van Leer, J. Comput. Phys. 32 (1979) 101-136.
        """
        check_choice("order= of advection", order, (1, 2))
        kind, advice = ("numbers", "") if order == 1 else ("real numbers", "; write u.real and u.imag")
        field = checked_field("u", u, self.grid.cells, self.is_fluid, kind, advice)
        v = self._face_field("v", v, "real numbers", "; write v.real")
        entering = self._face_field("inflow", inflow, kind, advice.replace("u.", "inflow."))
        faces = self.grid.faces
        check_batches(("u", field, self.grid.cells), ("v", v, faces), ("inflow", entering, faces))
        if order == 1:
            below, above = self.face_values.of_order_1(field, entering)
        else:
            below, above = self.face_values.of_order_2(field, v, entering)
        flux = anp.maximum(v, 0.0) * below + anp.minimum(v, 0.0) * above
        return in_dtype_of(u, -self.redistribute(self.divergence(flux)))

    def outflow_rates(self, v: Any) -> Any:
        """Return the rate at which a velocity empties each cell: the CFL number of a step, divided by dt [1 / time].

        Cells with a fluid fraction below 1/2 count as half cells, because of `redistribute`. With order 1 of
        `advection` steps are stable for CFL numbers up to 1, with order 2 for up to 1/2.

        Parameters
        ----------
        v : array, a field on the faces, real

        Returns
        -------
        array, a field on the cells
        """
        through_faces = self.apertures * self._face_field("v", v, "real numbers", "; write v.real")
        leaving = 0.5 * (self._sum_over_faces(anp.abs(through_faces)) + self._outflow(through_faces))
        return self.is_fluid * leaving / anp.maximum(self.volumes, 0.5 * self.grid.volumes)

    def redistribute(self, rate: Any) -> Any:
        """Return a rate without the step limit of small cells, whose excess is distributed to their neighbours.

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
        field = self._cell_field("rate", rate)
        around = self._neighbourhood(self.volumes)
        around = anp.where(self.is_fluid, around, 1.0)
        mean = self._neighbourhood(self.volumes * field) / around
        excess = anp.maximum(1.0 - 2.0 * self.fractions, 0.0) * (field - mean)
        result = self.is_fluid * (field - excess + self._neighbourhood(self.volumes * excess / around))
        return in_dtype_of(rate, result)

    @cached_property
    def _neighbourhood(self) -> Operator:
        """The operator that sums a field over each cell and the cells behind its open faces."""
        touching = abs(self._outflow.matrix) @ sp.diags_array(self._is_open.astype(float))
        links = sp.csr_array((touching @ touching.T + sp.eye_array(touching.shape[0]) > 0).astype(float))
        return from_matrix(links, self.grid.cells, self.grid.cells, "sum over neighbours")

    @cached_property
    def face_values(self) -> FaceValues:
        """The values of a cell field on both sides of each face, for upwind fluxes."""
        return FaceValues(self.grid, self._is_open)

    # ------------------------------------------------------------ arguments

    def _cell_field(self, name, value):
        """Return an argument as a field on the cells, 0 without fluid; a number is repeated."""
        return checked_field(name, value, self.grid.cells, self.is_fluid)

    def _face_field(self, name, value, kind="numbers", advice=""):
        """Return an argument as a field on the faces, 0 on faces without fluid; a number is repeated."""
        return checked_field(name, value, self.grid.faces, self._is_open, kind, advice)

    def _wall_values(self, values):
        """Return the values of the condition in the cut cells."""
        return self._in_cut_cells(checked_field("values", values, self.grid.cells, self._is_cut))

    @cached_property
    def _is_cut(self):
        is_cut = np.zeros(self.grid.cells.size, bool)
        is_cut[self._geometry.cut] = True
        return is_cut.reshape(self.grid.shape)

    def _coefficient(self, k):
        """Return k as a field on the faces."""
        k = self._face_field("k", k)
        check_values(partial(_check_not_negative, "k"), k)
        return k

    def _wall_coefficient(self, k, wall_k):
        """Return k at the wall, in the cut cells."""
        if wall_k is not None:
            wall_k = checked_field("wall_k", wall_k, self.grid.cells, self._is_cut)
            check_values(partial(_check_not_negative, "wall_k"), wall_k)
            return self._in_cut_cells(wall_k)
        total = self._in_cut_cells(self._sum_over_faces(self.apertures * self._coefficient(k)))
        area = self._in_cut_cells(self._sum_over_faces(self.apertures))
        return total / anp.where(np.asarray(sample(area)) > 0, area, 1.0)


def checked_field(name: str, value: Any, space: Space, is_used: Any, kind: str = "numbers", advice: str = "") -> Any:
    """Return an argument as a field on a space in double precision, or as a batch of fields; a number is repeated.

    Parameters
    ----------
    name : str
    value : number, array or traced
    space : Space
    is_used : bool array
        Where the field is used; elsewhere it may be NaN, and becomes 0.
    kind, advice : str
        As for `check_kind`.
    """
    check_plain(f"{name} of cut_cells", value)
    if not isbox(value):
        value = np.asarray(value)
    shape = np.shape(value)
    if shape != () and shape[max(len(shape) - len(space.shape), 0) :] != space.shape:
        raise ShapeError(f"{name} of cut_cells takes a number or a field on {space}, got an array of shape {shape}")
    check_precision(f"{name} of cut_cells", np.asarray(sample(value)))
    check_kind(f"{name} of cut_cells", dtype_of(value), kind, advice)
    if shape == ():
        check_values(partial(check_finite, f"{name} of cut_cells"), value)
    field = anp.where(is_used, _in_double(value), 0.0)
    check_values(partial(check_finite, f"{name} of cut_cells"), field)
    return field


def check_batches(*arguments: tuple[str, Any, Space]) -> None:
    """Raise ShapeError for fields whose leading axes do not broadcast.

    Parameters
    ----------
    *arguments : tuples of a name, a number or field, and the space of the field
    """
    batches = {name: np.shape(value)[: max(np.ndim(value) - len(space.shape), 0)] for name, value, space in arguments}
    try:
        np.broadcast_shapes(*batches.values())
    except ValueError:
        shapes = ", ".join(f"{batch} of {name}" for name, batch in batches.items() if batch)
        raise ShapeError(
            f"cut_cells needs one shape of the batch, got {shapes}; give each argument the same leading axes, or none"
        ) from None


def _in_double(field):
    """Return a field in double precision."""
    return cast(field, np.result_type(dtype_of(field), float))


def in_dtype_of(field: Any, result: Any) -> Any:
    """Return a result in single precision if the field is in single precision."""
    if dtype_of(field).kind not in "fc":
        return result
    least = np.complex64 if dtype_of(result).kind == "c" else np.float32
    return cast(result, np.result_type(real_dtype(dtype_of(field)), least))


def _check_not_negative(name, k):
    least = np.min(np.real(k), initial=0.0)
    if least < 0:
        raise ValueError(f"{name} of cut_cells must be >= 0, got {least:g}")
