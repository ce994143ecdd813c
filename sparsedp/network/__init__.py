"""Small networks as plain functions of a parameter tree: dense and convolution layers, nothing more.

A layer is a function ``layer(p, x)``, where p is a dict of arrays. A network is a Python function that calls layers.
Its parameters are these dicts, nested in dicts, lists or tuples; `minimize` accepts such a tree directly.
"""

from sparsedp._utils.calls import describe_module
from sparsedp.network.convolution_layer import convolution
from sparsedp.network.input_range import training_range
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
    "training_range",
]

describe_module(__name__, "dp.network.dense(p, x)")
