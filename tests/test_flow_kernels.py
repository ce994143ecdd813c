"""The passes of the projection: compiled against plain, and both against the definition."""

import numpy as np
import pytest

from sparsedp import kernels
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
    """The six lengths, and components and coefficients of cells and of faces for axes of more than one cell."""
    rng = np.random.default_rng(seed)
    there = [n > 1 or axis == 2 for axis, n in enumerate(shape)]
    counts = tuple((n + (not periodic)) * flag for n, flag in zip(shape, there))
    parts, cells, faces = [], [], []
    for axis, (n, m, flag) in enumerate(zip(shape, counts, there)):
        parts.append(rng.standard_normal(tuple(m if a == axis else k for a, k in enumerate(shape))))
        cells.append(rng.standard_normal((2, n)) * flag)
        lines = rng.standard_normal((3, m))
        if flag and not periodic:
            lines[1, 0] = lines[2, -1] = 0.0
        faces.append(lines)
    return (*shape, *counts), parts, cells, faces


def flat(parts):
    return np.concatenate([part.ravel() for part in parts])


def wanted(parts, cells, shape):
    b = np.zeros(shape)
    for axis, x in enumerate(parts):
        if x.size:
            n, m = shape[axis], x.shape[axis]
            lower, upper = cells[axis].reshape([2] + [-1 if a == axis else 1 for a in range(3)])
            b += upper * np.take(x, (np.arange(n) + 1) % m, axis) + lower * np.take(x, np.arange(n), axis)
    return b


def modules():
    found = [staggered_plain]
    if kernels.compiled():
        from sparsedp.kernels import staggered

        found.append(staggered)
    return found


@pytest.mark.parametrize(("shape", "periodic"), SHAPES)
@pytest.mark.parametrize("equal", [False, True])
def test_compiled_and_plain(shape, periodic, equal):
    six, parts, cells, faces = numbers(shape, periodic)
    if equal:
        cells = [np.stack([np.full(n, -2.0), np.full(n, 2.0)]) for n in shape]
    x, p = flat(parts), np.random.default_rng(1).standard_normal(shape)
    pushed = []
    for axis, part in enumerate(parts):
        face, n = np.arange(part.shape[axis]), shape[axis]
        keep, below, above = faces[axis].reshape([3] + [-1 if a == axis else 1 for a in range(3)])
        pushed.append(keep * part + below * np.take(p, (face - 1) % n, axis) + above * np.take(p, face % n, axis))
    for module in modules():
        b, out = np.empty(p.size), np.empty(x.size)
        flow, length = module.net_flow(x, six, np.concatenate(cells, axis=1), b)
        np.testing.assert_allclose(b.reshape(shape), wanted(parts, cells, shape), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose((flow, length), (np.sum(b**2), np.sum(x**2)), rtol=1e-13)
        module.push(x, p.ravel(), six, np.concatenate(faces, axis=1), out)
        np.testing.assert_allclose(out, flat(pushed), rtol=1e-13, atol=1e-13)
