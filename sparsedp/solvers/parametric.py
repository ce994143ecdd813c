"""Solves whose operator depends on parameters: x of (shift - D diag(k) G) x = b, differentiable in k, b and shift.

With A = shift - D diag(k) G and A x = b, one adjoint solve A^T y = g serves all arguments (see adjoint.py):

    cotangent of b: y,    of shift: -y * x (its sum where shift is one number),    of k: (D^T y) * (G x).

A matrix with the entries k at the places (i, j) of a fixed pattern is of that form too: D = -R^T and G = C, where R
and C pick the value at the row and at the column of each entry. The cotangent of an entry is -y_i x_j, and only the
places of the pattern are ever touched.
"""

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.calls import public
from sparsedp._utils.reconstruction import Remade
from sparsedp._utils.validation import check_finite, check_kind, check_plain, check_shape, check_type
from sparsedp.autodiff.backend import as_field, gathered
from sparsedp.autodiff.derivative import of_argument
from sparsedp.autodiff.fast_derivatives import in_dtype
from sparsedp.autodiff.tape import cast, dtype_of, isbox, plain
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.grid.space import Space, fits
from sparsedp.operators.given import from_matrix
from sparsedp.operators.masks_and_lift import identity
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix, compact, rows_of
from sparsedp.operators.structure.lazy import Chain, Diagonal, Sum
from sparsedp.operators.tensor import check_tensor, corners
from sparsedp.solvers.adjoint import solve_rule
from sparsedp.solvers.cache import Cache
from sparsedp.solvers.choose_method import check_settings
from sparsedp.solvers.inverse import build
from sparsedp.solvers.records import SolveLog
from sparsedp.solvers.scaling import exponent_of, shifted
from sparsedp.solvers.sparsity import pattern_like

__all__ = ["Elliptic", "EllipticSolver", "MatrixSolver", "elliptic_solver", "matrix_solver"]


FAR = 500  # exponent of coefficients beyond which they are scaled before the operator is built
LEAST_EXPONENT = -1022  # of a float with all its digits


class ParametricSolver(Remade):
    """x of (shift - D diag(k) G) x = b as a rule in (k, b, shift).

    A subclass has a `name` and makes the Operator: ``_operator(k, shift)``, of arrays that nobody else writes into.

    Attributes
    ----------
    info : SolveLog
        Records of the last forward and the last adjoint solve, and of the last set-up.
    """

    name: str
    all_rows = True  # refuse an operator with an equation that no unknown can satisfy: see `build`
    _operator: Any

    def __init__(self, D, G, settings):
        self.D, self.G = D, G
        self.info = SolveLog()
        self._settings, self._cache = settings, Cache()

    def _solution(self, k, b, shift):
        return solve_rule(self.name, self._solve, self._back, self._applied, checked=True)(b, k, shift)

    def _solve(self, transposed, checked, b, k, shift):
        inv = self._inverse(k, shift)
        return (inv.T if transposed else inv if checked else inv.tangent).apply(b)

    def _back(self, params, places, y, x):
        slopes = [lambda: self.D.T(y) * self.G(x), lambda: -y * x]
        return [of_argument(slopes[place](), params[place]) for place in places]

    def _applied(self, transposed, x, k, shift):
        first, last = (self.D.T, self.G.T) if transposed else (self.G, self.D)
        return shift * x - last(k * first(x))

    def _inverse(self, k, shift):
        """The set-up for this content, from the last two or new."""
        k, shift = (in_dtype(gathered(values), np.result_type(values, float)) for values in (k, shift))
        known = self._cache.find((k, shift))
        if known is not None:
            return known
        exponent = _exponent_out_of_range(k, shift)
        scaled_shift = shifted(np.atleast_1d(shift), -exponent).reshape(np.shape(shift))
        op = self._operator(shifted(k, -exponent) if exponent else k.copy(), scaled_shift)
        inverse = build(op, name=self.name, log=self.info, solves="few", all_rows=self.all_rows, **self._settings)
        inverse.solver.system.exponent += exponent  # solutions are scaled back by it
        return self._cache.put((k, shift), inverse)

    def __str__(self):
        if not len(self._cache):
            return f"{self!r}, not set up yet"
        return f"{self!r}, {len(self._cache)} of {self._cache.most} set-ups kept, the last one:\n{self._cache.last}"


def _exponent_out_of_range(k, shift):
    """Return the exponent of the largest coefficient where products with spacings could leave the range of floats.

    0 where they cannot, and where coefficients differ so much that dividing by that power of two loses digits.
    """
    sizes = np.abs(np.concatenate([np.ravel(k), np.ravel(shift)]))
    exponent = exponent_of(np.max(sizes, initial=0.0))
    if abs(exponent) <= FAR:
        return 0
    smallest = np.min(sizes, where=sizes > 0, initial=np.inf)
    return exponent if np.isinf(smallest) or exponent_of(smallest) - exponent > LEAST_EXPONENT else 0


# ---------------------------------------------------------------- a coefficient on the faces


def elliptic_solver(D, G, method="auto", rtol=1e-10, maxiter=None, nullspace="raise", **options):
    """Divergence and gradient -> solve(k, b, shift=0.0): x of (shift - D diag(k) G) x = b.

    Parameters
    ----------
    D : Operator, faces -> cells
    G : Operator, cells -> faces
        Boundary conditions and obstacles are part of it.
    method, rtol, maxiter, nullspace, **options
        As in `inverse`; options go to the method.

    Returns
    -------
    EllipticSolver
        Call it as ``solve(k, b, shift=0.0)``: k a number or one value for each face, real and >= 0 or
        complex, or a tensor for each cell, shape (dim, dim, *grid.shape), its symmetric real part positive
        definite; b a field on the cells; shift a number or one for each cell, real or complex; all finite.
        Differentiable in all three, to every order. The set-up depends on the content of (k, shift); the
        last two are kept.

    Raises
    ------
    TypeError
        If D or G is not an Operator, and on use, if k or b is a masked array, or k or shift holds no numbers.
    ShapeError
        If D and G do not fit, and on use, if k, b or shift has another shape.
    ValueError
        On use, if k is real and negative, or a tensor is not positive definite.
    NonFiniteError
        On use, if k, b or shift holds NaN or infinity.
    ConvergenceError
        On use, as for `inverse`.

    Notes
    -----
    Cost: one solve; its derivative in any of k, b, shift one more, with the transpose of the same
    set-up. Null space: where shift is 0 and no wall holds the level (pure Neumann), as for `inverse`;
    derivatives are projected, never refused. Helmholtz: a negative shift, -(omega / c)^2; its imaginary
    part damps, and absorbs waves where it grows towards the walls. Tensors: order 2; where G has no slope
    (a closed wall, a solid) the flux is 0, not the slope; see operators/tensor.py.

    Examples
    --------
    >>> from sparsedp import Grid, dirichlet, divergence, gradient, value_and_grad
    >>> grid = Grid(2)
    >>> solve = elliptic_solver(divergence(grid), gradient(grid, dirichlet))
    >>> solve(1.0, np.array([2.0, 2.0]))
    as_field([1., 1.])
    >>> value_and_grad(lambda k: solve(k, np.array([2.0, 2.0]))[0])(1.0)
    (1.0, -1.0)
    """
    for name, op in (("D", D), ("G", G)):
        check_type(f"elliptic_solver, as {name},", op, Operator, "an Operator", "dp.from_matrix(...) first")
    if not (fits(D.domain, G.codomain) and fits(D.codomain, G.domain)):
        raise ShapeError(
            f"elliptic_solver needs D @ G to be square: {D.name} maps {D.domain} to {D.codomain}, "
            f"{G.name} {G.domain} to {G.codomain}"
        )
    return EllipticSolver(D, G, check_settings(method, rtol, maxiter, nullspace, options))


class EllipticSolver(ParametricSolver):
    """solve(k, b, shift=0.0), made by `elliptic_solver`."""

    name = "elliptic_solver"

    def recipe(self):
        """The call that makes it again: see _utils/reconstruction.py."""
        return EllipticSolver, (self.D, self.G, self._settings)  # what is cached is set up again

    @public("dp.elliptic_solver(D, G)")
    def __call__(self, k, b, shift=0.0):
        """Solve (shift - D diag(k) G) x = b.

        Parameters
        ----------
        k : number, or array of the shape of a field on the faces, or of shape (dim, dim, *grid.shape)
            A tensor need not be symmetric; where it is, so is the operator.
        b : array, a field on the cells; leading axes are a batch
        shift : number, or array of the shape of a field on the cells

        Returns
        -------
        array of the shape and dtype of b; complex where k or shift is
        """
        check_plain("elliptic_solver", k, b, shift)
        b, shift = b if isbox(b) else as_field(b), _values("shift", shift, self.D.codomain)
        k, solver = self._settled(k)
        return solver._solution(k, b, shift)

    def flux(self, k, slopes):
        """Coefficient and slopes on the faces -> the flux k g, of a tensor K g, as the solve takes it.

        Parameters
        ----------
        k : as for the call
        slopes : array, a field on the faces
            ``G(u)``, or with values at walls ``G(u) + dp.lift(grid, boundary)(values)``.

        Returns
        -------
        array like slopes
            ``D(solve.flux(k, G(u)))`` is what the solve inverts: a rate of `stepper`, and where walls hold values
            ``D(solve.flux(k, lift(values)))`` belongs to b. Differentiable in both.
        """
        check_plain("elliptic_solver.flux", k, slopes)
        k, solver = self._settled(k)
        return k * slopes if solver is self else solver.fluxes(k * solver.slopes(slopes))

    def operator(self, k, shift=0.0):
        """Plain k and shift -> the Operator shift - D diag(k) G that is solved with.

        Parameters
        ----------
        k, shift : as for the call

        Returns
        -------
        Operator
            The stiff part of a step is ``linear=-1.0 * solve.operator(k)``. It has no derivative in k: take `flux`.
        """
        if isbox(k) or isbox(shift):
            raise DerivativeError(
                "elliptic_solver.operator takes plain k and shift, got a traced one; write solve.flux"
            )
        check_plain("elliptic_solver.operator", k, shift)
        (k, solver), shift = self._settled(k), _values("shift", shift, self.D.codomain)
        return solver._operator(np.array(k, np.result_type(k, float)), np.array(shift, np.result_type(shift, float)))

    def _settled(self, k):
        """(k for each face, or tensors at the corners; the solver for them)."""
        k = k if isbox(k) else as_field(k)
        if np.ndim(k) <= 2:
            return self._coefficient(k), self
        self.D.backend.check("a tensor")
        solver = self._tensors
        check_tensor("k", k, self.D.codomain.grid)
        return solver.at_corners(cast(k, np.result_type(dtype_of(k), float))), solver

    @cached_property
    def _tensors(self):
        return TensorSolver(self)

    def _coefficient(self, k):
        k = _values("k", k, self.D.domain, "harmonic_average(grid)(k)", self.D.codomain)
        values = as_field(plain(k))
        if values.dtype.kind != "c" and np.any(values < 0):
            raise ValueError(f"k must be >= 0, got {np.min(values):g} at {np.argmin(values)}")
        return k * np.ones(self.D.domain.shape) if values.ndim == 0 else k

    def _operator(self, k, shift):
        word, real = "shift" if shift.ndim else f"{shift:g}", np.result_type(k, shift).kind == "f"
        name = f"{word} - {self.D.name} @ diag(k) @ {self.G.name}"
        even = real and not shift.ndim and k.size and np.all(k == k[0])
        if even and self._product.separable and self._settings["method"] != "direct":
            # Constant coefficients keep the operator a sum of 1-D factors.
            op = -k[0] * self._product + float(shift) * identity(self.G.domain)
            return Operator(op.structure, self.G.domain, self.D.codomain, name)
        return Operator(Elliptic(self._minus, self.G, k, shift), self.G.domain, self.D.codomain, name)

    @cached_property
    def _minus(self):
        return -self.D

    @cached_property
    def _product(self):
        return self.D @ self.G

    def __repr__(self):
        return f"<elliptic_solver: shift - {self.D.name} @ diag(k) @ {self.G.name} on {self.G.domain}>"


class TensorSolver(ParametricSolver):
    """As the EllipticSolver `front`, with D and G that meet at the corners of cells: they are multiplied out."""

    name = "elliptic_solver"
    all_rows = False  # the rows of obstacles hold the flux into them, and its explicit matrix no longer shows that

    def __init__(self, front):
        D, G, grid = front.D, front.G, front.D.codomain.grid
        if grid is None or (D.codomain, D.domain) != (grid.cells, grid.faces):
            raise ShapeError(f"a tensor needs D from the faces to the cells of a grid, got {D}; write k for each face")
        closed = G.structure.magnitude()(np.ones(G.shape[1])) == 0
        self.slopes, self.fluxes, self.at_corners = corners(grid, closed)  # to corners and back, and of tensors
        super().__init__(D @ self.fluxes, self.slopes @ G, front._settings)
        self.info, self._cache = front.info, front._cache

    def _operator(self, k, shift):
        structure = Matrix(Elliptic(-self.D, self.G, k, shift).explicit())
        return Operator(structure, self.G.domain, self.D.codomain, "shift - divergence of tensor fluxes")


def _values(name, given, space, advice="", other=None):
    """A parameter, traced or not, which must be one finite number or a field on `space`.

    `advice`: what to write where it is a field on the space `other`.
    """
    values = as_field(plain(given))
    if values.shape not in ((), space.shape):
        advice = f"; write {advice}" if other is not None and values.shape == other.shape else ""
        raise ShapeError(
            f"{name} takes a number or a field on {space.described}, got an array of shape {values.shape}{advice}"
        )
    check_kind(name, values.dtype, "numbers", f"; write np.asarray({name}, float)")
    check_finite(name, values)
    return given if isbox(given) else values


class Elliptic(Sum):
    """shift + D diag(k) G: a sum that acts in one pass where D and G are differences of a grid.

    Parameters
    ----------
    D, G : Operator
        They keep what does not depend on k: transposes, magnitudes, and matrices where entries are asked for.
    k : array, shape (faces,)
    shift : a number or a field on the cells
    """

    def __init__(self, D, G, k, shift):
        self.D, self.G, self.k = D, G, Diagonal(k)
        self.shift = Diagonal(np.broadcast_to(np.ravel(shift), D.shape[0]))
        super().__init__([self.shift, Chain([D.structure, self.k, G.structure])])

    def transpose(self):
        return Elliptic(self.G.T, self.D.T, self.k.values, self.shift.values)

    def scaled(self, factor):
        return None  # so that the entries are the same bits, scaled

    def explicit(self):
        return compact(self.shift.explicit() + self.D.matrix @ (self.k.explicit() @ self.G.matrix))


# ---------------------------------------------------------------- the entries of a matrix


def matrix_solver(pattern, method="auto", rtol=1e-10, maxiter=None, nullspace="raise", domain=None, **options):
    """Sparsity pattern -> solve(data, b): x of A x = b, where A has the entries `data` on the pattern.

    Parameters
    ----------
    pattern : sparse matrix or 2-D array, square
        Its places count, not its values; a stored 0 is a place. `matrix_solver.from_coo(rows, columns)` takes places
        in any order, some of them many times, as assembly gives them.
    method, rtol, maxiter, nullspace, **options
        As in `inverse`; options go to the method.
    domain : Space, int or tuple of int, optional
        Where b and x live. Default: flat arrays.

    Returns
    -------
    MatrixSolver
        Call it as ``solve(data, b)``. `solve.rows` and `solve.columns` hold the place of each entry.
        Differentiable in data and b, to every order. The set-up depends on the content of data; the
        last two are kept. `solve.info` holds the records.

    Raises
    ------
    ShapeError
        If the pattern is not square or does not fit the domain; on use, if data or b has another shape.
    TypeError
        On use, if data does not hold numbers.
    NonFiniteError
        On use, if data or b holds NaN or infinity.
    ConvergenceError, IncompatibleError
        On use, as for `inverse`.

    Notes
    -----
    Formula: data_bar_ij = -y_i x_j on the pattern, with A^T y = g: one adjoint solve for data and b.
    Null space: as for `inverse`. The derivative in data of a singular system is that along changes
    which keep its null vectors, such as those that leave every row sum 0.
    Cost: one set-up for each new content of data, one solve, one adjoint solve, memory of the order of
    the entries: no outer product is formed.

    Examples
    --------
    >>> from sparsedp import value_and_grad
    >>> solve = matrix_solver([[1, 0], [1, 1]])
    >>> data, b = np.array([2.0, 1.0, 4.0]), np.array([2.0, 5.0])
    >>> solve(data, b)
    as_field([1., 1.])
    >>> value_and_grad(lambda data: solve(data, b)[1])(data)
    (1.0, as_field([ 0.125, -0.25 , -0.25 ]))
    """
    settings = check_settings(method, rtol, maxiter, nullspace, options)
    entries = pattern if sp.issparse(pattern) else np.asarray(pattern)
    if entries.ndim != 2:
        raise ShapeError(f"matrix_solver takes a 2-D pattern, got an array of shape {entries.shape}")
    pattern = pattern_like(entries)
    domain = domain if isinstance(domain, Space) else Space(pattern.shape[0] if domain is None else domain)
    check_shape("the pattern of matrix_solver", pattern, (domain.size, domain.size))
    return MatrixSolver(pattern, domain, settings)


def from_coo(rows, columns, domain=None, **settings):
    """Places of entries -> solve(values, b): x of A x = b, where values[i] is added to A at rows[i], columns[i].

    What assembly gives: places in any order, some of them many times. Values on one place are summed.

    Parameters
    ----------
    rows, columns : int arrays, shape (entries,)
    domain : Space, int or tuple of int, optional
        Where b and x live. Default: flat arrays, as long as the largest place asks for.
    **settings
        method, rtol and the others of `matrix_solver`.

    Returns
    -------
    MatrixSolver
        Differentiable in values, one for each place given, and b. `solve.rows` and `solve.columns` are the places of A.

    Raises
    ------
    TypeError
        If rows or columns are no integers.
    ShapeError
        If rows and columns differ in shape, are not flat, or do not fit the domain.

    Examples
    --------
    >>> import sparsedp as dp
    >>> solve = dp.matrix_solver.from_coo([0, 1, 0], [0, 1, 0])  # two values on the first place
    >>> solve(np.array([1.5, 4.0, 0.5]), np.array([2.0, 8.0]))
    as_field([1., 2.])
    """
    places = np.asarray(rows), np.asarray(columns)
    if places[0].ndim != 1 or places[0].shape != places[1].shape:
        raise ShapeError(f"from_coo takes flat rows and columns, got shapes {places[0].shape} and {places[1].shape}")
    for one in places:
        check_kind("rows and columns", one.dtype, "integers")
    domain = domain if domain is None or isinstance(domain, Space) else Space(domain)
    size = 1 + max(int(one.max(initial=-1)) for one in places) if domain is None else domain.size
    if places[0].size == 0 or min(map(np.min, places)) < 0 or max(map(np.max, places)) >= size:
        raise ShapeError(f"from_coo takes rows and columns from 0 to {size - 1}, one place at least; give others")
    keys, slot = np.unique(places[0].astype(np.int64) * size + places[1], return_inverse=True)
    pattern = sp.csr_array((np.ones(keys.size), np.divmod(keys, size)), shape=(size, size))
    solve = matrix_solver(pattern, domain=domain, **settings)
    adding = sp.csc_array((np.ones(slot.size), slot, np.arange(slot.size + 1)), shape=(keys.size, slot.size))
    solve.assembly = from_matrix(adding, name="sum of entries")
    return solve


matrix_solver.from_coo = from_coo  # type: ignore[attr-defined]


class MatrixSolver(ParametricSolver):
    """solve(data, b), made by `matrix_solver`.

    Attributes
    ----------
    rows, columns : int arrays, shape (entries,)
        Place of each entry, in the order of data: row by row, columns ascending.
    assembly : Operator or None
        What was given -> data; None where data is given (`matrix_solver.from_coo` sums on one place).
    domain : Space
    """

    name = "matrix_solver"

    def __init__(self, pattern, domain, settings, assembly=None):
        self.domain, self._pattern, self.assembly = domain, pattern, assembly
        self.rows = rows_of(pattern)
        self.columns = pattern.indices
        super().__init__(self._picking(self.rows, -1.0).T, self._picking(self.columns, 1.0), settings)

    def recipe(self):
        """The call that makes it again: see _utils/reconstruction.py."""
        return MatrixSolver, (self._pattern, self.domain, self._settings, self.assembly)

    def _picking(self, place, sign):
        """Operator: a field -> for each entry the value at its row, or its column, times the sign."""
        shape = (place.size, self.domain.size)
        matrix = sp.csr_array((np.full(place.size, sign), place, np.arange(place.size + 1)), shape=shape)
        return from_matrix(matrix, self.domain, name="entries")

    @public("dp.matrix_solver(pattern)")
    def __call__(self, data, b):
        """Solve A x = b.

        Parameters
        ----------
        data : array, shape (entries,)
        b : array, a field on the domain; leading axes are a batch

        Returns
        -------
        array of the shape of b
        """
        check_plain(self.name, data, b)
        if self.assembly is not None:
            data = self.assembly(data)
        values = np.asarray(plain(data))
        check_shape("data", values, self.rows.shape, "; give one value for each entry")
        check_kind("data", values.dtype, "numbers")
        check_finite("data", values, where=lambda entry: f"row {self.rows[entry]}, column {self.columns[entry]}")
        return self._solution(data if isbox(data) else values, b if isbox(b) else np.asarray(b), 0.0)

    def _operator(self, data, shift):
        matrix = sp.csr_array((data, self._pattern.indices, self._pattern.indptr), shape=self._pattern.shape)
        return from_matrix(matrix, self.domain, self.domain, name=f"matrix of {self.rows.size} entries")

    def __repr__(self):
        return f"<{self.name}: {self.rows.size} entries on {self.domain}>"
