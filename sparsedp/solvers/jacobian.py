"""The Jacobian J = dF/dx of a residual at a point, set up for solves: given, assembled by colours, or as products.

Set-ups are cached by content, the last two: of the point (x and the parameters, for the derivative rules),
and of the entries (a residual that is linear in x is set up once). Forward solves never look a point up.
"""

from threading import RLock
from typing import Any

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

__all__ = ["Jacobians", "Linearisation"]

FULL_UP_TO = 16  # unknowns: a full Jacobian takes fewer products than the search for its pattern
FULL_AT_MOST = 2000  # unknowns: a larger Jacobian that is not sparse is left as products
SYMMETRIC = 1e-12  # of the largest entry: by how much a symmetric Jacobian may differ from its transpose
AGREES = 1e-8  # relative difference up to which two forms of one Jacobian are taken for equal


class Linearisation:
    """J at one point, as Newton's method and the derivative rules use it.

    Parameters
    ----------
    solver : Solver
        Of J.
    point : (equation, x, leaves)
        Plain copies.
    checked : bool
        Whether J is known to be the derivative of the residual.
    """

    def __init__(self, solver, point, checked):
        self.solver, self.point, self.checked = solver, point, checked

    def __str__(self):
        return str(Inverse(Solution(self.solver)))

    def _of(self, act, x, *given):
        """What a method of the solver or its system, which know flat numbers, gives for a field."""
        system = self.solver.system
        return system.shaped(act(system.flat(x), *given), self.point[0].layout.space)

    def product(self, x):
        """J x."""
        return self._of(self.solver.system.applied, x)

    def magnitude(self, x):
        """|J| x, row by row, for x >= 0."""
        system = self.solver.system
        return self._of(lambda x: np.ldexp(system.magnitude(x), system.exponent), x)

    @property
    def singular(self):
        """Whether a null space of J, or an unknown that no equation uses, is known."""
        system = self.solver.system
        return system.active is not None or system.null_space.count > 0

    def step(self, F, forcing):
        """The Newton step -J^-1 F, up to the relative residual `forcing`. Never refused: the next residual judges."""
        return self._of(self.solver.approximate, -F, max(forcing, self.solver.system.rtol))

    def solve(self, b, transposed):
        """(J^-1 b or J^-T b to the full tolerance, its record). Refused when the root is not isolated."""
        solver = self.solver
        if self.singular and solver.nullspace == "raise":
            raise ConvergenceError(
                f"the Jacobian {solver.system.unscaled} is singular at the solution: the root is not isolated and has "
                "no derivative; add an equation that fixes it or write nullspace='project'",
                info=failure("setup_failed"),
            )
        x = self._of(solver.solve, b, transposed, False)
        return x, solver.log.adjoint if transposed else solver.log.forward

    def defect(self):
        """How far J is from the derivative of the residual along a random direction: (largest, its row)."""
        equation, x, leaves = self.point
        rng = np.random.default_rng(0)
        v = equation.layout.laid(rng.uniform(0.5, 1.5, x.size) * rng.choice([-1.0, 1.0], x.size))
        with np.errstate(all="ignore"):
            wanted = equation.tangent(x, leaves)(v)
        size = np.maximum(self.magnitude(np.abs(v)), np.abs(wanted))
        size = size + 1e-8 * np.max(size, initial=0.0)  # rounding of large rows is no difference in small ones
        share = np.abs(self.product(v) - wanted) / np.where(size > 0, size, 1.0)
        return float(np.max(share, initial=0.0)), int(np.argmax(share)) if share.size else 0


class Jacobians:
    """Where the Jacobians of one residual come from.

    Parameters
    ----------
    name : str
    jacobian : callable or None
    sparsity : sparse matrix or None
    settings : dict
        Keywords of `build`.
    """

    def __init__(self, name, jacobian, sparsity, settings):
        self.name, self.given, self.settings = name, jacobian, dict(settings, name=f"{name}.jacobian")
        self.sparsity: Any = None if sparsity is None else pattern_like(sparsity)
        self.ways: list = []  # whether rows are coloured, for VJPs, or columns, for JVPs: what the residual has
        self.way = ""
        # space -> (Coloured, or None when only products will do; the cells that the unknowns were found to lie on)
        self._patterns: dict = {}
        self._points, self._operators, self._matrices = Cache(), Cache(), Cache()
        self._alone = RLock()  # held by the thread that looks for a pattern

    def __str__(self):
        lines = [
            f"  {space.size} unknowns" + ("" if coloured is None else f", {coloured.count} products")
            for space, (coloured, _) in self._patterns.items()
        ]
        return "\n".join([*lines, str(self._points.last) if len(self._points) else "  not set up yet"])

    # ------------------------------------------------------------ set-ups

    def fresh(self, equation, x, leaves, near=None):
        """The Jacobian at this point, made now. One that leans on the engine of another, `near`, is not kept."""
        op, exact = self._operator(equation, x, leaves)
        known = Linearisation(self._solver(op, near), (equation, *copied((x, leaves))), exact)
        return known if near else self._points.put(_key(equation, x, leaves), known)

    def cached(self, equation, x, leaves):
        """The Jacobian at this point for a derivative: found again or made, and checked against the residual."""
        known = self._points.find(_key(equation, x, leaves)) or self.fresh(equation, x, leaves)
        return self.fresh(equation, x, leaves) if self.enlarged(known) else known

    def relaxed(self, equation, x, leaves, pace, near):
        """The Solver of J + D / pace, D the rates of its rows; None where its entries are not known."""
        op, _ = self._operator(equation, x, leaves)
        if op.form != "explicit" or not op.backend.whole_fields:
            return None
        matrix = op.matrix + sp.diags_array(_rates(op.matrix, equation.layout) / pace)
        return self._solver(from_matrix(matrix, op.domain, op.domain, op.name), near)

    def _solver(self, op, near):
        """The Solver of a Jacobian: found again by its entries, or set up."""
        settings, solver = self.settings, None
        key: Any = None
        if op.form == "explicit" and op.backend.whole_fields and not near:
            entries = op.matrix.indptr, op.matrix.indices, op.matrix.data
            key = (op,) if op is self._operators.last else entries
            solver = self._matrices.find(key)
            if not solver and op.shape[0] <= DENSE_UP_TO and settings["method"] in ("auto", "direct"):
                solver = build_dense(op, settings["rtol"], settings["nullspace"], settings["name"])
        solver = solver or build(op, **settings, solves="few", near=near, all_rows=False).solver
        return self._matrices.put(key, solver) if key else solver

    def suspected(self, known):
        """As `enlarged`, for a Newton step that did not do well. A Jacobian that was given may be a simpler one."""
        return self.given is None and self.enlarged(known)

    def hint(self, known):
        """What a failed solve should say about a Jacobian that was given."""
        if self.given is None:
            return ""
        defect = known.defect()[0]
        return f"; the jacobian given differs from the derivative of the residual by {defect:.1e}" * (defect > AGREES)

    def enlarged(self, known):
        """Check a Jacobian, once. Returns True when entries were missing and its pattern has been enlarged.

        Raises
        ------
        DerivativeError
            When it was given, as a whole or as its sparsity, and does not fit the residual.
        """
        if known.checked:
            return False
        defect, row = known.defect()
        known.checked = defect <= AGREES
        if known.checked:
            return False
        if self.given is not None:
            raise DerivativeError(
                f"the jacobian given for {self.name} differs from the derivative of the residual "
                f"by {defect:.1e} (relative) in row {row}; correct it or leave it out"
            )
        if self.sparsity is not None:
            raise DerivativeError(
                f"the sparsity given for {self.name} lacks entries in row {row}; add them or leave it out"
            )
        equation, x, leaves = known.point
        with self._alone:
            if not equation.layout.backend.whole_fields:
                self._stencil(equation, [x], leaves, known.solver.system.unscaled.structure.stencil)
            else:
                self._enlarge(equation, x, leaves, row)
        return True

    # ------------------------------------------------------------ three ways to a Jacobian

    def _operator(self, equation, x, leaves):
        """(J as an Operator, explicit where its entries are known; whether it is exact for certain)."""
        size, name = equation.size, self.settings["name"]
        if self.given is not None:
            self.way = "given"
            given = self.given(equation.layout.split(x), *equation.params(leaves))
            return self._as_operator(given, equation.layout, name), False
        with self._alone:
            coloured, space = self._patterns.get(equation.layout.space) or self._coloured(equation, x, leaves)
        if coloured is None:
            forward, backward = (self._product(equation, x, leaves, turned) for turned in (False, True))
            return from_functions(forward, backward, size, size, name), True
        product = self._product(equation, x, leaves, coloured.by_rows)
        if not equation.layout.backend.whole_fields:
            return coloured.operator(product, name), False
        matrix = coloured.matrix(product)
        if space is not None and equation.layout.shapes[0] != space.shape:
            space = None  # a field of another shape that has as many unknowns
        key = space, matrix.indptr, matrix.indices, matrix.data
        op = self._operators.find(key)  # that of the step before, where the residual is linear
        if op is None:
            cells = space if space is not None and _is_symmetric(matrix, space) else Space(size)
            op = self._operators.put(key, from_matrix(matrix, cells, cells, name))
        return op, coloured.by_rows and coloured.pattern.nnz == size**2

    def _as_operator(self, given, layout, name):
        if isbox(given):
            raise DerivativeError(f"the jacobian of {self.name} uses a traced value that is not an argument")
        if not isinstance(given, Operator):
            given = from_matrix(given if sp.issparse(given) or np.ndim(given) else [[given]], name=name)
        check_shape(f"the jacobian of {self.name}", given, (layout.size,) * 2)
        given = layout.backend.implementation(jacobian_on_unknowns)(given, layout.space)
        check_kind(f"the jacobian of {self.name}", given.dtype, "real numbers")
        return given

    def _product(self, equation, x, leaves, transposed, purpose="jacobian"):
        """v -> J v or J^T v, counted."""
        key = f"{self.name}.{purpose}", "vjp" if transposed else "jvp"
        act = (equation.transposed if transposed else equation.tangent)(x, leaves)

        def product(v):
            count(*key)
            with np.errstate(all="ignore"):
                return act(v)

        return product

    # ------------------------------------------------------------ the pattern

    def _coloured(self, equation, x, leaves):
        """The coloured pattern for this many unknowns (None: only products will do), and the cells that they lie on."""
        size, pattern = equation.size, self.sparsity
        if not equation.layout.backend.whole_fields:
            return self._stencil(equation, _points(equation, x, leaves), leaves)
        if not self.ways:
            has_jvp = _can(pushforward, lambda y: equation(y, *leaves), x, np.ones_like(x))
            has_vjp = _can(lambda: equation.transposed(x, leaves)(np.ones_like(x)))
            self.ways = [False] * has_jvp + [True] * (has_vjp or not has_jvp)
        if pattern is not None:
            self.way = "assembled on the pattern given"
            check_shape(f"the sparsity of {self.name}", pattern, (size, size))
        elif self.settings["method"] == "krylov":
            self.way = "products only, as asked"
        elif size <= FULL_UP_TO:
            pattern, self.way = dense_pattern(size, size), "assembled, all entries"
        else:
            points, self.way = _points(equation, x, leaves), "assembled on a pattern found by probing"
            if self._guessed(equation, points, leaves):
                return self._patterns[equation.layout.space]
            pattern = self._probed(equation, points, leaves)
            if pattern is None and self.settings["method"] == "auto" and size > FULL_AT_MOST:
                self.way = f"products only: {size} unknowns and a Jacobian that is not sparse"
            elif pattern is None:
                pattern, self.way = dense_pattern(size, size), "assembled, all entries: it is not sparse"
        if pattern is not None:
            return self._colour(pattern, equation, x, leaves)
        return self._patterns.setdefault(equation.layout.space, (None, None))

    def _colour(self, pattern, equation, x, leaves):
        cells, shapes = fields_met(equation, x, leaves)
        coloured = ColouredPattern(pattern, shapes, None if len(self.ways) > 1 else self.ways[0])
        known = self._patterns[equation.layout.space] = coloured, cells
        return known

    def _stencil(self, equation, points, leaves, lacking=None):
        """What the ranks know of the pattern, from some points; of one that is `lacking` entries, with those."""
        space, backend = equation.layout.space, equation.layout.backend
        self.way = f"the rows of each rank, {backend}"
        if self.sparsity is not None:
            raise TypeError(f"{self.name} takes no sparsity for fields on ranks; leave it out")
        products = self._products(equation, points, leaves, False)
        known = self._patterns[space] = backend.stencil(self.name, space, products, lacking), None
        return known

    def _guessed(self, equation, points, leaves):
        """Whether J has entries on a stencil only: what its products with colours give acts as it does. It is kept."""
        by_rows, shapes = self.ways[0], fields_met(equation, points[0], leaves)[1]
        guess = stencil_pattern(self._products(equation, points, leaves, by_rows), shapes)
        if guess is None:
            return False
        coloured = self._colour(guess.T.tocsr() if by_rows else guess, equation, points[0], leaves)[0]
        (product,) = self._products(equation, points[-1:], leaves, coloured.by_rows)
        return coloured.acts_as(product, AGREES)

    def _probed(self, equation, points, leaves):
        """The union of the patterns of J at the points, by columns or by rows; None where it is not sparse."""
        for by_rows in self.ways:
            found = find_pattern(self._products(equation, points, leaves, by_rows), *(equation.size,) * 2)
            if found is not None:
                return found.T.tocsr() if by_rows else found
        return None

    def _products(self, equation, points, leaves, by_rows):
        return [self._product(equation, point, leaves, by_rows, "pattern") for point in points]

    def _enlarge(self, equation, x, leaves, row):
        """Add the entries that J has at x. When there are none, its products are not linear."""
        coloured, found = self._patterns[equation.layout.space][0], self._probed(equation, [x], leaves)
        total = pattern_like(coloured.pattern + (dense_pattern(x.size, x.size) if found is None else found))
        if total.nnz == coloured.pattern.nnz:
            raise DerivativeError(f"the derivative of {self.name} is not linear in its direction in row {row}")
        self._colour(total, equation, x, leaves)


def _key(equation, x, leaves):
    """Of one call alone: what a residual uses beside its arguments may have changed at the next."""
    return (equation, x, *leaves)


def _points(equation, x, leaves):
    """Points to probe at: near x and at two opposite random ones."""
    rng = np.random.default_rng(0)
    scale = norm(x) / np.sqrt(max(x.size, 1)) or 1.0
    far = equation.layout.laid(scale * rng.standard_normal(x.size))
    near = x * (1 + 0.1 * equation.layout.laid(rng.uniform(-1, 1, x.size)))
    points = near, far, -far  # opposite: each side of a switch is met
    return [point for point in points if _is_valid(equation, point, leaves)] or [x]


def _is_valid(equation, x, leaves):
    """A probed point is ours, not the user's: where the residual refuses it, it is left out."""
    try:
        with np.errstate(all="ignore"):
            return bool(np.all(np.isfinite(equation.layout.tried(equation, x, *leaves))))
    except (ValueError, ArithmeticError, ConvergenceError):
        return False


def _can(derive, *args):
    """Whether a derivative can be taken: foreign rules may lack one."""
    try:
        derive(*args)
    except NO_JVP:
        return False
    return True


def jacobian_on_unknowns(op, space):
    """Return a Jacobian that was given as an Operator, between flat unknowns."""
    if op.backend.whole_fields:
        return op
    return from_matrix(op.matrix, name=op.name)


def _rates(matrix, layout):
    """The rate at which each unknown relaxes, with the sign of its equation; 0 where it is no equation of rates.

    Half the sum of a row over its own field: 4 nu / h^2 of a Laplacian in 2-D, |v| / h of convection. The sign is that
    of the diagonal where it leads the row, else that of the diagonal of the whole field. 0 for a pressure in div v = 0.
    """
    field = np.repeat(np.arange(len(layout.shapes)), np.diff(layout.space.offsets))
    row, diagonal = rows_of(matrix), matrix.diagonal()
    inside = field[row] == field[matrix.indices]
    sums = np.bincount(row[inside], np.abs(matrix.data[inside]), diagonal.size)
    signs = np.sign(np.bincount(field, diagonal))[field] if field.size else diagonal
    return 0.5 * sums * np.where(2.1 * np.abs(diagonal) >= sums, np.sign(diagonal), signs)


# ---------------------------------------------------------------- the grid of the Jacobian


def _is_symmetric(matrix, space):
    """Whether the matrix, its rows times the volumes of their cells, is symmetric: multigrid needs that."""
    weighed = sp.csr_array(matrix * space.grid.volumes.reshape(-1, 1))
    gap = np.max(np.abs((weighed - weighed.T).data), initial=0.0)  # SciPy's own refuses a matrix without rows
    return bool(gap <= SYMMETRIC * np.max(np.abs(weighed.data), initial=0.0))


def fields_met(equation, x, leaves):
    """Where the unknowns lie: told from the Operators in the residual.

    Parameters
    ----------
    equation : Equation
    x : flat array
    leaves : tuple of arrays

    Returns
    -------
    cells : Space or None
        The cells of a grid, if x is one field on them. On one axis LU needs no geometry.
    shapes : list of tuples of int
        Of the fields, one after the other, a velocity by its components where all are on one grid; of one dimension.
    """
    with recording() as calls, np.errstate(all="ignore"):
        equation(x, *leaves)
    actors = [op.domain for actors in calls.actors.values() for op in actors.values() if isinstance(op, Operator)]
    met, shapes = {space.shape: space for space in actors[::-1] if space.grid is not None}, equation.layout.shapes
    spaces = [met[shape] for shape in shapes if shape in met]
    if len(spaces) == len(shapes) and len({space.grid for space in spaces}) == 1:
        one = len(spaces) == 1 and spaces[0].kind == "cells" and len(shapes[0]) > 1
        return spaces[0] if one and spaces[0].backend.whole_fields else None, [
            part for space in spaces for part in space.parts
        ]
    return None, shapes if len(set(map(len, shapes))) == 1 else [(equation.size,)]
