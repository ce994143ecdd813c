"""Parameters of layers: drawn with a stated gain, kept in a file without pickle."""

import json
from zipfile import BadZipFile

import numpy as np

from sparsedp.files import write_file
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
    weight = _normal(rng, (inputs, outputs)) * (gain / np.sqrt(max(inputs, 1)))
    return {"weight": weight, "bias": np.zeros(outputs)}


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
    fan = max(inputs * int(np.prod(widths)), 1)
    weight = _normal(rng, (outputs, inputs, *widths)) * (gain / np.sqrt(fan))
    return {"weight": weight, "bias": np.zeros(outputs)}


def _normal(rng, shape):
    if not hasattr(rng, "standard_normal"):
        raise TypeError(f"weights are drawn from a numpy Generator, got {rng!r}; write np.random.default_rng(0)")
    return rng.standard_normal(shape)


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
    arrays: list = []
    text = json.dumps({"format": FORMAT, "tree": _words(parameters, arrays)})
    write_file(path, lambda stream: np.savez(stream, np.frombuffer(text.encode(), np.uint8), *arrays))


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
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:  # a damaged file is closed too
            words = json.loads(bytes(stored["arr_0"]).decode())
            tree = _tree(words["tree"], stored) if words.get("format") == FORMAT else None
    except (AttributeError, BadZipFile, EOFError, KeyError, TypeError, ValueError):
        words = {}
    if words.get("format") != FORMAT:
        raise ValueError(f"{path} was not written by dp.network.save, or is damaged; write it anew")
    return tree


def _words(tree, arrays):
    """A tree as JSON holds it; arrays are moved to a list and stand there by number."""
    if isinstance(tree, dict):
        if not all(isinstance(key, str) for key in tree):
            raise TypeError("save needs dicts with strings as keys; write str(key)")
        return {"dict": [[key, _words(branch, arrays)] for key, branch in tree.items()]}
    if isinstance(tree, (list, tuple)):
        return {"list" if isinstance(tree, list) else "tuple": [_words(branch, arrays) for branch in tree]}
    if isinstance(tree, (np.ndarray, np.generic)) and tree.dtype.kind in "biufc":
        arrays.append(np.asarray(tree))
        return {"array": len(arrays)}
    if tree is None or isinstance(tree, (bool, int, float, str)):
        return {"value": tree}
    raise TypeError(f"save takes arrays, numbers, strings and None, got {type(tree).__name__}; write np.asarray(value)")


def _tree(words, stored):
    [(kind, value)] = words.items()
    if kind == "dict":
        return {key: _tree(branch, stored) for key, branch in value}
    if kind in ("list", "tuple"):
        branches = [_tree(branch, stored) for branch in value]
        return branches if kind == "list" else tuple(branches)
    return stored[f"arr_{value}"] if kind == "array" else value
