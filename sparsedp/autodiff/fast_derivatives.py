"""Derivatives of the most frequent calls on a tape: arithmetic, indexing, and arrays built from numbers.

autograd has all of these derivatives, but takes three to ten times as long, because it handles all cases of
broadcasting, all dtypes and nested traces. The formulas of this module apply only to float64, and to traced operands
with the shape of the result; in other cases autograd is used. Without these formulas a gradient through steps of a
small problem takes twice the time (benchmarks/small.py, 200 steps of rk4).
"""

from __future__ import annotations

import operator
from inspect import unwrap
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.backend import BOX, as_field, formulas_of_kind
from sparsedp.autodiff.program_trace import is_recorded, sample
from sparsedp.errors import DerivativeError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import DTypeLike

__all__ = [
    "ARRAY",
    "BOTH",
    "COPY",
    "FIRST",
    "FLOAT",
    "FORMULAS",
    "ITEM",
    "MAKERS",
    "NUMBERS",
    "OPERATORS",
    "PLAIN",
    "PYTHON_OPERATORS",
    "REAL",
    "SECOND",
    "Formula",
    "Part",
    "by_entry",
    "denominator_slope",
    "distributed_formula",
    "in_dtype",
    "numerator_slope",
    "operand",
    "power_slope",
    "refuse_options",
]

FLOAT = np.dtype(float)
NUMBERS = {np.ndarray, np.float64}  # types with a shape and a dtype
SCALARS = {np.float64, float}
REAL = {np.ndarray, np.float64, float, int}
# Types of operands that do not define their own operator with a traced value.
PLAIN = {*REAL, slice, tuple, list, bool, type(None), type(Ellipsis)}
SEQUENCES = {list, tuple}
BASIC = {int, slice, type(None), type(Ellipsis)}  # basic indexing selects no entry twice
# Operators of Python by the name of their method.
OPERATORS = {
    "add": anp.add,
    "sub": anp.subtract,
    "mul": anp.multiply,
    "truediv": anp.true_divide,
    "pow": anp.power,
}
MAKERS = "_array_from_scalar_or_array", "array_from_args"  # functions that anp.array calls
ITEM = unwrap(BOX.__getitem__)
COPY = unwrap(getattr(anp.numpy_wrapper, MAKERS[0]))
ARRAY = unwrap(getattr(anp.numpy_wrapper, MAKERS[1]))
# For NumPy scalars the operators of Python take a tenth of the time of NumPy's functions. They are also used without a
# tape; the last bit of a power may differ between operator and function, but a step must give the same bits with and
# without a tape.
PYTHON_OPERATORS = {
    anp.add: operator.add,
    anp.subtract: operator.sub,
    anp.multiply: operator.mul,
    anp.true_divide: operator.truediv,
    anp.power: operator.pow,
    ITEM: operator.getitem,
}
REDUCTIONS = "sum", "mean", "prod", "var", "std", "max", "min", "amax", "amin"
FIRST = (0,)  # positions of the traced operands of a function of two operands
SECOND = (1,)
BOTH = (0, 1)
by_entry: set = set()  # pullbacks of elementwise functions


class Part(tuple):
    """A cotangent (g, index, shape) for an array of this shape, which is g at the index and zero elsewhere."""

    __slots__ = ()


class Formula(NamedTuple):
    """Derivatives of a function of autograd.

    Attributes
    ----------
    backward : callable
        ``backward(value, nums, args)`` returns the pair (pull, held) for a call with the result `value` and traced
        arguments at the positions `nums`, or None if the formula does not apply to this call. ``pull(g, *held)``
        returns the cotangents of the arguments `nums`.
    forward : callable
        ``forward(g, num, args, shape)`` returns the tangent of the result, which has this shape, for the tangent g of
        the argument at position `num`.
    """

    backward: Callable
    forward: Callable


def distributed_formula(function: Callable, value: Any, args: Sequence, nums: Sequence[int]) -> Formula | None:
    """Return the formula for a call with a distributed field, see `ArrayKind.formulas`; None if there is none."""
    formulas = formulas_of_kind(function, value, tuple(args), tuple(nums))
    if formulas is None:
        return None
    backward, forward = formulas
    return Formula(lambda value, nums, args: backward(nums, args), forward)


def refuse_options(function: Callable, options: dict) -> None:
    """Raise DerivativeError for the options `where` and `initial` of reductions, which autograd ignores."""
    if function.__name__ in REDUCTIONS and {"where", "initial"} & options.keys():
        raise DerivativeError(
            f"autograd's derivative of {function.__name__} does not know where= and initial=; choose entries by "
            "x[mask] or anp.where(mask, x, 0.0), and add the initial value to the result"
        )


def in_dtype(value: Any, dtype: DTypeLike) -> Any:
    """Convert a plain value to a dtype."""
    return as_field(value).astype(dtype, copy=False)


def operand(x: Any) -> Any:
    """Convert a list or tuple, which may contain traced values, to an array; return other values unchanged."""
    if type(x) in SEQUENCES:
        return anp.array(x)
    return x


# ---- elementwise functions -------------------------------------------------------------------------------------------


def power_slope(g: Any, x: Any, y: Any) -> Any:
    """Return g times dx**y / dx; for a negative number y without x**(y - 1), which may overflow."""
    if type(y) in (int, float) and y < 0:
        return g / x * y * x**y
    where = anp.where if type(y) is BOX else np.where  # the latter is faster
    return g * y * x ** where(y, y - 1, 1.0)


def numerator_slope(g: Any, x: Any, y: Any) -> Any:
    """Return g times the derivative of x / y with respect to x."""
    return g / y


def denominator_slope(g: Any, x: Any, y: Any) -> Any:
    """Return g times the derivative of x / y with respect to y, without y**2, which underflows for y below 1e-162."""
    return -g * (x / y) / y


def _entrywise(*slopes):
    """Return the formula of an elementwise function, whose JVP and VJP are the same product.

    Parameters
    ----------
    *slopes : (callable, tuple of int)
        For each operand the function ``slope(g, *args)``, which returns g times the derivative with respect to this
        operand, and the positions of the operands that it uses. The tape stores only these.
    """
    slope, needed = slopes[0]

    def pull_first(g, *args):
        return (slope(g, *args),)

    pulls: dict[tuple[int, ...], tuple[Callable, tuple]] = {FIRST: (pull_first, needed)}
    if len(slopes) == 2:
        second_slope, needed_by_second = slopes[1]

        def pull_second(g, *args):
            return (second_slope(g, *args),)

        def pull_both(g, *args):
            return slope(g, *args), second_slope(g, *args)

        pulls[SECOND] = pull_second, needed_by_second
        pulls[BOTH] = pull_both, BOTH if needed else ()
    by_entry.update(pull for pull, _ in pulls.values())

    def backward(value, nums, args):
        forms = args
        if type(value) is BOX:
            if not is_recorded(value):
                return None
            value = value._value
            forms = list(map(sample, args))
        if type(value) in SCALARS:
            for num in nums:
                if type(forms[num]) not in SCALARS:
                    return None
        elif type(value) is np.ndarray and value.dtype is FLOAT:
            shape = value.shape
            for num in nums:
                arg = forms[num]
                if type(arg) is not np.ndarray or arg.dtype is not FLOAT or arg.shape != shape:
                    return None
        else:
            return None
        if nums not in pulls:
            return None
        pull, needed = pulls[nums]
        if not needed:
            return pull, ()
        if len(nums) < len(args) and (type(args[0]) in SEQUENCES or type(args[1]) in SEQUENCES):
            args = [operand(arg) for arg in args]
        if needed == BOTH:
            return pull, args
        return pull, (args[0], None) if needed == FIRST else (None, args[1])

    def forward(g, num, args, shape):
        return slopes[num][0](g, *map(operand, args))

    return Formula(backward, forward)


# ---- entries of arrays, and arrays of numbers ------------------------------------------------------------------------


def _is_real(value):
    """Return True for a float64 number or array, plain or recorded in a program."""
    if type(value) is BOX and is_recorded(value):
        value = value._value
    return type(value) is np.float64 or (type(value) is np.ndarray and value.dtype is FLOAT)


def _pull_part(g, place):
    return (Part((g, *place)),)


def _item_backward(value, nums, args):
    array, index = args
    is_basic = type(index) in BASIC or (type(index) is tuple and all(type(one) in BASIC for one in index))
    if is_basic and _is_real(value) and _is_real(array):
        return _pull_part, ((index, array.shape),)
    return None


def _item_forward(g, num, args, shape):
    if type(g) is float:
        g = np.asarray(g)
    return g[args[1]]


def _pull_entries(g, nums):
    return [g[num - 2] for num in nums]


def _array_backward(value, nums, args):
    has_options = args[0] or args[1]
    if has_options or not _is_real(value) or not all(_is_real(args[num]) for num in nums):
        return None
    return _pull_entries, (nums,)


def _array_forward(g, num, args, shape):
    return Part((g, num - 2, shape))


_quotient = _entrywise((numerator_slope, SECOND), (denominator_slope, BOTH))

FORMULAS: dict[Any, Formula] = {
    anp.add: _entrywise((lambda g, *args: g, ()), (lambda g, *args: g, ())),
    anp.subtract: _entrywise((lambda g, *args: g, ()), (lambda g, *args: -g, ())),
    anp.multiply: _entrywise((lambda g, x, y: y * g, SECOND), (lambda g, x, y: x * g, FIRST)),
    anp.true_divide: _quotient,
    anp.divide: _quotient,
    anp.power: _entrywise((power_slope, BOTH)),
    anp.negative: _entrywise((lambda g, *args: -g, ())),
    ITEM: Formula(_item_backward, _item_forward),
    ARRAY: Formula(_array_backward, _array_forward),
}
