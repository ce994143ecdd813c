"""Matrix functions of a separable operator: exponentials, powers, and any function of its eigenvalues."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.validation import check_finite, check_function, check_kind, check_number, check_shape
from sparsedp.operators.operator import Operator
from sparsedp.solvers.separable import Eigenbasis, SpectralFunction, require_eigenbasis

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

__all__ = ["matrix_exponential", "matrix_function", "matrix_power"]


def matrix_exponential(op: Operator, time: float = 1.0) -> Operator:
    """Return the operator exp(time * op), for example exact diffusion over a given time.

    Parameters
    ----------
    op : Operator
        A Kronecker sum from a space to itself (``op.separable``), such as a laplacian; or a function of one.
    time : float
        Time [1 / unit of the operator]; must be finite, may be negative.

    Returns
    -------
    Operator
        Matrix-free: two transforms for each application.

    Raises
    ------
    ValueError
        If the operator is not separable or cannot be diagonalised.
    TypeError
        If `time` is not one real number.
    NonFiniteError
        If `time` is not finite, or the exponential overflows.

    See Also
    --------
    matrix_function, matrix_power, stepper

    Notes
    -----
    With A = V diag(e) V^-1: exp(t A) = V diag(exp(t e)) V^-1. Its transpose is exp(t A^T).

    Examples
    --------
    >>> from sparsedp import Grid, laplacian
    >>> spread = matrix_exponential(laplacian(Grid(2)), 1e9)
    >>> print(np.round(spread(np.array([1.0, 3.0])), 6))
    [2. 2.]
    """
    basis = require_eigenbasis(op, "matrix_exponential")
    check_number("time of matrix_exponential", time)
    with np.errstate(over="ignore"):
        values = np.exp(time * basis.eigenvalues)
    name = f"exp({time:g} * {op.name})"
    return _function_of(op, basis, values, name, "; take a shorter time or the other sign")


def matrix_power(op: Operator, exponent: float) -> Operator:
    """Return the operator op^exponent, for example a square root.

    Parameters
    ----------
    op : Operator
        A Kronecker sum from a space to itself (``op.separable``); or a function of one.
    exponent : float
        An integer. If no eigenvalue is negative, it may be any real number.

    Returns
    -------
    Operator

    Raises
    ------
    ValueError
        If the operator is not separable or cannot be diagonalised, or if the exponent is fractional and an eigenvalue
        is negative.
    TypeError
        If `exponent` is not one real number.
    NonFiniteError
        If `exponent` is not finite, or the power overflows.

    See Also
    --------
    matrix_exponential, matrix_function, inverse, laplace

    Notes
    -----
    For a negative exponent, vectors in the null space are mapped to 0, as by a generalised inverse. No residual is
    tested; use `inverse` to solve op(x) = b to a tolerance.

    Examples
    --------
    >>> from sparsedp import Grid, laplacian
    >>> root = matrix_power(-laplacian(Grid(3)), 0.5)
    >>> print(np.round(root(root(np.array([1.0, 2.0, 4.0]))), 6))
    [-1. -1.  2.]
    """
    basis = require_eigenbasis(op, "matrix_power")
    check_number("exponent of matrix_power", exponent)
    eigenvalues = basis.eigenvalues
    if exponent != int(exponent) and np.any(eigenvalues < 0):
        smallest = eigenvalues.min()
        raise ValueError(f"{op.name} has eigenvalues down to {smallest:.1e}; a fractional power needs them >= 0")
    is_zero = eigenvalues == 0
    power_of_zero = float(exponent == 0)
    with np.errstate(over="ignore"):
        powers = np.where(is_zero, 1.0, eigenvalues) ** float(exponent)
    values = np.where(is_zero, power_of_zero, powers)
    return _function_of(op, basis, values, f"({op.name})^{exponent:g}", "; rescale the operator")


def matrix_function(op: Operator, f: Callable[[NDArray[Any]], ArrayLike]) -> Operator:
    """Return the operator f(op), whose eigenvalues are f(e), for example a polynomial in a Laplacian.

    Parameters
    ----------
    op : Operator
        A Kronecker sum from a space to itself (``op.separable``); or a function of one.
    f : callable
        ``f(e)`` takes the array of all eigenvalues [unit of the operator] and returns an array of real numbers of the
        same shape. It is called once.

    Returns
    -------
    Operator
        Matrix-free: two transforms for each application. ``stepper("etdrk4", ...)`` accepts it as its argument
        `linear`, and integrates this part exactly.

    Raises
    ------
    ValueError
        If the operator is not separable or cannot be diagonalised.
    ShapeError
        If the result of f does not have the shape of the eigenvalues.
    TypeError
        If f is not a function, or its values are not real numbers.
    NonFiniteError
        If a value is NaN or infinite.

    See Also
    --------
    matrix_exponential, matrix_power, eigenpairs

    Notes
    -----
    With A = V diag(e) V^-1: f(A) = V diag(f(e)) V^-1. Its transpose is f(A^T).

    Examples
    --------
    >>> from sparsedp import Grid, laplacian
    >>> L = laplacian(Grid(3))
    >>> swift_hohenberg = matrix_function(L, lambda e: 0.1 - (1 + e) ** 2)
    >>> u = np.array([1.0, 2.0, 4.0])
    >>> print(np.round(swift_hohenberg(u) - (0.1 * u - u - 2 * L(u) - L(L(u))), 12) + 0.0)
    [0. 0. 0.]
    """
    check_function("matrix_function", f, "lambda e: -e**2 - e")
    basis = require_eigenbasis(op, "matrix_function")
    with np.errstate(all="ignore"):  # check_finite in _function_of raises an error for NaN and infinity
        values = np.asarray(f(basis.eigenvalues.copy()))
    advice = "; give a number for each eigenvalue"
    check_shape("f(e) of matrix_function", values, basis.eigenvalues.shape, advice)
    check_kind("f(e) of matrix_function", values.dtype, "real numbers")
    return _function_of(op, basis, values.astype(float), f"f({op.name})", "; check f there")


def _function_of(op, basis, values, name, advice):
    """Return the Operator with the same eigenvectors and the eigenvalues `values`; raise if one is not finite."""
    check_finite(name, values, "must be finite at the eigenvalues", advice=advice)
    return Operator(SpectralFunction(Eigenbasis(basis.spectrum, values), op.shape), op.domain, op.codomain, name)
