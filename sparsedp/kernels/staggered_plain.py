"""NumPy twins of the passes in staggered.py, as a careful user writes them: slices."""

from math import prod

import numpy as np

from sparsedp.kernels import squares

__all__ = ["net_flow", "push"]


def _number(line):
    """Coefficients along an axis as one number where they are equal: a pass with a number is faster."""
    return line[0] if line.size and line[0] == line[-1] and np.all(line == line[0]) else line


def _spread(line, axis):
    line = _number(line)
    return line if line.ndim == 0 else line.reshape([-1 if a == axis else 1 for a in range(3)])


def _cut(axis, start, stop):
    return tuple(slice(start, stop) if a == axis else slice(None) for a in range(3))


def net_flow(x, shape, lines, b):
    """See `sparsedp.kernels.passes.net_flow`."""
    b[...] = 0.0
    cells = b.reshape(shape[:3])
    (lower, upper), ends = lines, np.cumsum(shape[:3])
    for axis, part in _components(x, shape):
        here = slice(ends[axis] - shape[axis], ends[axis])
        _add_flow(part, lower[here], upper[here], axis, shape[axis], cells)
    return float(squares(b)), float(squares(x))


def _components(x, shape):
    """Pairs (axis, component) of a flat face field."""
    start = 0
    for axis, faces in enumerate(shape[3:]):
        part = tuple(faces if a == axis else n for a, n in enumerate(shape[:3]))
        start, stop = start + prod(part), start
        if faces:
            yield axis, x[stop:start].reshape(part)


def _add_flow(x, lower, upper, axis, n, b):
    """The cells between the first and the last one with one coefficient, if it is one; the ends apart."""
    for first, last in ((0, 1), (1, n - 1), (n - 1, n)) if n > 2 else ((i, i + 1) for i in range(n)):
        here = x[_cut(axis, first, last)]
        wraps = last == n and x.shape[axis] == n
        ahead = x[_cut(axis, 0, 1)] if wraps and last - first == 1 else x[_cut(axis, first + 1, last + 1)]
        low, high = _spread(lower[first:last], axis), _spread(upper[first:last], axis)
        b[_cut(axis, first, last)] += _both(low, here, high, ahead)


def _both(low, here, high, ahead):
    """low here + high ahead, with one product where the coefficients are a difference."""
    if np.ndim(low) == np.ndim(high) == 0 and low == -high:
        part = ahead - here
        part *= high
    else:
        part = high * ahead
        part += low * here
    return part


def push(x, p, shape, lines, out):
    """See `sparsedp.kernels.passes.push`."""
    p, ends = p.reshape(shape[:3]), np.cumsum(shape[3:])
    for (axis, given), (_, found) in zip(_components(x, shape), _components(out, shape), strict=True):
        keep, below, above = lines[:, ends[axis] - shape[3 + axis] : ends[axis]]
        _push_along(axis, given, p, keep, below, above, found)


def _push_along(axis, x, p, stay, low, high, out):
    n, m = p.shape[axis], x.shape[axis]
    inner = _cut(axis, 1, n)
    if n > 1:
        a, b, c = (_spread(line[1:n], axis) for line in (stay, low, high))
        here, ahead = p[_cut(axis, 0, n - 1)], p[inner]
        part = _both(b, here, c, ahead)
        out[inner] = x[inner]
        if not (np.ndim(a) == 0 and a == 1):
            out[inner] *= a
        out[inner] += part
    for face in {0, n} if m > n else {0}:
        this = _cut(axis, face, face + 1)
        last, first = p[_cut(axis, face - 1, face or None)], p[_cut(axis, face % n, face % n + 1)]
        out[this] = stay[face] * x[this] + low[face] * last + high[face] * first
