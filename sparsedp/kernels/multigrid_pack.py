"""Arrays in natural order for the set-up of the structured multigrid, and how they become split rows.

A natural array has cell 0 at index 1 of every axis, one cell of padding before and two behind: zeros,
or what a periodic axis repeats there. The compiled functions take 3-D arrays with cell (0, j, 0) at
index (1, j + lead, 1); in 2-D there is one j and lead is 0.
"""

import numpy as np

from sparsedp.kernels.multigrid_rows import LANES, PAD, ends, entry, inner, rows

__all__ = [
    "inside",
    "pack_red",
    "packed",
    "pack_coarse_links",
    "pack_fine_links",
    "pack_weights",
    "padded",
    "repeat",
    "width",
]


LINE = 64  # bytes of a cache line


def padded(shape, *leading):
    """A natural array of zeros, or several."""
    return np.zeros((*leading, *(n + 3 for n in shape)))


def inside(shape):
    """Where the cells are in a natural array."""
    return tuple(slice(1, n + 1) for n in shape)


def repeat(array, shape, periodic):
    """Fill the padding of a natural array along periodic axes. The array itself."""
    for axis, (n, flag) in enumerate(zip(shape, periodic)):
        lines = np.moveaxis(array, axis, 0)
        if flag:
            lines[0] = lines[n]
            lines[n + 1], lines[n + 2] = lines[1], lines[1 + 1 % n]
    return array


def width(count, split=True):
    """Length of a packed row of `count` cells: the padding, then vectors; an even number in natural order."""
    whole = LANES if split else 2 * LANES
    return PAD + -(-count // whole) * whole


def packed(*shape, dtype=float):
    """Zeros for rows, from the beginning of a cache line; what is written behind the last one does no harm."""
    size, item = np.prod(shape, dtype=int), np.dtype(dtype).itemsize
    flat = np.zeros(size + 2 * PAD + LINE // item, dtype)
    first = -flat.ctypes.data % LINE // item
    return flat[first : first + size].reshape(shape)


@entry
def pack_fine_links(before, after, a, scale, step, shape, periodic, lead):
    """Links a from a cell to the cell `step` in front -> c of the red cells, behind and in front of them."""
    half = (shape[2] + 1) // 2
    d0, d1, d2 = step
    for i in range(shape[0]):
        for j in range(shape[1]):
            row, p = 1 + i * shape[1] + j, (i + j) & 1
            l, m, n = i + 1, j + lead, p + 1
            for k in range((shape[2] + 1 - p) // 2):
                c = n + 2 * k
                here = scale[l, m, c]
                before[row, PAD + k] = a[l - d0, m - d1, c - d2] * scale[l - d0, m - d1, c - d2] * here
                after[row, PAD + k] = a[l, m, c] * here * scale[l + d0, m + d1, c + d2]
            ends(rows(before)[0] + row * rows(before)[1], half, before.dtype.type(0.0), periodic[2])
            ends(rows(after)[0] + row * rows(after)[1], half, after.dtype.type(0.0), periodic[2])


@inner
def _thrice(out, a, b, c):
    """Every second product of three lines."""
    for k in range(out.size):
        out[k] = a[2 * k] * b[2 * k] * c[2 * k]


@entry
def pack_coarse_links(out, a, scale, step, shape, periodic, lead):
    """Links a from a cell to the cell `step` in front -> c, rows split by column parity."""
    half = (shape[2] + 1) // 2
    d0, d1, d2 = step
    for i in range(shape[0]):
        for j in range(shape[1]):
            row, l, m = 1 + i * shape[1] + j, i + 1, j + lead
            for p in range(2):
                last = PAD + (shape[2] + 1 - p) // 2
                there = scale[l + d0, m + d1, p + 1 + d2 :]
                _thrice(out[row, p, PAD:last], a[l, m, p + 1 :], scale[l, m, p + 1 :], there)
                ends(rows(out)[0] + (2 * row + p) * rows(out)[1], half, out.dtype.type(0.0), periodic[2])


@entry
def pack_weights(out, starts, number, weight, coarse, root, group, corner, column, shape, periodic, lead):
    """Weights of the cells of one group of rows and one column parity on one of their corners.

    `coarse` is the scale of the coarse cells, `root` one over that of the fine ones.
    """
    half = (shape[2] + 1) // 2
    for i in range(group[0], shape[0], 2):
        for j in range(group[1], shape[1], 2):
            row, l, m = starts[1 + i * shape[1] + j] + number, i // 2 + 1, j // 2 + lead
            for k in range((shape[2] + 1 - column) // 2):
                value = weight[l, m, k + 1] * coarse[l + corner[0], m + corner[1], k + 1 + corner[2]]
                out[row, PAD + k] = value * root[i + 1, j + lead, 1 + 2 * k + column]
            ends(rows(out)[0] + row * rows(out)[1], half, out.dtype.type(0.0), periodic[2])


@entry
def pack_red(out, a, shape, lead):
    """The red cells of a natural array."""
    for i in range(shape[0]):
        for j in range(shape[1]):
            row, p, line = 1 + i * shape[1] + j, (i + j) & 1, a[i + 1, j + lead]
            for k in range((shape[2] + 1 - p) // 2):
                out[row, PAD + k] = line[1 + p + 2 * k]
