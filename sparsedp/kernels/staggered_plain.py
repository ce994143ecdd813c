"""NumPy twins of the passes in staggered.py, as a careful user writes them: slices."""

import numpy as np

__all__ = ["net_flow", "push"]


def _number(line):
    """Coefficients along an axis as one number where they are equal: a pass with a number is faster."""
    return line[0] if line.size and line[0] == line[-1] and np.all(line == line[0]) else line


def _spread(line, axis):
    line = _number(line)
    return line if line.ndim == 0 else line.reshape([-1 if a == axis else 1 for a in range(3)])


def _cut(axis, start, stop):
    return tuple(slice(start, stop) if a == axis else slice(None) for a in range(3))


def net_flow(x0, x1, x2, lower, upper, b):
    """See `sparsedp.kernels.net_flow`."""
    b[...] = 0.0
    for axis, x in enumerate((x0, x1, x2)):
        if x.size:
            n = b.shape[axis]
            _add_flow(x, lower[axis], upper[axis], axis, n, b)
    return float(np.einsum("ijk,ijk->", b, b))


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


def push(x, p, keep, below, above, axis, out):
    """See `sparsedp.kernels.push`."""
    n, m = p.shape[axis], x.shape[axis]
    stay, low, high = keep[axis], below[axis], above[axis]
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
