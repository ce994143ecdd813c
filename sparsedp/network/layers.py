"""Dense layers, activations and residual blocks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.tape import Rule, plain
from sparsedp.errors import ShapeError
from sparsedp.network.convolution_layer import convolution, weight_and_bias

__all__ = ["dense", "relu", "residual_block", "softplus", "tanh"]


def dense(p: dict[str, Any], x: Any) -> Any:
    """Compute x @ weight + bias.

    Parameters
    ----------
    p : dict
        weight : (inputs, outputs); bias : (outputs,). Both may have an additional leading axis, one copy for each
        sample.
    x : (samples, inputs) array

    Returns
    -------
    (samples, outputs) array

    Raises
    ------
    ShapeError
        If the shapes do not fit.

    See Also
    --------
    network.dense_weights, network.convolution

    Examples
    --------
    >>> dense({"weight": np.array([[1.0, 2.0]]), "bias": np.zeros(2)}, np.array([[3.0]]))
    array([[3., 6.]])
    """
    weight, bias = weight_and_bias(p, "dense")
    weight_shape = np.shape(plain(weight))
    bias_shape = np.shape(plain(bias))
    x_shape = np.shape(plain(x))
    copies = weight_shape[:-2]
    inputs_fit = len(x_shape) == 2 and weight_shape[-2:-1] == x_shape[1:]
    if not inputs_fit or bias_shape != (*copies, *weight_shape[-1:]) or copies not in ((), x_shape[:1]):
        raise ShapeError(
            f"dense takes x (samples, inputs), a weight (inputs, outputs) and a bias (outputs,), "
            f"got {x_shape}, {weight_shape} and {bias_shape}"
        )
    if copies:
        return (x[:, None] @ weight)[:, 0] + bias
    return x @ weight + bias


def _tanh_vjp(nums, y, x):
    return lambda g: (g * (1.0 - y * y),)


def _tanh_jvp(nums, tangents, y, x):
    return tangents[0] * (1.0 - y * y)


_TANH = Rule("tanh", np.tanh, _tanh_vjp, _tanh_jvp)  # autograd's own derivative overflows


def tanh(x: Any) -> Any:
    """Compute the hyperbolic tangent of each number.

    Parameters
    ----------
    x : array

    Returns
    -------
    array like x

    See Also
    --------
    network.relu, network.softplus

    Examples
    --------
    >>> float(tanh(np.array(0.0)))
    0.0
    """
    return _TANH(x)


def relu(x: Any) -> Any:
    """Compute max(x, 0) of each number; the derivative at 0 is 1/2, the mean of both sides.

    Parameters
    ----------
    x : array

    Returns
    -------
    array like x

    See Also
    --------
    network.softplus, network.tanh

    Examples
    --------
    >>> relu(np.array([-1.0, 2.0]))
    array([0., 2.])
    """
    return anp.maximum(x, 0.0)


def softplus(x: Any) -> Any:
    """Compute log(1 + exp(x)) of each number, without overflow.

    Parameters
    ----------
    x : array

    Returns
    -------
    array like x

    See Also
    --------
    network.relu, network.tanh

    Examples
    --------
    >>> softplus(np.array([0.0, 1000.0]))
    array([6.93147181e-01, 1.00000000e+03])
    """
    return anp.logaddexp(x, 0.0)


def residual_block(
    p: dict[str, dict[str, Any]], x: Any, activation: Callable[[Any], Any] = tanh, padding: str = "periodic"
) -> Any:
    """Add two convolutions to the identity: x + second(activation(first(x))).

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

    See Also
    --------
    network.convolution, network.residual_weights

    Examples
    --------
    >>> from sparsedp.network.weights import residual_weights
    >>> x = np.ones((1, 2, 8))
    >>> np.array_equal(residual_block(residual_weights(np.random.default_rng(0), 2, 3, gain=0.0), x), x)
    True
    """
    hidden = activation(convolution(p["first"], x, padding))
    return x + convolution(p["second"], hidden, padding)
