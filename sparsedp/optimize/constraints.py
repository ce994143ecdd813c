"""The argument `constraints` of `minimize`: values, Jacobian products and units of the constraint functions."""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property
from numbers import Number
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.base_classes import Frozen
from sparsedp._utils.calls import wrapped_functions
from sparsedp._utils.pytree import flatten, labels, leaves, norm, paired, power_of_two
from sparsedp._utils.validation import check_finite, check_function, check_kind
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.flattening import joined
from sparsedp.autodiff.tape import is_variable, isbox, sample
from sparsedp.errors import DerivativeError, ShapeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing

__all__ = ["ConstraintValues", "Constraints", "Equality", "equal"]

FINITE = "must be finite; start where every constraint is"
FINITE_DERIVATIVE = "must be finite; start where every constraint has derivatives"
EQUALITY_CALLS: ContextVar[list[Equality] | None] = ContextVar("equality_calls", default=None)  # of one constraint
SCIPY_DICT = {"type", "fun"}  # keys of a constraint of scipy.optimize.minimize that is a dict


class Equality(Frozen):
    """The constraint f(x) == 0 of `minimize`; see `equal`.

    Attributes
    ----------
    function : callable
    """

    function: Callable[[Any], Any]

    def __call__(self, x: Any) -> Any:
        """Return f(x)."""
        calls = EQUALITY_CALLS.get()
        if calls is not None:
            calls.append(self)
        return self.function(x)


def equal(function: Callable[[Any], Any]) -> Equality:
    """Return the constraint f(x) == 0, for the argument `constraints` of `minimize`.

    Parameters
    ----------
    function : callable
        ``function(x)`` returns a number or an array that is 0 at a feasible point.

    Returns
    -------
    Equality
        An object that `minimize` takes as a constraint, also behind `jit` and functools.partial. Calling it calls the
        function.

    Raises
    ------
    TypeError
        If `function` is not a function.

    See Also
    --------
    minimize

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> import numpy as np
    >>> from sparsedp import minimize
    >>> best = minimize(
    ...     lambda x: anp.sum(x**2), np.zeros(2), "augmented_lagrangian", constraints=equal(lambda x: anp.sum(x) - 1.0)
    ... )
    >>> best.x
    array([0.5, 0.5])
    """
    check_function("equal", function, "lambda x: np.sum(x) - 1.0")
    return Equality(function=function)


class ConstraintFunction:
    """A function y(x) with lower <= y(x) <= upper, and the rows c(x) <= 0 or c(x) == 0 that express these limits.

    Parameters
    ----------
    outputs : callable
        ``outputs(x)``, where x is a tree, returns a number or an array.
    packing : Packing
    name : str
        Name in messages.
    lower, upper : array_like
        Limits of y. A finite upper limit u gives the row y - u <= 0, a finite lower limit l the row l - y <= 0, and
        equal limits give the row y - l == 0.
    jacobian : callable, optional
        ``jacobian(v)`` returns the matrix of derivatives of y with respect to the flat vector v. Default: automatic
        differentiation.

    Attributes
    ----------
    index : (m,) array of int
        For each row, the entry of the flat y.
    sign : (m,) array
        1.0 for y - limit, -1.0 for limit - y.
    equality : (m,) array of bool
    shape : tuple
        The shape of y.
    """

    def __init__(
        self,
        outputs: Callable[[Any], Any],
        packing: Packing,
        name: str,
        lower: Any = -np.inf,
        upper: Any = 0.0,
        jacobian: Callable[[Any], Any] | None = None,
    ):
        self._outputs = outputs
        self._packing = packing
        self._name = name
        for limit in (lower, upper):
            check_kind(f"a limit of {name}", np.asarray(limit).dtype, "real numbers")
        self._limits = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        self._user_jacobian = jacobian
        self.shape: Any = None
        self.index: Any = None
        self.sign: Any = None
        self.equality: Any = None
        self._limit: Any = None
        if np.any(np.isnan(self._limits[0])) or np.any(np.isnan(self._limits[1])):
            raise ValueError(f"{name}: lb and ub must not be NaN; write -np.inf or np.inf for none")
        if np.any(self._limits[0] == np.inf) or np.any(self._limits[1] == -np.inf):
            raise ValueError(f"{name}: no value is >= lb=inf or <= ub=-inf; write lb=-np.inf or ub=np.inf for none")

    def at(self, vector: NDArray[np.float64]) -> LinearizedOutputs:
        """Return y at a point, with its derivatives. The first call determines the shape and the rows."""
        with _equality_calls() as calls:
            linearized = LinearizedOutputs(self._outputs, self._packing, vector, self._name, self._user_jacobian)
        if self.shape is None:
            self._set_rows(linearized.value.shape)
            if calls and not np.all(self.equality):
                raise ValueError(
                    f"{self._name} calls dp.equal(function) inside another function, which does not require == 0; "
                    "write dp.equal(lambda x: ...) around the whole function, or call the inner function itself"
                )
        if linearized.value.shape != self.shape:
            raise ShapeError(
                f"{self._name} must return the same shape in each call, got {self.shape} and {linearized.value.shape}"
            )
        check_finite(self._name, linearized.value, FINITE)
        return linearized

    def rows_of(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rows c, given the flat y."""
        return self.sign * (y[self.index] - self._limit)

    def cotangent(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the flat cotangent of y, given that of the rows c."""
        y = np.zeros(int(np.prod(self.shape)))
        np.add.at(y, self.index, self.sign * rows)
        return y

    def rows_of_multiplier(self, multiplier: Any, name: str) -> NDArray[np.float64]:
        """Return the multipliers of the rows, given one of the shape of y: the inverse of `cotangent`.

        Raises
        ------
        ShapeError, ValueError, NonFiniteError
            If the multiplier has another shape, or a sign that no row has, or is not finite.
        """
        values = np.asarray(multiplier)
        check_kind(name, values.dtype, "real numbers")
        if values.shape != self.shape:
            raise ShapeError(f"{name} must have the shape {self.shape} of the constraint, got {values.shape}")
        check_finite(name, values)
        y = values.astype(float).reshape(-1)
        rows = self.sign * y[self.index]
        rows = np.where(self.equality, rows, np.maximum(rows, 0.0))
        lost = np.abs(self.cotangent(rows) - y) > 0
        if np.any(lost):
            raise ValueError(
                f"{name} contains {y[lost][0]:g}, and no limit there has a multiplier of this sign; those of "
                "function(x) <= 0 are >= 0"
            )
        return rows

    def in_shape(self, flat: NDArray[np.float64]) -> Any:
        """Return flat entries in the shape of y; a number if y is a number."""
        if self.shape == ():
            return float(flat[0])
        return np.reshape(flat, self.shape)

    def _set_rows(self, shape):
        """Determine the rows from the limits, given the shape of y."""
        try:
            lower, upper = (np.ravel(np.broadcast_to(limit, shape)) for limit in self._limits)
        except ValueError:
            raise ShapeError(
                f"{self._name}: lb and ub of shapes {self._limits[0].shape} and {self._limits[1].shape} do not fit a "
                f"value of shape {shape}"
            ) from None
        if np.any(lower > upper):
            raise ValueError(
                f"{self._name}: lb must be <= ub, got {lower[lower > upper][0]:g} > {upper[lower > upper][0]:g}"
            )
        equality = lower == upper
        above = np.flatnonzero(np.isfinite(upper) & ~equality)
        below = np.flatnonzero(np.isfinite(lower) & ~equality)
        equal_entries = np.flatnonzero(equality & np.isfinite(lower))
        self.shape = shape
        self.index = np.concatenate([above, below, equal_entries])
        self.sign = np.concatenate([np.ones(above.size), -np.ones(below.size), np.ones(equal_entries.size)])
        self._limit = np.concatenate([upper[above], lower[below], lower[equal_entries]])
        self.equality = np.repeat([False, True], [above.size + below.size, equal_entries.size])


class LinearizedOutputs:
    """The outputs y of a constraint function at a point, and products with the Jacobian of the flat y.

    Parameters
    ----------
    outputs : callable
    packing : Packing
    vector : (n,) array
    name : str
        Name in messages.
    user_jacobian : callable or None
        See `ConstraintFunction`.

    Attributes
    ----------
    value : array
    flat : (k,) array
        The value in double precision.

    Raises
    ------
    TypeError, DerivativeError, ShapeError
        If the value is not a real number or array, is empty, or does not depend on x.
    """

    def __init__(
        self,
        outputs: Callable[[Any], Any],
        packing: Packing,
        vector: NDArray[np.float64],
        name: str,
        user_jacobian: Callable[[Any], Any] | None,
    ):
        self._packing = packing
        self._tree = packing.unpack(vector)
        self._name = name

        def checked_outputs(x):
            y = outputs(x)
            _check_outputs(name, y, user_jacobian is None)
            return y

        self._outputs = checked_outputs
        self._pull: Any = None
        self._matrix: Any = None
        if user_jacobian is None:
            self.value, self._pull = pullback(checked_outputs, self._tree)
        else:
            self.value = np.asarray(checked_outputs(self._tree))
            self._matrix = self._users_matrix(user_jacobian(packing.unpack(vector)))
        self.value = np.asarray(self.value)
        self.flat = self.value.reshape(-1).astype(float)

    def vjp(self, w: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return J^T w for w of shape (k,), by one backward pass."""
        if self._matrix is not None:
            return np.asarray(self._matrix.T @ w).reshape(-1)
        cotangent = w.reshape(self.value.shape).astype(self.value.dtype)
        gradient = joined(self._packing.slopes(self._pull(cotangent)))
        check_finite(f"a derivative of {self._name}", gradient, FINITE_DERIVATIVE)
        return gradient

    def jacobian(self) -> NDArray[np.float64]:
        """Return the matrix J of shape (k, n), by backward passes for its rows or forward passes for its columns."""
        if self._matrix is None:
            self._matrix = self._differentiated()
        if sp.issparse(self._matrix):
            return self._matrix.toarray()
        return self._matrix

    def _differentiated(self):
        """Return J by automatic differentiation."""
        rows = self.flat.size
        columns = self._packing.size
        if columns < rows:
            return np.array([self._jvp(unit) for unit in np.eye(columns)]).reshape(columns, rows).T
        return np.array([self.vjp(unit) for unit in np.eye(rows)]).reshape(rows, columns)

    def _jvp(self, v):
        """Return J v, an array of shape (k,)."""
        tangents = [leaf if is_variable(leaf) else None for leaf in leaves(self._packing.unpack(v))]
        return np.asarray(push(self._outputs, self._tree, tangents)[1]).reshape(-1).astype(float)

    def _users_matrix(self, matrix):
        """Return the Jacobian of the user as a matrix, dense or sparse, after a check of its shape."""
        expected = self.value.size, self._packing.size
        if not sp.issparse(matrix):
            matrix = np.asarray(matrix, dtype=float)
            if matrix.ndim == 1 and expected[0] == 1:
                matrix = matrix.reshape(1, -1)
        if matrix.shape != expected:
            raise ShapeError(f"the jac of {self._name} must have shape {expected}, got {matrix.shape}")
        values = matrix.data if sp.issparse(matrix) else matrix
        check_finite(f"the jac of {self._name}", values)
        return matrix


def _check_outputs(name, y, traced):
    """Raise an error if the outputs of a constraint are no real array that depends on x."""
    value: Any = sample(y)
    if isinstance(value, (bool, np.bool_)) or getattr(value, "dtype", None) == np.bool_:
        raise TypeError(
            f"{name} must return numbers that are <= 0 at a feasible point, got bool; write x - 1 for x <= 1"
        )
    if not isinstance(value, (np.ndarray, Number)):
        raise TypeError(
            f"{name} must return one number or array, got {type(value).__name__}; write np.stack or np.concatenate, or "
            "a list of functions as constraints"
        )
    if np.asarray(value).dtype.kind == "c":
        raise DerivativeError(f"{name} must be real, got complex values; write their real part or absolute value")
    if np.asarray(value).size == 0:
        raise ShapeError(f"{name} returned an empty array; leave it out")
    if traced and not isbox(y):
        raise DerivativeError(f"{name} does not depend on x; leave it out, or compute it from x with autograd.numpy")


class Constraints:
    """All constraints of a problem as rows c(x) <= 0 and c(x) == 0, in units in which they are of size 1.

    Parameters
    ----------
    constraints : callable, Equality, NonlinearConstraint, LinearConstraint, or a tree of them; or None
    packing : Packing

    Attributes
    ----------
    count : int
        Number of rows m. It is known after `begin`.
    equality : (m,) array of bool
    functions : list of ConstraintFunction
    unit : (m,) array
        The unit of each row, a power of two. It is the same for all rows of one function.

    Raises
    ------
    TypeError
        If a constraint is something else.

    Notes
    -----
    The unit of a function is the larger of two numbers at the start: the largest absolute value of its rows, and the
    root mean square of the norms of their gradients in the units of x.
    """

    def __init__(self, constraints: Any, packing: Packing):
        self._packing = packing
        self._tree = constraints
        entries: list[Any] = []
        names: list[str] = []
        self._build = None
        if constraints is not None:
            _check_no_dict_of_scipy(constraints)
            entries, self._build = flatten(constraints)
            names = labels(constraints, "constraints")
        self.functions = [_constraint_function(entry, packing, name) for entry, name in zip(entries, names)]
        self.count = 0
        self.equality = np.zeros(0, dtype=bool)
        self.unit = np.zeros(0)
        self._parts: list[slice] = []

    def begin(self, vector: NDArray[np.float64], x_unit: NDArray[np.float64]) -> None:
        """Determine the rows and their units at the start.

        Parameters
        ----------
        vector : (n,) array
        x_unit : (n,) array
            The unit of each entry of the vector.
        """
        units = []
        for function in self.functions:
            linearized = function.at(vector)
            rows = function.rows_of(linearized.flat)
            probe = np.cos(np.arange(1.0, 1.0 + linearized.flat.size))
            sensitivity = norm(x_unit * linearized.vjp(probe)) / norm(probe)
            size = max(sensitivity, float(np.max(np.abs(rows), initial=0.0)))
            units.append(np.full(rows.size, power_of_two(size)))
            self._parts.append(slice(self.count, self.count + rows.size))
            self.count += rows.size
        if self.functions:
            self.unit = np.concatenate(units)
            self.equality = np.concatenate([function.equality for function in self.functions])

    def at(self, vector: NDArray[np.float64]) -> ConstraintValues:
        """Return the rows at a point, with their derivatives."""
        return ConstraintValues(self, [function.at(vector) for function in self.functions])

    def split(self, rows: NDArray[np.float64]) -> list[tuple[ConstraintFunction, NDArray[np.float64]]]:
        """Return each function with its part of an array of all rows."""
        return [(function, rows[part]) for function, part in zip(self.functions, self._parts)]

    def multipliers(self, rows: NDArray[np.float64]) -> Any:
        """Return multipliers in the structure of the argument `constraints`, given those of the rows in units.

        The multiplier of a function has the shape of its value y. Lagrangian = loss + sum(multiplier * y) + constant.
        """
        values = [function.in_shape(function.cotangent(part)) for function, part in self.split(rows / self.unit)]
        return self._in_structure(values)

    def rows_of_multipliers(self, multipliers: Any) -> NDArray[np.float64]:
        """Return the multipliers of the rows in units, given those in the structure of the argument `constraints`.

        Raises
        ------
        TypeError, ShapeError, ValueError, NonFiniteError
            If there are no constraints, or if a multiplier has another structure, shape or sign or is not finite.
        """
        if self._build is None:
            raise TypeError("multipliers belong to constraints, and there are none; leave multipliers out")
        entries = paired(multipliers, self._tree, "multipliers", advice="; write them as best.multipliers has them")
        names = labels(self._tree, "multipliers")
        parts = [
            function.rows_of_multiplier(entry, name) for function, entry, name in zip(self.functions, entries, names)
        ]
        return joined(parts) * self.unit if parts else np.zeros(0)

    def values(self, at_point: ConstraintValues) -> Any:
        """Return the values y at a point in the structure of the argument `constraints`."""
        return self._in_structure([function.in_shape(flat) for function, flat in zip(self.functions, at_point.outputs)])

    def _in_structure(self, values):
        if self._build is None:
            return None
        return self._build(values)


class ConstraintValues:
    """The rows c(x) of all constraints at a point, in their units, with products with their Jacobian.

    Attributes
    ----------
    rows : (m,) array
    outputs : list of arrays
        The flat value y of each function, in its own unit.
    """

    def __init__(self, constraints: Constraints, linearized: list[LinearizedOutputs]):
        self._constraints = constraints
        self._linearized = linearized
        self.outputs = [one.flat for one in linearized]
        functions = constraints.functions
        parts = [function.rows_of(y) for function, y in zip(functions, self.outputs)]
        self.rows = joined(parts) / constraints.unit if parts else np.zeros(0)

    def vjp(self, v: NDArray[np.float64]) -> Any:
        """Return J^T v, by one backward pass for each function whose part of v is not 0."""
        total: Any = 0.0
        for (function, part), linearized in zip(self._constraints.split(v / self._constraints.unit), self._linearized):
            if np.any(part):
                total = total + linearized.vjp(function.cotangent(part))
        return total

    @cached_property
    def jacobian(self) -> NDArray[np.float64]:
        """The matrix J of shape (m, n)."""
        blocks = []
        for (function, unit), linearized in zip(self._constraints.split(self._constraints.unit), self._linearized):
            blocks.append(linearized.jacobian()[function.index] * (function.sign / unit)[:, None])
        return np.concatenate(blocks)


def _check_no_dict_of_scipy(constraints):
    """Raise TypeError for the dicts that scipy.optimize.minimize takes, whose inequalities have the other sign."""
    candidates = constraints if isinstance(constraints, (list, tuple)) else [constraints]
    for one in candidates:
        if isinstance(one, dict) and SCIPY_DICT <= set(one):
            raise TypeError(
                "constraints takes functions that are <= 0 at a feasible point, got a dict of SciPy, whose fun is >= 0 "
                "there; write lambda x: -fun(x) for 'ineq' and dp.equal(fun) for 'eq'"
            )


@contextmanager
def _equality_calls() -> Iterator[list[Equality]]:
    """Collect the equalities that a constraint calls."""
    calls: list[Equality] = []
    token = EQUALITY_CALLS.set(calls)
    try:
        yield calls
    finally:
        EQUALITY_CALLS.reset(token)


def _constraint_function(entry, packing, name):
    """Return the ConstraintFunction of one entry of the argument `constraints`."""
    if isinstance(entry, Equality):
        return ConstraintFunction(entry.function, packing, name, 0.0, 0.0)
    if hasattr(entry, "lb") and hasattr(entry, "ub") and (hasattr(entry, "fun") or hasattr(entry, "A")):
        return _constraint_of_scipy(entry, packing, name)
    if not callable(entry):
        raise TypeError(
            f"{name} must be a function, dp.equal(function) or a NonlinearConstraint, got {type(entry).__name__}; "
            "write lambda x: np.sum(x) - 1.0"
        )
    if any(isinstance(function, Equality) for function in wrapped_functions(entry)):
        return ConstraintFunction(entry, packing, name, 0.0, 0.0)
    return ConstraintFunction(entry, packing, name)


def _constraint_of_scipy(entry, packing, name):
    """Return the ConstraintFunction of a NonlinearConstraint or LinearConstraint, which take the flat vector."""
    if np.any(entry.keep_feasible):
        raise ValueError(f"{name}: keep_feasible is not available; write bounds, or leave it out")

    def of_flat(function):
        if packing.is_leaf and packing.values[0].ndim == 1 and not packing.complex:
            return function
        return lambda x: function(packing.traced(x))

    if hasattr(entry, "A"):
        if packing.complex:
            raise TypeError(
                f"{name}: a LinearConstraint takes real unknowns, got complex ones; write a function, such as "
                "lambda x: np.real(np.sum(x)) - 1.0"
            )
        matrix = entry.A if sp.issparse(entry.A) else np.atleast_2d(np.asarray(entry.A, dtype=float))
        if matrix.shape[1] != packing.size:
            raise ShapeError(
                f"{name}: A must have a column for each of the {packing.size} unknowns, got shape {matrix.shape}"
            )

        def product(vector):
            return matrix @ np.asarray(vector, dtype=float)

        return ConstraintFunction(of_flat(product), packing, name, entry.lb, entry.ub, lambda x: matrix)
    jacobian = of_flat(entry.jac) if callable(entry.jac) else None
    return ConstraintFunction(of_flat(entry.fun), packing, name, entry.lb, entry.ub, jacobian)
