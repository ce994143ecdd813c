"""Derivatives of the commonest calls on a tape: arithmetic, entries of arrays, arrays made of numbers.

autograd knows them all, and takes three to ten times as long: it is ready for all kinds of broadcasting, other dtypes
and traces inside traces. What is here serves float64 alone; without it a gradient of small steps takes twice the time
(benchmarks/burgers.py, 200 steps of rk4).
"""

import operator
from inspect import unwrap
from typing import Any

import autograd.numpy as anp
import numpy as np

__all__ = [
    "ACTS", "ARRAY", "BOX", "COPY", "FLOAT", "ITEM", "MAKERS", "NUMBERS", "OPERATORS", "PLAIN", "Part", "REAL",
    "pull_of", "tangent_of",
]  # fmt: skip

FLOAT = np.dtype(float)
REAL = {np.ndarray, np.float64, float, int}
NUMBERS = {np.ndarray, np.float64}  # that have a shape and a dtype
PLAIN = {*REAL, slice, tuple, list, bool, type(None), type(Ellipsis)}  # operands that leave all to the traced one
BASIC = {int, slice, type(None), type(Ellipsis)}  # indices that meet no entry twice
OPERATORS = {
    "add": anp.add, "sub": anp.subtract, "mul": anp.multiply, "truediv": anp.true_divide, "pow": anp.power,
}  # fmt: skip
MAKERS = "_array_from_scalar_or_array", "array_from_args"  # what anp.array calls
BOX = anp.numpy_boxes.ArrayBox
ITEM = unwrap(BOX.__getitem__)
# Of NumPy's numbers the operators of Python take a tenth of the time; and a step that is run again without a tape has
# their bits: a power by the function may differ in the last one.
ACTS = {
    anp.add: operator.add, anp.subtract: operator.sub, anp.multiply: operator.mul,
    anp.true_divide: operator.truediv, anp.power: operator.pow, ITEM: operator.getitem,
}  # fmt: skip
COPY, ARRAY = (unwrap(getattr(anp.numpy_wrapper, name)) for name in MAKERS)

# What of two operands a derivative needs -> what is held of them.
HELD: dict[tuple, Any] = {
    (): lambda args: (),
    (0,): lambda args: (args[0], None),
    (1,): lambda args: (None, args[1]),
    (0, 1): lambda args: args,
}


class Part(tuple):
    """(g, index, shape): a cotangent that is zero outside ``whole[index]``, and g there."""

    __slots__ = ()


def pull_of(fun, value, args, nums):
    """A call ``value = fun(*args)`` -> (pull, held), or None: autograd knows.

    ``pull(g, *held)``: the cotangents of args `nums`.
    """
    formulas = FORMULAS.get(fun)  # autograd's own: a primitive that a user made of NumPy's has other derivatives
    if formulas is None or type(value) not in NUMBERS or value.dtype is not FLOAT:
        return None
    for num in nums:
        arg = args[num]
        if type(arg) not in NUMBERS or arg.dtype is not FLOAT:
            return None
    return formulas[0](value, nums, args)


def tangent_of(fun, value, args, nums, tangents):
    """A call ``value = fun(*args)`` and the tangents of args `nums` -> that of the value; None: autograd knows."""
    formulas = FORMULAS.get(fun)
    if formulas is None or type(value) not in NUMBERS or value.dtype != FLOAT:
        return None
    for tangent in tangents:
        if type(tangent) not in REAL:
            return None
    tangent = formulas[1](value, nums, tangents, *args)
    return tangent if np.shape(tangent) == value.shape else None


def _entrywise(*acts):
    """Formulas of a function entry by entry: for each operand its derivative ``act(g, *args)``, and what that needs.

    A derivative is its own transpose. What is needed is a key of HELD: no array is held in vain.
    """
    act, other = acts[0][0], acts[-1][0]
    pulls = {
        (0,): (lambda g, *args: (act(g, *args),), HELD[acts[0][1]]),
        (1,): (lambda g, *args: (other(g, *args),), HELD[acts[-1][1]]),
        (0, 1): (lambda g, *args: (act(g, *args), other(g, *args)), HELD[acts[0][1] and (0, 1)]),
    }

    def back(value, nums, args):
        if nums[-1] >= len(acts):
            return None
        (pull, hold), shape = pulls[nums], value.shape
        for num in nums:
            if args[num].shape != shape:
                break
        else:
            return pull, hold(args)
        many = [value.ndim - args[num].ndim for num in nums]
        if any(shape[first:] != args[num].shape for num, first in zip(nums, many)):
            return None
        return (lambda g, *args: [_summed(back, first) for back, first in zip(pull(g, *args), many)]), hold(args)

    def forth(value, nums, tangents, *args):
        if nums[-1] >= len(acts):
            return None
        parts = [acts[num][0](tangent, *args) for num, tangent in zip(nums, tangents)]
        return parts[0] + parts[1] if len(nums) == 2 else parts[0]

    return back, forth


def _summed(g, many):
    """A cotangent summed over its first axes."""
    for _ in range(many):
        g = g.sum(axis=0)
    return g


def _item(value, nums, args):
    x, index = args
    if type(index) not in BASIC and not (type(index) is tuple and all(type(one) in BASIC for one in index)):
        return None
    return _part, ((index, x.shape),)


def _part(g, place):
    return (Part((g, *place)),)


def _array(value, nums, args):
    return None if args[0] or args[1] else (lambda g: [g[num - 2] for num in nums], ())


def _array_along(value, nums, tangents, positional, options, *entries):
    if positional or options:
        return None
    along = np.zeros(value.shape)
    for num, tangent in zip(nums, tangents, strict=True):
        along[num - 2] = tangent
    return along


# Of a function of autograd: (pull, held) from (value, nums, args), the tangent from (value, nums, tangents, *args).
FORMULAS: dict[Any, Any] = {
    anp.add: _entrywise((lambda g, *args: g, ()), (lambda g, *args: g, ())),
    anp.subtract: _entrywise((lambda g, *args: g, ()), (lambda g, *args: -g, ())),
    anp.multiply: _entrywise((lambda g, x, y: y * g, (1,)), (lambda g, x, y: x * g, (0,))),
    anp.true_divide: _entrywise((lambda g, x, y: g / y, (1,)), (lambda g, x, y: -g * x / y**2, (0, 1))),
    anp.power: _entrywise((lambda g, x, y: g * y * x ** np.where(y, y - 1, 1.0), (0, 1))),
    anp.negative: _entrywise((lambda g, *args: -g, ())),
    ITEM: (_item, lambda value, nums, tangents, x, index: tangents[0][index]),
    ARRAY: (_array, _array_along),
}
