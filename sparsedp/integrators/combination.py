"""Arithmetic on states: an array, or any tree of arrays, plus multiples of others."""

import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.fields import frozen as frozen_array
from sparsedp.tape import cast, dtype_of, is_variable, plain
from sparsedp.tree import flatten, leaves

__all__ = ["combine", "frozen", "like", "untraced"]


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
    shape = getattr(leaf, "shape", None)
    return shape is not None and getattr(rate, "shape", None) == shape


def _checked(found, tree):
    """The leaves of a rate. Broadcasting it into a state would hide a mistake."""
    others = leaves(tree)
    shapes = [np.shape(plain(leaf)) for leaf in found]
    theirs = [np.shape(plain(leaf)) for leaf in others]
    if shapes != theirs:
        raise ShapeError(f"a rate must have the shape of the state, {_words(shapes)}, got {_words(theirs)}")
    return others


def _sum(leaf, factors, rates):
    """leaf + the sum of factor * rate."""
    if leaf is None:
        return None
    for factor, rate in zip(factors, rates, strict=True):
        leaf = leaf + factor * rate
    return leaf


def _words(shapes):
    return ", ".join(map(str, shapes)) or "nothing"


def like(new, u):
    """The new state in the dtypes of the old one: rates in double precision do not widen a float32 state."""
    if not isinstance(new, (tuple, list, dict)):
        return new if dtype_of(new) == dtype_of(u) else _rounded(new, u)
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
