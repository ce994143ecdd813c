"""The tape: rules with hand-written derivatives, the traces they are called on, and the way back through a trace.

Only this file opens autograd. All rules go through one primitive (`_call`), all Operators through a lighter one
(`apply_operator`): a primitive for each rule would stay in autograd's tables for ever.

Complex cotangents are autograd's, g = dL/dRe(y) - i dL/dIm(y): the VJP of y = A x is A^T g.
"""

import inspect
from contextlib import contextmanager
from functools import cached_property, partial, wraps
from itertools import count as numbers_from
from typing import Any

import autograd.numpy as anp
import numpy as np
from autograd.core import JVPNode, VJPNode, add_outgrads, primitive_jvps, primitive_vjps
from autograd.extend import VSpace, defjvp, defjvp_argnums, defvjp, defvjp_argnums, primitive
from autograd.numpy.numpy_vjps import match_complex, replace_zero, unbroadcast_f
from autograd.tracer import Node, box_types, getval, isbox, new_box, notrace_primitives, trace_stack

from sparsedp._utils.counters import active, count, note, thread, timed
from sparsedp._utils.reconstruction import Remade
from sparsedp.autodiff.tape_constants import FIXED, constant, constant_args, frozen, sparing
from sparsedp.errors import DerivativeError, ShapeError

# isort: off
from sparsedp.autodiff.backend import BOX, match_value
from sparsedp.autodiff.fast_derivatives import (
    ACTS, ARRAY, COPY, FLOAT, ITEM, MAKERS, NUMBERS, OPERATORS, PLAIN, REAL, Part, formulas_of,
    in_dtype, operand, power_slope, refuse_options,
)  # fmt: skip

# isort: on
from sparsedp._utils.pytree import copied, leaves

__all__ = [
    "Recorder", "ReverseNode", "Rule", "VJPNode", "VSpace", "added", "apply_operator", "autograd_rules", "backward",
    "boxed", "called", "cast", "differentiable", "dtype_of", "fit", "forward_root", "innermost", "is_variable", "isbox",
    "linear", "new_trace", "plain", "split_boxes", "through", "traces_of", "untaped_root", "untraced",
]  # fmt: skip

plain = getval  # the value below all boxes
scaled_rules: dict = {}  # functions of autograd -> functions whose derivatives replace those of autograd on our traces


def autograd_rules(fun):
    """Return the VJP and the JVP maker of a function of autograd."""
    fun = scaled_rules.get(fun, fun)
    return primitive_vjps[fun], primitive_jvps[fun]


def _scaled(*functions, slopes):
    """Register ``slopes[k](g, value, *args)`` as the derivative of some functions in their argument k.

    autograd divides by squares in the derivatives of these functions. Below 1e-162 such a square underflows, and the
    derivative becomes NaN or infinite where it is finite. Other users of autograd keep its derivatives.
    """

    @primitive
    def scaled(*args):
        return functions[0](*args)

    def in_argument(k, slope):
        return lambda ans, *args: unbroadcast_f(args[k], lambda g: slope(g, ans, *args))

    def forward(slope):
        return lambda g, ans, *args: match_complex(ans, slope(g, ans, *args))

    defvjp(scaled, *(in_argument(k, slope) for k, slope in enumerate(slopes)))
    defjvp(scaled, *map(forward, slopes))
    scaled_rules.update(dict.fromkeys(functions, scaled))


def _angle_slope(g, ans, x):
    size = anp.abs(x)
    return g * (anp.conj(x * 1j) / size) / size


def _along_hypotenuse(g, x, y, share):
    """g times a share of x, y over x^2 + y^2."""
    r = anp.hypot(x, y)
    return g * (share / r) / r


_scaled(
    anp.true_divide,
    anp.divide,
    slopes=(lambda g, ans, x, y: g / y, lambda g, ans, x, y: -g * (x / y) / y),
)
_scaled(
    anp.power,
    slopes=(
        lambda g, ans, x, y: power_slope(g, x, y),
        lambda g, ans, x, y: g * anp.log(replace_zero(x, 1.0)) * ans,
    ),
)
_scaled(anp.reciprocal, slopes=(lambda g, ans, x: -g / x / x,))
_scaled(anp.angle, slopes=(_angle_slope,))
_scaled(
    anp.arctan2,
    slopes=(
        lambda g, ans, x, y: _along_hypotenuse(g, x, y, y),
        lambda g, ans, x, y: _along_hypotenuse(g, x, y, -x),
    ),
)

# ---- traces ----------------------------------------------------------------------------------------------------------


class Recorder:
    """Takes down the calls of reverse-mode traces in order: the backward pass need not sort a graph."""

    bytes: Any = None  # while it is a number: of the results, and of what stands beside traced values, is added
    ended = False  # whether the function has returned: nothing goes back through a later call

    def __init__(self, *witnesses):
        self.nodes: list = []
        self.witnesses = *thread.witnesses, *witnesses  # see(node, function, value, arguments, options, numbers)

    def root(self):
        """A fresh start of a reverse-mode trace, whose calls are taken down here."""
        return ReverseNode.new_root(self)

    def weigh(self, value, args, nums):
        """One call."""
        for num, held in enumerate((*args, value)):
            if num not in nums and type(held) not in FIXED:
                self.bytes += sum(getattr(leaf, "nbytes", 0) for leaf in leaves(held))

    def taken(self):
        """The calls since it was asked last: it forgets them, for they know it, and a circle is freed late."""
        nodes, self.nodes = self.nodes, []
        return nodes

    def open(self):
        """Itself, for one more call; refused after the end."""
        if self.ended:
            raise DerivativeError(
                "a traced value was stored, and is used after the function or the step that made it has ended: its "
                "derivative would be lost; return it, from a rollout in the state or by keep"
            )
        return self


class ReverseNode(VJPNode):
    """A call on a reverse-mode trace. Its pullback ``vjp(g, *held)`` sees the constants of the call as they are now."""

    __slots__ = ("held", "recorder")
    parents: Any
    vjp: Any
    held: Any

    @classmethod
    def new_root(cls, recorder):
        """Begin a trace."""
        root = cls.__new__(cls)
        root.parents, root.vjp, root.held, root.recorder = (), None, (), recorder
        return root

    def __init__(self, value, fun, args, options, nums, parents):
        self.parents, self.recorder = parents, parents[0].recorder.open()
        formulas = refuse_options(fun, options) if options else formulas_of(fun, value, args, nums)
        if formulas:
            self.vjp, held = formulas[0](nums, args)
            self.held = constant_args(held, nums) if len(nums) < len(held) else held
        else:
            if len(nums) < len(args) and fun not in sparing:
                args = constant_args(args, nums)
            super().__init__(value, scaled_rules.get(fun, fun), args, constant(options), nums, parents)
            self.held = OPEN if fun is _primitive and args[0].adds else ()
            if _kind(fun, value, args, nums) == "c":
                self._keep_real(args, nums)
        self.recorder.nodes.append(self)
        if self.recorder.bytes is not None:
            self.recorder.weigh(value, args, nums)
        for see in self.recorder.witnesses:
            see(self, fun, value, args, options, nums)

    def _keep_real(self, args, nums):
        """Beside complex values autograd hands complex cotangents on to real ones; a tuple, or entries, are neither."""
        pull, real = self.vjp, [is_variable(x := plain(args[num])) and dtype_of(x).kind != "c" for num in nums]
        if any(real):
            self.vjp = lambda g: [anp.real(back) if one else back for one, back in zip(real, pull(g), strict=True)]


class UntapedNode(Node):
    """A call of a step that will be run again on a tape: it tells that the result is traced, and holds nothing."""

    __slots__ = ("recorder",)
    recorder: Any

    def initialize_root(self, recorder):
        """Begin a trace."""
        self.recorder = recorder

    def __init__(self, value, fun, args, options, nums, parents):
        self.recorder = parents[0].recorder.open()


class ForwardNode(JVPNode):
    """A call on a forward-mode trace."""

    __slots__ = ()
    g: Any

    def __init__(self, value, fun, args, options, nums, parents):
        if formulas := refuse_options(fun, options) if options else formulas_of(fun, value, args, nums):
            total: Any = None
            for num, parent in zip(nums, parents, strict=True):
                g = formulas[1](parent.g, num, args, value.shape)
                total = (g, False) if total is None and type(g) in NUMBERS else added(total, g)
            self.g = total[0]
        else:
            _kind(fun, value, args, nums)
            super().__init__(value, scaled_rules.get(fun, fun), args, options, nums, parents)


def _kind(fun, value, args, nums):
    """The kind of dtype of a result. Traced values inside a list escape autograd: what they give is refused.

    They give an array of objects, or as in a product of two vectors one traced value.
    """
    kind = getattr(plain(value), "dtype", FLOAT).kind
    beside = (arg for num, arg in enumerate(args) if num not in nums and type(arg) in (list, tuple))
    if kind == "O" or (isbox(value) and any(map(isbox, leaves([*beside])))):
        raise DerivativeError(
            f"{fun.__name__} got a list that holds traced values, and their derivatives would be lost; "
            "write anp.array([...]) around it, with autograd.numpy as anp"
        )
    return kind


untraced = notrace_primitives  # by kind of node, functions that leave the tape
untraced[ReverseNode] = untraced[UntapedNode] = untraced[VJPNode]
untraced[ForwardNode] = untraced[JVPNode]
untaped_root = UntapedNode.new_root
forward_root = ForwardNode.new_root  # a fresh start of a forward-mode trace, with its tangent

_numbers = numbers_from(trace_stack.top + 1)


def new_trace():
    """The number of a trace that begins: larger than those of the traces it is nested in, and never given twice."""
    return next(_numbers)


@contextmanager
def _new_trace():
    """The same for autograd's own traces: it counts up and down, and the inner of two could get the smaller number."""
    yield new_trace()


trace_stack.new_trace = _new_trace


def traces_of(values):
    """The numbers of all traces that lead to some values."""
    numbers = set()
    for value in values:
        while isbox(value):
            numbers.add(value._trace)
            value = value._value
    return numbers


def innermost(values):
    """Return the numbers of the values on the innermost trace of all, if that is a reverse-mode one."""
    number = max((value._trace for value in values if isbox(value)), default=None)
    nums = [num for num, value in enumerate(values) if isbox(value) and value._trace == number]
    return nums if any(isinstance(values[num]._node, VJPNode) for num in nums) else []


def boxed(values, roots, number):
    """Values -> the same, those with a root on the trace of this number."""
    return [x if root is None else new_box(x, number, root) for x, root in zip(values, roots, strict=True)]


def split_boxes(values, number):
    """Values -> those below the boxes of this trace, and the nodes of the boxes (None where there is none)."""
    below, nodes = list(values), [None] * len(values)
    for k, value in enumerate(below):
        if isbox(value):
            if value._trace == number:
                below[k], nodes[k] = value._value, value._node
            elif hasattr(value._node, "recorder"):
                value._node.recorder.open()
    return below, nodes


def backward(nodes, ends, cotangents, sums):
    """Hand cotangents of `ends` back through the calls `nodes`, recorded in order.

    `ends`, `cotangents`: lists, None where there is none. `sums`: {node: (sum so far, whether it may be written to)},
    to which those of roots, and of calls elsewhere, are added.
    """
    for end, g in zip(ends, cotangents, strict=True):
        if end is not None and g is not None:
            sums[end] = added(sums[end], g) if end in sums else (g, False)
    for node in reversed(nodes):
        total = sums.pop(node, None)
        if total is not None:
            adds = node.held is OPEN
            held = [_open(sums.get(parent)) for parent in node.parents] if adds else node.held
            for parent, g in zip(node.parents, node.vjp(total[0], *held), strict=True):
                total = sums.get(parent)
                if total is None and type(g) in NUMBERS:
                    sums[parent] = g, adds and type(g) is np.ndarray
                elif not (adds and total is not None and total[0] is g):  # else the rule has added it
                    sums[parent] = added(total, g)


OPEN: tuple = Part()  # held of a call whose pullback gets the sums so far instead


def _open(total):
    """(Sum so far, whether it may be written to) or None -> the array that may be written to, or None."""
    return total[0] if total is not None and total[1] and type(total[0]) is np.ndarray else None


def added(total, g):
    """(Sum so far, whether it may be written to) or None, a cotangent -> the new pair."""
    kind = type(g)
    if kind is Part:
        g, index, _ = part = g
        if total is not None and total[1] and type(total[0]) is np.ndarray and type(g) in REAL:
            total[0][index] += g
            return total
        whole = _whole(*part) if total is None else total[0] + _whole(*part)
        return whole, type(whole) is np.ndarray
    if total is None or kind is not type(total[0]) or kind not in NUMBERS or total[0].dtype != g.dtype:
        return add_outgrads(total, g)
    if kind is np.float64:
        return total[0] + g, False
    return np.add(total[0], g, out=total[0] if total[1] else None), True


def _whole(g, index, shape):
    """A part of a cotangent, traced or not -> the array around it."""

    def around(g):
        whole = np.zeros(shape)
        whole[index] = g
        return whole[()]

    return linear("entries", around, lambda whole: whole[index])[0](g) if isbox(g) else around(g)


# ---- calls -----------------------------------------------------------------------------------------------------------


def direct(function):
    """A primitive of autograd -> the same, which asks autograd only where traces are nested."""
    raw = function.fun

    @wraps(function)
    def call(*args):
        values, nums, parents, trace = list(args), (), [], None  # type: list, Any, list, Any
        for num, arg in enumerate(args):
            kind = type(arg)
            if kind in box_types:
                value = arg._value
                if type(value) in box_types or (nums and arg._trace != trace):
                    return function(*args)
                values[num], trace = value, arg._trace
                nums = (*nums, num)
                parents.append(arg._node)
        ans = raw(*values)
        if not nums:
            return ans
        return new_box(ans, trace, type(parents[0])(ans, function, values, {}, nums, parents))

    return call


def _of_two(function):
    """The same for two operands. One that is not PLAIN may act itself, as NumPy's operators ask: left to autograd."""
    raw, kinds = function.fun, PLAIN if function is ITEM else PLAIN - {list, tuple}
    quick = ACTS.get(function, raw)

    @wraps(function)
    def call(x, y):
        left, right = type(x), type(y)
        if left is BOX and right in kinds:
            a, b, trace, nums, parents = x._value, y, x._trace, (0,), (x._node,)  # type: Any, Any, Any, tuple, tuple
        elif left in kinds:  # the other one is traced
            a, b, trace, nums, parents = x, y._value, y._trace, (1,), (y._node,)
        elif left is right is BOX and x._trace == y._trace:
            a, b, trace, nums, parents = x._value, y._value, x._trace, (0, 1), (x._node, y._node)
        else:
            return function(x, y) if function is ITEM else function(operand(x), operand(y))
        if type(a) is BOX or type(b) is BOX:
            return function(x, y)
        ans = quick(a, b) if type(a) in NUMBERS or type(b) in NUMBERS else raw(a, b)
        return new_box(ans, trace, type(parents[0])(ans, function, (a, b), {}, nums, parents))

    return call


def _install():
    """Give autograd's traced values quick operators, and its maker of arrays a quick way."""
    BOX.shape, BOX.__getitem__ = property(lambda box: np.shape(box._value)), _of_two(ITEM)
    for name, function in OPERATORS.items():
        act = _of_two(function)
        setattr(BOX, f"__{name}__", act)
        setattr(BOX, f"__r{name}__", lambda box, other, act=act: act(other, box))
    BOX.__neg__, copy = direct(anp.negative), direct(COPY)

    @wraps(COPY)
    def copy_of(args, options, value):
        """A number needs no copy."""
        number = type(value) in box_types and type(value._value) is np.float64 and not (args or options)
        return value if number else copy(args, options, value)

    for name, function in zip(MAKERS, (copy_of, direct(ARRAY)), strict=True):
        setattr(anp.numpy_wrapper, name, function)


_install()


# ---- rules -----------------------------------------------------------------------------------------------------------


def differentiable(name, forward, vjp=None, jvp=None, keywords=()):
    """Function + hand-written derivatives -> Rule that autograd can differentiate.

    Parameters
    ----------
    name : str, for errors and counts
    forward : callable
        ``forward(*args) -> ans`` on plain values; `ans` is an array, a float, or a tuple of arrays.
    vjp : callable, optional
        ``vjp(nums, ans, *args) -> pull``, called once; ``pull(g)`` is a tuple of a cotangent for each place in `nums`.
    jvp : callable, optional
        ``jvp(nums, tangents, ans, *args) -> tangent of ans``.
    keywords : tuple of str
        Trailing arguments of `forward` that a caller may pass by keyword; they are traced like the others.

    Returns
    -------
    Rule
        Call it like `forward`. `vjp` and `jvp` use `ans`, `args` and `g` only through other rules, Operators or
        autograd.numpy: then derivatives of every order follow. What the three functions return is copied: each may
        return one array of its own again and again. Into the arrays that they are given they cannot write.

    Raises
    ------
    DerivativeError
        When a traced value comes where there is no derivative, or a cotangent has a wrong number, shape or dtype.

    Notes
    -----
    `vjp` gets read-only copies of the arrays in `args` that are not traced, also of those in tuples, lists and dicts:
    a caller may write into them before the backward pass. Other objects must stay as they are.

    Examples
    --------
    >>> cube = differentiable("cube", lambda x: x**3, lambda nums, ans, x: lambda g: (3 * x**2 * g,))
    >>> from sparsedp.autodiff.derivative import value_and_grad
    >>> value_and_grad(cube)(2.0)
    (8.0, 12.0)
    """
    given = name, forward, vjp, jvp, tuple(keywords)
    made = differentiable, given
    back = vjp and (lambda *args: _apart(vjp(*map(frozen, args))))
    along = jvp and _apart(lambda nums, tangents, *args: jvp(nums, [*map(frozen, tangents)], *args))
    return Rule(name, _apart(forward), back, along, given[-1], made)


def _apart(function):
    """A function of the user apart from the tape: it may write into what it returned, not into what it is given."""
    return wraps(function)(lambda *args: copied(function(*map(frozen, args))))  # it has the signature of the function


class Rule(Remade):
    """A function with hand-written derivatives whose results are fresh arrays. Users make one with `differentiable`.

    `adds`: what `vjp` returns is called ``pull(g, *sums)``, for each cotangent with an array that holds the sum of
    others so far, or None. It may add its own to that, and return it; all else that it returns is fresh.
    """

    adds = False

    def __init__(self, name, forward, vjp=None, jvp=None, keywords=(), made=None):
        self.name = name
        self.forward = forward
        self.vjp = vjp
        self.jvp = jvp
        self.keywords = keywords
        self.made = made or (Rule, (name, forward, vjp, jvp, keywords))  # see _utils/reconstruction.py

    def __call__(self, *args, **options):
        if self.keywords or options:
            args = self._positional(args, options)
        return _call(self, *args)

    def _positional(self, args, options):
        for key in options:
            if key not in self.keywords:
                raise DerivativeError(f"{self.name} takes no keyword {key!r}; pass the value by position")
        bound = self._signature.bind(*args, **options)
        bound.apply_defaults()
        return bound.args

    @cached_property
    def _signature(self):
        """How it is called. A function that does not tell, as NumPy's own did not in 1.26, takes all by position."""
        try:
            return inspect.signature(self.forward)
        except (TypeError, ValueError):
            return inspect.signature(lambda *args: None)

    def __repr__(self):
        return f"<rule {self.name}>"


def _run(rule, *args):
    for arg in args:
        if type(arg) is not np.ndarray and isinstance(arg, (tuple, list, dict)) and any(map(isbox, leaves(arg))):
            raise DerivativeError(
                f"{rule.name} got a traced value inside a {type(arg).__name__}; pass it as an argument"
            )
    return timed(rule.name, "forward", rule.forward, *args)


_primitive = primitive(_run)
_call = direct(_primitive)


def through(rule, nums, *args):
    """A call of a rule whose forward and VJP take values of outer traces, and hand their cotangents on.

    Only the innermost trace, of the arguments `nums`, gets a node; all others go through those functions.
    """
    if not nums:
        return _run(rule, *args)
    values = [arg._value if num in nums else arg for num, arg in enumerate(args)]
    parents = [args[num]._node for num in nums]
    ans = _run(rule, *values)
    node = type(parents[0])(ans, through, (rule, *values), {}, [num + 1 for num in nums], parents)
    return new_box(ans, args[nums[0]]._trace, node)


def _call_vjp(argnums, ans, args, kwargs):
    rule, nums = args[0], tuple([num - 1 for num in argnums])
    if rule.vjp is None:
        raise DerivativeError(f"{rule.name} has no VJP; give differentiable(...) a vjp")
    values = constant_args(args[1:], nums)
    if active:
        names = list(rule._signature.parameters)  # of the arguments that could have a derivative, and nobody asks for
        for num, value in enumerate(values):
            if num not in nums and is_variable(value):
                note(rule.name, "not asked", names[min(num, len(names) - 1)])
    pull = rule.vjp(nums, ans, *values)

    def checked_pull(g, *sums):
        backs = timed(rule.name, "vjp", pull, g, *sums)
        several = isinstance(backs, (tuple, list))
        if not several or len(backs) != len(nums):  # autograd would accept it silently
            returned = len(backs) if several else type(backs).__name__
            raise DerivativeError(
                f"{rule.name} must return one derivative for each of the {len(nums)} values asked for, "
                f"got {returned}; return a tuple"
            )
        return [fit(rule.name, values[num], back, g) for num, back in zip(nums, backs, strict=True)]

    return checked_pull


def _call_jvp(argnums, tangents, ans, args, kwargs):
    rule = args[0]
    if rule.jvp is None:
        raise DerivativeError(f"{rule.name} has no JVP; give differentiable(...) a jvp")
    if any(map(isbox, (*tangents, *args))):  # inside a reverse-mode trace: its pullback runs later
        args = constant_args(args, argnums)
    count(rule.name, "jvp")
    tangent = rule.jvp(tuple(num - 1 for num in argnums), tangents, ans, *args[1:])
    # Several results come as a tuple, and the rule itself checks each.
    return tangent if isinstance(plain(ans), tuple) else fit(rule.name, ans, tangent, tangents[0])


defvjp_argnums(_primitive, _call_vjp)
defvjp_argnums(through, _call_vjp)
defjvp_argnums(_primitive, _call_jvp)


def fit(name, value, cotangent, g):
    """Check a derivative of `value` that was computed from `g`, and give it the dtype of `value`."""
    if type(cotangent) is type(value) and type(value) in NUMBERS:
        if cotangent.shape == value.shape and cotangent.dtype == value.dtype:
            return cotangent
    cotangent = match_value(np.asarray(cotangent) if isinstance(cotangent, list) else cotangent, value)
    shape, wanted = np.shape(plain(cotangent)), np.shape(plain(value))
    if shape != wanted:
        raise ShapeError(f"{name} returned a derivative of shape {shape} where {wanted} is needed")
    if type(cotangent) is np.ndarray and not isinstance(plain(value), np.ndarray):
        cotangent = cotangent[()]  # a number, as the value is
    kind, precise = dtype_of(cotangent), dtype_of(value)
    if kind == precise:
        return cotangent
    if kind.kind == "c" != precise.kind:
        raise DerivativeError(f"{name} returned a complex derivative of a real value; take its real part")
    if kind.kind not in "fc" or np.finfo(kind).eps > max(np.finfo(dtype_of(x)).eps for x in leaves((value, plain(g)))):
        raise DerivativeError(f"{name} returned a derivative of dtype {kind} where {precise} is needed")
    return cast(cotangent, precise)


def dtype_of(value):
    value = plain(value)
    return value.dtype if hasattr(value, "dtype") else np.asarray(value).dtype


def cast(g, dtype):
    """Array or traced array -> the same numbers in `dtype` (real part if `dtype` is real)."""
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


def linear(name, forward, transpose):
    """Name, linear ``forward(x)``, its ``transpose(g)`` on plain arrays -> two rules, each the other's derivative."""
    there = Rule(name, forward)
    back = Rule(f"{name}.T", transpose)
    for rule, transposed in ((there, back), (back, there)):
        rule.vjp = lambda nums, ans, x, act=transposed: lambda g: (act(g),)
        rule.jvp = lambda nums, tangents, ans, x, act=rule: act(tangents[0])
    return there, back


def _apply(op, u):
    return timed(op.name, "forward", op.apply, u)


_operator = primitive(_apply)
apply_operator = direct(_operator)  # a field through an Operator: half a rule's cost


def _operator_vjp(argnums, ans, args, kwargs):
    op, u = args
    dtype = u.dtype
    reference = op.backend.reference(u)  # the tape does not keep u
    del args, u

    def pull(g):
        act = partial(apply_operator, op.T) if isbox(g) else op.T.apply
        back = timed(op.name, "vjp", act, g)
        return (cast(match_value(back, reference), dtype),)

    return pull


def _operator_jvp(argnums, tangents, ans, args, kwargs):
    op = args[0]
    count(op.name, "jvp")
    tangent = tangents[0]
    return apply_operator(op.tangent, tangent) if isbox(tangent) else op.tangent.apply(tangent)


# Shapes of their constants are all they need, or they call `constant_args` themselves.
sparing.update((_primitive, _operator, through, anp.add, anp.subtract, anp.concatenate_args, ARRAY, COPY))
defvjp_argnums(_operator, _operator_vjp)
defjvp_argnums(_operator, _operator_jvp)


def is_variable(leaf):
    """Whether a leaf can carry a derivative: a floating number or array, or a traced one."""
    return isbox(leaf) or isinstance(leaf, (float, complex)) or getattr(getattr(leaf, "dtype", 0), "kind", "-") in "fc"


def called(fun, args):
    """The rule or Operator behind a node that called fun(*args); for autograd's own functions `fun`."""
    return args[0] if fun in (_primitive, _operator, through) else fun
