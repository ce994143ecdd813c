"""Assertions that a derivative or a transpose is right. They need no test framework."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sparsedp.check.choice import check_derivative
from sparsedp.check.gradient_check import Audit
from sparsedp.check.operators import transpose as check_transpose
from sparsedp.check.summary import Result, Summary
from sparsedp.operators.given import from_functions, from_linear_operator
from sparsedp.operators.operator import Operator

__all__ = [
    "assert_gradient",
    "assert_transpose",
    "check_transpose_of",
    "kind_of",
    "raise_unless_accepted",
    "reason_of",
]


def assert_gradient(
    f: Any,
    x: Any = None,
    *,
    gradient: Any = None,
    vjp: Callable[[Any, Any], Any] | None = None,
    jvp: Callable[[Any, Any], Any] | None = None,
    jacobian: Any = None,
    hessian: Any = None,
    quick: bool = True,
    allow_inconclusive: bool = False,
    **options: Any,
) -> Audit:
    """Raise an AssertionError if a derivative does not agree with finite differences.

    Parameters
    ----------
    f : callable or object
        A loss ``f(x) -> real scalar``, or a function with results of any shape, of NumPy, torch, JAX or this library;
        or an object with the methods ``apply`` and ``vjp``.
    x : array, or tree of arrays
        The point.
    gradient : callable or tree, optional
        The gradient of a loss: ``gradient(x)``, or its value at `x`.
    vjp, jvp : callable, optional
        ``vjp(x, g)`` and ``jvp(x, t)``. If both are given, they are also compared with each other.
    jacobian : array, sparse matrix, LinearOperator, Operator, or callable, optional
    hessian : array, sparse matrix, LinearOperator, Operator, or callable, optional
        With `gradient`, the Hessian is compared with differences of the gradient.
    quick : bool
        If True, few directions are examined. The fixture of pytest sets it to False for ``pytest --gradients``.
    allow_inconclusive : bool
        Whether the verdict "inconclusive" passes: at a kink, or for a function with much noise.
    **options
        Further arguments of `check.gradient` for a loss, and of `check.vjp`, `check.jvp`, `check.jacobian` and
        `check.hessian` for the others: `rng`, `steps`, `grid`, `noise` and others.

    Returns
    -------
    Audit
        The result of the check.

    Raises
    ------
    AssertionError
        If the verdict is "disagrees", or "inconclusive" without `allow_inconclusive`. The message names the reason, the
        wrong entries, and the call or stage at fault where it is known.
    TypeError
        If several derivatives are given that no check compares.

    See Also
    --------
    check.gradient, check.vjp, testing.assert_transpose

    Notes
    -----
    Without a derivative, the one by the library of `f` is checked: `check.gradient` for a loss on the tape of this
    library, `check.vjp` for everything else.

    Examples
    --------
    >>> x = np.linspace(1.0, 2.0, 5)
    >>> assert_gradient(lambda u: np.sum(u**3), x, gradient=lambda u: 3 * u**2).verdict
    'agrees'
    >>> assert_gradient(lambda u: u**3, x, vjp=lambda u, g: 3 * u * g)
    Traceback (most recent call last):
    AssertionError: the vjp disagrees...
    """
    __tracebackhide__ = True  # pytest shows the line of the test
    result = check_derivative(
        f,
        x,
        gradient=gradient,
        vjp=vjp,
        jvp=jvp,
        jacobian=jacobian,
        hessian=hessian,
        quick=quick,
        **options,
    )
    raise_unless_accepted(result, allow_inconclusive, complete=not quick)
    return result


def assert_transpose(
    op: Any,
    transpose: Callable[[Any], Any] | None = None,
    *,
    shape: int | tuple[int, ...] | None = None,
    seeds: int = 5,
    rng: int | np.random.Generator | None = None,
) -> Summary:
    """Raise an AssertionError if <g, A u> differs from <A^T g, u> by more than rounding.

    Parameters
    ----------
    op : Operator, LinearOperator or callable
        A linear map. A LinearOperator with complex numbers is compared with its conjugate transpose, `rmatvec`.
    transpose : callable, optional
        ``transpose(g)``, if `op` is a function ``op(u)``.
    shape : int or tuple of int, optional
        Shape of ``u``, if `op` is a function.
    seeds : int
        Number of random pairs of ``u`` and ``g``.
    rng : None, int or numpy Generator
        Seed or generator of the pairs. Default: a fixed seed.

    Returns
    -------
    Summary
        The result of `check.transpose`.

    Raises
    ------
    AssertionError
        If the transpose is wrong.
    TypeError
        If `op` is a function and `transpose` or `shape` is not given.

    See Also
    --------
    check.transpose, testing.assert_gradient

    Examples
    --------
    >>> assert_transpose(lambda u: u[1:] - u[:-1], lambda g: -np.diff(g, prepend=0, append=0), shape=6).verdict
    'agrees'
    """
    __tracebackhide__ = True
    result = check_transpose_of(op, transpose, shape=shape, seeds=seeds, rng=rng)
    raise_unless_accepted(result)
    return result


def check_transpose_of(
    op: Any,
    transpose: Callable[[Any], Any] | None = None,
    *,
    shape: int | tuple[int, ...] | None = None,
    seeds: int = 5,
    rng: int | np.random.Generator | None = None,
) -> Summary:
    """Return the result of `check.transpose` for an Operator, a LinearOperator, or two functions."""
    return check_transpose(_as_operator(op, transpose, shape), seeds, rng)


def _as_operator(op: Any, transpose: Callable[[Any], Any] | None, shape: int | tuple[int, ...] | None) -> Operator:
    """Return a linear map as an Operator."""
    if isinstance(op, Operator):
        return op
    if hasattr(op, "rmatvec"):
        return from_linear_operator(op)
    if not callable(op) or transpose is None or shape is None:
        raise TypeError(
            "assert_transpose takes an Operator, a LinearOperator, or two functions and the shape of the argument; "
            f"got {type(op).__name__}; write assert_transpose(apply, transpose, shape=u.shape)"
        )
    result = np.asarray(op(np.zeros(shape)))
    return from_functions(op, transpose, shape, result.shape, getattr(op, "__name__", "operator"))


def raise_unless_accepted(result: Result, allow_inconclusive: bool = False, complete: bool = True) -> None:
    """Raise an AssertionError if a check disagrees, or is inconclusive and that is not allowed.

    Parameters
    ----------
    result : Result
    allow_inconclusive : bool
    complete : bool
        Whether the tables of the check are part of the message.
    """
    __tracebackhide__ = True
    if result or (allow_inconclusive and result.verdict == "inconclusive"):
        return
    kind = kind_of(result)
    reason = reason_of(result)
    if complete:
        reason = f"{reason}\n{result}"
    if result.verdict == "inconclusive":
        raise AssertionError(f"the {kind} is inconclusive: {reason}")
    raise AssertionError(f"the {kind} disagrees: {reason}")


def kind_of(result: Result) -> str:
    """Return what was checked: "gradient", "vjp", "jvp", "jacobian", "hessian" or "transpose"."""
    if isinstance(result, Summary):
        return "transpose"
    return getattr(result, "kind", "gradient")


def reason_of(result: Result) -> str:
    """Return why a check failed, and on further lines the culprit and the entries with the largest gaps."""
    if isinstance(result, Summary):
        return ", ".join(result.failed)
    culprit = [f"culprit: {result.culprit}"] if result.culprit else []
    gaps = [f"largest gap: {gap}" for gap in result.gaps]
    return "\n  ".join([result.reason, *culprit, *gaps])
