"""The passes of the projection: compiled against plain, and both against the definition."""

import numpy as np
import pytest

from sparsedp.kernels import staggered_plain

SHAPES = [
    ((1, 1, 5), True),
    ((1, 1, 1), False),
    ((1, 4, 6), False),
    ((1, 2, 2), True),
    ((3, 4, 5), False),
    ((4, 3, 2), True),
]


def numbers(shape, periodic, seed=0):
    """Components, coefficients of cells and of faces, for axes of more than one cell."""
    rng = np.random.default_rng(seed)
    parts, cells, faces = [], [], []
    for axis, n in enumerate(shape):
        there = n > 1 or axis == 2
        full = tuple(m + (a == axis and not periodic) for a, m in enumerate(shape))
        parts.append(rng.standard_normal(full if there else (0, 0, 0)))
        cells.append(rng.standard_normal((2, n if there else 0)))
        lines = rng.standard_normal((3, full[axis] if there else 0))
        if there and not periodic:
            lines[1, 0] = lines[2, -1] = 0.0
        faces.append(lines)
    return parts, [tuple(x) for x in zip(*cells)], [tuple(np.ascontiguousarray(y) for y in x) for x in zip(*faces)]


def wanted(parts, lower, upper, shape):
    b = np.zeros(shape)
    for axis, x in enumerate(parts):
        if x.size:
            n, m = shape[axis], x.shape[axis]
            line = [-1 if a == axis else 1 for a in range(3)]
            ahead = np.take(x, (np.arange(n) + 1) % m, axis)
            b += upper[axis].reshape(line) * ahead + lower[axis].reshape(line) * np.take(x, np.arange(n), axis)
    return b


def modules():
    found = [staggered_plain]
    if pytest.importorskip("numba"):
        from sparsedp.kernels import staggered

        found.append(staggered)
    return found


@pytest.mark.parametrize(("shape", "periodic"), SHAPES)
@pytest.mark.parametrize("equal", [False, True])
def test_compiled_and_plain(shape, periodic, equal):
    parts, (lower, upper), (keep, below, above) = numbers(shape, periodic)
    if equal:
        lower, upper = (tuple(np.full_like(x, s) for x in lower) for s in (-2.0, 2.0))
    p = np.random.default_rng(1).standard_normal(shape)
    for module in modules():
        b = np.empty(shape)
        total = module.net_flow(*parts, lower, upper, b)
        np.testing.assert_allclose(b, wanted(parts, lower, upper, shape), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(total, np.sum(b**2), rtol=1e-13)
        for axis, x in enumerate(parts):
            if x.size:
                out = np.empty_like(x)
                module.push(x, p, keep, below, above, axis, out)
                n, m = shape[axis], x.shape[axis]
                line, face = [-1 if a == axis else 1 for a in range(3)], np.arange(m)
                last, first = np.take(p, (face - 1) % n, axis), np.take(p, face % n, axis)
                a, b_, c = (coefficient[axis].reshape(line) for coefficient in (keep, below, above))
                np.testing.assert_allclose(out, a * x + b_ * last + c * first, rtol=1e-13, atol=1e-13)
