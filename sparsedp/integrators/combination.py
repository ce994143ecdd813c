"""Arithmetic on states: an array, or any tree of arrays, plus multiples of others."""

import numpy as np

from sparsedp.errors import ShapeError
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
    found, rebuild = flatten(u)
    for factor, tree in pairs:
        others = leaves(tree)
        _check(found, others)
        found = [leaf if leaf is None else leaf + factor * other for leaf, other in zip(found, others, strict=True)]
    return rebuild(found)


def _check(found, others):
    """Broadcasting a rate into a state would hide a mistake."""
    shapes = [np.shape(plain(leaf)) for leaf in found]
    theirs = [np.shape(plain(leaf)) for leaf in others]
    if shapes != theirs:
        raise ShapeError(f"a rate must have the shape of the state, {_words(shapes)}, got {_words(theirs)}")


def _words(shapes):
    return ", ".join(map(str, shapes)) or "nothing"


def like(new, u):
    """The new state in the dtypes of the old one: rates in double precision do not widen a float32 state."""
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
    found, rebuild = flatten(tree)
    return rebuild(map(_view, found))


def _view(leaf):
    if type(leaf) is not np.ndarray or not leaf.flags.writeable:
        return leaf
    view = leaf.view()
    view.flags.writeable = False
    return view


def untraced(tree):
    """The same tree without a trace."""
    found, rebuild = flatten(tree)
    return rebuild(map(plain, found))
