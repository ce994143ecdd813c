"""Compiled loops of `sampling`.

A kernel is compiled for a number of axes and an order when it is first used. Types are stated, so that
read-only arrays do not ask for kernels of their own.
"""

import functools

from numba import njit, types
from numba.extending import register_jitable

from sparsedp.kernels.pointers import address, pointer
from sparsedp.kernels.sampling_bounds import extrema, mean_of_equal, spread_to_equal
from sparsedp.kernels.sampling_looks import add, miss, sides, total, way_back
from sparsedp.kernels.sampling_places import slope, value

__all__ = ["kernel"]


@register_jitable(error_model="numpy")
def gather(samples, w, scale, shape, strides, wraps, like, start, stop, out):
    """out = interpolated samples at i - scale w, for the rows start:stop."""
    n, numbers = shape[2], pointer(address(samples), 1.0)
    for row in range(start, stop):
        i, j = divmod(row, shape[1])
        here = row * n
        for k in range(n):
            one = value(i - scale[0] * w[0][here + k], shape[0], wraps[0], like[0])
            two = value(j - scale[1] * w[1][here + k], shape[1], wraps[1], like[1])
            three = value(k - scale[2] * w[2][here + k], n, wraps[2], like[2])
            out[here + k] = total(numbers, one, two, three, strides)


@register_jitable(error_model="numpy")
def scatter(samples, w, scale, shape, strides, wraps, like, start, stop, g):
    """The transpose of `gather`: samples += weights times g."""
    n, numbers = shape[2], pointer(address(samples), 1.0)
    for row in range(start, stop):
        i, j = divmod(row, shape[1])
        here = row * n
        for k in range(n):
            if g[here + k] != 0.0:
                one = value(i - scale[0] * w[0][here + k], shape[0], wraps[0], like[0])
                two = value(j - scale[1] * w[1][here + k], shape[1], wraps[1], like[1])
                three = value(k - scale[2] * w[2][here + k], n, wraps[2], like[2])
                add(numbers, one, two, three, strides, g[here + k])


@register_jitable(error_model="numpy")
def slopes(samples, w, scale, shape, strides, wraps, like, start, stop, g, out):
    """out += g times the derivative of `gather` in w, axis by axis; an axis that is not there adds nothing."""
    n, numbers = shape[2], pointer(address(samples), 1.0)
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
                out[0][at] -= scale[0] * number * total(numbers, steep, two, three, strides)
            if len(like[1]) > 1:
                steep = slope(q, shape[1], wraps[1], like[1])
                out[1][at] -= scale[1] * number * total(numbers, one, steep, three, strides)
            steep = slope(r, n, wraps[2], like[2])
            out[2][at] -= scale[2] * number * total(numbers, one, two, steep, strides)


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
def fold(u, outside, shape, strides, corner, targets, sources, samples, fresh):
    """The transpose of `extend`: added to u and outside, or written there when they are fresh."""
    if fresh:
        outside[:] = 0.0
    for row in range(shape[0] * shape[1]):
        i, j = divmod(row, shape[1])
        at, own = corner + i * strides[0] + j * strides[1], row * shape[2]
        if fresh:
            for k in range(shape[2]):
                u[own + k] = samples[at + k]
        else:
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
    u, outside, shape, strides, corner, targets, sources, samples, places, g, back, field, aside, speeds, fresh
):
    """Cotangent of the moved field -> added to field and aside, and to speeds; what is empty is left out.

    What is fresh, (field and aside, speeds), is written instead. Returns what the speeds gained, times w, in total.
    """
    (w, scale, wraps, like), many, rate = places, shape[0] * shape[1], 0.0
    back[:] = 0.0
    if speeds[2].size:
        extend(u, outside, shape, strides, corner, targets, sources, samples)
        none = field[:0]
        rate = way_back(samples, w, scale, shape, strides, wraps, like, 0, many, g, back, none, none, speeds, fresh[1])
    else:
        scatter(back, w, scale, shape, strides, wraps, like, 0, many, g)
    if field.size:
        fold(field, aside, shape, strides, corner, targets, sources, back, fresh[0])
    return rate


# ---------------------------------------------------------------- compiling

_real, _int = types.float64, types.int64
_read, _whole = types.Array(_real, 1, "C", readonly=True), types.Array(_int, 1, "C", readonly=True)
_write, _threes, _scale = types.Array(_real, 1, "C"), types.UniTuple(_int, 3), types.UniTuple(_real, 3)
_pair, _flags = types.UniTuple(_int, 2), types.UniTuple(types.boolean, 3)
_ghosts = (_threes, _pair, _int, _whole, _whole)


def _looked_up(like):
    kinds = types.Tuple([types.UniTuple(_real, len(zeros)) for zeros in like])
    return types.UniTuple(_read, 3), _scale, _threes, _pair, _flags, kinds, _int, _int


_axes, _flag = types.UniTuple(_write, 3), types.boolean
_back = (_write, _write, _write, _axes)  # where cotangents go
_KERNELS = {  # name: function, result, its arguments before and after the places, or all of them
    "gather": (gather, types.void, (_read,), (_write,)),
    "scatter": (scatter, types.void, (_write,), (_read,)),
    "slopes": (slopes, types.void, (_read,), (_read, _axes)),
    "extrema": (extrema, types.void, (_read,), (_write, _write)),
    "mean_of_equal": (mean_of_equal, types.void, (_read, _read, _read), (_write,)),
    "spread_to_equal": (spread_to_equal, types.void, (_read, _read, _write), (_read,)),
    "sides": (sides, types.void, (_read,), (_write, _write, _write)),
    "miss": (miss, _real, (_read,), (_read, _read, _read, _write, *_back)),
    "way_back": (way_back, _real, (_read,), (_read, *_back, _flag)),
    "extend": (extend, types.void, (_read, _read, *_ghosts, _write), None),
    "fold": (fold, types.void, (_write, _write, *_ghosts, _read, _flag), None),
    "finite": (finite, _flag, (_read,), None),
    "advance": (advance, _flag, (_read, _read, *_ghosts, _write), (_write,)),
    "retreat": (retreat, _real, (_read, _read, *_ghosts, _write), (_read, *_back, types.UniTuple(_flag, 2))),
}


@functools.cache
def kernel(name, like):
    """The compiled function, kept on disk where there is a place to keep it."""
    function, kind, first, last = _KERNELS[name]
    places = _looked_up(like)
    if name == "advance":
        places = *places[:2], *places[4:6]
    if name == "retreat":
        places = (types.Tuple([*places[:2], *places[4:6]]),)
    signature = first if last is None else first + places + last
    try:
        return njit([kind(*signature)], nogil=True, cache=True, error_model="numpy")(function)
    except (OSError, RuntimeError):
        return njit([kind(*signature)], nogil=True, error_model="numpy")(function)
