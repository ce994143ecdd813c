"""Dense layers, activations and residual blocks."""

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.tape import Rule, plain
from sparsedp.errors import ShapeError
from sparsedp.network.filters import convolution, weight_and_bias

__all__ = ["dense", "relu", "residual_block", "softplus", "tanh"]


def dense(p, x):
    """Weights and vectors -> x @ weight + bias.

    Parameters
    ----------
    p : dict
        weight : (inputs, outputs); bias : (outputs,). Both may have one more leading axis, one copy for each sample.
    x : (samples, inputs) array

    Returns
    -------
    (samples, outputs) array

    Raises
    ------
    ShapeError
        If the shapes do not fit.

    Examples
    --------
    >>> dense({"weight": np.array([[1.0, 2.0]]), "bias": np.zeros(2)}, np.array([[3.0]]))
    array([[3., 6.]])
    """
    weight, bias = weight_and_bias(p, "dense")
    w, b, given = (np.shape(plain(value)) for value in (weight, bias, x))
    copies = w[:-2]
    if len(given) != 2 or w[-2:-1] != given[1:] or b != (*copies, *w[-1:]) or copies not in ((), given[:1]):
        raise ShapeError(
            f"dense takes x (samples, inputs), a weight (inputs, outputs) and a bias (outputs,), "
            f"got {given}, {w} and {b}"
        )
    product = x @ weight if len(w) == 2 else (x[:, None] @ weight)[:, 0]
    return product + bias


_TANH = Rule(  # autograd's own overflows
    "tanh", np.tanh, lambda nums, y, x: lambda g: (g * (1.0 - y * y),), lambda nums, t, y, x: t[0] * (1.0 - y * y)
)


def tanh(x):
    """Hyperbolic tangent of each number.

    in: x, an array of any shape.
    out: an array like x.

    >>> float(tanh(np.array(0.0)))
    0.0
    """
    return _TANH(x)


def relu(x):
    """max(x, 0) of each number; the derivative at 0 is 1/2, the mean of both sides.

    in: x, an array of any shape.
    out: an array like x.

    >>> relu(np.array([-1.0, 2.0]))
    array([0., 2.])
    """
    return anp.maximum(x, 0.0)


def softplus(x):
    """log(1 + exp(x)) of each number, without overflow.

    in: x, an array of any shape.
    out: an array like x.

    >>> softplus(np.array([0.0, 1000.0]))
    array([6.93147181e-01, 1.00000000e+03])
    """
    return anp.logaddexp(x, 0.0)


def residual_block(p, x, activation=tanh, padding="periodic"):
    """Two convolutions beside the identity: x + second(activation(first(x))).

    Parameters
    ----------
    p : dict
        first, second : weights of convolutions; see residual_weights.
    x : (samples, channels, *cells) array
    activation : callable
    padding : str
        As for convolution.

    Returns
    -------
    array like x

    Raises
    ------
    ShapeError, ValueError
        As convolution.

    Examples
    --------
    >>> from sparsedp.network.weights import residual_weights
    >>> x = np.ones((1, 2, 8))
    >>> np.array_equal(residual_block(residual_weights(np.random.default_rng(0), 2, 3, gain=0.0), x), x)
    True
    """
    return x + convolution(p["second"], activation(convolution(p["first"], x, padding)), padding)
