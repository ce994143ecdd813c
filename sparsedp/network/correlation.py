"""Correlations of stacks of fields with small filters as matrix products, on plain arrays.

Shifts along the last axis become rows of one matrix; each shift along the other axis is then one product with a
slice of its columns, which the matrix product reads in place. So a field is copied once for each entry of a filter's
last axis, not for each entry of the filter. A field in 1-D is one in 2-D with one line.
"""

from math import prod
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

__all__ = ["correlate", "fold", "pad", "weigh"]

BLOCK = 1 << 22  # bytes of the copied matrix that are made at a time: they stay in the cache
MODES: dict[str, Any] = {"periodic": "wrap", "zero": "constant", "replicate": "edge"}


def pad(x, widths, padding):
    """(s, c, *cells) -> the same with (width - 1) / 2 more cells on each side."""
    around = [(0, 0)] * (x.ndim - len(widths)) + [(width // 2, width // 2) for width in widths]
    return np.pad(x, around, MODES[padding] if x.size else "constant")


def fold(x, widths, padding):
    """The transpose of `pad`."""
    for axis, width in zip(range(-len(widths), 0), widths, strict=True):
        wide, reach, n = np.moveaxis(x, axis, 0), width // 2, x.shape[axis] - width + 1
        core = wide[reach : reach + n].copy()
        if padding != "zero" and n:
            sources = np.pad(np.arange(n), reach, MODES[padding])
            for ghosts in (slice(reach), slice(n + reach, None)):
                np.add.at(core, sources[ghosts], wide[ghosts])
        x = np.moveaxis(core, 0, axis)
    return np.ascontiguousarray(x)


def correlate(x, weight):
    """Padded (s, c, *cells), (o, c, *widths) or one filter for each s -> (s, o, *cells).

    y[s, o, i] = sum over c, d of weight[o, c, d] x[s, c, i + d].
    """
    flat = x.ndim == 3
    x, weight = (x[:, :, None], weight[..., None, :]) if flat else (x, weight)
    cells = [n - width + 1 for n, width in zip(x.shape[2:], weight.shape[-2:], strict=True)]
    matrices = np.moveaxis(weight, -2, 0)  # one for each shift along the first axis
    matrices = matrices.reshape(*matrices.shape[:-2], -1)
    y = np.empty((len(x), weight.shape[-4], prod(cells)), np.result_type(x, weight))
    for some, columns in _columns(x, weight.shape[-1]):
        for shift, matrix in enumerate(matrices):
            part = columns[..., shift * cells[1] : (shift + cells[0]) * cells[1]]
            own = matrix[some] if weight.ndim == 5 else matrix
            if shift:
                y[some] += own @ part
            else:
                np.matmul(own, part, out=y[some])
    y = y.reshape(*y.shape[:2], *cells)
    return y[:, :, 0] if flat else y


def weigh(x, g, shape):
    """Padded (s, c, *cells), (s, o, *cells) -> filters of a shape: sum over s and i of g[s, o, i] x[s, c, i + d].

    With a leading axis of samples in `shape` the samples are kept apart.
    """
    rows, cells = g.reshape(*g.shape[:2], prod(g.shape[2:])), (1, *g.shape[2:])[-2:]
    full = shape if x.ndim == 4 else (*shape[:-1], 1, shape[-1])
    found = np.zeros((full[-2], *full[:-2], full[-1]), np.result_type(x, g))
    for some, columns in _columns(x[:, :, None] if x.ndim == 3 else x, shape[-1]):
        for shift, total in enumerate(found.reshape(*found.shape[:-2], -1)):
            part = columns[..., shift * cells[1] : (shift + cells[0]) * cells[1]]
            products = rows[some] @ np.swapaxes(part, 1, 2)
            if len(full) == 5:
                total[some] = products
            else:
                total += products.sum(axis=0)
    return np.ascontiguousarray(np.moveaxis(found, 0, -2)).reshape(shape)


def _columns(x, length):
    """Blocks of samples whose copies fit into the cache: their slice, and the fields shifted along the last axis as
    rows of a matrix (s, c length, wide cells). Nothing where there are no cells."""
    step = max(1, BLOCK // max(1, prod(x.shape[1:]) * length * x.itemsize))
    for start in range(0, len(x) if x.shape[-1] >= length else 0, step):
        some = slice(start, start + step)
        columns = np.ascontiguousarray(np.moveaxis(sliding_window_view(x[some], length, axis=-1), -1, 2))
        yield some, columns.reshape(len(columns), x.shape[1] * length, prod(columns.shape[3:]))
