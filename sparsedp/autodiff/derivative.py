"""Derivatives of whole programs: any function of a tree of arrays, forward and backward."""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.calls import frames_inside, public
from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import copied, described, flatten, keys, labels, leaves, mapped, paired
from sparsedp._utils.reconstruction import ReconstructibleFunction
from sparsedp._utils.validation import (
    advise,
    check_function,
    check_leaves,
    check_native,
    check_precision,
    check_shape,
    check_whole,
    surely_finite,
)
from sparsedp.autodiff.backend import collectively, is_field, match_value, process_count
from sparsedp.autodiff.tape import (
    Recorder,
    Rule,
    backward,
    boxed,
    called,
    cast,
    dtype_of,
    fit,
    forward_root,
    is_variable,
    isbox,
    new_trace,
    plain,
    split_boxes,
)
from sparsedp.autodiff.tape_constants import is_fixed
from sparsedp.errors import DerivativeError, NonFiniteError, NonFiniteGradientWarning, ShapeError, SparsedpError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

__all__ = [
    "NO_JVP",
    "check_loss",
    "checking_derivatives",
    "entrywise",
    "grad",
    "gradient_of",
    "hvp",
    "is_finite",
    "jvp",
    "name_of",
    "of_argument",
    "pullback",
    "push",
    "pushforward",
    "taped",
    "traced",
    "unwarned",
    "value_and_grad",
    "vjp",
    "witnessed",
    "zero_like",
]

# What `pushforward` raises where a rule of this library or of autograd has no JVP.
NO_JVP = (DerivativeError, NotImplementedError)
# Advice for a gradient of the wrong shape.
SPREAD = ": autograd's np.where does not add up what it spreads; multiply by the condition instead, a * c + b * (1 - c)"
LARGE = 1e100  # cotangents above this overflow in other calls, whose own derivatives are finite

# ---- gradients -------------------------------------------------------------------------------------------------------


def grad(loss: Callable, argnum: int = 0) -> Callable:
    """Return the function that returns the gradient of a scalar loss of a tree; see `value_and_grad`.

    Parameters
    ----------
    loss : callable
    argnum : int
        Position of the argument `x`.

    Returns
    -------
    callable
        ``f(*args) -> gradient``, with the structure of the argument.

    Raises
    ------
    TypeError
        If `loss` is not a function.
    ValueError
        If `argnum` is not a whole number >= 0.
    ShapeError, DerivativeError
        On use, as `value_and_grad`.

    Warns
    -----
    NonFiniteGradientWarning
        If the gradient holds NaN or infinity; it names the call whose derivative is not finite.

    See Also
    --------
    value_and_grad

    Notes
    -----
    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> grad(lambda x: x**2)(3.0)
    6.0
    """
    both = value_and_grad(loss, argnum)
    return ReconstructibleFunction(lambda *args: both(*args)[1], grad, loss, argnum)


def value_and_grad(loss: Callable, argnum: int = 0) -> Callable[..., tuple[Any, Any]]:
    """Return the function that returns the value and the gradient of a scalar loss of a tree.

    Parameters
    ----------
    loss : callable
        ``loss(x, *rest) -> real scalar``; `x` is any nesting of tuples, lists, dicts and
        dataclasses of arrays.
    argnum : int
        Position of the argument `x`; default: the first.

    Returns
    -------
    callable
        ``f(*args) -> (value, gradient)``. The gradient has the structure of `x`, each leaf the
        shape and dtype of the leaf of `x`. Leaves that are not floating (int, bool, None, str) are
        passed to the loss unchanged; their place in the gradient holds None.

    Raises
    ------
    TypeError
        If `loss` is not a function; on use, if there is no such argument.
    ValueError
        If `argnum` is not a whole number >= 0.
    ShapeError
        If the loss is not a scalar.
    DerivativeError
        If the loss is complex, or `x` holds no floating value.

    Warns
    -----
    NonFiniteGradientWarning
        If the gradient holds NaN or infinity; it names the call whose derivative is not finite.

    See Also
    --------
    grad, vjp, hvp, minimize, check.gradient

    Notes
    -----
    Complex numbers: the gradient in a complex leaf is dL/dRe - i dL/dIm, see docs/guides/complex_numbers.md.
    The caller, and the loss between two calls, may write into `x` and into constant arrays (``work[:] = c`` in a loop):
    what the backward pass needs is copied. An array that is read-only with all its memory is not copied;
    ``mask.flags.writeable = False`` saves the time of one product with the mask for each call. Other objects,
    sparse matrices too, must not be changed until the gradient is computed.

    Examples
    --------
    >>> value_and_grad(lambda x: x["a"] ** 2 * x["n"])({"a": 3.0, "n": 2})
    (18.0, {'a': 12.0, 'n': None})
    """
    check_function("value_and_grad", loss, "lambda x: np.sum(x**2)")
    advice = "; write 0 for the first argument, and value_and_grad(loss)(x) for the gradient at x"
    argnum = check_whole("argnum of value_and_grad", argnum, 0, advice)

    def evaluate(*args):
        if len(args) <= argnum:
            raise TypeError(f"the gradient in argument {argnum} of the loss needs it, got {len(args)} arguments")
        return collectively("the loss", args, _value_and_gradient, loss, argnum, args)

    return ReconstructibleFunction(evaluate, value_and_grad, loss, argnum)


def _value_and_gradient(loss, argnum, args):
    """Return the value of a loss, and its gradient in one of its arguments."""

    def of_argument(x):
        return loss(*args[:argnum], x, *args[argnum + 1 :])

    value, pull = pullback(of_argument, args[argnum])
    check_loss(value)

    def again():
        return _value_and_gradient(loss, argnum, args)

    try:
        gradient = pull(np.float64(1.0))  # a number of Python has no entries, which derivatives of it may ask for
    except NonFiniteError as error:  # a call refused a cotangent, as of a forward argument that the user looks for
        if not (thread.quiet or isbox(value)):
            cause = _cause_of_non_finite(again)
            if cause not in (None, str(error)):
                error.args = (f"{error}, in the backward pass: {cause}",)
        raise
    _warn_unless_finite("value_and_grad", gradient, again)
    if isbox(value):
        return value, gradient
    return float(value), gradient


def check_loss(value: Any) -> None:
    """Refuse the value of a loss, traced or not, if it is not one real number."""
    if keys(value) is not None:
        raise ShapeError(f"the loss must be a scalar, got a {type(value).__name__}; return one number")
    if np.shape(plain(value)) != ():
        raise ShapeError(f"the loss must be a scalar, got an array of shape {np.shape(plain(value))}; sum it")
    if dtype_of(value).kind == "c":
        raise DerivativeError("the loss must be real, got a complex number; take its real part or its absolute value")


def vjp(fun: Callable, *x: Any) -> tuple[Any, Callable]:
    """Return the value of a function, and the function from a cotangent to the VJP.

    Parameters
    ----------
    fun : callable
        ``fun(*x) -> array``.
    *x : trees of arrays
        Leaves that are not floating (int, None, str) are passed through and get None.

    Returns
    -------
    value : array
    pull : callable
        ``pull(g)``, with g of the shape of `value`: a cotangent like x; a tuple where there are several arguments.

    Raises
    ------
    TypeError
        If `fun` is not a function.
    DerivativeError
        If no leaf of `x` is a floating array or number, or the value of `fun` is not one array.
    ShapeError
        On use of `pull`, if `g` has another shape than the value.

    Warns
    -----
    NonFiniteGradientWarning
        If a result of `pull` holds NaN or infinity; it names the call whose derivative is not finite.

    See Also
    --------
    jvp, value_and_grad

    Notes
    -----
    Complex numbers: cotangents are dL/dRe - i dL/dIm, see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> value, pull = vjp(lambda u, v: u * v, 2.0, 5.0)
    >>> pull(1.0)
    (5.0, 2.0)
    """
    check_function("vjp", fun, "lambda u: ...")

    def of_tuple(parts):
        return fun(*parts)

    value, pull = collectively("vjp", x, pullback, of_tuple, x)

    def back(g):
        check_precision("the cotangent", g)
        slopes = collectively("the function of vjp", (g,), pull, g)
        if is_finite(g):
            _warn_unless_finite("vjp", slopes, lambda: pullback(of_tuple, x)[1](g))
        if len(x) == 1:
            return slopes[0]
        return slopes

    return value, public("pull")(back)


def pullback(fun: Callable, x: Any) -> tuple[Any, Callable]:
    """Return the value of a function of a tree, and the function from a cotangent to the VJP.

    Parameters
    ----------
    fun : callable
        ``fun(x) -> array``.
    x : tree of arrays
        Leaves that are not floating (int, None, str) are passed through and get None.

    Returns
    -------
    value : array
    pull : callable
        ``pull(g)`` has the structure of `x`; `g` has the shape of `value`.

    Raises
    ------
    DerivativeError
        If no leaf of `x` is a floating array or number, or the value of `fun` is not one array.
    ShapeError
        On use of `pull`, if `g` has another shape than the value.

    Notes
    -----
    The caller may write into `x`, the value, `g` and the results: the tape and they share no memory.

    Examples
    --------
    >>> value, pull = pullback(lambda x: x[0] * x[1], (2.0, 5.0))
    >>> pull(1.0)
    (5.0, 2.0)
    """
    entries, rebuild = flatten(x)
    check_native("a gradient", *entries)
    check_leaves("x", x)
    moving = []
    for place, leaf in enumerate(entries):
        moving.append(is_variable(leaf))
        if moving[place]:
            entries[place] = _apart_from_caller(leaf)
    if True not in moving:
        kinds = sorted({str(getattr(leaf, "dtype", type(leaf).__name__)) for leaf in entries})
        raise DerivativeError(
            f"a gradient needs floating values, got {', '.join(kinds) or 'nothing'}; write np.asarray(x, float)"
        )
    tape = taped(fun, rebuild(entries), moving)
    value = tape.rebuild(tape.values)
    if not is_field(plain(value)):
        raise DerivativeError(
            f"the function must return one array or number, got {type(value).__name__}; sum or join it"
        )

    def pull(g):
        check_shape("the cotangent", g, np.shape(value), "; give one like the value")
        gradients: list = [None] * len(entries)
        for place, slope in enumerate(tape.pull([g])):
            if moving[place]:
                gradients[place] = gradient_of(entries[place], slope)
        return rebuild(_without_shared_memory(gradients, g))

    return _apart_from_caller(value), pull


def gradient_of(leaf: Any, cotangent: Any) -> Any:
    """Return a cotangent as the gradient in a leaf, of its shape and dtype; zeros if there is no cotangent."""
    if cotangent is None:
        return _as_leaf(anp.zeros_like(plain(leaf)), leaf)
    check_shape("the gradient", cotangent, np.shape(leaf), SPREAD)
    return _as_leaf(fit("the gradient", leaf, cotangent, cotangent), leaf)


def _as_leaf(derivative, leaf):
    """Return a derivative of a number of Python as such a number, unless it is traced."""
    if isinstance(leaf, float) and not isbox(derivative):
        return float(derivative)
    return derivative


def _without_shared_memory(gradients, g):
    """Copy gradients that share memory with each other or with the cotangent g: the caller may write into one.

    autograd returns one array for both terms of a sum, and g itself.
    """
    owners = {id(_owner(g))}
    for number, gradient in enumerate(gradients):
        if isinstance(gradient, np.ndarray) and (id(_owner(gradient)) in owners or not gradient.flags.writeable):
            gradients[number] = gradient.copy()
        owners.add(id(_owner(gradient)))
    return gradients


def _owner(value):
    """Return the array that owns the memory of an array."""
    while isinstance(value, np.ndarray) and value.base is not None:
        value = value.base
    return value


def _apart_from_caller(value):
    """Return an array as it is now: pullbacks need it, and the caller may write into it before they run."""
    if isinstance(value, np.ndarray) and not is_fixed(value):
        return value.copy("K")
    return value


# ---- recorded evaluations --------------------------------------------------------------------------------------------


class Tape(NamedTuple):
    """The recorded evaluation of a function of a tree.

    Attributes
    ----------
    values : list
        Leaves of the result.
    rebuild : callable
        Builds the result from its leaves.
    ends : list
        Nodes of the leaves of the result, or None.
    nodes : list
        Of all calls.
    roots : list
        Nodes of the leaves of the tree, or None.
    """

    values: list
    rebuild: Any
    ends: list
    nodes: list
    roots: list

    def pull(self, cotangents: Sequence) -> list:
        """Return a cotangent for each leaf of the tree, or None, from those of the leaves of the result."""
        sums: dict = {}
        backward(self.nodes, self.ends, cotangents, sums)
        cotangents = []
        for root in self.roots:
            cotangent, _ = sums.get(root, (None, False))
            cotangents.append(cotangent)
        return cotangents


def taped(fun: Callable, tree: Any, moving: Iterable, *witnesses: Callable) -> Tape:
    """Evaluate a function of a tree and record it.

    Parameters
    ----------
    fun : callable
        ``fun(tree) -> tree``.
    tree : tree
    moving : iterable of bool
        For each leaf of the tree, whether it is a variable.
    *witnesses : callables
        Called for every node, see `Recorder`.
    """
    recorder = Recorder(*witnesses)
    roots: list = []
    for moves in moving:
        if moves:
            roots.append(recorder.root())
        else:
            roots.append(None)
    try:
        values, ends, rebuild = traced(fun, tree, roots)
    finally:
        nodes = recorder.taken()
        recorder.ended = True
        recorder.witnesses = ()  # a witness that keeps nodes would be a reference cycle
    return Tape(values, rebuild, ends, nodes, roots)


def traced(fun: Callable, tree: Any, roots: Sequence) -> tuple[list, list, Callable]:
    """Evaluate ``fun(tree)`` with traced values for the leaves that have a root.

    Returns
    -------
    values : list
        Leaves of the result.
    nodes : list
        Of the leaves of the result, or None.
    rebuild : callable
        Builds the result from its leaves.

    Raises
    ------
    DerivativeError
        If NumPy, math or Python refuse a traced value.
    """
    entries, rebuild = flatten(tree)
    number = new_trace()
    try:
        ends, build = flatten(fun(rebuild(boxed(entries, roots, number))))
        values, nodes = split_boxes(ends, number)
        return values, nodes, build
    except (TypeError, ValueError, AttributeError) as error:
        texts = str(error), str(error.__cause__)  # u[0] = traced: NumPy hides the reason in the cause
        if isinstance(error, SparsedpError) or not any("ArrayBox" in text for text in texts):
            advise(error)
            raise
        raise DerivativeError(
            f"a traced value was refused ({error}); write the function with autograd.numpy, without float(), item() "
            "and u[i] = ..., or take foreign code in by dp.from_blackbox or dp.differentiable"
        ) from error


@contextmanager
def witnessed(see: Callable) -> Iterator[None]:
    """Call a function for each node of a reverse-mode trace that is created inside a `with` block.

    Parameters
    ----------
    see : callable
        ``see(node, function, value, arguments, options, numbers)``; `numbers` are the positions of the arguments that
        are differentiated.
    """
    thread.witnesses.append(see)
    try:
        yield
    finally:
        thread.witnesses.remove(see)


# ---- directional derivatives -----------------------------------------------------------------------------------------


def jvp(fun: Callable, x: Any, tangent: Any) -> tuple[Any, Any]:
    """Return the value of a function of a tree and its directional derivative.

    Parameters
    ----------
    fun : callable
        ``fun(x)``; its result may be a tree.
    x, tangent : trees of arrays of the same structure
        The tangent of a leaf that is not floating is ignored.

    Returns
    -------
    value : tree
    tangent : tree
        Of the value.

    Raises
    ------
    TypeError
        If `fun` is not a function.
    ShapeError
        If the tangent has another structure than `x`, or a leaf of it another shape.

    Warns
    -----
    NonFiniteGradientWarning
        If the derivative holds NaN or infinity; it names the call whose derivative is not finite.

    See Also
    --------
    vjp, hvp

    Notes
    -----
    Forward mode, or two reverse passes if a part of `fun` has no forward derivative.
    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> value, slope = jvp(lambda x: x[0] * x[1], (2.0, 5.0), (1.0, 0.0))
    >>> float(value), float(slope)
    (10.0, 5.0)
    """
    check_function("jvp", fun, "lambda u: ...")
    return _jvp("jvp", fun, x, tangent)


def hvp(loss: Callable, x: Any, tangent: Any) -> Any:
    """Return the Hessian of a scalar loss of a tree times a direction.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``.
    x, tangent : trees of arrays of the same structure
        The tangent of a leaf that is not floating is ignored.

    Returns
    -------
    tree like x
        None at leaves that are not floating.

    Raises
    ------
    TypeError, ShapeError, DerivativeError
        As `jvp` and `value_and_grad`.

    Warns
    -----
    NonFiniteGradientWarning
        If the product holds NaN or infinity; it names the call whose derivative is not finite.

    See Also
    --------
    value_and_grad, jvp

    Notes
    -----
    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> hvp(lambda x: x[0] ** 2 * x[1], (2.0, 5.0), (1.0, 0.0))
    (10.0, 4.0)
    """
    return mapped(_as_leaf, _jvp("hvp", grad(loss), x, tangent)[1], x)


def _jvp(name, fun, x, tangent):
    """Return what `jvp` returns; the public function of this name warns if the derivative is not finite."""
    check_native("jvp", *leaves((x, tangent)))
    check_leaves("x", x)
    check_leaves("tangent", tangent)
    tangents = _directions(x, tangent)
    results = collectively("jvp", (x, tangent), push, fun, x, tangents)

    def again():
        tape = taped(fun, x, [direction is not None for direction in tangents])
        tape.pull([np.ones_like(value) if is_variable(value) else None for value in tape.values])

    if all(is_finite(direction) for direction in tangents if direction is not None):
        _warn_unless_finite(name, results[1], again)
    return copied(results)  # the caller may write into x, the tangent and the results


def pushforward(fun: Callable, x: Any, tangent: Any) -> tuple:
    """Return what `jvp` returns, in forward mode only, and without copies.

    Raises
    ------
    DerivativeError
        Or another type of NO_JVP, if a part of `fun` has no forward derivative.

    Examples
    --------
    >>> value, slope = pushforward(lambda x: x[0] * x[1], (2.0, 5.0), (1.0, 0.0))
    >>> float(value), float(slope)
    (10.0, 5.0)
    """
    return forward(fun, x, _directions(x, tangent))


def _directions(x, tangent):
    """Return the tangent of each leaf of `x`, None where the leaf is not floating."""
    entries = leaves(x)
    tangents = paired(tangent, x, "tangent", advice="; give a tangent like x")
    for number, leaf in enumerate(entries):
        if not is_variable(leaf):
            tangents[number] = None
            continue
        direction = tangents[number]
        if not (is_field(plain(direction)) and np.shape(direction) == np.shape(leaf)):
            path = labels(x, "tangent")[number]
            raise ShapeError(f"{path}: expected {described(leaf)}, got {described(direction)}; give a tangent like x")
    return tangents


def push(fun: Callable, tree: Any, tangents: Sequence) -> tuple:
    """Return the value of a function of a tree, and its tangent.

    Forward mode, or two reverse passes if a part of `fun` has no JVP.

    Parameters
    ----------
    fun : callable
    tree : tree
    tangents : sequence
        For each leaf of the tree, or None.

    Returns
    -------
    value, tangent : trees
        The tangent is None at leaves that are not floating.
    """
    try:
        return forward(fun, tree, tangents)
    except NO_JVP:
        if any(dtype_of(t).kind == "c" for t in tangents if t is not None):
            raise
        return _twice_reverse(fun, tree, tangents)


def forward(fun: Callable, x: Any, tangents: Sequence) -> tuple:
    """Return the value of a function and its tangent in forward mode, see `push`."""
    roots: list = [None] * len(tangents)
    for place, tangent in enumerate(tangents):
        if tangent is not None:
            roots[place] = forward_root(tangent)
    values, nodes, rebuild = traced(fun, x, roots)
    slopes = [tangent_of(value, node and node.g) for value, node in zip(values, nodes, strict=True)]
    return rebuild(values), rebuild(slopes)


def tangent_of(value: Any, slope: Any) -> Any:
    """Return the tangent of a result in its dtype: zero for a constant result, None if it is not floating."""
    if not is_variable(value):
        return None
    if slope is None:
        return zero_like(value)
    return fit("a rule", value, slope, slope)


def zero_like(value: Any) -> Any:
    """Return plain zeros of the shape and dtype of a value, traced or not."""
    return np.zeros(np.shape(plain(value)), dtype_of(value))[()]


def _twice_reverse(fun, tree, tangents):
    """Return the value of a function, and its tangent by two reverse passes.

    The pullback of a cotangent z, J^T z, is linear, so the gradient in z of <J^T z, tangent> is J tangent. It is
    evaluated at random z: a rule may branch on a cotangent of zero, and then has no derivative there.
    """
    tape = taped(fun, tree, [tangent is not None for tangent in tangents])
    moving = [is_variable(value) for value in tape.values]

    def product(z):
        total = 0.0
        for cotangent, tangent in zip(tape.pull(z), tangents, strict=True):
            if cotangent is not None:
                total = total + anp.sum(cotangent * tangent)
        return total

    z = [_random_like(value) if moves else None for value, moves in zip(tape.values, moving, strict=True)]
    slopes = taped(product, z, moving).pull([1.0])
    return tape.rebuild(tape.values), tape.rebuild(map(tangent_of, tape.values, slopes))


def _random_like(value):
    """Return plain numbers of the shape and dtype of a value, the same in every run."""
    numbers = np.random.default_rng(0).uniform(0.5, 1.5, np.shape(plain(value)))
    return np.asarray(numbers, dtype_of(value))[()]


# ---- derivatives that are not finite ---------------------------------------------------------------------------------


@contextmanager
def unwarned() -> Iterator[None]:
    """Suppress warnings of derivatives that are not finite inside a `with` block: the caller handles them."""
    thread.quiet += 1
    try:
        yield
    finally:
        thread.quiet -= 1


def _warn_unless_finite(name, derivative, again):
    """Warn of NaN or infinity in a derivative, with the name of the call it comes from.

    Parameters
    ----------
    name : str
        Of the public function that returns the derivative.
    derivative : tree
        Traced ones belong to an outer derivative, which is examined itself.
    again : callable
        ``again()`` computes the derivative again, in reverse mode.
    """
    if thread.quiet:
        return
    all_finite = True
    for leaf in leaves(derivative):
        if isbox(leaf):
            return
        if is_variable(leaf):
            all_finite = all_finite and is_finite(leaf)
    if all_finite:
        return
    reason = _cause_of_non_finite(again) or "dp.check.gradient(loss, x) shows where it comes from"
    warnings.warn(
        NonFiniteGradientWarning(f"the derivative returned by {name} holds NaN or infinity: {reason}"),
        stacklevel=frames_inside() + 1,
    )


def is_finite(value: Any) -> bool:
    """Whether an array or number, plain or traced, holds neither NaN nor infinity."""
    value = plain(value)
    return surely_finite(value) or bool(np.all(np.isfinite(value)))


def _cause_of_non_finite(again):
    """Name the first call whose own derivative is not finite; None if there is no such call, or with several processes.

    Parameters
    ----------
    again : callable
        ``again()`` computes the derivative again, in reverse mode.
    """
    if process_count() > 1:
        return None
    try:
        with unwarned(), checking_derivatives():
            again()
    except NonFiniteError as error:
        return str(error)
    except Exception:  # a function that cannot run twice
        pass
    return None


@contextmanager
def checking_derivatives() -> Iterator[None]:
    """Raise NonFiniteError inside a `with` block for the first call whose own derivative is NaN or infinite.

    A call whose cotangent is NaN or LARGE is not to blame. For a second run, after a gradient was not finite.
    """

    def see(node, fun, value, args, options, nums):
        pull = node.vjp
        name = name_of(called(fun, args))

        def checked(g, *held):
            cotangents = list(pull(g, *held))
            if all(np.all(np.abs(plain(part)) < LARGE) for part in leaves(g)):
                for num, cotangent in zip(nums, cotangents, strict=True):
                    _check_derivative(name, args[num], cotangent)
            return cotangents

        node.vjp = checked

    with witnessed(see), np.errstate(all="ignore"):
        yield


def _check_derivative(name, argument, cotangent):
    """Refuse a cotangent of an argument of a call that is not finite."""
    if not is_variable(cotangent):
        return
    finite = np.isfinite(plain(cotangent))
    if not np.all(finite):
        first = np.ravel(plain(argument))[np.argmin(finite)]
        raise NonFiniteError(
            f"the derivative of {name} is NaN or infinite where its argument is {first:.6g}; keep it away from there"
        )


def name_of(subject: Any) -> Any:
    """Return the name under which a user knows a rule, an Operator or a function of autograd."""
    return getattr(subject, "name", None) or getattr(subject, "__name__", type(subject).__name__)


# ---- rules of fields -------------------------------------------------------------------------------------------------


def entrywise(name: str, value: Callable, slopes: Callable) -> Rule:
    """Return the rule of a function of two fields that acts entry by entry.

    Parameters
    ----------
    name : str
    value : callable
        ``value(a, b)``.
    slopes : callable
        ``slopes(a, b)``: the derivatives in both arguments, also for traced values.
    """

    def vjp(nums, ans, a, b):
        pair = slopes(a, b)
        return lambda g: tuple(g * pair[num] for num in nums)

    def jvp(nums, tangents, ans, a, b):
        pair = slopes(a, b)
        return sum(pair[num] * tangent for num, tangent in zip(nums, tangents, strict=True))

    return Rule(name, value, vjp, jvp)


def of_argument(cotangent: Any, value: Any) -> Any:
    """Return a cotangent of a product of fields in the form of an argument.

    It is summed over batches, and for a real argument its real part is taken.
    """
    cotangent = match_value(cotangent, value)
    while np.ndim(cotangent) > np.ndim(value):
        cotangent = anp.sum(cotangent, axis=0)
    if dtype_of(cotangent).kind == "c" != dtype_of(value).kind:
        return cast(cotangent, float)
    return cotangent
