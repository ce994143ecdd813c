"""Functions of a separable operator as operators: exponentials, powers, and any function of its eigenvalues."""

import numpy as np

from sparsedp._utils.validation import check_finite, check_function, check_kind, check_number, check_shape
from sparsedp.operators.operator import Operator
from sparsedp.solvers.separable import SpectralFunction, diagonalised

__all__ = ["matrix_exponential", "matrix_function", "matrix_power"]


def matrix_exponential(op, time=1.0):
    """Separable operator -> the operator exp(time * op): exact diffusion over a time, at any size of step.

    Parameters
    ----------
    op : Operator
        A Kronecker sum from a space to itself (``op.separable``), such as a laplacian; or a power of one.
    time : float
        Finite [1 / unit of the operator].

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
        If `time` is not finite, or the exponential leaves the range of floats.

    Notes
    -----
    With A = V diag(e) V^-1: exp(t A) = V diag(exp(t e)) V^-1. Transpose: exp(t A^T).

    Examples
    --------
    >>> from sparsedp import Grid, laplacian
    >>> spread = matrix_exponential(laplacian(Grid(2)), 1e9)
    >>> print(np.round(spread(np.array([1.0, 3.0])), 6))
    [2. 2.]
    """
    axes, values = diagonalised(op, "matrix_exponential")
    check_number("time of matrix_exponential", time)
    with np.errstate(over="ignore"):
        weights = np.exp(time * values)
    name = f"exp({time:g} * {op.name})"
    return _function(op, axes, weights, name, "; take a shorter time or the other sign")


def matrix_power(op, exponent):
    """Separable operator -> the operator op^exponent, such as a square root or a smoothing power.

    Parameters
    ----------
    op : Operator
        A Kronecker sum from a space to itself (``op.separable``); or an exponential of one.
    exponent : float
        Whole, or any number when no eigenvalue is negative. On the null space a negative exponent
        gives 0: the generalised inverse.

    Returns
    -------
    Operator

    Raises
    ------
    ValueError
        If the operator is not separable, or a fractional power of a negative eigenvalue is asked for.
    TypeError
        If `exponent` is not one real number.
    NonFiniteError
        If `exponent` is not finite, or the power leaves the range of floats.

    Notes
    -----
    A product with known numbers, not a solve: no residual is looked at. For the solution of op x = b write `inverse`.

    Examples
    --------
    >>> from sparsedp import Grid, laplacian
    >>> root = matrix_power(-laplacian(Grid(3)), 0.5)
    >>> print(np.round(root(root(np.array([1.0, 2.0, 4.0]))), 6))
    [-1. -1.  2.]
    """
    axes, values = diagonalised(op, "matrix_power")
    check_number("exponent of matrix_power", exponent)
    if exponent != int(exponent) and np.any(values < 0):
        raise ValueError(f"{op.name} has eigenvalues down to {values.min():.1e}; a fractional power needs them >= 0")
    zero = values == 0
    with np.errstate(over="ignore"):
        weights = np.where(zero, float(exponent == 0), np.where(zero, 1.0, values) ** float(exponent))
    return _function(op, axes, weights, f"({op.name})^{exponent:g}", "; rescale the operator")


def matrix_function(op, f):
    """Separable operator -> the operator f(op): f of its eigenvalues, such as a polynomial in a Laplacian.

    Parameters
    ----------
    op : Operator
        A Kronecker sum from a space to itself (``op.separable``); or a function of one.
    f : callable
        ``f(e)``: an array of eigenvalues [unit of the operator] -> as many real numbers. It is called once.

    Returns
    -------
    Operator
        Matrix-free: two transforms for each application. As `linear` of ``stepper("etdrk4", ...)`` it is exact in time.

    Raises
    ------
    ValueError
        If the operator is not separable or cannot be diagonalised.
    ShapeError
        If f returns another shape.
    TypeError
        If f is no function, or returns what are no real numbers.
    NonFiniteError
        If a value is NaN or infinite.

    Notes
    -----
    With A = V diag(e) V^-1: f(A) = V diag(f(e)) V^-1. Transpose: f(A^T).

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
    axes, values = diagonalised(op, "matrix_function")
    with np.errstate(all="ignore"):  # NaN is refused below
        weights = np.asarray(f(values.copy()))
    check_shape("f(e) of matrix_function", weights, values.shape, "; give a number for each eigenvalue")
    check_kind("f(e) of matrix_function", weights.dtype, "real numbers")
    return _function(op, axes, weights.astype(float), f"f({op.name})", "; check f there")


def _function(op, axes, weights, name, advice):
    """The Operator with these weights in place of the eigenvalues; refused when they are beyond the range of floats."""
    check_finite(name, weights, "must be finite at the eigenvalues", advice=advice)
    return Operator(SpectralFunction((axes, weights), op.shape), op.domain, op.codomain, name)
