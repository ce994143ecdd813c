"""Differentiable black boxes: the sparse Jacobian of a NumPy function by complex steps or finite differences."""

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

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import public
from sparsedp._utils.counters import count
from sparsedp._utils.pytree import norm
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
COMPLEX_STEP_SIZE = 1e-30  # can be tiny: no difference is taken, so nothing cancels
DIFFERENCE_STEP = EPS ** (1 / 3)  # step of central differences, relative to x
DIFFERENCE_SHARES = 1.0, 1e-2  # factors of DIFFERENCE_STEP, for Jacobians and probes
# Largest difference allowed between a row of the Jacobian and a probe: relative to the row, and to the largest row.
TOLERANCES = {COMPLEX_STEP: (1e-9, 1e-12), DIFFERENCES: (1e-4, 1e-4)}
LARGEST_ROUNDING = 1e-5  # a difference above this share of a row must not be proportional to the step
EVALUATION_ERRORS = ValueError, ArithmeticError, RuntimeError  # of f at points without a result
MOVE_SHARES = 1.0, -1.0, 1e-2, -1e-2, 1e-4, -1e-4  # tried in turn until the function has a result
STEP_MULTIPLES = 2, 5, 11  # steps at which the difference between a row and a probe is computed again


def from_blackbox(f: Callable, sparsity: Any = None, derivative: str = "auto", name: str | None = None) -> BlackBox:
    """Make a NumPy function of one array differentiable, by its sparse Jacobian.

    Parameters
    ----------
    f : callable
        ``f(x)`` maps a real array of any shape to a real array of any shape. It must be deterministic.
    sparsity : sparse matrix or array, optional
        Matrix of shape (y.size, x.size), with a nonzero entry (i, j) where y_i may depend on x_j. By default, the
        pattern is detected. If x and y have the same shape, f is first treated as a stencil: its neighbours are
        determined at three cells and repeated over the grid. If a row of the resulting Jacobian disagrees with a
        derivative along a random direction, the pattern is instead searched by changing random parts of x, both
        slightly and by a tenth. If f takes another branch at a later point, the search is repeated there and entries
        are added. An entry below 1e-9 of its row (below 1e-5 with central differences) may be missed.
    derivative : "auto", "complex" or "difference"
        "complex" uses complex steps f(x + i h v), which are accurate to rounding but need analytic code that accepts
        complex numbers. "difference" uses central differences, with about ten correct digits. "auto" uses complex steps
        if they agree with central differences.
    name : str, optional
        Name in error messages and counters. Default: the name of `f`.

    Returns
    -------
    BlackBox
        A differentiable function ``box(x)``. `.jacobian(x)` returns dy/dx as a csr_array, `.runs` is the number of
        runs so far, and str() says how many runs one Jacobian takes.

    Raises
    ------
    TypeError
        If `f` is not callable.
    ValueError
        If `derivative` is none of the three words.
    ShapeError
        If `sparsity` does not have the shape (y.size, x.size), or if a later x has another shape than the first one.
    DerivativeError
        If `f` returns different results for the same x; if the Jacobian disagrees with a difference along a random
        direction, because `sparsity` lacks entries or f has no derivative at x; or if a second derivative is computed.
    NonFiniteError
        If f is NaN or infinite near x.

    See Also
    --------
    differentiable, interop.to_torch, interop.to_jax

    Notes
    -----
    A Jacobian costs one run for each colour of the pattern (two runs with central differences), one run at x, and two
    or three runs that test each row of the Jacobian along a random direction, which depends on x. If the test fails
    only in some rows, for example because a branch of the code does not support complex numbers, these rows are
    computed by central differences. At a kink the derivative is the mean of the one-sided derivatives; next to a kink
    it is the derivative on the same side.

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
    """A NumPy function with a sparse Jacobian, which is cached for the last two points. See `from_blackbox`.

    Attributes
    ----------
    runs : int
        Number of runs of the function so far.
    way : str
        The method: COMPLEX_STEP or DIFFERENCES. Empty until it is chosen at the first derivative.
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
        self._lock = RLock()  # the user's function may not be thread-safe
        self._rule = Rule(name, self._run, self._vjp, self._jvp)

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        # The detected pattern is included, because it took many runs to find.
        jacobian = self._shapes, self.way, self._coloured
        return BlackBox, (self._f, self._sparsity, self._derivative, self.name, jacobian)

    @public("dp.from_blackbox(f)")
    def __call__(self, x: Any) -> Any:
        """Return f(x). The result can be differentiated."""
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
        """Run the function on plain values. Return a copy, because f may reuse its result array."""
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
        """Return the Jacobian at x as an Operator. `y` is the recorded result f(x)."""
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
        """Return dy/dx at a point as a csr_array, cached for the last two points.

        Parameters
        ----------
        x : array

        Returns
        -------
        csr_array, (y.size, x.size)
        """
        return self._at(plain(x))[0]

    def _at(self, x):
        """Return the Jacobian and the result at a point, cached for the last two points."""
        x = np.asarray(x, dtype=float)
        with self._lock:
            return self._points.find((x,)) or self._points.put((x,), self._computed(x))

    def _computed(self, x):
        """Compute the Jacobian and the result at a point."""
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
        """Yield coloured patterns to try at x, the cheapest first. Each includes all entries found earlier."""
        rows = y.size
        columns = x.size
        earlier = self._sparsity
        shapes = None  # shape of the grid, if x and y have the same shape
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

        # Both changes are exactly 0 in a row that does not depend on the changed entries of x. The large change may
        # reach other branches of the code.
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
        return DIFFERENCE_STEP * np.maximum(np.abs(x), typical_size(x))

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
        """Return the Jacobian on a pattern, and a mask of the rows in which it disagrees with the probes.

        A probe is a derivative along a random direction. Rows in which the complex step fails are computed by central
        differences, and then by central differences with a shorter step. Near a kink the shorter step stays on one side
        of it; at a kink it gives the mean of both sides. Rows that disagree with a short probe, because the function
        has noise, may agree with a longer probe. The method with which all rows agree at the first point is also used
        at later points.
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
            except Exception as error:  # f does not accept complex numbers, or a point this far from x
                failure = error
                continue
            probed = True
            if not wrong.any():
                self.way = self.way or way[0]
                break
        if not probed:
            raise failure
        return matrix, wrong

    def _disagreeing_rows(self, matrix, x, way, share):
        """Return a mask of the rows in which a Jacobian disagrees with a derivative along a random direction."""
        generator = np.random.default_rng(crc32(x.tobytes()))  # the same direction each time at the same point
        v = share * self._steps(x) * generator.standard_normal(x.shape)
        wrong = [_wrong_rows(matrix, v, self._product(x, method), method) for method in {way, DIFFERENCES}]
        return np.any(wrong, axis=0)


@contextmanager
def _strict():
    """Raise an error if a complex number is cast to real, which loses the derivative. Ignore other warnings."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("error", np.exceptions.ComplexWarning)
        yield


def _with_rows(matrix, other, rows):
    """Return a copy of `matrix` in which the rows of the mask `rows` are taken from `other`, with the same pattern."""
    entries = np.repeat(rows, np.diff(matrix.indptr))
    return sp.csr_array((np.where(entries, other.data, matrix.data), matrix.indices, matrix.indptr), matrix.shape)


def _wrong_rows(matrix, v, along, way):
    """Return a mask of the rows in which ``matrix @ v`` differs too much from the derivative ``along(v)``."""
    missing = along(v) - matrix @ v
    size = abs(matrix) @ np.abs(v)
    share, floor = TOLERANCES[way]
    wrong = ~(np.abs(missing) <= share * size + floor * np.max(size, initial=0.0))
    doubtful = ~wrong & (np.abs(missing) > LARGEST_ROUNDING * size)
    if way == DIFFERENCES and doubtful.any():
        # The error of a missing entry is proportional to the step, however small the entry is; rounding errors are
        # not. This test also finds errors in rows far below the largest row, such as rows with other units.
        gaps = [along(times * v) - times * (matrix @ v + missing) for times in STEP_MULTIPLES]
        wrong |= doubtful & (missing != 0) & ~np.any(np.abs(gaps) > 0.1 * np.abs(missing), axis=0)
    return wrong


def change(run: Callable, x: NDArray, y: NDArray, v: NDArray) -> NDArray:
    """Return the change of ``y = run(x)`` if x is displaced along v.

    The displacement is a tenth of the root mean square of x. If the function raises an error or returns NaN or
    infinity, the opposite and shorter displacements are tried. The result is 0 if all of them fail.
    """
    for share in MOVE_SHARES:
        with suppress(*EVALUATION_ERRORS):
            moved = run(x + 0.1 * share * typical_size(x) * v)
            if np.all(np.isfinite(moved)):
                return moved - y
    return np.zeros_like(y)


def typical_size(x: NDArray) -> float:
    """Return the root mean square of an array, or 1 if that is 0 or the array is empty."""
    return norm(x) / np.sqrt(max(x.size, 1)) or 1.0
