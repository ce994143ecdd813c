"""Solves whose operator depends on parameters: x of (shift - D diag(k) G) x = b, differentiable in k, b and shift.

Notes
-----
With A = shift - D diag(k) G and A x = b, one adjoint solve A^T y = g serves all arguments (see adjoint.py):

    cotangent of b: y,    of shift: -y * x (its sum where shift is one number),    of k: (D^T y) * (G x).

In a batch of systems this holds for each entry, with one adjoint solve for each. The cotangent of an argument without
the leading axis, which is the same for all entries, is the sum over the entries.

A matrix with the entries k at the places (i, j) of a fixed pattern is of that form too: D = -R^T and G = C, where R
and C pick the value at the row and at the column of each entry. The cotangent of an entry is -y_i x_j, and only the
places of the pattern are visited.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, overload

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import public
from sparsedp._utils.validation import check_finite, check_kind, check_plain, check_shape, check_type, place
from sparsedp.autodiff.backend import as_field, gathered
from sparsedp.autodiff.derivative import of_argument
from sparsedp.autodiff.fast_derivatives import in_dtype
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import Rule, cast, dtype_of, isbox, sample
from sparsedp.errors import ConvergenceError, DerivativeError, ShapeError
from sparsedp.grid.space import Space, fits
from sparsedp.operators.difference import divergence
from sparsedp.operators.given import from_matrix
from sparsedp.operators.masks_and_lift import Body, identity
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

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from sparsedp.solvers.choose_method import SolveSettings
    from sparsedp.solvers.inverse import Inverse

__all__ = ["Elliptic", "EllipticSolver", "MatrixSolver", "elliptic_solver", "matrix_solver"]


LARGEST_EXPONENT = 500  # coefficients beyond 2^500 or below 2^-500 are scaled before the operator is built
SMALLEST_EXPONENT = -1022  # of a float with all its digits


class ParametricSolver(Reconstructible):
    """A solver of (shift - D diag(k) G) x = b, with a derivative rule in (k, b, shift).

    A subclass has a `name` and defines ``_operator(k, shift)``, which may keep the arrays, and
    ``of_coefficients(*given)``, which returns the solver and the checked (k, shift) of the coefficients of a call.

    Parameters
    ----------
    D, G : Operator
    settings : SolveSettings

    Attributes
    ----------
    info : SolveLog
        Records of the last forward and the last adjoint solve, and of the last set-up.
    """

    name: str
    all_rows = True  # refuse an operator with an equation that no unknown can satisfy: see `build`
    _operator: Any
    of_coefficients: Any  # for `eigenpairs`

    def __init__(self, D: Operator, G: Operator, settings: SolveSettings) -> None:
        self.D = D
        self.G = G
        self.info = SolveLog()
        self._settings = settings
        self._cache = Cache()
        self._batch_cache = Cache()  # of lists of inverses

    def _solution(self, k, b, shift, solve=None):
        """Return the solution; `solve` is the function of `solve_rule`, by default that for one operator."""
        rule = solve_rule(self.name, solve or self._solve, self._negative_gradient, self._product, checked=True)
        return rule(b, k, shift)

    def _solve(self, transposed, checked, b, k, shift):
        return _solved(self._inverse(k, shift), transposed, checked, b)

    def _negative_gradient(self, params, places, y, x):
        """Return -grad <y, A x> in k (place 0) and shift (place 1)."""
        gradients = []
        for position in places:
            if position == 0:
                gradient = self.D.T(y) * self.G(x)
            else:
                gradient = -y * x
            gradients.append(of_argument(gradient, params[position]))
        return gradients

    def _product(self, transposed, x, k, shift):
        """Return A x or A^T x."""
        if transposed:
            return shift * x - self.G.T(k * self.D.T(x))
        return shift * x - self.D(k * self.G(x))

    def _inverse(self, k, shift) -> Inverse:
        """Return the inverse for these values, from the cache or new."""
        k = _in_floating_dtype(k)
        shift = _in_floating_dtype(shift)
        inverse = self._cache.find((k, shift))
        if inverse is not None:
            return inverse
        return self._cache.put((k, shift), self._new_inverse(k, shift))

    def _new_inverse(self, k, shift) -> Inverse:
        """Return a new inverse for floating values of k and shift."""
        exponent = _exponent_out_of_range(k, shift)
        scaled_k = shifted(k, -exponent) if exponent else k.copy()
        scaled_shift = shifted(np.atleast_1d(shift), -exponent).reshape(np.shape(shift))
        op = self._operator(scaled_k, scaled_shift)
        inverse = build(op, self._settings, self.name, self.info, solves="few", all_rows=self.all_rows)
        inverse.solver.system.exponent += exponent  # solutions are scaled back by it
        return inverse

    def __str__(self) -> str:
        if not len(self._cache):
            return f"{self!r}, not set up yet"
        return f"{self!r}, {len(self._cache)} of {self._cache.most} set-ups kept, the last one:\n{self._cache.last}"


def _solved(inverse, transposed, checked, b):
    """Return the solution for b by an inverse or its transpose; see `solve_rule`."""
    if transposed:
        return inverse.T.apply(b)
    if checked:
        return inverse.apply(b)
    return inverse.tangent.apply(b)


def _in_floating_dtype(values):
    return in_dtype(gathered(values), np.result_type(values, float))


def _exponent_out_of_range(k, shift):
    """Return the exponent of the largest coefficient where products with spacings could leave the range of floats.

    0 where they cannot, and where coefficients differ so much that dividing by that power of two loses digits.
    """
    sizes = np.abs(np.concatenate([np.ravel(k), np.ravel(shift)]))
    exponent = exponent_of(np.max(sizes, initial=0.0))
    if abs(exponent) <= LARGEST_EXPONENT:
        return 0
    smallest = np.min(sizes, where=sizes > 0, initial=np.inf)
    if np.isinf(smallest) or exponent_of(smallest) - exponent > SMALLEST_EXPONENT:
        return exponent
    return 0


# ---------------------------------------------------------------- a coefficient on the faces


@overload
def elliptic_solver(
    D: Operator,
    G: Operator,
    method: str = ...,
    rtol: float = ...,
    maxiter: int | None = ...,
    nullspace: str = ...,
    **options: Any,
) -> EllipticSolver: ...
@overload
def elliptic_solver(
    D: Operator,
    G: Body,
    method: str = ...,
    rtol: float = ...,
    maxiter: int | None = ...,
    nullspace: str = ...,
    **options: Any,
) -> CutEllipticSolver: ...
def elliptic_solver(
    D: Operator,
    G: Operator | Body,
    method: str = "auto",
    rtol: float = 1e-10,
    maxiter: int | None = None,
    nullspace: str = "raise",
    **options: Any,
) -> EllipticSolver | CutEllipticSolver:
    """Return the function solve(k, b, shift=0.0) for x of (shift - D diag(k) G) x = b, with variable coefficients k.

    Parameters
    ----------
    D : Operator
        Divergence, from faces to cells.
    G : Operator, or body of `cut_cells`
        Gradient, from cells to faces. Boundary conditions and obstacles are part of it. With a body, D is
        ``dp.divergence(grid)``, and the call is ``body.solve(b, k=k, shift=shift)`` with this method and tolerance.
    method, rtol, maxiter, nullspace, **options
        As in `inverse`; options go to the method.

    Returns
    -------
    EllipticSolver
        Call it as ``solve(k, b, shift=0.0)``; all values are finite. k is a number or one value for each face, real
        and >= 0 or complex, or a tensor for each cell, shape (dim, dim, *grid.shape), its symmetric real part
        positive definite. b is a field on the cells. shift is a number or one for each cell, real or complex.
        Differentiable in all three, to every order. A set-up is built for each new content of (k, shift); the last
        two are cached.
        A leading axis of k, shift or b is a batch of independent systems, such as an ensemble of coefficients; an
        argument without that axis is the same for all of them. A batch of numbers has the shape (batch, 1) as k, and
        (batch, 1, ..., 1) as shift. It is refused if batch is the length of a field with one axis, such as k: that is
        more often a field with an axis too many, such as the output of a network. The set-ups of the last two batches
        are cached.

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

    See Also
    --------
    cut_cells, eigenpairs, harmonic_average, inverse, matched_layer, matrix_solver

    Notes
    -----
    **Derivatives.** With A = shift - D diag(k) G, A x = b and A^T y = g: the cotangent of b is y, of shift -y * x
    (its sum where shift is one number), and of k (D^T y) * (G x).

    **Cost.** One solve, and one more for the derivatives in k, b and shift together, with the transpose of the same
    set-up.

    **Null space.** Where shift is 0 and no boundary condition fixes the level (pure Neumann), as for `inverse`;
    derivatives are projected, never refused.

    **Helmholtz.** The shift is negative, -(omega / c)^2. Its imaginary part damps waves, and absorbs them where it
    grows towards the walls. `matched_layer` returns coefficients that absorb waves of all directions; ``order=4`` of
    `gradient` and `divergence` keeps the phase of waves of ten cells.

    **Tensors.** The discretisation is of order 2. Where G has no slope (a closed wall, an obstacle) the flux is 0, not
    the slope; see operators/tensor.py.

    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> from sparsedp import Grid, dirichlet, divergence, gradient, value_and_grad
    >>> grid = Grid(2)
    >>> solve = elliptic_solver(divergence(grid), gradient(grid, dirichlet))
    >>> solve(1.0, np.array([2.0, 2.0]))
    array([1., 1.])
    >>> value_and_grad(lambda k: solve(k, np.array([2.0, 2.0]))[0])(1.0)
    (1.0, -1.0)
    """
    settings = check_settings(method, rtol, maxiter, nullspace, options)
    if isinstance(G, Body):
        return CutEllipticSolver(_checked_divergence(D, G), G, settings)
    for name, op in (("D", D), ("G", G)):
        check_type(f"elliptic_solver, as {name},", op, Operator, "an Operator", "dp.from_matrix(...) first")
    if not (fits(D.domain, G.codomain) and fits(D.codomain, G.domain)):
        raise ShapeError(
            f"elliptic_solver needs D @ G to be square: {D.name} maps {D.domain} to {D.codomain}, "
            f"{G.name} {G.domain} to {G.codomain}"
        )
    return EllipticSolver(D, G, settings)


def _checked_divergence(D, body):
    """Return D; raise unless it is the divergence on the grid of a body of cut_cells."""
    check_type("elliptic_solver, as D,", D, Operator, "an Operator", "dp.divergence(grid)")
    expected = divergence(body.grid)
    if (D.domain, D.codomain) != (expected.domain, expected.codomain) or (D.matrix != expected.matrix).nnz:
        raise ValueError(
            f"elliptic_solver with a body of cut_cells takes the divergence of order 2 as D, got {D}; write "
            "dp.elliptic_solver(dp.divergence(body.grid), body)"
        )
    return D


class CutEllipticSolver(Reconstructible):
    """The differentiable function solve(k, b, shift=0.0) that `elliptic_solver` returns for a body of `cut_cells`.

    Parameters
    ----------
    D : Operator
        The divergence.
    body : CutCells
    settings : SolveSettings

    Attributes
    ----------
    info : SolveLog
        Records of the last solves.
    """

    def __init__(self, D: Operator, body: Any, settings: SolveSettings) -> None:
        self.constructor_call = (CutEllipticSolver, (D, body, settings))
        self._body = body.with_settings(settings)

    @property
    def info(self) -> Any:
        """Records of the last solves; None before the first one."""
        return self._body.info

    def __call__(self, k: Any, b: Any, shift: Any = 0.0) -> Any:
        """Solve shift x - div(k grad x) = b in the fluid, with the value 0 on all walls; see `CutCells.solve`."""
        return self._body.solve(b, k=k, shift=shift)

    def __repr__(self) -> str:
        return f"<elliptic_solver: {self._body}>"


class EllipticSolver(ParametricSolver):
    """The differentiable function solve(k, b, shift=0.0) that `elliptic_solver` returns."""

    name = "elliptic_solver"

    def recipe(self) -> tuple[type[EllipticSolver], tuple[Any, ...]]:
        """Return the call that reconstructs this object, without its set-ups: see _utils/base_classes.py."""
        return EllipticSolver, (self.D, self.G, self._settings)

    @public("dp.elliptic_solver(D, G)")
    def __call__(self, k: Any, b: Any, shift: Any = 0.0) -> Any:
        """Solve (shift - D diag(k) G) x = b.

        Parameters
        ----------
        k : number, or array of the shape of a field on the faces, or of shape (dim, dim, *grid.shape)
            A tensor need not be symmetric; where it is, so is the operator. A leading axis is a batch; a batch of
            numbers has the shape (batch, 1).
        b : array, a field on the cells; leading axes are a batch
        shift : number, or array of the shape of a field on the cells; a leading axis is a batch, of numbers with the
            shape (batch, 1, ..., 1)

        Returns
        -------
        array of the shape and dtype of b; complex where k or shift is
            With a leading axis if k, b or shift has one. With a batch of k or shift, b has at most one such axis.
        """
        check_plain("elliptic_solver", k, b, shift)
        if not isbox(b):
            b = as_field(b)
        shift, n_shift = _checked_batch("shift", shift, self.D.codomain)
        k, solver, n_k = self._coefficient_and_solver(k)
        if n_k is None and n_shift is None:
            return solver._solution(k, b, shift)
        self.D.backend.check("a batch of coefficients")
        sizes = {"k": n_k, "shift": n_shift, "b": _batch_of_right_hand_sides(b, self.D.codomain)}
        batch = Batch(solver, _common_size(sizes), n_k is not None, n_shift is not None)
        return solver._solution(k, b, shift, batch.solve)

    def flux(self, k: Any, slopes: Any) -> Any:
        """Return the flux k g, or K g of a tensor, from slopes g on the faces, as the solve discretises it.

        Parameters
        ----------
        k : as for the call
        slopes : array, a field on the faces
            ``G(u)``, or with values at walls ``G(u) + dp.lift(grid, boundary)(values)``.

        Returns
        -------
        array like slopes
            ``D(solve.flux(k, G(u)))`` is what the solve inverts: a rate for `stepper`. Where walls hold values,
            ``D(solve.flux(k, lift(values)))`` belongs to b. Differentiable in both arguments.
        """
        check_plain("elliptic_solver.flux", k, slopes)
        k, solver, _ = self._coefficient_and_solver(k)
        if solver is self:
            return k * slopes
        return solver.fluxes(k * solver.slopes(slopes))

    def operator(self, k: ArrayLike, shift: ArrayLike = 0.0) -> Operator:
        """Return the Operator shift - D diag(k) G of plain k and shift.

        Parameters
        ----------
        k, shift : as for the call

        Returns
        -------
        Operator
            The stiff part of a step is ``linear=-1.0 * solve.operator(k)``. It has no derivative in k; use `flux` for
            that.
        """
        if isbox(k) or isbox(shift):
            raise DerivativeError(
                "elliptic_solver.operator takes plain k and shift, got a traced one; write solve.flux"
            )
        check_plain("elliptic_solver.operator", k, shift)
        values, solver, n_k = self._coefficient_and_solver(k)
        if n_k is not None:
            raise ShapeError(
                f"elliptic_solver.operator takes one k, got a batch of {n_k}; call it for each entry along the "
                "first axis"
            )
        shift = _checked_parameter("shift", shift, self.D.codomain)
        k_copy = np.array(values, np.result_type(values, float))
        shift_copy = np.array(shift, np.result_type(shift, float))
        return solver._operator(k_copy, shift_copy)

    def of_coefficients(self, k: Any, shift: Any = 0.0) -> tuple[ParametricSolver, tuple[Any, Any]]:
        """Return the solver of these coefficients, and (k, shift) of its operator, checked."""
        check_plain("elliptic_solver", k, shift)
        shift = _checked_parameter("shift", shift, self.D.codomain)
        k, solver, n_k = self._coefficient_and_solver(k)
        if n_k is not None:
            raise ShapeError(
                f"eigenpairs takes one coefficient k, got a batch of {n_k}; call it for each entry along the first axis"
            )
        return solver, (k, shift)

    def _coefficient_and_solver(self, k):
        """Return k for each face and this solver, or a tensor at the corners of cells and its solver.

        The third value is the size of the batch of coefficients along the first axis, or None if k has no such axis.
        """
        if not isbox(k):
            k = as_field(k)
        if np.ndim(k) <= 2:
            k, batch = self._face_coefficient(k)
            return k, self, batch
        self.D.backend.check("a tensor")
        solver = self._tensor_solver
        grid = self.D.codomain.grid
        k = cast(k, np.result_type(dtype_of(k), float))
        if np.ndim(k) < 3 + grid.dim:
            check_values(partial(check_tensor, "k", grid=grid), k)
            return solver.at_corners(k), solver, None
        batch = np.shape(k)[0]
        check_values(partial(_check_tensors, grid=grid), k)
        # The tensors at the corners, for all entries of the batch at once: an axis behind the axes of the tensor.
        at_corners = solver.at_corners(anp.moveaxis(k, 0, 2))
        return anp.moveaxis(at_corners, 3, 0), solver, batch

    @cached_property
    def _tensor_solver(self):
        return TensorSolver(self)

    def _face_coefficient(self, k):
        """Return k for each face, and the size of its batch, or None."""
        k, batch = _checked_batch("k", k, self.D.domain, "harmonic_average(grid)(k)", self.D.codomain)
        check_values(_check_not_negative, k)
        if np.ndim(sample(k)) == 0:
            return k * np.ones(self.D.domain.shape), None
        return k, batch

    def _operator(self, k, shift):
        shift_name = "shift" if shift.ndim else f"{shift:g}"
        name = f"{shift_name} - {self.D.name} @ diag(k) @ {self.G.name}"
        is_real = np.result_type(k, shift).kind == "f"
        is_constant = is_real and not shift.ndim and k.size and np.all(k == k[0])
        if is_constant and self._divergence_of_gradient.separable and self._settings.method != "direct":
            # Constant coefficients: the operator remains a sum of 1-D factors.
            op = -k[0] * self._divergence_of_gradient + float(shift) * identity(self.G.domain)
            return Operator(op.structure, self.G.domain, self.D.codomain, name)
        return Operator(Elliptic(self._negative_divergence, self.G, k, shift), self.G.domain, self.D.codomain, name)

    @cached_property
    def _negative_divergence(self):
        return -self.D

    @cached_property
    def _divergence_of_gradient(self):
        return self.D @ self.G

    def __repr__(self) -> str:
        return f"<elliptic_solver: shift - {self.D.name} @ diag(k) @ {self.G.name} on {self.G.domain}>"


class Batch:
    """The solves of a batch of independent systems with coefficients of their own.

    Parameters
    ----------
    solver : EllipticSolver or TensorSolver
    size : int
        Number of systems.
    has_k, has_shift : bool
        Whether k, or shift, has a leading axis; else it is the same for all systems.
    """

    def __init__(self, solver: ParametricSolver, size: int, has_k: bool, has_shift: bool) -> None:
        self._solver = solver
        self._size = size
        self._has_k = has_k
        self._has_shift = has_shift

    def solve(self, transposed: bool, checked: bool, b: Any, k: Any, shift: Any) -> NDArray[Any]:
        """Return the solutions, stacked along the first axis; see `solve_rule`."""
        space = self._solver.D.codomain
        solutions = []
        has_b = np.ndim(b) > len(space.shape)
        for i, inverse in enumerate(self._inverses(k, shift)):
            try:
                solutions.append(_solved(inverse, transposed, checked, b[i] if has_b else b))
            except ConvergenceError as error:
                error.args = (f"entry {i} of the batch: {error}", *error.args[1:])
                raise
        if not solutions:
            dtype = np.result_type(b, np.float32)
            if np.iscomplexobj(k) or np.iscomplexobj(shift):
                dtype = np.result_type(dtype, np.complex64)
            return np.empty((0, *space.shape), dtype)
        return np.array(solutions)

    def _inverses(self, k, shift) -> list[Inverse]:
        """Return the inverses of all systems, from the cache or new."""
        k = _in_floating_dtype(k)
        shift = _in_floating_dtype(shift)
        cache = self._solver._batch_cache
        inverses = cache.find((k, shift))
        if inverses is not None:
            return inverses
        inverses = []
        for i in range(self._size):
            k_of_entry = k
            shift_of_entry = shift
            if self._has_k:
                k_of_entry = k[i]
            if self._has_shift:
                shift_of_entry = shift[i]
                if shift_of_entry.size and np.all(shift_of_entry == shift_of_entry.flat[0]):
                    shift_of_entry = np.asarray(shift_of_entry.flat[0])  # a number: the operator may be separable
            inverses.append(self._solver._new_inverse(k_of_entry, shift_of_entry))
        return cache.put((k, shift), inverses)


class TensorSolver(ParametricSolver):
    """The solver for coefficients that are tensors, with D and G between the cells and the corners of cells.

    Parameters
    ----------
    solver : EllipticSolver
        With D and G between the cells and the faces; both solvers share their records and set-ups.
    """

    name = "elliptic_solver"
    all_rows = False  # the rows of obstacles hold the flux into them, and its explicit matrix no longer shows that

    def __init__(self, solver: EllipticSolver) -> None:
        D = solver.D
        G = solver.G
        grid = D.codomain.grid
        if grid is None or (D.codomain, D.domain) != (grid.cells, grid.faces):
            raise ShapeError(f"a tensor needs D from the faces to the cells of a grid, got {D}; write k for each face")
        is_closed = G.structure.magnitude()(np.ones(G.shape[1])) == 0
        # Slopes from faces to corners, fluxes from corners to faces, and tensors from cells to corners.
        self.slopes, self.fluxes, self.at_corners = corners(grid, is_closed)
        super().__init__(D @ self.fluxes, self.slopes @ G, solver._settings)
        self.info = solver.info
        self._cache = solver._cache
        self._batch_cache = solver._batch_cache

    def _operator(self, k, shift):
        structure = Matrix(Elliptic(-self.D, self.G, k, shift).explicit())
        return Operator(structure, self.G.domain, self.D.codomain, "shift - divergence of tensor fluxes")


def _checked_parameter(name, parameter, space, hint=""):
    """Return a parameter, traced or not, which must be one finite number or a field on `space`."""
    values = as_field(sample(parameter))
    if values.shape not in ((), space.shape):
        raise ShapeError(
            f"{name} takes a number or a field on {space.described}, got an array of shape {values.shape}{hint}"
        )
    return _finite_numbers(name, parameter)


def _finite_numbers(name, parameter):
    """Return a parameter, traced or as an array; raise an error if it holds no numbers or if one is not finite."""
    check_kind(name, as_field(sample(parameter)).dtype, "numbers", f"; write np.asarray({name}, float)")
    if not isbox(parameter):
        parameter = as_field(parameter)
    check_values(partial(check_finite, name), parameter)
    return parameter


def _checked_batch(name, parameter, space, advice="", other_space=None):
    """Return a parameter, and the size of its batch: as `_checked_parameter`, but there may be a leading axis.

    A batch of numbers, with axes of length 1 behind the leading one, is broadcast to fields. `advice` says what to
    write where the parameter is a field on `other_space`.
    """
    shape = np.shape(as_field(sample(parameter)))
    trailing_ones = (1,) * len(space.shape)
    of_numbers = shape[1:] == trailing_ones
    is_other_field = other_space is not None and shape == other_space.shape
    if len(shape) != 1 + len(space.shape) or not (of_numbers or shape[1:] == space.shape) or is_other_field:
        hint = ""
        if is_other_field:
            hint = f"; write {advice}"
        elif len(shape) == 1:
            hint = f"; a batch of {shape[0]} numbers has the shape {shape + trailing_ones}"
        return _checked_parameter(name, parameter, space, hint), None
    if of_numbers and shape[:1] == space.shape != (1,):
        raise ShapeError(
            f"{name} of shape {shape} may be a batch of {shape[0]} numbers, or a field on {space.described} with an "
            f"axis too many; write {name}[:, 0] for the field, or {name} * np.ones((1, {shape[0]})) for the batch"
        )
    parameter = _finite_numbers(name, parameter)
    if of_numbers:
        parameter = parameter * np.ones((1, *space.shape))
    return parameter, shape[0]


def _batch_of_right_hand_sides(b, space):
    """Return the size of the batch of right-hand sides that are solved with a batch of coefficients, or None."""
    shape = np.shape(b)
    if shape == space.shape:
        return None
    if shape[1:] == space.shape:
        return shape[0]
    raise ShapeError(
        f"b takes a field on {space.described}, or one for each entry of the batch of coefficients, got an array of "
        f"shape {shape}"
    )


def _common_size(sizes):
    """Return the size of a batch, given the size for each argument or None; raise ShapeError if the sizes differ."""
    sizes = {name: size for name, size in sizes.items() if size is not None}
    if len({*sizes.values()}) > 1:
        sizes_by_name = ", ".join(f"{size} of {name}" for name, size in sizes.items())
        raise ShapeError(
            f"elliptic_solver needs one batch size, got {sizes_by_name}; give each the same leading axis, or none"
        )
    return next(iter(sizes.values()))


def _check_tensors(tensors, grid):
    """Check each tensor of a batch along the first axis."""
    for i, tensor in enumerate(np.asarray(tensors)):
        check_tensor(f"k[{i}]", tensor, grid=grid)


def _check_not_negative(k):
    k = as_field(k)
    if k.dtype.kind != "c" and np.any(k < 0):
        raise ValueError(f"k must be >= 0, got {np.min(k):g} at {place(int(np.argmin(k)), np.shape(k) or (1,))}")


class Elliptic(Sum):
    """The structure of shift + D diag(k) G, which acts in one pass where D and G are differences on a grid.

    Parameters
    ----------
    D, G : Operator
        They keep what does not depend on k: transposes, magnitudes, and matrices where entries are needed.
    k : array, shape (faces,)
    shift : a number or a field on the cells
    """

    def __init__(self, D: Operator, G: Operator, k: NDArray[Any], shift: ArrayLike) -> None:
        self.D = D
        self.G = G
        self.k = Diagonal(k)
        self.shift = Diagonal(np.broadcast_to(np.ravel(shift), D.shape[0]))
        super().__init__([self.shift, Chain([D.structure, self.k, G.structure])])

    def transpose(self) -> Elliptic:
        """Return the structure of the transpose."""
        return Elliptic(self.G.T, self.D.T, self.k.values, self.shift.values)

    def scaled(self, factor: Any) -> None:
        """Return None: the entries are scaled instead, so that they keep their bits."""
        return None

    def explicit(self) -> sp.csr_array:
        """Return the entries."""
        return compact(self.shift.explicit() + self.D.matrix @ (self.k.explicit() @ self.G.matrix))


# ---------------------------------------------------------------- the entries of a matrix


def matrix_solver(
    pattern: Any,
    method: str = "auto",
    rtol: float = 1e-10,
    maxiter: int | None = None,
    nullspace: str = "raise",
    domain: Space | int | tuple[int, ...] | None = None,
    **options: Any,
) -> MatrixSolver:
    """Return the function solve(data, b) for x of A x = b, where A has the entries `data` on a sparsity pattern.

    Parameters
    ----------
    pattern : sparse matrix or 2-D array, square
        Only its places are used, not its values; a stored 0 is a place. Use ``matrix_solver.from_coo(rows, columns)``
        for places in any order, with repetitions, as assembly produces them.
    method, rtol, maxiter, nullspace, **options
        As in `inverse`; options go to the method.
    domain : Space, int or tuple of int, optional
        The space of b and x. Default: flat arrays.

    Returns
    -------
    MatrixSolver
        Call it as ``solve(data, b)``. `solve.rows` and `solve.columns` hold the place of each entry.
        Differentiable in data and b, to every order. A set-up is built for each new content of data; the last two are
        kept. `solve.info` holds the records.

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

    See Also
    --------
    eigenpairs, inverse, elliptic_solver

    Notes
    -----
    **Derivatives.** With A^T y = g: the cotangent of the entry (i, j) is -y_i x_j, and the cotangent of b is y.

    **Null space.** As for `inverse`. The derivative in data of a singular system holds for changes that keep its null
    vectors, such as those that keep every row sum 0.

    **Cost.** One set-up for each new content of data, one solve, and one adjoint solve for the derivatives in data and
    b. The memory is proportional to the number of entries: no outer product is formed.

    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> from sparsedp import value_and_grad
    >>> solve = matrix_solver([[1, 0], [1, 1]])
    >>> data, b = np.array([2.0, 1.0, 4.0]), np.array([2.0, 5.0])
    >>> solve(data, b)
    array([1., 1.])
    >>> value_and_grad(lambda data: solve(data, b)[1])(data)
    (1.0, array([ 0.125, -0.25 , -0.25 ]))
    """
    settings = check_settings(method, rtol, maxiter, nullspace, options)
    entries = pattern if sp.issparse(pattern) else np.asarray(pattern)
    if entries.ndim != 2:
        raise ShapeError(f"matrix_solver takes a 2-D pattern, got an array of shape {entries.shape}")
    pattern = pattern_like(entries)
    if domain is None:
        domain = pattern.shape[0]
    if not isinstance(domain, Space):
        domain = Space(domain)
    check_shape("the pattern of matrix_solver", pattern, (domain.size, domain.size))
    return MatrixSolver(pattern, domain, settings)


def from_coo(
    rows: ArrayLike,
    columns: ArrayLike,
    domain: Space | int | tuple[int, ...] | None = None,
    **settings: Any,
) -> MatrixSolver:
    """Return the function solve(values, b) for x of A x = b, where values[i] is added to A at rows[i], columns[i].

    Places may be in any order and repeated, as assembly produces them; values at one place are summed.

    Parameters
    ----------
    rows, columns : int arrays, shape (entries,)
    domain : Space, int or tuple of int, optional
        The space of b and x. Default: flat arrays, whose size is the largest index + 1.
    **settings
        method, rtol and the others of `matrix_solver`.

    Returns
    -------
    MatrixSolver
        Differentiable in values, one for each given place, and in b. `solve.rows` and `solve.columns` are the places
        of A.

    Raises
    ------
    TypeError
        If rows or columns are not integers.
    ShapeError
        If rows and columns differ in shape, are not flat, or do not fit the domain.

    Examples
    --------
    >>> import sparsedp as dp
    >>> solve = dp.matrix_solver.from_coo([0, 1, 0], [0, 1, 0])  # two values on the first place
    >>> solve(np.array([1.5, 4.0, 0.5]), np.array([2.0, 8.0]))
    array([1., 2.])
    """
    row = np.asarray(rows)
    column = np.asarray(columns)
    if row.ndim != 1 or row.shape != column.shape:
        raise ShapeError(f"from_coo takes flat rows and columns, got shapes {row.shape} and {column.shape}")
    check_kind("rows and columns", row.dtype, "integers")
    check_kind("rows and columns", column.dtype, "integers")
    if domain is not None and not isinstance(domain, Space):
        domain = Space(domain)
    if domain is None:
        size = 1 + max(int(row.max(initial=-1)), int(column.max(initial=-1)))
    else:
        size = domain.size
    if row.size == 0 or min(row.min(), column.min()) < 0 or max(row.max(), column.max()) >= size:
        raise ShapeError(f"from_coo takes rows and columns from 0 to {size - 1}, one place at least; give others")
    keys, slot = np.unique(row.astype(np.int64) * size + column, return_inverse=True)
    pattern = sp.csr_array((np.ones(keys.size), np.divmod(keys, size)), shape=(size, size))
    solve = matrix_solver(pattern, domain=domain, **settings)
    summation = sp.csc_array((np.ones(slot.size), slot, np.arange(slot.size + 1)), shape=(keys.size, slot.size))
    solve.assembly = from_matrix(summation, name="sum of entries")
    return solve


matrix_solver.from_coo = from_coo  # type: ignore[attr-defined]


class MatrixSolver(ParametricSolver):
    """The differentiable function solve(data, b) that `matrix_solver` returns.

    Parameters
    ----------
    pattern : csr_array
    domain : Space
    settings : SolveSettings
    assembly : Operator, optional

    Attributes
    ----------
    rows, columns : int arrays, shape (entries,)
        Place of each entry, in the order of data: row by row, columns ascending.
    assembly : Operator or None
        From the values that are passed to the call to data; None if data are passed (`matrix_solver.from_coo` sums
        values at one place).
    domain : Space
    """

    name = "matrix_solver"

    def __init__(
        self,
        pattern: sp.csr_array,
        domain: Space,
        settings: SolveSettings,
        assembly: Operator | None = None,
    ) -> None:
        self.domain = domain
        self.assembly = assembly
        self._pattern = pattern
        self.rows: NDArray[Any] = rows_of(pattern)
        self.columns: NDArray[Any] = pattern.indices
        super().__init__(self._picking(self.rows, -1.0).T, self._picking(self.columns, 1.0), settings)

    def recipe(self) -> tuple[type[MatrixSolver], tuple[Any, ...]]:
        """Return the call that reconstructs this object, without its set-ups: see _utils/base_classes.py."""
        return MatrixSolver, (self._pattern, self.domain, self._settings, self.assembly)

    def _picking(self, place, factor):
        """Return the Operator from a field to its values at the given places, one for each entry, times a factor."""
        shape = (place.size, self.domain.size)
        matrix = sp.csr_array((np.full(place.size, factor), place, np.arange(place.size + 1)), shape=shape)
        return from_matrix(matrix, self.domain, name="entries")

    @public("dp.matrix_solver(pattern)")
    def __call__(self, data: Any, b: Any) -> Any:
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
        data = self._entries(data)
        if not isbox(b):
            b = np.asarray(b)
        return self._solution(data, b, 0.0)

    def solve_with_weights(self, data: Any, b: Any, weights: Any) -> Any:
        """Solve A x = b, where the null vectors of A and of its transpose are constant on each singular component.

        On each singular component, the sum of ``weights * x`` is 0, and a multiple of the weights is subtracted from b.
        The unweighted call has the null space of equal weights.

        Parameters
        ----------
        data, b
            As for the call.
        weights : array, a field on the domain, >= 0
            Positive on each singular component. Differentiable.

        Returns
        -------
        array of the shape of b
        """
        entries = self._entries(data)
        check_values(self._check_range, entries, b)
        total = self._component_sums(weights, entries)
        total = anp.where(total == 0, 1.0, total)
        x = self._solution(entries, b - weights * self._component_sums(b, entries) / total, 0.0)
        return x - self._component_sums(weights * x, entries) / total

    def _check_range(self, data, b):
        """Raise IncompatibleError if a right-hand side is not in the range; see `Solver.check_range`."""
        solver = self._inverse(data, 0.0).solver
        for field in np.reshape(b, (-1, self.domain.size)):
            for part in (field.real, field.imag) if np.iscomplexobj(field) else (field,):
                solver.check_range(part.astype(float))

    def _component_sums(self, x, data):
        """Return for each unknown the sum of x over its singular component; 0 for unknowns in no such component.

        A symmetric linear map of x: its VJP and JVP are the map itself. It does not depend on small changes of data.
        """

        def forward(x, data):
            null_space = self._inverse(data, 0.0).solver.system.null_space
            sums = np.zeros(np.shape(x), np.result_type(x, float))
            if not null_space.count:
                return sums
            is_singular = null_space.right != 0
            labels = 0 if null_space.labels is None else null_space.labels
            rows = sums.reshape(-1, self.domain.size)
            for row, field in zip(rows, np.reshape(x, rows.shape), strict=True):
                row[:] = np.where(is_singular, null_space._sums(is_singular * field)[labels], 0.0)
            return sums

        def vjp(nums, ans, x, data):
            def pull(g):
                of_x = of_argument(self._component_sums(g, data), x)
                return tuple(of_x if num == 0 else np.zeros(np.shape(sample(data))) for num in nums)

            return pull

        def jvp(nums, tangents, ans, x, data):
            if nums[0] != 0:
                return 0.0 * ans
            return self._component_sums(tangents[0], data)

        return Rule("sums over singular components", forward, vjp, jvp)(x, data)

    def of_coefficients(self, data: Any) -> tuple[ParametricSolver, tuple[Any, Any]]:
        """Return this solver, and (k, shift) of its operator for the argument `data` of a call."""
        check_plain(self.name, data)
        return self, (self._entries(data), 0.0)

    def _entries(self, data):
        """Return the entries of the matrix for the argument `data` of a call."""
        if self.assembly is not None:
            data = self.assembly(data)
        values = np.asarray(sample(data))
        check_shape("data", values, self.rows.shape, "; give one value for each entry")
        check_kind("data", values.dtype, "numbers")
        if not isbox(data):
            data = values
        check_values(partial(check_finite, "data", where=self._place_of), data)
        return data

    def _place_of(self, entry):
        return f"row {self.rows[entry]}, column {self.columns[entry]}"

    def _operator(self, data, shift):
        matrix = sp.csr_array((data, self._pattern.indices, self._pattern.indptr), shape=self._pattern.shape)
        return from_matrix(matrix, self.domain, self.domain, name=f"matrix of {self.rows.size} entries")

    def __repr__(self) -> str:
        return f"<{self.name}: {self.rows.size} entries on {self.domain}>"
