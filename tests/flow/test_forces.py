"""flux, forces and brinkman: sums that telescope, the drag of a cylinder, derivatives in its shape, refusals."""

import autograd.numpy as anp
import numpy as np
import pytest
from catalogue import SHAPES, grids, solid

import sparsedp as dp

BOX = {1: np.s_[1:3], 2: np.s_[1:3, 2:], 3: np.s_[1:3, :2, :]}


@pytest.mark.parametrize("shape", SHAPES)
def test_flux_equals_the_divergence_in_a_box(shape, rng):
    for grid in grids(shape, rng):
        D = dp.divergence(grid)
        v = rng.standard_normal(grid.faces.size)
        cells = np.zeros(shape, bool)
        cells[BOX[len(shape)]] = True
        for box, inside in ((BOX[len(shape)], cells), (solid(grid), solid(grid))):
            out = dp.flux(grid, box)
            terms = grid.volumes * D(v)
            assert np.isclose(out(v), np.sum(terms[inside]), rtol=0, atol=1e-14 * np.sum(abs(terms)))
    everywhere = dp.flux(dp.Grid(shape, periodic=True), np.ones(shape, bool))
    assert not everywhere.matrix.count_nonzero()


# ---- forces: the balance of momentum ---------------------------------------------------------------------------------

SIDES = {"x": (dp.inflow, dp.outflow), "y": (dp.no_slip, dp.free_slip)}


def obstacles(periodic, rng):
    """Return a stretched channel with two obstacles, its operators, and a flow in it."""
    h = rng.uniform(0.5, 2.0, 9), rng.uniform(0.5, 2.0, 7)
    grid = dp.Grid((9, 7), spacing=h, periodic=(periodic, False), origin=(-1.0, 2.0))
    sides = {axis: SIDES[axis] for axis in grid.axes[periodic:]}
    cells = np.zeros((9, 7), bool)
    cells[3:5, 2:4] = cells[6, 4] = True
    v = dp.projection(grid, cells, sides)(rng.standard_normal(grid.faces.size))
    p = rng.standard_normal(grid.shape)
    return grid, sides, cells, v, p


def incoming(grid, v, p, nu):
    """Return the momentum along x that enters through the first cells, the outflow and the lower wall."""
    u, (h, k) = grid.split(v)[0], grid.widths
    if grid.periodic[0]:
        return -nu * np.sum(grid.spacings(0) * u[:, 0]) / (0.5 * k[0])
    middle = p[0] + (0.5 * (u[0] + u[1])) ** 2 - nu * (u[1] - u[0]) / h[0]
    return np.sum(k * (middle - u[-1] ** 2)) - nu * np.sum(grid.spacings(0)[1:] * u[1:, 0]) / (0.5 * k[0])


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("slip", [dp.no_slip, dp.free_slip])
def test_total_force_equals_the_momentum_through_the_boundary(periodic, slip, rng):
    """The momentum equation summed over the free faces plus the force equals the momentum that enters."""
    grid, sides, cells, v, p = obstacles(periodic, rng)
    slope = dp.gradient(grid, {} if periodic else {"x": (dp.neumann, dp.dirichlet)}, cells)
    rate = 0.3 * dp.face_laplacian(grid, sides, cells, slip)(v) - dp.convection(grid, sides, cells)(v, v) - slope(p)
    gained = grid.split(grid.faces.volumes * rate)[0]
    force = dp.forces(grid, cells, sides, slip)(v, p, 0.3)[0]
    assert abs(np.sum(gained) + force - incoming(grid, v, p, 0.3)) <= 1e-13 * (np.sum(abs(gained)) + abs(force))


def test_forces_are_additive_over_cells(rng):
    grid, sides, cells, v, p = obstacles(False, rng)
    one = cells.copy()
    other = cells.copy()
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
    """A uniform acceleration has the torque of a point mass in the centre; elsewhere, force times lever arm."""
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
    on = dp.forces(grid, cells, sides)
    weights = rng.standard_normal(3)
    x = {"v": v, "p": p, "nu": 0.3}
    loss = lambda x: anp.sum(weights * on(x["v"], x["p"], x["nu"])) ** 2
    assert dp.check.gradient(loss, x, quick=True).verdict == "agrees"
    assert np.allclose(dp.grad(lambda p: weights @ on(v, p, 0.3))(p), on.pressure.T(weights))


# ---- brinkman: obstacles of any shape --------------------------------------------------------------------------------


def flat_wall(grid, angle, place):
    """Return the distance of the faces to a wall of a given slope."""
    x, y = (grid.join(*(grid.face_centres(axis)[a] for axis in (0, 1))) for a in (0, 1))
    return np.cos(angle) * (x - place) + np.sin(angle) * (y - place)


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4, 2.0])
def test_effective_position_of_a_flat_wall(angle):
    """The profile of the formula solves the equation on the grid, for every slope and position of the wall."""
    grid = dp.Grid((12, 12), size=3.0)
    h = 0.25
    for place in (1.3, 1.41, 1.5):
        s = flat_wall(grid, angle, place)
        U = np.logaddexp(0.0, 8 * s / h) * h / 8
        left = dp.face_laplacian(grid)(U) - dp.brinkman(grid)(7.0 * s) * U
        inner = [part[2:-2, 2:-2] for part in grid.split(left)]
        deep = [part[2:-2, 2:-2] < -2.8 * h for part in grid.split(s)]  # as good as 0 there
        assert max(np.max(abs(part[~low])) for part, low in zip(inner, deep)) <= 1e-8


def through_a_slit(n, lower=0.2137, upper=0.8011):
    """Flow rate between two walls in a periodic box, beside (upper - lower)^3 / 12."""
    grid = dp.Grid((1, n), size=1.0, periodic=True)
    y = grid.face_centres(0)[1]
    level = grid.join(0.5 * (upper - lower) - abs(y - 0.5 * (upper + lower)), 1.0)
    rate = dp.brinkman(grid)(level) * grid.join(1.0, 0.0)  # no obstacle for the other component
    u = dp.inverse(dp.diagonal(grid.faces, rate + grid.join(0.0, 1.0)) - dp.face_laplacian(grid))(grid.join(1.0, 0.0))
    return np.sum(u) / n / ((upper - lower) ** 3 / 12) - 1


def test_order_of_brinkman():
    errors = [abs(through_a_slit(n)) for n in (20, 40, 80, 160)]
    assert errors[0] <= 0.02 and np.log2(errors[0] / errors[-1]) >= 3 * 1.8


@pytest.mark.parametrize(("shape", "periodic"), [((6, 5), False), ((6, 5), True), ((1, 4), False), ((3, 4, 2), False)])
def test_derivatives_of_brinkman(shape, periodic, rng):
    grid = dp.Grid(shape, spacing=0.3, periodic=periodic)
    friction = dp.brinkman(grid)
    weights = rng.standard_normal(grid.faces.size)
    level = 0.2 * rng.standard_normal(grid.faces.size)
    loss = lambda level: anp.sum(weights * anp.log1p(friction(level)))
    far = np.zeros(level.size)
    far[0] = 1e3  # elsewhere flat, or cells away from any wall
    assert np.all(np.isfinite(dp.hvp(loss, far, level))) and np.all(np.isfinite(dp.hvp(loss, 1e3 + level, level)))
    assert dp.check.gradient(loss, level, quick=True).verdict == "agrees"
    t = rng.standard_normal(level.size)
    near = lambda size: dp.grad(loss)(level + size * t)
    assert np.allclose(dp.hvp(loss, level, t), (near(1e-6) - near(-1e-6)) / 2e-6, rtol=1e-5, atol=1e-4)


def test_level_sets_of_any_scale(rng):
    grid = dp.Grid((5, 4), spacing=0.5)
    friction = dp.brinkman(grid)
    s = flat_wall(dp.Grid((5, 4), spacing=0.5), 0.7, 1.0)
    want = friction(s)
    for k in (900, -900):
        assert np.array_equal(friction(2.0**k * s), want)
    for given in (np.asfortranarray(s), s[::-1].copy()[::-1], np.repeat(s, 2)[::2], list(s)):
        assert np.array_equal(friction(given), want)
    assert np.allclose(friction(s.astype(np.float32)), want, rtol=1e-3) and np.all(want >= 0)
    assert np.array_equal(friction(np.sign(s).astype(int)), friction(np.sign(s)))
    nowhere = friction(0.5 + 0 * s)
    everywhere = friction(-0.5 + 0 * s)
    assert not np.any(nowhere) and np.all(everywhere >= 1e4) and not np.any(friction(0 * s))
    for h, words in ((2.0**-600, "spacing is too small, rescale"), (2.0**600, "the spacing is too large; rescale")):
        with pytest.raises(dp.errors.NonFiniteError, match=words):
            dp.brinkman(dp.Grid((3, 3), spacing=h))
    assert dp.brinkman(dp.Grid((0, 3)))(np.zeros(3)).shape == (3,)
