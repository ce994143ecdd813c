"""Constants of a tape: what the backward pass needs from the caller, kept apart from the caller's arrays.

A pullback runs later than its call, and the caller may have written into an array in between (`work[:] = c` in a
loop). So every array that goes into a node of a tape without being traced is replaced by a read-only copy.

A large array that many nodes use is copied once: the last copy of such a view of its owner is found again and compared
bit by bit. That takes as long as a copy and saves the memory. Copies live as long as the tapes that hold them.
"""

from copy import copy
from weakref import WeakValueDictionary

import numpy as np

__all__ = ["FIXED", "constant", "constant_args", "frozen", "is_fixed", "sparing"]

SMALL = 2**16  # bytes up to which a copy of its own takes less time than a comparison with an older one
CHUNK = 2**15  # entries that are compared at once: two pieces of them stay in the cache of a core
LONGEST = 8  # bytes of the longest integer, as which bits are compared
FIXED = {float, int, bool, str, slice, type(None), type(Ellipsis), np.float64}

# Functions whose pullbacks need no numbers of their constants, and those that call `constant_args`.
sparing: set = set()
# (id of the owner, shape, strides) of an array -> the last copy of it
copies: WeakValueDictionary = WeakValueDictionary()


def constant_args(args, nums):
    """Arguments of a call -> the same, those not traced (not at the places `nums`) as constants."""
    held = None
    for num, arg in enumerate(args):
        if type(arg) not in FIXED and num not in nums:
            value = constant(arg)
            if value is not arg:
                held = held or list(args)
                held[num] = value
    return args if held is None else tuple(held)


def constant(value):
    """The same value in arrays that nobody writes into; also in tuples, lists and dicts.

    What can change no more is handed back as it is. Other objects are the business of who made them.

    Examples
    --------
    >>> work = np.array([1.0, 2.0])
    >>> kept = constant(work)
    >>> work[:] = 0.0
    >>> kept
    array([1., 2.])
    """
    kind = type(value)
    if isinstance(value, np.ndarray):
        return value if is_fixed(value) else _copied(value)
    if kind is tuple and all(type(one) in FIXED for one in value):
        return value
    if kind is tuple or kind is list:
        return kind(map(constant, value))
    if isinstance(value, dict):  # it may have an order of its own, or a default
        held = copy(value)
        for name, one in value.items():  # not by update: that of a Counter adds
            held[name] = constant(one)
        return held
    return kind(*map(constant, value)) if isinstance(value, tuple) and hasattr(kind, "_fields") else value


def is_fixed(array):
    """Whether nobody can write into an array: a read-only view of one that is writeable does not count."""
    while isinstance(array, np.ndarray):
        if array.flags.writeable:
            return False
        array = array.base
    return array is None or type(array) is bytes


def frozen(value):
    """Array -> a view nobody can write through; numbers as they are."""
    if type(value) is not np.ndarray:
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def _copied(value):
    if value.nbytes <= SMALL or value.dtype.kind not in "biufc" or value.real.itemsize > LONGEST:
        return _frozen_copy(value)
    owner = value if value.base is None else value.base
    view = id(owner), value.shape, value.strides
    earlier = copies.get(view)
    if earlier is None or not _same_bits(earlier, value):
        earlier = copies[view] = _frozen_copy(value)
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
    earlier, value = earlier.view(bits), value.view(bits)
    rows = max(1, CHUNK * len(value) // value.size)
    return all((earlier[k : k + rows] == value[k : k + rows]).all() for k in range(0, len(value), rows))
