"""Small networks as plain functions of a parameter tree: dense and convolution layers, nothing more.

A layer is ``layer(p, x)`` with p a dict of arrays; a network is a Python function that calls layers; its parameters
are any nesting of such dicts, and minimize takes them as they are.
"""

from sparsedp._utils.calls import describe_module
from sparsedp.network.convolution_layer import convolution
from sparsedp.network.layers import dense, relu, residual_block, softplus, tanh
from sparsedp.network.weights import convolution_weights, dense_weights, load, residual_weights, save

__all__ = [
    "convolution",
    "convolution_weights",
    "dense",
    "dense_weights",
    "load",
    "relu",
    "residual_block",
    "residual_weights",
    "save",
    "softplus",
    "tanh",
]

describe_module(__name__, "dp.network.dense(p, x)")
