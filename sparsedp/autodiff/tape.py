"""The tape: rules with hand-written derivatives, the traces that record their calls, and the backward pass.

Only this module uses the internals of autograd. All rules share one primitive of autograd (`_call`), and all Operators
share another, faster one (`apply_operator`): a primitive for each rule would stay in the tables of autograd as long as
the process runs.

The traced arrays of autograd (`ArrayBox`) get faster arithmetic operators. These apply only to traces of this module;
for other users of autograd every call, its node on their tape and its result are unchanged.

Complex cotangents follow autograd, g = dL/dRe(y) - i dL/dIm(y): the VJP of y = A x is A^T g.
"""

from __future__ import annotations

import inspect
import math
import sys
from contextlib import contextmanager
from functools import cached_property, partial, wraps
from itertools import accumulate
from itertools import count as count_from
from operator import getitem
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np
from autograd.core import JVPNode, VJPNode, add_outgrads, primitive_jvps, primitive_vjps, sparse_add
from autograd.extend import VSpace, defjvp, defjvp_argnums, defvjp, defvjp_argnums, primitive
from autograd.numpy.numpy_vjps import match_complex, replace_zero, unbroadcast_f
from autograd.tracer import Node, box_types, isbox, new_box, notrace_primitives, trace_stack

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.counters import active, count, note, thread, timed
from sparsedp._utils.pytree import copied, is_branch, leaves
from sparsedp._utils.validation import check_takes
from sparsedp.autodiff.backend import ARRAY_KINDS, BOX, match_value
from sparsedp.autodiff.fast_derivatives import (
    ARRAY,
    BOTH,
    COPY,
    FIRST,
    FLOAT,
    FORMULAS,
    ITEM,
    MAKERS,
    NUMBERS,
    OPERATORS,
    PLAIN,
    PYTHON_OPERATORS,
    REAL,
    SECOND,
    Part,
    denominator_slope,
    distributed_formula,
    in_dtype,
    numerator_slope,
    operand,
    power_slope,
    refuse_options,
)
from sparsedp.autodiff.program_trace import (
    ProgramNode,
    is_recorded,
    open_traces,
    recorded_level,
    recording_trace,
    sample,
)
from sparsedp.autodiff.tape_constants import FIXED, constant, constant_args, frozen, sparing
from sparsedp.errors import DerivativeError, JitError, ShapeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import DTypeLike

__all__ = [
    "Recorder",
    "ReverseNode",
    "Rule",
    "VJPNode",
    "VSpace",
    "add_at",
    "added",
    "apply_operator",
    "autograd_rules",
    "backward",
    "boxed",
    "called",
    "cast",
    "differentiable",
    "dtype_of",
    "embedded",
    "executed_function",
    "fit",
    "forward_root",
    "innermost",
    "is_fresh",
    "is_operator_call",
    "is_variable",
    "isbox",
    "linear",
    "new_trace",
    "is_recorded",
    "plain",
    "recorded_level",
    "recording_trace",
    "sample",
    "sparse_add",
    "split_boxes",
    "through",
    "traces_of",
    "untaped_root",
    "untraced",
]


def plain(value: Any) -> Any:
    """Return the value below all boxes; raise JitError while `dp.jit` records it, as its entries decide something."""
    while type(value) in box_types:
        if type(value._node) is ProgramNode:
            frame: Any = sys._getframe(1)
            while frame.f_globals.get("__name__", "").startswith("sparsedp._utils"):  # of the functions of trees
                frame = frame.f_back
            name = frame.f_code.co_name.strip("<>")
            error = JitError(
                f"dp.jit cannot record a decision by the values of a traced array ({name} in "
                f"{frame.f_globals.get('__name__')}); call the function without dp.jit"
            )
            raise value._node.trace.refused(error)
        value = value._value
    return value


# Function of autograd -> function whose derivatives are used instead of those of autograd, on traces of this module.
replaced_functions: dict[Callable, Callable] = {}


def autograd_rules(function: Callable) -> tuple[Callable, Callable]:
    """Return the VJP maker and the JVP maker of a function of autograd."""
    function = replaced_functions.get(function, function)
    return primitive_vjps[function], primitive_jvps[function]


# ---- derivatives in place of those of autograd -----------------------------------------------------------------------


def _replace_derivatives(*functions, slopes):
    """Register derivatives of some functions for the traces of this module.

    autograd's derivatives of these functions divide by the square of a value. The square of a value below 1e-162
    underflows, so that autograd returns NaN or infinity although the derivative is finite.

    Parameters
    ----------
    *functions : callables
        A function of autograd and its aliases.
    slopes : sequence of callables
        For each argument ``slope(g, ans, *args)``, which returns g times the derivative of the result `ans` with
        respect to this argument; None for a derivative that is 0.
    """

    @primitive
    def replacement(*args):
        return functions[0](*args)

    def vjp_in(num, slope):
        return slope and (lambda ans, *args: unbroadcast_f(args[num], lambda g: slope(g, ans, *args)))

    def jvp_in(slope):
        return slope and (lambda g, ans, *args: match_complex(ans, slope(g, ans, *args)))

    defvjp(replacement, *[vjp_in(num, slope) for num, slope in enumerate(slopes)])
    defjvp(replacement, *[jvp_in(slope) for slope in slopes])
    for function in functions:
        replaced_functions[function] = replacement


@primitive
def _concatenation(axis, *arrays):
    """Concatenate arrays; its derivatives take n operations for n arrays, where those of autograd take n^2."""
    return anp.concatenate_args(axis, *arrays)


def _concatenation_vjp(nums, value, args, options):
    """Return the pullback, which splits a cotangent; autograd adds up the lengths again for each array."""
    axis, *arrays = args
    shapes = [anp.shape(array) for array in arrays]
    if axis is None:  # the arrays were flattened
        lengths = [math.prod(shape) for shape in shapes]
        before = ()
    else:
        lengths = [shape[axis] for shape in shapes]
        before = (slice(None),) * (axis % value.ndim)
    ends = list(accumulate(lengths))
    places = [(*before, slice(ends[num - 1] - lengths[num - 1], ends[num - 1])) for num in nums]
    if axis is None:
        return lambda g: [anp.reshape(g[place], shapes[num - 1]) for num, place in zip(nums, places, strict=True)]
    return lambda g: [g[place] for place in places]


def _concatenation_jvp(nums, tangents, value, args, options):
    """Concatenate all tangents; autograd adds one array of the size of the result for each."""
    axis, *arrays = args
    tangent_of = dict(zip(nums, tangents, strict=True))
    parts = []
    for num, array in enumerate(arrays, start=1):
        parts.append(tangent_of[num] if num in tangent_of else anp.zeros_like(array))
    return anp.concatenate_args(axis, *parts)


defvjp_argnums(_concatenation, _concatenation_vjp)
defjvp_argnums(_concatenation, _concatenation_jvp)
replaced_functions[anp.concatenate_args] = _concatenation


def _without_result(slope):
    """Adapt a derivative ``slope(g, *args)`` to the signature ``slope(g, ans, *args)``."""
    return lambda g, ans, *args: slope(g, *args)


def _exponent_slope(g, ans, x, y):
    return g * anp.log(replace_zero(x, 1.0)) * ans


def _reciprocal_slope(g, x):
    return -g / x / x


def _angle_slope(g, x):
    size = anp.abs(x)
    return g * (anp.conj(x * 1j) / size) / size


def _arctan2_first_slope(g, x, y):
    r = anp.hypot(x, y)
    return g * (y / r) / r


def _arctan2_second_slope(g, x, y):
    r = anp.hypot(x, y)
    return g * (-x / r) / r


def _chosen_slope(g, ans, condition, *operands):
    return anp.where(condition, g, anp.zeros(np.shape(sample(ans)), dtype_of(g)))


def _other_slope(g, ans, condition, *operands):
    return anp.where(condition, anp.zeros(np.shape(sample(ans)), dtype_of(g)), g)


_replace_derivatives(
    anp.true_divide,
    anp.divide,
    slopes=(_without_result(numerator_slope), _without_result(denominator_slope)),
)
_replace_derivatives(anp.power, slopes=(_without_result(power_slope), _exponent_slope))
_replace_derivatives(anp.reciprocal, slopes=(_without_result(_reciprocal_slope),))
_replace_derivatives(anp.angle, slopes=(_without_result(_angle_slope),))
_replace_derivatives(
    anp.arctan2,
    slopes=(_without_result(_arctan2_first_slope), _without_result(_arctan2_second_slope)),
)
# autograd's derivative of where does not add up the cotangents of an operand that is repeated, such as a number.
_replace_derivatives(getattr(anp, "_original_where", anp.where), slopes=(None, _chosen_slope, _other_slope))

# ---- traces ----------------------------------------------------------------------------------------------------------


class Recorder:
    """The calls of a reverse-mode trace in order, so that the backward pass need not sort a graph.

    Parameters
    ----------
    *callbacks : callables
        Callbacks ``see(node, function, value, arguments, options, numbers)``. They and those in `thread.node_hooks` are
        called for every node that is created.

    Attributes
    ----------
    nodes : list of ReverseNode
        The recorded calls.
    bytes : int or None
        If it is a number, the sizes in bytes of results and of arguments that are not traced are added to it.
    entries : dict
        (node of an array, index) -> entry that was taken from it, see `_entries`.
    ended : bool
        Whether the traced function has returned. Its values cannot be differentiated any more, so that using one of
        them raises a DerivativeError.
    """

    def __init__(self, *callbacks: Callable):
        self.nodes: list[ReverseNode] = []
        self.callbacks = (*thread.node_hooks, *callbacks)
        self.bytes: Any = None
        self.entries: dict[tuple, Any] = {}
        self.ended = False

    def root(self) -> ReverseNode:
        """Return the node of a new variable of the trace."""
        root = ReverseNode.__new__(ReverseNode)
        root._first = None
        root._rest = None
        root.vjp = None
        root.held = ()
        root.recorder = self
        return root

    def weigh(self, value: Any, args: Sequence, nums: Sequence[int]) -> None:
        """Add the bytes of a call to `bytes`."""
        size = self.bytes or 0
        for num, held in enumerate((*args, value)):
            if num not in nums and type(held) not in FIXED:
                for leaf in leaves(held):
                    size += getattr(leaf, "nbytes", 0)
        self.bytes = size

    def taken(self) -> list[ReverseNode]:
        """Return and clear the recorded nodes; this breaks a reference cycle."""
        nodes = self.nodes
        self.nodes = []
        self.entries = {}
        return nodes

    def check_open(self) -> None:
        """Raise DerivativeError if the traced function has returned."""
        if self.ended:
            raise DerivativeError(
                "a traced value was stored and used after the function or the step that computed it had ended, so its "
                "derivative would be lost; return it, from a rollout in the state or by keep"
            )


class ReverseNode(VJPNode):
    """A call on a reverse-mode trace.

    A tape has many nodes, and each object that Python's garbage collector tracks costs time. So one or two parents, the
    most frequent case, are stored without a tuple.

    Attributes
    ----------
    vjp : callable
        The pullback ``vjp(g, *held)``.
    held : tuple
        The further arguments of the pullback, with copies of those that the caller could modify.
    recorder : Recorder
    """

    __slots__ = ("_first", "_rest", "held", "recorder")
    vjp: Any
    held: Any

    @property
    def parents(self) -> tuple:
        """Nodes of the traced arguments."""
        first = self._first
        rest = self._rest
        if first is None:
            return ()
        if rest is None:
            return (first,)
        if type(rest) is tuple:
            return (first, *rest)
        return (first, rest)

    def __init__(self, value: Any, function: Callable, args: Any, options: dict, nums: Any, parents: Any):
        recorder = parents[0].recorder
        if recorder.ended:
            recorder.check_open()
        self.recorder = recorder
        self._first = parents[0]
        self._rest = None
        if len(parents) == 2:
            self._rest = parents[1]
        elif len(parents) > 2:
            self._rest = tuple(parents[1:])
        pullback = None
        if options:
            refuse_options(function, options)
        else:
            formula = FORMULAS.get(function)
            if formula is not None:
                pullback = formula.backward(value, nums, args)
            if pullback is None and ARRAY_KINDS:
                formula = distributed_formula(function, value, args, nums)
                pullback = formula and formula.backward(value, nums, args)
        if pullback is None:
            self._differentiate_by_autograd(value, function, args, options, nums)
        else:
            self.vjp, held = pullback
            if len(nums) < len(held):
                held = constant_args(held, nums)
            self.held = held
        recorder.nodes.append(self)
        if recorder.bytes is not None:
            recorder.weigh(value, args, nums)
        for see in recorder.callbacks:
            see(self, function, value, args, options, nums)

    def _differentiate_by_autograd(self, value, function, args, options, nums):
        """Set the pullback to that of a function of autograd, or of a rule."""
        if len(nums) < len(args) and function not in sparing:
            args = constant_args(args, nums)
        primitive = replaced_functions.get(function, function)
        options = constant(options)
        if function not in (_primitive, _operator, through) and _is_program_level((value, *args)):
            self.vjp = _recorded_pullback_of_autograd(value, primitive, args, options, nums)
        else:
            self.vjp = VJPNode(value, primitive, args, options, nums, ()).vjp
        self.held = ()
        if function is _primitive and args[0].adds:
            self.held = SUMS
        if _kind(function, value, args, nums) == "c":
            self._keep_real(args, nums)

    def _keep_real(self, args, nums):
        """Take the real part of the cotangents of real arguments.

        If another argument is complex, autograd returns complex cotangents for real arguments too. Arguments that are
        tuples are not converted.
        """
        pull = self.vjp
        is_real = []
        for num in nums:
            x = sample(args[num])
            is_real.append(is_variable(x) and dtype_of(x).kind != "c")

        def real_pull(g):
            cotangents = zip(is_real, pull(g), strict=True)
            return [anp.real(cotangent) if real else cotangent for real, cotangent in cotangents]

        if any(is_real):
            self.vjp = real_pull


class UntapedNode(Node):
    """A call in a step that is run again later on a tape: it marks its result as traced, and records nothing."""

    __slots__ = ("recorder",)
    recorder: Any

    def initialize_root(self, recorder: Recorder) -> None:
        """Begin a trace."""
        self.recorder = recorder

    def __init__(self, value: Any, function: Callable, args: Any, options: dict, nums: Any, parents: Any):
        self.recorder = parents[0].recorder
        self.recorder.check_open()


class ForwardNode(JVPNode):
    """A call on a forward-mode trace, with its tangent `g`."""

    __slots__ = ()
    g: Any

    def __init__(self, value: Any, function: Callable, args: Any, options: dict, nums: Any, parents: Any):
        formula = None
        if options:
            refuse_options(function, options)
        else:
            formula = FORMULAS.get(function)
            if formula is not None and formula.backward(value, nums, args) is None:
                formula = None
            if formula is None and ARRAY_KINDS:
                formula = distributed_formula(function, value, args, nums)
        if formula is None:
            _kind(function, value, args, nums)
            super().__init__(value, replaced_functions.get(function, function), args, options, nums, parents)
            return
        total: Any = None
        for num, parent in zip(nums, parents, strict=True):
            g = formula.forward(parent.g, num, args, np.shape(value))
            if total is None and type(g) in NUMBERS:
                total = (g, False)
            else:
                total = added(total, g)
        self.g = total[0]


def _kind(function, value, args, nums):
    """Return the kind of dtype of a result; raise DerivativeError for traced values inside a list.

    autograd does not trace values inside a list. The result is then an array of objects or, as in a product of two
    vectors, one traced value.
    """
    kind = getattr(sample(value), "dtype", FLOAT).kind
    hidden = kind == "O"
    if isbox(value) and not hidden:
        constants = [arg for num, arg in enumerate(args) if num not in nums and type(arg) in (list, tuple)]
        hidden = any(map(isbox, leaves(constants)))
    if hidden:
        raise DerivativeError(
            f"{function.__name__} got a list that holds traced values, and their derivatives would be lost; "
            "write anp.array([...]) around it, with autograd.numpy as anp"
        )
    return kind


untraced = notrace_primitives  # type of node -> functions whose results are not traced
untraced[ReverseNode] = untraced[VJPNode]
untraced[UntapedNode] = untraced[VJPNode]
untraced[ForwardNode] = untraced[JVPNode]
untaped_root = UntapedNode.new_root
forward_root = ForwardNode.new_root  # begins a forward-mode trace with its tangent
OWN_NODES = {ReverseNode, UntapedNode, ForwardNode, ProgramNode}


# Returns the number of a new trace, which is unique and larger than the numbers of the traces around it.
new_trace = count_from(trace_stack.top + 1).__next__


@contextmanager
def _new_autograd_trace():
    """Use the counter of this module to number the traces of autograd.

    autograd's own counter goes up and down with the open traces of all threads. If one of two nested traces belongs to
    this module, or if other threads open traces, the inner trace could get the smaller number, and its derivative
    would be wrong.
    """
    yield new_trace()


trace_stack.new_trace = _new_autograd_trace


def traces_of(values: Iterable) -> set[int]:
    """Return the numbers of all traces of some values."""
    numbers = set()
    for value in values:
        while isbox(value):
            numbers.add(value._trace)
            value = value._value
    return numbers


def innermost(values: Sequence) -> list[int]:
    """Return the positions of the values on the innermost trace; an empty list if that is a forward-mode trace."""
    trace = -1
    nums: list[int] = []
    for num, value in enumerate(values):
        if not isbox(value) or value._trace < trace:
            continue
        if value._trace > trace:
            trace = value._trace
            nums = []
        if isinstance(value._node, VJPNode):
            nums.append(num)
    return nums


def boxed(values: Iterable, roots: Iterable, number: int) -> list:
    """Return values as a list, in which the values with a root are traced on the trace with this number."""
    traced = []
    for value, root in zip(values, roots, strict=True):
        if root is None:
            traced.append(value)
        else:
            traced.append(new_box(value, number, root))
    return traced


def split_boxes(values: Iterable, number: int) -> tuple[list, list]:
    """Separate values on the trace with this number from their nodes.

    Returns
    -------
    below : list
        The values without the boxes of this trace; other values unchanged.
    nodes : list
        The nodes of the values on this trace; None for other values.
    """
    below = list(values)
    nodes: list = [None] * len(below)
    for k, value in enumerate(below):
        if not isbox(value):
            continue
        if value._trace == number:
            below[k] = value._value
            nodes[k] = value._node
        elif hasattr(value._node, "recorder"):
            value._node.recorder.check_open()
    return below, nodes


# ---- the backward pass -----------------------------------------------------------------------------------------------


def backward(nodes: Sequence[ReverseNode], ends: Sequence, cotangents: Sequence, sums: dict) -> None:
    """Propagate cotangents through recorded calls.

    Parameters
    ----------
    nodes : sequence of ReverseNode
        In the order of the calls.
    ends : sequence
        For each result its node, or None.
    cotangents : sequence
        For each result its cotangent, or None.
    sums : dict
        Maps a node to the pair (sum of its cotangents, whether the sum may be modified in place). On return it contains
        the cotangents of roots, and of calls that are not in `nodes`.
    """
    for end, g in zip(ends, cotangents, strict=True):
        if end is not None and g is not None:
            if end in sums:
                sums[end] = added(sums[end], g)
            else:
                sums[end] = (g, False)
    for node in reversed(nodes):
        total = sums.pop(node, None)
        if total is None:
            continue
        held = node.held
        if held is SUMS:
            _pull_into_sums(node, total[0], sums)
            continue
        for parent, g in zip(node.parents, node.vjp(total[0], *held), strict=True):
            total = sums.get(parent)
            if total is None and type(g) in NUMBERS:
                sums[parent] = (g, False)
            else:
                sums[parent] = added(total, g)


# Exceptions of pullbacks of autograd that use NumPy's own functions.
UNTRACEABLE = (AttributeError, IndexError, JitError, TypeError, ValueError)
# Value of `held` for a call whose pullback is called as ``pull(g, *sums)``, see `Rule.adds`.
SUMS: tuple = Part()


def _pull_into_sums(node, g, sums):
    """Propagate a cotangent through a call whose pullback may add its results to the sums of its parents."""
    open_sums = [_open(sums.get(parent)) for parent in node.parents]
    for parent, cotangent in zip(node.parents, node.vjp(g, *open_sums), strict=True):
        total = sums.get(parent)
        if total is None and type(cotangent) in NUMBERS:
            sums[parent] = (cotangent, type(cotangent) is np.ndarray)
        elif total is None or total[0] is not cotangent:  # else the pullback has added it
            sums[parent] = added(total, cotangent)


def _open(total):
    """Return the array of a sum of cotangents if it may be modified in place, else None."""
    if total is not None and total[1] and type(total[0]) is np.ndarray:
        return total[0]
    return None


def added(total: tuple | None, g: Any) -> tuple:
    """Add a cotangent to a sum of cotangents.

    Parameters
    ----------
    total : (Any, bool) or None
        The sum, and whether it may be modified in place.
    g : Any

    Returns
    -------
    (Any, bool)
    """
    kind = type(g)
    if kind is Part:
        return _add_part(total, g)
    if open_traces and recording_trace((g, total and total[0])) is not None:
        return _add_recorded(total, g)
    if total is None or kind is not type(total[0]) or kind not in NUMBERS or total[0].dtype != g.dtype:
        return add_outgrads(total, g)
    if kind is np.float64:
        return total[0] + g, False
    if total[1]:
        return np.add(total[0], g, out=total[0]), True
    return np.add(total[0], g), True


def _add_recorded(total, g):
    """Add a cotangent to a sum of cotangents, one of which belongs to a program."""
    if type(g) is not BOX:
        g = add_outgrads(None, g)[0]  # the array of a sparse cotangent
    if total is None:
        return g, False
    if type(total[0]) in NUMBERS or type(total[0]) is BOX:  # not in place: the sum may be a constant of the program
        return total[0] + g, True
    return add_outgrads((total[0], False), g)[0], False


def add_at(total: Any, g: Any, index: Any) -> Any:
    """Add g to the entries of an array at an index, in place."""
    total[index] += g
    return total


def _add_part(total, part):
    """Add the cotangent of an entry or part of an array to a sum of cotangents of the array."""
    g, index, _ = part
    if (
        total is not None
        and total[1]
        and type(total[0]) is BOX
        and is_recorded(total[0])
        and not (isbox(g) and not is_recorded(g))
    ):
        trace = total[0]._node.trace
        return trace.box(trace.call(add_at, total[0]._node.slot, trace.unboxed(g), index)), True
    if total is not None and total[1] and type(total[0]) is np.ndarray and type(g) in REAL:
        total[0][index] += g
        return total
    whole = _whole(*part)
    if total is not None:
        whole = total[0] + whole
    return whole, type(whole) is np.ndarray or is_recorded(whole)


def _whole(g, index, shape):
    """Return an array of this shape with the part g, which may be traced, at the index and zeros elsewhere."""
    if not isbox(g):
        return embedded(g, index, shape)
    if is_recorded(g):
        trace = g._node.trace
        return trace.box(trace.call(embedded, g._node.slot, index, shape))
    embed, _ = linear("entries", lambda g: embedded(g, index, shape), lambda whole: whole[index])
    return embed(g)


def embedded(g: Any, index: Any, shape: tuple) -> Any:
    """Return an array of this shape with the part g at the index and zeros elsewhere."""
    whole = np.zeros(shape)
    whole[index] = g
    return whole[()]


# ---- calls -----------------------------------------------------------------------------------------------------------


def direct(function: Any) -> Callable:
    """Return a faster form of a primitive; it calls autograd only for nested traces and traces of other users."""
    raw = function.fun

    @wraps(function)
    def call(*args):
        values: list | None = None
        nums: tuple[int, ...] = ()
        parents: tuple = ()
        trace = 0
        for num, arg in enumerate(args):
            if type(arg) not in box_types:
                continue
            value = arg._value
            node = arg._node
            if type(value) in box_types or type(node) not in OWN_NODES:
                return function(*args)
            if values is None:
                values = list(args)
                trace = arg._trace
            elif arg._trace != trace:
                return function(*args)
            values[num] = value
            nums = (*nums, num)
            parents = (*parents, node)
        if values is None:
            return raw(*args)
        answer = raw(*values)
        return new_box(answer, trace, type(node)(answer, function, values, {}, nums, parents))

    return call


def _binary(function):
    """Return a faster form of a primitive of autograd for two operands, see `direct`.

    An operand whose type is not in `PLAIN` may define the operator itself, so that autograd is called.
    """
    raw = function.fun
    quick = PYTHON_OPERATORS.get(function, raw)
    plain_types = PLAIN
    if function is not ITEM:
        plain_types = PLAIN - {list, tuple}

    def ask_autograd(x, y):
        if function is ITEM:
            return function(x, y)
        return function(operand(x), operand(y))

    @wraps(function)
    def call(x, y):
        nums: tuple[int, ...]
        parents: tuple
        if type(x) is BOX:
            node = x._node
            if type(node) not in OWN_NODES:
                return function(x, y)
            trace = x._trace
            a = x._value
            if type(y) is BOX:
                if y._trace != trace:
                    return function(x, y)
                b = y._value
                nums = BOTH
                parents = (node, y._node)
            elif type(y) in plain_types:
                b = y
                nums = FIRST
                parents = (node,)
            else:
                return ask_autograd(x, y)
        else:  # y is traced
            node = y._node
            if type(node) not in OWN_NODES:
                return function(x, y)
            if type(x) not in plain_types:
                return ask_autograd(x, y)
            trace = y._trace
            a = x
            b = y._value
            nums = SECOND
            parents = (node,)
        if type(a) is BOX or type(b) is BOX:
            if function is ITEM and type(a) is BOX:
                answer = a[b]
            else:
                answer = call(a, b)
            executed = function
        else:
            executed = quick if type(a) in NUMBERS or type(b) in NUMBERS else raw
            answer = executed(a, b)
        if type(node) is ProgramNode:
            node = ProgramNode(answer, executed, (a, b), {}, nums, parents)
        else:
            node = type(node)(answer, function, (a, b), {}, nums, parents)
        return BOX(answer, trace, node) if type(answer) in NUMBERS else new_box(answer, trace, node)

    return call


def _entries(take):
    """Return a form of indexing that records the same entry of an array once.

    The cotangents of all uses of the entry are then added as numbers, and put into the cotangent of the array once. It
    applies to entries that are numbers, and to all while `dp.jit` records.
    """

    @wraps(ITEM)
    def item(box, index):
        node = box._node
        if type(index) is not int or type(node) is not ReverseNode:
            return take(box, index)
        known = node.recorder.entries
        entry = known.get((node, index))
        if entry is None:
            entry = take(box, index)
            if type(entry._value) is np.float64 or is_recorded(entry._value):
                known[node, index] = entry
        return entry

    return item


def _reflected(act):
    return lambda box, other: act(other, box)


def _shape(box):
    value = box._value
    if type(value) in NUMBERS:
        return value.shape
    return np.shape(value)


def _install():
    """Replace operators of autograd's traced values by the faster ones, which call autograd for all other traces."""
    BOX.shape = property(_shape)
    BOX.__getitem__ = _entries(_binary(ITEM))
    BOX.__neg__ = direct(anp.negative)
    reflected: dict[Callable, Callable] = {}  # function of NumPy -> operator for an array and a traced value
    for name, function in OPERATORS.items():
        act = _binary(function)
        setattr(BOX, f"__{name}__", act)
        setattr(BOX, f"__r{name}__", _reflected(act))
        if name != "pow":  # NumPy's power and the operator may differ in the last bit
            reflected[function.fun] = act
    dispatch = BOX.__array_ufunc__

    @wraps(dispatch)
    def array_ufunc(box, function, method, *operands, **options):
        """Call the faster operators for ``array * traced``, for which NumPy does not call ``traced.__rmul__``."""
        if function in reflected and method == "__call__" and not options and len(operands) == 2:
            x, y = operands
            if type(x) is np.ndarray and type(y) is BOX and type(y._node) in OWN_NODES:
                return reflected[function](x, y)
        return dispatch(box, function, method, *operands, **options)

    BOX.__array_ufunc__ = array_ufunc
    copy = direct(COPY)

    @wraps(COPY)
    def copy_of(args, options, value):
        if type(value) in box_types and not (args or options) and type(value._node) in OWN_NODES:
            number = value._value
            if type(number) is np.float64 or (is_recorded(number) and type(number._value) is np.float64):
                return value  # a number needs no copy
        return copy(args, options, value)

    setattr(anp.numpy_wrapper, MAKERS[0], copy_of)
    setattr(anp.numpy_wrapper, MAKERS[1], direct(ARRAY))

    constant_full_like = anp.full_like

    @wraps(constant_full_like)
    def full_like(a, fill_value, *args, **options):
        """Fill an array as NumPy does; differentiable in the fill value, which autograd treats as a constant."""
        answer = constant_full_like(a, fill_value, *args, **options)
        if type(fill_value) is BOX and type(fill_value._node) in OWN_NODES and answer.dtype.kind in "fc":
            return (np.zeros_like(answer) + fill_value).astype(answer.dtype)
        return answer

    anp.full_like = full_like


_install()


# ---- rules -----------------------------------------------------------------------------------------------------------


def differentiable(
    name: str,
    forward: Callable,
    vjp: Callable | None = None,
    jvp: Callable | None = None,
    keywords: Sequence[str] = (),
) -> Rule:
    """Return a function with hand-written derivatives.

    Parameters
    ----------
    name : str
        Name of the function in error messages and counts.
    forward : callable
        ``forward(*args) -> ans``, called with values that are not traced. `ans` is an array, a float, or a tuple of
        arrays.
    vjp : callable, optional
        ``vjp(nums, ans, *args) -> pull``. `nums` are the positions of the arguments that are differentiated, and
        ``pull(g)`` returns a tuple with the cotangent of each of them, for the cotangent `g` of `ans`.
    jvp : callable, optional
        ``jvp(nums, tangents, ans, *args) -> tangent of ans``, where `tangents` are those of the arguments `nums`.
    keywords : sequence of str
        Names of trailing arguments of `forward` that may be passed by keyword. They are differentiated like the others.

    Returns
    -------
    Rule
        A function that is called like `forward`. It has derivatives of every order if `vjp` and `jvp` compute with
        `ans`, `args` and `g` only by other rules, Operators or functions of autograd.numpy. The arrays that the three
        functions return are copied, so that they may return the same array in every call. The arrays that they get
        are read-only.

    Raises
    ------
    DerivativeError
        When the function is differentiated: if the needed `vjp` or `jvp` was not given, or if a cotangent is complex
        for a real argument, cannot be converted to its dtype, or if the number of cotangents is wrong.
    ShapeError
        When the function is differentiated: if the shape of a derivative is not that of its value.

    See Also
    --------
    implicit, from_blackbox, check.gradient

    Notes
    -----
    `vjp` gets read-only copies of the arrays in `args` that are not traced, also of those in tuples, lists and dicts,
    because the caller may write into the arrays before the backward pass. Other objects must not be modified.
    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> cube = differentiable("cube", lambda x: x**3, lambda nums, ans, x: lambda g: (3 * x**2 * g,))
    >>> from sparsedp.autodiff.derivative import value_and_grad
    >>> value_and_grad(cube)(2.0)
    (8.0, 12.0)
    """
    keywords = tuple(keywords)
    constructor_call = differentiable, (name, forward, vjp, jvp, keywords)
    isolated_vjp = None if vjp is None else _isolated_vjp(name, vjp)
    isolated_jvp = None if jvp is None else _isolated_jvp(name, jvp)
    return Rule(name, _isolated(forward), isolated_vjp, isolated_jvp, keywords, constructor_call)


VJP_FORM = "vjp=lambda nums, ans, *args: lambda g: (...,)"


def _isolated(function):
    """Wrap a user's function: its arguments are read-only and its results are copied; the signature stays."""
    return wraps(function)(lambda *args: copied(function(*map(frozen, args))))


def _isolated_vjp(name, vjp):
    """Wrap a user's `vjp`: its arguments are read-only, and its pullback is wrapped by `_isolated`."""

    def isolated(nums, ans, *args):
        check_takes(f"differentiable({name!r})", vjp, 2 + len(args), VJP_FORM)
        pull = vjp(nums, frozen(ans), *map(frozen, args))
        if not callable(pull):
            raise TypeError(f"the vjp of {name} must return a function, got {type(pull).__name__}; write {VJP_FORM}")
        return _isolated(pull)

    return isolated


def _isolated_jvp(name, jvp):
    """Wrap a user's `jvp`: its arguments and tangents are read-only, and its results are copied."""

    def on_frozen_tangents(nums, tangents, *args):
        check_takes(f"differentiable({name!r})", jvp, 2 + len(args), "jvp=lambda nums, tangents, ans, *args: ...")
        return jvp(nums, [frozen(tangent) for tangent in tangents], *args)

    return _isolated(on_frozen_tangents)


class Rule(Reconstructible):
    """A function with hand-written derivatives. Users create one with `differentiable`.

    Its functions must return new arrays that no other code modifies.

    Parameters
    ----------
    name : str
    forward, vjp, jvp : callable
    keywords : tuple of str
        The arguments of `differentiable`.
    constructor_call : (callable, tuple), optional
        A function and its arguments that construct the rule again, for pickles. Default: this class and its arguments.

    Attributes
    ----------
    adds : bool
        Whether pullbacks are called as ``pull(g, *sums)``. For each cotangent to be returned `sums` has an array with
        the sum of the other cotangents of this argument, or None. The pullback may add its cotangent to this array in
        place and return the array; otherwise it must return a new array.
    bind : callable or None
        ``bind(*values)`` returns the function for `bound`, which returns what `forward` returns, bit for bit. None
        stands for `forward` itself.
    bind_vjp : callable or None
        ``bind_vjp(nums, *values)`` returns the pullback for arguments of the form of `values`, a function
        ``pull(g, *values)`` that returns what ``vjp(nums, ans, *values)(g)`` returns, bit for bit. It returns None
        for arguments of another form than the rule is fast for.
    accepts_traced : bool
        Whether the functions of the rule accept traced values of outer traces, see `through`.
    """

    adds = False
    bind: Callable | None = None
    bind_vjp: Callable | None = None
    accepts_traced = False

    def __init__(
        self,
        name: str,
        forward: Callable,
        vjp: Callable | None = None,
        jvp: Callable | None = None,
        keywords: tuple[str, ...] = (),
        constructor_call: tuple | None = None,
    ):
        self.name = name
        self.forward = forward
        self.vjp = vjp
        self.jvp = jvp
        self.keywords = keywords
        self.constructor_call = constructor_call or (Rule, (name, forward, vjp, jvp, keywords))
        self._bound: dict[tuple, Callable] = {}
        self._bound_vjps: dict[tuple, Callable | None] = {}

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Evaluate the rule, and record the call if an argument is traced."""
        if self.keywords or options:
            args = self._positional(args, options)
        return _call(self, *args)

    def bound(self, *values: Any) -> Callable:
        """Return a function with the signature of `forward` for plain arguments of the form of these: see `form_of`.

        What depends only on the form, such as checks of shapes, is decided here, once: the rule keeps the function. It
        checks values in every call, and may be called by several threads at once.
        """
        if self.bind is None:
            return self.forward
        form = form_of(values)
        function = self._bound.get(form)
        if function is None:
            function = self.bind(*values)
            if len(self._bound) >= MOST_BOUND:
                self._bound.clear()
            self._bound[form] = function
        return function

    def bound_vjp(self, nums: tuple[int, ...], *values: Any) -> Callable | None:
        """Return the pullback in the arguments `nums` for arguments of the form of these, or None; see `bind_vjp`."""
        if self.bind_vjp is None:
            return None
        key = nums, form_of(values)
        pull = self._bound_vjps.get(key, self)
        if pull is self:
            pull = self.bind_vjp(nums, *values)
            if len(self._bound_vjps) >= MOST_BOUND:
                self._bound_vjps.clear()
            self._bound_vjps[key] = pull
        return pull

    def _positional(self, args, options):
        """Return all arguments by position."""
        for key in options:
            if key not in self.keywords:
                raise DerivativeError(f"{self.name} takes no keyword {key!r}; pass the value by position")
        bound = self._signature.bind(*args, **options)
        bound.apply_defaults()
        return bound.args

    @cached_property
    def _signature(self):
        """Signature of `forward`. A function without one, as some of NumPy 1.26, takes all arguments by position."""
        try:
            return inspect.signature(self.forward)
        except (TypeError, ValueError):
            return inspect.signature(lambda *args: None)

    def __repr__(self):
        return f"<rule {self.name}>"


MOST_BOUND = 64  # number of forms of arguments for which a rule keeps a function


def form_of(values: Iterable) -> tuple:
    """Return the form of some arguments as a hashable value.

    It consists of the type of each argument, and for arrays of the shape, the dtype and whether they are C-contiguous.
    """
    form: list = []
    for value in values:
        if type(value) is np.ndarray:
            form.append((value.shape, value.dtype, value.flags.c_contiguous))
        else:
            form.append(type(value))
    return tuple(form)


def _run(rule, *args):
    """Call the function of a rule on plain values."""
    for arg in args:
        kind = type(arg)
        if kind is np.ndarray or kind is float:
            continue
        if is_branch(arg) and any(map(isbox, leaves(arg))):
            raise DerivativeError(f"{rule.name} got a traced value inside a {kind.__name__}; pass it as an argument")
    act = rule.forward if rule.bind is None else rule.bound(*args)
    if active:
        return timed(rule.name, "forward", act, *args)
    return act(*args)


_primitive = primitive(_run)
_call = direct(_primitive)


def through(rule: Rule, nums: Sequence[int], *args: Any) -> Any:
    """Call a rule whose functions accept traced values of outer traces and use only differentiable operations.

    A node is created on the innermost trace only, to which the arguments `nums` belong. The outer traces record the
    operations inside the functions of the rule.
    """
    if not nums:
        return _run(rule, *args)
    values = list(args)
    parents = []
    for num in nums:
        values[num] = args[num]._value
        parents.append(args[num]._node)
    answer = _run(rule, *values)
    node = type(parents[0])(answer, through, (rule, *values), {}, [num + 1 for num in nums], parents)
    return new_box(answer, args[nums[0]]._trace, node)


def _call_vjp(argnums, ans, args, options):
    """Return the pullback of a call of a rule, with checks of the cotangents that the rule returns."""
    rule = args[0]
    nums = tuple([num - 1 for num in argnums])
    if rule.vjp is None:
        raise DerivativeError(f"{rule.name} has no VJP; give differentiable(...) a vjp")
    values = constant_args(args[1:], nums)
    if active:
        _note_not_asked(rule, nums, values)
    if not rule.accepts_traced and _is_program_level((ans, *values)):
        pull = _recorded_pullback(rule, nums, ans, values)
    else:
        pull = rule.vjp(nums, ans, *values)

    def checked_pull(g, *sums):
        cotangents = timed(rule.name, "vjp", pull, g, *sums)
        is_sequence = isinstance(cotangents, (tuple, list))
        if not is_sequence or len(cotangents) != len(nums):  # autograd would not raise an error
            returned = len(cotangents) if is_sequence else type(cotangents).__name__
            raise DerivativeError(
                f"{rule.name} must return one derivative for each of the {len(nums)} values asked for, "
                f"got {returned}; return a tuple"
            )
        fitted = []
        for num, cotangent in zip(nums, cotangents, strict=True):
            fitted.append(fit(rule.name, values[num], cotangent, g))
        return fitted

    return checked_pull


def _is_program_level(values):
    """Return True if some values belong to a program, and none to a trace above it."""
    levels = [is_recorded(value) for value in values if type(value) in box_types]
    return bool(levels) and all(levels)


def _recorded_pullback(rule, nums, ans, values):
    """Return the pullback of a call of a rule while `dp.jit` records: a call of the program."""
    trace = recording_trace((ans, *values))
    slots = list(map(trace.unboxed, values))
    bound_pull = rule.bound_vjp(nums, *map(trace.sample, slots))
    if bound_pull is None:
        pull = trace.call(partial(rule.vjp, nums), trace.unboxed(ans), *slots)

    def recorded_pull(g, *sums):
        if isbox(g) and not is_recorded(g):  # a derivative of the derivative
            return rule.vjp(nums, ans, *values)(g, *sums)
        if bound_pull is None:
            cotangents = trace.call(_pulled, pull, trace.unboxed(g), *[None] * len(sums))
        else:
            cotangents = trace.call(bound_pull, trace.unboxed(g), *slots)
        returned = trace.sample(cotangents)
        if not isinstance(returned, (tuple, list)):
            return returned
        return [trace.box(trace.call(getitem, cotangents, place)) for place in range(len(returned))]

    return recorded_pull


def _pulled(pull, g, *sums):
    return pull(g, *sums)


def _recorded_pullback_of_autograd(value, function, args, options, nums):
    """Return the pullback of a call of a function of autograd while `dp.jit` records.

    The calls inside the pullback are recorded. If it cannot be traced, the whole pullback is one call of the program.
    """
    trace = recording_trace((value, *args))

    def as_one_call(g):
        slots = map(trace.unboxed, (g, value, *args))
        cotangents = trace.call(partial(_pulled_by_autograd, function, options, tuple(nums)), *slots)
        return [trace.box(trace.call(getitem, cotangents, place)) for place in range(len(nums))]

    try:
        pull = VJPNode(value, function, args, options, nums, ()).vjp
    except UNTRACEABLE:
        trace.refusal = None
        return as_one_call

    def traced_pull(g):
        try:
            return pull(g)
        except UNTRACEABLE:
            trace.refusal = None
            return as_one_call(g)

    return traced_pull


def _pulled_by_autograd(function, options, nums, g, value, *args):
    return tuple(VJPNode(value, function, args, options, nums, ()).vjp(g))


def _note_not_asked(rule, nums, values):
    """Note in the counters which arguments of a rule could have a derivative, but are not traced."""
    names = list(rule._signature.parameters)
    for num, value in enumerate(values):
        if num not in nums and is_variable(value):
            note(rule.name, "not asked", names[min(num, len(names) - 1)])


def _call_jvp(argnums, tangents, ans, args, options):
    """Return the tangent of a call of a rule."""
    rule = args[0]
    if rule.jvp is None:
        raise DerivativeError(f"{rule.name} has no JVP; give differentiable(...) a jvp")
    if any(map(isbox, (*tangents, *args))):  # inside a reverse-mode trace: the pullback runs later and needs copies
        args = constant_args(args, argnums)
    count(rule.name, "jvp")
    nums = tuple(num - 1 for num in argnums)
    inputs = (*tangents, ans, *args[1:])
    if not rule.accepts_traced and _is_program_level(inputs):
        trace = recording_trace(inputs)
        tangent = trace.box(trace.call(partial(_pushed, rule, nums), *map(trace.unboxed, inputs)))
    else:
        tangent = rule.jvp(nums, tangents, ans, *args[1:])
    if isinstance(sample(ans), tuple):  # rules with several results check the tangents themselves
        return tangent
    return fit(rule.name, ans, tangent, tangents[0])


def _pushed(rule, nums, *inputs):
    """Call the JVP of a rule with the tangents of the arguments `nums`, the result and the arguments."""
    return rule.jvp(nums, inputs[: len(nums)], *inputs[len(nums) :])


defvjp_argnums(_primitive, _call_vjp)
defvjp_argnums(through, _call_vjp)
defjvp_argnums(_primitive, _call_jvp)


def fit(name: str, value: Any, cotangent: Any, g: Any) -> Any:
    """Check a derivative of a value, and convert it to the dtype of the value.

    Parameters
    ----------
    name : str
        Name of the rule that returned the derivative.
    value : Any
        The value that was differentiated, plain or traced.
    cotangent : Any
        The derivative.
    g : Any
        The cotangent or tangent from which it was computed.

    Raises
    ------
    ShapeError
        If the derivative and the value have different shapes.
    DerivativeError
        If the derivative is complex and the value real, or if its dtype cannot be converted without loss.
    """
    if type(cotangent) is type(value) and type(value) in NUMBERS:
        if cotangent.shape == value.shape and cotangent.dtype == value.dtype:
            return cotangent
    if isinstance(cotangent, list):
        cotangent = np.asarray(cotangent)
    cotangent = match_value(cotangent, value)
    shape = np.shape(sample(cotangent))
    expected_shape = np.shape(sample(value))
    if shape != expected_shape:
        raise ShapeError(f"{name} returned a derivative of shape {shape} where {expected_shape} is needed")
    if type(cotangent) is np.ndarray and not isinstance(sample(value), np.ndarray):
        cotangent = cotangent[()]  # the value is a number, so return a NumPy scalar and not a 0-d array
    dtype = dtype_of(cotangent)
    precise = dtype_of(value)
    if dtype == precise:
        return cotangent
    if dtype.kind == "c" != precise.kind:
        raise DerivativeError(f"{name} returned a complex derivative of a real value; take its real part")
    if dtype.kind not in "fc" or np.finfo(dtype).eps > max(
        np.finfo(dtype_of(x)).eps for x in leaves((value, sample(g)))
    ):
        raise DerivativeError(f"{name} returned a derivative of dtype {dtype} where {precise} is needed")
    return cast(cotangent, precise)


def dtype_of(value: Any) -> np.dtype:
    """Return the dtype of a value, plain or traced."""
    value = sample(value)
    if hasattr(value, "dtype"):
        return value.dtype
    return np.asarray(value).dtype


def real_dtype(dtype: np.dtype) -> np.dtype:
    """Return the dtype of the real parts of numbers, float64 for integers and bools."""
    if dtype.kind not in "fc":
        return np.dtype(float)
    return np.empty(0, dtype).real.dtype


def cast(g: Any, dtype: DTypeLike) -> Any:
    """Convert an array, plain or traced, to another dtype; take the real part if the dtype is real."""
    if dtype_of(g).kind == "c" and np.dtype(dtype).kind == "f":
        g = anp.real(g)
    if dtype_of(g) == dtype:
        return g
    if not isbox(g):
        return in_dtype(g, dtype)
    rule = Rule("cast", lambda x: in_dtype(x, dtype))
    rule.vjp = lambda nums, ans, x: lambda cotangent: (cast(cotangent, dtype_of(x)),)
    rule.jvp = lambda nums, tangents, ans, x: cast(tangents[0], dtype)
    return rule(g)


def linear(name: str, forward: Callable, transpose: Callable) -> tuple[Rule, Rule]:
    """Return rules for a linear function and for its transpose; the VJP of each rule is the other one.

    Parameters
    ----------
    name : str
    forward, transpose : callable
        ``forward(x)`` and ``transpose(g)``, for arrays that are not traced.
    """
    act = Rule(name, forward)
    transposed = Rule(f"{name}.T", transpose)
    act.vjp = lambda nums, ans, x: lambda g: (transposed(g),)
    act.jvp = lambda nums, tangents, ans, x: act(tangents[0])
    transposed.vjp = lambda nums, ans, x: lambda g: (act(g),)
    transposed.jvp = lambda nums, tangents, ans, x: transposed(tangents[0])
    return act, transposed


def _apply(op, u):
    if active:
        return timed(op.name, "forward", op.apply, u)
    return op.apply(u)


_operator = primitive(_apply)
apply_operator = direct(_operator)  # ``apply_operator(op, u)`` takes half the time of a call of a rule


def _operator_vjp(argnums, ans, args, options):
    op, u = args
    dtype = u.dtype
    reference = op.backend.reference(u)  # so that the tape does not keep u in memory
    del args, u

    def pull(g):
        if isbox(g):
            cotangent = timed(op.name, "vjp", apply_operator, op.T, g)
        elif active:
            cotangent = timed(op.name, "vjp", op.T.apply, g)
        else:
            cotangent = op.T.apply(g)
        if type(cotangent) is np.ndarray and cotangent.dtype is dtype and reference is None:
            return (cotangent,)
        return (cast(match_value(cotangent, reference), dtype),)

    return pull


def _operator_jvp(argnums, tangents, ans, args, options):
    op = args[0]
    count(op.name, "jvp")
    (tangent,) = tangents
    if isbox(tangent):
        return apply_operator(op.tangent, tangent)
    return op.tangent.apply(tangent)


# The pullbacks of these functions use only the shapes of constants, or the functions call `constant_args` themselves.
sparing.update((_primitive, _operator, through, anp.add, anp.subtract, anp.concatenate_args, ARRAY, COPY))
defvjp_argnums(_operator, _operator_vjp)
defjvp_argnums(_operator, _operator_jvp)


def is_variable(leaf: Any) -> bool:
    """Return True if a leaf can have a derivative: a floating number or array, plain or traced."""
    return isbox(leaf) or isinstance(leaf, (float, complex)) or getattr(getattr(leaf, "dtype", 0), "kind", "-") in "fc"


def called(function: Callable, args: Sequence) -> Any:
    """Return the rule or Operator of a recorded call ``function(*args)``, or `function` if it belongs to autograd."""
    if function in (_primitive, _operator, through):
        return args[0]
    return function


def is_operator_call(function: Callable) -> bool:
    """Return whether a recorded function is the primitive of all Operators, whose arguments are (op, u)."""
    return function is _operator


def executed_function(function: Callable, args: Sequence, samples: Sequence) -> tuple[Callable, Sequence]:
    """Return the function of plain values that executes a recorded call, and its arguments.

    Parameters
    ----------
    function : callable
        The recorded function: a primitive of autograd, the primitive of all rules or that of all Operators, or a
        function of plain values.
    args : sequence
        The arguments of the call, in any form.
    samples : sequence
        Plain values with the shapes and dtypes of the arguments.
    """
    if function is _primitive:
        return args[0].bound(*samples[1:]), args[1:]
    if function is _operator:
        op, u = samples
        is_contiguous = type(u) is np.ndarray and u.flags.c_contiguous
        return op.bound(u) if is_contiguous else op.apply, args[1:]
    return getattr(function, "fun", function), args


def is_fresh(function: Callable) -> bool:
    """Return whether the results of a recorded call are new arrays: those of rules and Operators are."""
    return function is _primitive or function is _operator
