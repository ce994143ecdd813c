"""Arithmetic on states: an array, or any tree of arrays, plus multiples of others."""

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.fields import frozen as frozen_array
from sparsedp.tape import Rule, cast, dtype_of, is_variable, isbox, plain
from sparsedp.tree import flatten, leaves

__all__ = ["combine", "frozen", "like", "untraced"]

# u + sum of f_i r_i  has  u_bar = g,  r_i_bar = f_i g  and the tangent  u' + sum of f_i r_i'.


def combine(u, *pairs):
    """u + the sum of factor * tree over the pairs (factor, tree), leaf by leaf.

    Parameters
    ----------
    u : tree of arrays
    *pairs : (number or traced number, tree of arrays like u)

    Returns
    -------
    tree like u

    Examples
    --------
    >>> combine((1.0, 2.0), (0.5, (4.0, 8.0)))
    (3.0, 6.0)
    """
    factors = tuple(factor for factor, _ in pairs)
    if not isinstance(u, (tuple, list, dict)):
        rates = [tree for _, tree in pairs]
        if not all(_matches(u, rate) for rate in rates):
            rates = [_checked([u], tree)[0] for tree in rates]
        return _sum(u, factors, rates)
    found, rebuild = flatten(u)
    columns = [_checked(found, tree) for _, tree in pairs]
    return rebuild(_sum(leaf, factors, [rates[n] for rates in columns]) for n, leaf in enumerate(found))


def _matches(leaf, rate):
    """The common case: one array, and a rate of its shape."""
    return hasattr(rate, "shape") and hasattr(leaf, "shape") and rate.shape == leaf.shape


def _checked(found, tree):
    """The leaves of a rate. Broadcasting it into a state would hide a mistake."""
    others = leaves(tree)
    shapes = [np.shape(plain(leaf)) for leaf in found]
    theirs = [np.shape(plain(leaf)) for leaf in others]
    if shapes != theirs:
        raise ShapeError(f"a rate must have the shape of the state, {_words(shapes)}, got {_words(theirs)}")
    return others


def _sum(leaf, factors, rates):
    """leaf + the sum of factor * rate: on the tape one node, where only arrays are traced."""
    if leaf is None:
        return None
    if (isbox(leaf) or any(map(isbox, rates))) and not any(map(isbox, factors)):
        return SUM(factors, leaf, *rates)
    for factor, rate in zip(factors, rates, strict=True):
        leaf = leaf + factor * rate
    return leaf


def _total(factors, leaf, *rates):
    return _sum(leaf, factors, rates)


def _total_vjp(nums, ans, factors, leaf, *rates):
    def pull(g):
        return tuple(g if num == 1 else _real_as(factors[num - 2] * g, rates[num - 2]) for num in nums)

    return pull


def _total_jvp(nums, tangents, ans, factors, leaf, *rates):
    total = sum(t if num == 1 else factors[num - 2] * t for num, t in zip(nums, tangents, strict=True))
    return total if dtype_of(total) == dtype_of(ans) else cast(total, dtype_of(ans))


def _real_as(g, value):
    """What a real rate of a complex state gets is the real part."""
    return anp.real(g) if dtype_of(g).kind == "c" != dtype_of(value).kind else g


SUM = Rule("stages", _total, _total_vjp, _total_jvp)


def _words(shapes):
    return ", ".join(map(str, shapes)) or "nothing"


def like(new, u):
    """The new state in the dtypes of the old one: rates in double precision do not widen a float32 state."""
    if type(new) is type(u) is np.ndarray and new.dtype == u.dtype:
        return new
    found, rebuild = flatten(new)
    return rebuild(_rounded(leaf, old) for leaf, old in zip(found, leaves(u), strict=True))


def _rounded(leaf, old):
    kind = dtype_of(old)
    if not is_variable(old) or dtype_of(leaf) == kind:
        return leaf
    if dtype_of(leaf).kind == "c" != kind.kind:
        raise TypeError(f"a rate of complex numbers needs a complex state, got {kind}; write u.astype(complex)")
    return cast(leaf, kind)


def frozen(tree):
    """The same tree with arrays that nobody can write into: a rate must not change the state."""
    if not isinstance(tree, (tuple, list, dict)):
        return frozen_array(tree)
    found, rebuild = flatten(tree)
    return rebuild(map(frozen_array, found))


def untraced(tree):
    """The same tree without a trace."""
    found, rebuild = flatten(tree)
    return rebuild(map(plain, found))
