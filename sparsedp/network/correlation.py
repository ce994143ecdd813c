"""Correlations of stacks of fields with small filters as matrix products, on plain arrays.

The fields, shifted along the last axis, become the rows of one matrix. For each shift along the other axis, the result
is a product with a slice of the columns of this matrix, and the matrix product reads the slice without a copy.
A field is therefore copied as often as the filter is wide along the last axis, not once for each filter entry.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["PADDINGS", "correlate", "filter_gradient", "pad", "pad_transposed"]

BLOCK_BYTES = 1 << 22  # the copied matrix is built in blocks of about this size, which fit into the cache
PADDINGS: dict[str, Any] = {"periodic": "wrap", "zero": "constant", "replicate": "edge"}  # modes of np.pad


def pad(x: NDArray[Any], widths: Sequence[int], padding: str) -> NDArray[Any]:
    """Add (width - 1) / 2 cells on each side of the fields.

    Parameters
    ----------
    x : (samples, channels, nx, ny) array
    widths : (int, int)
        Widths of the filters; odd.
    padding : str
        A key of `PADDINGS`.

    Returns
    -------
    array
    """
    mode = PADDINGS[padding]
    if not x.size:  # np.pad raises an error for empty axes in the other modes
        mode = "constant"
    return np.pad(x, [(0, 0), (0, 0), *((width // 2, width // 2) for width in widths)], mode)


def pad_transposed(x: NDArray[Any], widths: Sequence[int], padding: str) -> NDArray[Any]:
    """Apply the transpose of `pad`: add the value of each padding cell to the cell of which it is a copy.

    Parameters
    ----------
    x : (samples, channels, nx + widths[0] - 1, ny + widths[1] - 1) array
    widths : (int, int)
    padding : str

    Returns
    -------
    (samples, channels, nx, ny) array
    """
    for axis, width in zip((-2, -1), widths):
        padded = np.moveaxis(x, axis, 0)
        reach = width // 2
        n = x.shape[axis] - width + 1
        core = padded[reach : reach + n].copy()
        if padding != "zero" and n:
            sources = np.pad(np.arange(n), reach, PADDINGS[padding])
            ghosts = np.r_[:reach, n + reach : n + 2 * reach]
            np.add.at(core, sources[ghosts], padded[ghosts])
        x = np.moveaxis(core, 0, axis)
    return np.ascontiguousarray(x)


def correlate(x: NDArray[Any], weight: NDArray[Any]) -> NDArray[Any]:
    """Correlate padded fields with filters.

    Parameters
    ----------
    x : (samples, inputs, *padded cells) array
    weight : (outputs, inputs, wx, wy) array, or (samples, outputs, inputs, wx, wy) with separate filters per sample

    Returns
    -------
    (samples, outputs, *cells) array

    Notes
    -----
    y[s, o, i] = sum over c, d of weight[o, c, d] x[s, c, i + d].
    """
    cells = [n - width + 1 for n, width in zip(x.shape[2:], weight.shape[-2:])]
    matrices = np.moveaxis(weight, -2, 0)  # one matrix for each shift along the first axis
    matrices = matrices.reshape(*matrices.shape[:-2], -1)
    per_sample = weight.ndim == 5
    y = np.zeros((len(x), weight.shape[-4], prod(cells)), np.result_type(x, weight))
    for samples, shift, columns in _shifted_blocks(x, weight.shape[-2:]):
        if per_sample:
            y[samples] += matrices[shift, samples] @ columns
        else:
            y[samples] += matrices[shift] @ columns
    return y.reshape(*y.shape[:2], *cells)


def filter_gradient(x: NDArray[Any], g: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Correlate padded fields with a cotangent. This is the VJP of `correlate` with respect to the filters.

    Parameters
    ----------
    x : (samples, inputs, *padded cells) array
    g : (samples, outputs, *cells) array
    shape : tuple of int
        Shape of the filters, as in `correlate`. With a leading axis of samples, the result has one gradient for each
        sample; without it, the result is the sum over samples.

    Returns
    -------
    array with the given shape

    Notes
    -----
    weight[o, c, d] = sum over s, i of g[s, o, i] x[s, c, i + d].
    """
    rows = g.reshape(*g.shape[:2], prod(g.shape[2:]))
    filters = np.zeros((shape[-2], *shape[:-2], shape[-1]), np.result_type(x, g))
    matrices = filters.reshape(*filters.shape[:-2], -1)
    per_sample = len(shape) == 5
    for samples, shift, columns in _shifted_blocks(x, shape[-2:]):
        products = rows[samples] @ np.swapaxes(columns, 1, 2)
        if per_sample:
            matrices[shift, samples] = products
        else:
            matrices[shift] += products.sum(axis=0)
    return np.ascontiguousarray(np.moveaxis(filters, 0, -2))


def _shifted_blocks(x, widths) -> Iterator[tuple[slice, int, NDArray[Any]]]:
    """Yield blocks of samples whose copies fit into the cache, for each shift along the first axis.

    Each item is a tuple of the slice of samples, the shift, and the shifted fields. The shifted fields are an array of
    shape (samples, inputs * last width, cells). Nothing is yielded if there are no output cells along the last axis.
    """
    first_width, last_width = widths
    lines = x.shape[2] - first_width + 1
    line_length = x.shape[3] - last_width + 1
    if line_length <= 0:
        return
    bytes_of_sample = max(1, prod(x.shape[1:]) * last_width * x.itemsize)
    block = max(1, BLOCK_BYTES // bytes_of_sample)
    for start in range(0, len(x), block):
        samples = slice(start, start + block)
        windows = sliding_window_view(x[samples], last_width, axis=-1)
        columns = np.ascontiguousarray(np.moveaxis(windows, -1, 2))
        columns = columns.reshape(len(columns), x.shape[1] * last_width, -1)
        for shift in range(first_width):
            yield samples, shift, columns[..., shift * line_length : (shift + lines) * line_length]
