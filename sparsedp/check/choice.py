"""Choose the check for the derivative that is given: the same for assertions in tests and for the command line."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from sparsedp._utils.calls import advice_near
from sparsedp._utils.pytree import copied, leaves
from sparsedp.check.derivatives import gradient_as_vjp
from sparsedp.check.derivatives import hessian as check_hessian
from sparsedp.check.derivatives import jacobian as check_jacobian
from sparsedp.check.derivatives import jvp as check_jvp
from sparsedp.check.derivatives import vjp as check_vjp
from sparsedp.check.gradient_check import Audit
from sparsedp.check.gradient_check import gradient as check_gradient
from sparsedp.check.programs import library_of, plain_numpy_refused
from sparsedp.operators.operator import Operator

__all__ = ["DERIVATIVES", "check_derivative"]

DERIVATIVES = ("gradient", "vjp", "jvp", "jacobian", "hessian")
CHECKS: dict[str, Callable[..., Any]] = dict(
    gradient=check_gradient, vjp=check_vjp, jvp=check_jvp, jacobian=check_jacobian, hessian=check_hessian
)
PAIRS = ({"vjp", "jvp"}, {"gradient", "hessian"})  # derivatives that one check compares with each other
ARGUMENTS = {kind: [*inspect.signature(check).parameters] for kind, check in CHECKS.items()}
ALL_ARGUMENTS = sorted({*DERIVATIVES, *(name for names in ARGUMENTS.values() for name in names)})
POSITIONAL = ("f", "loss", "x", "J", "H", "quick")  # arguments of checks that are not among the options
DIRECTIONS = 3  # random directions of a complete check of a derivative of a vector function


def check_derivative(
    f: Any,
    x: Any = None,
    *,
    gradient: Any = None,
    vjp: Callable[[Any, Any], Any] | None = None,
    jvp: Callable[[Any, Any], Any] | None = None,
    jacobian: Any = None,
    hessian: Any = None,
    quick: bool = False,
    **options: Any,
) -> Audit:
    """Check the derivative that is given, or the one of the library that `f` is written with.

    Parameters
    ----------
    f : callable or object
        A loss, or a function of any shape, as for `check.vjp`.
    x : array, or tree of arrays
    gradient, vjp, jvp, jacobian, hessian : optional
        One of them, or both `vjp` and `jvp`, or both `gradient` and `hessian`. Default: the derivative by reverse mode
        of the library of `f`.
    quick : bool
        Whether fewer directions are examined.
    **options
        Passed on to the check.

    Returns
    -------
    Audit

    Raises
    ------
    TypeError
        If derivatives are given that no check compares.
    """
    __tracebackhide__ = True  # pytest shows the line of the test
    derivatives = {"gradient": gradient, "vjp": vjp, "jvp": jvp, "jacobian": jacobian, "hessian": hessian}
    names_of_derivatives = {name for name, derivative in derivatives.items() if derivative is not None}
    if len(names_of_derivatives) > 1 and names_of_derivatives not in PAIRS:
        names = " and ".join(name for name in DERIVATIVES if name in names_of_derivatives)
        raise TypeError(f"one derivative is checked at a time, got {names}; write one call for each")
    kind = _kind(f, x, names_of_derivatives, options)
    if kind == "gradient":
        with plain_numpy_refused("gradient"):
            return check_gradient(f, x, gradient, quick=quick, **options)
    if not quick:
        options = {"directions": DIRECTIONS, **options}
    if names_of_derivatives == {"gradient"}:
        return gradient_as_vjp(f, gradient, x, **options)
    if kind == "hessian":
        return check_hessian(f, hessian, x, gradient=gradient, **options)
    if kind == "jacobian":
        return check_jacobian(f, jacobian, x, **options)
    if kind == "jvp":
        return check_jvp(f, jvp, x, **options)
    return check_vjp(f, vjp, x, jvp=jvp, **options)


def _kind(f: Any, x: Any, names_of_derivatives: set[str], options: dict[str, Any]) -> str:
    """Return the check for the derivatives that are given. Raise an error for an option that it does not have."""
    __tracebackhide__ = True
    for name in options:
        if name not in ALL_ARGUMENTS:
            raise TypeError(f"no check of a derivative has the argument {name!r}{advice_near(name, ALL_ARGUMENTS)}")
    kind = next((kind for kind in ("hessian", "jacobian") if kind in names_of_derivatives), "vjp")
    if names_of_derivatives == {"jvp"}:
        kind = "jvp"
    elif (names_of_derivatives == {"gradient"} and library_of(f, *leaves(x)).name == "numpy") or (
        not names_of_derivatives and _is_loss(f, x)
    ):
        kind = "gradient"
    for name in options:
        if name not in ARGUMENTS[kind] or name in POSITIONAL:
            options_of_kind = [word for word in ARGUMENTS[kind] if word not in (*DERIVATIVES, *POSITIONAL)]
            raise TypeError(f"check.{kind} has no argument {name!r}; it takes {', '.join(options_of_kind)}")
    return kind


def _is_loss(f: Any, x: Any) -> bool:
    """Return whether f is a function with a real scalar result that is not written with torch or JAX."""
    if x is None or isinstance(f, (Operator, type)) or not callable(f) or hasattr(f, "matvec"):
        return False
    if library_of(f, *leaves(x)).name != "numpy" or any(hasattr(f, word) for word in ("vjp", "jvp")):
        return False
    value = f(copied(x))  # f may change its argument in place
    if library_of(value).name != "numpy" or isinstance(value, dict) or np.shape(value) != ():
        return False
    return np.asarray(value).dtype.kind in "biuf"
