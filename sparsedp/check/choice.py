"""Choose the check for the derivative that is given: the same for assertions in tests and for the command line."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from sparsedp._utils.calls import advice_near
from sparsedp._utils.pytree import copied
from sparsedp.check.derivatives import hessian as check_hessian
from sparsedp.check.derivatives import jacobian as check_jacobian
from sparsedp.check.derivatives import jvp as check_jvp
from sparsedp.check.derivatives import vjp as check_vjp
from sparsedp.check.gradient_check import Audit
from sparsedp.check.gradient_check import gradient as check_gradient
from sparsedp.check.programs import library_of
from sparsedp.operators.operator import Operator

__all__ = ["DERIVATIVES", "check_derivative"]

DERIVATIVES = ("gradient", "vjp", "jvp", "jacobian", "hessian")
CHECKS = (check_gradient, check_vjp, check_jvp, check_jacobian, check_hessian)
PAIRS = ({"vjp", "jvp"}, {"gradient", "hessian"})  # derivatives that one check compares with each other
ARGUMENTS = sorted({name for check in CHECKS for name in inspect.signature(check).parameters} | set(DERIVATIVES))
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
    derivatives = {"gradient": gradient, "vjp": vjp, "jvp": jvp, "jacobian": jacobian, "hessian": hessian}
    given = {name for name, derivative in derivatives.items() if derivative is not None}
    if len(given) > 1 and given not in PAIRS:
        names = " and ".join(name for name in DERIVATIVES if name in given)
        raise TypeError(f"one derivative is checked at a time, got {names}; write one call for each")
    for name in options:
        if name not in ARGUMENTS:
            raise TypeError(f"no check of a derivative has the argument {name!r}{advice_near(name, ARGUMENTS)}")
    if given == {"gradient"} or (not given and _is_loss(f, x)):
        return check_gradient(f, x, gradient, quick=quick, **options)
    if not quick:
        options = {"directions": DIRECTIONS, **options}
    if "hessian" in given:
        return check_hessian(f, hessian, x, gradient=gradient, **options)
    if "jacobian" in given:
        return check_jacobian(f, jacobian, x, **options)
    if given == {"jvp"}:
        return check_jvp(f, jvp, x, **options)
    return check_vjp(f, vjp, x, jvp=jvp, **options)


def _is_loss(f: Any, x: Any) -> bool:
    """Return whether f is a function with a real scalar result that is not written with torch or JAX."""
    if x is None or isinstance(f, Operator) or not callable(f) or hasattr(f, "matvec"):
        return False
    if library_of(f, x).name != "numpy":
        return False
    value = f(copied(x))  # f may change its argument in place
    return library_of(value).name == "numpy" and np.shape(value) == () and np.isrealobj(value)
