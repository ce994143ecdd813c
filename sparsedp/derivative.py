"""Derivatives of whole programs: any function of a tree of arrays, forward and backward."""

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.tape import (
    backward,
    dtype_of,
    fit,
    forward_root,
    is_variable,
    isbox,
    plain,
    reverse_root,
    split_box,
    trace,
)
from sparsedp.tree import flatten, leaves

__all__ = ["pullback", "pushforward", "value_and_grad"]


def pullback(fun, x):
    """Function of a tree -> its value, and the function from a cotangent to the VJP.

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
        If no leaf of `x` is a floating array or number.

    Examples
    --------
    >>> value, pull = pullback(lambda x: x[0] * x[1], (2.0, 5.0))
    >>> pull(1.0)
    (5.0, 2.0)
    """
    found, rebuild = flatten(x)
    roots = [reverse_root() if is_variable(leaf) else None for leaf in found]
    if not any(roots):
        kinds = sorted({str(getattr(leaf, "dtype", type(leaf).__name__)) for leaf in found})
        raise DerivativeError(
            f"a gradient needs floating values, got {', '.join(kinds) or 'nothing'}; write x.astype(float)"
        )
    value, node = split_box(*trace(fun, x, roots))

    def pull(g):
        cotangents = {} if node is None else backward(node, g)
        return rebuild(
            [
                None if root is None else _gradient(leaf, cotangents.get(root))
                for leaf, root in zip(found, roots, strict=True)
            ]
        )

    return value, pull


def _gradient(leaf, cotangent):
    if cotangent is None:
        return 0.0 if isinstance(leaf, float) else anp.zeros_like(plain(leaf))
    cotangent = fit("the gradient", leaf, cotangent, cotangent)
    return float(cotangent) if isinstance(leaf, float) and not isbox(cotangent) else cotangent


def pushforward(fun, x, tangent):
    """Function of a tree -> its value and its directional derivative (JVP).

    Parameters
    ----------
    fun : callable
        ``fun(x)``; its result may be a tree.
    x, tangent : trees of arrays of the same structure
        The tangent of a leaf that is not floating is ignored.

    Returns
    -------
    (value, tangent of value)

    Examples
    --------
    >>> value, slope = pushforward(lambda x: x[0] * x[1], (2.0, 5.0), (1.0, 0.0))
    >>> float(value), float(slope)
    (10.0, 5.0)
    """
    found, directions = leaves(x), leaves(tangent)
    roots = [
        forward_root(direction) if is_variable(leaf) else None
        for leaf, direction in zip(found, directions, strict=True)
    ]
    result, number = trace(fun, x, roots)
    ends, rebuild = flatten(result)
    pairs = [split_box(end, number) for end in ends]
    values = rebuild(value for value, node in pairs)
    return values, rebuild(_no_tangent(value) if node is None else node.g for value, node in pairs)


def _no_tangent(value):
    return anp.zeros_like(plain(value)) if is_variable(value) else None


def value_and_grad(loss):
    """Scalar loss of a tree -> function that returns the value and the gradient.

    Parameters
    ----------
    loss : callable
        ``loss(x, *rest) -> real scalar``; `x` is any nesting of arrays, tuples, lists and dicts.

    Returns
    -------
    callable
        ``f(x, *rest) -> (value, gradient)``. The gradient has the structure of `x`, each leaf the
        shape and dtype of its twin. Leaves that are not floating (int, bool, None, str) are passed
        to the loss unchanged; their place in the gradient holds None.

    Raises
    ------
    ShapeError
        If the loss is not a scalar.
    DerivativeError
        If the loss is complex, or `x` holds no floating value.

    Examples
    --------
    >>> value_and_grad(lambda x: x["a"] ** 2 * x["n"])({"a": 3.0, "n": 2})
    (18.0, {'a': 12.0, 'n': None})
    """

    def evaluate(x, *rest):
        value, pull = pullback(lambda tree: loss(tree, *rest), x)
        if np.shape(plain(value)) != ():
            raise ShapeError(f"the loss must be a scalar, got an array of shape {np.shape(plain(value))}; sum it")
        if dtype_of(value).kind == "c":
            raise DerivativeError(
                "the loss must be real, got a complex number; take its real part or its absolute value"
            )
        return value if isbox(value) else float(value), pull(1.0)

    return evaluate
