r"""Convolution layers in 1-D and 2-D: one rule for three products, derivatives of every order by hand.

With the padded field P x the layer is  y[o, i] = sum_{c, d} w[o, c, d] (P x)[c, i + d] + b[o],  a bilinear map of x
and w. With the trilinear form T(x, w, g) = sum g . y there are three such maps, each of two of the three:

    0, the cotangent of x: sum_o of g against the filters turned round, then P^T;
    1, the cotangent of w: correlation of P x with g;
    2, y itself;

and the derivatives of each of the three are the other two.
"""

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.validation import check_choice
from sparsedp.autodiff.tape import Rule, plain
from sparsedp.errors import ShapeError
from sparsedp.network.correlation import MODES, correlate, fold, pad, weigh

__all__ = ["check_widths", "convolution"]


def convolution(p, x, padding="periodic"):
    """Weights and fields on cells -> fields on the same cells, each a sum of filtered inputs plus a bias.

    Parameters
    ----------
    p : dict
        weight : (outputs, inputs, width) in 1-D, (outputs, inputs, width_x, width_y) in 2-D, odd widths;
        bias : (outputs,).
        Both may have one more leading axis, one copy for each sample of x.
    x : (samples, inputs, n) or (samples, inputs, nx, ny) array
    padding : "periodic", "zero" or "replicate"
        What lies beyond the field.

    Returns
    -------
    (samples, outputs, n) or (samples, outputs, nx, ny) array

    Raises
    ------
    ValueError
        If the padding is not known or a width is even.
    ShapeError
        If the shapes do not fit.

    Examples
    --------
    >>> p = {"weight": np.array([[[-0.5, 0.0, 0.5]]]), "bias": np.zeros(1)}
    >>> convolution(p, np.array([[[0.0, 1.0, 4.0, 9.0]]]), "replicate")
    array([[[0.5, 2. , 4. , 2.5]]])
    """
    weight, bias = weight_and_bias(p, "convolution")
    _check(np.shape(plain(weight)), np.shape(plain(bias)), np.shape(plain(x)), padding)
    on_cells = anp.reshape(bias, anp.shape(bias) + (1,) * (anp.ndim(x) - 2))  # of each output, or of every sample's
    return _trilinear(x, weight, 2, anp.shape(weight), padding) + on_cells


def weight_and_bias(p, layer):
    """The two arrays of one layer."""
    try:
        return p["weight"], p["bias"]
    except (KeyError, TypeError, IndexError):
        names = ", ".join(map(str, p)) if isinstance(p, dict) else type(p).__name__
        raise TypeError(
            f"{layer} takes the dict of one layer, with weight and bias, got {names}; write p['name'] of that layer"
        ) from None


def check_widths(widths):
    """Refuse filters without a middle."""
    if any(width % 2 == 0 for width in widths):
        raise ValueError(f"convolution needs odd widths, so that the output lies on the same cells, got {widths}")


def _check(weight, bias, x, padding):
    check_choice("padding", padding, MODES)
    dim = len(x) - 2
    if dim not in (1, 2) or len(weight) not in (dim + 2, dim + 3):
        raise ShapeError(
            f"convolution takes x (samples, inputs, n) or (samples, inputs, nx, ny) and a weight (outputs, inputs, "
            f"widths), got {x} and {weight}"
        )
    widths, copies = weight[-dim:], weight[: len(weight) - dim - 2]
    check_widths(widths)
    if weight[-dim - 1] != x[1] or bias != (*copies, weight[-dim - 2]) or copies not in ((), x[:1]):
        raise ShapeError(f"convolution got x {x}, weight {weight} and bias {bias}; inputs, outputs or samples differ")


def _third(a, b, slot, shape, padding):
    """Of x, w and g in T(x, w, g), slots 0, 1 and 2, what multiplies the one in a slot: made of the next two in turn.

    `shape` is that of the weight.
    """
    if np.ndim(a if slot else b) == 3:  # a field in 1-D is one in 2-D with one line
        return _third(a[..., None, :], b[..., None, :], slot, (*shape[:-1], 1, shape[-1]), padding)[..., 0, :]
    widths = shape[-2:]
    if slot == 0:
        turned = np.swapaxes(a[..., ::-1, ::-1], -3, -4)
        return fold(correlate(pad(b, [2 * width - 1 for width in widths], "zero"), turned), widths, padding)
    if slot == 1:
        return weigh(pad(b, widths, padding), a, shape)
    return correlate(pad(a, widths, padding), b)


def _vjp(nums, y, a, b, slot, *rest):
    """The cotangent of a, which stands two slots before the third, and of b, which stands one before."""
    return lambda g: tuple(
        _trilinear(g, a, (slot + 2) % 3, *rest) if num else _trilinear(b, g, (slot + 1) % 3, *rest) for num in nums
    )


def _jvp(nums, tangents, y, a, b, *rest):
    parts = [_trilinear(a, t, *rest) if num else _trilinear(t, b, *rest) for num, t in zip(nums, tangents, strict=True)]
    return sum(parts[1:], parts[0])


_trilinear = Rule("convolution", _third, _vjp, _jvp)
