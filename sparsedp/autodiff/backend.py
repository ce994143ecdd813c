"""Backends: where the numbers of fields are stored, and what the library asks of that place.

Code outside of ``parallel/`` calls the methods of `Backend` and the functions below, and never asks where a field is
stored. The class `Backend` itself is the default: fields are NumPy arrays of this process. ``parallel/`` derives the
backend of fields whose blocks are stored by several processes.

======================  ============================================================================================
asked of                by
======================  ============================================================================================
a grid                  ``grid.backend``; `Backend.check`, `Backend.place`, `Backend.mesh`
a field                 `Backend.split`, `Backend.join`, `Backend.concatenate`, `Backend.volumes`, `Backend.field`,
                        `Backend.combinable`; `as_field`, `gathered`, `replicated`
a state of a rollout    `Backend.stack`, `Backend.fingerprint`
a reduction             NumPy's functions: a field of another backend implements ``np.sum``, ``np.max``, ...
an application          `Backend.apply`, `Backend.reference`; `match_value` for its derivative
a solve                 `Backend.local_structure`; `Backend.implementation`: the class or function that the backend uses
                        instead of a default
the tape                `ArrayKind`: derivative formulas of calls with fields that are no NumPy arrays
a public call           `collectively`: all processes run it, or all raise
======================  ============================================================================================
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from numbers import Number
from typing import Any

import autograd.numpy as anp
import numpy as np

__all__ = [
    "ARRAY_KINDS",
    "BOX",
    "NUMPY",
    "ArrayKind",
    "Backend",
    "array_types",
    "as_field",
    "backend_of",
    "collectively",
    "folded",
    "formulas_of_kind",
    "gathered",
    "is_field",
    "match_value",
    "process_count",
    "replicated",
    "require_arrays",
]

BOX = anp.numpy_boxes.ArrayBox
FOLD = 509  # words in a line of a fingerprint: a prime, so that a field that was shifted has another one
OTHER_FOLD = 521  # where an axis of the array is a multiple of the first
WHOLE = 8192  # bytes up to which a fingerprint is that of all bytes


class Backend:
    """Fields are NumPy arrays in the memory of this process. Base class of other backends.

    Attributes
    ----------
    whole_fields : bool
        Whether a field is one array of this process, which compiled loops and SciPy can take.
    """

    whole_fields: bool = True

    def __str__(self) -> str:
        return ""  # added to the text of a grid

    def __reduce__(self) -> Any:
        return "NUMPY"  # pickled by its name in this module

    # ------------------------------------------------------------ grids

    def check(self, name: str) -> None:
        """Raise TypeError if a function of the library does not support this backend."""

    def place(self, grid: Any) -> Any:
        """Return a grid whose fields are stored by this backend."""
        return grid

    def mesh(self, grid: Any, lines: list[np.ndarray]) -> tuple:
        """Return a field of coordinates for each axis, from the coordinates along the axes."""
        return tuple(np.array(full) for full in np.meshgrid(*lines, indexing="ij"))

    # ------------------------------------------------------------ fields

    def volumes(self, space: Any) -> Any:
        """Return the control volumes of a space as a field."""
        return space.array_of_volumes()

    def split(self, space: Any, v: Any) -> tuple:
        """Return the components of a field; differentiable."""
        return space.split_array(v)

    def join(self, space: Any, parts: Any) -> Any:
        """Return one field of its components; differentiable."""
        return space.join_arrays(parts)

    def concatenate(self, space: Any, parts: Sequence) -> Any:
        """Return a flat field of the numbers of some values, traced or not, one after the other."""
        lines = [anp.reshape(replicated(part), (-1,)) for part in parts]
        if not lines:
            return np.zeros(0)
        if len(lines) == 1:
            return lines[0]
        return anp.concatenate(lines)

    def field(self, space: Any, values: np.ndarray) -> Any:
        """Return a field of values that every process holds."""
        return values

    def combinable(self, value: Any) -> Any:
        """Return a value, traced or not, in a form that can be combined with fields of this backend."""
        return replicated(value)

    def flat(self, field: Any) -> Any:
        """Return a field as an array with one axis, without a copy."""
        return field.reshape(-1)

    def stack(self, fields: Sequence) -> Any:
        """Return fields, traced or not, along a new first axis; where that is not possible, the tuple of them."""
        if any(type(field) is BOX for field in fields):
            return anp.stack(fields)
        return np.stack(fields)

    def fingerprint(self, field: Any) -> int:
        """Return 64 bits that depend on all bits of a plain field."""
        return hash(folded(np.asarray(field, order="C")))

    # ------------------------------------------------------------ applications and solves

    def apply(self, op: Any, u: Any, out: np.ndarray | None = None) -> Any:
        """Return the result of an Operator for a plain field."""
        return op.apply_array(u, out)

    def local_structure(self, op: Any) -> Any:
        """Return the Structure of an Operator on the entries of fields that this process holds."""
        return op.structure

    def reference(self, u: Any) -> Any:
        """Return what the VJP of an Operator must know of its argument to return a gradient of the same form."""
        return None

    def attempt(self, act: Callable, *args: Any) -> Any:
        """Return ``act(*args)``; the caller handles its error, and all processes that share the fields do so."""
        return act(*args)

    def implementation(self, default: Callable) -> Callable:
        """Return the class or function to call instead of a default one that works on NumPy arrays."""
        return default


NUMPY = Backend()


def folded(value: Any) -> bytes:
    """Return bytes that depend on all bits of an array; a large one is cut into lines, added as whole numbers."""
    if value.nbytes < WHOLE:
        return value.tobytes()
    if any(size % FOLD == 0 for size in value.shape):
        fold = OTHER_FOLD
    else:
        fold = FOLD
    flat = value.reshape(-1).view(np.uint8)
    end = flat.size - flat.size % (8 * fold)
    return flat[:end].view(np.uint64).reshape(-1, fold).sum(axis=0).tobytes() + flat[end:].tobytes()


class ArrayKind(ABC):
    """What the tape and public calls ask of fields that are not NumPy arrays.

    The type of such a field has the methods ``gather()`` (the whole field as a NumPy array), ``fingerprint()`` (an int
    of all bits, the same on all processes), ``astype(dtype)`` and an attribute ``backend``.
    """

    @abstractmethod
    def formulas(self, fun: Callable, value: Any, args: tuple, nums: tuple) -> tuple | None:
        """Return the VJP and JVP of a call ``value = fun(*args)`` for arguments `nums`; None: use autograd's."""

    def match(self, derivative: Any, value: Any) -> Any:
        """Return a derivative in the form (number, array or field) of the value that it belongs to."""
        return derivative

    def collectively(self, what: str, arguments: Any, act: Callable, *args: Any) -> Any:
        """Return ``act(*args)``: see the function `collectively`."""
        return act(*args)

    def process_count(self) -> int:
        """Return the number of processes that share the fields."""
        return 1


ARRAY_KINDS: dict[type, ArrayKind] = {}  # by the type of the fields; empty until fields are distributed


def _type_of(value: Any) -> type:
    """Return the type of a value, or of the value in its boxes."""
    while type(value) is BOX:
        value = value._value
    return type(value)


# ---- functions of a value -------------------------------------------------------------------------------------------


def array_types() -> tuple[type, ...]:
    """Return the types of fields."""
    return (np.ndarray, *ARRAY_KINDS)


def is_field(value: Any) -> bool:
    """Return whether a plain value is a number, an array, or a field of any backend."""
    return isinstance(value, (np.ndarray, Number)) or type(value) in ARRAY_KINDS


def backend_of(values: Iterable) -> Backend:
    """Return the backend of the first plain value that is no NumPy array or number; NUMPY if there is none."""
    for value in values:
        if type(value) in ARRAY_KINDS:
            return value.backend
    return NUMPY


def as_field(value: Any) -> Any:
    """Return a plain value as an array; fields of other backends are returned as they are."""
    return value if type(value) in ARRAY_KINDS else np.asarray(value)


def gathered(value: Any) -> Any:
    """Return a plain value; a distributed field as the array of all its entries."""
    return value.gather() if type(value) in ARRAY_KINDS else value


def replicated(value: Any) -> Any:
    """Return a value, traced or not; a distributed field as an array that every process holds. Differentiable."""
    kind = ARRAY_KINDS.get(_type_of(value))
    if kind is None:
        return value
    return kind.match(value, np.broadcast_to(0.0, value.shape))


def require_arrays(name: str, values: Iterable) -> None:
    """Raise TypeError if one of some plain values is a distributed field."""
    for value in values:
        if type(value) in ARRAY_KINDS:
            value.refuse(name)


# ---- derivatives and calls ------------------------------------------------------------------------------------------


def formulas_of_kind(fun: Callable, value: Any, args: tuple, nums: tuple) -> tuple | None:
    """Return the formulas of a call by the first argument that is no NumPy array: see `ArrayKind.formulas`."""
    for arg in args:
        kind = ARRAY_KINDS.get(_type_of(arg))
        if kind is not None:
            return kind.formulas(fun, value, args, nums)
    return None


def match_value(derivative: Any, value: Any) -> Any:
    """Return a derivative, traced or not, in the form of the value that it belongs to."""
    if not ARRAY_KINDS:
        return derivative
    kind = ARRAY_KINDS.get(_type_of(derivative)) or ARRAY_KINDS.get(_type_of(value))
    if kind is None:
        return derivative
    return kind.match(derivative, value)


def collectively(what: str, arguments: Any, act: Callable, *args: Any) -> Any:
    """Return ``act(*args)``, called by all processes that share fields.

    If one of them raises, all raise its error. A tree of arguments must be the same on all of them.
    """
    for kind in ARRAY_KINDS.values():
        return kind.collectively(what, arguments, act, *args)
    return act(*args)


def process_count() -> int:
    """Return the number of processes that share the fields of this one."""
    for kind in ARRAY_KINDS.values():
        return kind.process_count()
    return 1
