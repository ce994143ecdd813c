r"""Convolution layers in 1-D and 2-D: one fused rule, derivatives of every order by hand.

With the padded field P x the layer is  y[o, i] = sum_{c, d} w[o, c, d] (P x)[c, i + d] + b[o],  a bilinear map of x
and w. With the trilinear form T(x, w, g) = sum g . y its derivatives are two more bilinear maps,

    back(g, w):  sum_o of g against the filters turned round, then P^T: the cotangent of x;
    weigh(x, g): correlation of P x with g: the cotangent of w;

and the derivatives of each of the three are the other two.
"""

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.network.correlation import correlate, fold, pad, weigh
from sparsedp.tape import Rule, plain

__all__ = ["check_widths", "convolution"]

PADDINGS = ("periodic", "zero", "replicate")


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
    return _convolution(x, weight, bias, padding)


def weight_and_bias(p, layer):
    """The two arrays of one layer."""
    try:
        return p["weight"], p["bias"]
    except (KeyError, TypeError, IndexError):
        found = ", ".join(map(str, p)) if isinstance(p, dict) else type(p).__name__
        raise TypeError(
            f"{layer} takes the dict of one layer, with weight and bias, got {found}; write p['name'] of that layer"
        ) from None


def check_widths(widths):
    """Refuse filters without a middle."""
    if any(width % 2 == 0 for width in widths):
        raise ValueError(f"convolution needs odd widths, so that the output lies on the same cells, got {widths}")


def _check(weight, bias, x, padding):
    if padding not in PADDINGS:
        raise ValueError(f"padding must be periodic, zero or replicate, got {padding!r}")
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


def by_parts(name, forward, backs, forths):
    """A rule from its derivatives in each of its first arguments.

    Parameters
    ----------
    name : str
    forward : callable
        ``forward(*args) -> y``.
    backs, forths : tuples of callables
        ``back(g, y, *args)``, the cotangent of one argument, and ``forth(t, y, *args)``, the tangent of y along one.
    """

    def vjp(nums, y, *args):
        return lambda g: tuple(backs[num](g, y, *args) for num in nums)

    def jvp(nums, tangents, y, *args):
        parts = [forths[num](t, y, *args) for num, t in zip(nums, tangents, strict=True)]
        return sum(parts[1:], parts[0])

    return Rule(name, forward, vjp, jvp)


def _plain_linear(x, weight, padding):
    return correlate(pad(x, weight.shape[2 - np.ndim(x) :], padding), weight)


def _plain_back(g, weight, padding):
    dim = np.ndim(g) - 2
    turned = np.swapaxes(np.flip(weight, tuple(range(-dim, 0))), -dim - 1, -dim - 2)
    widths = weight.shape[-dim:]
    return fold(correlate(pad(g, [2 * width - 1 for width in widths], "zero"), turned), widths, padding)


def _plain_weigh(x, g, shape, padding):
    return weigh(pad(x, shape[2 - np.ndim(x) :], padding), g, shape)


def _spread(bias, cells):
    """One number for each output, or for each of every sample -> the same on all cells."""
    return anp.reshape(bias, anp.shape(bias) + (1,) * len(cells))


def _forward(x, weight, bias, padding):
    y = _plain_linear(x, weight, padding)
    y += _spread(bias, x.shape[2:])
    return y


def _total(g, y, x, weight, bias, padding):
    """Cotangent of the bias: the sum over cells, and over samples unless each has its own."""
    g = anp.sum(g, axis=tuple(range(2, anp.ndim(g))))
    return g if anp.ndim(bias) == 2 else anp.sum(g, axis=0)


_convolution = by_parts(
    "convolution",
    _forward,
    (
        lambda g, y, x, weight, bias, padding: _back(g, weight, padding),
        lambda g, y, x, weight, bias, padding: _weigh(x, g, anp.shape(weight), padding),
        _total,
    ),
    (
        lambda t, y, x, weight, bias, padding: _linear(t, weight, padding),
        lambda t, y, x, weight, bias, padding: _linear(x, t, padding),
        lambda t, y, x, weight, bias, padding: _spread(t, anp.shape(y)[2:]) + anp.zeros(anp.shape(y)),
    ),
)


def _bilinear(name, forward, first, second):
    """A bilinear rule of (a, b, *static); first(g, a, b, *static) and second are the cotangents of a and b."""
    rule: Rule = by_parts(
        name,
        forward,
        (lambda g, y, *args: first(g, *args), lambda g, y, *args: second(g, *args)),
        (lambda t, y, a, *rest: rule(t, *rest), lambda t, y, a, b, *static: rule(a, t, *static)),
    )
    return rule


_linear: Rule = _bilinear(
    "convolution, linear part",
    _plain_linear,
    lambda g, x, weight, padding: _back(g, weight, padding),
    lambda g, x, weight, padding: _weigh(x, g, anp.shape(weight), padding),
)
_back: Rule = _bilinear(
    "convolution, back",
    _plain_back,
    lambda h, g, weight, padding: _linear(h, weight, padding),
    lambda h, g, weight, padding: _weigh(h, g, anp.shape(weight), padding),
)
_weigh: Rule = _bilinear(
    "convolution, weights",
    _plain_weigh,
    lambda v, x, g, shape, padding: _back(g, v, padding),
    lambda v, x, g, shape, padding: _linear(x, v, padding),
)
