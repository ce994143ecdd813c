"""Differentiable black boxes: sparse Jacobians of a simulator without derivatives, by coloured differences."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import contextmanager, suppress
from itertools import product
from threading import RLock
from typing import Any
from zlib import crc32

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from sparsedp._utils.calls import public
from sparsedp._utils.counters import count
from sparsedp._utils.pytree import norm
from sparsedp._utils.reconstruction import Reconstructible
from sparsedp._utils.validation import EPS, check_choice, check_finite, check_function, check_precision, check_shape
from sparsedp.autodiff.tape import Rule, isbox, plain
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.operators.given import from_matrix
from sparsedp.solvers.cache import Cache
from sparsedp.solvers.sparsity import ColouredPattern, dense_pattern, find_pattern, pattern_like, stencil_pattern

__all__ = ["BlackBox", "from_blackbox"]

COMPLEX_STEP = "complex step"
DIFFERENCES = "central differences"
METHODS = {"auto": "", "complex": COMPLEX_STEP, "difference": DIFFERENCES}
COMPLEX_STEP_SIZE = 1e-30  # no difference is taken, so nothing cancels
DIFFERENCE_STEP = EPS ** (1 / 3)  # step of central differences, relative to x
DIFFERENCE_SHARES = 1.0, 1e-2  # of the step of central differences: Jacobians and probes
# How far a row of the Jacobian may differ from a probe: as a share of the row, and of the largest row.
TOLERANCES = {COMPLEX_STEP: (1e-9, 1e-12), DIFFERENCES: (1e-4, 1e-4)}
LARGEST_ROUNDING = 1e-5  # share of a row; a larger difference from a probe that is proportional to the step is an error
EVALUATION_ERRORS = ValueError, ArithmeticError, RuntimeError  # raised by foreign code at points without a result
MOVE_SHARES = 1.0, -1.0, 1e-2, -1e-2, 1e-4, -1e-4  # tried in turn until the function has a result
STEP_MULTIPLES = 2, 5, 11  # steps at which the difference between a row and a probe is computed again


def from_blackbox(f: Callable, sparsity: Any = None, derivative: str = "auto", name: str | None = None) -> BlackBox:
    """Return a NumPy function of an array as a differentiable function.

    Parameters
    ----------
    f : callable
        ``f(x)``, real arrays of any shapes; it must return the same result for the same x.
    sparsity : sparse matrix or array, optional
        (y.size, x.size), not 0 where y_i may depend on x_j. Default: the stencil found at three cells, repeated over
        the grid, if each row of the Jacobian agrees with a derivative along a random direction; else found by changing
        random parts of x, slightly and by a tenth. At a later point that takes another branch it is searched again, and
        entries are added. An entry below 1e-9 (differences: 1e-5) of its row may be missed.
    derivative : "auto", "complex" or "difference"
        complex: f(x + i h v), to rounding, for code that is analytic and takes complex numbers. difference: central
        differences, about ten digits. auto: complex where it is found to agree with differences.
    name : str, optional
        Name in errors and counts; default: the name of f.

    Returns
    -------
    BlackBox
        ``box(x)``; `.jacobian(x)` is the csr_array dy/dx, `.runs` the number of runs so far; str() says how many runs
        one Jacobian takes.

    Raises
    ------
    TypeError
        If f is no function.
    ValueError
        If `derivative` is not known.
    ShapeError
        If the sparsity or a later x has another shape.
    DerivativeError
        If f is not deterministic or has changed since it was run, or no Jacobian agrees with a difference along a
        random direction: a sparsity that lacks entries, a point where f has no derivative; on derivatives of second
        order.
    NonFiniteError
        If f is NaN or infinite near x.

    See Also
    --------
    differentiable, interop.to_torch, interop.to_jax

    Notes
    -----
    Cost: one run for each colour of the pattern (two for central differences), one at x, and two or three that probe
    the Jacobian row by row along a direction which is another one at each x. Where only a few rows miss something, at
    a branch of code that takes no complex step there, they are taken by central differences. At a kink the derivative
    is the mean of both sides, next to it that of its own side.

    References
    ----------
    A. R. Curtis, M. J. D. Powell, J. K. Reid, IMA J. Appl. Math. 13, 1974 (colouring); W. Squire, G. Trapp,
    SIAM Rev. 40, 1998 (complex step).

    Examples
    --------
    >>> shift = from_blackbox(lambda x: np.roll(x, 1) ** 2)
    >>> from sparsedp.autodiff.derivative import value_and_grad
    >>> import autograd.numpy as anp
    >>> value_and_grad(lambda x: anp.sum(shift(x)))(np.array([1.0, 2.0, 3.0]))
    (14.0, array([2., 4., 6.]))
    """
    check_function("from_blackbox", f, "dp.from_blackbox(lambda x: ...)")
    check_choice("derivative", derivative, METHODS)
    return BlackBox(f, sparsity, derivative, str(name or getattr(f, "__name__", "simulator")))


class BlackBox(Reconstructible):
    """A foreign function with a sparse Jacobian, cached for the last two points: see `from_blackbox`.

    Attributes
    ----------
    runs : int
        Runs of the function so far.
    way : str
        COMPLEX_STEP or DIFFERENCES; empty until the first derivative decides.
    """

    _shapes: Any
    _coloured: Any

    def __init__(
        self, f: Callable, sparsity: Any, derivative: str, name: str, jacobian: tuple = (None, "", None)
    ) -> None:
        self._f = f
        self._derivative = derivative
        self.name = name
        self._sparsity = sparsity
        if sparsity is not None:
            self._sparsity = pattern_like(sparsity)
        self._shapes, self.way, self._coloured = jacobian
        self.way = self.way or METHODS[derivative]
        self.runs = 0
        self._points = Cache()
        self._lock = RLock()  # foreign code may work in arrays of its own: one thread at a time
        self._rule = Rule(name, self._run, self._vjp, self._jvp)

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        # The pattern found so far is included: it took many runs.
        jacobian = self._shapes, self.way, self._coloured
        return BlackBox, (self._f, self._sparsity, self._derivative, self.name, jacobian)

    @public("dp.from_blackbox(f)")
    def __call__(self, x: Any) -> Any:
        """Return the result of the function; it can be differentiated."""
        return self._rule(x)

    def __str__(self):
        if self._coloured is None:
            return f"{self.name}: no derivative asked for yet, {self.runs} runs"
        runs = self._coloured.count
        if self.way != COMPLEX_STEP:
            runs *= 2  # a central difference takes two
        rows, columns = self._coloured.pattern.shape
        return (
            f"{self.name}: Jacobian {rows} x {columns} with {self._coloured.pattern.nnz} entries from {runs} runs "
            f"instead of {columns}, by {self.way}; {self.runs} runs so far"
        )

    __repr__ = __str__

    def _run(self, x):
        """Run the function on plain values and return a copy: it may write into the returned array at the next run."""
        check_precision(f"the argument of {self.name}", x)
        count(f"{self.name}.run", "forward")
        with self._lock:
            self.runs += 1
            y = np.array(self._f(np.array(x)))
        if y.dtype.kind not in "biuf" and np.asarray(x).dtype.kind != "c":
            raise TypeError(f"{self.name} must return real numbers, got dtype {y.dtype}; take the real part")
        check_precision(f"the result of {self.name}", y)
        if y.dtype.kind in "biu":
            return y.astype(float)
        return y

    def _vjp(self, nums, y, x):
        def pull(g):
            return (self._operator(x, y).T(g),)

        return pull

    def _jvp(self, nums, tangents, y, x):
        return self._operator(x, y)(tangents[0])

    def _operator(self, x, y):
        """Return the Jacobian as an Operator, at the argument of a run with the result y."""
        if isbox(x):
            raise DerivativeError(
                f"{self.name} is a black box without second derivatives; use a method with first derivatives, or "
                "write the function with autograd.numpy"
            )
        matrix, result = self._at(x)
        first_result = plain(y)
        if x.dtype != float:  # the Jacobian is computed in float64
            first_result = self._run(x.astype(float))
        if not np.array_equal(result, first_result):
            raise DerivativeError(
                f"{self.name} gives another result for the same argument than before; it must depend on its argument "
                "only, so make everything that changes between calls a part of it"
            )
        inputs, outputs = self._shapes
        return from_matrix(matrix, inputs, outputs, f"{self.name}.J")

    def jacobian(self, x: Any) -> Any:
        """Return dy/dx at a point as a csr_array; kept for the last two points.

        Parameters
        ----------
        x : array

        Returns
        -------
        csr_array, (y.size, x.size)
        """
        return self._at(plain(x))[0]

    def _at(self, x):
        """Return the Jacobian at a point and the result there, cached for the last two points."""
        x = np.asarray(x, dtype=float)
        with self._lock:
            return self._points.find((x,)) or self._points.put((x,), self._computed(x))

    def _computed(self, x):
        """Compute the Jacobian at a point and the result there."""
        check_finite(f"the argument of {self.name}", x)
        y = self._run(x)
        check_finite(f"{self.name} near x", y, "must be finite to be differentiated")
        if self._shapes not in (None, (x.shape, y.shape)):
            raise ShapeError(
                f"{self.name} maps {self._shapes[0]} to {self._shapes[1]}, got {x.shape} to {y.shape}; call "
                "from_blackbox again for other shapes"
            )
        self._shapes = x.shape, y.shape
        for coloured in self._patterns(x.reshape(-1), y.reshape(-1)):
            self._coloured = coloured
            matrix, wrong = self._probed(coloured, x.reshape(-1))
            if not wrong.any():
                return matrix, y
        raise DerivativeError(
            f"row {np.argmax(wrong)} of the Jacobian of {self.name} by {self.way or COMPLEX_STEP} does not agree with "
            "a difference along a random direction; its sparsity lacks entries, or it has a kink at x: leave sparsity "
            "and derivative out, or move x a little"
        )

    def _flat(self, x):
        """Run the function on a flat argument and return the flat result."""
        return self._run(x.reshape(self._shapes[0])).reshape(-1)

    # ------------------------------------------------------------ the pattern

    def _patterns(self, x, y):
        """Yield coloured patterns to try at x, the cheapest first; each includes the entries of earlier points."""
        rows = y.size
        columns = x.size
        earlier = self._sparsity
        shapes = None  # of the grid, if x and y are fields on the same one
        if self._shapes[0] == self._shapes[1]:
            shapes = [self._shapes[0]]
        if self._coloured is not None:
            yield self._coloured
            earlier = self._coloured.pattern
        elif earlier is not None:
            check_shape(f"the sparsity of {self.name}", earlier, (rows, columns))
            yield ColouredPattern(earlier, shapes)
        elif not np.array_equal(self._flat(x), y):
            raise DerivativeError(f"{self.name} gives two results for one argument; fix its random state first")
        if self._sparsity is not None:
            return
        step = self._steps(x)

        def near(v):
            return self._flat(x + step * v) - y

        def far(v):
            return change(self._flat, x, y, v)

        def coloured(pattern):
            if earlier is not None:
                pattern = pattern_like(pattern + earlier)
            return ColouredPattern(pattern, shapes)

        # Both changes are exactly 0 in a row that does not depend on the moved columns; far moves cross branches.
        changes = [near, far]
        if shapes is not None:
            guess = stencil_pattern(changes, shapes)
            if guess is not None:
                yield coloured(guess)
        pattern = find_pattern(changes, rows, columns)
        if pattern is None:
            pattern = dense_pattern(rows, columns)
        yield coloured(pattern)

    # ------------------------------------------------------------ one Jacobian

    def _steps(self, x):
        return DIFFERENCE_STEP * np.maximum(np.abs(x), typical(x))

    def _product(self, x, way):
        """Return the product of the Jacobian at x with a vector, as a function of the vector."""

        def complex_step(v):
            return self._flat(x + 1j * COMPLEX_STEP_SIZE * v).imag / COMPLEX_STEP_SIZE

        def central_difference(v):
            return (self._flat(x + v) - self._flat(x - v)) / 2

        if way == COMPLEX_STEP:
            return complex_step
        return central_difference

    def _by_colours(self, coloured, x, way, share):
        """Compute the Jacobian on a pattern by one product for each colour."""
        steps = np.ones_like(x)
        if way != COMPLEX_STEP:
            steps = share * self._steps(x)
        product_along = self._product(x, way)

        def scaled_product(v):
            return product_along(steps * v)

        matrix = coloured.matrix(scaled_product)
        matrix.data /= steps[matrix.indices]
        check_finite(f"the differences of {self.name} near x", matrix.data, advice="; move x a little")
        return matrix

    def _probed(self, coloured, x):
        """Return the Jacobian on a pattern, and the rows in which it disagrees with the probes.

        Rows in which the complex step fails are computed by central differences, then by shorter ones: next to a kink
        these stay on one side of it, and at a kink they give the mean of both. Rows that no short probe agrees with, as
        in code with noise, may agree with a longer one. The method that all rows agree with at the first point is used
        at later ones.
        """
        ways = []
        if self.way != DIFFERENCES:
            ways.append((COMPLEX_STEP, 1.0))
        if self._derivative != "complex":
            ways.extend((DIFFERENCES, share) for share in DIFFERENCE_SHARES)
        jacobians: dict = {}
        matrix = coloured.pattern
        wrong = np.ones(coloured.pattern.shape[0], dtype=bool)
        probed = False
        for share, way in product(reversed(DIFFERENCE_SHARES), ways):
            try:
                with _strict():
                    if way not in jacobians:
                        jacobians[way] = self._by_colours(coloured, x, *way)
                    matrix = _with_rows(matrix, jacobians[way], wrong)
                    wrong &= self._disagreeing_rows(matrix, x, way[0], share)
            except MemoryError:
                raise
            except Exception as error:  # the code takes no complex numbers, or no point this far from x
                trouble = error
                continue
            probed = True
            if not wrong.any():
                self.way = self.way or way[0]
                break
        if not probed:
            raise trouble
        return matrix, wrong

    def _disagreeing_rows(self, matrix, x, way, share):
        """Return the rows in which a Jacobian disagrees with its own method or with a difference along a direction."""
        generator = np.random.default_rng(crc32(x.tobytes()))  # one direction for each point
        v = share * self._steps(x) * generator.standard_normal(x.shape)
        wrong = [_wrong_rows(matrix, v, self._product(x, method), method) for method in {way, DIFFERENCES}]
        return np.any(wrong, axis=0)


@contextmanager
def _strict():
    """Raise an error if a complex number is cast to real, which loses the derivative; ignore NumPy's warnings."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("error", np.exceptions.ComplexWarning)
        yield


def _with_rows(matrix, other, rows):
    """Return a matrix with some rows from another one on the same pattern."""
    entries = np.repeat(rows, np.diff(matrix.indptr))
    return sp.csr_array((np.where(entries, other.data, matrix.data), matrix.indices, matrix.indptr), matrix.shape)


def _wrong_rows(matrix, v, along, way):
    """Return the rows in which the product of a matrix with v differs too much from the product along v."""
    lacks = along(v) - matrix @ v
    size = abs(matrix) @ np.abs(v)
    share, floor = TOLERANCES[way]
    wrong = ~(np.abs(lacks) <= share * size + floor * np.max(size, initial=0.0))
    doubtful = ~wrong & (np.abs(lacks) > LARGEST_ROUNDING * size)
    if way == DIFFERENCES and doubtful.any():
        # Entries, however small, lack something in proportion to the step, and what rounding makes does not. A row may
        # be far smaller than the largest, as one of other units is.
        gaps = [along(times * v) - times * (matrix @ v + lacks) for times in STEP_MULTIPLES]
        wrong |= doubtful & (lacks != 0) & ~np.any(np.abs(gaps) > 0.1 * np.abs(lacks), axis=0)
    return wrong


def change(run: Callable, x: NDArray, y: NDArray, v: NDArray) -> NDArray:
    """Return the change of ``y = run(x)`` when x moves along v.

    The move is a tenth of the size of x; shorter moves are tried if the function raises an error or returns NaN or
    infinity. The change is 0 if it does so for all of them.
    """
    for share in MOVE_SHARES:
        with suppress(*EVALUATION_ERRORS):
            moved = run(x + 0.1 * share * typical(x) * v)
            if np.all(np.isfinite(moved)):
                return moved - y
    return np.zeros_like(y)


def typical(x: NDArray) -> float:
    """Return the root mean square of an array, or 1 if that is 0 or the array is empty."""
    return norm(x) / np.sqrt(max(x.size, 1)) or 1.0
