"""Parameters of layers: drawn with a stated gain, kept in a file without pickle."""

import numpy as np

from sparsedp.io.atomic_files import load_tree, save_tree
from sparsedp.network.filters import check_widths

__all__ = ["convolution_weights", "dense_weights", "load", "residual_weights", "save"]

FORMAT = "sparsedp network 1"


def dense_weights(rng, inputs, outputs, gain=1.0):
    """Sizes -> parameters of a dense layer: normal weights of deviation gain / sqrt(inputs), no bias.

    Parameters
    ----------
    rng : numpy.random.Generator
    inputs, outputs : int
    gain : float
        1 keeps the size of a signal through a linear layer; 5/3 through tanh, sqrt(2) through relu.

    Returns
    -------
    dict
        weight (inputs, outputs) and bias (outputs,).

    Examples
    --------
    >>> p = dense_weights(np.random.default_rng(0), 3, 2)
    >>> p["weight"].shape, p["bias"].shape
    ((3, 2), (2,))
    """
    return _layer(rng, (inputs, outputs), inputs, outputs, gain)


def convolution_weights(rng, inputs, outputs, widths, gain=1.0):
    """Sizes -> parameters of a convolution: normal weights of deviation gain / sqrt(inputs x entries), no bias.

    Parameters
    ----------
    rng : numpy.random.Generator
    inputs, outputs : int
    widths : int or tuple of int
        Odd: an int in 1-D, a pair in 2-D.
    gain : float
        See dense_weights.

    Returns
    -------
    dict
        weight (outputs, inputs, *widths) and bias (outputs,).

    Examples
    --------
    >>> convolution_weights(np.random.default_rng(0), 1, 8, (5, 5))["weight"].shape
    (8, 1, 5, 5)
    """
    widths = (widths,) if np.ndim(widths) == 0 else tuple(widths)
    check_widths(widths)
    return _layer(rng, (outputs, inputs, *widths), inputs * int(np.prod(widths)), outputs, gain)


def _layer(rng, shape, fan, outputs, gain):
    """Weights of which `fan` numbers are summed for each output."""
    if not hasattr(rng, "standard_normal"):
        raise TypeError(f"weights are drawn from a numpy Generator, got {rng!r}; write np.random.default_rng(0)")
    return {"weight": rng.standard_normal(shape) * (gain / np.sqrt(max(fan, 1))), "bias": np.zeros(outputs)}


def residual_weights(rng, channels, widths, gain=1.0):
    """Sizes -> parameters of a residual block.

    Parameters
    ----------
    rng : numpy.random.Generator
    channels : int
    widths : int or tuple of int
    gain : float
        Of the second convolution; 0 makes the block the identity at the start.

    Returns
    -------
    dict
        first and second, parameters of convolutions.

    Examples
    --------
    >>> sorted(residual_weights(np.random.default_rng(0), 4, 3))
    ['first', 'second']
    """
    first = convolution_weights(rng, channels, channels, widths)
    return {"first": first, "second": convolution_weights(rng, channels, channels, widths, gain)}


def save(path, parameters):
    """Parameters -> a .npz file without pickle; the structure stands beside the arrays as JSON.

    Parameters
    ----------
    path : str or path
    parameters : any nesting of tuples, lists and dicts of arrays, numbers, strings and None

    Raises
    ------
    TypeError
        If a leaf is something else, or a key of a dict is not a string.
    OSError
        If the file cannot be written; what was saved there before is there still.

    Examples
    --------
    >>> import os, tempfile
    >>> file = os.path.join(tempfile.mkdtemp(), "net.npz")
    >>> save(file, {"layers": [np.ones(2)], "steps": 3})
    >>> load(file)
    {'layers': [array([1., 1.])], 'steps': 3}
    """
    save_tree(path, parameters, FORMAT)


def load(path):
    """File that `save` wrote -> parameters.

    Parameters
    ----------
    path : str or path

    Returns
    -------
    tree

    Raises
    ------
    ValueError
        If the file is not one of those.

    Examples
    --------
    >>> import os, tempfile
    >>> file = os.path.join(tempfile.mkdtemp(), "net.npz")
    >>> save(file, (1.5, None))
    >>> load(file)
    (1.5, None)
    """
    content = load_tree(path, FORMAT)
    if content is None:
        raise ValueError(f"{path} was not written by dp.network.save, or is damaged; write it anew")
    return content[0]
