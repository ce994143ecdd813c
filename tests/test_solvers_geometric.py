"""Geometric hierarchies: exact transpose, rates, null spaces, refusals."""

import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels
from sparsedp.solvers.amg import geometric_levels


def smooth(shape, boundary, periodic=False):
    grid = dp.Grid(shape, spacing=[1 + 0.4 * np.sin(np.arange(n)) for n in shape], periodic=periodic)
    k = 1 + 0.5 * np.prod([np.sin(0.1 * x) for x in grid.centres()], axis=0)
    faces = dp.diagonal(grid.faces, dp.harmonic_average(grid)(k))
    return -dp.divergence(grid) @ faces @ dp.gradient(grid, boundary)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann])
@pytest.mark.parametrize("shape", [(300,), (64, 64), (65, 47), (18, 17, 16), (1, 130)])
def test_iterations_and_solution(shape, boundary, periodic, rng):
    op = smooth(shape, boundary, periodic)
    inv = dp.inverse(op, "multigrid", hierarchy="geometric", nullspace="project")
    other = dp.inverse(op, "direct", nullspace="project")
    b = rng.standard_normal(shape)
    x, y = inv(b), inv.T(b)
    assert inv.info.forward.iterations <= 20 and inv.info.adjoint.iterations <= 20
    for mine, theirs in ((x, other(b)), (y, other.T(b))):
        assert np.max(np.abs(mine - theirs)) <= 1e-7 * np.max(np.abs(theirs))


@pytest.mark.parametrize("cycle", ["V", "W"])
@pytest.mark.parametrize("sweeps", [(("forward",), ("backward",)), (("forward", "backward"), ("forward",))])
def test_the_transposed_cycle_is_exact(cycle, sweeps, rng):
    grid = dp.Grid((40, 37), size=1.0)
    op = 20 * dp.upwind(grid, 0, 1, dp.dirichlet) - dp.laplacian(grid, dp.dirichlet)
    inv = dp.inverse(op, "multigrid", hierarchy="geometric", cycle=cycle, sweeps=sweeps)
    forward = inv.solver.engine.forward
    b, g = rng.standard_normal((2, op.domain.size))
    x, y = forward.cycle(b), forward.transpose().cycle(g)
    assert len(forward.levels) >= 3
    assert abs(x @ g - b @ y) <= 1e-14 * np.linalg.norm(x) * np.linalg.norm(g)
    field = rng.standard_normal(grid.shape)
    inv(field), inv.T(field)
    assert inv.info.adjoint.iterations <= 1.2 * inv.info.forward.iterations + 1


def test_interpolation_keeps_constants_and_lines():
    grid = dp.Grid((23, 16), spacing=[np.linspace(1, 2, 23), np.ones(16)], periodic=(False, True))
    levels = geometric_levels((-dp.laplacian(grid)).matrix, grid, 25, 20)
    for _, P, R in levels[:-1]:
        assert P @ np.ones(P.shape[1]) == pytest.approx(1.0) and abs(P.T - R).nnz == 0
        assert P.indices.dtype == np.int32
    assert len(levels) >= 4 and levels[-1][1] is None


def test_auto_takes_pairs_of_cells_in_3d_without_numba(monkeypatch, rng):
    """For coefficients and cells that are even; not for jumps, flat cells or obstacles, nor in 2-D."""
    monkeypatch.setattr(kernels, "compiled", lambda: False)
    cube = dp.Grid((26, 25, 24), size=1.0)
    k = 1 + 0.5 * np.prod([np.sin(5 * x) for x in cube.centres()], axis=0)

    def chosen(grid, k, **options):
        faces = dp.diagonal(grid.faces, dp.harmonic_average(grid)(k))
        return dp.inverse(-dp.divergence(grid) @ faces @ dp.gradient(grid, dp.dirichlet, **options))

    even = chosen(cube, k)
    assert "levels from pairs of cells" in even.reason and "15600 > 2028 > 294" in even.info.hierarchy
    b = rng.standard_normal(cube.shape)
    even(b), even.T(b)
    assert max(even.info.forward.iterations, even.info.adjoint.iterations) <= 14
    solid = np.zeros(cube.shape, bool)
    solid[9:12, 9:12, 9:12] = True
    flat = dp.Grid(cube.shape, size=(1.0, 1.0, 0.1))
    for other in (chosen(cube, np.where(solid, 1e3, k)), chosen(flat, k), chosen(cube, k, solid=solid)):
        assert other.method == "multigrid" and "pairs of cells" not in other.reason


def test_refusals():
    op = dp.from_matrix(np.diag([1.0, 2.0]))
    with pytest.raises(
        ValueError,
        match="a geometric hierarchy needs an operator on the cells of a grid, .* is not; write hierarchy='algebraic'",
    ):
        dp.inverse(op, "multigrid", hierarchy="geometric")
    with pytest.raises(ValueError, match="hierarchy must be 'algebraic' or 'geometric', got 'both'"):
        dp.inverse(op, "multigrid", hierarchy="both")
