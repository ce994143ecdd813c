"""Singular operators: compatible data, projections, regions, islands, solids."""

import re

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from test_solvers import EVERY, GENERAL, stretched

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.solvers.system import System

INCOMPATIBLE = dp.errors.IncompatibleError


def neumann(grid, solid=None):
    return -dp.divergence(grid) @ dp.gradient(grid, solid=solid)


def weighted_mean(grid, x):
    return np.sum(grid.volumes * x) / np.sum(grid.volumes)


# ---------------------------------------------------------------- defects


@pytest.mark.sampled
@EVERY
@pytest.mark.parametrize("grid", [dp.Grid((20, 22)), stretched(20, 22)], ids=["uniform", "stretched"])
@pytest.mark.parametrize("defect", [1e-14, 1e-7, 1.0])
def test_neumann_defects(grid, method, defect, rng):
    """Rounding is accepted, a small defect is recorded, a large one is refused; the weights are the volumes."""
    b = rng.standard_normal(grid.shape)
    b -= weighted_mean(grid, b)
    w = grid.volumes
    b += defect * np.linalg.norm(b) * w / np.linalg.norm(w)
    measured = np.sum(w * b) / np.linalg.norm(w) / np.linalg.norm(b)
    strict, lenient = (dp.inverse(neumann(grid), method, nullspace=word) for word in ("raise", "project"))
    x = lenient(b)
    assert weighted_mean(grid, x) == pytest.approx(0.0, abs=1e-12 * np.max(np.abs(x)))
    assert neumann(grid)(x) == pytest.approx(b - weighted_mean(grid, b), abs=1e-8)
    assert lenient.info.forward.defect == pytest.approx(abs(measured), rel=1e-6, abs=1e-15)
    if defect < 1:
        assert np.array_equal(strict(b), x)
        return
    message = (
        "inverse(-divergence @ gradient) is singular and the right-hand side is not in its range: on component 1 of 1 "
        "(440 cells from (0, 0)) the defect is 7.1e-01, allowed is 1e-06; "
        "subtract the weighted mean or write nullspace='project'"
    )
    with pytest.raises(INCOMPATIBLE, match=re.escape(message)) as caught:
        strict(b)
    assert caught.value.info.status == strict.info.forward.status == "incompatible_rhs"
    assert caught.value.info.defect == pytest.approx(measured, rel=1e-9)


@EVERY
def test_data_almost_in_the_null_space(method, rng):
    """The right-hand side after the projection has to be compatible to its own digits."""
    op = neumann(stretched(20, 22))
    inv = dp.inverse(op, method, nullspace="project")
    b = 1.0 + 1e-11 * rng.standard_normal(op.domain.shape)
    x = inv(b)
    assert inv.info.forward.status == "converged"
    assert op(x) == pytest.approx(b - weighted_mean(op.domain.grid, b), rel=1e-3, abs=1e-15)


@EVERY
def test_cotangents_are_never_refused(method, rng):
    grid = stretched(18, 18)
    inv = dp.inverse(neumann(grid), method)
    ones = np.ones(grid.shape)
    b = rng.standard_normal(grid.shape)
    b -= weighted_mean(grid, b)
    gradient = value_and_grad(lambda b: anp.sum(inv(b)))(b)[1]
    assert np.max(np.abs(gradient)) > 0 and inv.info.adjoint.defect > 0.5
    # The transposed system has volumes and ones exchanged: w is its null vector, ones its test.
    assert np.sum(gradient) == pytest.approx(0.0, abs=1e-9 * np.max(np.abs(gradient)))
    assert not np.any(inv.T(grid.volumes * ones)) and inv.info.adjoint.iterations == 0
    g = rng.standard_normal(grid.shape)
    inv.T(g)
    assert inv.info.adjoint.defect == pytest.approx(abs(g.sum()) / 18 / np.linalg.norm(g), rel=1e-9)
    h = 1e-6 * dp.divergence(grid)(dp.interior(grid)(rng.standard_normal(grid.faces.size)))
    assert np.sum(inv(b + h)) - np.sum(inv(b)) == pytest.approx(np.sum(gradient * h), rel=1e-4)


# ---------------------------------------------------------------- regions


def walled(count):
    """A strip of solid walls that leaves `count` regions, the last one a single cell."""
    solid = np.zeros((count * 5, 9), dtype=bool)
    solid[4::5] = True
    solid[-5:] = True
    solid[-3, 4] = False
    return solid


@GENERAL
@pytest.mark.parametrize("count", [2, 3, 51])
def test_each_region_has_its_own_mean(method, count, rng):
    solid = walled(count)
    grid = dp.Grid(solid.shape, spacing=[1 + 0.3 * np.sin(np.arange(n)) for n in solid.shape])
    op = neumann(grid, solid)
    inv = dp.inverse(op, method)
    regions = [np.s_[5 * n : 5 * n + 4] for n in range(count - 1)]
    assert inv.solver.system.null_space.count == count - 1
    b = np.where(solid, 0.0, rng.standard_normal(grid.shape))
    b[-5:] = 0.0
    for region in regions:
        b[region] -= np.sum((grid.volumes * b)[region]) / np.sum(grid.volumes[region])
    x = inv(b)
    assert not np.any(x[solid]) and x[-3, 4] == 0  # solids and the island are no unknowns
    for region in regions:
        assert np.sum((grid.volumes * x)[region]) == pytest.approx(0.0, abs=1e-9)
        assert op(x)[region] == pytest.approx(b[region], abs=1e-8)
    b[regions[-1]] += 1.0
    with pytest.raises(INCOMPATIBLE, match=rf"on component {count - 1} of {count - 1} \(36 cells from"):
        inv(b)
    g = rng.standard_normal(grid.shape)
    b = rng.standard_normal(grid.shape)
    both = dp.inverse(op, method, nullspace="project")
    assert np.sum(both(b) * g) == pytest.approx(np.sum(b * both.T(g)), rel=1e-9)


def test_rounding_on_a_region_without_data_is_not_refused():
    """Rounding errors of a divergence on a region without data are below the tolerance."""
    grid = dp.Grid((14, 9))
    solid = walled(3)[:14]
    inv = dp.inverse(neumann(grid, solid))
    b = np.zeros(grid.shape)
    b[0, 0], b[0, 1], b[5, 0] = 1.0, -1.0, 1e-17
    inv(b)
    assert inv.info.forward.defect <= 1e-6


@GENERAL
def test_data_in_solids_and_islands(method):
    solid = walled(2)
    grid = dp.Grid(solid.shape)
    b = np.zeros(grid.shape)
    b[7, 4] = 1.0  # the island
    strict, lenient = (dp.inverse(neumann(grid, solid), method, nullspace=word) for word in ("raise", "project"))
    message = (
        "inverse(-divergence @ gradient): the right-hand side must be 0 where there is no unknown (solid or isolated "
        "cells, coefficient 0), but is not in cell (7, 4); set it to 0 or write nullspace='project'"
    )
    with pytest.raises(INCOMPATIBLE, match=re.escape(message)):
        strict(b)
    assert not np.any(lenient(b)) and lenient.info.forward.defect == 1.0
    assert not np.any(strict.T(b))


@GENERAL
def test_solids_with_dirichlet_faces(method, rng):
    """Rows of solid cells hold the flux into them; these cells are left out of the solve."""
    grid = dp.Grid((21, 20), size=1.0)
    x, y = grid.centres()
    solid = (x - 0.5) ** 2 + (y - 0.4) ** 2 < 0.04
    op = -dp.laplacian(grid, dp.neumann, solid, dp.dirichlet)
    inv = dp.inverse(op, method)
    assert inv.solver.system.null_space.count == 0
    open_cells = ~solid.ravel()
    small = op.matrix.toarray()[open_cells][:, open_cells]
    b, g = np.where(solid, 0.0, rng.standard_normal((2, *grid.shape)))
    wanted = np.zeros(grid.shape)
    wanted[~solid] = np.linalg.solve(small, b[~solid])
    assert inv(b) == pytest.approx(wanted, rel=1e-8, abs=1e-10)
    assert np.sum(inv(b) * (g + solid)) == pytest.approx(np.sum(b * inv.T(g + solid)), rel=1e-9)


# ---------------------------------------------------------------- other null vectors


def advection(grid, rng):
    """Advection by a wind that varies, with diffusion, periodic: rows sum to 0, columns do not."""
    speed = dp.diagonal(grid.cells, 1.0 + rng.random(grid.shape))
    return speed @ dp.upwind(grid) - 0.5 * dp.laplacian(grid)


@GENERAL
@pytest.mark.parametrize("turned", [False, True])
def test_a_computed_null_vector(method, turned, rng):
    op = advection(dp.Grid((18, 17), periodic=True), rng)
    op = op.T if turned else op
    inv = dp.inverse(op, method, nullspace="project")
    space = inv.solver.system.null_space
    matrix = op.matrix
    assert space.count == 1
    assert np.max(np.abs(matrix @ space.right)) <= 1e-12 and np.max(np.abs(matrix.T @ space.left)) <= 1e-12
    b, g = rng.standard_normal((2, *op.domain.shape))
    x = inv(b)
    y = inv.T(g)
    assert np.sum(x * g) == pytest.approx(np.sum(b * y), rel=1e-8)
    assert op(x) == pytest.approx(space.project(b.ravel()).reshape(b.shape), abs=1e-8)
    with pytest.raises(INCOMPATIBLE):
        dp.inverse(op, method)(b)


def test_components_of_a_lower_dimension():
    """A gradient along x only: every line is a component of its own."""
    grid = dp.Grid((5, 4))
    line = dp.laplacian(dp.Grid(5)).matrix
    lines = dp.from_matrix(sp.kron(line, sp.eye_array(4)), grid.cells, grid.cells)
    inv = dp.inverse(lines, nullspace="project")
    assert inv.solver.system.null_space.count == 4
    b = np.random.default_rng(0).standard_normal(grid.shape)
    assert inv(b).mean(axis=0) == pytest.approx(np.zeros(4), abs=1e-14)
    assert lines(inv(b)) == pytest.approx(b - b.mean(axis=0))


def test_labels_from_factors_are_those_from_entries():
    grid = dp.Grid((6, 5, 4), periodic=(True, False, False))
    op = dp.laplacian(grid)
    explicit = dp.from_matrix(op.matrix)
    assert System(op).components == System(explicit).components == (None, 1)
    along = dp.upwind(grid, "y")  # every line of cells along y is a component
    one = System(along).components
    other = System(dp.from_matrix(along.matrix)).components
    assert one[1] == other[1] == 24 == len(np.unique(one[0])) == len(np.unique(one[0] * 1000 + other[0]))


FAILURES = [
    ([[1.0, 2.0], [2.0, 4.0]], "setup_failed", "is singular and its null space is neither the constants nor"),
    ([[0.0, 0.0], [1.0, 2.0]], "empty_row", "row 0 of <matrix: space(2) -> space(2), explicit> has no entries"),
    ([[1.0, -1.0], [1.0, -1.0]], "setup_failed", "the null vector of the other side was not found; add a shift"),
    (
        [[2.0, -1.0, -1.0], [2.0, -1.0, -1.0], [1.0, 1.0, -2.0]],
        "setup_failed",
        "the right and the left null vector are orthogonal; add a shift",
    ),
]


@pytest.mark.parametrize("matrix, status, words", FAILURES)
def test_systems_that_cannot_be_solved(matrix, status, words):
    with pytest.raises(dp.errors.ConvergenceError, match=re.escape(words)) as caught:
        dp.inverse(dp.from_matrix(np.array(matrix)), "direct")
    assert caught.value.info.status == status


UNUSED = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, 0.0], [1.0, 1.0, 0.0]])  # no row uses unknown 2, and row 2 has entries


@pytest.mark.parametrize("method", ["auto", "direct", "krylov", "multigrid", "structured", "separable"])
@pytest.mark.parametrize("nullspace", ["raise", "project"])
def test_an_equation_whose_own_unknown_is_not_used_is_refused(method, nullspace):
    """Its unknown is no unknown of the solve, and its row would not be tested."""
    with pytest.raises(
        dp.errors.ConvergenceError,
        match=r"row 2 of .* has entries, but unknown 2 is used in no row, so that this equation would be ignored; "
        r"use the unknown in a row, or leave the equation out: dp.mask\(A.codomain, keep\) @ A",
    ) as caught:
        dp.inverse(dp.from_matrix(UNUSED), method, nullspace=nullspace)
    assert caught.value.info.status == "empty_column"


def test_unused_unknowns_of_other_operators():
    complex_entries = UNUSED.astype(complex)
    single = UNUSED.astype(np.float32)
    scaled = dp.from_matrix([[1.0, 0.0], [1.0, 1.0]]) @ dp.diagonal(dp.from_matrix(np.eye(2)).domain, [1e200, 1e-200])
    wind = dp.upwind(dp.Grid(5), "x").T
    for op in (dp.from_matrix(complex_entries), dp.from_matrix(single), -1e10 * scaled, wind):
        with pytest.raises(dp.errors.ConvergenceError, match="is used in no row"):
            dp.inverse(op)
    solve = dp.matrix_solver(np.ones((3, 3)))
    b = np.array([1.0, 0.3, 0.0])
    with pytest.raises(dp.errors.ConvergenceError, match="is used in no row"):
        value_and_grad(lambda data: anp.sum(solve(data, b)))(UNUSED.ravel())


def test_an_equation_is_left_out_by_a_mask():
    """With the row or the column masked, x solves the other two equations: (2 * 1 + 0.3, 1 + 2 * 0.3) / 3."""
    used = UNUSED.copy()
    used[:, 2] = 1.0
    keep = np.array([True, True, False])
    space = dp.from_matrix(used).domain
    b = np.array([1.0, 0.3, 0.0])
    g = np.array([1.0, -2.0, 5.0])
    rows = dp.mask(space, keep) @ dp.from_matrix(UNUSED)
    for op in (rows, dp.from_matrix(used) @ dp.mask(space, keep), rows @ dp.mask(space, keep)):
        inv = dp.inverse(op)
        assert inv(b) == pytest.approx([2.3 / 3, 1.6 / 3, 0.0])
        assert inv.T(g) == pytest.approx([0.0, -1.0, 0.0], abs=1e-14)


@GENERAL
def test_a_masked_laplacian_leaves_out_the_masked_cells(method, rng):
    grid = stretched(20, 18)
    keep = np.ones(grid.shape, dtype=bool)
    keep[5:8, 6:12] = False
    op = -dp.laplacian(grid, dp.dirichlet)
    mask = dp.mask(grid.cells, keep)
    small = op.matrix.toarray()[keep.ravel()][:, keep.ravel()]
    b = np.where(keep, rng.standard_normal(grid.shape), 0.0)
    expected = np.zeros(grid.shape)
    expected[keep] = np.linalg.solve(small, b[keep])
    declared_by_diagonal = op @ dp.diagonal(grid.cells, keep.astype(float))
    for masked in (op @ mask, mask @ op @ mask, 2.0 * op @ (0.5 * mask), declared_by_diagonal):
        assert dp.inverse(masked, method)(b) == pytest.approx(expected, rel=1e-8, abs=1e-10)


def test_a_singular_sparse_matrix():
    """The scaled Laplacian has a null vector that is neither ones nor volumes."""
    matrix = dp.laplacian(dp.Grid((20, 20))).matrix
    scale = sp.diags_array(1.0 + np.random.default_rng(0).random(400))
    with pytest.raises(dp.errors.ConvergenceError, match="singular") as caught:
        dp.inverse(dp.from_matrix(scale @ matrix @ scale), "direct")
    assert caught.value.info.status == "setup_failed"


# ---------------------------------------------------------------- tiny and empty


@EVERY
@pytest.mark.parametrize("shape", [(1,), (1, 1), (1, 7), (2, 2), (13, 11), (2, 1, 3)])
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann])
def test_small_grids(shape, boundary, method, rng):
    op = -dp.laplacian(dp.Grid(shape), boundary)
    inv = dp.inverse(op, method, nullspace="project")
    matrix = op.matrix.toarray()
    b = rng.standard_normal(shape)
    wanted = np.linalg.pinv(matrix, rcond=1e-10) @ b.ravel()
    assert inv(b).ravel() == pytest.approx(wanted, rel=1e-8, abs=1e-9)
    assert inv.T(b).ravel() == pytest.approx(wanted, rel=1e-8, abs=1e-9)


@EVERY
def test_systems_without_unknowns(method):
    grid = dp.Grid((4, 3))
    inv = dp.inverse(neumann(grid, np.ones(grid.shape, dtype=bool)), method)
    assert not np.any(inv(np.zeros(grid.shape))) and not np.any(inv.T(np.ones(grid.shape)))
    with pytest.raises(INCOMPATIBLE):
        inv(np.ones(grid.shape))
    empty = dp.inverse(neumann(dp.Grid((0, 3))), method)
    assert empty(np.zeros((0, 3))).shape == (0, 3) and empty.T(np.zeros((0, 3))).shape == (0, 3)
    assert "no unknowns" in str(empty)


@pytest.mark.parametrize("share, stretched", [(0.45, False), (0.6, False), (0.6, True)])
def test_multigrid_ignores_rounding_residues(share, stretched):
    """A region of one unknown on a coarse level has a row of rounding errors there, and no equation."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        spacing = (rng.uniform(0.5, 2.0, 30), rng.uniform(0.5, 2.0, 26)) if stretched else None
        grid = dp.Grid((30, 26), spacing=spacing)
        solid = rng.random(grid.shape) < share
        laplacian = dp.laplacian(grid, solid=solid)
        inv = dp.inverse(-laplacian, "multigrid", nullspace="project")
        wanted = -laplacian(rng.standard_normal(grid.shape))
        assert np.linalg.norm(-laplacian(inv(wanted)) - wanted) <= 1e-9 * np.linalg.norm(wanted)
        assert inv.T(wanted).any() and inv.info.adjoint.iterations <= 12
