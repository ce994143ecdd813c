"""Draw random initial parameters of layers with a given gain; save and load parameters without pickle."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp.io.atomic_files import load_tree, save_tree
from sparsedp.network.convolution_layer import check_widths

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["convolution_weights", "dense_weights", "load", "residual_weights", "save"]

FORMAT = "sparsedp network 1"


def dense_weights(
    rng: np.random.Generator, inputs: int, outputs: int, gain: float = 1.0
) -> dict[str, NDArray[np.float64]]:
    """Draw parameters of a dense layer: normal weights with standard deviation gain / sqrt(inputs), and zero bias.

    Parameters
    ----------
    rng : numpy.random.Generator
    inputs, outputs : int
    gain : float
        Scale of the weights. Outputs have about the same size as inputs with gain 1 for a linear layer, 5/3 for a
        layer followed by tanh, and sqrt(2) for a layer followed by relu.

    Returns
    -------
    dict
        weight (inputs, outputs) and bias (outputs,).

    See Also
    --------
    network.dense

    Examples
    --------
    >>> p = dense_weights(np.random.default_rng(0), 3, 2)
    >>> p["weight"].shape, p["bias"].shape
    ((3, 2), (2,))
    """
    return _drawn(rng, (inputs, outputs), inputs, outputs, gain)


def convolution_weights(
    rng: np.random.Generator, inputs: int, outputs: int, widths: int | Sequence[int], gain: float = 1.0
) -> dict[str, NDArray[np.float64]]:
    """Draw the parameters of a convolution: normal weights and zero bias.

    Parameters
    ----------
    rng : numpy.random.Generator
    inputs, outputs : int
    widths : int or tuple of int
        Odd widths of the filters: an int in 1-D, a pair in 2-D.
    gain : float
        See `dense_weights`. The standard deviation is gain / sqrt(inputs * number of entries of a filter).

    Returns
    -------
    dict
        weight (outputs, inputs, *widths) and bias (outputs,).

    See Also
    --------
    network.convolution

    Examples
    --------
    >>> convolution_weights(np.random.default_rng(0), 1, 8, (5, 5))["weight"].shape
    (8, 1, 5, 5)
    """
    all_widths = tuple(np.atleast_1d(widths).tolist())
    check_widths(all_widths)
    return _drawn(rng, (outputs, inputs, *all_widths), inputs * int(np.prod(all_widths)), outputs, gain)


def _drawn(rng, shape, summands, outputs, gain):
    """Return random weights with standard deviation gain / sqrt(summands), and zero bias.

    `summands` is the number of weights that contribute to each output.
    """
    if not hasattr(rng, "standard_normal"):
        raise TypeError(f"weights are drawn from a numpy Generator, got {rng!r}; write np.random.default_rng(0)")
    return {"weight": rng.standard_normal(shape) * (gain / np.sqrt(max(summands, 1))), "bias": np.zeros(outputs)}


def residual_weights(
    rng: np.random.Generator, channels: int, widths: int | Sequence[int], gain: float = 1.0
) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Draw the parameters of a residual block.

    Parameters
    ----------
    rng : numpy.random.Generator
    channels : int
    widths : int or tuple of int
        See `convolution_weights`.
    gain : float
        Gain of the second convolution. With 0 the block is initially the identity.

    Returns
    -------
    dict
        The parameters of the two convolutions, under the keys ``first`` and ``second``.

    See Also
    --------
    network.residual_block

    Examples
    --------
    >>> sorted(residual_weights(np.random.default_rng(0), 4, 3))
    ['first', 'second']
    """
    first = convolution_weights(rng, channels, channels, widths)
    second = convolution_weights(rng, channels, channels, widths, gain)
    return {"first": first, "second": second}


def save(path: str | os.PathLike[str], parameters: Any) -> None:
    """Save parameters to an .npz file without pickle. The structure of the tree is stored in the file as JSON.

    Parameters
    ----------
    path : str or path
    parameters : any nesting of tuples, lists and dicts of arrays, numbers, strings and None

    Raises
    ------
    TypeError
        If a leaf has another type, or a key of a dict is not a string.
    OSError
        If the file cannot be written. An existing file with this name is then unchanged.

    See Also
    --------
    network.load

    Examples
    --------
    >>> import os, tempfile
    >>> file = os.path.join(tempfile.mkdtemp(), "net.npz")
    >>> save(file, {"layers": [np.ones(2)], "steps": 3})
    >>> load(file)
    {'layers': [array([1., 1.])], 'steps': 3}
    """
    save_tree(path, parameters, FORMAT)


def load(path: str | os.PathLike[str]) -> Any:
    """Load parameters from a file that `save` wrote.

    Parameters
    ----------
    path : str or path

    Returns
    -------
    tree
        The parameters, with the structure that was saved.

    Raises
    ------
    ValueError
        If the file was not written by `save`, or is damaged.

    See Also
    --------
    network.save

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
        raise ValueError(f"{path} was not written by dp.network.save, or is damaged; save the parameters again")
    return content[0]
