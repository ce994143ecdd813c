"""NumPy twins of the compiled loops of `sampling`, with the same arguments."""

from itertools import product

import numpy as np

__all__ = [
    "advance",
    "corners",
    "extend",
    "extrema",
    "finite",
    "fold",
    "gather",
    "mean_of_equal",
    "miss",
    "retreat",
    "scatter",
    "sides",
    "slopes",
    "spread_to_equal",
    "way_back",
]


def _place(p, n, wraps, width):
    """Index coordinate -> where it is looked up, the cell it lies in, and the fraction (see `sampling_native`)."""
    low, high = (-1.5, n + 0.5) if width == 2 else (-2.0, n + 1.0)
    with np.errstate(invalid="ignore"):
        if wraps:
            p = p - n * np.floor(p / n)
            low, high = 0.0, float(n)
        p = np.minimum(np.where(p >= low, p, low), high)
    i = np.floor(p)
    i = np.minimum(i, n) if width == 4 else i
    return i.astype(np.int64), p - i


def _weights(p, n, wraps, width):
    """First sample and the weights of the value."""
    if width == 1:
        return 0, (1.0,)
    i, t = _place(p, n, wraps, width)
    s = 1.0 - t
    if width == 2:
        return i + 2, (s, t)
    return i + 2, (-0.5 * t * s * s, s * (1.0 + t - 1.5 * t * t), t * (1.0 + s - 1.5 * s * s), -0.5 * s * t * t)


def _steepness(p, n, wraps, width):
    """First sample and the weights of the slope; at a kink the mean of both sides."""
    i, t = _place(p, n, wraps, width)
    s = 1.0 - t
    if width == 2:
        kink = t == 0
        return i + 1, (np.where(kink, -0.5, 0.0), np.where(kink, 0.0, -1.0), np.where(kink, 0.5, 1.0))
    return i + 2, (s * (1.5 * t - 0.5), t * (4.5 * t - 5.0), s * (5.0 - 4.5 * s), t * (0.5 - 1.5 * s))


def _places(w, scale, shape):
    """Index coordinates of the looked-up places, one array for each axis."""
    lines = np.arange(shape[0]).reshape(-1, 1, 1), np.arange(shape[1]).reshape(1, -1, 1), np.arange(shape[2])
    return [line - factor * speed.reshape(shape) for line, factor, speed in zip(lines, scale, w, strict=True)]


def _products(axes, strides):
    """Every sample of a stencil and its weight."""
    first = axes[0][0] * strides[0] + axes[1][0] * strides[1] + axes[2][0]
    for (i, a), (j, b), (k, c) in product(*(enumerate(weights) for _, weights in axes)):
        yield first + (i * strides[0] + j * strides[1] + k), a * (b * c)


def corners(w, scale, shape, strides, wraps, like):
    """Samples and weights of the value at i - scale w: pairs of arrays."""
    places = _places(w, scale, shape)
    return _products([_weights(*item) for item in zip(places, shape, wraps, map(len, like), strict=True)], strides)


def _total(samples, pairs, shape):
    total = np.zeros(shape)
    for index, weight in pairs:
        total += weight * samples[index]
    return total


def gather(samples, w, scale, shape, strides, wraps, like, start, stop, out):
    """See `sampling_native`."""
    out[...] = _total(samples, corners(w, scale, shape, strides, wraps, like), shape).reshape(out.shape)


def scatter(samples, w, scale, shape, strides, wraps, like, start, stop, g):
    """See `sampling_native`."""
    g = g.reshape(shape)
    for index, weight in corners(w, scale, shape, strides, wraps, like):
        index, share = np.broadcast_arrays(index, weight * g)
        samples += np.bincount(index.ravel(), share.ravel(), samples.size)


def slopes(samples, w, scale, shape, strides, wraps, like, start, stop, g, out):
    """See `sampling_native`."""
    items = list(zip(_places(w, scale, shape), shape, wraps, map(len, like), strict=True))
    values = [_weights(*item) for item in items]
    for axis, item in enumerate(items):
        if item[3] > 1:
            axes = [_steepness(*item) if a == axis else value for a, value in enumerate(values)]
            change = _total(samples, _products(axes, strides), shape).reshape(g.shape)
            np.subtract(out[axis], scale[axis] * g * change, out=out[axis])


def _inner(corner, shape, strides, samples):
    """The field inside its samples."""
    item = samples.itemsize
    steps = strides[0] * item, strides[1] * item, item
    return np.lib.stride_tricks.as_strided(samples[corner:], shape, steps)


def extend(u, outside, shape, strides, corner, targets, sources, samples):
    """See `sampling_native`."""
    _inner(corner, shape, strides, samples)[...] = u.reshape(shape)
    samples[targets] = np.concatenate([u, outside])[sources]


def fold(u, outside, shape, strides, corner, targets, sources, samples, fresh):
    """See `sampling_native`."""
    if fresh:
        u[:], outside[:] = 0.0, 0.0
    view = u.reshape(shape)
    view += _inner(corner, shape, strides, samples)
    ghosts = np.bincount(sources, samples[targets], u.size + outside.size)
    u += ghosts[: u.size]
    if outside.size:
        outside += ghosts[u.size : u.size + outside.size]


def _cells(w, scale, shape, strides, wraps, like):
    """The samples of the cell around each place: a list of index arrays."""
    axes = []
    for p, n, wrap, width in zip(_places(w, scale, shape), shape, wraps, map(len, like), strict=True):
        first = _place(p, n, wrap, width)[0] + width // 2 + 1 if width > 1 else 0
        axes.append((first, (1.0,) * min(width, 2)))
    return [index for index, _ in _products(axes, strides)]


def extrema(samples, w, scale, shape, strides, wraps, like, start, stop, low, high):
    """See `sampling_native`."""
    values = [samples[index] for index in _cells(w, scale, shape, strides, wraps, like)]
    low[...] = np.minimum.reduce(values).reshape(low.shape)
    high[...] = np.maximum.reduce(values).reshape(low.shape)


def _equal(samples, bound, cells, shape):
    """For each sample of a cell its share of what belongs to the bound."""
    flags = [samples[index] == bound.reshape(shape) for index in cells]
    return flags / np.maximum(np.sum(flags, axis=0), 1)


def mean_of_equal(samples, bound, changes, w, scale, shape, strides, wraps, like, start, stop, out):
    """See `sampling_native`."""
    cells = _cells(w, scale, shape, strides, wraps, like)
    shares = _equal(samples, bound, cells, shape)
    out[...] = sum(share * changes[index] for index, share in zip(cells, shares, strict=True)).reshape(out.shape)


def spread_to_equal(samples, bound, changes, w, scale, shape, strides, wraps, like, start, stop, g):
    """See `sampling_native`."""
    cells = _cells(w, scale, shape, strides, wraps, like)
    for index, share in zip(cells, _equal(samples, bound, cells, shape), strict=True):
        index, amount = np.broadcast_arrays(index, share * g.reshape(shape))
        changes += np.bincount(index.ravel(), amount.ravel(), changes.size)


def finite(values):
    """See `sampling_native`."""
    return np.isfinite(values).all()


def advance(u, outside, shape, strides, corner, targets, sources, samples, w, scale, wraps, like, out):
    """See `sampling_native`; what is not finite would only give warnings here."""
    good = all(map(finite, (u, outside, *w)))
    if good:
        extend(u, outside, shape, strides, corner, targets, sources, samples)
        gather(samples, w, scale, shape, strides, wraps, like, 0, 0, out)
    return good


def retreat(
    u, outside, shape, strides, corner, targets, sources, samples, places, g, back, field, aside, speeds, fresh
):
    """See `sampling_native`."""
    (w, scale, wraps, like), rate = places, 0.0
    rest = w, scale, shape, strides, wraps, like, 0, 0
    back[:] = 0.0
    if speeds[2].size:
        extend(u, outside, shape, strides, corner, targets, sources, samples)
    rate = way_back(samples, *rest, g, back, back[:0], back[:0], speeds, fresh[1])
    if field.size:
        fold(field, aside, shape, strides, corner, targets, sources, back, fresh[0])
    return rate


def sides(samples, w, scale, shape, strides, wraps, like, start, stop, out, low, high):
    """See `sampling_looks`."""
    places = w, scale, shape, strides, wraps, like, start, stop
    gather(samples, *places, out)
    extrema(samples, *places, low, high)


def way_back(samples, w, scale, shape, strides, wraps, like, start, stop, g, back, low, high, out, fresh):
    """See `sampling_looks`."""
    places = w, scale, shape, strides, wraps, like, start, stop
    if back.size:
        scatter(back, *places, g)
    if low.size:
        least, most = np.empty((2, low.size))
        extrema(samples, *places, least, most)
        for bound, share in ((least, low), (most, high)):
            spread_to_equal(samples, bound, back, *places, share)
    return _gained(samples, places, g, out, fresh) if out[2].size else 0.0


def _gained(samples, places, g, out, fresh):
    """Slopes to out, and what they add to it times w."""
    w, like = places[0], places[5]
    gain = [np.zeros(g.size) if len(n) > 1 else g[:0] for n in like]
    slopes(samples, *(*places, g, gain))
    total = 0.0
    for axis, change in enumerate(gain):
        if len(like[axis]) > 1:
            np.add(out[axis], change, out=out[axis]) if not fresh else np.copyto(out[axis], change)
            total += float(np.sum(change * w[axis]))
    return total


def miss(samples, w, scale, shape, strides, wraps, like, start, stop, f, u, g, own, back, low, high, out):
    """See `sampling_looks`."""
    places, free = (w, scale, shape, strides, wraps, like, start, stop), 1.0
    gather(samples, *places, own)
    if low.size:
        new = f + 0.5 * (u - own)
        under, over = np.heaviside(low - new, 0.5), np.heaviside(new - high, 0.5)
        low[:], high[:], free = under * g, over * g, 1.0 - under - over
    own[:] = free * g
    scatter(back, *places, -0.5 * own)
    return _gained(samples, places, -0.5 * own, out, True) if out[2].size else 0.0
