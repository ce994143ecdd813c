"""Constants of a tape: copies of the arrays that are not traced, for the backward pass.

A pullback runs later than the call that it belongs to, and the caller may have written into an array in between
(`work[:] = c` in a loop). So each array in a node of a tape that is not traced is replaced by a read-only copy.

If many nodes use the same large array, it is copied only once: a table holds the last copy of the array, which is
compared with the array bit by bit. The comparison takes as long as a copy, but saves memory. The table holds weak
references, so that a copy is freed together with the tapes that use it.
"""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np

from sparsedp._utils.pytree import field_names

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["FIXED", "constant", "constant_args", "frozen", "is_fixed", "sparing"]

SMALL = 2**16  # smaller arrays (bytes) are copied at once, because a comparison with an earlier copy takes longer
CHUNK = 2**15  # number of entries that are compared at a time, so that both parts fit into the cache of a core
LONGEST = 8  # bytes of the longest integer type; bits are compared as integers
FIXED = {float, int, bool, str, slice, type(None), type(Ellipsis), np.float64}  # types of immutable values

# Functions whose constant arguments need not be copied: the pullback does not read the values of the constants, or the
# function itself calls `constant_args`.
sparing: set[Callable] = set()
# (id of the array that owns the memory, shape, strides) -> last copy
copies: WeakValueDictionary = WeakValueDictionary()


def constant_args(args: Sequence, nums: Sequence[int]) -> Any:
    """Return the arguments of a call with constant copies of those that are not traced (not at positions `nums`)."""
    constants: list | None = None
    for num, arg in enumerate(args):
        if type(arg) in FIXED or num in nums:
            continue
        value = constant(arg)
        if value is not arg:
            if constants is None:
                constants = list(args)
            constants[num] = value
    if constants is None:
        return args
    return tuple(constants)


def constant(value: Any) -> Any:
    """Return a copy of a value whose arrays, also inside tuples, lists, dicts and dataclasses, are read-only.

    Immutable arrays and objects of other types are returned without a copy. The caller must not modify the latter.

    Examples
    --------
    >>> work = np.array([1.0, 2.0])
    >>> kept = constant(work)
    >>> work[:] = 0.0
    >>> kept
    array([1., 2.])
    """
    kind: Any = type(value)
    if isinstance(value, np.ndarray):
        if is_fixed(value):
            return value
        return _copied(value)
    if kind is tuple and all(type(entry) in FIXED for entry in value):
        return value
    if kind is tuple or kind is list:
        return kind(map(constant, value))
    if kind is dict and not value:  # the options of nearly all calls
        return {}
    if isinstance(value, dict):
        constants = copy(value)  # keep subclasses such as OrderedDict and defaultdict
        for name, entry in value.items():  # not `update`, because Counter.update adds the values
            constants[name] = constant(entry)
        return constants
    if isinstance(value, tuple) and hasattr(kind, "_fields"):
        return kind(*map(constant, value))
    names = field_names(value)
    if names is not None:
        return kind(**{name: constant(getattr(value, name)) for name in names})
    return value


def is_fixed(array: np.ndarray) -> bool:
    """Return True if no one can write into an array: the array and all its bases are read-only."""
    owner: Any = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or type(owner) is bytes


def frozen(value: Any) -> Any:
    """Return a read-only view of an array; return other values unchanged."""
    if type(value) is not np.ndarray:
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def _copied(value):
    """Return a read-only copy of an array; reuse the last copy if it has the same bits."""
    if value.nbytes <= SMALL or value.dtype.kind not in "biufc" or value.real.itemsize > LONGEST:
        return _frozen_copy(value)
    owner = value if value.base is None else value.base
    view = id(owner), value.shape, value.strides
    earlier = copies.get(view)
    if earlier is None or not _same_bits(earlier, value):
        earlier = _frozen_copy(value)
        copies[view] = earlier
    return earlier


def _frozen_copy(value):
    copy = value.copy("K")
    copy.setflags(False)
    return copy


def _same_bits(earlier, value):
    """Return True if two arrays of equal shape have the same bits.

    `==` is not enough, because 0.0 == -0.0 and their reciprocals differ.
    """
    if earlier.dtype != value.dtype or type(earlier) is not type(value):
        return False
    if value.dtype.kind == "c":
        return _same_bits(earlier.real, value.real) and _same_bits(earlier.imag, value.imag)
    bits = f"i{value.itemsize}"
    earlier = earlier.view(bits)
    value = value.view(bits)
    rows = max(1, CHUNK * len(value) // value.size)
    return all((earlier[k : k + rows] == value[k : k + rows]).all() for k in range(0, len(value), rows))
