"""Dense layers, activations and residual blocks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.tape import Rule, sample
from sparsedp.errors import ShapeError
from sparsedp.network.convolution_layer import convolution, weight_and_bias

__all__ = ["dense", "relu", "residual_block", "softplus", "tanh"]


def dense(p: dict[str, Any], x: Any) -> Any:
    """Compute x @ weight + bias.

    Parameters
    ----------
    p : dict
        weight : (inputs, outputs); bias : (outputs,). Both may have an additional leading axis, with separate
        parameters for each sample of `x`.
    x : (samples, inputs) array

    Returns
    -------
    (samples, outputs) array

    Raises
    ------
    ShapeError
        If the shapes of `x`, the weight and the bias do not match.

    See Also
    --------
    network.dense_weights, network.convolution, network.training_range

    Examples
    --------
    >>> dense({"weight": np.array([[1.0, 2.0]]), "bias": np.zeros(2)}, np.array([[3.0]]))
    array([[3., 6.]])
    """
    weight, bias = weight_and_bias(p, "dense")
    weight_shape = np.shape(sample(weight))
    bias_shape = np.shape(sample(bias))
    x_shape = np.shape(sample(x))
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


_TANH = Rule("tanh", np.tanh, _tanh_vjp, _tanh_jvp)  # 1 - tanh(x)^2 cannot overflow; autograd divides by cosh(x)^2


def tanh(x: Any) -> Any:
    """Compute the hyperbolic tangent elementwise.

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
    """Compute max(x, 0) elementwise. The derivative at 0 is 1/2, the mean of the one-sided derivatives.

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
    """Compute log(1 + exp(x)) elementwise, without overflow.

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
    """Apply a residual block: x + second(activation(first(x))), where first and second are convolutions.

    Parameters
    ----------
    p : dict
        first, second : parameters of the two convolutions; see `residual_weights`.
    x : (samples, channels, *cells) array
    activation : callable
        Applied between the two convolutions.
    padding : str
        See `convolution`.

    Returns
    -------
    array like x

    Raises
    ------
    ShapeError, ValueError
        See `convolution`.

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
