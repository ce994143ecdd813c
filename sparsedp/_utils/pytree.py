"""Nested containers of arrays: taken apart into leaves, put together again, paired with each other, and measured.

A tree is any nesting of tuples (named ones too), lists and dicts (``defaultdict``, ``OrderedDict`` and other subclasses
too). Everything else is a leaf. Entries of dicts keep their order.

Two trees are always paired by `paired`: entries of dicts by key, those of named tuples by field, and only those of
plain tuples and lists by position.
"""

from copy import copy
from math import hypot, isfinite

import numpy as np
import scipy.sparse as sp

from sparsedp.errors import ShapeError

__all__ = [
    "branches_mapped",
    "copied",
    "described",
    "flatten",
    "is_uniform",
    "keys",
    "labels",
    "leaves",
    "mapped",
    "norm",
    "paired",
    "placed",
    "power_of_two",
    "safe_unit",
    "subscript",
]

BRANCHES = tuple, list, dict  # types of what is not a leaf
DEEPEST = 100  # containers in containers: recursions over deeper trees would leave Python's limit
SMALL, LARGE = 2.0**-200, 2.0**200  # between these, products of four numbers and a few more are floats
MOST_EXPONENT = 1023  # of a power of two that is a float


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
    """Apply a function to every leaf of a tree, or to the leaves of several trees that are paired with the first one.

    Examples
    --------
    >>> mapped(max, {"a": 1.0, "b": 5.0}, {"b": 3.0, "a": 2.0})
    {'a': 2.0, 'b': 5.0}
    """
    if not isinstance(tree, BRANCHES):
        return function(tree, *others)
    return _build(tree, map(function, leaves(tree), *(paired(other, tree, "tree") for other in others)))


def leaves(tree, depth=0):
    """Tree -> list of its leaves, from left to right.

    Parameters
    ----------
    tree : any nesting of tuple, list and dict
    depth : int
        How many containers it is in.

    Returns
    -------
    list

    Raises
    ------
    ValueError
        If containers are nested too deep, as those that contain themselves.

    Examples
    --------
    >>> leaves([1, (2, {"x": 3})])
    [1, 2, 3]
    """
    names = keys(tree)
    if names is None:
        return [tree]
    if depth >= DEEPEST:
        raise ValueError(
            f"a tree has containers nested more than {DEEPEST} deep, or one that contains itself; flatten it"
        )
    return [leaf for name in names for leaf in leaves(tree[name], depth + 1)]


def paired(tree, reference, name, owner="", advice="", shapes=False, prefix=None, error=ShapeError):
    """Return the leaves of a tree in the order of the leaves of a reference tree.

    Entries of dicts are paired by key, whatever their order, those of named tuples by field, and those of plain tuples
    and lists by position.

    Parameters
    ----------
    tree, reference : trees
    name : str
        Root of the paths in messages: ``name['u'][0]``.
    owner : str
        Follows a path in messages, such as " of stepper(heun)".
    advice : str
        Ends a message.
    shapes : bool
        Whether leaves must have the shapes of those of the reference.
    prefix : callable, optional
        ``prefix(leaf)``: whether this leaf may stand for a whole branch of the reference; it is then repeated for each
        of its leaves. Default: none may.
    error : type
        What is raised.

    Returns
    -------
    list

    Raises
    ------
    ShapeError
        Or `error`, if a key is missing or unknown, or a branch or the shape of a leaf differs. The message gives the
        path.

    Examples
    --------
    >>> paired({"v": 2.0, "u": 1.0}, {"u": None, "v": None}, "rate")
    [1.0, 2.0]
    >>> paired({"v": 2.0, "u": 1.0}, {"u": None, "v": (None, None)}, "floor", prefix=is_uniform)
    [1.0, 2.0, 2.0]
    """
    try:
        return _pair(tree, reference, shapes, prefix)
    except _MismatchError as mismatch:
        path = name + "".join(reversed(mismatch.subscripts))
        raise error(f"{path}{owner}: {mismatch.words}{advice}") from None


def is_uniform(leaf):
    """Whether a leaf is one number or None, which may stand for a whole branch."""
    return leaf is None or (np.ndim(leaf) == 0 and np.asarray(leaf).dtype.kind in "biufc")


class _MismatchError(Exception):
    """Two branches cannot be paired: why, and the subscripts that lead to them, the innermost first."""

    def __init__(self, words):
        super().__init__(words)
        self.words, self.subscripts = words, []


def _pair(tree, reference, shapes, prefix):
    """The recursion of `paired`."""
    names = keys(reference)
    if names is None:
        if keys(tree) is not None:
            raise _MismatchError(f"expected one array or number, got {described(tree)}")
        if shapes and np.shape(tree) != np.shape(reference):
            raise _MismatchError(f"expected shape {np.shape(reference)}, got {np.shape(tree)}")
        return [tree]
    if prefix and keys(tree) is None and prefix(tree):
        return [tree] * len(leaves(reference))
    if keys(tree) is None or isinstance(tree, dict) != isinstance(reference, dict):
        raise _MismatchError(f"expected {described(reference)}, got {described(tree)}")
    entries = []
    for name, place in zip(names, _places(tree, reference)):
        branch, wanted = tree[place], reference[name]
        if not (shapes or isinstance(branch, BRANCHES) or isinstance(wanted, BRANCHES)):  # most often: quickly
            entries.append(branch)
            continue
        try:
            entries += _pair(branch, wanted, shapes, prefix)
        except _MismatchError as mismatch:
            mismatch.subscripts.append(subscript(reference, name))
            raise
    return entries


def _places(tree, reference):
    """Where a branch holds the entries of a reference branch, in the order of the reference."""
    if isinstance(reference, dict):
        if tree.keys() != reference.keys():
            _check_names("key", tree, reference)
        return reference.keys()
    fields, others = getattr(tree, "_fields", None), getattr(reference, "_fields", None)
    if fields and others and fields != others:
        _check_names("field", fields, others)
        return [fields.index(field) for field in others]
    if len(tree) != len(reference):
        raise _MismatchError(f"expected {described(reference)}, got {described(tree)}")
    return range(len(reference))


def _check_names(kind, given, wanted):
    """Refuse unknown and missing names."""
    unknown = [repr(name) for name in given if name not in wanted]
    missing = [repr(name) for name in wanted if name not in given]
    if not (unknown or missing):
        return
    problem, names = ("unknown", unknown) if unknown else ("missing", missing)
    plural = "s" if len(names) > 1 else ""
    expected = ", ".join(map(repr, wanted)) or "none"
    raise _MismatchError(f"{problem} {kind}{plural} {', '.join(names)}; expected {expected}")


def described(tree):
    """Say in words what a tree is: its kind, and how large it is."""
    if isinstance(tree, dict):
        return f"a dict of {', '.join(map(str, tree)) or 'nothing'}"
    if isinstance(tree, (tuple, list)):
        return f"a {type(tree).__name__} of length {len(tree)}"
    is_array = hasattr(tree, "shape") or isinstance(tree, (float, complex))
    return f"an array of shape {np.shape(tree)}" if is_array else getattr(tree, "described", type(tree).__name__)


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
    """Return the next larger power of two that is a float; dividing by it changes no digits. 1 for 0."""
    return float(np.ldexp(1.0, min(np.frexp(value)[1], MOST_EXPONENT))) if value > 0 else 1.0


def safe_unit(size):
    """Return a power of two near a size whose square may underflow or overflow; 1 where it does not."""
    return 1.0 if SMALL < size < LARGE else power_of_two(size)


def keys(tree):
    """The keys of the branches of a tree; None of a leaf."""
    if isinstance(tree, dict):
        return tree.keys()
    return range(len(tree)) if isinstance(tree, (tuple, list)) else None


def branches_mapped(function, tree):
    """A branch of the same type and keys, with ``function(key)`` in place of each entry."""
    if isinstance(tree, dict):
        if type(tree) is dict:
            return {key: function(key) for key in tree}
        built = copy(tree)  # keeps what a subclass knows beside its entries, such as a default
        for key in tree:
            built[key] = function(key)
        return built
    entries = [function(place) for place in range(len(tree))]
    return type(tree)(*entries) if hasattr(tree, "_fields") else type(tree)(entries)


def _build(tree, values):
    """A tree of the same structure and types, its leaves taken from an iterator."""
    if keys(tree) is None:
        return next(values)
    return branches_mapped(lambda key: _build(tree[key], values), tree)
