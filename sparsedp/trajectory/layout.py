"""Where the numbers of a state lie in its tree, and whether another tree has the same form."""

from functools import cached_property
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import described, flatten, keys, labels, leaves, paired
from sparsedp._utils.validation import check_finite, check_leaves, check_native, hidden_leaves
from sparsedp.autodiff.backend import array_types, as_field, is_distributed
from sparsedp.autodiff.derivative import is_finite
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, plain, split_boxes, traces_of
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import DerivativeError, ShapeError

__all__ = [
    "Layout", "dense", "fingerprint", "folded", "owned", "refuse_lost", "refuse_mask", "stacked",
]  # fmt: skip


FOLD = 509  # words to a line of a fingerprint: a prime, so that a field that was shifted has another one


class Layout:
    """The form of a tree: which leaves are variables (floating numbers and arrays) and which stay as they are.

    Parameters
    ----------
    tree : any nesting of arrays, tuples, lists and dicts
    root : str
        What messages call it.

    Attributes
    ----------
    places : list of int
        Numbers of the variable leaves.
    statics : tuple
        All leaves, None in place of the variables.
    labels, names : lists of str
        Of all leaves and of the variables, as one would write them: ``state["ink"][0]``.
    bare, flat : bool
        The tree is one variable leaf and nothing else, or a tuple of such leaves.
    open : bool
        Some branch is a dict or a list, whose entries could be changed.
    shapes, dtypes, floats : list
        Of the variable leaves.
    nbytes : int
        Of all of them.
    rounds : bool
        Whether a step may widen float32 to float64, and is rounded: beside numbers of Python, which are
        traced as float64, autograd widens what NumPy does not.
    """

    rounds = False

    def __init__(self, tree, root):
        entries, rebuild = flatten(tree)
        moving = list(map(is_variable, entries))
        self.places = [place for place, moves in enumerate(moving) if moves]
        self.root, self.bare = root, bool(self.places) and keys(tree) is None
        self.flat = type(tree) is tuple and all(moving) and all(keys(branch) is None for branch in tree)
        # Without the variables: what is kept must not hold a trace or a large array.
        self.statics = tuple(None if moves else constant(leaf) for leaf, moves in zip(entries, moving, strict=True))
        self._template = rebuild(self.statics)
        for number, leaf in enumerate(entries):
            if isinstance(leaf, np.ma.MaskedArray):
                refuse_mask(f"rollout takes plain arrays, got a masked array as {self.labels[number]}", leaf)
        check_native("rollout", *entries)
        self.open = _is_open(tree)
        check_leaves(root, tree, containers=False)
        for number, leaf in enumerate(entries):
            if any(map(isbox, hidden_leaves(leaf))):
                raise DerivativeError(
                    f"{labels(tree, root)[number]} of rollout is a {type(leaf).__name__} with a traced value, which is "
                    "not a tree; write a dict or a NamedTuple"
                )
        variables = [plain(entries[place]) for place in self.places]
        self.floats = [type(leaf) is float for leaf in variables]  # numbers of Python, and handed out as such
        self.shapes = [np.shape(leaf) for leaf in variables]
        self.dtypes = [dtype_of(leaf) for leaf in variables]
        self.nbytes = sum(as_field(leaf).nbytes for leaf in variables)

    @cached_property
    def labels(self):
        """Names of all leaves."""
        return labels(self._template, self.root)

    @property
    def names(self):
        """Names of the variables."""
        return [self.labels[place] for place in self.places]

    def variables(self, tree):
        """The variables of the tree that it was made of, contiguous."""
        entries = leaves(tree)
        return [dense(entries[place]) for place in self.places]

    def build(self, variables, statics=None):
        """Variables, of which there may be more, and the other leaves -> the tree."""
        if self.bare:
            return variables[0]
        if self.flat:
            return tuple(variables[: len(self.places)])
        entries = list(self.statics if statics is None else statics)
        for place, value in zip(self.places, variables):
            entries[place] = value
        return self._rebuild(entries)

    @cached_property
    def _rebuild(self):
        return flatten(self._template)[1]

    def take(self, tree, when, number, outer):
        """A tree of the same form -> its variables; the same below the boxes of one trace, contiguous; nodes; others.

        Parameters
        ----------
        tree : any nesting of arrays, tuples, lists and dicts
        when : str
            Who made it.
        number : int
            Of the trace.
        outer : set of int
            The traces that the variables may be on beside it.

        Raises
        ------
        ShapeError
            If the form, a shape or a dtype differs.
        """
        if self.bare and not isinstance(tree, (tuple, list, dict)):
            variables: Any = [tree]
            others = self.statics
        elif self.flat and type(tree) is tuple and len(tree) == len(self.places):
            variables, others = tree, self.statics
        else:
            variables, others = self._parted(tree, when)
        values, nodes = split_boxes(variables, number)
        for k, value in enumerate(values):
            if not (
                type(value) is np.ndarray
                and value.shape == self.shapes[k]
                and value.dtype == self.dtypes[k]
                and value.flags.c_contiguous
            ):
                values[k] = self._settled(k, value, when, outer)
                if values[k] is not value:
                    variables = None  # other arrays than those that were returned
        return variables, values, nodes, others

    def _parted(self, tree, when):
        """A tree of the same form -> its variables and its other leaves."""
        advice = "; return a state like the first one"
        entries = paired(tree, self._template, self.root, f" after {when}", advice)
        variables = [entries[place] for place in self.places]
        if len(variables) == len(entries):
            return variables, self.statics
        for place in self.places:
            entries[place] = None
        others = tuple(map(constant, entries))
        for leaf, static in zip(others, self.statics, strict=True):
            refuse_mask(f"{when} made a masked array of {self.root}", leaf)
            if is_variable(leaf):
                raise ShapeError(
                    f"{self.root} must keep its form: {when} made a floating value of {_brief(static)}; "
                    "start with a floating value, for example state.astype(float)"
                )
        return variables, others

    def _settled(self, number, value, when, outer):
        name, shape, dtype = self.names[number], self.shapes[number], self.dtypes[number]
        if not traces_of([value]) <= outer:
            refuse_lost(when)
        refuse_mask(f"{when} made a masked array of {name}", plain(value))
        if not isinstance(plain(value), (np.generic, float, complex, *array_types())):
            raise ShapeError(_changed(name, "one array", described(value), when))
        if np.shape(value) != shape:
            raise ShapeError(_changed(name, f"shape {shape}", f"shape {np.shape(value)}", when))
        if self.rounds and dtype_of(value) == np.result_type(dtype, np.float64):
            value = cast(value, dtype)
        if dtype_of(value).kind == "O":
            raise ShapeError(
                f"{name} must keep its form: {when} made an array of objects; use autograd.numpy as np in it"
            )
        if dtype_of(value) != dtype:
            raise ShapeError(_changed(name, f"dtype {dtype}", f"dtype {dtype_of(value)}", when))
        return dense(value)

    def check_finite(self, values, owner, needs="must be finite"):
        """Refuse NaN and infinity in variables, plain or traced: leaf, first index, count."""
        for number, value in enumerate(values):
            if not is_finite(value):
                check_finite(f"{self.names[number]} of {owner}", plain(value), needs)


def _is_open(tree):
    return isinstance(tree, (dict, list)) or (isinstance(tree, tuple) and any(map(_is_open, tree)))


def _brief(value):
    return f"an array of dtype {value.dtype}" if isinstance(value, np.ndarray) else repr(value)


def dense(value):
    """Array or number -> contiguous array, or a NumPy scalar when it has no axes; traced values as they are."""
    if isbox(value) or is_distributed(value):
        return value
    return np.ascontiguousarray(value) if np.ndim(value) else np.asarray(value)[()]


def owned(value):
    """Array or number -> a contiguous copy of its own; traced values as they are: nobody writes into those."""
    if isbox(value) or is_distributed(value):
        return value
    return dense(np.array(value, order="C"))


def stacked(parts):
    """Arrays of one shape, traced or not -> one array, along a new first axis."""
    return (anp if any(map(isbox, parts)) else np).stack(parts)


def refuse_mask(what, leaf):
    """The mask of an array would be lost on the way."""
    if isinstance(leaf, np.ma.MaskedArray):
        raise TypeError(f"{what}; fill it first, and hand the mask along as an array of its own")


def refuse_lost(what):
    """A trace that leads elsewhere is not gone back through."""
    raise DerivativeError(
        f"{what} uses a traced value that is not one of its arguments, and its derivative would be lost; "
        "pass it in params or make it a part of the state"
    )


def fingerprint(values, statics=()):
    """Variables and other leaves of a state -> 64 bits for each variable, and for each whole number and word."""
    marks = [_bits(dense(plain(value))) for value in values]  # of a number of Python, too
    for leaf in statics:
        if isinstance(leaf, (int, str)):
            marks.append(hash(leaf))
        elif isinstance(leaf, (np.ndarray, np.generic)) and not leaf.dtype.hasobject:
            marks.append(_bits(leaf))
    return marks


def _bits(value):
    return value.fingerprint() if is_distributed(value) else hash(folded(value))


def folded(value):
    """Bytes made of all bits of an array, read once: a large one is cut into lines, added up as whole numbers."""
    if value.nbytes < 8192:
        return value.tobytes()
    fold = 521 if any(size % FOLD == 0 for size in value.shape) else FOLD
    flat = value.reshape(-1).view(np.uint8)
    end = flat.size - flat.size % (8 * fold)
    return flat[:end].view(np.uint64).reshape(-1, fold).sum(axis=0).tobytes() + flat[end:].tobytes()


def _changed(name, wanted, given, when):
    return f"{name} must keep its form: {when} made {given} of {wanted}; return a state like the first one"
