"""Derivatives of functions between trees: along tangents that some leaves have, and back from several results."""

import autograd.numpy as anp

from sparsedp.derivative import NO_JVP, directions, forward, grad, tangent_of, traced, zero_like
from sparsedp.fields import check_function
from sparsedp.tape import dtype_of, isbox
from sparsedp.traces import backward, reverse_root, split_box
from sparsedp.tree import copied, flatten, leaves

__all__ = ["hvp", "jvp", "pull_ends", "push"]


def jvp(fun, x, tangent):
    """Function of a tree -> its value and its directional derivative.

    Parameters
    ----------
    fun : callable
        ``fun(x)``; its result may be a tree.
    x, tangent : trees of arrays of the same structure
        The tangent of a leaf that is not floating is ignored.

    Returns
    -------
    (value, tangent of value)

    Raises
    ------
    TypeError
        If `fun` is not a function.
    ShapeError
        If the tangent has another structure than `x`, or a leaf of it another shape.

    Notes
    -----
    Forward mode; by two reverse passes where a part of `fun` has no forward derivative.

    Examples
    --------
    >>> value, slope = jvp(lambda x: x[0] * x[1], (2.0, 5.0), (1.0, 0.0))
    >>> float(value), float(slope)
    (10.0, 5.0)
    """
    check_function("jvp", fun, "lambda u: ...")
    return copied(push(fun, x, directions(x, tangent)))  # the caller may write into x, the tangent and the results


def hvp(loss, x, tangent):
    """Scalar loss of a tree, a direction -> the Hessian of the loss times the direction.

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

    Examples
    --------
    >>> hvp(lambda x: x[0] ** 2 * x[1], (2.0, 5.0), (1.0, 0.0))
    (10.0, 4.0)
    """
    product = jvp(grad(loss), x, tangent)[1]
    found, rebuild = flatten(product)
    return rebuild([float(p) if isinstance(u, float) and not isbox(p) else p for p, u in zip(found, leaves(x))])


def push(fun, tree, tangents):
    """fun, its argument, a tangent or None for each leaf -> (value, tangent of it as a tree, None at constants).

    Forward, or by two reverse passes where a part of `fun` has no JVP.
    """
    try:
        return forward(fun, tree, tangents)
    except NO_JVP:
        if any(dtype_of(t).kind == "c" for t in tangents if t is not None):
            raise
        return _twice_reverse(fun, tree, tangents)


def _twice_reverse(fun, tree, tangents):
    """The pullback z -> J^T z is linear, so the gradient in z of <J^T z, tangent> is J tangent."""
    roots = [None if tangent is None else reverse_root() for tangent in tangents]
    result, number = traced(fun, tree, roots)
    found, rebuild = flatten(result)
    parts = [split_box(leaf, number) for leaf in found]
    used = [place for place, (_, node) in enumerate(parts) if node is not None]
    moving = [(root, tangent) for root, tangent in zip(roots, tangents, strict=True) if root is not None]

    def paired(z):
        backs = pull_ends([parts[place][1] for place in used], z, [root for root, _ in moving])
        products = [anp.sum(back * t) for back, (_, t) in zip(backs, moving, strict=True) if back is not None]
        return sum(products[1:], products[0]) if products else 0.0

    starts = [reverse_root() for _ in used]
    total, inner = traced(paired, [zero_like(parts[place][0]) for place in used], starts)
    _, end = split_box(total, inner)
    slopes = {} if end is None else backward(end, 1.0)
    known = dict(zip(used, starts, strict=True))
    values = [value for value, _ in parts]
    return rebuild(values), rebuild(
        tangent_of(value, slopes.get(known[place]) if place in known else None) for place, value in enumerate(values)
    )


class _Ends:
    """Stands for the last node of a graph with several results: hands each its cotangent."""

    __slots__ = ("_cotangents", "parents")

    def __init__(self, nodes, cotangents):
        self.parents, self._cotangents = nodes, cotangents

    def vjp(self, g):
        """The cotangents, in the order of the results."""
        return self._cotangents


def pull_ends(nodes, cotangents, roots):
    """Nodes of results and their cotangents -> cotangent of each root, None where there is none."""
    if not nodes:
        return [None] * len(roots)
    found = backward(nodes[0], cotangents[0]) if len(nodes) == 1 else backward(_Ends(nodes, cotangents), None)
    return [found.get(root) for root in roots]
