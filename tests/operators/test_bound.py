"""Operator.bound: a function for arrays of one shape and dtype, with the bits of the product into a given array."""

import gc
import pickle
import weakref

import numpy as np
import pytest
from catalogue import CATALOGUE, LABELS, boundaries

import sparsedp as dp
from sparsedp import kernels

GRID = dp.Grid((6, 5), size=1.0)


def operators(entry):
    op = entry.make(GRID, boundaries(GRID)[0])
    return op, op.T, op.explicit(), op.matrix_free()


@pytest.mark.parametrize("entry", CATALOGUE, ids=LABELS)
def test_same_bits_as_into_a_given_array(entry, rng):
    for op in operators(entry):
        for lead in ((), (3,)):
            u = rng.standard_normal(lead + op.domain.shape)
            u.reshape(-1)[::7] = -0.0
            u.reshape(-1)[-1] = np.nan
            wanted = op.apply(u, out=np.empty(lead + op.codomain.shape))
            found = op.bound(u)(u)
            assert found.tobytes() == wanted.tobytes() and found.shape == wanted.shape
            assert not np.shares_memory(found, u) and not np.shares_memory(found, op.bound(u)(u))
            assert op.bound(u) is op.bound(u.copy())


def test_sums_products_and_masks(rng):
    space = GRID.cells
    mask = dp.mask(space, rng.random(space.shape) < 0.5)
    scale = dp.diagonal(space, rng.standard_normal(space.shape))
    L = dp.from_matrix(dp.laplacian(GRID).matrix, space, space)
    u = rng.standard_normal(space.shape)
    for op in (mask @ L, L @ mask @ scale, L + mask, mask + L @ scale + scale, scale @ mask):
        assert op.bound(u)(u).tobytes() == op.apply(u, out=np.empty(space.shape)).tobytes()


@pytest.mark.parametrize("dtype", ["f4", "c8", "c16", ">f8", "i4", "?"])
def test_other_dtypes(dtype, rng):
    u = (10 * rng.standard_normal(GRID.shape)).astype(dtype)
    for op in (dp.laplacian(GRID), dp.laplacian(GRID).matrix_free(), dp.diagonal(GRID.cells, u.real.astype(float))):
        wanted = op.apply(u)
        found = op.bound(u)(u)
        assert found.dtype == wanted.dtype and found.tobytes() == wanted.tobytes()


def test_without_the_private_loop_of_scipy(monkeypatch, rng):
    u = rng.standard_normal(GRID.shape)
    L = dp.laplacian(GRID)
    wanted = L(u)
    assert kernels.product_loop() is not None
    monkeypatch.setattr(kernels, "product_loop", lambda: None)
    other = dp.laplacian(GRID)
    assert other(u).tobytes() == wanted.tobytes()


def test_a_wrong_loop_is_not_used(monkeypatch):
    def wrong(rows, columns, indptr, indices, data, x, out):
        out += 1.0

    monkeypatch.setattr("scipy.sparse._sparsetools.csr_matvec", wrong)
    assert kernels.product_loop.__wrapped__() is None


def test_shapes_are_checked(rng):
    L = dp.laplacian(GRID)
    L(rng.standard_normal(GRID.shape))
    with pytest.raises(dp.errors.ShapeError, match="takes a field on cells"):
        L.bound(np.zeros((5, 6)))
    for wrong in (np.zeros((5, 6)), np.zeros(30)):
        with pytest.raises(dp.errors.ShapeError, match="takes a field on cells"):
            L(wrong)


def test_strided_arguments(rng):
    L = dp.laplacian(GRID)
    u = rng.standard_normal(GRID.shape)
    wanted = L(u).tobytes()
    assert L(np.asfortranarray(u)).tobytes() == wanted
    assert L(np.repeat(u, 2, axis=1)[:, ::2]).tobytes() == wanted


def test_the_functions_are_not_pickled_and_hold_no_operator(rng):
    L = dp.laplacian(GRID)
    size = len(pickle.dumps(L))
    for lead in range(100):
        L(rng.standard_normal((lead, *GRID.shape)))
    assert len(pickle.dumps(L)) == size and len(L._bound) <= 64
    dead = weakref.ref(L)
    gc.disable()
    try:
        del L
        assert dead() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("method", ["separable", "direct"])
def test_inverses(method, rng):
    inv = dp.inverse(-dp.laplacian(GRID, dp.dirichlet), method)
    b = rng.standard_normal((2, *GRID.shape))
    for op in (inv, inv.T):
        assert op.bound(b[0])(b[0]).tobytes() == op(b[0]).tobytes() == op(b)[0].tobytes()
        assert op.apply(b[0], out=np.empty(GRID.shape)).tobytes() == op(b[0]).tobytes()
