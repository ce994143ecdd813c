"""The compiled loops of the structured multigrid against dense matrices, on small grids of every kind."""

from itertools import product

import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels

pytestmark = pytest.mark.skipif(not kernels.compiled(), reason="structured multigrid needs numba")

GRIDS = [
    ((7, 9), (True, True)),
    ((6, 5), (False, False)),
    ((8, 6), (True, True)),
    ((17, 4), (False, True)),
    ((12, 12), (True, False)),
]
GRIDS += [
    ((5, 4, 6), (False,) * 3),
    ((8, 4, 6), (True, True, False)),
    ((6, 6, 8), (True,) * 3),
    ((9, 1, 8), (False,) * 3),
]


def engine_of(shape, periodic, rng):
    """Return the engine of an operator with random coefficients."""
    grid = dp.Grid(shape, spacing=[rng.uniform(0.5, 2, n) for n in shape], periodic=periodic)
    faces = dp.diagonal(grid.faces, rng.uniform(0.1, 9.0, grid.faces.size))
    op = 0.3 * dp.identity(grid.cells) - dp.divergence(grid) @ faces @ dp.gradient(grid, dp.dirichlet)
    return dp.inverse(op, "structured", precision="double").solver.engine


def matrix_of(function, rows, columns):
    """Return the matrix of a linear function of fields in natural order."""
    images = [function(unit.reshape(columns)).reshape(-1) for unit in np.eye(np.prod(columns))]
    return np.stack(images, axis=1).reshape(np.prod(rows), np.prod(columns))


def dense(level, extras=True):
    """Return the matrix of a level."""
    cells = level.grid.cells
    number = np.arange(cells(level.extra).size).reshape(level.grid.shape)
    matrix = np.zeros((number.size, number.size))
    if extras:
        matrix += np.diag(cells(level.extra).reshape(-1))
    for links, step in zip(cells(level.links), level.steps, strict=True):
        neighbour = np.roll(number, [-d for d in step], range(number.ndim))
        for i, j, a in zip(number.flat, neighbour.flat, links.flat, strict=True):
            matrix[i, i] += a
            matrix[j, j] += a
            matrix[i, j] -= a
            matrix[j, i] -= a
    return matrix


def prolongation(level):
    """Return the black-box interpolation as a matrix, and the transfer."""
    from sparsedp.solvers.structured_multigrid.cycle import Transfer, interpolation_weights

    fine = level.grid
    coarse = level.grid.coarse()
    transfer = Transfer(fine, coarse, interpolation_weights(level))

    def interpolated_field(values):
        field = coarse.zeros()
        coarse.cells(field)[...] = values
        return fine.cells(transfer.prolong(coarse.fill_ghosts(field), fine.zeros()))

    return matrix_of(interpolated_field, fine.shape, coarse.shape), transfer


@pytest.mark.parametrize("shape, periodic", GRIDS)
def test_the_coarse_matrix_is_the_galerkin_product(shape, periodic, rng):
    """For the links; the extras are summed by rows, so they stay on the diagonal. Two levels: 5 points, then 9."""
    level = engine_of(shape, periodic, rng).level
    for _ in range(2):
        P, _ = prolongation(level)
        expected = P.T @ dense(level, extras=False) @ P
        extra = level.grid.cells(level.extra).reshape(-1)
        level, _ = level.coarsened()
        expected += np.diag(P.T @ (extra * P.sum(axis=1)))
        assert np.max(np.abs(dense(level) - expected)) <= 1e-13 * np.max(np.abs(expected))


@pytest.mark.parametrize("shape, periodic", GRIDS)
def test_restriction_is_the_transpose_of_interpolation(shape, periodic, rng):
    level = engine_of(shape, periodic, rng).level
    P, transfer = prolongation(level)
    fine = level.grid
    coarse = level.grid.coarse()

    def restricted(values):
        field = fine.zeros()
        fine.cells(field)[...] = values
        return coarse.cells(transfer.restrict(fine.fill_ghosts(field), coarse.zeros()))

    assert np.max(np.abs(matrix_of(restricted, coarse.shape, fine.shape) - P.T)) <= 1e-14


@pytest.mark.parametrize("shape, periodic", GRIDS)
def test_the_cycle_is_symmetric_and_positive(shape, periodic, rng):
    engine = engine_of(shape, periodic, rng)
    fine = engine.finest
    grid = engine.padded_grid
    is_unknown = grid.cells(engine.level.root_diagonal).reshape(-1) > 0.0

    def cycle(field):
        fine.b[...] = 0.0
        grid.cells(fine.b)[...] = field
        grid.fill_ghosts(fine.b)
        fine.cycle()
        return grid.cells(fine.x)

    M = matrix_of(cycle, grid.shape, grid.shape)[np.ix_(is_unknown, is_unknown)]
    assert np.max(np.abs(M - M.T)) <= 1e-12 * np.max(np.abs(M))
    assert np.linalg.eigvalsh(M + M.T).min() > 0.0


@pytest.mark.parametrize("shape", [(5, 4), (5, 4, 3)])
def test_steps_lead_to_the_neighbours(shape, rng):
    from sparsedp.solvers.structured_multigrid.loops import PaddedGrid

    for periodic in product((False, True), repeat=len(shape)):
        grid = PaddedGrid(shape, periodic)
        values = rng.standard_normal(shape)
        field = grid.zeros()
        grid.cells(field)[...] = values
        grid.fill_ghosts(field)
        for step in product((-1, 0, 1), repeat=len(shape)):
            expected = np.roll(values, [-d for d in step], range(len(shape)))
            for axis, (n, d, flag) in enumerate(zip(shape, step, periodic, strict=True)):
                if d and not flag:
                    end = n - 1 if d > 0 else 0
                    np.moveaxis(expected, axis, 0)[end] = 0.0
            assert np.array_equal(grid.cells(field, step), expected)
            second = grid.cells(field, step, 2)
            assert np.array_equal(second, expected[(slice(None, None, 2),) * len(shape)])
