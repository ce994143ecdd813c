"""The Jacobian J = dF/dx of a residual at a point, set up for solves: supplied, assembled by colours, or as products.

The last two set-ups are cached by content: of the point (x and the parameters, for the derivative rules), and of the
entries (a residual that is linear in x is set up once). Forward solves never look up a point.
"""

from __future__ import annotations

from threading import RLock
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.counters import count, recording
from sparsedp._utils.pytree import copied, norm
from sparsedp._utils.validation import check_kind, check_shape
from sparsedp.autodiff.derivative import NO_JVP, pushforward
from sparsedp.autodiff.tape import isbox
from sparsedp.errors import ConvergenceError, DerivativeError
from sparsedp.grid.space import Space
from sparsedp.operators.given import from_functions, from_matrix
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import rows_of
from sparsedp.solvers.cache import Cache
from sparsedp.solvers.direct import DENSE_UP_TO
from sparsedp.solvers.inverse import Inverse, Solution, build, build_dense
from sparsedp.solvers.records import failure
from sparsedp.solvers.sparsity import ColouredPattern, dense_pattern, find_pattern, pattern_like, stencil_pattern
from sparsedp.solvers.system import System

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from sparsedp.solvers.choose_method import SolveSettings
    from sparsedp.solvers.engine import Engine
    from sparsedp.solvers.records import SolveInfo
    from sparsedp.solvers.solve import Solver

__all__ = ["Jacobians", "KnownPattern", "Linearisation", "Point", "find_fields", "probing_points"]

FULL_UP_TO = 16  # unknowns: a full Jacobian takes fewer products than the search for its pattern
FULL_AT_MOST = 2000  # unknowns: a larger Jacobian that is not sparse is applied by products
SYMMETRY_TOLERANCE = 1e-12  # of the largest entry: by how much a symmetric Jacobian may differ from its transpose
AGREEMENT = 1e-8  # largest relative difference of two forms of one Jacobian that counts as rounding


class Point(NamedTuple):
    """Where a Jacobian is taken: plain copies of the unknowns and of the floating leaves of the parameters."""

    equation: Any
    x: Any
    leaves: Sequence[Any]


class Linearisation:
    """J at one point, as Newton's method and the derivative rules use it.

    Parameters
    ----------
    solver : Solver, or Unfactored for products only
        Of J.
    point : Point
    checked : bool
        Whether J is known to be the derivative of the residual.
    """

    def __init__(self, solver: Any, point: Point, checked: bool) -> None:
        self.solver = solver
        self.point = point
        self.checked = checked

    def __str__(self) -> str:
        return str(Inverse(Solution(self.solver)))

    def _on_field(self, function, x, *args):
        """Apply a function of flat arrays, such as a method of the solver, to a field, distributed or not."""
        system = self.solver.system
        return system.shaped(function(system.flat(x), *args), self.point.equation.unknowns.space)

    def product(self, x: Any) -> Any:
        """Return J x."""
        return self._on_field(self.solver.system.applied, x)

    def magnitude(self, x: Any) -> Any:
        """Return |J| x, with the magnitudes of the entries of J, for x >= 0."""
        system = self.solver.system

        def unscaled_magnitude(x):
            return np.ldexp(system.magnitude(x), system.exponent)

        return self._on_field(unscaled_magnitude, x)

    @property
    def singular(self) -> bool:
        """Whether J is known to have a null space, or an unknown that no equation uses."""
        system = self.solver.system
        return system.active is not None or system.null_space.count > 0

    def step(self, F: Any, forcing: float) -> Any:
        """Return the Newton step -J^-1 F, to the relative residual `forcing` where that can be reached."""
        return self._on_field(self.solver.approximate, -F, max(forcing, self.solver.system.rtol))

    def approximate(self, b: Any, transposed: bool = False) -> Any:
        """Return J^-1 b or J^-T b to the tolerance where that can be reached, else the best iterate."""
        return self._on_field(self.solver.approximate, b, self.solver.system.rtol, transposed)

    def solve(self, b: Any, transposed: bool) -> tuple[Any, SolveInfo | None]:
        """Solve J x = b or J^T x = b to the full tolerance.

        Returns
        -------
        x : flat unknowns
        info : SolveInfo or None
            Its record; None where a certificate repeats an earlier solve.

        Raises
        ------
        ConvergenceError
            If J is singular, that is, if the root is not isolated.
        """
        solver = self.solver
        if self.singular and solver.nullspace == "raise":
            raise ConvergenceError(
                f"the Jacobian {solver.system.unscaled} is singular at the solution: the root is not isolated and has "
                "no derivative; add an equation that fixes it or write nullspace='project'",
                info=failure("setup_failed"),
            )
        x = self._on_field(solver.solve, b, transposed, False)
        return x, solver.log.last(transposed)

    def defect(self) -> tuple[float, int]:
        """Compare J with the derivative of the residual along a random direction.

        Returns
        -------
        largest : float
            The largest relative difference of a row.
        row : int
        """
        equation, x, leaves = self.point
        rng = np.random.default_rng(0)
        v = equation.unknowns.distribute(rng.uniform(0.5, 1.5, x.size) * rng.choice([-1.0, 1.0], x.size))
        with np.errstate(all="ignore"):
            expected = equation.tangent(x, leaves)(v)
        size = np.maximum(self.magnitude(np.abs(v)), np.abs(expected))
        size = size + 1e-8 * np.max(size, initial=0.0)  # rounding of large rows is no difference in small ones
        differences = np.abs(self.product(v) - expected) / np.where(size > 0, size, 1.0)
        row = int(np.argmax(differences)) if differences.size else 0
        return float(np.max(differences, initial=0.0)), row


class Unfactored(NamedTuple):
    """An Operator in the place of its Solver, for products."""

    op: Operator

    @property
    def system(self) -> System:
        """The system of the Operator."""
        return System(self.op)


class KnownPattern(NamedTuple):
    """What is known of the Jacobian on one space of unknowns.

    Attributes
    ----------
    coloured : ColouredPattern or None
        None if J is only applied by products.
    cells : Space or None
        The cells of a grid on which the unknowns were found to lie.
    """

    coloured: Any
    cells: Space | None


class Jacobians:
    """The source of the Jacobians of one residual.

    Parameters
    ----------
    name : str
    jacobian : callable or None
        ``jacobian(x, *params)``, supplied by the user.
    sparsity : sparse matrix or None
        Supplied by the user.
    settings : SolveSettings
        Of the linear solves.

    Attributes
    ----------
    description : str
        How the Jacobians are obtained; empty before the first one.
    can_relax : bool
        Whether `relaxed_solver` is implemented.
    """

    can_relax = True

    def __init__(self, name: str, jacobian: Callable[..., Any] | None, sparsity: Any, settings: SolveSettings) -> None:
        self.name = name
        self.user_jacobian = jacobian
        self.settings = settings
        self.solver_name = f"{name}.jacobian"
        self.sparsity: Any = None if sparsity is None else pattern_like(sparsity)
        self.description = ""
        # The values of `by_rows` of ColouredPattern that the residual allows: True by VJPs, False by JVPs.
        self._orientations: list[bool] = []
        self._patterns: dict[Space, KnownPattern] = {}
        self._points = Cache()
        self._operators = Cache()
        self._matrices = Cache()
        self._last_method = self.settings.method
        self._lock = RLock()  # held by the thread that searches a pattern

    def __str__(self) -> str:
        lines = []
        for space, pattern in self._patterns.items():
            line = f"  {space.size} unknowns"
            if pattern.coloured is not None:
                line += f", {pattern.coloured.count} products"
            lines.append(line)
        if len(self._points):
            lines.append(str(self._points.last))
        else:
            lines.append("  not set up yet")
        return "\n".join(lines)

    # ------------------------------------------------------------ set-ups

    def evaluate(self, equation: Any, x: Any, leaves: Sequence[Any], near: Engine | None = None) -> Linearisation:
        """Return the Jacobian at a point.

        Parameters
        ----------
        equation : Equation
        x : flat unknowns
        leaves : sequence of arrays
        near : Engine, optional
            Of another Jacobian, to precondition the solves with this one, which is then not cached.
        """
        if self._is_large_flow:
            self._release()
        op, is_exact = self._operator(equation, x, leaves)
        point = Point(equation, *copied((x, leaves)))
        linearisation = Linearisation(self._solver(op, near), point, is_exact)
        if near:
            return linearisation
        return self._points.put(_key(equation, x, leaves), linearisation)

    def _release(self):
        """Drop all set-ups, because two of them do not fit into memory."""
        self._points = Cache()
        self._operators = Cache()
        self._matrices = Cache()

    @property
    def _is_large_flow(self):
        """Whether the last set-up was by method "schur", which is for flows in 3-D; equal entries are not looked up."""
        return self._last_method == "schur"

    def cached(self, equation: Any, x: Any, leaves: Sequence[Any]) -> Linearisation:
        """Return the Jacobian at a point for a derivative, from the cache or new, compared with the residual."""
        linearisation = self._points.find(_key(equation, x, leaves)) or self.evaluate(equation, x, leaves)
        if self.complete_pattern(linearisation):
            return self.evaluate(equation, x, leaves)
        return linearisation

    def operator(self, equation: Any, x: Any, leaves: Sequence[Any]) -> Operator:
        """Return the Jacobian at a point as an Operator, compared with the residual, without a set-up for solves."""
        op, is_exact = self._operator(equation, x, leaves)
        unfactored = Linearisation(Unfactored(op), Point(equation, *copied((x, leaves))), is_exact)
        if self.complete_pattern(unfactored):
            op, _ = self._operator(equation, x, leaves)
        return op

    def relaxed_solver(
        self, equation: Any, x: Any, leaves: Sequence[Any], time_step: float, near: Engine | None
    ) -> Solver | None:
        """Return the Solver of J + D / time_step, D the rates of its rows; None where its entries are not known."""
        op, _ = self._operator(equation, x, leaves)
        if op.form != "explicit":
            return None
        matrix = op.matrix + sp.diags_array(_rates(op.matrix, equation.unknowns) / time_step)
        return self._solver(from_matrix(matrix, op.domain, op.domain, op.name), near)

    def _solver(self, op, near):
        """Return the Solver of a Jacobian, from the cache of entries or new."""
        if op.form != "explicit" or near or self._is_large_flow:
            return self._build(op, near)
        key: tuple[Any, ...]
        if op is self._operators.last:
            key = (op,)
        else:
            key = (op.matrix.indptr, op.matrix.indices, op.matrix.data)
        solver = self._matrices.find(key)
        if solver is not None:
            return solver
        if op.shape[0] <= DENSE_UP_TO and self.settings.method in ("auto", "direct"):
            solver = build_dense(op, self.settings.rtol, self.settings.nullspace, self.solver_name)
        if solver is None:
            solver = self._build(op, near)
        return self._matrices.put(key, solver)

    def _build(self, op, near):
        solver = build(op, self.settings, self.solver_name, solves="few", near=near, all_rows=False).solver
        self._last_method = solver.engine.method
        return solver

    def check_after_slow_step(self, linearisation: Linearisation) -> bool:
        """Do the same as `complete_pattern`, unless the user supplied the Jacobian: it may be a simpler one."""
        return self.user_jacobian is None and self.complete_pattern(linearisation)

    def hint(self, linearisation: Linearisation) -> str:
        """Return what the message of a failed solve should say about a Jacobian that the user supplied."""
        if self.user_jacobian is None:
            return ""
        defect = linearisation.defect()[0]
        if defect <= AGREEMENT:
            return ""
        return f"; the jacobian given differs from the derivative of the residual by {defect:.1e}"

    def complete_pattern(self, linearisation: Linearisation) -> bool:
        """Compare a Jacobian with the derivative of the residual, once.

        Returns
        -------
        bool
            Whether entries were missing, and have been added to the pattern.

        Raises
        ------
        DerivativeError
            If the user supplied the Jacobian or its sparsity, and it does not fit the residual.
        """
        if linearisation.checked:
            return False
        defect, row = linearisation.defect()
        linearisation.checked = defect <= AGREEMENT
        if linearisation.checked:
            return False
        if self.user_jacobian is not None:
            raise DerivativeError(
                f"the jacobian given for {self.name} differs from the derivative of the residual "
                f"by {defect:.1e} (relative) in row {row}; correct it or leave it out"
            )
        if self.sparsity is not None:
            raise DerivativeError(
                f"the sparsity given for {self.name} lacks entries in row {row}; add them or leave it out"
            )
        with self._lock:
            self._enlarge_pattern(linearisation, row)
        return True

    # ------------------------------------------------------------ three ways to a Jacobian

    def _operator(self, equation, x, leaves):
        """Return J as an Operator, explicit where its entries are known, and whether it is certainly exact."""
        unknowns = equation.unknowns
        name = self.solver_name
        if self.user_jacobian is not None:
            self.description = "given"
            jacobian = self.user_jacobian(unknowns.split(x), *equation.params(leaves))
            return self._as_operator(jacobian, unknowns, name), False
        with self._lock:
            pattern = self._patterns.get(unknowns.space)
            if pattern is None:
                pattern = self._find_pattern(equation, x, leaves)
        coloured = pattern.coloured
        size = equation.size
        if coloured is None:
            forward = self._product(equation, x, leaves, transposed=False)
            backward = self._product(equation, x, leaves, transposed=True)
            return from_functions(forward, backward, size, size, name), True
        product = self._product(equation, x, leaves, coloured.by_rows)
        return self._assembled(pattern, product, unknowns)

    def _assembled(self, pattern, product, unknowns):
        """Return J as an Operator from its products, and whether it is certainly exact."""
        coloured = pattern.coloured
        op = self._explicit_operator(coloured.matrix(product), unknowns, pattern, self.solver_name)
        is_full = coloured.pattern.nnz == unknowns.size**2
        return op, coloured.by_rows and is_full

    def _explicit_operator(self, matrix, unknowns, pattern, name):
        """Return the matrix as an Operator, the last one if it is equal, on the cells of a grid if it is symmetric."""
        cells = pattern.cells
        if cells is not None and unknowns.shapes[0] != cells.shape:
            cells = None  # a field of another shape with as many unknowns
        if self._is_large_flow:  # so that the solver needs no second copy
            matrix = matrix.copy()
            matrix.eliminate_zeros()
        key = (cells, matrix.indptr, matrix.indices, matrix.data)
        op = None if self._is_large_flow else self._operators.find(key)
        if op is not None:
            return op
        space = Space(unknowns.size)
        shapes = pattern.coloured.shapes
        if shapes is not None and len(shapes) > 1:
            space = Space(None, "unknowns", None, shapes)
        if cells is not None and _is_symmetric(matrix, cells):
            space = cells
        op = from_matrix(matrix, space, space, name)
        if self._is_large_flow:
            return op
        return self._operators.put(key, op)

    def _as_operator(self, jacobian, unknowns, name):
        """Return a Jacobian that the user supplied as an Operator on the unknowns."""
        if isbox(jacobian):
            raise DerivativeError(f"the jacobian of {self.name} uses a traced value that is not an argument")
        if not isinstance(jacobian, Operator):
            is_number = not sp.issparse(jacobian) and not np.ndim(jacobian)
            if is_number:
                jacobian = [[jacobian]]
            jacobian = from_matrix(jacobian, name=name)
        check_shape(f"the jacobian of {self.name}", jacobian, (unknowns.size, unknowns.size))
        jacobian = self._on_unknowns(jacobian, unknowns.space)
        check_kind(f"the jacobian of {self.name}", jacobian.dtype, "real numbers")
        return jacobian

    def _on_unknowns(self, op, space):
        """Return a Jacobian that the user supplied as an Operator between the unknowns."""
        if op.backend is space.backend:
            return op
        return from_matrix(op.matrix, name=op.name)

    def _product(self, equation, x, leaves, transposed, purpose="jacobian"):
        """Return the function that maps v to J v or J^T v, and counts."""
        if transposed:
            counter = (f"{self.name}.{purpose}", "vjp")
            multiply = equation.transposed(x, leaves)
        else:
            counter = (f"{self.name}.{purpose}", "jvp")
            multiply = equation.tangent(x, leaves)

        def product(v):
            count(*counter)
            with np.errstate(all="ignore"):
                return multiply(v)

        return product

    # ------------------------------------------------------------ the pattern

    def _find_pattern(self, equation, x, leaves):
        """Find and store the pattern for the space of these unknowns."""
        unknowns = equation.unknowns
        size = equation.size
        if not self._orientations:
            self._orientations = _possible_orientations(equation, x, leaves)
        if self.sparsity is not None:
            self.description = "assembled on the pattern given"
            check_shape(f"the sparsity of {self.name}", self.sparsity, (size, size))
            return self._store_coloured(self.sparsity, equation, x, leaves)
        if self.settings.method == "krylov":
            self.description = "products only, as asked"
            return self._store(unknowns.space, KnownPattern(None, None))
        if size <= FULL_UP_TO:
            self.description = "assembled, all entries"
            return self._store_coloured(dense_pattern(size, size), equation, x, leaves)
        self.description = "assembled on a pattern found by probing"
        points = probing_points(equation, x, leaves)
        if self._is_stencil(equation, points, leaves):
            return self._patterns[unknowns.space]
        pattern = self._probed_pattern(equation, points, leaves)
        if pattern is None and self.settings.method == "auto" and size > FULL_AT_MOST:
            self.description = f"products only: {size} unknowns and a Jacobian that is not sparse"
            return self._store(unknowns.space, KnownPattern(None, None))
        if pattern is None:
            self.description = "assembled, all entries: it is not sparse"
            pattern = dense_pattern(size, size)
        return self._store_coloured(pattern, equation, x, leaves)

    def _store_coloured(self, pattern, equation, x, leaves):
        cells, shapes = find_fields(equation, x, leaves)
        by_rows = None
        if len(self._orientations) == 1:
            by_rows = self._orientations[0]
        coloured = ColouredPattern(pattern, shapes, by_rows)
        return self._store(equation.unknowns.space, KnownPattern(coloured, cells))

    def _store(self, space, pattern):
        self._patterns[space] = pattern
        return pattern

    def _is_stencil(self, equation, points, leaves):
        """Guess a stencil, store it, and return whether J has no entries elsewhere."""
        by_rows = self._orientations[0]
        shapes = find_fields(equation, points[0], leaves)[1]
        guess = stencil_pattern(self._pattern_products(equation, points, leaves, by_rows), shapes)
        if guess is None:
            return False
        if by_rows:
            guess = guess.T.tocsr()
        coloured = self._store_coloured(guess, equation, points[0], leaves).coloured
        (product,) = self._pattern_products(equation, points[-1:], leaves, coloured.by_rows)
        return coloured.acts_as(product, AGREEMENT)

    def _probed_pattern(self, equation, points, leaves):
        """Return the union of the patterns of J at the points, probed by columns or by rows; None if not sparse."""
        for by_rows in self._orientations:
            products = self._pattern_products(equation, points, leaves, by_rows)
            pattern = find_pattern(products, equation.size, equation.size)
            if pattern is not None:
                return pattern.T.tocsr() if by_rows else pattern
        return None

    def _pattern_products(self, equation, points, leaves, by_rows):
        return [self._product(equation, point, leaves, by_rows, "pattern") for point in points]

    def _enlarge_pattern(self, linearisation, row):
        """Add the entries that J has at its point; if there are none, its products are not linear."""
        equation, x, leaves = linearisation.point
        coloured = self._patterns[equation.unknowns.space].coloured
        pattern = self._probed_pattern(equation, [x], leaves)
        if pattern is None:
            pattern = dense_pattern(x.size, x.size)
        union = pattern_like(coloured.pattern + pattern)
        if union.nnz == coloured.pattern.nnz:
            raise DerivativeError(f"the derivative of {self.name} is not linear in its direction in row {row}")
        self._store_coloured(union, equation, x, leaves)


def _key(equation, x, leaves):
    """Return the key of a point for one call: what a residual uses beside its arguments may change until the next."""
    return (equation, x, *leaves)


def _possible_orientations(equation, x, leaves):
    """Return False if J can be assembled by JVPs, and True if by VJPs; VJPs if neither works."""
    ones = np.ones_like(x)

    def residual(y):
        return equation(y, *leaves)

    def vjp():
        return equation.transposed(x, leaves)(ones)

    has_jvp = _can_derive(pushforward, residual, x, ones)
    has_vjp = _can_derive(vjp)
    orientations = []
    if has_jvp:
        orientations.append(False)
    if has_vjp or not has_jvp:
        orientations.append(True)
    return orientations


def probing_points(equation: Any, x: Any, leaves: Sequence[Any]) -> list[Any]:
    """Return points to probe at: near x, and two opposite random ones, so that each side of a switch occurs."""
    rng = np.random.default_rng(0)
    distribute = equation.unknowns.distribute
    scale = norm(x) / np.sqrt(max(x.size, 1)) or 1.0
    far = distribute(scale * rng.standard_normal(x.size))
    near = x * (1 + 0.1 * distribute(rng.uniform(-1, 1, x.size)))
    points = [near, far, -far]
    return [point for point in points if _is_valid(equation, point, leaves)] or [x]


def _is_valid(equation, x, leaves):
    """Whether the residual accepts a point that was not chosen by the user."""
    try:
        with np.errstate(all="ignore"):
            return bool(np.all(np.isfinite(equation.unknowns.attempt(equation, x, *leaves))))
    except (ValueError, ArithmeticError, ConvergenceError):
        return False


def _can_derive(derive, *args):
    """Whether a derivative can be taken: rules of other packages may lack one."""
    try:
        derive(*args)
    except NO_JVP:
        return False
    return True


def _rates(matrix, unknowns):
    """Return the rate at which each unknown relaxes, with the sign of its equation; 0 if the equation is not a rate.

    It is half the sum of the magnitudes in a row over its own field: 4 nu / h^2 of a Laplacian in 2-D, |v| / h of
    convection. The sign is the one of the diagonal entry where it dominates the row, else the sign of the sum of the
    diagonal over the field; 0 for a pressure in div v = 0.
    """
    field = np.repeat(np.arange(len(unknowns.shapes)), np.diff(unknowns.space.offsets))
    row = rows_of(matrix)
    diagonal = matrix.diagonal()
    is_inside = field[row] == field[matrix.indices]
    sums = np.bincount(row[is_inside], np.abs(matrix.data[is_inside]), diagonal.size)
    field_signs = diagonal
    if field.size:
        field_signs = np.sign(np.bincount(field, diagonal))[field]
    signs = np.where(2.1 * np.abs(diagonal) >= sums, np.sign(diagonal), field_signs)
    return 0.5 * sums * signs


# ---------------------------------------------------------------- the grid of the Jacobian


def _is_symmetric(matrix, space):
    """Whether the matrix, its rows times the volumes of their cells, is symmetric: multigrid needs that."""
    weighted = sp.csr_array(matrix * space.grid.volumes.reshape(-1, 1))
    difference = np.max(np.abs((weighted - weighted.T).data), initial=0.0)  # SciPy's max refuses a matrix without rows
    return bool(difference <= SYMMETRY_TOLERANCE * np.max(np.abs(weighted.data), initial=0.0))


def find_fields(equation: Any, x: NDArray[Any], leaves: Sequence[Any]) -> tuple[Space | None, list[tuple[int, ...]]]:
    """Find out on which fields the unknowns lie, from the Operators that the residual calls.

    Parameters
    ----------
    equation : Equation
    x : flat array
    leaves : sequence of arrays

    Returns
    -------
    cells : Space or None
        The cells of a grid in 2-D or 3-D, if x is one field on them. On one axis LU needs no geometry.
    shapes : list of tuples of int
        Shapes of the fields, one after the other, all of one dimension. A velocity is given by its components if all
        fields are on one grid.
    """
    with recording() as calls, np.errstate(all="ignore"):
        equation(x, *leaves)
    operators = []
    for method_objects in calls.method_objects.values():
        operators += [op for op in method_objects.values() if isinstance(op, Operator)]
    space_of_shape = {}
    for op in reversed(operators):
        if op.domain.grid is not None:
            space_of_shape[op.domain.shape] = op.domain
    shapes = equation.unknowns.shapes
    spaces = [space_of_shape[shape] for shape in shapes if shape in space_of_shape]
    if len(spaces) == len(shapes) and len({space.grid for space in spaces}) == 1:
        parts = [part for space in spaces for part in space.parts]
        is_one_field_of_cells = len(spaces) == 1 and spaces[0].kind == "cells" and len(shapes[0]) > 1
        if is_one_field_of_cells and spaces[0].backend is equation.unknowns.backend:
            return spaces[0], parts
        return None, parts
    if len({len(shape) for shape in shapes}) == 1:
        return None, shapes
    return None, [(equation.size,)]
