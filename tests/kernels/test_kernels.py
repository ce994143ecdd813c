"""The kernels against sparse matrices, compiled and not: all sizes and ends."""

from functools import reduce
from math import prod
from threading import Barrier, Thread

import numpy as np
import pytest
import scipy.sparse as sp

from sparsedp import kernels
from sparsedp.kernels import team
from sparsedp.kernels.reference import Rows, Tridiagonal

SHAPES = [(1, 1, 1), (1, 1, 2), (1, 1, 3), (1, 1, 700), (1, 2, 1), (1, 31, 37), (1, 64, 130), (2, 1, 3), (2, 2, 2)]
SHAPES += [(3, 1, 17), (7, 5, 1), (5, 7, 11), (13, 8, 64), (20, 20, 20)]
NUMBA = pytest.mark.skipif(not kernels.compiled(), reason="numba is not installed")


@pytest.fixture(params=[False, pytest.param(True, marks=NUMBA)], ids=["reference", "compiled"])
def side(request, monkeypatch):
    """Run without numba, and with numba on several threads for every size."""
    monkeypatch.setattr(kernels, "compiled", lambda: request.param)
    monkeypatch.setattr(team, "SERIAL", 0)


def line(rng, n, periodic, stretched):
    """Return a tridiagonal matrix: random, or constant except at its ends."""
    lower, centre, upper = rng.uniform(0.5, 1.5, (3, n))
    if stretched:
        first, last = 0, 0
    elif periodic:
        first, last = 0, n
    else:
        first, last = 1, max(1, n - 1)
    for band, value in ((lower, 1.25), (centre, -2.5), (upper, 0.75 if n % 2 else 1.25)):
        band[first:last] = value
    if not periodic or n == 1:
        lower[0] = upper[-1] = 0
    return Tridiagonal(lower, centre, upper)


def dense(axis, n):
    if axis is None:
        return np.zeros((n, n))
    matrix = np.diag(axis.centre)
    i = np.arange(n)
    np.add.at(matrix, (i, i - 1), axis.lower)
    np.add.at(matrix, (i, (i + 1) % n), axis.upper)
    return matrix


def matrix_of(axes, shape, shift):
    total = shift * sp.eye_array(prod(shape))
    for k, axis in enumerate(axes):
        sides = [sp.csr_array(dense(axis, n)) if a == k else sp.eye_array(n) for a, n in enumerate(shape)]
        total = total + reduce(sp.kron, sides)
    return sp.csr_array(total)


def cases():
    """Yield shapes with all kinds of axes."""
    rng = np.random.default_rng(0)
    for turn, shape in enumerate(SHAPES * 3):
        kinds = [None if rng.random() < 0.2 else rng.random(2) < 0.5 for _ in shape]
        yield turn, shape, tuple(kind if kind is None else line(rng, n, *kind) for kind, n in zip(kinds, shape))


def close(found, expected, times=10):
    scale = 1 + np.max(np.abs(expected), initial=0)
    return np.all(np.abs(found - expected) <= times * np.finfo(float).eps * scale)


def along(u, rows, scale, start=None):
    """The product as a new array; added to `start` if there is one."""
    out = np.full((len(u), rows.rows, u.shape[2]), np.nan) if start is None else start.copy()
    kernels.along_axis(u, out, rows, scale, start is not None)
    return out


def added(u, axes, shift):
    out = np.full_like(u, np.nan)
    kernels.summed(u.shape, axes, shift)(u, out)
    return out


def threads_and_one(make):
    """Return the results of `make` with all threads and with one."""
    found = [make()]
    kernels.set_threads(1)
    try:
        return [*found, make()]
    finally:
        kernels.set_threads()


def test_sum_of_axes_is_the_sparse_matrix(side):
    rng = np.random.default_rng(1)
    for _, shape, axes in cases():
        u = rng.standard_normal(shape)
        u.setflags(write=False)
        expected = (matrix_of(axes, shape, 0.3) @ u.ravel()).reshape(shape)
        many, one = threads_and_one(lambda u=u, axes=axes: added(u, axes, 0.3))
        assert close(many, expected) and many.tobytes() == one.tobytes(), (shape, axes)


@NUMBA
def test_uniform_rows_give_the_same_bits():
    """The same three numbers in every row, read once or for each row."""
    rng = np.random.default_rng(4)
    for shape in ((1, 1, 1), (1, 1, 2), (1, 5, 3), (1, 7, 40), (4, 1, 37), (3, 5, 40), (2, 3, 1)):
        axes = tuple(line(rng, n, n > 1, n > 1) for n in shape)
        for axis in axes:
            for diagonal in axis:
                diagonal[:] = np.where(diagonal, diagonal[len(diagonal) // 2], 0.0)
        u = rng.standard_normal(shape)
        found = []
        for uniform in (True, False):
            out = np.full_like(u, np.nan)
            bands = [np.stack(axis) for axis in axes]
            assert kernels.run("stencil", "kronecker_sum", shape[0] * shape[1], u.size, 1, u, out, *bands, uniform, 0.3)
            found.append(out)
        assert np.array_equal(*found) and np.array_equal(found[0], added(u, axes, 0.3))


def test_a_missing_neighbour_is_not_read_from_the_far_end(side):
    rng = np.random.default_rng(3)
    shape = (6, 7, 40)
    for axis, n in enumerate(shape):
        axes = tuple(line(rng, n, False, True) if k == axis else None for k in range(3))
        for end in (0, n - 1):
            u = np.ones(shape)
            u[tuple(end if k == axis else slice(None) for k in range(3))] = np.nan
            bad = np.isnan(added(u, axes, 1.0)).any(axis=tuple(k for k in range(3) if k != axis))
            assert np.flatnonzero(bad).tolist() == sorted({end, abs(end - 1)})


def record(matrix, diagonals):
    """Return the Rows of a sparse matrix, with or without the diagonals."""
    m = sp.csr_array(matrix)
    m.sum_duplicates()
    row = np.repeat(np.arange(m.shape[0]), np.diff(m.indptr))
    offsets = np.unique(m.indices - row) if diagonals else np.zeros(0, int)
    values = np.zeros((offsets.size, m.shape[0]))
    spans = np.zeros((2, offsets.size), int)
    for d, offset in enumerate(offsets):
        here = row[m.indices - row == offset]
        values[d, here] = m.data[m.indices - row == offset]
        spans[:, d] = here[0], here[-1] + 1
    lists = m.indptr.astype(np.int64), m.indices.astype(np.int64), m.data
    return Rows(*m.shape, *lists, offsets.astype(np.int64), *spans, values)


def matrices():
    rng = np.random.default_rng(4)
    for n, m in ((1, 1), (2, 3), (7, 7), (40, 41), (131, 130), (300, 300)):
        yield sp.dia_array((np.ones((2, m)) * [[-1], [1]], [0, 1]), shape=(n, m))
        yield sp.dia_array((rng.random((5, m)), [-2, -1, 0, 1, 2]), shape=(n, m))
        yield sp.csr_array(np.where(rng.random((n, m)) < 2 / m, rng.random((n, m)), 0.0))
        yield sp.csr_array((n, m))
        ring = sp.lil_array((m, m))
        for shift, value in ((-1, 0.5), (0, -2.0), (1, 0.25)):
            ring[np.arange(m), (np.arange(m) + shift) % m] = value
        yield ring


def test_matrix_along_an_axis_is_the_sparse_matrix(side):
    rng = np.random.default_rng(5)
    for turn, matrix in enumerate(matrices()):
        rows = record(matrix, turn % 3)
        for before, after in ((1, 1), (3, 1), (2, 2), (2, 5), (1, 90)):
            u = rng.standard_normal((before, rows.cols, after))
            start = rng.standard_normal((before, rows.rows, after))
            expected = 0.7 * np.stack([matrix @ plane for plane in u])
            many, one = threads_and_one(lambda u=u, rows=rows: along(u, rows, 0.7))
            again = along(u, rows, 0.7, start)
            assert close(many, expected) and many.tobytes() == one.tobytes(), (turn, u.shape)
            assert close(again, start + expected), (turn, u.shape)


@pytest.mark.parametrize("shape", [(0, 3, 3), (2, 0, 3), (2, 3, 0)])
def test_empty_arrays(shape):
    axes = tuple(line(np.random.default_rng(0), n, False, False) if n else None for n in shape)
    kernels.summed(shape, axes, 1.0)(np.zeros(shape), np.zeros(shape))
    rows = record(sp.csr_array((shape[1], shape[1])), True)
    kernels.along_axis(np.zeros(shape), np.zeros(shape), rows, 1.0, False)


def test_rows_without_columns_give_zero():
    out = np.ones((2, 3, 4))
    kernels.along_axis(np.zeros((2, 0, 4)), out, record(sp.csr_array((3, 0)), True), 1.0, False)
    assert not out.any()


@NUMBA
def test_python_threads_may_call_at_the_same_time(monkeypatch):
    monkeypatch.setattr(team, "SERIAL", 0)
    rng = np.random.default_rng(7)
    axes = (None, line(rng, 150, False, True), line(rng, 160, True, True))
    fields = [rng.standard_normal((1, 150, 160)) for _ in range(4)]
    expected = [added(u, axes, 0.0) for u in fields]
    results = [[] for _ in fields]
    start = Barrier(len(fields))

    def work(k):
        start.wait()
        results[k].extend(added(fields[k], axes, 0.0).tobytes() == expected[k].tobytes() for _ in range(30))

    workers = [Thread(target=work, args=(k,)) for k in range(len(fields))]
    for thread in workers:
        thread.start()
    for thread in workers:
        thread.join()
    assert [all(result) and len(result) == 30 for result in results] == [True] * len(fields)


def double(x, start, stop):
    for i in range(start, stop):
        x[i] *= 2.0


@NUMBA
def test_compilation_without_a_cache_directory(monkeypatch):
    import numba

    real = numba.njit

    def njit(*args, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function")
        return real(*args, **options)

    monkeypatch.setattr(numba, "njit", njit)
    x = np.ones(5)
    team.Kernel(double, "write1").run(5, 5, 2, x)
    assert x.tolist() == [2.0] * 5


@NUMBA
def test_numpy_fallback_when_compilation_fails(monkeypatch):
    import numba

    from sparsedp.kernels import stencil

    rng = np.random.default_rng(8)
    u = rng.standard_normal((3, 4, 5))
    axes = tuple(line(rng, n, True, True) for n in u.shape)
    expected = added(u, axes, 1.0)
    monkeypatch.setattr(numba, "njit", lambda *args, **options: 1 / 0)
    monkeypatch.setattr(stencil, "kronecker_sum", team.Kernel(stencil.kronecker_sum.loop, stencil.kronecker_sum.words))
    with pytest.warns(RuntimeWarning, match="NumPy is used instead"):
        found = added(u, axes, 1.0)
    assert close(found, expected)


@NUMBA
def test_an_error_in_a_slab_is_raised_after_all_slabs_end(monkeypatch):
    monkeypatch.setattr(team, "SERIAL", 0)
    ended = []

    def compiled(x, start, stop):
        ended.append(start)
        if start:
            raise ValueError("this slab")

    kernel = team.Kernel(double, "write1")
    monkeypatch.setattr(kernel, "_compile_or_warn", lambda: compiled)
    with pytest.raises(ValueError, match="this slab"):
        kernel.run(4, 4, 2, np.ones(4))
    assert sorted(ended) == [0, 2]
