"""The derivative rule of a linear solve whose matrix depends on parameters: s of A(p) s = b, differentiable in b and p.

    A s' = b' - A' s,       A' s the derivative of A s along p'
    b_bar = y  with  A^T y = g,         p_bar = -grad <y, A s>,  with y and s held fixed,

in the convention of tape.py for complex numbers too: plain transposes, and the real part for real values. One
solve with the transpose serves all arguments. The transposed solve has a rule of the same form: each is used in the
derivative of the other, and derivatives of every order follow.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import placed
from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.derivative import of_argument, push
from sparsedp.autodiff.tape import Rule, plain

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
    """Return the Rule of (b, *params): s of A(params) s = b, or of the transposed system.

    The Rule is created for each solve and not kept, because it holds its solver.

    Parameters
    ----------
    name : str
    solve : callable
        ``solve(transposed, checked, b, *params)`` of plain values.
    back : callable
        ``back(params, places, y, s)`` returns -grad <y, A s> in the params at these places, in their order.
    product : callable
        ``product(transposed, s, *params)`` returns A s or A^T s, differentiable in the params.
    transposed : bool
    checked : bool
        Whether b are primal data, not those of a derivative.
    """
    rule = partial(solve_rule, name, solve, back, product)

    def vjp(nums: Sequence[int], ans: Any, b: Any, *params: Any) -> Callable[[Any], tuple]:
        places = [num - 1 for num in nums if num]

        def pull(g: Any) -> tuple:
            adjoint = rule(not transposed)(g, *params)
            y, s = (ans, adjoint) if transposed else (adjoint, ans)
            slopes = []
            with np.errstate(over="ignore", invalid="ignore"):  # overflow is refused below
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

    forward = partial(solve, transposed, checked)  # the rule has the names of its arguments
    return Rule(f"{name}.T" if transposed else name, forward, vjp, jvp)


def vary(fun: Callable[..., Any], args: Sequence, places: Sequence[int]) -> tuple[Callable[[Sequence], Any], list]:
    """Return fun(*args) as a function of the list of the arguments at some places, and that list."""

    def varied(values: Sequence) -> Any:
        return fun(*placed(args, places, values))

    return varied, [args[place] for place in places]


def _finite(name: str, cotangent: Any) -> Any:
    """Refuse products of two solutions that overflow."""
    check_finite(f"a gradient of {name}", plain(cotangent), advice="; scale the loss or the right-hand side")
    return cotangent
