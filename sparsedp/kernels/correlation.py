"""Correlations of stacks of fields with small filters as matrix products, on plain arrays.

Shifts along the last axis become rows of one matrix; each shift along the other axis is then one product with a
slice of its columns, which the matrix product reads in place. So a field is copied once for each entry of a filter's
last axis, not for each entry of the filter.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

__all__ = ["correlate", "fold", "pad", "weigh"]

BLOCK = 1 << 22  # bytes of the copied matrix that are made at a time: they stay in the cache


def pad(x, widths, padding):
    """(s, c, *cells) -> the same with (width - 1) / 2 more cells on each side."""
    for axis, width in zip(range(-len(widths), 0), widths, strict=True):
        reach, n = width // 2, x.shape[axis]
        if not reach:
            continue
        places = np.arange(-reach, n + reach)
        places = places % n if padding == "periodic" and n else np.clip(places, 0, max(n - 1, 0))
        x = _wider(x, axis, reach) if padding == "zero" or not n else np.take(x, places, axis)
    return x


def _wider(x, axis, reach):
    shape = list(x.shape)
    shape[axis] += 2 * reach
    wide = np.zeros(shape, x.dtype)
    part = [slice(None)] * x.ndim
    part[axis] = slice(reach, reach + x.shape[axis])
    wide[tuple(part)] = x
    return wide


def fold(x, widths, padding):
    """The transpose of `pad`."""
    for axis, width in zip(range(-len(widths), 0), widths, strict=True):
        reach = width // 2
        if not reach:
            continue
        wide = np.moveaxis(x, axis, 0)
        n = len(wide) - 2 * reach
        core = wide[reach : reach + n].copy()
        if padding != "zero" and n:
            for place in [*range(reach), *range(n + reach, n + 2 * reach)]:
                core[(place - reach) % n if padding == "periodic" else min(max(place - reach, 0), n - 1)] += wide[place]
        x = np.moveaxis(core, 0, axis)
    return np.ascontiguousarray(x)


def correlate(x, weight):
    """Padded (s, c, *cells), (o, c, *widths) or one filter for each s -> (s, o, *cells).

    y[s, o, i] = sum over c, d of weight[o, c, d] x[s, c, i + d].
    """
    flat = x.ndim == 3
    x, weight = (x[:, :, None], weight[..., None, :]) if flat else (x, weight)
    samples, _, wide, long = x.shape
    outputs, width = weight.shape[-4], weight.shape[-2]
    cells = (wide - width + 1, long - weight.shape[-1] + 1)
    matrices = _matrices(weight)
    y = np.empty((samples, outputs, cells[0] * cells[1]), np.result_type(x, weight))
    for some in _blocks(x, weight.shape[-1]):
        own = matrices[:, some] if weight.ndim == 5 else matrices
        columns = _columns(x[some], weight.shape[-1])
        for shift in range(width):
            part = columns[..., shift * cells[1] : (shift + cells[0]) * cells[1]]
            if shift:
                y[some] += own[shift] @ part
            else:
                np.matmul(own[shift], part, out=y[some])
    y = y.reshape(samples, outputs, *cells)
    return y[:, :, 0] if flat else y


def weigh(x, g, shape):
    """Padded (s, c, *cells), (s, o, *cells) -> filters of a shape: sum over s and i of g[s, o, i] x[s, c, i + d].

    With a leading axis of samples in `shape` the samples are kept apart.
    """
    flat = x.ndim == 3
    if flat:
        x, g, full = x[:, :, None], g[:, :, None], (*shape[:-1], 1, shape[-1])
    else:
        full = tuple(shape)
    outputs, inputs, width, length = full[-4:]
    cells = g.shape[2:]
    found = np.zeros((width, *full[:-4], outputs, inputs * length), np.result_type(x, g))
    for some in _blocks(x, length):
        columns = _columns(x[some], length)
        rows = np.ascontiguousarray(g[some]).reshape(columns.shape[0], outputs, cells[0] * cells[1])
        for shift in range(width):
            part = columns[..., shift * cells[1] : (shift + cells[0]) * cells[1]]
            if len(full) == 5:
                found[shift, some] = rows @ np.swapaxes(part, 1, 2)
            else:
                for row, column in zip(rows, part, strict=True):
                    found[shift] += row @ column.T
    found = np.moveaxis(found.reshape(width, *full[:-4], outputs, inputs, length), 0, -2)
    return np.ascontiguousarray(found).reshape(shape)


def _matrices(weight):
    """(..., o, c, width, length) -> (width, ..., o, c length): one matrix for each shift along the first axis."""
    moved = np.ascontiguousarray(np.moveaxis(weight, -2, 0))
    return moved.reshape(*moved.shape[:-2], -1)


def _columns(x, length):
    """(s, c, wide, long) -> (s, c length, wide cells): the field shifted along its last axis, in rows."""
    if x.shape[-1] < length:  # no cells
        return np.empty((x.shape[0], x.shape[1] * length, 0), x.dtype)
    windows = sliding_window_view(x, length, axis=-1)  # (s, c, wide, cells, length)
    moved = np.ascontiguousarray(np.moveaxis(windows, -1, 2))
    return moved.reshape(x.shape[0], x.shape[1] * length, moved.shape[3] * moved.shape[4])


def _blocks(x, length):
    """Slices of samples whose columns fit into the cache together."""
    one = max(1, int(np.prod(x.shape[1:])) * length * x.itemsize)
    step = max(1, BLOCK // one)
    return [slice(start, start + step) for start in range(0, len(x), step)]
