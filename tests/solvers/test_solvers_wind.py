"""Not symmetric: advection by winds of any strength, with the wind, around a vortex, and against it."""

import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording

ConvergenceError = dp.errors.ConvergenceError


def across(n, strength, upwards=-1):
    """Along x and down y; with `upwards` = 1 the slopes in y are taken on the lee side."""
    grid = dp.Grid((n, n), size=1.0)
    flow = dp.upwind(grid, 0, 1, dp.dirichlet) + 0.5 * upwards * dp.upwind(grid, 1, -1, dp.dirichlet)
    return strength * flow - dp.laplacian(grid, dp.dirichlet)


def vortex(n, strength):
    """Closed streamlines without inflow or outflow."""
    grid = dp.Grid((n, n), size=1.0)
    x, y = np.meshgrid(*[np.linspace(0.0, 1.0, n + 1)] * 2, indexing="ij")
    v = strength * dp.curl(grid)((np.sin(np.pi * x) * np.sin(np.pi * y)) ** 2)
    dt = 0.1 / (strength * n)
    rate = (dp.identity(grid.cells) - dp.transport(grid, "upwind").operator(v, dt)) * (1 / dt)
    return rate - dp.laplacian(grid, dp.dirichlet)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("strength", [20.0, 500.0, 1e5])
@pytest.mark.parametrize("make", [across, vortex])
@pytest.mark.parametrize("n", [60, 100])
def test_strong_winds(n, make, strength, rng):
    """Forward and adjoint solves take the same number of iterations, within 20 %, with one set-up."""
    op = make(n, strength)
    with recording() as calls:
        inv = dp.inverse(op, "multigrid")
        b, g = rng.standard_normal((2, n, n))
        x = inv(b)
        y = inv.T(g)
    forward = inv.info.forward
    adjoint = inv.info.adjoint
    assert calls[inv.name, "setup"] == 1 and {forward.status, adjoint.status} == {"converged"}
    assert forward.iterations <= 20 and abs(adjoint.iterations - forward.iterations) <= 0.2 * forward.iterations
    assert abs(np.vdot(x, g) - np.vdot(b, y)) <= 1e-8 * np.linalg.norm(x) * np.linalg.norm(g)


def test_auto_keeps_factors_of_a_small_windy_system(rng):
    op = across(60, 500.0)
    inv = dp.inverse(op)
    x = rng.standard_normal((60, 60))
    assert inv.method == "direct"
    assert inv(op(x)) == pytest.approx(x, rel=1e-9, abs=1e-9)
    assert inv.T(op.T(x)) == pytest.approx(x, rel=1e-9, abs=1e-9)


def test_slopes_on_the_lee_side_are_refused():
    """Solutions grow from wall to wall: with 40 cells the condition number is 1e17, and no digit would be right."""
    op = across(40, 500.0, upwards=1)
    with pytest.raises(ConvergenceError, match="or its condition number is beyond 1e14; add a shift, or remove the"):
        dp.inverse(op)
    inv = dp.inverse(op, "multigrid")
    for solve in (inv, inv.T):
        with pytest.raises(ConvergenceError, match=r"relative residual .* \(stagnated\)"):
            solve(np.ones((40, 40)))
