"""Compiled loops of `sampling`.

A kernel is compiled for a number of axes and an order when it is first used. Types are stated, so that
read-only arrays do not ask for kernels of their own.
"""

import functools

from numba import njit, types
from numba.extending import register_jitable

from sparsedp.kernels.sampling_bounds import extrema, mean_of_equal, spread_to_equal
from sparsedp.kernels.sampling_places import slope, value

__all__ = ["kernel"]


@njit(error_model="numpy")
def _sum(samples, one, two, three, strides):
    """Product of the weights of three axes with the samples."""
    total = 0.0
    first = one[0] * strides[0] + two[0] * strides[1] + three[0]
    for i in range(len(one[1])):
        plane = 0.0
        for j in range(len(two[1])):
            at, line = first + i * strides[0] + j * strides[1], 0.0
            for k in range(len(three[1])):
                line += three[1][k] * samples[at + k]
            plane += two[1][j] * line
        total += one[1][i] * plane
    return total


@njit(error_model="numpy")
def _add(samples, one, two, three, strides, number):
    first = one[0] * strides[0] + two[0] * strides[1] + three[0]
    for i in range(len(one[1])):
        for j in range(len(two[1])):
            at, share = first + i * strides[0] + j * strides[1], number * one[1][i] * two[1][j]
            for k in range(len(three[1])):
                samples[at + k] += share * three[1][k]


@register_jitable(error_model="numpy")
def gather(samples, w, scale, shape, strides, wraps, like, start, stop, out):
    """out = interpolated samples at i - scale w, for the rows start:stop."""
    n = shape[2]
    for row in range(start, stop):
        i, j = divmod(row, shape[1])
        here = row * n
        for k in range(n):
            one = value(i - scale[0] * w[0][here + k], shape[0], wraps[0], like[0])
            two = value(j - scale[1] * w[1][here + k], shape[1], wraps[1], like[1])
            three = value(k - scale[2] * w[2][here + k], n, wraps[2], like[2])
            out[here + k] = _sum(samples, one, two, three, strides)


@register_jitable(error_model="numpy")
def scatter(samples, w, scale, shape, strides, wraps, like, start, stop, g):
    """The transpose of `gather`: samples += weights times g."""
    n = shape[2]
    for row in range(start, stop):
        i, j = divmod(row, shape[1])
        here = row * n
        for k in range(n):
            if g[here + k] != 0.0:
                one = value(i - scale[0] * w[0][here + k], shape[0], wraps[0], like[0])
                two = value(j - scale[1] * w[1][here + k], shape[1], wraps[1], like[1])
                three = value(k - scale[2] * w[2][here + k], n, wraps[2], like[2])
                _add(samples, one, two, three, strides, g[here + k])


@register_jitable(error_model="numpy")
def slopes(samples, w, scale, shape, strides, wraps, like, start, stop, g, out):
    """out += g times the derivative of `gather` in w, axis by axis; an axis that is not there adds nothing."""
    n = shape[2]
    for row in range(start, stop):
        i, j = divmod(row, shape[1])
        here = row * n
        for k in range(n):
            at = here + k
            p, q, r = i - scale[0] * w[0][at], j - scale[1] * w[1][at], k - scale[2] * w[2][at]
            one, two, three = (
                value(p, shape[0], wraps[0], like[0]),
                value(q, shape[1], wraps[1], like[1]),
                value(r, n, wraps[2], like[2]),
            )
            number = g[at]
            if len(like[0]) > 1:
                steep = slope(p, shape[0], wraps[0], like[0])
                out[0][at] -= scale[0] * number * _sum(samples, steep, two, three, strides)
            if len(like[1]) > 1:
                steep = slope(q, shape[1], wraps[1], like[1])
                out[1][at] -= scale[1] * number * _sum(samples, one, steep, three, strides)
            steep = slope(r, n, wraps[2], like[2])
            out[2][at] -= scale[2] * number * _sum(samples, one, two, steep, strides)


@register_jitable(error_model="numpy")
def extend(u, outside, shape, strides, corner, targets, sources, samples):
    """Field, values outside -> samples with the layers in front and behind filled in."""
    for row in range(shape[0] * shape[1]):
        i, j = divmod(row, shape[1])
        at, own = corner + i * strides[0] + j * strides[1], row * shape[2]
        for k in range(shape[2]):
            samples[at + k] = u[own + k]
    for k in range(targets.size):
        source = sources[k]
        samples[targets[k]] = u[source] if source < u.size else outside[source - u.size]


@register_jitable(error_model="numpy")
def fold(u, outside, shape, strides, corner, targets, sources, samples):
    """The transpose of `extend`: added to u and outside."""
    for row in range(shape[0] * shape[1]):
        i, j = divmod(row, shape[1])
        at, own = corner + i * strides[0] + j * strides[1], row * shape[2]
        for k in range(shape[2]):
            u[own + k] += samples[at + k]
    for k in range(targets.size):
        source = sources[k]
        if source < u.size:
            u[source] += samples[targets[k]]
        elif outside.size:
            outside[source - u.size] += samples[targets[k]]


@register_jitable(error_model="numpy")
def finite(values):
    """Whether no number is NaN or infinite."""
    for start in range(0, values.size, 4096):
        total = 0.0
        for k in range(start, min(start + 4096, values.size)):
            total += values[k] * 0.0
        if not total == 0.0:
            return False
    return True


def advance(u, outside, shape, strides, corner, targets, sources, samples, w, scale, wraps, like, out):
    """Field and values outside -> moved field; whether all that it came from is finite. One call for a small grid."""
    extend(u, outside, shape, strides, corner, targets, sources, samples)
    gather(samples, w, scale, shape, strides, wraps, like, 0, shape[0] * shape[1], out)
    return finite(u) and finite(outside) and finite(w[0]) and finite(w[1]) and finite(w[2])


def retreat(
    u, outside, shape, strides, corner, targets, sources, samples, w, scale, wraps, like, g, back, field, aside, speeds
):
    """Cotangent of the moved field -> added to field and aside, and to speeds; what is empty is left out."""
    many = shape[0] * shape[1]
    if speeds[2].size:
        extend(u, outside, shape, strides, corner, targets, sources, samples)
        slopes(samples, w, scale, shape, strides, wraps, like, 0, many, g, speeds)
    if field.size:
        back[:] = 0.0
        scatter(back, w, scale, shape, strides, wraps, like, 0, many, g)
        fold(field, aside, shape, strides, corner, targets, sources, back)


# ---------------------------------------------------------------- compiling

_real, _int = types.float64, types.int64
_read, _whole = types.Array(_real, 1, "C", readonly=True), types.Array(_int, 1, "C", readonly=True)
_write, _threes, _scale = types.Array(_real, 1, "C"), types.UniTuple(_int, 3), types.UniTuple(_real, 3)
_pair, _flags = types.UniTuple(_int, 2), types.UniTuple(types.boolean, 3)
_ghosts = (_threes, _pair, _int, _whole, _whole)


def _looked_up(like):
    kinds = types.Tuple([types.UniTuple(_real, len(zeros)) for zeros in like])
    return types.UniTuple(_read, 3), _scale, _threes, _pair, _flags, kinds, _int, _int


_first, _last = (_read, _read, *_ghosts, _write), (_write, _write, _write, types.UniTuple(_write, 3))
_KERNELS = {  # name: function, its arguments before and after the places, or all of them
    "gather": (gather, (_read,), (_write,)),
    "scatter": (scatter, (_write,), (_read,)),
    "slopes": (slopes, (_read,), (_read, types.UniTuple(_write, 3))),
    "extrema": (extrema, (_read,), (_write, _write)),
    "mean_of_equal": (mean_of_equal, (_read, _read, _read), (_write,)),
    "spread_to_equal": (spread_to_equal, (_read, _read, _write), (_read,)),
    "extend": (extend, (_read, _read, *_ghosts, _write), None),
    "fold": (fold, (_write, _write, *_ghosts, _read), None),
    "finite": (finite, (_read,), None),
    "advance": (advance, _first, (_write,)),
    "retreat": (retreat, _first, (_read, *_last)),
}


@functools.cache
def kernel(name, like):
    """The compiled function, kept on disk where there is a place to keep it."""
    function, first, last = _KERNELS[name]
    places = _looked_up(like)
    if name in ("advance", "retreat"):
        places = *places[:2], *places[4:6]
    signature = first if last is None else first + places + last
    kind = types.boolean if name in ("finite", "advance") else types.void
    try:
        return njit([kind(*signature)], nogil=True, cache=True, error_model="numpy")(function)
    except (OSError, RuntimeError):
        return njit([kind(*signature)], nogil=True, error_model="numpy")(function)
