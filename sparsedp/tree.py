"""Nested containers of arrays: taken apart into leaves, put together again, and measured.

A tree is any nesting of tuples (named ones too), lists and dicts. Everything else is a leaf.
Dict entries keep their order.
"""

from math import hypot, isfinite

import numpy as np
import scipy.sparse as sp

from sparsedp.errors import ShapeError

__all__ = [
    "copied",
    "flatten",
    "keys",
    "labels",
    "leaves",
    "leaves_like",
    "mapped",
    "norm",
    "placed",
    "power_of_two",
    "subscript",
]


def flatten(tree):
    """Tree -> (list of leaves, function that builds the same tree from other leaves).

    Parameters
    ----------
    tree : any nesting of tuple, list and dict

    Returns
    -------
    entries : list
        The leaves, from left to right.
    rebuild : callable
        ``rebuild(entries)`` is equal to ``tree``; it takes any iterable of as many leaves.

    Examples
    --------
    >>> entries, rebuild = flatten({"a": (1.0, 2.0), "b": None})
    >>> entries
    [1.0, 2.0, None]
    >>> rebuild([3.0, 4.0, 5.0])
    {'a': (3.0, 4.0), 'b': 5.0}
    """
    return leaves(tree), lambda values: _build(tree, iter(values))


def placed(entries, places, values):
    """A sequence as a list with other values at some places.

    Examples
    --------
    >>> placed((1.0, 2.0, 3.0), [0, 2], "ab")
    ['a', 2.0, 'b']
    """
    entries = list(entries)
    for place, value in zip(places, values, strict=True):
        entries[place] = value
    return entries


def copied(tree):
    """Tree -> the same tree with copies of its arrays and sparse matrices: the caller may reuse them."""
    return mapped(lambda leaf: leaf.copy() if isinstance(leaf, np.ndarray) or sp.issparse(leaf) else leaf, tree)


def mapped(function, tree, *others):
    """function(leaf) in the place of every leaf, or function(leaf, other, ...) over trees of as many leaves.

    Examples
    --------
    >>> mapped(max, {"a": 1.0, "b": 5.0}, (2.0, 3.0))
    {'a': 2.0, 'b': 5.0}
    """
    if not isinstance(tree, (tuple, list, dict)):
        return function(tree, *others)
    return _build(tree, map(function, leaves(tree), *map(leaves, others)))


def leaves(tree):
    """Tree -> list of its leaves, from left to right.

    Parameters
    ----------
    tree : any nesting of tuple, list and dict

    Returns
    -------
    list

    Examples
    --------
    >>> leaves([1, (2, {"x": 3})])
    [1, 2, 3]
    """
    names = keys(tree)
    return [tree] if names is None else [leaf for name in names for leaf in leaves(tree[name])]


def leaves_like(tree, other, what, wanted):
    """Leaves of a tree in the order of another one's: by name where both are dicts, and other names are refused.

    Parameters
    ----------
    tree, other : trees
    what, wanted : str
        What they are called in messages.

    Examples
    --------
    >>> leaves_like({"v": 2.0, "u": 1.0}, {"u": None, "v": None}, "the rate", "the state")
    [1.0, 2.0]
    """
    names, others = keys(tree), keys(other)
    if isinstance(tree, dict) and isinstance(other, dict) and names != others:
        raise ShapeError(f"{what} must have the names of {wanted}, {[*others]}, got {[*names]}")
    if names is None or others is None or set(names) != set(others):
        return leaves(tree)
    return [leaf for name in others for leaf in leaves_like(tree[name], other[name], what, wanted)]


def labels(tree, root):
    """Tree and its name -> the names of its leaves, from left to right, as one would write them.

    Examples
    --------
    >>> labels({"u": (1.0, 2.0), "n": 3}, "x")
    ["x['u'][0]", "x['u'][1]", "x['n']"]
    """
    names = keys(tree)
    if names is None:
        return [root]
    return [label for name in names for label in labels(tree[name], root + subscript(tree, name))]


def subscript(tree, name):
    """A branch and a key of it -> how one would write the entry: ``['u']``, ``[0]``, ``.k`` of a named tuple."""
    fields = getattr(tree, "_fields", None)
    return f".{fields[name]}" if fields else f"[{name!r}]"


def norm(tree):
    """Tree -> Euclidean norm over the numbers of all leaves, without overflow or underflow.

    Parameters
    ----------
    tree : any nesting of tuple, list and dict
        Of arrays and numbers, real or complex; None counts for nothing.

    Returns
    -------
    float
        Infinite or NaN where a leaf is.

    Examples
    --------
    >>> norm([3e200, None, np.array([0.0, 4e200])])
    5.00e+200
    """
    arrays = [leaf if hasattr(leaf, "shape") else np.asarray(leaf) for leaf in leaves(tree) if leaf is not None]
    largest = max((float(np.max(np.abs(a), initial=0.0)) for a in arrays), default=0.0)
    if largest == 0 or not isfinite(largest):
        return largest
    return largest * hypot(*(float(np.linalg.norm(a / largest)) for a in arrays))


def power_of_two(value):
    """The power of two next above, so that dividing by it changes no digits."""
    return 2.0 ** float(np.clip(np.frexp(value)[1], -900, 900)) if value > 0 else 1.0


def keys(tree):
    """The keys of the branches of a tree; None of a leaf."""
    if isinstance(tree, dict):
        return tree.keys()
    return range(len(tree)) if isinstance(tree, (tuple, list)) else None


def _build(tree, values):
    if isinstance(tree, dict):
        return type(tree)((key, _build(branch, values)) for key, branch in tree.items())
    if isinstance(tree, (tuple, list)):
        branches = [_build(branch, values) for branch in tree]
        return type(tree)(*branches) if hasattr(tree, "_fields") else type(tree)(branches)
    return next(values)
