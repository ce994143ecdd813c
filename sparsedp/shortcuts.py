"""The commonest things that happen on a tape, without the detours that autograd takes for the rare ones."""

from typing import Any

import autograd.numpy as anp
import numpy as np

__all__ = ["added", "along", "arithmetic", "direct"]

FLOAT = np.dtype(float)
REAL = {np.ndarray, np.float64, float, int}


def added(known, back):
    """(sum so far, whether it may be written to) or None, an array -> the new pair; None when not both are arrays.

    The common cases of what autograd's ``add_outgrads`` does.
    """
    if type(back) is not np.ndarray:
        return None
    if known is None:
        return back, False
    total, own = known
    if type(total) is not np.ndarray or total.dtype != back.dtype:
        return None
    return np.add(total, back, out=total if own else None), True


def direct(primitive, raw, boxes, new_box):
    """A primitive and the function below it -> the same, which asks autograd only where traces are nested.

    Parameters
    ----------
    primitive, raw : callable
    boxes : set of the types of traced values
    new_box : callable
        ``new_box(value, trace, node)``.
    """

    def call(*args):
        nums = [num for num, arg in enumerate(args) if type(arg) in boxes]
        if not nums:
            return raw(*args)
        trace, values, parents = args[nums[0]]._trace, list(args), []
        for num in nums:
            box = args[num]
            values[num] = box._value
            if box._trace != trace or type(values[num]) in boxes:
                return primitive(*args)
            parents.append(box._node)
        ans = raw(*values)
        return new_box(ans, trace, type(parents[0])(ans, primitive, tuple(values), {}, tuple(nums), tuple(parents)))

    return call


def arithmetic(fun, value, args, nums):
    """A call ``value = fun(*args)`` -> the function from g to the cotangents of args `nums`; None: autograd knows.

    For arrays of float64 that are not broadcast, and their sums; the formulas are those of autograd.
    """
    rule = FORMULAS.get(fun)  # autograd's own: a primitive that a user made of NumPy's has other derivatives
    if rule is None or len(args) != rule.__code__.co_argcount - 1 or value.dtype != FLOAT:
        return None
    shape = args[0].shape if rule in TOTALS and type(args[0]) is np.ndarray else value.shape
    for num in nums:
        arg = args[num]
        if type(arg) is not np.ndarray or arg.shape != shape or arg.dtype != FLOAT:
            return None
    back = rule(nums, *args)
    return back and (lambda g: back(g if getattr(g, "dtype", FLOAT) == FLOAT else _real(g)))


def along(fun, value, args, nums, tangents):
    """A call ``value = fun(*args)`` and the tangents of args `nums` -> that of the value; None: autograd knows.

    For float64, without other traces; the formulas are those of autograd.
    """
    rule = TANGENTS.get(fun)
    if rule is None or getattr(value, "dtype", None) != FLOAT or any(type(g) not in REAL for g in tangents):
        return None
    return rule(value, nums, tangents, *args)


def _add_along(value, nums, tangents, x, y):
    if len(nums) == 2:
        return tangents[0] + tangents[1]
    return tangents[0] if np.shape(tangents[0]) == value.shape else None


def _subtract_along(value, nums, tangents, x, y):
    if len(nums) == 2:
        return tangents[0] - tangents[1]
    g = -tangents[0] if nums[0] else tangents[0]
    return g if np.shape(g) == value.shape else None


def _multiply_along(value, nums, tangents, x, y):
    if type(x) not in REAL or type(y) not in REAL:
        return None
    if len(nums) == 2:
        return tangents[0] * y + x * tangents[1]
    return x * tangents[0] if nums[0] else tangents[0] * y


def _divide_along(value, nums, tangents, x, y):
    if type(x) not in REAL or type(y) not in REAL:
        return None
    if len(nums) == 2:
        return tangents[0] / y - tangents[1] * x / y**2
    return -tangents[0] * x / y**2 if nums[0] else tangents[0] / y


def _negative_along(value, nums, tangents, x):
    return -tangents[0]


def _item_along(value, nums, tangents, x, index):
    return tangents[0][index]


def _array_along(value, nums, tangents, positional, options, *parts):
    if positional or options:
        return None
    g = np.zeros(value.shape)
    for num, tangent in zip(nums, tangents):
        g[num - 2] = tangent
    return g


def _real(g):
    """Beside complex values autograd hands complex cotangents on to real ones."""
    return anp.real(g) if g.dtype.kind == "c" else g


def _add(nums, x, y):
    return (lambda g: (g,)) if len(nums) == 1 else lambda g: (g, g)


def _subtract(nums, x, y):
    if len(nums) == 2:
        return lambda g: (g, -g)
    return (lambda g: (g,)) if nums[0] == 0 else lambda g: (-g,)


def _multiply(nums, x, y):
    if len(nums) == 2:
        return lambda g: (y * g, x * g)
    other = x if nums[0] else y
    return lambda g: (other * g,)


def _divide(nums, x, y):
    if len(nums) == 2:
        return lambda g: (g / y, -g * x / y**2)
    return (lambda g: (-g * x / y**2,)) if nums[0] else lambda g: (g / y,)


def _negative(nums, x):
    return lambda g: (-g,)


def _power(nums, x, y):
    if nums != (0,) or type(y) not in (int, float):
        return None
    return lambda g: (g * y * x ** (y - 1 if y else 1.0),)


def _sum(nums, x):
    shape = x.shape
    return lambda g: (_everywhere(g, shape),)


def _mean(nums, x):
    shape, many = x.shape, x.size
    return (lambda g: (_everywhere(g / many, shape),)) if many else None


def _everywhere(g, shape):
    return np.full(shape, g) if type(g) in (float, np.float64) else g * np.ones(shape)


TOTALS = _sum, _mean
FORMULAS: dict[Any, Any] = {
    anp.add: _add,
    anp.subtract: _subtract,
    anp.multiply: _multiply,
    anp.true_divide: _divide,
    anp.divide: _divide,
    anp.negative: _negative,
    anp.power: _power,
    anp.sum: _sum,
    getattr(anp.numpy_wrapper, "_primitive_mean", anp.mean): _mean,  # in newer versions anp.mean only calls it
}
TANGENTS: dict[Any, Any] = {
    anp.add: _add_along,
    anp.subtract: _subtract_along,
    anp.multiply: _multiply_along,
    anp.true_divide: _divide_along,
    anp.divide: _divide_along,
    anp.negative: _negative_along,
    anp.numpy_boxes.ArrayBox.__getitem__: _item_along,
    anp.array_from_args: _array_along,
}
