"""What a rollout computes: its step, the forms of its arguments, and which of them are differentiated.

The form of an argument is its tree structure together with the shapes and dtypes of its floating leaves, which are
called its variables. An `ArgumentForm` stores a form and checks whether another tree has it. A `RolloutSpecification`
stores the forms of state, params and inputs; it does not change while the rollout runs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from numbers import Number
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import TreeStructure, child, described, is_branch, keys, leaves, paired
from sparsedp._utils.validation import (
    PLAIN_LEAVES,
    PRECISIONS,
    check_finite,
    check_leaves,
    check_native,
    hidden_leaves,
)
from sparsedp.autodiff.backend import array_types, as_field, backend_of, folded
from sparsedp.autodiff.derivative import is_finite
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, plain, sample, split_boxes, traces_of
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
    """The tree structure of an argument of a rollout, and the shapes and dtypes of its variables (floating leaves).

    Parameters
    ----------
    tree : any nesting of arrays, tuples, lists and dicts
    root : str
        Name of the argument in error messages.

    Attributes
    ----------
    is_open : bool
        Whether some branch is mutable (a dict, a list, or a dataclass that is not frozen), so that a step could
        replace its entries.
    shapes, dtypes, is_float : list
        One entry for each variable; `is_float` is True for a Python float.
    nbytes : int
        Total size of the variables.
    rounds : bool
        Whether a float64 result of a step is rounded to the float32 of the state. Set when some argument is a Python
        float: NumPy keeps float32 in operations with it, but autograd traces it as float64 and thus returns float64.
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
        if all(map(_is_plain, entries)):  # the most frequent case, which passes all checks below
            return
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
        """Separate the variables and the other leaves of a tree that must have this form.

        Parameters
        ----------
        tree : any nesting of arrays, tuples, lists and dicts
        origin : str
            Name of the function that returned the tree, for error messages.
        number : int
            Number of the trace of the rollout.
        outer : set of int
            Numbers of the other traces that the variables may belong to.

        Returns
        -------
        variables : list or None
            The variables as they stand in the tree; None if one of them had to be converted.
        values : list
            The contiguous values of the variables, without boxes of the trace of the rollout.
        nodes : list
            For each variable its node on that trace, or None.
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
        """Return variable k as a contiguous array or number; raise an error if its shape or dtype differs."""
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
        """Raise NonFiniteError for NaN or infinity in variables, with the leaf, the first index and the count."""
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
        The forms of state, params and, if there are any, inputs.
    n : int
        Number of steps.
    truncate : int or None
    differentiated : list of int
        Positions of the variables that need a cotangent, in the list of the variables of state, params and inputs.

    Attributes
    ----------
    state, params, inputs : ArgumentForm
        `inputs` is None if the rollout has no inputs.
    cuts : range
        Indices of the states that truncation treats as constants for the steps after them.
    first_traced : int
        Index of the first state that depends on a differentiated variable; n + 1 if there is none.
    is_open : bool
        Whether a step gets dicts, lists or other mutable containers, whose entries it could replace.
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
        """Split the list of all variables into the lists of state, params and inputs."""
        first = len(self.state.places)
        second = first + len(self.params.places)
        return list(variables[:first]), list(variables[first:second]), list(variables[second:])


def _is_plain(leaf: Any) -> bool:
    """Return True for an array of NumPy in single or double precision, traced or not, and for a number or None."""
    value = sample(leaf)
    if type(value) is np.ndarray:
        return value.dtype.char in PRECISIONS
    return type(value) in PLAIN_LEAVES


# ---- arrays of a state -----------------------------------------------------------------------------------------------


def is_array(value: Any) -> bool:
    """Return True for a number or a NumPy array, False for a distributed field."""
    return isinstance(value, (np.ndarray, Number))


def contiguous(value: Any) -> Any:
    """Return an array in C order and a number as a NumPy scalar; return traced values and other fields unchanged."""
    if not is_array(value):
        return value
    if np.ndim(value):
        return np.ascontiguousarray(value)
    return np.asarray(value)[()]


def owned(value: Any) -> Any:
    """Return a contiguous copy; return traced values and distributed fields unchanged, as they are never modified."""
    if not is_array(value):
        return value
    return contiguous(np.array(value, order="C"))


def fingerprint(values: Sequence, statics: Sequence = ()) -> list:
    """Return a hash for each variable of a state, and for each integer, string and array among its other leaves."""
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
    """Stack values, traced or not, along a new first axis; return a tuple if their backend cannot stack them."""
    return backend_of([plain(parts[-1])]).stack(parts)


# ---- errors ----------------------------------------------------------------------------------------------------------


def refuse_mask(message: str, leaf: Any) -> None:
    """Raise TypeError for a masked array, because a rollout would lose the mask."""
    if isinstance(leaf, np.ma.MaskedArray):
        raise TypeError(f"{message}; fill it first, and pass the mask as an array of its own")


def refuse_foreign_trace(origin: str) -> None:
    """Raise DerivativeError for a result on a trace that the backward pass does not differentiate."""
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
