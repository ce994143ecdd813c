"""Buffers of large results: recycled when no reference is left, and never before."""

import gc
import threading

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils import buffers

SHAPE = (1 << 15,)


@pytest.fixture(autouse=True)
def _nothing_waits(monkeypatch):
    monkeypatch.setattr(buffers, "LARGE", 8 * SHAPE[0])  # quick to fill
    buffers._free.clear()
    yield
    buffers._free.clear()


def test_the_memory_of_a_result_that_is_gone_serves_again():
    first = buffers.empty(SHAPE, float)
    where = first.ctypes.data
    del first
    assert buffers.empty(SHAPE, float).ctypes.data == where


@pytest.mark.parametrize(
    "hold",
    [
        lambda array: array,
        lambda array: array[3:],
        lambda array: array[::-1][1:],  # a view of a view
        lambda array: array.reshape(2, -1).T,
        lambda array: array.view(np.int64),
        lambda array: array.astype(float, copy=False),
        lambda array: np.asarray(memoryview(array)),
        lambda array: memoryview(array)[5:],
        lambda array: np.frombuffer(array)[1:],
        lambda array: np.broadcast_to(array, (2, array.size))[0],
        lambda array: np.lib.stride_tricks.as_strided(array, (2,), (8,)),
        lambda array: array.ctypes,
        lambda array: array.flat,
        lambda array: np.from_dlpack(array)[2:],
    ],
)
def test_what_somebody_sees_is_never_handed_out(hold):
    first = buffers.empty(SHAPE, float)
    first[:] = 7.0
    where = first.ctypes.data
    seen = hold(first)
    del first
    gc.collect(1)  # what is new; a whole one looks at all that the tests before have left
    others = [buffers.empty(SHAPE, float) for _ in range(3)]
    assert where not in [other.ctypes.data for other in others]
    for other in others:
        other[:] = 1.0
    if not isinstance(seen, (np.flatiter, type(others[0].ctypes))):
        assert np.all(np.asarray(seen).view(float) == 7.0)


def test_a_result_is_plain_writeable_and_its_own():
    result = buffers.empty(SHAPE, float)
    assert type(result) is np.ndarray
    assert result.flags.writeable
    assert result.flags.c_contiguous
    assert result.flags.aligned
    assert result.ctypes.data % 16 == 0


def test_what_waits_is_bounded(monkeypatch):
    monkeypatch.setattr(buffers, "SPARE", 2 * buffers.LARGE)
    many = [buffers.empty(SHAPE, float) for _ in range(5)]
    last = many.pop()
    where = last.ctypes.data
    many.clear()
    del last
    assert sum(memory.size for memory in buffers._free.values()) == 2 * buffers.LARGE
    assert where in [memory.ctypes.data for memory in buffers._free.values()]


def test_operators_take_it_and_give_right_results(monkeypatch):
    monkeypatch.setattr(buffers, "LARGE", 8)
    grid = dp.Grid((20, 30), size=1.0)
    laplacian = dp.laplacian(grid)
    u = np.random.default_rng(0).standard_normal(grid.shape)
    wanted = (laplacian.matrix @ u.ravel()).reshape(grid.shape)
    kept = [laplacian(u + k) for k in range(4)]
    for _ in range(20):
        laplacian(3 * u)
    _, gradient = dp.value_and_grad(lambda u: anp.sum(laplacian(u) ** 2))(u)
    for result in kept:  # constants are in the null space
        np.testing.assert_allclose(result, wanted, atol=1e-9)
    np.testing.assert_allclose(gradient, 2 * laplacian.T(laplacian(u)), rtol=1e-12, atol=1e-9)


def test_threads_never_share_a_result(monkeypatch):
    monkeypatch.setattr(buffers, "LARGE", 8)
    faults = []

    def work(number):
        for _ in range(300):
            mine = buffers.empty((1000,), float)
            mine[:] = number
            other = buffers.empty((1000,), float)
            other[:] = -number
            if not (np.all(mine == number) and np.all(other == -number)):
                faults.append(number)

    team = [threading.Thread(target=work, args=(number,)) for number in range(1, 5)]
    for thread in team:
        thread.start()
    for thread in team:
        thread.join()
    assert not faults
