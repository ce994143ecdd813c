"""The largest stable step of explicit methods, against the eigenvalues of dense matrices and against repeated steps."""

import math

import numpy as np
import pytest

import sparsedp as dp
from sparsedp.integrators import stability
from sparsedp.integrators.runge_kutta import EXPLICIT

CONDITIONS = {
    "dirichlet": dp.dirichlet,
    "neumann": dp.neumann,
    "robin": dp.robin(1.0, 0.3),
    "mixed": {"x": (dp.dirichlet, dp.robin(2.0, 1.0))},
}
GRIDS = {
    "line": dp.Grid(16),
    "plane": dp.Grid((7, 9)),
    "channel": dp.Grid((7, 8), size=(1.0, 3.0), periodic=(False, True)),
}


def growth(op, h, order):
    """Return the largest |R(h w)| over the eigenvalues w of an operator."""
    z = h * np.linalg.eigvals(op.matrix.toarray())
    return np.max(np.abs(sum(z**k / math.factorial(k) for k in range(order + 1))))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", EXPLICIT)
@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
@pytest.mark.parametrize("boundary", CONDITIONS.values(), ids=CONDITIONS)
def test_the_limit_of_order_4_between_walls(boundary, grid, method):
    op = dp.laplacian(grid, boundary, order=4)
    order = EXPLICIT[method].order
    limit = stability.largest_step(op, EXPLICIT[method])
    assert growth(op, 0.999 * limit, order) <= 1 + 1e-9
    assert growth(op, 1.001 * limit, order) > 1 + 1e-4
    for product in (dp.divergence(grid, order=4) @ dp.gradient(grid, boundary, order=4), op.explicit()):
        assert stability.largest_step(product, EXPLICIT[method]) == pytest.approx(limit, rel=2e-6)


@pytest.mark.parametrize("method, factor", [("euler", 0.6), ("heun", 0.6), ("ssprk3", 0.6), ("rk4", 0.6)])
def test_unstable_steps_of_order_4_are_refused(method, factor):
    """With dt = 0.6 h^2, 300 steps of Euler's method would grow to 2.8e103."""
    grid = dp.Grid(16)
    u = np.cos(np.arange(16.0) ** 2)
    op = dp.laplacian(grid, dp.dirichlet, order=4)
    with pytest.raises(dp.errors.UnstableStepError, match=f"{method} is unstable for laplacian with dt = 0.6: the lar"):
        dp.stepper(method, op, factor)(u, None)
    allowed = dp.stepper(method, op, factor, unstable="allow")
    assert np.max(np.abs(dp.rollout(allowed, u, None, 300))) > 1e20
    stable = dp.stepper(method, op, 0.999 * stability.largest_step(op, EXPLICIT[method]))
    assert np.max(np.abs(dp.rollout(stable, u, None, 300))) < np.max(np.abs(u))


def test_the_linear_part_of_a_rate_has_a_limit():
    op = dp.laplacian(dp.Grid(16), order=4)
    step = dp.stepper("rk4", lambda u, p: 0.0 * u, 0.6, linear=(op, 0.5))
    assert np.all(np.isfinite(step(np.ones(16), None)))
    step = dp.stepper("rk4", lambda u, p: 0.0 * u, 0.6, linear=(op, 1.0))
    with pytest.raises(dp.errors.UnstableStepError):
        step(np.ones(16), None)


@pytest.mark.parametrize("cells", [16, 600])
def test_upwind_differences_between_walls_have_the_limit_of_the_courant_number(cells):
    """All their eigenvalues are 1, but fields grow as long as they cross the grid; the limits are 1 and 1.3926."""
    op = -dp.upwind(dp.Grid(cells))
    assert stability.largest_step(op, EXPLICIT["euler"]) == pytest.approx(1.0, rel=1e-5)
    assert stability.largest_step(op, EXPLICIT["rk4"]) == pytest.approx(1.392647, rel=1e-5)


def test_the_limits_of_waves_without_damping():
    """Centred differences have the eigenvalues i sin(x): rk4 is stable up to 2.8284, ssprk3 to 1.7321, euler never."""
    one = np.eye(16)
    centred = dp.from_matrix((np.roll(one, -1, 0) - np.roll(one, 1, 0)) / 2)
    assert stability.largest_step(centred, EXPLICIT["rk4"]) == pytest.approx(math.sqrt(8), rel=1e-6)
    assert stability.largest_step(centred, EXPLICIT["ssprk3"]) == pytest.approx(math.sqrt(3), rel=3e-6)
    assert stability.largest_step(centred, EXPLICIT["euler"]) == pytest.approx(math.sqrt(2e-6), rel=1e-3)
    schroedinger = dp.from_matrix(1j * dp.laplacian(dp.Grid(8, periodic=True)).matrix.toarray())
    assert stability.largest_step(schroedinger, EXPLICIT["rk4"]) == pytest.approx(math.sqrt(8) / 4, rel=1e-6)


def test_modes_that_grow_set_no_limit():
    growing = dp.from_matrix(np.array([[0.5, -3.0], [3.0, 0.5]]))
    nilpotent = dp.from_matrix(np.array([[0.0, 1.0], [0.0, 0.0]]))
    for op in (growing, nilpotent):
        assert stability.largest_step(op, EXPLICIT["euler"]) == np.inf


def test_the_limit_from_ritz_values():
    """A matrix that is not symmetric and has more than 64 rows: its limit has an error below 0.5 %."""
    grid = dp.Grid((30, 20), size=1.0)
    op = dp.laplacian(grid, dp.dirichlet, order=4)
    exact = stability.largest_step(op, EXPLICIT["rk4"])
    assert stability.largest_step(op.explicit(), EXPLICIT["rk4"]) == pytest.approx(exact, rel=5e-3)
