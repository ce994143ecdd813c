"""Derivatives of the commonest calls on a tape: arithmetic of equal shapes, entries of arrays, arrays made of numbers.

autograd knows them all, and takes ten times as long: it is ready for broadcasting, other dtypes and traces inside
traces. What is here serves float64 alone; without it a gradient of small steps takes twice the time
(benchmarks/burgers.py, 200 steps of rk4).
"""

import operator
from functools import partial
from inspect import unwrap
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np

__all__ = [
    "ARRAY", "BOX", "COPY", "ITEM", "MAKERS", "NUMBERS", "OPERATORS", "PLAIN", "Part", "REAL", "pull_of", "tangent_of",
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
COPY, ARRAY = (unwrap(getattr(anp.numpy_wrapper, name)) for name in MAKERS)
RESHAPED = {ITEM, ARRAY}


class Part(NamedTuple):
    """A cotangent or tangent that is zero outside ``whole[index]``, and g there."""

    g: Any
    index: Any
    shape: tuple


def pull_of(fun, value, args, nums):
    """A call ``value = fun(*args)`` -> the function from g to the cotangents of args `nums`; None: autograd knows."""
    formulas = FORMULAS.get(fun)  # autograd's own: a primitive that a user made of NumPy's has other derivatives
    if formulas is None or value.dtype is not FLOAT:
        return None
    shape = None if fun in RESHAPED else value.shape
    for num in nums:
        arg = args[num]
        if type(arg) not in NUMBERS or arg.dtype is not FLOAT or (shape is not None and arg.shape != shape):
            return None
    pull = formulas[0](nums, *args)
    return pull and (lambda g: pull(g if getattr(g, "dtype", FLOAT) is FLOAT else _real(g)))


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


def _real(g):
    """Beside complex values autograd hands complex cotangents on to real ones."""
    return anp.real(g) if g.dtype.kind == "c" else g


def _of_two(factor):
    """factor(num, x, y), the derivative in an operand as a function of g that holds no array in vain -> both formulas.

    Entry by entry, a derivative is its own transpose.
    """

    def back(nums, x, y):
        one = factor(nums[0], x, y)
        if len(nums) == 1:
            return lambda g: (one(g),)
        other = factor(1, x, y)
        return lambda g: (one(g), other(g))

    def forth(value, nums, tangents, x, y):
        g = factor(nums[0], x, y)(tangents[0])
        return g + factor(1, x, y)(tangents[1]) if len(nums) == 2 else g

    return back, forth


def _same(g):
    return g


def _item(nums, x, index):
    if type(index) not in BASIC and not (type(index) is tuple and all(type(one) in BASIC for one in index)):
        return None
    shape = x.shape
    return lambda g: (Part(g, index, shape),)


def _array(nums, positional, options, *entries):
    return None if positional or options else lambda g: [g[num - 2] for num in nums]


def _array_along(value, nums, tangents, positional, options, *entries):
    if positional or options:
        return None
    along = np.zeros(value.shape)
    for num, tangent in zip(nums, tangents, strict=True):
        along[num - 2] = tangent
    return along


# Of a function of autograd: the pullback, from (nums, *args), and the tangent, from (value, nums, tangents, *args).
FORMULAS: dict[Any, Any] = {
    anp.add: _of_two(lambda num, x, y: _same),
    anp.subtract: _of_two(lambda num, x, y: operator.neg if num else _same),
    anp.multiply: _of_two(lambda num, x, y: partial(operator.mul, x if num else y)),
    anp.negative: (lambda nums, x: lambda g: (-g,), lambda value, nums, tangents, x: -tangents[0]),
    ITEM: (_item, lambda value, nums, tangents, x, index: tangents[0][index]),
    ARRAY: (_array, _array_along),
}
