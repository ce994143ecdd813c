"""Backends: a backend stores fields as arrays and implements the operations that depend on how they are stored.

Code outside of ``parallel/`` calls the methods of `Backend` and the functions below, and does not depend on where a
field is stored. The class `Backend` itself is the default: a field is a NumPy array in the memory of this process.
``parallel/`` derives a backend whose fields are split into blocks, one for each of several processes.

======================  ============================================================================================
operation on            interface
======================  ============================================================================================
grids                   ``grid.backend``; `Backend.check`, `Backend.place`, `Backend.mesh`
fields                  `Backend.split`, `Backend.join`, `Backend.concatenate`, `Backend.volumes`, `Backend.field`,
                        `Backend.combinable`; `as_field`, `gathered`, `replicated`
states of a rollout     `Backend.stack`, `Backend.fingerprint`
reductions              NumPy's functions: fields of another backend implement ``np.sum``, ``np.max``, ...
operator products       `Backend.apply`, `Backend.reference`; `match_value` for their derivatives
solves                  `Backend.local_structure`; `Backend.implementation` for the class or function that the backend
                        uses instead of a default
the tape                `ArrayKind`: derivative formulas of calls with fields that are not NumPy arrays
public calls            `collectively`: either the call succeeds on all processes, or all of them raise an error
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
# A fingerprint of a large array is computed from the sum of lines of FOLD words of 64 bits. FOLD is a prime, so that
# shifting a field along an axis changes the sum; OTHER_FOLD is used if the length of an axis is a multiple of FOLD.
FOLD = 509
OTHER_FOLD = 521
WHOLE = 8192  # arrays with fewer bytes are hashed in full


class Backend:
    """Fields are NumPy arrays in the memory of this process. Base class of other backends.

    Attributes
    ----------
    whole_fields : bool
        Whether a field is one NumPy array of this process, which can be passed to compiled loops and to SciPy.
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
        """Return for each axis the field of its coordinate, given the coordinates along all axes."""
        return tuple(np.array(full) for full in np.meshgrid(*lines, indexing="ij"))

    # ------------------------------------------------------------ fields

    def volumes(self, space: Any) -> Any:
        """Return the control volumes of a space as a field."""
        return space.array_of_volumes()

    def split(self, space: Any, v: Any) -> tuple:
        """Return the components of a field; differentiable."""
        return space.split_array(v)

    def join(self, space: Any, parts: Any) -> Any:
        """Join the components of a field to one field; differentiable."""
        return space.join_arrays(parts)

    def concatenate(self, space: Any, parts: Sequence) -> Any:
        """Flatten some values, traced or not, and concatenate them to one flat field."""
        lines = [anp.reshape(replicated(part), (-1,)) for part in parts]
        if not lines:
            return np.zeros(0)
        if len(lines) == 1:
            return lines[0]
        return anp.concatenate(lines)

    def field(self, space: Any, values: np.ndarray) -> Any:
        """Return a field from an array of all its values that every process has."""
        return values

    def combinable(self, value: Any) -> Any:
        """Return a value, traced or not, in a form that can be combined with fields of this backend."""
        return replicated(value)

    def flat(self, field: Any) -> Any:
        """Return a field as an array with one axis, without a copy."""
        return field.reshape(-1)

    def stack(self, fields: Sequence) -> Any:
        """Stack fields, traced or not, along a new first axis; return a tuple if this is not possible."""
        if any(type(field) is BOX for field in fields):
            return anp.stack(fields)
        return np.stack(fields)

    def fingerprint(self, field: Any) -> int:
        """Return a hash of 64 bits that depends on all entries of a plain field."""
        return hash(folded(np.asarray(field, order="C")))

    # ------------------------------------------------------------ applications and solves

    def apply(self, op: Any, u: Any, out: np.ndarray | None = None) -> Any:
        """Apply an Operator to a plain field."""
        return op.apply_array(u, out)

    def local_structure(self, op: Any) -> Any:
        """Return the Structure of an Operator restricted to the entries of fields that this process stores."""
        return op.structure

    def reference(self, u: Any) -> Any:
        """Return the data about the argument of an Operator that its VJP needs to return a gradient of the same form.

        NumPy arrays need none.
        """
        return None

    def attempt(self, act: Callable, *args: Any) -> Any:
        """Return ``act(*args)``; if it raises on one process, raise on all processes that share the fields.

        So the caller can catch the error and continue in the same way on all processes.
        """
        return act(*args)

    def implementation(self, default: Callable) -> Callable:
        """Return the class or function to call instead of a default one that works on NumPy arrays."""
        return default


NUMPY = Backend()


def folded(value: Any) -> bytes:
    """Return bytes that depend on all entries of an array; a large array is reduced to a sum of lines of integers."""
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
    """The operations of the tape and of public calls that depend on a type of field other than NumPy arrays.

    The type of such a field has the methods ``gather()`` (return the whole field as a NumPy array), ``fingerprint()``
    (return a hash of all entries, the same on all processes), ``astype(dtype)``, and the attribute ``backend``.
    """

    @abstractmethod
    def formulas(self, fun: Callable, value: Any, args: tuple, nums: tuple) -> tuple | None:
        """Return the VJP and JVP of a call ``value = fun(*args)`` for the arguments at positions `nums`.

        Return None to use the formulas of autograd.
        """

    def match(self, derivative: Any, value: Any) -> Any:
        """Convert a derivative to the type (number, array or field) of the value that it belongs to."""
        return derivative

    def collectively(self, what: str, arguments: Any, act: Callable, *args: Any) -> Any:
        """Return ``act(*args)``: see the function `collectively`."""
        return act(*args)

    def process_count(self) -> int:
        """Return the number of processes that share the fields."""
        return 1


ARRAY_KINDS: dict[type, ArrayKind] = {}  # type of field -> ArrayKind; empty until distributed fields are used


def _type_of(value: Any) -> type:
    """Return the type of a value; of a traced value, the type of the value inside its boxes."""
    while type(value) is BOX:
        value = value._value
    return type(value)


# ---- functions of a value -------------------------------------------------------------------------------------------


def array_types() -> tuple[type, ...]:
    """Return the types of fields."""
    return (np.ndarray, *ARRAY_KINDS)


def is_field(value: Any) -> bool:
    """Return True if a plain value is a number, an array, or a field of any backend."""
    return isinstance(value, (np.ndarray, Number)) or type(value) in ARRAY_KINDS


def backend_of(values: Iterable) -> Backend:
    """Return the backend of the first distributed field among plain values; NUMPY if there is none."""
    for value in values:
        if type(value) in ARRAY_KINDS:
            return value.backend
    return NUMPY


def as_field(value: Any) -> Any:
    """Return a plain value as an array; fields of other backends are returned as they are."""
    return value if type(value) in ARRAY_KINDS else np.asarray(value)


def gathered(value: Any) -> Any:
    """Return a distributed field as a NumPy array of all its entries, any other plain value unchanged."""
    return value.gather() if type(value) in ARRAY_KINDS else value


def replicated(value: Any) -> Any:
    """Return a distributed field, traced or not, as an array on every process; return other values unchanged."""
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
    """Return `ArrayKind.formulas` of the first argument that is a distributed field; None if there is none."""
    for arg in args:
        kind = ARRAY_KINDS.get(_type_of(arg))
        if kind is not None:
            return kind.formulas(fun, value, args, nums)
    return None


def match_value(derivative: Any, value: Any) -> Any:
    """Convert a derivative, traced or not, to the type (number, array or field) of the value that it belongs to."""
    if not ARRAY_KINDS:
        return derivative
    kind = ARRAY_KINDS.get(_type_of(derivative)) or ARRAY_KINDS.get(_type_of(value))
    if kind is None:
        return derivative
    return kind.match(derivative, value)


def collectively(what: str, arguments: Any, act: Callable, *args: Any) -> Any:
    """Return ``act(*args)``, called by all processes that share fields.

    If one process raises an error, all processes raise it. The tree `arguments` must be the same on all processes.
    """
    for kind in ARRAY_KINDS.values():
        return kind.collectively(what, arguments, act, *args)
    return act(*args)


def process_count() -> int:
    """Return the number of processes that share fields with this one, itself included."""
    for kind in ARRAY_KINDS.values():
        return kind.process_count()
    return 1
