"""Derivatives of the commonest calls on a tape: arithmetic, entries of arrays, arrays made of numbers.

autograd knows them all, and takes three to ten times as long: it is ready for all kinds of broadcasting, other dtypes
and traces inside traces. What is here serves float64 alone, and traced operands of the shape of their result; without
it a gradient of small steps takes twice the time (benchmarks/small.py, 200 steps of rk4).

Two calls stand here because autograd's derivatives of them are wrong: `full_like`, and reductions with options.
"""

import operator
from inspect import unwrap
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.backend import ARRAY_KINDS, BOX, formulas_of_kind, is_distributed
from sparsedp.errors import DerivativeError

__all__ = [
    "ACTS",
    "ARRAY",
    "COPY",
    "FLOAT",
    "ITEM",
    "MAKERS",
    "NUMBERS",
    "OPERATORS",
    "PLAIN",
    "REAL",
    "Part",
    "by_entry",
    "formulas_of",
    "in_dtype",
    "operand",
    "power_slope",
    "refuse_options",
]

FLOAT = np.dtype(float)
REAL = {np.ndarray, np.float64, float, int}
NUMBERS = {np.ndarray, np.float64}  # that have a shape and a dtype
PLAIN = {*REAL, slice, tuple, list, bool, type(None), type(Ellipsis)}  # operands that leave all to the traced one
BASIC = {int, slice, type(None), type(Ellipsis)}  # indices that meet no entry twice
OPERATORS = {
    "add": anp.add, "sub": anp.subtract, "mul": anp.multiply, "truediv": anp.true_divide, "pow": anp.power,
}  # fmt: skip
MAKERS = "_array_from_scalar_or_array", "array_from_args"  # what anp.array calls
ITEM = unwrap(BOX.__getitem__)
# Of NumPy's numbers the operators of Python take a tenth of the time; and a step that is run again without a tape has
# their bits: a power by the function may differ in the last one.
ACTS = {
    anp.add: operator.add, anp.subtract: operator.sub, anp.multiply: operator.mul,
    anp.true_divide: operator.truediv, anp.power: operator.pow, ITEM: operator.getitem,
}  # fmt: skip
_constant_full_like = anp.full_like
REDUCTIONS = "sum", "mean", "prod", "var", "std", "max", "min", "amax", "amin"
COPY, ARRAY = (unwrap(getattr(anp.numpy_wrapper, name)) for name in MAKERS)

# What of two operands a derivative needs -> what is held of them.
HELD: dict[tuple, Any] = {
    (): lambda args: (),
    (0,): lambda args: (args[0], None),
    (1,): lambda args: (None, args[1]),
    (0, 1): lambda args: args,
}


by_entry: set = set()  # pullbacks that act entry by entry


class Part(tuple):
    """(g, index, shape): zero outside ``whole[index]``, and g there."""

    __slots__ = ()


def formulas_of(fun, value, args, nums):
    """A call ``value = fun(*args)`` -> its two formulas in FORMULAS; None: autograd knows."""
    line = FORMULAS.get(fun)  # autograd's own: a primitive that a user made of NumPy's has other derivatives
    if line is None or type(value) not in NUMBERS or value.dtype is not FLOAT:
        return formulas_of_kind(fun, value, args, nums) if ARRAY_KINDS else None
    for num in nums:
        arg = args[num]
        if type(arg) not in NUMBERS or arg.dtype is not FLOAT:
            return formulas_of_kind(fun, value, args, nums) if ARRAY_KINDS else None
    return line[1:] if line[0](value, nums, args) else None


def _full_like(a, fill_value, *args, **options):
    """As NumPy's; autograd's takes a traced value to fill with as a constant."""
    ans = _constant_full_like(a, fill_value, *args, **options)
    if type(fill_value) is BOX and ans.dtype.kind in "fc":
        return (np.zeros_like(ans) + fill_value).astype(ans.dtype)
    return ans


def refuse_options(fun, options):
    """Autograd's rules of reductions know neither the entries that are left out nor what is begun with."""
    if fun.__name__ in REDUCTIONS and {"where", "initial"} & options.keys():
        raise DerivativeError(
            f"autograd's derivative of {fun.__name__} does not know where= and initial=; choose entries by x[mask] or "
            "anp.where(mask, x, 0.0), and put what it begins with beside it"
        )


def in_dtype(value, dtype):
    """Plain value -> the same numbers in a dtype."""
    return value.astype(dtype) if is_distributed(value) else np.asarray(value, dtype)


def _entrywise(*acts):
    """A line for a function entry by entry: for each operand its derivative ``act(g, *args)``, and what that needs.

    A derivative is its own transpose. What is needed is a key of HELD: no array is held in vain.
    """
    (act, need), (other, needs) = acts[0], acts[-1]
    pulls: dict[tuple, Any] = {(0,): (lambda g, *args: (act(g, *args),), HELD[need])}
    if len(acts) == 2:
        pulls[1,] = lambda g, *args: (other(g, *args),), HELD[needs]
        pulls[0, 1] = lambda g, *args: (act(g, *args), other(g, *args)), HELD[need and (0, 1)]

    by_entry.update(pull for pull, _ in pulls.values())

    def fits(value, nums, args):
        for num in nums:
            if args[num].shape != value.shape:
                return False
        return nums in pulls

    def back(nums, args):
        pull, hold = pulls[nums]
        return pull, hold(args if len(nums) == len(args) else [*map(operand, args)])

    return fits, back, lambda g, num, args, shape: acts[num][0](g, *map(operand, args))


def operand(x):
    """An operand as NumPy takes it: one less than a list is no list, and it may hold traced values."""
    return anp.array(x) if type(x) is list or type(x) is tuple else x


def _is_basic(value, nums, args):
    index = args[1]
    return type(index) in BASIC or (type(index) is tuple and all(type(one) in BASIC for one in index))


def _part(g, place):
    return (Part((g, *place)),)


def _entries(g, nums):
    return [g[num - 2] for num in nums]


def power_slope(g, x, y):
    """Return g times the derivative of x**y in x, without the overflow of x**(y - 1) for a negative number y."""
    if type(y) in (int, float) and y < 0:
        return g / x * y * x**y
    where = anp.where if type(y) is BOX else np.where  # the latter is faster
    return g * y * x ** where(y, y - 1, 1.0)


# The square of a divisor below 1e-162 underflows to 0; the quotient x / y and its derivative may still be finite.
_quotient = _entrywise((lambda g, x, y: g / y, (1,)), (lambda g, x, y: -g * (x / y) / y, (0, 1)))

# Of a function of autograd: whether the formulas hold, from (value, nums, args); (pull, held), from (nums, args), with
# ``pull(g, *held)`` the cotangents of args `nums`; what a tangent of one of them gives, from (g, num, args, shape).
FORMULAS: dict[Any, Any] = {
    anp.add: _entrywise((lambda g, *args: g, ()), (lambda g, *args: g, ())),
    anp.subtract: _entrywise((lambda g, *args: g, ()), (lambda g, *args: -g, ())),
    anp.multiply: _entrywise((lambda g, x, y: y * g, (1,)), (lambda g, x, y: x * g, (0,))),
    anp.true_divide: _quotient,
    anp.divide: _quotient,
    anp.power: _entrywise((power_slope, (0, 1))),
    anp.negative: _entrywise((lambda g, *args: -g, ())),
    ITEM: (
        _is_basic,
        lambda nums, args: (_part, ((args[1], args[0].shape),)),
        lambda g, num, args, shape: (np.asarray(g) if type(g) is float else g)[args[1]],
    ),
    ARRAY: (
        lambda value, nums, args: not (args[0] or args[1]),
        lambda nums, args: (_entries, (nums,)),
        lambda g, num, args, shape: Part((g, num - 2, shape)),
    ),
}

anp.full_like = _full_like
