"""Order of accuracy of solutions of Poisson's equation: manufactured, not an eigenfunction, data by lift."""

import numpy as np
import pytest
from fields import Field, grid_of

import sparsedp as dp

SIDES = {
    "dirichlet": (dp.dirichlet, False),
    "neumann": (dp.neumann, False),
    "periodic": (dp.neumann, True),
    "robin": (dp.robin(1.0, 0.7), False),
    "mixed": ({"x": (dp.dirichlet, dp.neumann), "y": (dp.robin(2.0, 1.0), dp.dirichlet)}, False),
}


def error(n, dim, boundary, periodic, stretched):
    """L2 error of the solution of lap u = f on n^dim cells; constants do not count where they are free."""
    grid = grid_of(n, dim, periodic, stretched)
    field = Field(periodic)
    boundary = {a: s for a, s in boundary.items() if a in grid.axes} if isinstance(boundary, dict) else boundary
    exact = field(grid.centres())
    D = dp.divergence(grid)
    source = field.laplacian(grid, boundary)[1]
    source = source - D(dp.lift(grid, boundary)(field.wall_values(grid, boundary)))
    u = dp.inverse(D @ dp.gradient(grid, boundary), nullspace="project")(source)
    gap = u - exact
    if boundary is dp.neumann:
        gap = gap - np.sum(grid.volumes * gap) / np.sum(grid.volumes)
    return np.sqrt(np.sum(grid.volumes * gap**2))


@pytest.mark.sampled
@pytest.mark.parametrize("stretched", [False, True], ids=["uniform", "stretched"])
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kind", SIDES)
def test_solutions_are_of_second_order(kind, dim, stretched):
    sizes = {1: (64, 128, 256), 2: (32, 64, 128), 3: (16, 24, 32)}[dim]
    errors = [error(n, dim, *SIDES[kind], stretched) for n in sizes]
    assert 1.9 <= -np.polyfit(np.log(sizes), np.log(errors), 1)[0] <= 2.2, errors


def test_poisson_square():
    """Case B1: -lap u = 1 on the unit square; middle and integral to 5e-4 at 128^2, order 2."""
    gaps = []
    for n in (32, 64, 128):
        grid = dp.Grid((n, n), size=1.0)
        u = dp.inverse(-dp.laplacian(grid, dp.dirichlet))(np.ones(grid.shape))
        middle = dp.sample(grid, [[0.5, 0.5]])(u)[0]
        gaps.append([abs(middle / 0.07367135328151 - 1), abs(np.sum(grid.volumes * u) / 0.03514425373879 - 1)])
    assert max(gaps[-1]) <= 5e-4
    orders = np.log2(np.array(gaps[1]) / gaps[2])
    assert np.all((orders >= 1.9) & (orders <= 2.2)), orders
