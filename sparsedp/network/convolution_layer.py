r"""Convolution layers in 1-D and 2-D, with derivatives of every order.

With the padded field P x the layer is  y[o, i] = sum_{c, d} w[o, c, d] (P x)[c, i + d] + b[o],  a bilinear map of x
and w. The trilinear form T(x, w, g) = sum g . y has three partial derivatives, each a bilinear map of the other two
arguments:

    with respect to x: correlation of g with the reversed filters, then P^T;
    with respect to w: correlation of P x with g;
    with respect to g: y itself;

and the partial derivatives of each of these three maps are given by the other two maps. A single derivative rule
therefore covers all three maps, and derivatives of every order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.validation import check_choice
from sparsedp.autodiff.tape import Rule, sample
from sparsedp.errors import ShapeError
from sparsedp.network.correlation import PADDINGS, correlate, filter_gradient, pad, pad_transposed

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["check_widths", "convolution", "weight_and_bias"]

X, W, Y = 0, 1, 2  # positions of x, w and g in the trilinear form; the derivative with respect to g is y


def convolution(p: dict[str, Any], x: Any, padding: str = "periodic") -> Any:
    """Apply a convolution layer to cell fields: each output is the sum of all filtered inputs plus a bias.

    The filters are correlated with the field (they are not reversed), and the output lies on the same cells as `x`.

    Parameters
    ----------
    p : dict
        weight : (outputs, inputs, width) in 1-D, (outputs, inputs, width_x, width_y) in 2-D, odd widths;
        bias : (outputs,).
        Both may have an additional leading axis, with separate parameters for each sample of `x`.
    x : (samples, inputs, n) or (samples, inputs, nx, ny) array
    padding : "periodic", "zero" or "replicate"
        How the field is continued outside the domain: periodically, by zeros, or by the value of the nearest cell.

    Returns
    -------
    (samples, outputs, n) or (samples, outputs, nx, ny) array

    Raises
    ------
    ValueError
        If `padding` is none of the three names, or a width is even.
    ShapeError
        If the shapes of `x`, the weight and the bias do not match.

    See Also
    --------
    network.dense, network.convolution_weights, network.residual_block, network.training_range

    Examples
    --------
    >>> p = {"weight": np.array([[[-0.5, 0.0, 0.5]]]), "bias": np.zeros(1)}
    >>> convolution(p, np.array([[[0.0, 1.0, 4.0, 9.0]]]), "replicate")
    array([[[0.5, 2. , 4. , 2.5]]])
    """
    weight, bias = weight_and_bias(p, "convolution")
    _check(np.shape(sample(weight)), np.shape(sample(bias)), np.shape(sample(x)), padding)
    bias_on_cells = anp.reshape(bias, anp.shape(bias) + (1,) * (anp.ndim(x) - 2))
    return _trilinear(x, weight, Y, anp.shape(weight), padding) + bias_on_cells


def weight_and_bias(p: dict[str, Any], layer: str) -> tuple[Any, Any]:
    """Return the weight and the bias from the parameters of a layer; raise TypeError if one of them is missing."""
    try:
        return p["weight"], p["bias"]
    except (KeyError, TypeError, IndexError):
        names = type(p).__name__
        if isinstance(p, dict):
            names = ", ".join(map(str, p))
        raise TypeError(
            f"{layer} takes the dict of one layer, with weight and bias, got {names}; write p['name'] of that layer"
        ) from None


def check_widths(widths: Sequence[int]) -> None:
    """Raise ValueError for a filter of even width, which has no central entry."""
    if any(width % 2 == 0 for width in widths):
        raise ValueError(f"convolution needs odd widths, so that the output lies on the same cells, got {widths}")


def _check(weight, bias, x, padding):
    """Raise an error if the shapes of weight, bias and field do not match, or if the padding is unknown."""
    check_choice("padding", padding, PADDINGS)
    dim = len(x) - 2
    if dim not in (1, 2) or len(weight) not in (dim + 2, dim + 3):
        raise ShapeError(
            f"convolution takes x (samples, inputs, n) or (samples, inputs, nx, ny) and a weight (outputs, inputs, "
            f"widths), got {x} and {weight}"
        )
    check_widths(weight[-dim:])
    copies = weight[: len(weight) - dim - 2]
    outputs = weight[-dim - 2]
    inputs = weight[-dim - 1]
    if inputs != x[1] or bias != (*copies, outputs) or copies not in ((), x[:1]):
        raise ShapeError(f"convolution got x {x}, weight {weight} and bias {bias}; inputs, outputs or samples differ")


def _derivative_of_form(a, b, argument, weight_shape, padding):
    """Return the derivative of T(x, w, g) with respect to one argument, X, W or Y.

    `a` and `b` are the values of the other two arguments in cyclic order (x, w, g): they are w and g for X, g and x
    for W, x and w for Y.
    """
    field = b if argument == X else a
    if np.ndim(field) == 3:  # treat a 1-D field as a 2-D field with a single line
        shape = (*weight_shape[:-1], 1, weight_shape[-1])
        return _derivative_of_form(a[..., None, :], b[..., None, :], argument, shape, padding)[..., 0, :]
    widths = weight_shape[-2:]
    if argument == X:
        reversed_filters = np.swapaxes(a[..., ::-1, ::-1], -3, -4)
        padded = pad(b, [2 * width - 1 for width in widths], "zero")
        return pad_transposed(correlate(padded, reversed_filters), widths, padding)
    if argument == W:
        return filter_gradient(pad(b, widths, padding), a, weight_shape)
    return correlate(pad(a, widths, padding), b)


def _vjp(nums, y, a, b, argument, *rest):
    """Return the VJP with respect to `a` and `b`.

    `a` and `b` are the arguments (argument + 1) % 3 and (argument + 2) % 3 of the trilinear form.
    """

    def pull(g):
        cotangents = []
        for num in nums:
            if num == 0:
                cotangents.append(_trilinear(b, g, (argument + 1) % 3, *rest))
            else:
                cotangents.append(_trilinear(g, a, (argument + 2) % 3, *rest))
        return tuple(cotangents)

    return pull


def _jvp(nums, tangents, y, a, b, *rest):
    """Return the JVP: the product rule for a map that is linear in `a` and in `b`."""
    total = None
    for num, tangent in zip(nums, tangents, strict=True):
        if num == 0:
            term = _trilinear(tangent, b, *rest)
        else:
            term = _trilinear(a, tangent, *rest)
        total = term if total is None else total + term
    return total


_trilinear = Rule("convolution", _derivative_of_form, _vjp, _jvp)
