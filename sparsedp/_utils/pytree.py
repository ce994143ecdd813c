"""Pytrees: nested containers of arrays, their leaves and the paths of these, and the pairing of two trees.

A tree is any nesting of

- tuples and named tuples,
- lists,
- dicts and their subclasses, such as ``defaultdict`` and ``OrderedDict``; entries keep their order,
- instances of dataclasses, whose entries are their fields.

Every other object is a leaf. Objects of this library are leaves, too, and so are dataclasses that cannot be rebuilt
from their fields because they have a ``__post_init__`` or fields that are not arguments.

Two trees are always paired by `paired`: entries of dicts by key, entries of named tuples and dataclasses by field, and
entries of plain tuples and lists by position.
"""

from __future__ import annotations

from copy import copy
from functools import cached_property
from math import hypot, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp.errors import ShapeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

__all__ = [
    "TreeStructure",
    "branches_mapped",
    "child",
    "copied",
    "described",
    "field_names",
    "flatten",
    "is_branch",
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

BRANCHES = tuple, list, dict  # types of containers except dataclasses
LEAVES = {np.ndarray, float, int, str, bool, type(None), np.float64}  # the most frequent types of leaves
DEEPEST = 100  # largest depth of nested containers; deeper recursion could exceed Python's limit
# Products of four numbers between these limits, times a moderate factor, neither overflow nor underflow.
SMALL = 2.0**-200
LARGE = 2.0**200
MOST_EXPONENT = 1023  # largest exponent of a power of two that is a finite float


class TreeStructure:
    """The structure of a tree: its containers, and the leaves that are not variables.

    Variables are the leaves that may differ between two trees of the same structure. The methods return the names of
    the variables, extract the variables from a tree of this structure, and build a tree from them.

    Parameters
    ----------
    tree : tree
    root : str
        Name of the tree in error messages.
    is_variable : callable, optional
        ``is_variable(leaf)`` returns whether the leaf is a variable. Default: every leaf is a variable.
    keep : callable, optional
        ``keep(leaf)`` returns the object that is stored for a leaf that is not a variable. Default: the leaf itself.

    Attributes
    ----------
    places : list of int
        Positions of the variables among the leaves.
    statics : tuple
        All leaves, with None in place of the variables, so that the structure does not keep traces or large arrays.
    template : tree
        The tree with these leaves.
    is_leaf, is_flat : bool
        Whether the tree is a single variable, and whether it is a tuple of variables.

    Examples
    --------
    >>> structure = TreeStructure({"u": (1.0, 2.0), "n": 3}, "x", lambda leaf: isinstance(leaf, float))
    >>> structure.names
    ["x['u'][0]", "x['u'][1]"]
    >>> structure.build("ab")
    {'u': ('a', 'b'), 'n': 3}
    >>> structure.variables({"n": 0, "u": [5.0, 6.0]})
    [5.0, 6.0]
    """

    def __init__(
        self,
        tree: Any,
        root: str = "tree",
        is_variable: Callable[[Any], bool] | None = None,
        keep: Callable[[Any], Any] | None = None,
    ) -> None:
        self.root = root
        self.places: list[int] = []
        statics: list[Any] = []
        for place, leaf in enumerate(leaves(tree)):
            if is_variable is None or is_variable(leaf):
                self.places.append(place)
                statics.append(None)
            elif keep is None:
                statics.append(leaf)
            else:
                statics.append(keep(leaf))
        self.statics = tuple(statics)
        self.template = _build(tree, iter(statics))
        has_only_variables = len(self.places) == len(statics)
        self.is_leaf = has_only_variables and keys(tree) is None
        self.is_flat = has_only_variables and type(tree) is tuple and all(keys(branch) is None for branch in tree)

    @cached_property
    def labels(self) -> list[str]:
        """Names of all leaves as Python expressions, such as ``x['u'][0]``."""
        return labels(self.template, self.root)

    @cached_property
    def names(self) -> list[str]:
        """Names of the variables as Python expressions."""
        return [self.labels[place] for place in self.places]

    def names_under(self, root: str) -> list[str]:
        """Return the names of the variables of a tree with this structure whose name is `root`."""
        all_names = labels(self.template, root)
        return [all_names[place] for place in self.places]

    def variables(self, tree: Any, name: str = "tree", **options: Any) -> list:
        """Return the variables of a tree that must have this structure, in the order of the latter; see `paired`."""
        if self.is_leaf and keys(tree) is None and not options:
            return [tree]
        entries = paired(tree, self.template, name, **options)
        return [entries[place] for place in self.places]

    def build(self, variables: Sequence, statics: Sequence | None = None) -> Any:
        """Build a tree from its variables and its other leaves (`statics`; default: those of this structure)."""
        if self.is_leaf:
            return variables[0]
        if self.is_flat:
            return tuple(variables)
        if statics is None:
            statics = self.statics
        return _build(self.template, iter(placed(statics, self.places, variables)))


# ---- containers ------------------------------------------------------------------------------------------------------


def field_names(tree: Any) -> tuple[str, ...] | None:
    """Return the names of the fields of a dataclass instance that is a tree; None for all other values."""
    kind = type(tree)
    fields = getattr(kind, "__dataclass_fields__", None)
    if fields is None or hasattr(kind, "__post_init__") or kind.__module__.partition(".")[0] == "sparsedp":
        return None
    if not all(field.init for field in fields.values()):
        return None
    return tuple(fields)


def is_branch(tree: Any) -> bool:
    """Return True if a tree is a container, False if it is a leaf."""
    return isinstance(tree, BRANCHES) or field_names(tree) is not None


def keys(tree: Any) -> Any:
    """Return the keys of the entries of a container, see `child`; None for a leaf."""
    if type(tree) in LEAVES:
        return None
    if isinstance(tree, dict):
        return tree.keys()
    if isinstance(tree, (tuple, list)):
        return range(len(tree))
    return field_names(tree)


def child(tree: Any, key: Any) -> Any:
    """Return the entry of a container for one of its `keys`."""
    return tree[key] if isinstance(tree, BRANCHES) else getattr(tree, key)


def branches_mapped(function: Callable, tree: Any) -> Any:
    """Return a container of the same type and keys, with ``function(key)`` in place of each entry."""
    if isinstance(tree, dict):
        if type(tree) is dict:
            return {key: function(key) for key in tree}
        built = copy(tree)  # keeps attributes of a subclass, such as the default of a defaultdict
        for key in tree:
            built[key] = function(key)
        return built
    if not isinstance(tree, BRANCHES):
        return type(tree)(**{name: function(name) for name in keys(tree)})
    entries = [function(place) for place in range(len(tree))]
    return type(tree)(*entries) if hasattr(tree, "_fields") else type(tree)(entries)


def subscript(tree: Any, key: Any) -> str:
    """Return the Python expression for an entry of a container: ``['u']``, ``[0]``, or ``.k`` for a field."""
    if not isinstance(tree, BRANCHES):
        return f".{key}"
    fields = getattr(tree, "_fields", None)
    if fields:
        return f".{fields[key]}"
    return f"[{key!r}]"


# ---- leaves ----------------------------------------------------------------------------------------------------------


def flatten(tree: Any) -> tuple[list, Callable]:
    """Return the leaves of a tree, and a function that builds the same tree from other leaves.

    Parameters
    ----------
    tree : tree

    Returns
    -------
    entries : list
        The leaves, from left to right.
    rebuild : callable
        ``rebuild(values)`` returns the tree with these leaves, an iterable of the same length as `entries`.

    Examples
    --------
    >>> entries, rebuild = flatten({"a": (1.0, 2.0), "b": None})
    >>> entries
    [1.0, 2.0, None]
    >>> rebuild([3.0, 4.0, 5.0])
    {'a': (3.0, 4.0), 'b': 5.0}
    """
    return leaves(tree), lambda values: _build(tree, iter(values))


def leaves(tree: Any, depth: int = 0) -> list:
    """Return the leaves of a tree, from left to right.

    Parameters
    ----------
    tree : tree
    depth : int
        Number of containers that enclose the tree, in recursive calls.

    Raises
    ------
    ValueError
        If containers are nested more than `DEEPEST` deep, for example if a list contains itself.

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
    entries = []
    for name in names:
        entries += leaves(child(tree, name), depth + 1)
    return entries


def _build(tree, values):
    """Return a tree with the same structure and types, and with leaves from an iterator."""
    if keys(tree) is None:
        return next(values)
    return branches_mapped(lambda key: _build(child(tree, key), values), tree)


def placed(entries: Iterable, places: Iterable[int], values: Iterable) -> list:
    """Copy a sequence to a list, and replace the entries at some positions.

    Examples
    --------
    >>> placed((1.0, 2.0, 3.0), [0, 2], "ab")
    ['a', 2.0, 'b']
    """
    entries = list(entries)
    for place, value in zip(places, values, strict=True):
        entries[place] = value
    return entries


def copied(tree: Any) -> Any:
    """Return a tree with copies of its arrays and sparse matrices, so that the caller may modify the originals."""
    return mapped(_copied_leaf, tree)


def _copied_leaf(leaf):
    if isinstance(leaf, np.ndarray) or sp.issparse(leaf):
        return leaf.copy()
    return leaf


def mapped(function: Callable, tree: Any, *others: Any) -> Any:
    """Apply a function to every leaf of a tree, or to the corresponding leaves of several trees; return the tree.

    Examples
    --------
    >>> mapped(max, {"a": 1.0, "b": 5.0}, {"b": 3.0, "a": 2.0})
    {'a': 2.0, 'b': 5.0}
    """
    if keys(tree) is None:
        return function(tree, *others)
    return _build(tree, map(function, leaves(tree), *(paired(other, tree, "tree") for other in others)))


def labels(tree: Any, root: str) -> list[str]:
    """Return the names of the leaves of a tree as Python expressions, from left to right.

    Examples
    --------
    >>> labels({"u": (1.0, 2.0), "n": 3}, "x")
    ["x['u'][0]", "x['u'][1]", "x['n']"]
    """
    names = keys(tree)
    if names is None:
        return [root]
    return [label for name in names for label in labels(child(tree, name), root + subscript(tree, name))]


def described(tree: Any) -> str:
    """Return a description of a tree for error messages: its type and its size or keys."""
    if isinstance(tree, dict):
        return f"a dict of {', '.join(map(str, tree)) or 'nothing'}"
    if isinstance(tree, (tuple, list)):
        return f"a {type(tree).__name__} of length {len(tree)}"
    fields = field_names(tree)
    if fields is not None:
        return f"a {type(tree).__name__} of {', '.join(fields) or 'nothing'}"
    if hasattr(tree, "shape") or isinstance(tree, (float, complex)):
        return f"an array of shape {np.shape(tree)}"
    return getattr(tree, "described", type(tree).__name__)


# ---- pairs of trees --------------------------------------------------------------------------------------------------


def paired(
    tree: Any,
    reference: Any,
    name: str,
    owner: str = "",
    advice: str = "",
    shapes: bool = False,
    prefix: Callable | None = None,
    error: type[Exception] = ShapeError,
) -> list:
    """Return the leaves of a tree in the order of the leaves of a reference tree.

    Entries of dicts are paired by key, regardless of their order, entries of named tuples and dataclasses by field, and
    entries of plain tuples and lists by position.

    Parameters
    ----------
    tree, reference : trees
    name : str
        Name of the tree, with which paths in error messages begin: ``name['u'][0]``.
    owner : str
        Text after the path in error messages, such as " of stepper(heun)".
    advice : str
        End of error messages.
    shapes : bool
        Whether leaves must have the same shapes as the leaves of the reference.
    prefix : callable, optional
        ``prefix(leaf)`` returns whether this leaf may stand for a whole branch of the reference. It is then repeated
        for each leaf of the branch. By default no leaf may.
    error : type
        Type of the exception that is raised.

    Returns
    -------
    list

    Raises
    ------
    ShapeError
        If a key is missing or unknown, or if the type of a container or the shape of a leaf differs. The message
        contains the path. With the argument `error` an exception of that type is raised instead.

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


def is_uniform(leaf: Any) -> bool:
    """Return True if a leaf is one number or None, which may stand for a whole branch."""
    return leaf is None or (np.ndim(leaf) == 0 and np.asarray(leaf).dtype.kind in "biufc")


class _MismatchError(Exception):
    """Raised if two branches cannot be paired, with the reason and the subscripts of the path, the innermost first."""

    def __init__(self, words):
        super().__init__(words)
        self.words = words
        self.subscripts: list[str] = []


def _pair(tree, reference, shapes, prefix):
    """Return the leaves of a branch in the order of a reference branch."""
    names = keys(reference)
    if names is None:
        if keys(tree) is not None:
            raise _MismatchError(f"expected one array or number, got {described(tree)}")
        if shapes and np.shape(tree) != np.shape(reference):
            raise _MismatchError(f"expected shape {np.shape(reference)}, got {np.shape(tree)}")
        return [tree]
    if prefix and keys(tree) is None and prefix(tree):
        return [tree] * len(leaves(reference))
    if keys(tree) is None or _kind(tree) is not _kind(reference):
        raise _MismatchError(f"expected {described(reference)}, got {described(tree)}")
    entries = []
    for name, place in zip(names, _places(tree, reference)):
        branch = child(tree, place)
        reference_branch = child(reference, name)
        if not (shapes or is_branch(branch) or is_branch(reference_branch)):  # the most frequent case
            entries.append(branch)
            continue
        try:
            entries += _pair(branch, reference_branch, shapes, prefix)
        except _MismatchError as mismatch:
            mismatch.subscripts.append(subscript(reference, name))
            raise
    return entries


def _kind(tree):
    """Return the type of container with which a container can be paired; `object` for dataclasses."""
    if isinstance(tree, dict):
        return dict
    if isinstance(tree, (tuple, list)):
        return tuple
    return object


def _places(tree, reference):
    """Return the keys of a container in the order of the entries of a reference container."""
    if isinstance(reference, dict):
        if tree.keys() != reference.keys():
            _check_names("key", tree, reference)
        return reference.keys()
    if not isinstance(reference, BRANCHES):
        _check_names("field", keys(tree), keys(reference))
        return keys(reference)
    fields = getattr(tree, "_fields", None)
    wanted_fields = getattr(reference, "_fields", None)
    if fields and wanted_fields and fields != wanted_fields:
        _check_names("field", fields, wanted_fields)
        return [fields.index(field) for field in wanted_fields]
    if len(tree) != len(reference):
        raise _MismatchError(f"expected {described(reference)}, got {described(tree)}")
    return range(len(reference))


def _check_names(kind, names, expected):
    """Raise an error for unknown and missing names."""
    unknown = [repr(name) for name in names if name not in expected]
    missing = [repr(name) for name in expected if name not in names]
    if unknown:
        problem = f"unknown {kind}{'s' if len(unknown) > 1 else ''} {', '.join(unknown)}"
    elif missing:
        problem = f"missing {kind}{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
    else:
        return
    raise _MismatchError(f"{problem}; expected {', '.join(map(repr, expected)) or 'none'}")


# ---- norms -----------------------------------------------------------------------------------------------------------


def norm(tree: Any) -> float:
    """Return the Euclidean norm of the entries of all leaves, without overflow or underflow of squares.

    Parameters
    ----------
    tree : tree of arrays and numbers
        Real or complex; leaves that are None are ignored.

    Returns
    -------
    float
        Infinity or NaN if a leaf contains one.

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


def power_of_two(value: float) -> float:
    """Return the next larger power of two, at most 2**1023, or 1 for 0; division by it is exact."""
    if value <= 0:
        return 1.0
    exponent = np.frexp(value)[1]
    return float(np.ldexp(1.0, min(exponent, MOST_EXPONENT)))


def safe_unit(size: float) -> float:
    """Return a power of two near a size if its square could underflow or overflow, else 1."""
    if SMALL < size < LARGE:
        return 1.0
    return power_of_two(size)
