"""The commonest things that happen on a tape, without the detours that autograd takes for the rare ones.

Each buys a third or more of a gradient of small steps (benchmarks/burgers.py, 200 steps of rk4); what buys less is not
here.
"""

import operator
from functools import partial, wraps
from inspect import unwrap
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np

__all__ = ["added", "along", "arithmetic", "direct", "install", "noted"]

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
MEAN = getattr(anp.numpy_wrapper, "_primitive_mean", anp.mean)  # in newer versions anp.mean only calls it
RESHAPED = {anp.sum, MEAN, ITEM, ARRAY}


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
    if known is None or kind is not type(known[0]) or kind not in NUMBERS or known[0].dtype != back.dtype:
        return None
    total = np.add(known[0], back, out=known[0] if known[1] and kind is np.ndarray else None)
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
        trace = args[nums[0]]._trace
        for num in nums:
            box = args[num]
            if box._trace != trace or type(box._value) in boxes:
                return primitive(*args)
        return noted(primitive, raw, args, nums, new_box)

    return call


def noted(primitive, raw, args, nums, new_box):
    """A call whose arguments `nums` are on one trace: `raw` of what is below it, and a node for `primitive`."""
    values, parents = list(args), []
    for num in nums:
        values[num] = args[num]._value
        parents.append(args[num]._node)
    ans = raw(*values)
    node = type(parents[0])(ans, primitive, tuple(values), {}, tuple(nums), tuple(parents))
    return new_box(ans, args[nums[0]]._trace, node)


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

    BOX.shape, BOX.__getitem__ = property(lambda box: np.shape(box._value)), method(ITEM, operator.getitem)
    for name, ufunc in OPERATORS.items():
        for left in (True, False):
            setattr(BOX, f"__{'r' * (not left)}{name}__", method(getattr(anp, ufunc), getattr(np, ufunc), left))
    copy, array = (direct(made, made.fun, boxes, new_box) for made in (COPY, ARRAY))

    @wraps(COPY)
    def copy_of(args, options, value):
        """A number needs no copy."""
        number = type(value) in boxes and type(value._value) is np.float64 and not (args or options)
        return value if number else copy(args, options, value)

    for name, made in zip(MAKERS, (copy_of, array), strict=True):
        setattr(anp.numpy_wrapper, name, made)


def arithmetic(fun, value, args, nums):
    """A call ``value = fun(*args)`` -> the function from g to the cotangents of args `nums`; None: autograd knows.

    For float64 that is not broadcast, entries and arrays made of numbers; the formulas are those of autograd.
    """
    rule = RULES.get(fun)  # autograd's own: a primitive that a user made of NumPy's has other derivatives
    if rule is None or value.dtype is not FLOAT:
        return None
    shape = None if fun in RESHAPED else value.shape
    for num in nums:
        arg = args[num]
        if type(arg) not in NUMBERS or arg.dtype is not FLOAT or (shape is not None and arg.shape != shape):
            return None
    back = rule[0](nums, *args)
    return back and (lambda g: back(g if getattr(g, "dtype", FLOAT) is FLOAT else _real(g)))


def along(fun, value, args, nums, tangents):
    """A call ``value = fun(*args)`` and the tangents of args `nums` -> that of the value; None: autograd knows.

    For float64, without other traces; the formulas are those of autograd.
    """
    rule = RULES.get(fun)
    if rule is None or type(value) not in NUMBERS or value.dtype != FLOAT:
        return None
    for g in tangents:
        if type(g) not in REAL:
            return None
    g = rule[1](value, nums, tangents, *args)
    return g if np.shape(g) == value.shape else None


def _real(g):
    """Beside complex values autograd hands complex cotangents on to real ones."""
    return anp.real(g) if g.dtype.kind == "c" else g


def _of_two(part):
    """part(num, x, y), the derivative in an operand as a function of g that holds no array in vain -> (vjp, jvp)."""

    def back(nums, x, y):
        act = part(nums[0], x, y)
        if len(nums) == 1:
            return lambda g: (act(g),)
        other = part(1, x, y)
        return lambda g: (act(g), other(g))

    def forth(value, nums, tangents, x, y):
        g = part(nums[0], x, y)(tangents[0])
        return g + part(1, x, y)(tangents[1]) if len(nums) == 2 else g

    return back, forth


def _total(many):
    """many(x), by which a sum of all entries is divided -> its vjp."""

    def back(nums, x, *axis):
        shape, divisor = x.shape, many(x)
        return None if axis or not divisor else lambda g: (_everywhere(g / divisor, shape),)

    return back


def _everywhere(g, shape):
    return np.full(shape, g) if type(g) in (float, np.float64) else g * np.ones(shape)


def _same(g):
    return g


def _none(*args):
    """What is left to autograd."""


def _item(nums, x, index):
    if type(index) not in BASIC and not (type(index) is tuple and all(type(one) in BASIC for one in index)):
        return None
    shape = x.shape
    return lambda g: (Part(g, index, shape),)


def _array(nums, *args):
    return None if args[0] or args[1] else lambda g: [g[num - 2] for num in nums]


def _array_along(value, nums, tangents, positional, options, *parts):
    g = np.zeros(value.shape)
    for num, tangent in zip(nums, tangents):
        g[num - 2] = tangent
    return None if positional or options else g


def _copy(nums, positional, options, x):
    return None if positional or options else lambda g: (g,)


# Of a function of autograd: vjp(nums, *args) -> back, and jvp(value, nums, tangents, *args).
RULES: dict[Any, Any] = {
    anp.add: _of_two(lambda num, x, y: _same),
    anp.subtract: _of_two(lambda num, x, y: operator.neg if num else _same),
    anp.multiply: _of_two(lambda num, x, y: partial(operator.mul, x if num else y)),
    anp.negative: (lambda nums, x: lambda g: (-g,), lambda value, nums, tangents, x: -tangents[0]),
    anp.sum: (_total(lambda x: 1), _none),
    MEAN: (_total(np.size), _none),
    ITEM: (_item, lambda value, nums, tangents, x, index: tangents[0][index]),
    ARRAY: (_array, _array_along),
    COPY: (_copy, lambda value, nums, tangents, positional, options, x: np.array(tangents[0], *positional, **options)),
}
