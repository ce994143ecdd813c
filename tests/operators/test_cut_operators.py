"""Operators of cut_cells: gaps, coefficients at the wall, batches, unused values, refused arguments."""

import autograd.numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import NonFiniteError, ShapeError

GRID = dp.Grid((6, 5), size=(1.2, 0.9))


def ring(x, y):
    """The fluid around a disc."""
    return np.sqrt((x - 0.62) ** 2 + (y - 0.43) ** 2) - 0.27


@pytest.fixture
def body():
    return dp.cut_cells(GRID, ring, {"x": dp.dirichlet}, dp.robin(1.0, 0.3))


# ------------------------------------------------------------ gaps


@pytest.mark.parametrize(("half", "tolerance"), [(0.01, 1e-2), (0.3, 1e-4), (0.5, 1e-4), (0.8, 0.06), (1.0, 0.14)])
def test_solutions_in_gaps_of_one_cell(half, tolerance):
    """u'' = -1 between two walls: the integral over the gap is 2/3 half^3, and the flux through each wall is half."""
    gap = dp.cut_cells(dp.Grid((4, 12)), lambda x, y: half - abs(y - 6.0), solid_boundary=dp.dirichlet)
    u = gap.solve(np.ones((4, 12)))
    assert np.isclose(np.sum(gap.volumes * u) / 4.0, 2.0 / 3.0 * half**3, rtol=tolerance)
    assert np.max(u) < 0.51 * half**2
    fluxes = gap.flux(u)[gap.areas > 0]
    assert len(fluxes) == 8 and np.allclose(fluxes, -half, rtol=1e-3)
    uniform = gap.solve(np.zeros((4, 12)), 0.7)
    assert np.allclose(uniform[gap.is_fluid], 0.7, rtol=1e-9)


@pytest.mark.parametrize("condition", [dp.dirichlet, dp.robin(1.0, 0.2)], ids=repr)
@pytest.mark.parametrize("half", [0.1, 0.3, 0.5, 0.7, 1.0])
def test_linear_fields_in_gaps_are_exact(half, condition):
    """The flux from one wall to the other, and the solution: values differ along the walls and across the gap."""
    grid = dp.Grid((7, 12))
    sides = {"x": dp.dirichlet}
    gap = dp.cut_cells(grid, lambda x, y: half - abs(y - 6.0), sides, condition)
    x, y = gap.centroids
    slope = np.where(y > 6.0, 3.0, -3.0)
    values = condition.a * (1.0 + 2.0 * x + 3.0 * y) + condition.b * slope
    x, y = grid.centres()
    exact = 1.0 + 2.0 * x + 3.0 * y
    walls = dp.lift(grid, sides).domain.join(1.0 + 3.0 * y[:1], 15.0 + 3.0 * y[:1], 0.0, 0.0)
    u = gap.solve(np.zeros(grid.shape), values, walls)
    assert np.allclose(u, exact * gap.is_fluid, atol=1e-4)
    assert np.allclose(gap.slopes(u, values), slope * (gap.areas > 0), atol=1e-3)


def test_the_slope_in_a_gap_has_derivatives():
    def size(half):
        gap = dp.cut_cells(dp.Grid((2, 8)), lambda x, y: half - abs(y - 4.0), solid_boundary=dp.dirichlet)
        return np.sum(gap.volumes * gap.solve(np.ones((2, 8))))

    assert np.isclose(dp.grad(size)(0.4), 2 * 2 * 0.4**2, rtol=1e-3)
    h = 1e-5
    assert np.isclose(dp.grad(size)(0.7), (size(0.7 + h) - size(0.7 - h)) / (2 * h), rtol=1e-6)


def gap_at_the_grid(width, upper):
    """The fluid between a plane body and a wall of the grid; the height above the body of points."""
    grid = dp.Grid((4, 9))
    height = (lambda y: y - 9.0 + width) if upper else (lambda y: width - y)
    return dp.cut_cells(grid, lambda x, y: height(y), dp.dirichlet, dp.dirichlet), height


def check_gap_at_the_grid(width, upper, tolerance):
    """-u'' = 1 between walls with the value 0, against the exact integrals; and linear fields."""
    gap, height = gap_at_the_grid(width, upper)
    grid = gap.grid
    x, y = grid.centres()
    # A field that is linear along and across the gap.
    value = lambda x, y: 1.0 + 2.0 * x + 3.0 * height(y)
    values = value(*gap.centroids)
    of_wall = value(x[:, 0], 9.0 if upper else 0.0)
    ends = (0.0, of_wall) if upper else (of_wall, 0.0)
    exact = value(*np.broadcast_arrays(x, y))
    walls = dp.lift(grid, gap.boundary).domain.join(exact[0] - 1.0, exact[-1] + 1.0, *ends)
    u = gap.solve(np.zeros(grid.shape), values, walls)
    assert np.allclose(u, exact * gap.is_fluid, atol=1e-4)
    assert np.allclose(gap.slopes(u, values, walls), -3.0 * (gap.areas > 0), atol=1e-3)
    assert np.allclose(gap.diffusion(u, values, walls) * gap.volumes, 0.0, atol=1e-9)
    plain = dp.cut_cells(grid, lambda x, y: height(y), {"y": dp.dirichlet}, dp.dirichlet)
    u = plain.solve(np.ones(grid.shape))
    assert np.isclose(np.sum(plain.volumes * u) / 4, width**3 / 12, rtol=tolerance)
    assert np.isclose(np.sum(plain.flux(u)) / 4, -width / 2, rtol=tolerance)


@pytest.mark.parametrize("width", [0.3, 1.45])
def test_gaps_between_the_body_and_a_wall_of_the_grid(width):
    """The integral of the solution and the fluxes are exact; 1.3 to 3.9 times too large if only the body is a wall."""
    check_gap_at_the_grid(width, width > 1, 1e-4)


@pytest.mark.whole
@pytest.mark.parametrize("upper", [False, True])
def test_gaps_of_all_widths_between_the_body_and_a_wall_of_the_grid(upper):
    for width in (0.05, 0.5, 1.0, 1.05, 1.5, 1.9, 2.0, 2.2, 2.5, 3.3, 4.0):
        check_gap_at_the_grid(width, upper, 1.5e-3 if width <= 2.0 else 0.12)


@pytest.mark.parametrize(
    ("solid", "wall", "tolerance"),
    [
        (dp.dirichlet, dp.dirichlet, 2e-4),
        (dp.dirichlet, dp.neumann, 2e-4),
        (dp.dirichlet, dp.robin(1.0, 0.2), 2e-4),
        (dp.robin(1.0, 0.2), dp.dirichlet, 3e-4),
        (dp.robin(1.0, 0.2), dp.neumann, 3e-4),
        (dp.neumann, dp.dirichlet, 7e-4),
    ],
)
def test_linear_fields_between_a_disc_and_walls_of_the_grid(solid, wall, tolerance):
    """The error is the error of the polygon, also if a wall of the grid is 1.5 cells from the disc."""
    grid = dp.Grid((16, 16), size=8.0)
    sides = {"x": dp.dirichlet, "y": wall}
    body = dp.cut_cells(grid, lambda x, y: np.hypot(x - 4.0, y - 2.75) - 2.0, sides, solid)
    value = lambda x, y: 1.0 + 2.0 * x + 3.0 * y
    slope = -(2.0 * body.normals[0] + 3.0 * body.normals[1])
    values = solid.a * value(*body.centroids) + solid.b * slope
    x, y = grid.coordinates(0), grid.coordinates(1)
    ends = [wall.a * value(x, end) + wall.b * outward * 3.0 for end, outward in ((0.0, -1.0), (8.0, 1.0))]
    walls = dp.lift(grid, sides).domain.join(value(0.0, y), value(8.0, y), *ends)
    error = body.is_fluid * (body.solve(np.zeros(grid.shape), values, walls) - value(*grid.centres()))
    assert np.sqrt(np.sum(body.volumes * error**2) / np.sum(body.volumes)) < tolerance


@pytest.mark.whole
def test_derivatives_in_a_gap_at_a_wall_of_the_grid():
    """The integral over a gap of the width w is w^3 / 12, in both modes; and the second derivative."""

    def size(width):
        gap = dp.cut_cells(dp.Grid((2, 6)), lambda x, y: y - 6.0 + width, {"y": dp.dirichlet}, dp.dirichlet)
        return np.sum(gap.volumes * gap.solve(np.ones((2, 6)))) / 2

    assert np.isclose(dp.grad(size)(0.4), 0.04, rtol=1e-4)
    assert np.isclose(dp.grad(dp.grad(size))(1.3), 0.65, rtol=1e-3)
    h = 1e-5
    between = 2.2  # between both slopes
    assert np.isclose(dp.grad(size)(between), (size(between + h) - size(between - h)) / (2 * h), rtol=1e-6)


@pytest.mark.whole
def test_derivatives_in_the_values_of_a_gap_at_a_wall_of_the_grid(rng):
    gap, _ = gap_at_the_grid(1.3, True)
    domain = dp.lift(gap.grid, gap.boundary).domain
    weights = rng.standard_normal((3, *gap.grid.shape))

    def loss(values, walls, b):
        u = gap.solve(b, values, walls)
        flux = gap.flux(u, values, walls=walls)
        return np.sum(weights[0] * u + weights[1] * flux + weights[2] * gap.diffusion(u**2, values, walls))

    arguments = rng.standard_normal(gap.grid.shape), rng.standard_normal(domain.size), np.ones(gap.grid.shape)
    for place in range(3):
        function = lambda x, place=place: loss(*arguments[:place], x, *arguments[place + 1 :])
        assert dp.check.gradient(function, arguments[place], quick=True).verdict == "agrees"


def test_a_wall_of_the_grid_aside_is_no_gap():
    """A body whose wall is normal to a wall of the grid: the slope is that of the fit, without values on the grid."""
    grid = dp.Grid((9, 6))
    wall = dp.cut_cells(grid, lambda x, y: x - 4.3, {"y": dp.dirichlet}, dp.dirichlet)
    x, _ = grid.centres()
    u = (x - 4.3) * np.ones(grid.shape)
    assert np.allclose(wall.slopes(u), -1.0 * (wall.areas > 0), atol=1e-9)


def test_plane_walls_are_no_gaps(rng):
    """The slope at a plane wall equals the slope of the fit, in each direction: exact for quadratic fields."""
    grid = dp.Grid((14, 13), size=(1.1, 0.9))
    for angle in rng.uniform(0, 2 * np.pi, 12):
        normal = np.array([np.cos(angle), np.sin(angle)])
        level = lambda x, y, normal=normal: normal[0] * (x - 0.53) + normal[1] * (y - 0.46)
        wall = dp.cut_cells(grid, level, solid_boundary=dp.dirichlet)
        u = 1.0 + level(*grid.centres())
        slopes = wall.slopes(u, 1.0)[3:-3, 3:-3][wall.areas[3:-3, 3:-3] > 0]
        assert np.allclose(slopes, -1.0, atol=1e-7)


# ------------------------------------------------------------ coefficients at the wall


def test_the_coefficient_at_the_wall_is_the_mean_over_the_open_area():
    """A cell at a corner of the grid: faces on walls of the grid count like those between cells."""
    grid = dp.Grid((2, 2))
    corner = dp.cut_cells(grid, lambda x, y: 2.5 - x - y)
    k = grid.join(np.array([[1.0, 9.0], [2.0, 3.0], [5.0, 6.0]]), np.array([[1.0, 4.0, 7.0], [8.0, 2.0, 3.0]]))
    flux = corner.flux(np.zeros((2, 2)), 1.0, k)
    # Cell (1, 0): its open faces are x-lower (2, whole), x-upper (5, half), y-lower (8, whole), y-upper (2, half).
    assert np.isclose(flux[1, 0] / corner.areas[1, 0], (2.0 + 0.5 * 5.0 + 8.0 + 0.5 * 2.0) / 3.0, rtol=1e-12)


def test_tiny_levels_have_the_geometry_of_large_ones():
    nodes = np.meshgrid(*(GRID.coordinates(axis, "nodes") for axis in (0, 1)), indexing="ij")
    level = ring(*nodes)
    for factor, tolerance in ((1e-300, 1e-14), (1e-315, 1e-6), (1e300, 1e-14)):
        scaled = dp.cut_cells(GRID, factor * level)
        assert np.allclose(scaled.fractions, dp.cut_cells(GRID, level).fractions, atol=tolerance)


# ------------------------------------------------------------ batches


def test_leading_axes_are_a_batch(rng):
    flow = dp.cut_cells(GRID, ring)
    walled = dp.cut_cells(GRID, ring, {"x": dp.dirichlet}, dp.robin(1.0, 0.3))
    u, rate, values, wall_k = rng.uniform(0.5, 1.5, (4, 2, 3, *GRID.shape))
    v, k, inflow = rng.uniform(0.5, 1.5, (3, 2, 3, GRID.faces.size))
    v = dp.interior(GRID)(v)
    walls = rng.standard_normal((2, 3, dp.lift(GRID, {"x": dp.dirichlet}).domain.size))
    calls = [
        (walled.gradient, (u, walls)),
        (walled.divergence, (v,)),
        (walled.slopes, (u, values)),
        (flow.slopes, (u, 0.5)),
        (walled.flux, (u, values, k)),
        (walled.flux, (u, values, k, wall_k)),
        (walled.diffusion, (u, values, walls, k)),
        (flow.advection, (u, v, inflow)),
        (flow.redistribute, (rate,)),
        (flow.project, (v,)),
        (walled.solve, (u, values, walls)),
    ]
    for function, arguments in calls:
        batch = function(*arguments)
        assert batch.shape[:2] == (2, 3), function
        single = function(*(x[1, 2] if np.ndim(x) else x for x in arguments))
        assert np.allclose(batch[1, 2], single, rtol=1e-10, atol=1e-11), function
    assert walled.solve(u[0, 0], values).shape == values.shape
    weights = rng.standard_normal((3, *GRID.shape))
    slope = dp.grad(lambda u: np.sum(weights * walled.diffusion(u, values[0], walls[0], k[0])))(u[0])
    h = 1e-5
    ends = [np.sum(weights * walled.diffusion(u[0] + s * rate[0], values[0], walls[0], k[0])) for s in (h, -h)]
    assert np.isclose(np.sum(slope * rate[0]), (ends[0] - ends[1]) / (2 * h), rtol=1e-8)


# ------------------------------------------------------------ advection of order 2


def rotating_cylinder(n):
    """A body, the velocity of a rotating fluid in a cylinder, and the ink in it after an angle."""
    grid = dp.Grid((n, n), size=2.0, origin=-1.0)
    body = dp.cut_cells(grid, lambda x, y: 0.81 - np.hypot(x - 0.013, y + 0.021))
    nodes = np.meshgrid(grid.coordinates(0, "nodes"), grid.coordinates(1, "nodes"), indexing="ij")
    stream = np.maximum(0.81**2 - (nodes[0] - 0.013) ** 2 - (nodes[1] + 0.021) ** 2, 0.0) / 2
    v = dp.curl(grid)(stream) / np.where(body.apertures > 0, body.apertures, 1.0)
    x, y = grid.centres()

    def ink(angle):
        along_x, along_y = 0.013 + 0.55 * np.cos(angle), -0.021 + 0.55 * np.sin(angle)
        return body.is_fluid * np.exp(-((x - along_x) ** 2 + (y - along_y) ** 2) / 0.04)

    return body, v, ink


@pytest.mark.whole
def test_advection_of_order_2_along_a_curved_wall():
    errors = []
    for n in (24, 48):
        body, v, ink = rotating_cylinder(n)
        dt = 0.5 / n
        u = ink(0.0)
        content = np.sum(body.volumes * u)
        for _ in range(2 * n):
            middle = u + dt * body.advection(u, v, order=2)
            u = 0.5 * (u + middle + dt * body.advection(middle, v, order=2))
        assert np.isclose(np.sum(body.volumes * u), content, rtol=1e-13)
        assert -0.01 < np.min(u) and np.max(u) < 1.0
        errors.append(np.sum(body.volumes * abs(u - ink(1.0))))
    assert np.log2(errors[0] / errors[1]) > 1.6


def test_advection_of_order_2_is_exact_for_linear_fields(rng):
    grid = dp.Grid((9, 8), spacing=[np.linspace(0.1, 0.2, 9), 0.15])
    everywhere = dp.cut_cells(grid, np.ones(grid.nodes.shape))
    x, y = grid.centres()
    at_walls = grid.join(*(1.0 + 2.0 * x + 3.0 * y for x, y in map(grid.face_centres, (0, 1))))
    rate = everywhere.advection(1.0 + 2.0 * x + 3.0 * y, grid.join(0.7, -0.4), at_walls, order=2)
    assert np.allclose(rate[:-1, 1:], -(0.7 * 2.0 - 0.4 * 3.0), rtol=1e-12)  # without the walls where the fluid leaves
    uniform = dp.Grid((9, 8), size=(1.1, 0.9))
    body = dp.cut_cells(uniform, lambda x, y: 1.37 - x - y)
    x, y = uniform.centres()
    v = uniform.join(0.7, -0.7)  # along the wall
    at_walls = uniform.join(*(1.0 + 2.0 * x + 3.0 * y for x, y in map(uniform.face_centres, (0, 1))))
    rate = body.advection(1.0 + 2.0 * x + 3.0 * y, v, at_walls, order=2)
    far = (x + y < 1.0) & (x > 0.2) & (y > 0.2)
    assert np.count_nonzero(far) >= 10 and np.allclose(rate[far], 0.7, rtol=1e-12)
    batch = body.advection(rng.standard_normal((2, 9, 8)), np.stack([v, -v]), order=2)
    assert batch.shape == (2, 9, 8)
    ones = 1.0 * body.is_fluid
    assert np.allclose(body.advection(ones, body.project(v), 1.0, order=2), 0.0, atol=1e-9)  # constants are kept


@pytest.mark.parametrize("upper", [False, True])
def test_advection_of_order_2_is_continuous_where_the_flow_turns_at_a_wall(upper, rng):
    """The slope in the cell at the wall changes with the direction of the flow, while fluid crosses its other face."""
    grid = dp.Grid((6, 3), size=1.0)
    plain = dp.cut_cells(grid, np.ones(grid.nodes.shape))
    x, _ = grid.centres()
    u = (x**2 if upper else (1 - x) ** 2) + 0.0 * grid.centres()[1]
    x_faces = np.ones(grid.faces.parts[0])
    place = -1 if upper else 0

    def rate(speed):
        at_wall = np.zeros(x_faces.shape)
        at_wall[place] = 1.0
        v = grid.join((1.0 - at_wall) * x_faces + speed * at_wall, 0.0)
        return plain.advection(u, v, inflow=2.0, order=2)

    inside, outside = (rate(sign * 1e-9 * (-1.0 if upper else 1.0)) for sign in (1.0, -1.0))
    assert np.allclose(inside, outside, atol=1e-6)
    entering = rate(-1.0 if upper else 1.0)
    assert np.max(abs(entering - inside)) > 0.1
    for speed in (0.05, -0.05, 0.3):
        direction = dp.jvp(rate, speed, 1.0)[1]
        assert np.allclose(direction, (rate(speed + 1e-6) - rate(speed - 1e-6)) / 2e-6, atol=1e-6)


def test_derivatives_of_advection_of_order_2(rng):
    body, v, ink = rotating_cylinder(8)
    weights, tangent = rng.standard_normal((2, 8, 8))
    of_v = rng.standard_normal(v.size)

    def loss(q):
        return np.sum(weights * body.advection(ink(0.3) + q * tangent, v + q * of_v, q, order=2) ** 2)

    other = ink(1.1)[::-1]
    rate = dp.jit(lambda u, v: body.advection(u, v, order=2))
    assert np.array_equal(rate(ink(0.3), v), body.advection(ink(0.3), v, order=2))
    assert np.array_equal(rate(other, -v), body.advection(other, -v, order=2))  # decisions are made anew
    h = 1e-6
    slope = dp.grad(loss)(0.2)
    assert np.isclose(slope, (loss(0.2 + h) - loss(0.2 - h)) / (2 * h), rtol=1e-6)
    assert np.isclose(dp.jvp(loss, 0.2, 1.0)[1], slope, rtol=1e-10)


# ------------------------------------------------------------ arguments


def test_values_where_there_is_no_fluid_are_not_used(body, rng):
    assert not np.all(body.is_fluid)
    flow = dp.cut_cells(GRID, ring)
    u = rng.standard_normal(GRID.shape)
    v = dp.interior(GRID)(rng.standard_normal(GRID.faces.size))
    dead_u = np.where(body.is_fluid, u, np.nan)
    dead_v = np.where(body.apertures > 0, v, np.nan)
    dead_values = np.where(body.areas > 0, u, np.nan)
    k = np.where(body.apertures > 0, 2.0, -np.inf)
    pairs = [
        (lambda u, v, values, k: body.solve(u, values, k=k), "solve"),
        (lambda u, v, values, k: body.diffusion(u, values, k=k, wall_k=abs(values)), "diffusion"),
        (lambda u, v, values, k: body.gradient(u), "gradient"),
        (lambda u, v, values, k: body.divergence(v), "divergence"),
        (lambda u, v, values, k: flow.project(v), "project"),
        (lambda u, v, values, k: flow.advection(u, v), "advection"),
        (lambda u, v, values, k: flow.redistribute(u), "redistribute"),
    ]
    for function, name in pairs:
        expected = function(u, v, u, np.full(GRID.faces.size, 2.0))
        assert np.array_equal(function(dead_u, dead_v, dead_values, k), expected), name
    gradient = dp.grad(lambda b: np.sum(body.solve(b, dead_values) ** 2))(dead_u)
    assert np.all(gradient[~body.is_fluid] == 0) and np.all(np.isfinite(gradient))
    assert np.all(dp.grad(lambda u: np.sum(body.diffusion(u) ** 2))(dead_u)[~body.is_fluid] == 0)


def test_refused_arguments(body):
    u = np.ones(GRID.shape)
    k = np.ones(GRID.faces.size)
    for call in (body.diffusion, body.flux, body.solve):
        with pytest.raises(ValueError, match="^k of cut_cells must be >= 0, got -2$"):
            call(u, k=-2.0)
        with pytest.raises(ValueError, match="^wall_k of cut_cells must be >= 0, got -1$"):
            call(u, wall_k=-u)
        with pytest.raises(NonFiniteError, match="k of cut_cells must be finite"):
            call(u, k=np.nan * k)
        with pytest.raises(NonFiniteError, match="wall_k of cut_cells must be finite"):
            call(u, wall_k=np.nan)
        with pytest.raises(ShapeError, match="k of cut_cells takes a number or a field on faces"):
            call(u, k=np.ones(1))
    for call in (body.diffusion, body.gradient, body.solve):
        walls = np.full(dp.lift(GRID, {"x": dp.dirichlet}).domain.size, np.nan)
        with pytest.raises(NonFiniteError, match="^walls of cut_cells, on their faces, must be finite, got 22 that"):
            call(u, walls=walls)
    with pytest.raises(NonFiniteError, match="u of cut_cells must be finite"):
        body.gradient(np.nan * u)
    with pytest.raises(TypeError, match="^v of cut_cells must hold real numbers, got dtype complex128; write v.real$"):
        body.advection(u, 1j * k)
    with pytest.raises(ValueError, match="order= of advection must be one of 1, 2, got 3"):
        body.advection(u, k, order=3)
    with pytest.raises(
        TypeError, match="^u of cut_cells must hold real numbers, got dtype complex128; write u.real and u.imag$"
    ):
        body.advection(1j * u, k, order=2)
    with pytest.raises(
        TypeError,
        match="^inflow of cut_cells must hold real numbers, got dtype complex128; write inflow.real and inflow.imag$",
    ):
        body.advection(u, k, 1j, order=2)
    with pytest.raises(
        TypeError, match="^u of cut_cells must be float32, float64, complex64 or complex128, got float16"
    ):
        body.gradient(u.astype(np.float16))
    with pytest.raises(TypeError, match="u of cut_cells must hold numbers"):
        body.slopes(np.full(GRID.shape, "a"))
    with pytest.raises(
        ShapeError,
        match=r"^solve of cut_cells takes one k for all right-hand sides, got an array of shape \(2, 71\); call solve "
        "once for each k$",
    ):
        body.solve(u, k=np.stack([k, k]))
    with pytest.raises(ShapeError, match="^solve of cut_cells takes one shift for all right-hand sides"):
        body.solve(u, shift=np.stack([u, u]))
