"""Validation of arguments: fields, numbers, functions and result arrays.

Each function `check_*` raises an error if a value is invalid. Its argument `name` is the subject of the message.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from decimal import ROUND_FLOOR, Context
from inspect import CO_VARARGS
from math import isfinite
from types import FunctionType
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.calls import advice_near
from sparsedp._utils.pytree import labels, leaves
from sparsedp.errors import NonFiniteError, ShapeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = [
    "BLOCK",
    "EPS",
    "PRECISIONS",
    "advise",
    "check_choice",
    "check_finite",
    "check_function",
    "check_in_range",
    "check_integer",
    "check_kind",
    "check_leaves",
    "check_native",
    "check_number",
    "check_on",
    "check_out",
    "check_plain",
    "check_precision",
    "check_shape",
    "check_takes",
    "check_type",
    "check_whole",
    "field_array",
    "hidden_leaves",
    "is_number",
    "is_other_precision",
    "is_whole",
    "number_beside",
    "place",
    "rounded_down",
    "surely_finite",
]

FLOAT = np.dtype(float)
EPS = np.finfo(float).eps  # distance from 1 to the next larger float
WRAP = "{0}; wrap what is computed in dp.interop.to_{0}(f), which keeps gradients"
# Package that defines the type of an array -> name of the library, and advice for the error message.
LIBRARIES = {
    "torch": WRAP.format("torch"),
    "jax": WRAP.format("jax"),
    "jaxlib": WRAP.format("jax"),
    "xarray": "xarray, whose coordinates would be lost; write dp.interop.from_xarray(grid, u)",
}
PRECISIONS = "fdFD"  # type characters of the dtypes of fields and trees, see `check_precision`
PLAIN_LEAVES = {float, complex, int, bool, str, type(None)}
BLOCK = 8192  # largest number of entries for one BLAS product, since BLAS uses several threads above 10000


def field_array(op: Any, u: Any, batch: bool = False) -> np.ndarray:
    """Convert the argument of an operator to an array in C order and native byte order, of float or complex dtype.

    Parameters
    ----------
    op : Operator
    u : array_like
    batch : bool
        Whether leading axes are allowed, so that the array contains several fields.

    Raises
    ------
    ShapeError
        If the array is not a field on the domain of the operator.
    TypeError
        If the array is not numeric.
    """
    if type(u) is not np.ndarray:
        check_plain(op.name, u)
        u = _array(op, u)
    shape = op.domain.shape
    if u.shape != shape and not (batch and _is_batch(u.shape, shape)):
        raise ShapeError(
            f"{op.name} takes a field on {op.domain.described}, got an array of shape {u.shape}{_in_shape(op, u)}"
        )
    if u.dtype.char not in PRECISIONS:
        if u.dtype.kind not in "biu":
            raise TypeError(f"{op.name} takes float or complex numbers, got dtype {u.dtype}; write u.astype(float)")
        u = u.astype(float)
    if not u.flags.c_contiguous or not u.dtype.isnative:
        u = np.ascontiguousarray(u, dtype=u.dtype.newbyteorder("="))
    return u


def _is_batch(shape, field_shape):
    """Return whether the last axes have the shape of a field; always true for a 0-d field, which has no axes."""
    lead = len(shape) - len(field_shape)
    return lead >= 0 and shape[lead:] == field_shape


def _in_shape(op, u):
    """Return advice for an array whose wrong shape suggests what the user intended; else an empty string."""
    space = op.domain
    if u.ndim == 0:
        return f"; write np.full({space.shape}, {u})"
    if u.shape == (space.size,):
        return f"; write op(u.reshape{space.shape}), or op @ u for a flat array"
    if u.ndim == 2 and u.shape[0] == space.size:
        return "; for the columns of a matrix, as lobpcg of SciPy gives them, write op.to_scipy()"
    return ""


def _array(op, u):
    """Convert an argument of an operator to an array; raise ShapeError for a list of arrays of different shapes."""
    try:
        return np.asarray(u)
    except ValueError:  # a list of arrays of different shapes
        parts = "grid.join(*parts)" if op.domain.kind == "faces" else "op.domain.join(*parts)"
        raise ShapeError(
            f"{op.name} takes one array on {op.domain.described}, got {len(u)} parts; write {parts}"
        ) from None


def check_plain(name: str, *values: Any) -> None:
    """Raise TypeError for masked arrays, whose mask NumPy would drop silently, and for arrays of other libraries."""
    if any(isinstance(value, np.ma.MaskedArray) for value in values):
        raise TypeError(f"{name} takes plain arrays, got a masked array; fill it first")
    check_native(name, *values)


def check_native(name: str, *values: Any) -> None:
    """Raise TypeError for arrays of torch, jax and xarray, whose gradients or coordinates would be lost."""
    for value in values:
        kind = type(value)
        if kind is np.ndarray:
            continue
        library = kind.__module__.partition(".")[0]
        if library in LIBRARIES:
            raise TypeError(f"{name} needs arrays of NumPy, got a {kind.__name__} of {LIBRARIES[library]}")


def check_precision(name: str, value: Any) -> None:
    """Raise TypeError for arrays of half and of extended precision.

    The library computes with float32, float64, complex64 and complex128. Fields and trees of other precisions
    (float16, longdouble, clongdouble) raise an error, because a longdouble would lose digits silently and its memory
    cannot be viewed as float64. Integers and booleans are accepted. Settings such as dt, and derivatives returned by a
    user's function, are not checked here; they are rounded to double precision.
    """
    dtype: Any = getattr(value, "dtype", None)
    if is_other_precision(dtype):
        kind = "complex" if dtype.kind == "c" else "float"
        raise TypeError(
            f"{name} must be float32, float64, complex64 or complex128, got {dtype}; write np.asarray(x, {kind})"
        )


def is_other_precision(dtype: Any) -> bool:
    """Return whether a NumPy dtype is floating or complex, but of neither single nor double precision."""
    if not isinstance(dtype, np.dtype) or dtype.char in PRECISIONS:
        return False
    return dtype.kind in "fc" or dtype.name == "bfloat16"


def check_leaves(name: str, tree: Any, containers: bool = True) -> None:
    """Raise TypeError for leaves of half or extended precision, and for containers that are not trees.

    Parameters
    ----------
    name : str
        Name of the tree, with which paths in error messages begin.
    tree : tree
    containers : bool
        Whether to raise an error for a container with floating numbers that is not a tree, such as a Mapping that is
        not a dict. It would be a leaf, and its numbers would silently be constants.

    Raises
    ------
    TypeError
    """
    if type(tree) is np.ndarray:
        check_precision(name, tree)
        return
    for number, leaf in enumerate(leaves(tree)):
        dtype = getattr(leaf, "dtype", None)
        if dtype is not None:
            if is_other_precision(dtype):
                check_precision(labels(tree, name)[number], leaf)
        elif containers and type(leaf) not in PLAIN_LEAVES and any(map(_is_floating, hidden_leaves(leaf))):
            raise TypeError(
                f"{labels(tree, name)[number]} is a {type(leaf).__name__}, which is not a tree: its numbers would have "
                "no derivative; write a dict, a NamedTuple or a plain dataclass"
            )


def hidden_leaves(value: Any) -> list:
    """Return the leaves inside a container that is not a tree: some dataclasses, and Mappings that are not dicts."""
    hidden: list = []
    if type(value) in PLAIN_LEAVES or type(value) is np.ndarray:
        return hidden
    pending = [value]
    seen = set()  # a dataclass may contain itself
    while pending:
        container = pending.pop()
        if id(container) in seen:
            continue
        seen.add(id(container))
        inside = leaves(_entries_of(container))
        hidden += inside
        pending += inside
    return hidden


def _entries_of(container):
    """Return the list of the entries of a dataclass or Mapping; an empty list for other values."""
    if isinstance(container, Mapping):
        return list(container.values())
    if is_dataclass(container) and not isinstance(container, type):
        return [getattr(container, field.name, None) for field in fields(container)]
    return []


def _is_floating(leaf):
    """Return True if a leaf is a floating number or array, traced or not."""
    if isinstance(leaf, (float, complex)):
        return True
    dtype = getattr(leaf, "dtype", None)
    return getattr(dtype, "kind", None) in ("f", "c")


def check_out(op: Any, out: Any, u: np.ndarray, dtype: np.dtype, shape: tuple[int, ...]) -> None:
    """Raise an error for an array `out` of a wrong shape or dtype, or that shares memory with the argument `u`."""
    example = f"out=np.empty({shape}, {dtype.name!r})"
    check_type(f"{op.name}, as out,", out, np.ndarray, "an array", example)
    if out.shape != shape:
        raise ShapeError(f"{op.name} gives a field on {op.codomain}, got out of shape {out.shape}; write {example}")
    if out.dtype != dtype:
        raise TypeError(f"{op.name} gives {dtype} here, got out of dtype {out.dtype}; write {example}")
    if not out.flags.c_contiguous or not out.flags.writeable or np.may_share_memory(out, u):
        raise ValueError(f"{op.name} needs an out that is contiguous, writeable and apart from u; write {example}")


def check_finite(
    name: Any,
    values: Any,
    needs: str = "must be finite",
    where: Callable[[int], Any] | None = None,
    advice: str = "",
) -> None:
    """Raise NonFiniteError for NaN and infinity; the message contains their number and the index of the first one.

    Parameters
    ----------
    name : str
    values : number or array
    needs : str
        Part of the message that says what is expected.
    where : callable, optional
        ``where(number)`` returns the description of the entry with this flat index. Default: its index in `values`.
    advice : str
        End of the message.

    Raises
    ------
    NonFiniteError
    """
    finite = np.isfinite(values)
    if np.all(finite):
        return
    if finite.ndim == 0:
        raise NonFiniteError(f"{name} {needs}, got {values}; write a finite number")
    index = int(np.argmin(finite))
    count = finite.size - np.count_nonzero(finite)
    first = place(index, finite.shape) if where is None else where(index)
    raise NonFiniteError(f"{name} {needs}, got {count} that are NaN or infinite, the first at {first}{advice}")


def surely_finite(value: Any) -> bool:
    """Test cheaply whether all entries are finite, without a temporary array; may return False if sums overflow."""
    if type(value) is np.ndarray and value.size <= BLOCK and value.dtype == FLOAT:
        if isfinite(np.vdot(value, value)):  # fast and without warnings; if a square overflows, the sum below decides
            return True
    elif type(value) is np.float64:
        return isfinite(value)
    with np.errstate(all="ignore"):
        return bool(np.isfinite(np.sum(value)))


def place(index: int, shape: tuple[int, ...]) -> Any:
    """Convert a flat index in C order to the index of an entry: an int in 1-D, else a tuple."""
    indices = tuple(map(int, np.unravel_index(index, shape)))
    if len(indices) == 1:
        return indices[0]
    return indices


def check_function(name: str, thing: Any, example: str, count: int | None = None) -> None:
    """Raise TypeError for a value that is not callable, or does not take `count` arguments."""
    if not callable(thing):
        raise TypeError(f"{name} takes a function, got {type(thing).__name__}; write {example}")
    if count is not None:
        check_takes(name, thing, count, example)


def check_type(name: str, thing: Any, kind: Any, description: str, example: str) -> None:
    """Raise TypeError for a value that is not an instance of `kind`; `description` is what is expected: "an array"."""
    if not isinstance(thing, kind):
        raise TypeError(f"{name} takes {description}, got {type(thing).__name__}; write {example}")


def check_shape(what: str, value: Any, shape: tuple[int, ...], advice: str = "") -> None:
    """Raise ShapeError for a value of another shape."""
    if np.shape(value) != shape:
        raise ShapeError(f"{what} must have shape {shape}, got {np.shape(value)}{advice}")


def check_on(name: str, value: Any, space: Any, advice: str = "") -> None:
    """Raise ShapeError for a value that does not have the shape of a field on a space."""
    if np.shape(value) != space.shape:
        raise ShapeError(f"{name} takes a field on {space.described}, got an array of shape {np.shape(value)}{advice}")


KINDS = {"numbers": "biufc", "real numbers": "biuf", "integers": "iu", "True or False": "b"}


def check_kind(what: str, dtype: np.dtype, needs: str, advice: str = "") -> None:
    """Raise TypeError for a dtype that is not of the required kind `needs`, a key of `KINDS`."""
    if dtype.kind not in KINDS[needs]:
        raise TypeError(f"{what} must hold {needs}, got dtype {dtype}{advice}")


def check_choice(name: str, word: Any, choices: Iterable, advice: str = "") -> None:
    """Raise ValueError for a value that is not one of the choices; 1 is not accepted in place of True."""
    choices = list(choices)
    if any(isinstance(word, type(choice)) and word == choice for choice in choices):
        return
    words = ", ".join(str(choice) for choice in choices if choice is not None)
    advice = advice or advice_near(word, words.split(", "))
    expected = f"one of {words}" if ", " in words else words
    raise ValueError(f"{name} must be {expected}, got {_shown(word)}{advice}")


def advise(error: Exception, params: Any = (), example: str = "rollout(step, start, params, n)") -> None:
    """Add advice to the message of an error of arithmetic with a list, or with params that are None or a dict."""
    text = str(error)
    if isinstance(error, TypeError) and "; write" not in text:
        if "'list'" in text or "multiply sequence" in text:
            error.args = (f"{text}; write np.asarray(x) for an array: a list is a tree of numbers",)
        elif params is None and "NoneType" in text:
            error.args = (f"{text}; write {example}: the params given are None",)
        elif isinstance(params, dict) and "'dict'" in text:
            keys = ", ".join(map(repr, params))
            error.args = (f"{text}; write params[key]: the params given are a dict with the keys {keys}",)


def check_takes(name: str, fun: Any, count: int, example: str) -> None:
    """Raise TypeError for a Python function that cannot be called with `count` positional arguments."""
    if type(fun) is not FunctionType or fun.__code__.co_flags & CO_VARARGS:
        return
    most = fun.__code__.co_argcount
    if not most - len(fun.__defaults__ or ()) <= count <= most:
        raise TypeError(f"{name} calls a function with {count} arguments, got one that takes {most}; write {example}")


RANGES = {
    "": lambda value: True,
    "> 0": lambda value: value > 0,
    ">= 0": lambda value: value >= 0,
    "> 1": lambda value: value > 1,
    "between 0 and 1": lambda value: 0 < value < 1,
    "from 0 to 1": lambda value: 0 <= value <= 1,
    "from 0 to below 1": lambda value: 0 <= value < 1,
}


def check_number(name: str, value: Any, needs: str = "", advice: str = "", kind: str = "") -> float:
    """Return a finite real number as a float; raise an error for all other values.

    Parameters
    ----------
    name : str
    value : Any
    needs : str
        The range of valid numbers, a key of `RANGES`.
    advice, kind : str
        End of the message for a number out of range, and end of the message for a value that is not a number.
    """
    if not is_number(value):
        raise TypeError(f"{name} must be one real number, got {_shown(value)}{kind}")
    if not isfinite(value):
        raise NonFiniteError(f"{name} must be finite, got {value}")
    if not RANGES[needs](value):
        limits = [float(word) for word in needs.split() if word.isdigit()]
        raise ValueError(f"{name} must be {needs}, got {number_beside(value, *limits)}{advice}")
    return float(value)


def check_in_range(name: str, values: Any, needs: str, where: str = "in cell") -> None:
    """Raise an error for a coefficient that is not finite, or out of range.

    Parameters
    ----------
    name : str
    values : number or real array
    needs : str
        The range of valid numbers, a key of `RANGES`.
    where : "in cell" or "on face"
        Words before the index of an entry of an array.

    Raises
    ------
    NonFiniteError, ValueError
        With the first invalid entry of an array and its index.
    """
    if np.ndim(values) == 0:
        check_number(name, values, needs)
        return
    check_finite(name, values)
    valid = RANGES[needs](values)
    if not np.all(valid):
        first = place(int(np.argmin(valid)), np.shape(values))
        raise ValueError(f"{name} must be {needs}, got {number_beside(values[first], 0.0)} {where} {first}")


def _shown(value):
    """Return the text for a value in a message: for an array its shape, otherwise its repr."""
    return f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else repr(value)


def check_whole(name: str, value: Any, least: int, advice: str = "") -> int:
    """Return a whole number >= `least` as an int; raise ValueError for all other values."""
    if not is_whole(value, least):
        raise ValueError(f"{name} must be a whole number >= {least}, got {_shown(value)}{advice}")
    return int(value)


def check_integer(name: str, value: Any, least: int, advice: str = "") -> int:
    """Return an integer >= `least` as an int; unlike `check_whole`, raise TypeError for floats such as 2.0."""
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be an integer, got {_shown(value)}{advice}") from None
    if isinstance(value, bool) or number < least:
        raise ValueError(f"{name} must be an integer >= {least}, got {value!r}{advice}")
    return number


def is_number(value: Any) -> bool:
    """Return True if a value is one real number, including NaN and infinity but not True and False."""
    if type(value) is float:
        return True
    array = np.asarray(value)
    return array.ndim == 0 and array.dtype.kind in "iuf"


def is_whole(value: Any, least: int) -> bool:
    """Return True if a value is a whole number >= `least`, such as 2 or 2.0."""
    return bool(is_number(value) and value % 1 == 0 and value >= least)  # NaN % 1 and inf % 1 are NaN


def number_beside(number: Any, *limits: float, digits: int = 6, style: str = "g") -> str:
    """Format a number with enough digits to show whether it is smaller or larger than each of some limits.

    Parameters
    ----------
    number : float
    *limits : float
        Other numbers in the same message, which are printed with the format ``:g``.
    digits : int
        Smallest number of digits.
    style : "g" or "e"

    Returns
    -------
    str

    Examples
    --------
    >>> number_beside(1.5, 0.0, 1.0), number_beside(1 + 1e-12, 0.0, 1.0)
    ('1.5', '1.000000000001')
    >>> number_beside(1.01e-10, 1e-10, digits=1, style="e")
    '1.01e-10'
    """
    bounds = [*limits, *(float(f"{limit:g}") for limit in limits)]
    for precision in range(digits, 17):
        text = f"{number:.{precision}{style}}"
        shown = float(text)
        if all((shown > bound) == (number > bound) and (shown < bound) == (number < bound) for bound in bounds):
            return text
    return repr(float(number))


def rounded_down(number: float) -> str:
    """Format an upper bound > 0 with six digits, rounded down so that the printed number does not exceed the bound."""
    near = float(number) * (1 + 4 * EPS)
    return f"{float(Context(prec=6, rounding=ROUND_FLOOR).create_decimal(near)):.6g}"
