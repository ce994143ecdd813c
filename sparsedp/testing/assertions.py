"""Assertions that a derivative or a transpose is right. They need no test framework."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from math import inf
from typing import Any

import numpy as np
from numpy.exceptions import ComplexWarning

from sparsedp._utils.calls import frames_inside, without_own_frames
from sparsedp.check.choice import check_derivative
from sparsedp.check.derivatives import transposed_products
from sparsedp.check.gradient_check import Audit
from sparsedp.check.operators import transpose as check_transpose
from sparsedp.check.summary import Result, Row, Summary
from sparsedp.operators.given import from_functions, from_linear_operator
from sparsedp.operators.operator import Operator
from sparsedp.testing.observers import OBSERVERS, are_complete

__all__ = ["assert_gradient", "assert_transpose", "kind_of", "reason_of"]


def assert_gradient(
    f: Any,
    x: Any = None,
    *,
    gradient: Any = None,
    vjp: Callable[[Any, Any], Any] | None = None,
    jvp: Callable[[Any, Any], Any] | None = None,
    jacobian: Any = None,
    hessian: Any = None,
    quick: bool | None = None,
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
    quick : bool, optional
        Whether few directions are examined. Default: True, but False in a test of ``pytest --gradients``.
    allow_inconclusive : bool
        Whether the verdict "inconclusive" passes: at a kink, or for a function with much noise.
    **options
        Further arguments of the check: `rng`, `steps` and `directions`; for all derivatives except `gradient` also
        `grid`, `noise` and `beside`, and for `vjp` and `jvp` also `convention` and `stages`.

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
    if quick is None:
        quick = not are_complete()
    start = time.perf_counter()
    derivatives = {"gradient": gradient, "vjp": vjp, "jvp": jvp, "jacobian": jacobian, "hessian": hessian}
    try:
        result = check_derivative(f, x, quick=quick, **derivatives, **options)
    except Exception as error:
        raise without_own_frames(error)  # noqa: B904 SPARSEDP_TRACEBACK=full keeps all frames
    _conclude(result, time.perf_counter() - start, allow_inconclusive, complete=not quick)
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
        ``transpose(g)``, if `op` is a function ``op(u)``: the transpose without conjugation, also for complex numbers.
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
    start = time.perf_counter()
    try:
        operator = _as_operator(op, transpose, shape)
        result = _difference_of_shapes(operator, transpose)
        if result is None:
            result = _checked_transpose(operator, seeds, rng, isinstance(op, Operator))
    except Exception as error:
        raise without_own_frames(error)  # noqa: B904 SPARSEDP_TRACEBACK=full keeps all frames
    if not result:
        result = _with_entries(result, operator)
    _conclude(result, time.perf_counter() - start, complete=are_complete())
    return result


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
    dtype = complex if np.iscomplexobj(result) else float
    return from_functions(op, transpose, shape, result.shape, getattr(op, "__name__", "operator"), dtype)


def _difference_of_shapes(operator: Operator, transpose: Callable[[Any], Any] | None) -> Summary | None:
    """Return a result that disagrees if a function returns another shape than that of u; None if not."""
    if transpose is None:
        return None
    shape = np.shape(transpose(np.zeros(operator.codomain.shape)))
    expected = operator.domain.shape
    if shape == expected:
        return None
    note = f"transpose(g) has shape {shape}, expected {expected}, the shape of u"
    return Summary(f"transpose of {operator.name}", [Row("shape", inf, None, False, note)])


def _checked_transpose(operator: Operator, seeds: int, rng: int | np.random.Generator | None, is_own: bool) -> Summary:
    """Return the result of `check.transpose`.

    The functions of other code may be for real numbers only. If they return real numbers for real fields, and are right
    for these, results for complex fields do not count.
    """
    with warnings.catch_warnings():
        if not is_own:
            warnings.simplefilter("ignore", ComplexWarning)  # a buffer of real numbers discards imaginary parts
        result = check_transpose(operator, seeds, rng)
    if result or is_own or operator.dtype.kind == "c":
        return result
    rows = []
    for row in result.rows:
        if row.ok is False and "complex" in row.name:
            row = Row(row.name, note="not tested, the functions are for real numbers")
        rows.append(row)
    return Summary(result.title, rows)


def _with_entries(result: Summary, operator: Operator) -> Summary:
    """Return the result of a wrong transpose with the entries of u and of A u at which it is wrong."""
    try:
        if np.any(operator.apply(np.zeros(operator.domain.shape))):
            return Summary(result.title, result.rows, culprit="A is not linear: it does not map zeros to zeros")
        summary = transposed_products(operator)
    except Exception:  # a wrong function may raise any exception; its transpose is wrong anyway
        return result
    return Summary(result.title, result.rows, culprit=summary.culprit, gaps=summary.gaps)


def _conclude(result: Result, seconds: float, allow_inconclusive: bool = False, complete: bool = False) -> None:
    """Tell the observer of the test about a check, and raise an AssertionError if it is not accepted.

    Parameters
    ----------
    result : Result
    seconds : float
    allow_inconclusive : bool
        Whether an inconclusive check is accepted.
    complete : bool
        Whether the tables of the check are part of the message.
    """
    __tracebackhide__ = True
    is_accepted = bool(result) or (allow_inconclusive and result.verdict == "inconclusive")
    for observer in OBSERVERS[-1:]:
        frame = sys._getframe(frames_inside())
        observer.note(result, seconds, is_accepted, frame.f_code.co_filename, frame.f_lineno)
    if is_accepted:
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
    reason = _reason_of_transpose(result) if isinstance(result, Summary) else result.reason
    attributes = vars(result)
    culprit = [f"culprit: {attributes['culprit']}"] if attributes.get("culprit") else []
    gaps = [f"largest gap: {gap}" for gap in attributes.get("gaps", ())]
    return "\n  ".join([reason, *culprit, *gaps])


def _reason_of_transpose(result: Summary) -> str:
    """Return why a transpose is wrong: the exception or the shape if there is one, or else the dtypes."""
    failed = [row for row in result.rows if row.ok is False]
    notes = [row.note for row in failed if row.note]
    if notes:
        return notes[0]
    dtypes = ", ".join(row.name.partition(", ")[2] for row in failed)
    return f"<g, A u> and <A^T g, u> differ by {failed[0].figure:.1e} rounding errors, in {dtypes}"
