"""Derivatives of a function of a tree of arrays, in forward and reverse mode: grad, vjp, jvp, hvp."""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import ReconstructibleFunction
from sparsedp._utils.calls import frames_inside, public
from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import copied, described, flatten, keys, labels, leaves, mapped, paired
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
    sample,
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
    "random_like",
    "taped",
    "traced",
    "unwarned",
    "value_and_grad",
    "vjp",
    "observed_nodes",
    "zero_like",
]

# Exceptions of `pushforward` if a rule of this library or of autograd has no JVP.
NO_JVP = (DerivativeError, NotImplementedError)
# Advice for a gradient of the wrong shape.
WRONG_SHAPE = "; in the defvjp of a function, add up the cotangents of an argument that broadcasting repeats"
LARGE = 1e100  # a larger cotangent can overflow in a call whose own derivative is finite

# ---- gradients -------------------------------------------------------------------------------------------------------


def grad(loss: Callable, argnum: int = 0) -> Callable:
    """Return a function that computes the gradient of a scalar loss; see `value_and_grad`.

    Parameters
    ----------
    loss : callable
        ``loss(x, *rest) -> real scalar``; `x` is any nesting of tuples, lists, dicts and dataclasses of arrays.
    argnum : int
        Position of the argument `x`; default: the first.

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
        When the returned function is called, in the same cases as for `value_and_grad`.

    Warns
    -----
    NonFiniteGradientWarning
        If the gradient contains NaN or infinity. The warning names the call whose derivative is not finite.

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
    """Return a function that computes the value and the gradient of a scalar loss.

    Parameters
    ----------
    loss : callable
        ``loss(x, *rest) -> real scalar``; `x` is any nesting of tuples, lists, dicts and dataclasses of arrays.
    argnum : int
        Position of the argument `x`; default: the first.

    Returns
    -------
    callable
        ``f(*args) -> (value, gradient)``. The gradient has the tree structure of `x`, and each of its leaves has the
        shape and dtype of the leaf of `x`. Leaves that are not floating (int, bool, None, str) are passed to the loss
        unchanged, and the gradient has None at their positions.

    Raises
    ------
    TypeError
        If `loss` is not a function, or if the returned function is called with too few arguments.
    ValueError
        If `argnum` is not a whole number >= 0.
    ShapeError
        If the loss is not a scalar.
    DerivativeError
        If the loss is complex, or if `x` contains no floating value.

    Warns
    -----
    NonFiniteGradientWarning
        If the gradient contains NaN or infinity. The warning names the call whose derivative is not finite.

    See Also
    --------
    grad, vjp, hvp, jit, minimize, check.gradient

    Notes
    -----
    Complex numbers: the gradient in a complex leaf is dL/dRe - i dL/dIm, see docs/guides/complex_numbers.md.
    The loss may write into constant arrays while it runs (``work[:] = c`` in a loop), because the tape copies the
    values that the backward pass needs. Arrays that are read-only, together with the array that owns their memory, are
    not copied: ``mask.flags.writeable = False`` saves a copy of the mask, which takes about as long as a product with
    it, in each call. Other objects, such as sparse matrices, must not be modified until the gradient is computed.

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
    """Return the value of a loss, and its gradient with respect to the argument at position `argnum`."""
    jitted = getattr(loss, "jitted_value_and_grad", None)
    if jitted is not None and not any(map(isbox, leaves(args))):
        return _by_program(loss, jitted, argnum, args)

    def of_argument(x):
        return loss(*args[:argnum], x, *args[argnum + 1 :])

    value, pull = pullback(of_argument, args[argnum])
    check_loss(value)

    def again():
        return _value_and_gradient(loss, argnum, args)

    try:
        gradient = pull(np.float64(1.0))  # not a Python float: pullbacks may use its shape and dtype
    except NonFiniteError as error:  # a pullback got a cotangent that is not finite: name the call that produced it
        if not (thread.quiet or isbox(value)):
            cause = _cause_of_non_finite(again)
            if cause not in (None, str(error)):
                error.args = (f"{error}, in the backward pass: {cause}",)
        raise
    _warn_unless_finite("value_and_grad", gradient, again)
    if isbox(value):
        return value, gradient
    return float(value), gradient


def _by_program(loss, jitted, argnum, args):
    """Return the value and the gradient of a jitted loss, see `jit`."""
    value, gradient = jitted(argnum)(*args)

    def again():
        return _value_and_gradient(loss.function, argnum, args)

    _warn_unless_finite("value_and_grad", gradient, again)
    return float(value), mapped(_as_leaf, gradient, args[argnum])


def check_loss(value: Any) -> None:
    """Raise ShapeError or DerivativeError if the value of a loss, traced or not, is not one real number."""
    if keys(value) is not None:
        raise ShapeError(f"the loss must be a scalar, got a {type(value).__name__}; return one number")
    if np.shape(sample(value)) != ():
        raise ShapeError(f"the loss must be a scalar, got an array of shape {np.shape(sample(value))}; sum it")
    if dtype_of(value).kind == "c":
        raise DerivativeError("the loss must be real, got a complex number; take its real part or its absolute value")


def vjp(fun: Callable, *x: Any) -> tuple[Any, Callable]:
    """Return the value of a function, and the function that computes the VJP for a cotangent.

    Parameters
    ----------
    fun : callable
        ``fun(*x) -> array``.
    *x : trees of arrays
        Arguments. Leaves that are not floating (int, None, str) are passed to `fun` unchanged, and the cotangent has
        None at their positions.

    Returns
    -------
    value : array
    pull : callable
        ``pull(g)``, with a cotangent `g` of the shape of `value`, returns the cotangent of `x` as a tree like `x`; if
        `fun` has several arguments, a tuple with one tree for each of them.

    Raises
    ------
    TypeError
        If `fun` is not a function.
    DerivativeError
        If no leaf of `x` is a floating array or number, or the value of `fun` is not one array.
    ShapeError
        When `pull` is called, if `g` and the value have different shapes.

    Warns
    -----
    NonFiniteGradientWarning
        If a result of `pull` contains NaN or infinity. The warning names the call whose derivative is not finite.

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
        if not isbox(g) and is_finite(g):
            _warn_unless_finite("vjp", slopes, lambda: pullback(of_tuple, x)[1](g))
        if len(x) == 1:
            return slopes[0]
        return slopes

    return value, public("pull")(back)


def pullback(fun: Callable, x: Any) -> tuple[Any, Callable]:
    """Return the value of a function of one tree, and the function that computes the VJP for a cotangent.

    Parameters
    ----------
    fun : callable
        ``fun(x) -> array``.
    x : tree of arrays
        Leaves that are not floating (int, None, str) are passed to `fun` unchanged, and the cotangent has None in
        their place.

    Returns
    -------
    value : array
    pull : callable
        ``pull(g)``, with a cotangent `g` of the shape of `value`, returns a tree like `x`.

    Raises
    ------
    DerivativeError
        If no leaf of `x` is a floating array or number, or the value of `fun` is not one array.
    ShapeError
        When `pull` is called, if `g` and the value have different shapes.

    Notes
    -----
    The caller may write into `x`, the value, `g` and the results, because none of them shares memory with the tape.

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
            entries[place] = _protected_copy(leaf)
    if True not in moving:
        kinds = sorted({str(getattr(leaf, "dtype", type(leaf).__name__)) for leaf in entries})
        advice = "np.asarray(x, float)"
        if kinds == ["int"]:
            advice = "1.0 instead of 1"
        raise DerivativeError(f"a gradient needs floating values, got {', '.join(kinds) or 'nothing'}; write {advice}")
    tape = taped(fun, rebuild(entries), moving)
    value = tape.rebuild(tape.values)
    if not is_field(sample(value)):
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

    return _protected_copy(value), pull


def gradient_of(leaf: Any, cotangent: Any) -> Any:
    """Convert a cotangent to the shape, dtype and type of a leaf; return zeros if the cotangent is None."""
    if cotangent is None:
        return _as_leaf(anp.zeros_like(sample(leaf)), leaf)
    check_shape("the gradient", cotangent, np.shape(leaf), WRONG_SHAPE)
    return _as_leaf(fit("the gradient", leaf, cotangent, cotangent), leaf)


def _as_leaf(derivative, leaf):
    """Convert the derivative of a Python float to a Python float, unless it is traced."""
    if isinstance(leaf, float) and not isbox(derivative):
        return float(derivative)
    return derivative


def _without_shared_memory(gradients, g):
    """Copy gradients that share memory with each other or with the cotangent g, as the caller may modify one of them.

    For a sum, autograd returns g itself as the cotangent of both terms.
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


def _protected_copy(value):
    """Copy an array that is not immutable, because the caller may write into it before the pullbacks use it."""
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
        For each leaf of the result its node, or None if it does not depend on a variable.
    nodes : list
        Nodes of all calls, in order.
    roots : list
        For each leaf of the argument its node, or None if it is not a variable.
    """

    values: list
    rebuild: Any
    ends: list
    nodes: list
    roots: list

    def pull(self, cotangents: Sequence) -> list:
        """Return the cotangents of the leaves of the argument (or None), given those of the leaves of the result."""
        sums: dict = {}
        backward(self.nodes, self.ends, cotangents, sums)
        cotangents = []
        for root in self.roots:
            cotangent, _ = sums.get(root, (None, False))
            cotangents.append(cotangent)
        return cotangents


def taped(fun: Callable, tree: Any, moving: Iterable, *callbacks: Callable) -> Tape:
    """Evaluate a function of a tree and record it.

    Parameters
    ----------
    fun : callable
        ``fun(tree) -> tree``.
    tree : tree
    moving : iterable of bool
        For each leaf of the tree, whether it is a variable.
    *callbacks : callables
        Callbacks that are called for every node, see `Recorder`.
    """
    recorder = Recorder(*callbacks)
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
        recorder.callbacks = ()  # a callback that stores nodes would form a reference cycle with the recorder
    return Tape(values, rebuild, ends, nodes, roots)


def traced(fun: Callable, tree: Any, roots: Sequence) -> tuple[list, list, Callable]:
    """Evaluate ``fun(tree)`` with traced values for the leaves that have a root.

    Returns
    -------
    values : list
        Leaves of the result.
    nodes : list
        For each leaf of the result its node, or None if it is not traced.
    rebuild : callable
        Builds the result from its leaves.

    Raises
    ------
    DerivativeError
        If `fun` passes a traced value to a function that does not accept it, such as those of NumPy or math.
    """
    entries, rebuild = flatten(tree)
    number = new_trace()
    try:
        ends, build = flatten(fun(rebuild(boxed(entries, roots, number))))
        values, nodes = split_boxes(ends, number)
        return values, nodes, build
    except (TypeError, ValueError, AttributeError) as error:
        texts = str(error), str(error.__cause__)  # for u[0] = traced only the cause mentions the traced value
        if isinstance(error, SparsedpError) or not any("ArrayBox" in text for text in texts):
            advise(error)
            raise
        raise DerivativeError(
            f"a traced value was refused ({error}); write the function with autograd.numpy, without float(), item() "
            "and u[i] = ..., or take foreign code in by dp.from_blackbox or dp.differentiable"
        ) from error


@contextmanager
def observed_nodes(see: Callable) -> Iterator[None]:
    """Call a function for each node of a reverse-mode trace that is created inside a `with` block.

    Parameters
    ----------
    see : callable
        ``see(node, function, value, arguments, options, numbers)``; `numbers` are the positions of the arguments that
        are differentiated.
    """
    thread.node_hooks.append(see)
    try:
        yield
    finally:
        thread.node_hooks.remove(see)


# ---- directional derivatives -----------------------------------------------------------------------------------------


def jvp(fun: Callable, x: Any, tangent: Any) -> tuple[Any, Any]:
    """Return the value of a function of a tree and its directional derivative.

    Parameters
    ----------
    fun : callable
        ``fun(x)``; its result may be a tree.
    x, tangent : trees of arrays of the same structure
        The point and the direction. The tangent of a leaf that is not floating is ignored.

    Returns
    -------
    value : tree
        The value ``fun(x)``.
    tangent : tree
        Directional derivative of the value, a tree like it.

    Raises
    ------
    TypeError
        If `fun` is not a function.
    ShapeError
        If the tangent differs from `x` in tree structure, or a leaf of it in shape.

    Warns
    -----
    NonFiniteGradientWarning
        If the derivative contains NaN or infinity. The warning names the call whose derivative is not finite.

    See Also
    --------
    vjp, hvp

    Notes
    -----
    Uses forward mode, or two reverse passes if a part of `fun` has no JVP.
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
    """Return the product of the Hessian of a scalar loss and a direction.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``.
    x, tangent : trees of arrays of the same structure
        The point and the direction. The tangent of a leaf that is not floating is ignored.

    Returns
    -------
    tree like x
        The product, with None in place of leaves that are not floating.

    Raises
    ------
    TypeError, ShapeError, DerivativeError
        In the same cases as for `jvp` and `value_and_grad`.

    Warns
    -----
    NonFiniteGradientWarning
        If the product contains NaN or infinity. The warning names the call whose derivative is not finite.

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
    jitted = getattr(loss, "jitted_hvp", None)
    if jitted is not None and not any(map(isbox, leaves((x, tangent)))):
        return mapped(_as_leaf, jitted(x, tangent), x)
    return mapped(_as_leaf, _jvp("hvp", grad(loss), x, tangent)[1], x)


def _jvp(name, fun, x, tangent):
    """Return the results of `jvp`; `name` is the public function that a warning of a non-finite derivative names."""
    check_native("jvp", *leaves((x, tangent)))
    check_leaves("x", x)
    check_leaves("tangent", tangent)
    tangents = _directions(x, tangent)
    results = collectively("jvp", (x, tangent), push, fun, x, tangents)

    def again():
        tape = taped(fun, x, [direction is not None for direction in tangents])
        tape.pull([np.ones_like(value) if is_variable(value) else None for value in tape.values])

    if all(not isbox(direction) and is_finite(direction) for direction in tangents if direction is not None):
        _warn_unless_finite(name, results[1], again)
    return copied(results)  # the caller may write into x, the tangent and the results


def pushforward(fun: Callable, x: Any, tangent: Any) -> tuple:
    """Return the results of `jvp`, computed in forward mode only, and without copying them.

    Raises
    ------
    DerivativeError
        If a part of `fun` has no JVP. It may also be another exception type of NO_JVP.

    Examples
    --------
    >>> value, slope = pushforward(lambda x: x[0] * x[1], (2.0, 5.0), (1.0, 0.0))
    >>> float(value), float(slope)
    (10.0, 5.0)
    """
    return forward(fun, x, _directions(x, tangent))


def _directions(x, tangent):
    """Return the list of the tangents of the leaves of `x`, with None for leaves that are not floating."""
    entries = leaves(x)
    tangents = paired(tangent, x, "tangent", advice="; give a tangent like x")
    for number, leaf in enumerate(entries):
        if not is_variable(leaf):
            tangents[number] = None
            continue
        direction = tangents[number]
        if not (is_field(sample(direction)) and np.shape(direction) == np.shape(leaf)):
            path = labels(x, "tangent")[number]
            raise ShapeError(f"{path}: expected {described(leaf)}, got {described(direction)}; give a tangent like x")
    return tangents


def push(fun: Callable, tree: Any, tangents: Sequence) -> tuple:
    """Return the value of a function of a tree, and its tangent.

    Uses forward mode, or two reverse passes if a part of `fun` has no JVP.

    Parameters
    ----------
    fun : callable
    tree : tree
    tangents : sequence
        For each leaf of the tree its tangent, or None for a constant.

    Returns
    -------
    value, tangent : trees
        The tangent has None in place of leaves that are not floating.
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
    """Return the tangent of a result in the dtype of the result; zeros for a constant, None if it is not floating."""
    if not is_variable(value):
        return None
    if slope is None:
        return zero_like(value)
    return fit("a rule", value, slope, slope)


def zero_like(value: Any) -> Any:
    """Return plain zeros of the shape and dtype of a value, traced or not."""
    return np.zeros(np.shape(sample(value)), dtype_of(value))[()]


def _twice_reverse(fun, tree, tangents):
    """Return the value of a function, and its tangent by two reverse passes.

    The pullback z -> J^T z is linear, so the gradient of <J^T z, tangent> with respect to z is J tangent for every z.
    It is evaluated at a random z and not at zero, because a rule may have a special branch for zero cotangents.
    """
    tape = taped(fun, tree, [tangent is not None for tangent in tangents])
    moving = [is_variable(value) for value in tape.values]

    def product(z):
        total = 0.0
        for cotangent, tangent in zip(tape.pull(z), tangents, strict=True):
            if cotangent is not None:
                total = total + anp.sum(cotangent * tangent)
        return total

    z = [random_like(value) if moves else None for value, moves in zip(tape.values, moving, strict=True)]
    slopes = taped(product, z, moving).pull([1.0])
    return tape.rebuild(tape.values), tape.rebuild(map(tangent_of, tape.values, slopes))


def random_like(value: Any) -> Any:
    """Return random numbers of the shape and dtype of a value, plain or traced, the same in every run."""
    numbers = np.random.default_rng(0).uniform(0.5, 1.5, np.shape(sample(value)))
    return np.asarray(numbers, dtype_of(value))[()]


# ---- derivatives that are not finite ---------------------------------------------------------------------------------


@contextmanager
def unwarned() -> Iterator[None]:
    """Suppress NonFiniteGradientWarning inside a `with` block, for callers that check derivatives themselves."""
    thread.quiet += 1
    try:
        yield
    finally:
        thread.quiet -= 1


def _warn_unless_finite(name, derivative, again):
    """Warn of NaN or infinity in a derivative, and name the call that produced it.

    Parameters
    ----------
    name : str
        Name of the public function that returns the derivative.
    derivative : tree
        Not checked if it has traced leaves, because then the outer derivative is checked.
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
    """Return True if an array or number, plain or traced, contains neither NaN nor infinity."""
    value = plain(value)
    return surely_finite(value) or bool(np.all(np.isfinite(value)))


def _cause_of_non_finite(again):
    """Return a message that names the first call in the backward pass whose own derivative is not finite.

    Return None if there is no such call, or if several processes share the fields.

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
    except Exception:  # the function may fail when it is run a second time
        pass
    return None


@contextmanager
def checking_derivatives() -> Iterator[None]:
    """Raise NonFiniteError inside a `with` block for the first call whose own derivative is NaN or infinite.

    Calls that get a cotangent with NaN or with entries above `LARGE` are not checked, since their own derivative may be
    finite. Used in a second run, after a gradient was not finite.
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

    with observed_nodes(see), np.errstate(all="ignore"):
        yield


def _check_derivative(name, argument, cotangent):
    """Raise NonFiniteError if the cotangent of an argument of a call is not finite."""
    if not is_variable(cotangent):
        return
    finite = np.isfinite(plain(cotangent))
    if not np.all(finite):
        first = np.ravel(plain(argument))[np.argmin(finite)]
        raise NonFiniteError(
            f"the derivative of {name} is NaN or infinite where its argument is {first:.6g}; keep it away from there"
        )


def name_of(subject: Any) -> Any:
    """Return the name of a rule, an Operator or a function of autograd for error messages."""
    return getattr(subject, "name", None) or getattr(subject, "__name__", type(subject).__name__)


# ---- rules of fields -------------------------------------------------------------------------------------------------


def entrywise(name: str, value: Callable, slopes: Callable) -> Rule:
    """Return a rule for an elementwise function of fields of one shape.

    Parameters
    ----------
    name : str
    value : callable
        ``value(*fields)``.
    slopes : callable
        ``slopes(*fields)`` returns the derivatives with respect to each field; it must accept traced values.
    """

    def vjp(nums, ans, *fields):
        partials = slopes(*fields)
        return lambda g: tuple(g * partials[num] for num in nums)

    def jvp(nums, tangents, ans, *fields):
        partials = slopes(*fields)
        return sum(partials[num] * tangent for num, tangent in zip(nums, tangents, strict=True))

    return Rule(name, value, vjp, jvp)


def of_argument(cotangent: Any, value: Any) -> Any:
    """Convert a cotangent of a product of fields to the shape of an argument, and to real if the argument is real.

    A batch axis that the argument does not have is summed over.
    """
    cotangent = match_value(cotangent, value)
    while np.ndim(cotangent) > np.ndim(value):
        cotangent = anp.sum(cotangent, axis=0)
    if dtype_of(cotangent).kind == "c" != dtype_of(value).kind:
        return cast(cotangent, float)
    return cotangent
