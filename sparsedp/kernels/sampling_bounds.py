"""Compiled loops of `sampling` for the least and the greatest sample around a place."""

from math import floor

from numba import njit

from sparsedp.kernels.sampling_places import cubic_place, inside

__all__ = ["extrema", "mean_of_equal", "spread_to_equal"]


@njit(error_model="numpy")
def _cell(p, n, wraps, like):
    """First of the two samples around a place, how many there are."""
    if len(like) == 1:
        return 0, 1
    if len(like) == 2:
        return int(floor(inside(p, n, wraps))) + 2, 2
    return cubic_place(p, n, wraps)[0] + 3, 2


@njit(error_model="numpy")
def _corner(w, scale, shape, strides, wraps, like, at):
    """First sample of the cell around the place of point `at`, and its size along the axes."""
    row, k = divmod(at, shape[2])
    i, j = divmod(row, shape[1])
    one = _cell(i - scale[0] * w[0][at], shape[0], wraps[0], like[0])
    two = _cell(j - scale[1] * w[1][at], shape[1], wraps[1], like[1])
    three = _cell(k - scale[2] * w[2][at], shape[2], wraps[2], like[2])
    return one[0] * strides[0] + two[0] * strides[1] + three[0], one[1], two[1], three[1]


def extrema(samples, w, scale, shape, strides, wraps, like, start, stop, low, high):
    """Least and greatest sample of the cell around i - scale w."""
    for at in range(start * shape[2], stop * shape[2]):
        first, a, b, c = _corner(w, scale, shape, strides, wraps, like, at)
        least = most = samples[first]
        for i in range(a):
            for j in range(b):
                for m in range(c):
                    value = samples[first + i * strides[0] + j * strides[1] + m]
                    least, most = min(least, value), max(most, value)
        low[at], high[at] = least, most


@njit(error_model="numpy")
def _count(samples, bound, first, a, b, c, strides):
    found = 0
    for i in range(a):
        for j in range(b):
            for m in range(c):
                found += samples[first + i * strides[0] + j * strides[1] + m] == bound
    return max(found, 1)


def mean_of_equal(samples, bound, changes, w, scale, shape, strides, wraps, like, start, stop, out):
    """Mean of the changes of those samples around a place that equal the bound."""
    for at in range(start * shape[2], stop * shape[2]):
        first, a, b, c = _corner(w, scale, shape, strides, wraps, like, at)
        total = 0.0
        for i in range(a):
            for j in range(b):
                for m in range(c):
                    near = first + i * strides[0] + j * strides[1] + m
                    if samples[near] == bound[at]:
                        total += changes[near]
        out[at] = total / _count(samples, bound[at], first, a, b, c, strides)


def spread_to_equal(samples, bound, changes, w, scale, shape, strides, wraps, like, start, stop, g):
    """The transpose of `mean_of_equal`, added to the changes."""
    for at in range(start * shape[2], stop * shape[2]):
        if g[at] != 0.0:
            first, a, b, c = _corner(w, scale, shape, strides, wraps, like, at)
            share = g[at] / _count(samples, bound[at], first, a, b, c, strides)
            for i in range(a):
                for j in range(b):
                    for m in range(c):
                        near = first + i * strides[0] + j * strides[1] + m
                        if samples[near] == bound[at]:
                            changes[near] += share
