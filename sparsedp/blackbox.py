"""A simulator without derivatives becomes differentiable: sparse Jacobians by coloured differences."""

import warnings
from threading import RLock
from typing import Any

import numpy as np

from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError
from sparsedp.fields import check_finite
from sparsedp.ledger import active, count
from sparsedp.solvers.colouring import Coloured
from sparsedp.solvers.kept import Kept
from sparsedp.solvers.probing import REFUSED, changes, points_near, typical
from sparsedp.solvers.sparsity import dense_pattern, find_pattern, pattern_of
from sparsedp.solvers.translates import translated_pattern
from sparsedp.tape import Rule, differentiable, plain
from sparsedp.tree import copied

__all__ = ["Adopted", "adopt"]

COMPLEX = 1e-30  # step of the complex step: no difference is taken, so nothing cancels
CENTRAL = np.finfo(float).eps ** (1 / 3)  # step of central differences, relative to x
AGREES = {"complex step": 1e-6, "central differences": 1e-4}
ROWS = {"complex step": (1e-9, 0.0), "central differences": (1e-5, 1e-9)}  # of a row, and of the largest: what may miss

TIMES = 2, 5, 11  # steps at which what a row lacks is looked at again


def adopt(f, sparsity=None, derivative="auto", name=None):
    """Any NumPy function of an array -> the same function, differentiable.

    Parameters
    ----------
    f : callable
        ``f(x) -> y``, real arrays of any shapes; it must give the same y for the same x.
    sparsity : sparse matrix or array, optional
        (y.size, x.size), not 0 where y_i may depend on x_j. Default: what three cells touch, moved over the grid, if at
        3 points each row of the Jacobian agrees with a derivative along a random direction; else found by changing
        random parts of x at 3 points. An entry that is not 0 on a share s of all points is missed with probability
        (1 - s)^3; from a stencil also one below 1e-9 (differences: 1e-5) of its row.
    derivative : "auto", "complex" or "difference"
        complex: f(x + i h v), to rounding, for code that is analytic and takes complex numbers. difference: central
        differences, about ten digits. auto: complex where it is found to agree with differences.
    name : str, optional
        Appears in errors and counts; default: that of f.

    Returns
    -------
    Adopted
        ``adopted(x)``; `.jacobian(x)` is the csr_array dy/dx, `.runs` the number of runs so far; str() tells how many
        runs one Jacobian takes.

    Raises
    ------
    TypeError
        If f is no function.
    ValueError
        If `derivative` is not known.
    ShapeError
        If the sparsity or a later x has another shape.
    DerivativeError
        At the first derivative: if f is not deterministic, or the Jacobian misses what a random probe sees; on
        derivatives of second order.
    NonFiniteError
        If f is NaN or infinite near x.

    Notes
    -----
    Source: A. R. Curtis, M. J. D. Powell, J. K. Reid, IMA J. Appl. Math. 13, 1974 (colouring); W. Squire, G. Trapp,
    SIAM Rev. 40, 1998 (complex step).

    Examples
    --------
    >>> shift = adopt(lambda x: np.roll(x, 1) ** 2)
    >>> from sparsedp.derivative import value_and_grad
    >>> import autograd.numpy as anp
    >>> value_and_grad(lambda x: anp.sum(shift(x)))(np.array([1.0, 2.0, 3.0]))
    (14.0, array([2., 4., 6.]))
    """
    if not callable(f):
        raise TypeError(f"adopt takes a function of one array, got {type(f).__name__}; write dp.adopt(lambda x: ...)")
    if derivative not in ("auto", "complex", "difference"):
        raise ValueError(f"derivative must be auto, complex or difference, got {derivative!r}")
    return Adopted(f, copied(sparsity), derivative, name or getattr(f, "__name__", "simulator"))


class Adopted:
    """A foreign function with a sparse Jacobian, kept for the last two points. Made by `adopt`.

    Attributes
    ----------
    runs : int
        Runs of the function so far.
    way : str
        "complex step" or "central differences"; empty before the first derivative.
    """

    def __init__(self, f, sparsity, derivative, name):
        self._f, self._sparsity, self._derivative, self.name = f, sparsity, derivative, name
        self.runs, self.way = 0, ""
        self._shapes: Any = None
        self._coloured: Any = None
        self._points, self._alone = Kept(), RLock()  # foreign code may work in arrays of its own: one thread at a time
        direct: Rule
        transposed = differentiable(f"{name}.T", self._back, self._only_in_g(lambda h, x: direct(h, x)))
        direct = differentiable(f"{name}.J", self._along, self._only_in_g(lambda h, x: transposed(h, x)))
        self._rule = differentiable(
            name,
            self._run,
            lambda nums, y, x: lambda g: (transposed(g, x),),
            lambda nums, tangents, y, x: direct(tangents[0], x),
        )

    def __call__(self, x):
        return self._rule(x)

    def __str__(self):
        if self._coloured is None:
            return f"{self.name}: no derivative asked for yet, {self.runs} runs"
        each = self._coloured.count * (1 if self.way == "complex step" else 2)
        rows, columns = self._coloured.pattern.shape
        return (
            f"{self.name}: Jacobian {rows} x {columns} with {self._coloured.pattern.nnz} entries from {each} runs "
            f"instead of {columns}, by {self.way}; {self.runs} runs so far"
        )

    __repr__ = __str__

    def _only_in_g(self, turn):
        """VJP of a map that is linear in its first argument; its second derivative is not known."""

        def vjp(nums, ans, g, x):
            if 1 in nums:
                raise DerivativeError(
                    f"{self.name} is adopted: its Jacobian is known, its second derivative is not; use a method with "
                    "first derivatives, or write the function with autograd.numpy"
                )
            return lambda h: (turn(h, x),)

        return vjp

    def _run(self, x):
        """One run on plain values."""
        if active:
            count(f"{self.name}.run", "forward")
        with self._alone:
            self.runs += 1
            y = np.array(self._f(np.array(x)))
        if y.dtype.kind not in "biuf" and np.asarray(x).dtype.kind != "c":
            raise TypeError(f"{self.name} must return real numbers, got dtype {y.dtype}; take the real part")
        return y.astype(float) if y.dtype.kind in "biu" else y

    def _along(self, v, x):
        return (self.jacobian(x) @ np.ravel(v)).reshape(self._shapes[1])

    def _back(self, g, x):
        return (self.jacobian(x).T @ np.ravel(g)).reshape(np.shape(x))

    def jacobian(self, x):
        """dy/dx at a point, csr_array; kept for the last two points.

        Parameters
        ----------
        x : array

        Returns
        -------
        csr_array, (y.size, x.size)
        """
        x = np.asarray(plain(x), dtype=float)
        with self._alone:
            known = self._points.find((x,))
            return self._points.put((x,), self._made(x)) if known is None else known

    def _made(self, x):
        check_finite(f"the argument of {self.name}", x)
        y = self._run(x)
        check_finite(f"{self.name} near x", y, "must be finite to be differentiated")
        if self._shapes is not None and self._shapes != (x.shape, y.shape):
            raise ShapeError(
                f"{self.name} was adopted from {self._shapes[0]} to {self._shapes[1]}, got {x.shape} to {y.shape}; "
                "adopt it again"
            )
        first = self._coloured is None
        if first:
            self._shapes = x.shape, y.shape
            self._coloured = self._pattern(x, y)
            self.way = self._choose(x)
        matrix = self._by_colours(x, self.way)
        if first:
            self._check(matrix, x, y)
        return matrix

    def _pattern(self, x, y):
        rows, columns = y.size, x.size
        if self._sparsity is not None:
            given = self._sparsity.tocsr() if hasattr(self._sparsity, "tocsr") else np.asarray(self._sparsity)
            row, column = np.nonzero(given)
            pattern = pattern_of(row, column, given.shape)
            if pattern.shape != (rows, columns):
                raise ShapeError(f"the sparsity of {self.name} must have shape {(rows, columns)}, got {pattern.shape}")
            return Coloured(pattern, self._grid(x, y), by_rows=False)
        if not np.array_equal(self._run(x), y, equal_nan=True):
            raise DerivativeError(f"{self.name} gives two results for one argument; fix its random state first")
        near, grid = points_near(self._run, x), self._grid(x, y)
        products = [changes(self._run, point) for point in near]
        guess = None if grid is None else translated_pattern(products, grid)
        if guess is not None and self._holds(Coloured(guess, grid, by_rows=False), x, near):
            return self._coloured
        found = find_pattern(products, rows, columns)
        return Coloured(dense_pattern(rows, columns) if found is None else found, self._grid(x, y), by_rows=False)

    @staticmethod
    def _grid(x, y):
        return x.shape if x.shape == y.shape else None

    def _holds(self, coloured, x, near):
        """Whether Jacobians on a guessed pattern give every row of a derivative along a random direction."""
        self._coloured, rng = coloured, np.random.default_rng(4)
        way = self._choose(x)
        share, floor = ROWS[way]
        for point in near:
            v, product = self._steps(point) * rng.standard_normal(point.shape), self._product(point, way)
            try:
                matrix = self._by_colours(point, way)
                lacks = product(v) - matrix @ v.reshape(-1)
                size = share * (abs(matrix) @ np.abs(v).reshape(-1))
                small = ~(np.abs(lacks) <= size)
                if not np.all(np.abs(lacks) <= size + floor / share * np.max(size)):
                    return False
                if np.any(small) and np.any(small & _grows(lacks, v, product, matrix)):
                    return False
            except REFUSED:  # not finite so close to an allowed point
                return False
        return True

    def _steps(self, x):
        return CENTRAL * np.maximum(np.abs(x), typical(x))

    def _product(self, x, way):
        if way == "complex step":
            return lambda v: np.ravel(self._run(x + 1j * COMPLEX * v).imag) / COMPLEX
        return lambda v: np.ravel(self._run(x + v) - self._run(x - v)) / 2

    def _by_colours(self, x, way):
        steps = np.ones_like(x) if way == "complex step" else self._steps(x)
        product = self._product(x, way)
        matrix = self._coloured.matrix(lambda v: product(steps * v.reshape(x.shape)))
        matrix.data /= steps.reshape(-1)[matrix.indices]
        if not np.all(np.isfinite(matrix.data)):
            raise NonFiniteError(f"{self.name} is not finite close to x; its Jacobian cannot be taken there")
        return matrix

    def _choose(self, x):
        if self._derivative == "difference":
            return "central differences"
        if self._derivative == "complex" or self._is_analytic(x):
            return "complex step"
        return "central differences"

    def _is_analytic(self, x):
        """Whether a complex step along one direction agrees with a difference; code that drops it gives 0."""
        v = self._steps(x) * np.random.default_rng(1).uniform(0.5, 1.5, x.shape)
        difference = self._product(x, "central differences")(v)
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                # What is cast to real has lost the derivative.
                warnings.simplefilter("error", np.exceptions.ComplexWarning)
                step = self._product(x, "complex step")(v)
        except Exception:
            return False
        return _gap(step, difference) <= 1e-5

    def _check(self, matrix, x, y):
        """The Jacobian against a difference along a direction of its own."""
        v = np.random.default_rng(2).standard_normal(x.shape)
        known = self._product(x, "central differences")(self._steps(x) * v)
        gap = _gap(matrix @ (self._steps(x) * v).reshape(-1), known)
        if not gap <= AGREES[self.way]:
            self._coloured = None
            raise DerivativeError(
                f"the Jacobian of {self.name} by {self.way} differs by {gap:.1e} from a difference along a random "
                "direction; its sparsity lacks entries, or it has a kink at x: give sparsity, or "
                "derivative='difference'"
            )


def _grows(lacks, v, product, matrix):
    """Which rows lack something in proportion to the step: entries, however small. What rounding makes does not grow.

    A row may be far smaller than the largest, as one of other units is.
    """
    gaps = [product(times * v) - times * (matrix @ v.reshape(-1)) - times * lacks for times in TIMES]
    return np.all([np.abs(gap) <= 0.1 * np.abs(lacks) for gap in gaps], axis=0) & (lacks != 0)


def _gap(found, known):
    size = float(np.linalg.norm(known))
    return float(np.linalg.norm(found - known)) / size if size else float(np.linalg.norm(found) > 0)
