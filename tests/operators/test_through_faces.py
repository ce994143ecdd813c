"""L diag(k) R in one compiled pass against its entries, on every kind of grid; what is masked; the same bits."""

from itertools import product

import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels
from sparsedp.operators.structure import lazy
from sparsedp.solvers.parametric import Elliptic

pytestmark = pytest.mark.skipif(not kernels.compiled(), reason="the fused pass needs numba")

SHAPES = [(2, 2), (7, 5), (16, 17), (2, 3, 2), (5, 4, 6), (8, 2, 5)]


@pytest.fixture(autouse=True)
def at_every_size(monkeypatch):
    monkeypatch.setattr(lazy, "FUSED_FROM", 0)
    monkeypatch.setattr(lazy, "ROW_FROM", 0)


def chain(grid, k, boundary=dp.dirichlet):
    return -dp.divergence(grid) @ dp.diagonal(grid.faces, k) @ dp.gradient(grid, boundary)


@pytest.mark.whole
@pytest.mark.parametrize("shape", SHAPES)
def test_forward_and_transposed_against_the_entries(shape, rng):
    for periodic, boundary in product(product((False, True), repeat=len(shape)), (dp.neumann, dp.robin(1, 2))):
        grid = dp.Grid(shape, spacing=[rng.uniform(0.5, 2, n) for n in shape], periodic=periodic)
        solid = -dp.laplacian(grid, boundary, rng.random(shape) < 0.3)
        for op in (chain(grid, rng.uniform(0.1, 9, grid.faces.size), boundary), solid):
            for structure in (op.structure, op.structure.transpose()):
                assert structure._fused is not None
                x = rng.standard_normal(grid.cells.size)
                matrix = structure.explicit()
                wrong = np.abs(structure.product(x) - matrix @ x)
                assert np.max(wrong) <= 1e-15 * np.max(abs(matrix) @ np.abs(x))


def test_masked_faces_exclude_nan(rng):
    grid = dp.Grid((6, 5))
    solid = np.zeros((6, 5), bool)
    solid[2:4, 1:3] = True
    op = dp.laplacian(grid, dp.neumann, solid)
    u = rng.standard_normal((6, 5))
    spoilt = np.where(solid, np.nan, u)
    assert np.array_equal(op(spoilt)[~solid], op(np.where(solid, 0.0, u))[~solid])


def test_a_zero_coefficient_passes_nan_on(rng):
    grid = dp.Grid((6, 5))
    k = rng.uniform(1, 2, grid.faces.size)
    k[10] = 0.0
    u = rng.standard_normal((6, 5))
    u[2, 2] = np.nan
    op = chain(grid, k)
    passes = op.structure.members
    one_after_the_other = passes[0].product(passes[1].product(passes[2].product(u.reshape(-1))))
    assert np.array_equal(np.isnan(op(u)), np.isnan(one_after_the_other.reshape(u.shape)))


def test_other_products_are_applied_member_by_member():
    grid = dp.Grid((6, 5))
    line = dp.Grid(8)
    middle = dp.diagonal(grid.faces, np.ones(grid.faces.size) * 1j)
    for op in (
        -dp.divergence(grid) @ middle @ dp.gradient(grid),
        dp.gradient(grid) @ dp.diagonal(grid.cells, np.ones((6, 5))) @ dp.divergence(grid),
        chain(line, np.ones(9)),
    ):
        assert not isinstance(op.structure, lazy.Chain) or op.structure._fused is None


def test_the_same_bits_with_one_thread_and_two(rng):
    grid = dp.Grid((90, 80, 75))
    op = chain(grid, rng.uniform(1, 2, grid.faces.size))
    u = rng.standard_normal(grid.shape)
    found = []
    for threads in (1, None):
        dp.set_threads(threads)
        found.append(op(u))
    assert np.array_equal(*found)


def test_a_parametric_operator_acts_in_one_pass(rng):
    """shift - D diag(k) G, as `elliptic_solver` applies it, forward and transposed."""
    grid = dp.Grid((6, 5), spacing=[rng.uniform(0.5, 2, n) for n in (6, 5)])
    op = Elliptic(-dp.divergence(grid), dp.gradient(grid, dp.robin(1, 2)), rng.uniform(0.1, 9, grid.faces.size), 0.7)
    for structure in (op, op.transpose()):
        assert structure.members[1]._fused is not None
        x = rng.standard_normal(grid.cells.size)
        matrix = structure.explicit()
        assert np.max(np.abs(structure.product(x) - matrix @ x)) <= 2e-15 * np.max(abs(matrix) @ np.abs(x))
