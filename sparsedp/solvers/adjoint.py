"""The derivative rule of a linear solve A(p) s = b: the solution s is differentiable in b and in the parameters p.

    JVP:  A s' = b' - A' s,  where A' s is the derivative of A s along p' for constant s
    VJP:  A^T y = g,  b_bar = y,  p_bar = -grad_p <y, A s>  for constant y and s

Complex numbers follow the convention of tape.py: transposes are not conjugated, and the cotangent of a real argument
is real. One solve with the transpose gives the cotangents of all arguments. The transposed solve has a rule of the same
form. Each of the two rules uses the other in its derivative, so derivatives of every order exist.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import placed
from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.derivative import of_argument, push
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import Rule

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

__all__ = ["solve_rule", "vary"]


def solve_rule(
    name: str,
    solve: Callable[..., Any],
    back: Callable[[tuple, list[int], Any, Any], Iterable],
    product: Callable[..., Any],
    transposed: bool = False,
    checked: bool = False,
) -> Rule:
    """Return the derivative Rule that maps (b, *params) to the solution s of A(params) s = b or of its transpose.

    A Rule is created for each solve and is not stored, because it references the solver.

    Parameters
    ----------
    name : str
    solve : callable
        ``solve(transposed, checked, b, *params)`` returns s; no argument is traced.
    back : callable
        ``back(params, places, y, s)`` returns the gradients of -<y, A s> with respect to ``params[place]`` for each
        place in `places`, in this order.
    product : callable
        ``product(transposed, s, *params)`` returns A s or A^T s, and is differentiable in the params.
    transposed : bool
    checked : bool
        Whether b is a right-hand side of the user. False for the solves of derivatives.
    """
    rule = partial(solve_rule, name, solve, back, product)

    def vjp(nums: Sequence[int], ans: Any, b: Any, *params: Any) -> Callable[[Any], tuple]:
        places = [num - 1 for num in nums if num]

        def pull(g: Any) -> tuple:
            adjoint = rule(not transposed)(g, *params)
            y, s = (ans, adjoint) if transposed else (adjoint, ans)
            slopes = []
            with np.errstate(over="ignore", invalid="ignore"):  # _finite raises an error on overflow
                if not nums[0]:
                    slopes.append(of_argument(adjoint, b))
                if places:
                    slopes.extend(back(params, places, y, s))
            return tuple(_finite(name, slope) for slope in slopes)

        return pull

    def jvp(nums: Sequence[int], tangents: Sequence, ans: Any, b: Any, *params: Any) -> Any:
        places = [num - 1 for num in nums if num]
        total = 0.0 if nums[0] else tangents[0]
        if places:
            varied, values = vary(lambda *params: product(transposed, ans, *params), params, places)
            _, change = push(varied, values, tangents[-len(places) :])
            total = total - change
        return rule(transposed)(total, *params)

    forward = partial(solve, transposed, checked)  # Rule reads its signature: (b, *params)
    return Rule(f"{name}.T" if transposed else name, forward, vjp, jvp)


def vary(fun: Callable[..., Any], args: Sequence, places: Sequence[int]) -> tuple[Callable[[Sequence], Any], list]:
    """Return `fun` as a function of a list of the arguments at `places` only, and the list of their values."""

    def varied(values: Sequence) -> Any:
        return fun(*placed(args, places, values))

    return varied, [args[place] for place in places]


def _finite(name: str, cotangent: Any) -> Any:
    """Return the cotangent; raise NonFiniteError if it overflowed."""
    advice = "; scale the loss or the right-hand side"
    check_values(partial(check_finite, f"a gradient of {name}", advice=advice), cotangent)
    return cotangent
