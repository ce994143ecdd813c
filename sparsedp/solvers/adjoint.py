"""The rule of a linear solve whose matrix depends on parameters: s of A(p) s = b, differentiable in b and p.

    A s' = b' - A' s,       A' s the derivative of A s along p'
    b_bar = y  with  A^T y = g,         p_bar = -grad <y, A s>,  with y and s held fixed,

in the convention of tape.py for complex numbers too: plain transposes, and the real part for what is real. So one
solve with the transpose serves all arguments. The transposed solve is a rule of the same form: each is the other's
helper, and derivatives of every order follow.
"""

from functools import partial

import numpy as np

from sparsedp._utils.pytree import placed
from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.derivative import of_argument, push
from sparsedp.autodiff.tape import Rule, plain

__all__ = ["solve_rule", "vary"]


def solve_rule(name, solve, back, product, transposed=False, checked=False):
    """The Rule of (b, *params): s of A(params) s = b, or of the transposed system. It is not kept: it holds its solver.

    Parameters
    ----------
    name : str
    solve : callable
        ``solve(transposed, checked, b, *params)``, of plain values. `checked`: b are primal data, not a derivative.
    back : callable
        ``back(params, places, y, s)``: -grad <y, A s> in the params at these places, one after the other.
    product : callable
        ``product(transposed, s, *params)``: A s or A^T s, differentiable in the params.
    """
    helper = partial(solve_rule, name, solve, back, product)

    def vjp(nums, ans, b, *params):
        places = [num - 1 for num in nums if num]

        def pull(g):
            other = helper(not transposed)(g, *params)
            y, s = (ans, other) if transposed else (other, ans)
            with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused
                slopes = list(back(params, places, y, s)) if places else []
                slopes = slopes if nums[0] else [of_argument(other, b), *slopes]
            return tuple(_finite(name, slope) for slope in slopes)

        return pull

    def jvp(nums, tangents, ans, b, *params):
        places, total = [num - 1 for num in nums if num], 0.0 if nums[0] else tangents[0]
        if places:
            varied, chosen = vary(lambda *params: product(transposed, ans, *params), params, places)
            total = total - push(varied, chosen, tangents[-len(places) :])[1]
        return helper(transposed)(total, *params)

    forward = partial(solve, transposed, checked)  # the rule has the names of its arguments
    return Rule(f"{name}.T" if transposed else name, forward, vjp, jvp)


def vary(fun, args, places):
    """fun(*args) -> (function of the list of the arguments at `places`, that list)."""
    return lambda chosen: fun(*placed(args, places, chosen)), [args[place] for place in places]


def _finite(name, cotangent):
    """Refuse products of two solutions that overflow."""
    check_finite(f"a gradient of {name}", plain(cotangent), advice="; scale the loss or the right-hand side")
    return cotangent
