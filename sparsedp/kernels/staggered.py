"""The compiled passes of the projection: net flow out of cells, pressure pushed onto faces. Serial, row by row.

Beside the transforms they are short: a team of threads would bring nothing. Arrays are flat and few, because
each that is handed over costs as much as a short row; `shape` tells where the components start.
"""

from numba import njit, types

__all__ = ["net_flow", "push"]

_out = types.Array(types.float64, 1, "C")
_given = types.Array(types.float64, 1, "C", readonly=True)
_shape = types.UniTuple(types.int64, 6)
_lines = types.Array(types.float64, 2, "C", readonly=True)


def _compiled(signature, **options):
    """Decorator: compile and keep on disk, or only compile where there is no place to keep it."""

    def decorate(function):
        settings = {"error_model": "numpy", "nogil": True, **options}
        try:
            return njit([signature], cache=True, **settings)(function)
        except (OSError, RuntimeError):
            return njit([signature], **settings)(function)

    return decorate


@_compiled(types.float64(_given), fastmath={"reassoc"})  # in any order: it is a size, not a result
def _squares(row):
    total = 0.0
    for k in range(row.size):
        total += row[k] * row[k]
    return total


@_compiled(types.UniTuple(types.float64, 2)(_given, _shape, _lines, _out))
def net_flow(x, shape, lines, b):
    """b = sum over the axes of upper v[i + 1] + lower v[i]; returns the sums of the squares of b and of x."""
    n0, n1, n2, m0, m1, m2 = shape
    second, third = m0 * n1 * n2, m0 * n1 * n2 + n0 * m1 * n2  # where the components start
    lower, upper = lines[0], lines[1]
    lo, up = lower[n0 + n1 :], upper[n0 + n1 :]
    total = 0.0
    for i in range(n0):
        for j in range(n1):
            cell, face = (i * n1 + j) * n2, third + (i * n1 + j) * m2
            row, here = b[cell : cell + n2], x[face : face + m2]
            ahead = here[1:]
            for k in range(n2 - 1):
                row[k] = up[k] * ahead[k] + lo[k] * here[k]
            row[n2 - 1] = up[n2 - 1] * here[n2 if m2 > n2 else 0] + lo[n2 - 1] * here[n2 - 1]
            if m1 > 0:
                face, beyond = second + (i * m1 + j) * n2, second + (i * m1 + (j + 1 if j + 1 < m1 else 0)) * n2
                here, ahead, low, high = x[face : face + n2], x[beyond : beyond + n2], lower[n0 + j], upper[n0 + j]
                for k in range(n2):
                    row[k] += high * ahead[k] + low * here[k]
            if m0 > 0:
                face, beyond = (i * n1 + j) * n2, ((i + 1 if i + 1 < m0 else 0) * n1 + j) * n2
                here, ahead, low, high = x[face : face + n2], x[beyond : beyond + n2], lower[i], upper[i]
                for k in range(n2):
                    row[k] += high * ahead[k] + low * here[k]
            total += _squares(row)
    return total, _squares(x)


@_compiled(types.void(_given, _given, _shape, _lines, _out))
def push(x, p, shape, lines, out):
    """out = keep x + below p[i - 1] + above p[i] on the faces of all axes."""
    n0, n1, n2, m0, m1, m2 = shape
    second, third = m0 * n1 * n2, m0 * n1 * n2 + n0 * m1 * n2
    keep, below, above = lines[0], lines[1], lines[2]
    for i in range(m0):
        start, last, first = i * n1 * n2, (i - 1 if i > 0 else n0 - 1) * n1 * n2, (i if i < n0 else 0) * n1 * n2
        given, found = x[start : start + n1 * n2], out[start : start + n1 * n2]
        here, ahead, a, b, c = p[last : last + n1 * n2], p[first : first + n1 * n2], keep[i], below[i], above[i]
        for k in range(n1 * n2):
            found[k] = a * given[k] + b * here[k] + c * ahead[k]
    for i in range(n0):
        for j in range(m1):
            start, last, first = second + (i * m1 + j) * n2, (j - 1 if j > 0 else n1 - 1), (j if j < n1 else 0)
            given, found, last, first = x[start : start + n2], out[start : start + n2], last + i * n1, first + i * n1
            here, ahead = p[last * n2 : last * n2 + n2], p[first * n2 : first * n2 + n2]
            a, b, c = keep[m0 + j], below[m0 + j], above[m0 + j]
            for k in range(n2):
                found[k] = a * given[k] + b * here[k] + c * ahead[k]
    stay, low, high = keep[m0 + m1 :], below[m0 + m1 :], above[m0 + m1 :]
    for row in range(n0 * n1):
        given, found = x[third + row * m2 : third + row * m2 + m2], out[third + row * m2 : third + row * m2 + m2]
        here = p[row * n2 : row * n2 + n2]
        ahead, source, target = here[1:], given[1:n2], found[1:n2]
        for k in range(n2 - 1):
            target[k] = stay[k + 1] * source[k] + low[k + 1] * here[k] + high[k + 1] * ahead[k]
        found[0] = stay[0] * given[0] + low[0] * here[n2 - 1] + high[0] * here[0]
        if m2 > n2:
            found[n2] = stay[n2] * given[n2] + low[n2] * here[n2 - 1] + high[n2] * here[0]
