"""Correlations of stacks of fields with small filters as matrix products, on plain arrays.

Shifts along the last axis become rows of one matrix; each shift along the other axis is then one product with a
slice of its columns, which the matrix product reads in place. So a field is copied once for each entry of a filter's
last axis, not for each entry of the filter.
"""

from math import prod
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

__all__ = ["MODES", "correlate", "fold", "pad", "weigh"]

BLOCK = 1 << 22  # bytes of the copied matrix that are made at a time: they stay in the cache
MODES: dict[str, Any] = {"periodic": "wrap", "zero": "constant", "replicate": "edge"}


def pad(x, widths, padding):
    """(s, c, nx, ny) -> the same with (width - 1) / 2 more cells on each side."""
    around = [(0, 0), (0, 0), *((width // 2, width // 2) for width in widths)]
    return np.pad(x, around, MODES[padding] if x.size else "constant")


def fold(x, widths, padding):
    """The transpose of `pad`."""
    for axis, width in zip((-2, -1), widths):
        wide, reach, n = np.moveaxis(x, axis, 0), width // 2, x.shape[axis] - width + 1
        core = wide[reach : reach + n].copy()
        if padding != "zero" and n:
            sources = np.pad(np.arange(n), reach, MODES[padding])
            ghosts = np.r_[:reach, n + reach : n + 2 * reach]
            np.add.at(core, sources[ghosts], wide[ghosts])
        x = np.moveaxis(core, 0, axis)
    return np.ascontiguousarray(x)


def correlate(x, weight):
    """Padded (s, c, *cells), (o, c, wx, wy) or one filter for each s -> (s, o, *cells).

    y[s, o, i] = sum over c, d of weight[o, c, d] x[s, c, i + d].
    """
    cells = [n - width + 1 for n, width in zip(x.shape[2:], weight.shape[-2:])]
    matrices = np.moveaxis(weight, -2, 0)  # one for each shift along the first axis
    matrices = matrices.reshape(*matrices.shape[:-2], -1)
    y = np.zeros((len(x), weight.shape[-4], prod(cells)), np.result_type(x, weight))
    for some, shift, part in _shifted(x, weight.shape[-2:]):
        y[some] += (matrices[shift, some] if weight.ndim == 5 else matrices[shift]) @ part
    return y.reshape(*y.shape[:2], *cells)


def weigh(x, g, shape):
    """Padded (s, c, *cells), (s, o, *cells) -> filters of a shape: sum over s and i of g[s, o, i] x[s, c, i + d].

    With a leading axis of samples in `shape` the samples are kept apart.
    """
    rows = g.reshape(*g.shape[:2], prod(g.shape[2:]))
    filters = np.zeros((shape[-2], *shape[:-2], shape[-1]), np.result_type(x, g))
    totals = filters.reshape(*filters.shape[:-2], -1)
    for some, shift, part in _shifted(x, shape[-2:]):
        products = rows[some] @ np.swapaxes(part, 1, 2)
        if len(shape) == 5:
            totals[shift, some] = products
        else:
            totals[shift] += products.sum(axis=0)
    return np.ascontiguousarray(np.moveaxis(filters, 0, -2))


def _shifted(x, widths):
    """Blocks of samples whose copies fit into the cache: their slice, a shift along the first axis, and the fields so
    shifted, with all shifts along the last axis as rows of a matrix (s, c shifts, cells). Nothing without cells."""
    first, last = widths
    lines, wide = x.shape[2] - first + 1, x.shape[3] - last + 1
    step = max(1, BLOCK // max(1, prod(x.shape[1:]) * last * x.itemsize))
    for start in range(0, len(x) if wide > 0 else 0, step):
        some = slice(start, start + step)
        columns = np.ascontiguousarray(np.moveaxis(sliding_window_view(x[some], last, axis=-1), -1, 2))
        columns = columns.reshape(len(columns), x.shape[1] * last, -1)
        for shift in range(first):
            yield some, shift, columns[..., shift * wide : (shift + lines) * wide]
