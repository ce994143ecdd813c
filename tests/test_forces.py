"""flux, forces and brinkman: sums that telescope, the drag of a cylinder, derivatives in its shape, refusals."""

import autograd.numpy as anp
import numpy as np
import pytest
from catalogue import SHAPES, grids, solid

import sparsedp as dp

BOX = {1: np.s_[1:3], 2: np.s_[1:3, 2:], 3: np.s_[1:3, :2, :]}


@pytest.mark.parametrize("shape", SHAPES)
def test_flux_is_the_divergence_in_the_box(shape, rng):
    for grid in grids(shape, rng):
        D, v = dp.divergence(grid), rng.standard_normal(grid.faces.size)
        cells = np.zeros(shape, bool)
        cells[BOX[len(shape)]] = True
        for box, inside in ((BOX[len(shape)], cells), (solid(grid), solid(grid))):
            out, terms = dp.flux(grid, box), grid.volumes * D(v)
            assert np.isclose(out(v), np.sum(terms[inside]), rtol=0, atol=1e-14 * np.sum(abs(terms)))
    everywhere = dp.flux(dp.Grid(shape, periodic=True), np.ones(shape, bool))
    assert not everywhere.matrix.count_nonzero()


# ---- forces: the balance of momentum ---------------------------------------------------------------------------------

SIDES = {"x": (dp.inflow, dp.outflow), "y": (dp.no_slip, dp.free_slip)}


def obstacles(periodic, rng):
    """A stretched channel with two obstacles, what it needs, and a flow in it."""
    h = rng.uniform(0.5, 2.0, 9), rng.uniform(0.5, 2.0, 7)
    grid = dp.Grid((9, 7), spacing=h, periodic=(periodic, False), origin=(-1.0, 2.0))
    sides = {axis: SIDES[axis] for axis in grid.axes[periodic:]}
    cells = np.zeros((9, 7), bool)
    cells[3:5, 2:4] = cells[6, 4] = True
    v, p = dp.projection(grid, cells, sides)(rng.standard_normal(grid.faces.size)), rng.standard_normal(grid.shape)
    return grid, sides, cells, v, p


def incoming(grid, v, p, nu):
    """Momentum along x that comes in: through the middle of the first cells, the outflow and the lower wall."""
    u, (h, k) = grid.split(v)[0], grid.widths
    if grid.periodic[0]:
        return -nu * np.sum(grid.spacings(0) * u[:, 0]) / (0.5 * k[0])
    middle = p[0] + (0.5 * (u[0] + u[1])) ** 2 - nu * (u[1] - u[0]) / h[0]
    return np.sum(k * (middle - u[-1] ** 2)) - nu * np.sum(grid.spacings(0)[1:] * u[1:, 0]) / (0.5 * k[0])


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("slip", [dp.no_slip, dp.free_slip])
def test_sums_telescope(periodic, slip, rng):
    """The momentum equation, summed over the free faces, and the force on the obstacles are what comes in."""
    grid, sides, cells, v, p = obstacles(periodic, rng)
    slope = dp.gradient(grid, {} if periodic else {"x": (dp.neumann, dp.dirichlet)}, cells)
    rate = 0.3 * dp.face_laplacian(grid, sides, cells, slip)(v) - dp.convection(grid, sides, cells)(v, v) - slope(p)
    gained = grid.split(grid.faces.volumes * rate)[0]
    force = dp.forces(grid, cells, sides, slip)(v, p, 0.3)[0]
    assert abs(np.sum(gained) + force - incoming(grid, v, p, 0.3)) <= 1e-13 * (np.sum(abs(gained)) + abs(force))


def test_parts_add_up_and_a_box_holds_what_is_in_it(rng):
    grid, sides, cells, v, p = obstacles(False, rng)
    one, other = cells.copy(), cells.copy()
    one[6], other[:6] = False, False
    on = [dp.forces(grid, cells, sides, cells=part, about=(1.0, 3.0)) for part in (cells, one, other)]
    whole, first, second = (each(v, p, 0.3) for each in on)
    assert np.allclose(whole, first + second, rtol=1e-13) and np.allclose(
        on[0](v, 0 * p + 5.0, 0.3), on[0](v, 0 * p, 0.3)
    )
    # Around the first obstacle: what its own faces take, and what the fluid in the box gains.
    slope = dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)}, cells)
    rate = 0.3 * dp.face_laplacian(grid, sides, cells)(v) - dp.convection(grid, sides, cells)(v, v) - slope(p)
    around = dp.forces(grid, cells, sides, cells=np.s_[2:6, 1:4], about=(1.0, 3.0))
    assert np.allclose(around(v, p, 0.3), first + around.total(rate), rtol=1e-12)


def test_torque(rng):
    """Of a uniform acceleration: that of the weight in the middle. About another point: a force times an arm."""
    for dim in (2, 3):
        grid = dp.Grid((4, 5, 6)[:dim], spacing=0.5, origin=1.0)
        on = dp.forces(grid, cells=np.ones(grid.shape, bool), about=(1.5, 2.0, 2.5)[:dim])
        g = rng.standard_normal(dim)
        arm = np.zeros(3)
        arm[:dim] = np.array(grid.size) / 2 + 1.0 - np.array((1.5, 2.0, 2.5)[:dim])
        torque = np.cross(arm, np.append(g, np.zeros(3 - dim)))
        found = on.total(grid.join(*g)) / np.prod(grid.size)
        assert np.allclose(found, np.append(g, torque[2:] if dim == 2 else torque), rtol=1e-13)
    grid, sides, cells, v, p = obstacles(False, rng)
    here, there = (dp.forces(grid, cells, sides, about=place)(v, p, 0.3) for place in ((1.0, 3.0), 0.0))
    assert there[2] == pytest.approx(here[2] + 1.0 * here[1] - 3.0 * here[0], rel=1e-12)
    assert dp.forces(dp.Grid(5), cells=np.s_[1:3])(np.ones(6), np.arange(5.0), 0.1).shape == (1,)


def test_derivatives_of_forces(rng):
    grid, sides, cells, v, p = obstacles(False, rng)
    on, weights = dp.forces(grid, cells, sides), rng.standard_normal(3)
    x = {"v": v, "p": p, "nu": 0.3}
    loss = lambda x: anp.sum(weights * on(x["v"], x["p"], x["nu"])) ** 2
    assert dp.check.gradient(loss, x).verdict == "agrees"
    assert np.allclose(dp.grad(lambda p: weights @ on(v, p, 0.3))(p), on.pressure.T(weights))
