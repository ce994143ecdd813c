"""What a rollout computes: its step, the forms of its arguments, and which of them are differentiated.

An `ArgumentForm` is the structure of an argument, and says whether another tree has the same form. A
`RolloutSpecification` holds the forms of state, params and inputs; it does not change while the rollout runs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from numbers import Number
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import TreeStructure, child, described, is_branch, keys, leaves, paired
from sparsedp._utils.validation import check_finite, check_leaves, check_native, hidden_leaves
from sparsedp.autodiff.backend import array_types, as_field, backend_of, folded
from sparsedp.autodiff.derivative import is_finite
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, plain, split_boxes, traces_of
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import DerivativeError, ShapeError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = [
    "ArgumentForm",
    "RolloutSpecification",
    "contiguous",
    "fingerprint",
    "is_array",
    "owned",
    "refuse_foreign_trace",
    "refuse_mask",
    "stacked",
]


class ArgumentForm(TreeStructure):
    """The structure of an argument of a rollout, and the shapes and dtypes of its variables, the floating leaves.

    Parameters
    ----------
    tree : any nesting of arrays, tuples, lists and dicts
    root : str
        Its name in messages.

    Attributes
    ----------
    is_open : bool
        Some branch is a dict or a list, whose entries could be changed.
    shapes, dtypes, is_float : list
        Of the variables; `is_float`: whether it is a float of Python.
    nbytes : int
        Of all of them.
    rounds : bool
        Whether a step may widen float32 to float64, and its result is rounded: beside numbers of Python, which are
        traced as float64, autograd widens what NumPy does not.
    """

    rounds = False

    def __init__(self, tree: Any, root: str) -> None:
        super().__init__(tree, root, is_variable, constant)
        self.shapes: list[tuple] = []
        self.dtypes: list[np.dtype] = []
        self.is_float: list[bool] = []
        self.nbytes = 0
        for leaf in self.variables(tree):
            value = plain(leaf)
            self.shapes.append(np.shape(value))
            self.dtypes.append(dtype_of(value))
            self.is_float.append(type(value) is float)
            self.nbytes += as_field(value).nbytes
        self._check(tree)
        self.is_open = _is_open(tree)

    def _check(self, tree: Any) -> None:
        entries = leaves(tree)
        for place, leaf in enumerate(entries):
            if isinstance(leaf, np.ma.MaskedArray):
                refuse_mask(f"rollout takes plain arrays, got a masked array as {self.labels[place]}", leaf)
        check_native("rollout", *entries)
        check_leaves(self.root, tree, containers=False)
        for place, leaf in enumerate(entries):
            for hidden in hidden_leaves(leaf):
                if isbox(hidden):
                    raise DerivativeError(
                        f"{self.labels[place]} of rollout is a {type(leaf).__name__} with a traced value, "
                        "which is not a tree; write a dict, a NamedTuple or a plain dataclass"
                    )

    def take(self, tree: Any, origin: str, number: int, outer: set[int]) -> tuple:
        """Take a tree of the same form apart.

        Parameters
        ----------
        tree : any nesting of arrays, tuples, lists and dicts
        origin : str
            What returned the tree, for messages.
        number : int
            The trace of the rollout.
        outer : set of int
            The other traces that the variables may be on.

        Returns
        -------
        variables : list or None
            As they were returned; None where an array had to be converted.
        values : list
            The same without the trace of the rollout, contiguous.
        nodes : list
            Their nodes on that trace, or None.
        statics : tuple
            The other leaves.

        Raises
        ------
        ShapeError
            If the form, a shape or a dtype differs.
        """
        variables: Any
        if self.is_leaf and not is_branch(tree):
            variables = [tree]
            statics = self.statics
        elif self.is_flat and type(tree) is tuple and len(tree) == len(self.places):
            variables = tree
            statics = self.statics
        else:
            variables, statics = self._separated(tree, origin)
        values, nodes = split_boxes(variables, number)
        for k, value in enumerate(values):
            if not (
                type(value) is np.ndarray
                and value.shape == self.shapes[k]
                and value.dtype == self.dtypes[k]
                and value.flags.c_contiguous
            ):
                values[k] = self._converted(k, value, origin, outer)
                if values[k] is not value:
                    variables = None
        return variables, values, nodes, statics

    def _separated(self, tree: Any, origin: str) -> tuple[list, tuple]:
        """Return the variables and the other leaves of a tree of the same form."""
        advice = "; return a state like the first one"
        entries = paired(tree, self.template, self.root, f" after {origin}", advice)
        variables = [entries[place] for place in self.places]
        if len(variables) == len(entries):
            return variables, self.statics
        for place in self.places:
            entries[place] = None
        statics = tuple(map(constant, entries))
        for leaf, first in zip(statics, self.statics, strict=True):
            refuse_mask(f"{origin} made a masked array of {self.root}", leaf)
            if is_variable(leaf):
                raise ShapeError(
                    f"{self.root} must keep its form: {origin} made a floating value of {_brief(first)}; "
                    "start with a floating value, for example state.astype(float)"
                )
        return variables, statics

    def _converted(self, k: int, value: Any, origin: str, outer: set[int]) -> Any:
        """Return a variable as a contiguous array or number of its shape and dtype; refuse other ones."""
        name = self.names[k]
        dtype = self.dtypes[k]
        if not traces_of([value]) <= outer:
            refuse_foreign_trace(origin)
        refuse_mask(f"{origin} made a masked array of {name}", plain(value))
        if not isinstance(plain(value), (np.generic, float, complex, *array_types())):
            raise ShapeError(_changed(name, "one array", described(value), origin))
        if np.shape(value) != self.shapes[k]:
            raise ShapeError(_changed(name, f"shape {self.shapes[k]}", f"shape {np.shape(value)}", origin))
        if self.rounds and dtype_of(value) == np.result_type(dtype, np.float64):
            value = cast(value, dtype)
        if dtype_of(value).kind == "O":
            raise ShapeError(
                f"{name} must keep its form: {origin} made an array of objects; use autograd.numpy as np in it"
            )
        if dtype_of(value) != dtype:
            raise ShapeError(_changed(name, f"dtype {dtype}", f"dtype {dtype_of(value)}", origin))
        return contiguous(value)

    def check_finite(self, values: Sequence, owner: str, needs: str = "must be finite") -> None:
        """Refuse NaN and infinity in variables; the message names the leaf, the first index and the count."""
        for k, value in enumerate(values):
            if not is_finite(value):
                check_finite(f"{self.names[k]} of {owner}", plain(value), needs)


@dataclass(eq=False)
class RolloutSpecification:
    """The step of a rollout, its arguments, and which of them are differentiated.

    Parameters
    ----------
    step : callable
    forms : list of ArgumentForm
        Of state, params and, where there are any, inputs.
    n : int
        Number of steps.
    truncate : int or None
    differentiated : list of int
        Positions of the variables, of all arguments in this order, that need a cotangent.

    Attributes
    ----------
    state, params, inputs : ArgumentForm
        `inputs` is None where there are none.
    cuts : range
        Indices of the states that truncation makes constants for the steps after them.
    first_traced : int
        Index of the first state that depends on something differentiated.
    is_open : bool
        Whether a step gets dicts or lists, whose entries it could change.
    """

    step: Callable
    forms: list[ArgumentForm]
    n: int
    truncate: int | None
    differentiated: list[int]
    state: ArgumentForm = field(init=False)
    params: ArgumentForm = field(init=False)
    inputs: ArgumentForm | None = field(init=False)
    cuts: range = field(init=False)
    first_traced: int = field(init=False)
    is_open: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        self.state = self.forms[0]
        self.params = self.forms[1]
        if len(self.forms) == 3:
            self.inputs = self.forms[2]
        else:
            self.inputs = None
        if self.truncate:
            self.cuts = range(self.n - self.truncate, 0, -self.truncate)
        else:
            self.cuts = range(0)
        self.state.rounds = False
        for form in self.forms:
            self.is_open = self.is_open or form.is_open
            self.state.rounds = self.state.rounds or True in form.is_float
        if not self.differentiated:
            self.first_traced = self.n + 1
        elif self.differentiated[0] < len(self.state.places):
            self.first_traced = 0
        else:
            self.first_traced = 1

    @property
    def names(self) -> list[str]:
        """Return the names of all variables."""
        return [name for form in self.forms for name in form.names]

    def split(self, variables: Sequence) -> tuple[list, list, list]:
        """Return the variables of state, params and inputs, from those of all arguments."""
        first = len(self.state.places)
        second = first + len(self.params.places)
        return list(variables[:first]), list(variables[first:second]), list(variables[second:])


# ---- arrays of a state -----------------------------------------------------------------------------------------------


def is_array(value: Any) -> bool:
    """Whether a plain value is a number or array of NumPy, not a field of another backend."""
    return isinstance(value, (np.ndarray, Number))


def contiguous(value: Any) -> Any:
    """Return a contiguous array, or a NumPy scalar of a value without axes; values that are no arrays as they are."""
    if not is_array(value):
        return value
    if np.ndim(value):
        return np.ascontiguousarray(value)
    return np.asarray(value)[()]


def owned(value: Any) -> Any:
    """Return a contiguous copy; traced values and other fields, into which nothing writes, are returned as they are."""
    if not is_array(value):
        return value
    return contiguous(np.array(value, order="C"))


def fingerprint(values: Sequence, statics: Sequence = ()) -> list:
    """Return 64 bits for each variable of a state, and for each whole number, text and array of its other leaves."""
    marks = []
    for value in values:
        value = plain(value)
        marks.append(backend_of([value]).fingerprint(value))
    for leaf in statics:
        if isinstance(leaf, (int, str)):
            marks.append(hash(leaf))
        elif isinstance(leaf, (np.ndarray, np.generic)) and not leaf.dtype.hasobject:
            marks.append(hash(folded(leaf)))
    return marks


def stacked(parts: Sequence) -> Any:
    """Return values, traced or not, along a new first axis; the tuple of them if their backend cannot stack them."""
    return backend_of([plain(parts[-1])]).stack(parts)


# ---- refusals --------------------------------------------------------------------------------------------------------


def refuse_mask(message: str, leaf: Any) -> None:
    """Refuse an array with a mask, which a rollout would lose."""
    if isinstance(leaf, np.ma.MaskedArray):
        raise TypeError(f"{message}; fill it first, and pass the mask as an array of its own")


def refuse_foreign_trace(origin: str) -> None:
    """Refuse a result on a trace that the backward pass does not follow."""
    raise DerivativeError(
        f"{origin} uses a traced value that is not one of its arguments, and its derivative would be lost; "
        "pass it in params or make it a part of the state"
    )


def _is_open(tree: Any) -> bool:
    if isinstance(tree, (dict, list)):
        return True
    names = keys(tree)
    if names is None:
        return False
    is_frozen = isinstance(tree, tuple) or tree.__dataclass_params__.frozen
    return not is_frozen or any(_is_open(child(tree, name)) for name in names)


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of dtype {value.dtype}"
    return repr(value)


def _changed(name: str, expected: str, result: str, origin: str) -> str:
    return f"{name} must keep its form: {origin} made {result} of {expected}; return a state like the first one"
