"""The compiled passes of the projection: net flow out of cells, pressure pushed onto faces. Serial, row by row.

Beside the transforms they are short: a team of threads would bring nothing. Face components come as 3-D
arrays with leading axes of length 1; a component that is not there has no entries.
"""

from numba import njit, types

__all__ = ["net_flow", "push"]

_out = types.Array(types.float64, 3, "C")
_given = types.Array(types.float64, 3, "C", readonly=True)
_row = types.Array(types.float64, 1, "C")
_lines = types.UniTuple(types.Array(types.float64, 1, "C", readonly=True), 3)


def _compiled(signature, **options):
    """Decorator: compile and keep on disk, or only compile where there is no place to keep it."""

    def decorate(function):
        settings = {"error_model": "numpy", "nogil": True, **options}
        try:
            return njit([signature], cache=True, **settings)(function)
        except (OSError, RuntimeError):
            return njit([signature], **settings)(function)

    return decorate


@_compiled(types.float64(_row), fastmath={"reassoc"})  # in any order: it is a size, not a result
def _squares(row):
    total = 0.0
    for k in range(row.size):
        total += row[k] * row[k]
    return total


@_compiled(types.float64(_given, _given, _given, _lines, _lines, _out))
def net_flow(x0, x1, x2, lower, upper, b):
    """b = sum over the axes of upper v[i + 1] + lower v[i]; returns the sum of its squares."""
    n0, n1, n2 = b.shape
    lo, up = lower[2], upper[2]
    total = 0.0
    for i in range(n0):
        for j in range(n1):
            row, here = b[i, j], x2[i, j]
            ahead = here[1:]
            for k in range(n2 - 1):
                row[k] = up[k] * ahead[k] + lo[k] * here[k]
            row[n2 - 1] = up[n2 - 1] * here[n2 if here.size > n2 else 0] + lo[n2 - 1] * here[n2 - 1]
            if x1.size:
                low, high = lower[1][j], upper[1][j]
                here, ahead = x1[i, j], x1[i, j + 1 if j + 1 < x1.shape[1] else 0]
                for k in range(n2):
                    row[k] += high * ahead[k] + low * here[k]
            if x0.size:
                low, high = lower[0][i], upper[0][i]
                here, ahead = x0[i, j], x0[i + 1 if i + 1 < x0.shape[0] else 0, j]
                for k in range(n2):
                    row[k] += high * ahead[k] + low * here[k]
            total += _squares(row)
    return total


@_compiled(types.void(_given, _given, _lines, _lines, _lines, types.int64, _out))
def push(x, p, keep, below, above, axis, out):
    """out = keep x + below p[i - 1] + above p[i] on the faces of one axis."""
    n0, n1, n2 = p.shape
    m0, m1, m2 = x.shape
    stay, low, high = keep[axis], below[axis], above[axis]
    for i in range(m0):
        for j in range(m1):
            given, found = x[i, j], out[i, j]
            if axis == 2:
                here = p[i, j]
                ahead, source, target = here[1:], given[1:n2], found[1:n2]
                a, b, c = stay[1:n2], low[1:n2], high[1:n2]
                for k in range(n2 - 1):
                    target[k] = a[k] * source[k] + b[k] * here[k] + c[k] * ahead[k]
                found[0] = stay[0] * given[0] + low[0] * here[n2 - 1] + high[0] * here[0]
                if m2 > n2:
                    found[n2] = stay[n2] * given[n2] + low[n2] * here[n2 - 1] + high[n2] * here[0]
                continue
            face, count = (j, n1) if axis == 1 else (i, n0)
            a, b, c = stay[face], low[face], high[face]
            last, first = (face - 1 if face > 0 else count - 1), (face if face < count else 0)
            here, ahead = (p[i, last], p[i, first]) if axis == 1 else (p[last, j], p[first, j])
            for k in range(n2):
                found[k] = a * given[k] + b * here[k] + c * ahead[k]
