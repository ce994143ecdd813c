"""Anisotropy and flat cells where no transform applies: around obstacles, and with coefficients that vary."""

import numpy as np
import pytest

import sparsedp as dp

N = 96


def balls(grid):
    x, y = (c / (c.flat[0] + c.flat[-1]) for c in grid.centres())
    return (x % (1 / 3) - 1 / 6) ** 2 + (y % (1 / 3) - 1 / 6) ** 2 < 0.01


def weak(boundary):
    """k is 1e-6 along y."""
    grid = dp.Grid((N, N), size=1.0)
    k = dp.diagonal(grid.faces, grid.join(1.0, 1e-6))
    return -dp.divergence(grid) @ k @ dp.gradient(grid, boundary, balls(grid))


def flat(boundary):
    """Cells 1e4 times as long as high."""
    grid = dp.Grid((N, N), size=(1.0, 1e-4))
    return -dp.laplacian(grid, boundary, balls(grid))


def clustered(boundary):
    """Cells from 1 to 1e5 high."""
    heights = np.geomspace(1e-5, 1.0, N)
    grid = dp.Grid((N, N), spacing=(1 / N, heights / heights.sum()))
    return -dp.laplacian(grid, boundary, balls(grid))


def varied(boundary):
    """Flat cells, and k between 0.1 and 1.9."""
    grid = dp.Grid((N, N), size=(1.0, 1e-4))
    x, y = grid.centres()
    k = dp.diagonal(grid.faces, dp.harmonic_average(grid)(1 + 0.9 * np.sin(9 * x) * np.sin(9e4 * y)))
    return -dp.divergence(grid) @ k @ dp.gradient(grid, boundary)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann], ids=str)
@pytest.mark.parametrize("make", [weak, flat, clustered, varied])
def test_thin_scenes(make, boundary, rng):
    """Few iterations, forward and adjoint (limit 30); auto takes none with point smoothing."""
    op = make(boundary)
    b = op(rng.standard_normal((N, N)))
    g = rng.standard_normal((N, N))
    auto, multigrid = (dp.inverse(op, method, nullspace="project") for method in ("auto", "multigrid"))
    assert auto.method == "direct"
    for inv in (auto, multigrid):
        x = inv(b)
        y = inv.T(g)
        for record in (inv.info.forward, inv.info.adjoint):
            assert record.iterations <= 15 and record.status.startswith("converged")
        left = inv.info.adjoint.residual * np.linalg.norm(x) * np.linalg.norm(g)  # x.g - b.y is x.(g - A^T y) + ...
        left += inv.info.forward.residual * np.linalg.norm(b) * np.linalg.norm(y)
        assert abs(np.vdot(x, g) - np.vdot(b, y)) <= 1.01 * left + 1e-13 * np.linalg.norm(b) * np.linalg.norm(y)


def test_thin_scenes_in_elliptic_solver_go_to_multigrid(rng):
    """Few solves are expected for each coefficient: neither LU nor point smoothing is chosen."""
    grid = dp.Grid((160, 150), size=(1.0, 1e-4))
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    solve(rng.uniform(1.0, 2.0, grid.faces.size), rng.standard_normal(grid.shape))
    assert "multigrid" in str(solve) and solve.info.forward.iterations <= 15
