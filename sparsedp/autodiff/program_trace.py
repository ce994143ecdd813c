"""The trace of `dp.jit`: it records the calls of a function of arrays as a list, which `program` turns into a program.

A value on this trace stands for an array that differs from call to call. Its shape and dtype are the same in every
call, so that code may use them freely; its entries are those of the first call and must not be used. `plain`, which
returns the entries of a traced array, therefore raises `JitError` on this trace. Code of this library reads a traced
value in one of three ways:

=================  =====================================================================================================
`sample`           for the shape or dtype only
`check_values`     for a check, which becomes a call of the program
`plain`            for a decision, which raises JitError here, unless the function is decorated by `opaque`, so that
                   it becomes one call of the program
=================  =====================================================================================================

Traces of derivatives lie above this trace: a gradient is recorded like any other function.
"""

from __future__ import annotations

import operator
from functools import wraps
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
from autograd.tracer import Box, Node, box_types, getval, isbox, new_box, notrace_primitives

from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.backend import BOX
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import JitError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = [
    "ProgramCall",
    "ProgramNode",
    "ProgramTrace",
    "Slot",
    "array_copy",
    "check_values",
    "finiteness_check",
    "is_recorded",
    "opaque",
    "open_traces",
    "recorded_level",
    "recording_trace",
    "refuse_outer_trace",
    "sample",
]

sample = getval  # the value below all boxes, for its shape and dtype only

open_traces: list[None] = []  # one entry for each function that any thread records, for a fast test

# Functions whose result depends on the shape and dtype of their argument only: they are not recorded.
OF_SHAPES = {
    anp.shape,
    anp.ndim,
    anp.size,
    anp.result_type,
    anp.iscomplexobj,
    anp.isscalar,
    anp.zeros_like,
    anp.ones_like,
}
# Functions whose result has a shape that depends on values.
OF_VARIABLE_SHAPE = {anp.nonzero, anp.flatnonzero, anp.argwhere}


class Slot:
    """The number of a value of a program, in place of this value."""

    __slots__ = ("number",)

    def __init__(self, number: int) -> None:
        self.number = number

    def __repr__(self) -> str:
        return f"v{self.number}"


class ProgramCall(NamedTuple):
    """One call of a program.

    Attributes
    ----------
    function : callable
        A function of plain values.
    args : tuple
        A Slot for each value that differs from call to call; other arguments are constants.
    options : dict
    result : Slot
    has_effect : bool
        Whether the call is kept although its result is not used: a check.
    """

    function: Any
    args: tuple
    options: dict
    result: Slot
    has_effect: bool = False


class ProgramTrace:
    """A list of calls, and the values of one execution of them.

    Parameters
    ----------
    number : int
        Number of the trace.
    opaque_call : callable
        ``opaque_call(function, args, options)`` calls a function, and records it as one call: see `opaque`.

    Attributes
    ----------
    calls : list of ProgramCall
    samples : list
        The values in the execution that was recorded, in the order of the slots.
    refusal : JitError or None
        The reason why the function cannot be recorded.
    owner : Jitted or None
        The jitted function that is recorded.
    """

    def __init__(self, number: int, opaque_call: Callable) -> None:
        self.number = number
        self.opaque_call = opaque_call
        self.calls: list[ProgramCall] = []
        self.samples: list[Any] = []
        self.refusal: JitError | None = None
        self.owner: Any = None

    def refused(self, error: JitError) -> JitError:
        """Return an error to be raised, which `check` raises again if the recorded function catches it."""
        self.refusal = error
        return error

    def check(self) -> None:
        """Raise the JitError that the recorded function has caught."""
        if self.refusal is not None:
            raise self.refusal

    def slot(self, value: Any) -> Slot:
        """Return the slot of a new value."""
        self.samples.append(value)
        return Slot(len(self.samples) - 1)

    def sample(self, arg: Any) -> Any:
        """Return the recorded value of an argument of a call."""
        if type(arg) is Slot:
            return self.samples[arg.number]
        return arg

    def add(self, function: Callable, args: Sequence, options: dict, value: Any, has_effect: bool = False) -> Slot:
        """Record a call that returned a value; constants among the arguments are copied."""
        name = None
        if function in OF_VARIABLE_SHAPE:
            name = function.__name__
        elif getattr(function, "__name__", "") in ("__getitem__", "getitem") and type(args[1]) is Slot:
            if np.asarray(self.sample(args[1])).dtype == bool:
                name = "a traced mask as an index"
        if name is not None:
            raise JitError(
                f"dp.jit cannot record {name}, because the shape of its result depends on values; "
                "write np.where(condition, a, b)"
            )
        if any(map(isbox, args)):
            refuse_outer_trace()
        kept = tuple(arg if type(arg) is Slot else constant(arg) for arg in args)
        if _is_hiding(value) or any(map(_is_hiding, kept)):
            rule = kept[0] if kept else None
            name = getattr(rule, "name", None) or getattr(function, "__name__", type(function).__name__)
            raise JitError(
                f"dp.jit cannot record {name}, which got a traced value by its closure or inside an array of NumPy; "
                "pass traced values as arguments, and write anp.array([...])"
            )
        slot = self.slot(value)
        self.calls.append(ProgramCall(function, kept, constant(options), slot, has_effect))
        return slot

    def call(self, function: Callable, *args: Any) -> Slot:
        """Call a function of plain values with the recorded values of some slots and constants, and record the call."""
        return self.add(function, args, {}, function(*map(self.sample, args)))

    def box(self, slot: Slot) -> Any:
        """Return the traced value of a slot."""
        node = ProgramNode.__new__(ProgramNode)
        node.trace = self
        node.slot = slot
        return new_box(self.samples[slot.number], self.number, node)

    def unboxed(self, value: Any) -> Any:
        """Return the slot of a traced value, and any other value unchanged."""
        if is_recorded(value):
            return value._node.slot
        return value


class ProgramNode(Node):
    """A value on a `ProgramTrace`."""

    __slots__ = ("slot", "trace")
    slot: Any
    trace: Any

    def __init__(self, value: Any, function: Callable, args: Any, options: dict, nums: Any, parents: Any) -> None:
        self.trace = parents[0].trace
        slots = list(args)
        for num, parent in zip(nums, parents, strict=True):
            slots[num] = parent.slot
        _refuse_hidden(function, slots)
        self.slot = self.trace.add(function, slots, options, value)


def refuse_outer_trace() -> None:
    """Raise JitError for a value of another trace, which would be a constant of the program."""
    raise JitError(
        "dp.jit cannot record a function that uses a traced value which is not one of its arguments; pass it as an "
        "argument"
    )


def _is_hiding(value):
    """Return True if a value that should be plain is traced, or is an array of objects, which may be traced."""
    if isinstance(value, np.ndarray):
        return value.dtype == object
    if type(value) in (tuple, list):
        return any(map(_is_hiding, value))
    return isbox(value)


def _refuse_hidden(function, args):
    """Raise JitError for traced values inside a tuple or list, which would be stored as constants."""
    for arg in args:
        if type(arg) in (tuple, list) and any(map(isbox, arg)):
            name = getattr(function, "__name__", type(function).__name__)
            raise JitError(
                f"dp.jit cannot record {name} with a traced value inside a {type(arg).__name__}; "
                "write anp.array([...]) around values, and anp.where for entries chosen by a traced index"
            )


notrace_primitives[ProgramNode] = OF_SHAPES


def array_copy(value: Any) -> Any:
    """Return a copy of an array in the same memory layout, and any other value unchanged."""
    if isinstance(value, np.ndarray):
        return value.copy("K")
    return value


def is_recorded(value: Any) -> bool:
    """Return True if the outermost box of a value belongs to a `ProgramTrace`."""
    return type(value) in box_types and type(value._node) is ProgramNode


def recorded_level(value: Any) -> Any:
    """Return a value without the boxes above the `ProgramTrace`, and without any box if there is no such trace."""
    while type(value) in box_types and type(value._node) is not ProgramNode:
        value = value._value
    return value


def recording_trace(values: Sequence) -> Any:
    """Return the `ProgramTrace` below some values, or None."""
    for value in values:
        if type(value) in box_types:
            value = recorded_level(value)
            if type(value) in box_types:
                return value._node.trace
    return None


def check_values(check: Callable, *args: Any) -> None:
    """Call a function that checks some values, traced or not; while `dp.jit` records, add the check to the program.

    Parameters
    ----------
    check : callable
        ``check(*args)`` raises an error, or returns nothing.
    *args
        Arguments, without traced values inside containers.
    """
    if not any(map(isbox, args)):
        check(*args)
        return
    check(*map(sample, args))
    trace = recording_trace(args)
    if trace is not None:
        slots = [trace.unboxed(recorded_level(arg)) for arg in args]
        trace.add(check, slots, {}, None, has_effect=True)


def finiteness_check(function: Callable) -> Callable:
    """Mark a function for `check_values` that does nothing if all its arguments are finite."""
    function.checks_finiteness = True  # type: ignore[attr-defined]
    return function


def opaque(function: Callable) -> Callable:
    """Decorate a function that makes decisions by values of arrays: `dp.jit` records it as one call.

    The program calls the function itself. Derivatives come from a tape of this call.
    """

    @wraps(function)
    def call(*args, **options):
        if open_traces:
            trace = recording_trace(leaves((args, options)))
            if trace is not None:
                return trace.opaque_call(function, args, options)
        return function(*args, **options)

    return call


def _truth(box):
    """Return the truth value of a traced value, unless its trace is recorded."""
    if type(box._node) is ProgramNode:
        error = JitError(
            "dp.jit cannot record a decision by a traced value (if, while, and, or); write np.where(condition, a, b), "
            "or call the function without dp.jit"
        )
        raise box._node.trace.refused(error)
    return bool(box._value)


def _in_place(function):
    """Return an operator such as ``+=``, which rebinds a name, for traced values.

    It is refused for arrays while `dp.jit` records, because NumPy would change the array, to which other names may
    refer.
    """

    def act(box, other):
        if open_traces and isinstance(sample(box), np.ndarray):
            trace = recording_trace((box,))
            if trace is not None:
                raise trace.refused(JitError("dp.jit cannot record an operation in place (u += v); write u = u + v"))
        return function(box, other)

    return act


def _scalar_box(value, trace, node):
    """Return the box of an integer or boolean number, which only a `ProgramTrace` has."""
    if type(node) is not ProgramNode and not isbox(value):
        raise TypeError(f"Can't differentiate w.r.t. type {type(value)}")
    return BOX(value, trace, node)


def _refusing(convert):
    """Return a conversion to an integer type of NumPy that does not read values while `dp.jit` records."""

    def new(cls, *args, **options):
        if open_traces and recording_trace(args) is not None:
            raise JitError("dp.jit cannot convert a traced array by an integer type of NumPy; write u.astype(int)")
        return convert(cls, *args, **options)

    return new


def _in_order(function):
    return lambda box, other: function(box, other)


def _in_reverse(function):
    return lambda box, other: function(other, box)


def _install():
    BOX.__bool__ = _truth
    for name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul"):
        setattr(BOX, f"__i{name}__", _in_place(getattr(operator, name)))
    # Comparisons of values on this trace are traced, too, and masks are combined.
    for operation, function in (("and", anp.bitwise_and), ("or", anp.bitwise_or), ("xor", anp.bitwise_xor)):
        setattr(BOX, f"__{operation}__", _in_order(function))
        setattr(BOX, f"__r{operation}__", _in_reverse(function))
    BOX.__invert__ = anp.invert
    for kind in (anp.int8, anp.int16, anp.int32, anp.int64):
        kind.__new__ = _refusing(kind.__new__)
    for kind in (np.bool_, np.int64, np.intp, bool, int):
        Box.type_mappings.setdefault(kind, _scalar_box)


_install()
