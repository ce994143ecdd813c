"""The compiled loops of the structured multigrid against dense matrices, on small grids of every kind."""

from itertools import product

import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels

pytestmark = pytest.mark.skipif(not kernels.compiled(), reason="structured multigrid needs numba")

GRIDS = [((6, 5), (False, False)), ((8, 6), (True, True)), ((17, 4), (False, True)), ((12, 12), (True, False))]
GRIDS += [
    ((5, 4, 6), (False,) * 3),
    ((8, 4, 6), (True, True, False)),
    ((6, 6, 8), (True,) * 3),
    ((9, 1, 8), (False,) * 3),
]


def level_of(shape, periodic, rng):
    """A finest level with random coefficients, and its engine."""
    from sparsedp.solvers.multigrid.levels import Level
    from sparsedp.solvers.multigrid.spread import Spread

    grid = dp.Grid(shape, spacing=[rng.uniform(0.5, 2, n) for n in shape], periodic=periodic)
    faces = dp.diagonal(grid.faces, rng.uniform(0.1, 9.0, grid.faces.size))
    op = 0.3 * dp.identity(grid.cells) - dp.divergence(grid) @ faces @ dp.gradient(grid, dp.dirichlet)
    engine = dp.inverse(op, "structured", precision="double").solver.engine
    from sparsedp.solvers.multigrid.reading import stencil_of
    from sparsedp.solvers.system import System

    stencil, spread = stencil_of(System(op)), Spread(grid)
    return Level(spread.natural(stencil, np.zeros(grid.cells.size, bool)), finest=True), engine


def matrix_of(function, rows, columns):
    """A linear function of fields in natural order -> its matrix."""
    return np.stack([function(unit.reshape(columns)).reshape(-1) for unit in np.eye(np.prod(columns))], axis=1).reshape(
        np.prod(rows), np.prod(columns)
    )


def dense(natural, extras=True):
    """Natural -> its matrix."""
    number = np.arange(natural.free.size).reshape(natural.shape)
    matrix = np.diag(natural.extra.reshape(-1)) if extras else np.zeros((number.size,) * 2)
    for links, step in zip(natural.links, natural.steps, strict=True):
        there = np.roll(number, [-d for d in step], range(number.ndim))
        for i, j, a in zip(number.flat, there.flat, links.flat, strict=True):
            matrix[i, i], matrix[j, j] = matrix[i, i] + a, matrix[j, j] + a
            matrix[i, j], matrix[j, i] = matrix[i, j] - a, matrix[j, i] - a
    return matrix


def prolongation(level, weights):
    """The weights as a matrix, by the definition of the tables."""
    from sparsedp.solvers.multigrid.interpolation import Transfer

    layout = level.layout
    colours, rows = range(len(layout.colours)), Transfer(layout, range(len(layout.colours))).rows
    coarse = layout.wrap(layout.zeros(1))

    def interpolated(values):
        layout.cells(coarse[0], 0)[...] = values
        layout.wrap(coarse)
        field = layout.zeros(len(colours))
        for weight, (colour, _, far) in zip(weights, rows, strict=False):
            layout.body(field[colour])[:] += layout.body(weight) * layout.body(coarse[0], far)
        return level.in_order(field)

    return matrix_of(interpolated, layout.shape, layout.halves)


@pytest.mark.parametrize("shape, periodic", GRIDS)
def test_the_coarse_matrix_is_that_of_galerkin(shape, periodic, rng):
    """Of the links; extras are summed up by rows, which keeps them on the diagonal."""
    from sparsedp.solvers.multigrid.coarsening import Natural, coarsened
    from sparsedp.solvers.multigrid.interpolation import interpolated

    level, _ = level_of(shape, periodic, rng)
    layout, count = level.layout, len(level.layout.colours)
    weights = interpolated(level)
    P, found = prolongation(level, weights), coarsened(level, weights)
    links = np.stack([level.in_order(level.links[m : m + count]) for m in range(0, len(level.links) - count, count)])
    steps, nothing = np.eye(layout.dim, dtype=int), np.zeros(layout.shape)
    extra = level.in_order(level.extra)
    A = dense(Natural(layout.shape, layout.periodic, [tuple(s) for s in steps], links, extra, nothing), extras=False)
    wanted = P.T @ A @ P + np.diag(P.T @ (extra.reshape(-1) * P.sum(axis=1)))
    assert np.max(np.abs(dense(found) - wanted)) <= 1e-13 * np.max(np.abs(wanted))


@pytest.mark.parametrize("shape, periodic", GRIDS)
def test_the_cycle_is_symmetric_and_positive(shape, periodic, rng):
    _, engine = level_of(shape, periodic, rng)
    fine, layout = engine.fine, engine.fine.layout
    red = np.zeros(layout.shape, bool)
    for q in fine.red:
        red[layout.natural(q)] = True
    held = red & (engine.factors[1] > 0.0)
    r, z = layout.zeros(2, len(fine.red))

    def cycle(field):
        layout.split(field, r, fine.red)
        layout.wrap(r)
        fine.x[...] = fine.over * r
        fine.precondition(r, z, engine.sums)
        out = np.zeros(layout.shape)
        layout.merge(z, fine.red, out)
        return out

    M = matrix_of(cycle, layout.shape, layout.shape)[np.ix_(held.reshape(-1), held.reshape(-1))]
    assert np.max(np.abs(M - M.T)) <= 1e-12 * np.max(np.abs(M))
    assert np.linalg.eigvalsh(M + M.T).min() > 0.0


@pytest.mark.parametrize("shape", [(5, 4), (5, 4, 3)])
def test_every_neighbour_is_where_the_layout_says(shape, rng):
    from sparsedp.solvers.multigrid.layout import Layout

    for periodic in product((False, True), repeat=len(shape)):
        shape = tuple(n + n % 2 if flag else n for n, flag in zip(shape, periodic, strict=True))
        layout, field = Layout(shape, periodic), rng.standard_normal(shape)
        colours = range(len(layout.colours))
        rows = layout.zeros(len(colours))
        layout.split(field, rows, colours)
        layout.wrap(rows)
        for step in product((-1, 0, 1), repeat=len(shape)):
            beside, shifted = layout.zeros(len(colours)), np.empty(shape)
            for q in colours:
                colour, far = layout.neighbour(q, step)
                layout.body(beside[q])[:] = layout.body(rows[colour], far)
            layout.merge(beside, colours, shifted)
            wanted = np.roll(field, [-d for d in step], range(len(shape)))
            for axis, (n, d, flag) in enumerate(zip(shape, step, periodic, strict=True)):
                if d and not flag:
                    np.moveaxis(wanted, axis, 0)[n - 1 if d > 0 else 0] = 0.0
            assert np.array_equal(shifted, wanted)
