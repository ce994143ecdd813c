"""Constants of a tape: what the backward pass needs of the caller's arrays, as they were at the call.

A pullback runs later than its call, and the caller may have written into an array in between (`work[:] = c` in a
loop). So every array in a node of a tape that is not traced is replaced by a read-only copy.

A large array that many nodes use is copied once: the last copy of such a view is kept in a table and compared with the
array bit by bit. That takes as long as a copy and saves the memory. Copies live as long as the tapes that hold them.
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

SMALL = 2**16  # bytes up to which a copy takes less time than a comparison with an earlier one
CHUNK = 2**15  # entries that are compared at once: two such parts stay in the cache of a core
LONGEST = 8  # bytes of the longest integer, as which bits are compared
FIXED = {float, int, bool, str, slice, type(None), type(Ellipsis), np.float64}  # types of immutable values

# Functions whose pullbacks need no numbers of their constants, and those that call `constant_args`.
sparing: set[Callable] = set()
# (id of the owner, shape, strides) of an array -> its last copy
copies: WeakValueDictionary = WeakValueDictionary()


def constant_args(args: Sequence, nums: Sequence[int]) -> Any:
    """Return the arguments of a call, those that are not traced (not at the positions `nums`) as constants."""
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
    """Return a value in read-only arrays; also inside tuples, lists, dicts and dataclasses.

    Immutable arrays are returned as they are. Other objects must not be changed by their owner.

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
    if isinstance(value, dict):
        constants = copy(value)  # it may have an order of its own, or a default
        for name, entry in value.items():  # not by update: that of a Counter adds
            constants[name] = constant(entry)
        return constants
    if isinstance(value, tuple) and hasattr(kind, "_fields"):
        return kind(*map(constant, value))
    names = field_names(value)
    if names is not None:
        return kind(**{name: constant(getattr(value, name)) for name in names})
    return value


def is_fixed(array: np.ndarray) -> bool:
    """Whether an array is immutable. A read-only view of a writeable array is not."""
    owner: Any = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or type(owner) is bytes


def frozen(value: Any) -> Any:
    """Return an array as a read-only view; all else as it is."""
    if type(value) is not np.ndarray:
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def _copied(value):
    """Return a read-only copy of an array, if possible one that exists."""
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
    """Whether two arrays of one shape hold the same bits: 0.0 and -0.0 have different reciprocals."""
    if earlier.dtype != value.dtype or type(earlier) is not type(value):
        return False
    if value.dtype.kind == "c":
        return _same_bits(earlier.real, value.real) and _same_bits(earlier.imag, value.imag)
    bits = f"i{value.itemsize}"
    earlier = earlier.view(bits)
    value = value.view(bits)
    rows = max(1, CHUNK * len(value) // value.size)
    return all((earlier[k : k + rows] == value[k : k + rows]).all() for k in range(0, len(value), rows))
