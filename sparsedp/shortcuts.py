"""The commonest things that happen on a tape, without the detours that autograd takes for the rare ones."""

import operator
from functools import wraps
from inspect import unwrap
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np

__all__ = ["added", "along", "arithmetic", "direct", "install"]

FLOAT = np.dtype(float)
REAL = {np.ndarray, np.float64, float, int}
NUMBERS = {np.ndarray, np.float64}  # that have a shape and a dtype
PLAIN = {*REAL, slice, tuple, list, bool, type(None), type(Ellipsis)}  # operands that leave all to the traced one
BASIC = {int, slice, type(None), type(Ellipsis)}  # indices that meet no entry twice
MAKERS = "_array_from_scalar_or_array", "array_from_args"  # what anp.array calls
OPERATORS = {"add": "add", "sub": "subtract", "mul": "multiply", "truediv": "true_divide", "pow": "power"}
BOX = anp.numpy_boxes.ArrayBox
ITEM = unwrap(BOX.__getitem__)
COPY, ARRAY = (unwrap(getattr(anp.numpy_wrapper, name)) for name in MAKERS)


class Part(NamedTuple):
    """A cotangent that is zero outside ``whole[index]``, and g there."""

    g: Any
    index: Any
    shape: tuple


def added(known, back):
    """(sum so far, whether it may be written to) or None, a cotangent -> the new pair; None: autograd knows.

    The common cases of what autograd's ``add_outgrads`` does.
    """
    kind = type(back)
    if kind is Part and type(back.g) in REAL:
        if known is None:
            total = np.zeros(back.shape)
        elif type(known[0]) is np.ndarray and known[0].dtype == FLOAT:
            total = known[0] if known[1] else known[0].copy()
        else:
            return known[0] + added(None, back)[0], False
        total[back.index] += back.g
        return total, True
    if kind not in NUMBERS:
        return None
    if known is None:
        return back, False
    total, own = known
    if type(total) is not kind or total.dtype != back.dtype:
        return None
    total = np.add(total, back, out=total if own and kind is np.ndarray else None)
    return total, type(total) is np.ndarray


def direct(primitive, raw, boxes, new_box):
    """A primitive and the function below it -> the same, which asks autograd only where traces are nested.

    Parameters
    ----------
    primitive, raw : callable
    boxes : set of the types of traced values
    new_box : callable
        ``new_box(value, trace, node)``.
    """

    @wraps(primitive)
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


def install(boxes, new_box):
    """Give autograd's traced values quick operators; they ask autograd's own where traces are nested.

    Parameters
    ----------
    boxes, new_box
        As for `direct`.
    """

    def method(primitive, raw, left=True):
        """The traced value is the left operand of `primitive`, or the right one."""

        single = (0,) if left else (1,)

        @wraps(primitive)
        def call(box, other):
            node, kind, values = box._node, type(other), None  # type: Any, Any, Any
            nums, parents = single, (node,)  # type: Any, Any
            if kind in PLAIN:
                values = (box._value, other) if left else (other, box._value)
            elif kind in boxes and left and other._trace == box._trace:
                values, nums, parents = (box._value, other._value), (0, 1), (node, other._node)
            if values is None or type(values[0]) in boxes or type(values[1]) in boxes:
                return primitive(box, other) if left else primitive(other, box)
            ans = raw(*values)
            return new_box(ans, box._trace, type(node)(ans, primitive, values, {}, nums, parents))

        return call

    others: Any = unwrap(BOX.__array_ufunc__)
    right: dict[Any, Any] = {}

    @wraps(others)
    def array_ufunc(box, ufunc, how, *args, **options):
        """``array * box``, which NumPy hands over."""
        act = right.get(ufunc)
        if act and how == "__call__" and not options and len(args) == 2 and type(args[0]) in PLAIN and args[1] is box:
            return act(box, args[0])
        return others(box, ufunc, how, *args, **options)

    BOX.shape, BOX.__array_ufunc__ = property(lambda box: np.shape(box._value)), array_ufunc
    BOX.__getitem__, BOX.__neg__ = method(ITEM, operator.getitem), direct(anp.negative, np.negative, boxes, new_box)
    for name, ufunc in OPERATORS.items():
        primitive, raw = getattr(anp, ufunc), getattr(np, ufunc)
        right[raw] = method(primitive, raw, left=False)
        setattr(BOX, f"__{name}__", method(primitive, raw))
        setattr(BOX, f"__r{name}__", right[raw])
    quick = {name: direct(made, made.fun, boxes, new_box) for name, made in zip(MAKERS, (COPY, ARRAY))}

    @wraps(COPY)
    def copy(args, options, value):
        """A number needs no copy."""
        if type(value) in boxes and type(value._value) is np.float64 and not (args or options):
            return value
        return quick[MAKERS[0]](args, options, value)

    for name, made in zip(MAKERS, (copy, quick[MAKERS[1]])):
        setattr(anp.numpy_wrapper, name, made)


def arithmetic(fun, value, args, nums):
    """A call ``value = fun(*args)`` -> the function from g to the cotangents of args `nums`; None: autograd knows.

    For float64 that is not broadcast, sums, entries and arrays made of numbers; the formulas are those of autograd.
    """
    rule = FORMULAS.get(fun)  # autograd's own: a primitive that a user made of NumPy's has other derivatives
    if rule is None or value.dtype is not FLOAT:
        return None
    many = rule.__code__.co_argcount - 1
    if many and len(args) != many:
        return None
    shape = None if rule in RESHAPED else value.shape
    for num in nums:
        arg = args[num]
        if type(arg) not in NUMBERS or arg.dtype is not FLOAT or (shape is not None and arg.shape != shape):
            return None
    back = rule(nums, *args)
    return back and (lambda g: back(g if getattr(g, "dtype", FLOAT) is FLOAT else _real(g)))


def along(fun, value, args, nums, tangents):
    """A call ``value = fun(*args)`` and the tangents of args `nums` -> that of the value; None: autograd knows.

    For float64, without other traces; the formulas are those of autograd.
    """
    rule = TANGENTS.get(fun)
    if rule is None or type(value) not in NUMBERS or value.dtype != FLOAT:
        return None
    for g in tangents:
        if type(g) not in REAL:
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


def _power_along(value, nums, tangents, x, y):
    if nums != (0,) or type(y) not in (int, float) or type(x) not in REAL:
        return None
    return tangents[0] * y * x ** (y - 1 if y else 1.0)


def _negative_along(value, nums, tangents, x):
    return -tangents[0]


def _item_along(value, nums, tangents, x, index):
    return tangents[0][index]


def _copy_along(value, nums, tangents, positional, options, x):
    return None if positional or options else np.array(tangents[0])


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


def _item(nums, x, index):
    if type(index) not in BASIC and not (type(index) is tuple and all(type(one) in BASIC for one in index)):
        return None
    shape = x.shape
    return lambda g: (Part(g, index, shape),)


def _array(nums, *args):
    return None if args[0] or args[1] else lambda g: [g[num - 2] for num in nums]


def _copy(nums, positional, options, x):
    return None if positional or options else lambda g: (g,)


RESHAPED = _sum, _mean, _item, _array
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
    ITEM: _item,
    ARRAY: _array,
    COPY: _copy,
}
TANGENTS: dict[Any, Any] = {
    anp.add: _add_along,
    anp.subtract: _subtract_along,
    anp.multiply: _multiply_along,
    anp.true_divide: _divide_along,
    anp.divide: _divide_along,
    anp.negative: _negative_along,
    anp.power: _power_along,
    ITEM: _item_along,
    ARRAY: _array_along,
    COPY: _copy_along,
}
