"""cut_cells: geometry of planes, exact linear solutions, limits, orders around and inside of a disc, derivatives."""

import autograd.numpy as np
import numpy as onp
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError, IncompatibleError, JitError, NonFiniteError, ShapeError

CONDITIONS = [dp.dirichlet, dp.neumann, dp.robin(1.0, 0.3)]
GRID = dp.Grid((7, 6), spacing=[np.linspace(0.1, 0.2, 7), 0.15])
ONES = np.ones(GRID.shape)


def hypot(*coordinates):
    return np.sqrt(sum(x**2 for x in coordinates))


def plane(dim):
    """A plane that is aligned with no axis: a level, the unit normal that points into the fluid, and a point on it."""
    normal = np.array([0.6, -0.3, 0.5][:dim])
    normal = normal / np.linalg.norm(normal)
    point = np.array([0.47, 0.36, 0.41][:dim])
    return (lambda *x: 3.0 * sum(n * (c - p) for n, c, p in zip(normal, x, point))), normal, point


# ------------------------------------------------------------ geometry


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_planes_are_exact(dim):
    """Volumes by Gauss's theorem for the field x: dim V = sum of A x.n over the closed surface of the fluid."""
    grid = dp.Grid((5, 4, 3)[:dim], size=(1.1, 0.9, 0.8)[:dim])
    level, normal, point = plane(dim)
    body = dp.cut_cells(grid, level)
    on_wall = body.areas > 0
    assert np.count_nonzero(on_wall) >= 1
    assert all(np.allclose(n[on_wall], expected, atol=1e-14) for n, expected in zip(body.normals, normal))
    distance = sum(n * (x - p) for n, x, p in zip(normal, body.centroids, point))
    assert np.all(abs(distance[on_wall]) < 1e-15)
    through_wall = -np.sum(body.areas) * np.dot(normal, point)
    position = grid.join(*(grid.face_centres(a)[a] for a in range(dim)))
    through_sides = np.sum(body.volumes * body.divergence(position))
    assert np.isclose(dim * np.sum(body.volumes), through_sides + through_wall, rtol=1e-14)
    for axis in range(dim):  # the surface of the fluid of each cell is closed
        constant = grid.join(*(float(a == axis) for a in range(dim)))
        assert np.allclose(body.volumes * body.divergence(constant), body.areas * body.normals[axis], atol=1e-15)


@pytest.mark.whole
def test_volumes_of_a_wedge_and_of_a_ball():
    corner = dp.cut_cells(dp.Grid((3, 3, 3)), lambda x, y, z: x + y + z - 7.5)  # the corner of a cell: 1.5^3 / 6
    assert np.isclose(np.sum(corner.volumes), 1.5**3 / 6, rtol=1e-14)
    assert np.isclose(np.sum(corner.areas), np.sqrt(3) / 2 * 1.5**2, rtol=1e-14)
    ball = dp.cut_cells(dp.Grid((12,) * 3, size=2.0, origin=-1.0), lambda *x: 0.7 - hypot(*x))
    assert np.isclose(np.sum(ball.volumes), 4 / 3 * np.pi * 0.7**3, rtol=0.03)
    assert np.isclose(np.sum(ball.areas), 4 * np.pi * 0.7**2, rtol=0.03)
    assert np.isclose(np.sum(ball.centroids[0] * ball.areas), 0.0, atol=1e-14)  # the cells have no preferred diagonal


# ------------------------------------------------------------ exact solutions and limits


@pytest.mark.parametrize("condition", CONDITIONS, ids=repr)
@pytest.mark.parametrize("dim", [1, 2, pytest.param(3, marks=pytest.mark.whole)])
def test_linear_solutions_are_exact(dim, condition):
    grid = dp.Grid((6, 5, 4)[:dim], size=(1.1, 0.9, 0.8)[:dim], periodic=(False, True, True)[:dim])
    body = dp.cut_cells(grid, lambda x, *_: 0.47 - x, {"x": dp.dirichlet}, condition)
    walls = dp.lift(grid, {"x": dp.dirichlet}).domain.join(1.0, 0.0)
    values = condition.a * (1.0 + 2.0 * 0.47) + condition.b * 2.0
    u = body.solve(np.zeros(grid.shape), values, walls, k=2.5)
    assert np.allclose(u, body.is_fluid * (1.0 + 2.0 * grid.centres()[0]), atol=1e-8)
    assert np.all(abs(body.slopes(u, values) - 2.0)[body.areas > 0] < 1e-8)
    assert np.all(abs(body.diffusion(u, values, walls, k=2.5)) < 1e-8)
    inflow = np.sum(body.volumes * body.divergence(body.gradient(u, walls)))
    assert np.isclose(inflow + np.sum(body.flux(u, values)), 0.0, atol=1e-12)  # conservative


@pytest.mark.parametrize("condition", CONDITIONS, ids=repr)
@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.whole)])
def test_slopes_of_linear_fields_are_exact_at_walls_of_any_direction(dim, condition):
    grid = dp.Grid((8, 9, 7)[:dim], size=(1.1, 0.9, 0.8)[:dim])
    level, normal, _ = plane(dim)
    body = dp.cut_cells(grid, level, dp.dirichlet, condition)
    steepness = np.array([2.0, -3.0, 0.7][:dim])
    u, at_wall = (1.0 + sum(s * x for s, x in zip(steepness, points)) for points in (grid.centres(), body.centroids))
    slope = -np.dot(steepness, normal)
    of_wall = dp.lift(grid, dp.dirichlet).domain
    ends = []
    for axis in range(dim):
        for end in (0.0, grid.size[axis]):
            points = [np.full_like(x, end) if a == axis else x for a, x in enumerate(grid.centres())]
            ends.append((1.0 + sum(s * x for s, x in zip(steepness, points))).take(0, axis))
    walls = of_wall.join(*ends)
    errors = abs(body.slopes(u, condition.a * at_wall + condition.b * slope, walls) - slope)
    inside = (slice(2, -2),) * dim
    assert np.count_nonzero(body.areas[inside]) > 3
    tolerance = 1e-5 if condition == dp.dirichlet else 1e-7  # in gaps at the grid, the fit to values on walls is damped
    assert np.all(errors[inside][body.areas[inside] > 0] < tolerance)


@pytest.mark.whole
def test_limits_are_the_plain_solver():
    box = (abs(GRID.centres()[0] - 0.5) < 0.2) & (abs(GRID.centres()[1] - 0.45) < 0.2)
    x, y = (GRID.coordinates(axis, "nodes") for axis in (0, 1))
    left, right = x[np.where(box.any(1))[0][[0, -1]] + [0, 1]]
    low, high = y[np.where(box.any(0))[0][[0, -1]] + [0, 1]]
    middle, half = 0.5 * np.array([left + right, low + high]), 0.5 * np.array([right - left, high - low])
    aligned = dp.cut_cells(
        GRID,
        lambda x, y: np.maximum(abs(x - middle[0]) - half[0], abs(y - middle[1]) - half[1]).round(14),
        dp.dirichlet,
    )
    assert np.array_equal(aligned.is_fluid, ~box)
    plain = dp.inverse(-dp.laplacian(GRID, dp.dirichlet, solid=box))
    assert np.allclose(aligned.solve(ONES), plain(ONES * ~box), rtol=1e-9)
    fluid = dp.cut_cells(GRID, np.ones((8, 7)), dp.dirichlet, dp.dirichlet)
    assert np.allclose(fluid.solve(ONES), dp.inverse(-dp.laplacian(GRID, dp.dirichlet))(ONES), rtol=1e-9)
    solid = dp.cut_cells(GRID, np.zeros((8, 7)), dp.dirichlet, dp.dirichlet)
    assert np.all(solid.solve(ONES) == 0) and not solid.is_fluid.any()
    nothing = dp.cut_cells(dp.Grid((0, 2)), np.ones((1, 3)), dp.dirichlet)
    assert nothing.solve(np.ones((0, 2))).shape == (0, 2)


@pytest.mark.whole
@pytest.mark.parametrize("condition", CONDITIONS, ids=repr)
def test_tiny_cells_change_nothing(condition):
    """Slivers, and a pocket of fluid around one node."""
    grid = dp.Grid((6, 5), size=1.0)
    sizes = []
    for sliver in (0.0, 1e-14, 1e-9, 1e-6):
        body = dp.cut_cells(grid, lambda x, y, sliver=sliver: x - 0.5 + sliver, dp.dirichlet, condition)
        sizes.append(np.sum(body.volumes * body.solve(np.ones(grid.shape), 0.1)))
    assert np.allclose(sizes, sizes[0], rtol=1e-5) and np.allclose(sizes[:3], sizes[0], rtol=1e-8)
    pocket = -np.ones(grid.nodes.shape)
    pocket[3, 2] = 1e-3
    body = dp.cut_cells(grid, pocket, dp.dirichlet, condition, nullspace="project")
    assert np.all(np.isfinite(body.solve(np.zeros(grid.shape), 0.7)))
    if condition == dp.dirichlet:
        assert np.allclose(body.solve(np.zeros(grid.shape), 0.7)[body.is_fluid], 0.7)


@pytest.mark.whole
def test_steps_are_not_limited_by_small_cells():
    body = dp.cut_cells(GRID, lambda x, y: hypot(x - 0.5, y - 0.45) - 0.2, dp.dirichlet, dp.robin(1.0, 0.3))
    assert np.min(body.fractions[body.is_fluid]) < 0.1
    step = dp.stepper("tr_bdf2", None, 10.0, linear=body.laplacian, source=lambda _: ONES * body.is_fluid)
    u = dp.rollout(step, 0 * ONES, None, 30)
    assert np.allclose(u, body.solve(ONES), rtol=1e-9)
    assert np.allclose(body.laplacian(u), body.diffusion(u), atol=1e-11)


@pytest.mark.whole
def test_periodic_sides_have_no_seam():
    grid = dp.Grid((8, 6), size=1.0, periodic=True)
    x, y = np.meshgrid(*(grid.coordinates(axis, "nodes") for axis in (0, 1)), indexing="ij")
    level = np.cos(2 * np.pi * x) * np.cos(2 * np.pi * y) + 0.37
    b = np.cos(2 * np.pi * grid.centres()[0])
    u = dp.cut_cells(grid, level, solid_boundary=dp.dirichlet).solve(b)
    shifted = dp.cut_cells(grid, np.roll(level, 3, 0), solid_boundary=dp.dirichlet).solve(np.roll(b, 3, 0))
    assert np.allclose(np.roll(u, 3, 0), shifted, rtol=1e-9)


@pytest.mark.whole
def test_dtypes_batches_and_coefficients():
    body = dp.cut_cells(GRID, lambda x, y: hypot(x - 0.5, y - 0.45) - 0.2, dp.dirichlet, dp.dirichlet)
    u = body.solve(ONES)
    single = body.solve(ONES.astype(np.float32))
    assert single.dtype == np.float32 and np.allclose(single, u, rtol=1e-6)
    assert np.array_equal(body.solve(ONES.astype(int)), u)
    plain = dp.cut_cells(GRID, lambda x, y: hypot(x - 0.5, y - 0.45) - 0.2)
    wind = dp.interior(GRID)(np.ones(GRID.faces.size))
    results = [
        (plain.project, (wind,)),
        (plain.advection, (u, plain.project(wind))),
        (plain.divergence, (wind,)),
        (plain.redistribute, (u,)),
        (body.gradient, (u,)),
        (body.slopes, (u,)),
        (body.flux, (u,)),
        (body.diffusion, (u,)),
    ]
    for function, arguments in results:
        exact = function(*arguments)
        single = function(*(argument.astype(np.float32) for argument in arguments))
        assert single.dtype == np.float32 and np.allclose(single, exact, atol=1e-4 * np.max(abs(exact)))
        wave = function((1j * arguments[0]).astype(np.complex64), *arguments[1:])
        assert wave.dtype == np.complex64 and np.allclose(wave, 1j * exact, atol=1e-4 * np.max(abs(exact)) + 1e-12)
    assert body.solve(ONES.astype(np.complex64)).dtype == np.complex64
    assert body.solve(ONES.astype(np.float32), k=1 + 1j).dtype == np.complex64
    assert np.allclose(body.solve(np.stack([ONES, 3 * ONES]))[1], 3 * u, rtol=1e-12)
    assert np.allclose(body.solve(ONES * 1j), 1j * u, rtol=1e-12)
    assert np.allclose(body.solve(1e250 * ONES, k=1e200), 1e50 * u, rtol=1e-9)
    far = dp.cut_cells(GRID, lambda x, y: 1e200 * (hypot(x - 0.5, y - 0.45) - 0.2), dp.dirichlet, dp.dirichlet)
    assert np.allclose(far.solve(ONES), u, rtol=1e-9)
    k = np.full(GRID.faces.size, 2.0)
    assert np.allclose(body.solve(ONES, 0.3, k=k), body.solve(ONES, 0.3, k=2.0), rtol=1e-12)
    assert np.allclose(body.solve(ONES, 0.3, k=k, wall_k=2.0), body.solve(ONES, 0.3, k=2.0), rtol=1e-12)
    assert np.allclose(body.solve(ONES + 5 * u, shift=5.0), u, rtol=1e-9)
    solve = dp.jit(lambda b, k: np.sum(body.solve(b, 0.3, k=k)))
    assert np.isclose(solve(ONES, 2.0), np.sum(body.solve(ONES, 0.3, k=2.0)), rtol=1e-12)
    assert np.isclose(solve(2 * ONES, 3.0), np.sum(body.solve(2 * ONES, 0.3, k=3.0)), rtol=1e-12)
    assert repr(body) == "<cut_cells: 42 of 42 cells hold fluid, 12 are cut, dirichlet on the wall>"


# ------------------------------------------------------------ the body as an argument of other functions


def test_a_body_as_an_argument(rng):
    body = dp.cut_cells(GRID, lambda x, y: hypot(x - 0.5, y - 0.45) - 0.2, dp.dirichlet, dp.robin(1.0, 0.3))
    conditions = {"boundary": dp.dirichlet, "solid_boundary": dp.robin(1.0, 0.3)}
    assert dp.laplacian(GRID, solid=body, **conditions) is body.laplacian
    solve = dp.elliptic_solver(dp.divergence(GRID), body, rtol=1e-12)
    b = rng.standard_normal((2, *GRID.shape))
    k = rng.uniform(1.0, 2.0, GRID.faces.size)
    assert np.array_equal(solve(k, b, 0.5), body.solve(b, k=k, shift=0.5))
    assert solve.info.forward.status == "converged" and body.solve(b) is not None
    assert repr(solve) == f"<elliptic_solver: {body}>"

    def loss(radius, k):
        disc = dp.cut_cells(GRID, lambda x, y: hypot(x - 0.5, y - 0.45) - radius, dp.dirichlet, dp.dirichlet)
        return np.sum(disc.volumes * dp.elliptic_solver(dp.divergence(GRID), disc)(k, b[0]))

    h = 1e-6
    slope = dp.grad(loss)(0.21, k)
    assert np.isclose(slope, (loss(0.21 + h, k) - loss(0.21 - h, k)) / (2 * h), rtol=1e-6)


def test_functions_without_a_body_name_its_method():
    body = dp.cut_cells(GRID, lambda x, y: x - 0.5, dp.dirichlet)
    with pytest.raises(
        TypeError,
        match="^gradient takes a boolean array as solid, got a body of cut_cells; write "
        r"body.gradient\(u\), or dp.laplacian\(grid, solid=body\)$",
    ):
        dp.gradient(GRID, solid=body)
    with pytest.raises(
        TypeError, match="^this function takes a boolean array.*; write solid=~body.is_fluid for a stair"
    ):
        dp.interior(GRID, solid=body)
    with pytest.raises(
        ValueError,
        match="^laplacian needs the conditions of its body of cut_cells as boundary and solid_boundary, got others; "
        "write body.laplacian$",
    ):
        dp.laplacian(GRID, solid=body)
    with pytest.raises(
        ValueError,
        match=r"^laplacian takes a body of cut_cells on its grid Grid\(7 x 6 cells, size 7 x 6\), got one on Grid\(7 ",
    ):
        dp.laplacian(dp.Grid((7, 6)), dp.dirichlet, solid=body)
    with pytest.raises(
        ValueError,
        match="^elliptic_solver with a body of cut_cells takes the divergence of order 2 as D, got .*; write "
        r"dp.elliptic_solver\(dp.divergence\(body.grid\), body\)$",
    ):
        dp.elliptic_solver(2.0 * dp.divergence(GRID), body)
    with pytest.raises(TypeError, match="elliptic_solver, as D,"):
        dp.elliptic_solver(GRID, body)


# ------------------------------------------------------------ derivatives


def scene(dim, condition, n):
    """A loss of a body and of everything that it depends on."""
    grid = dp.Grid((n,) * dim, size=2.0, origin=-1.0)
    b, weights, values = np.random.default_rng(dim).standard_normal((3, *grid.shape))
    nodes = np.meshgrid(*(grid.coordinates(axis, "nodes") for axis in range(dim)), indexing="ij")

    def loss(q):
        radius = np.sqrt(sum((x - 0.03 * q[2]) ** 2 * (1 + 0.1 * q[1] * axis) for axis, x in enumerate(nodes)))
        body = dp.cut_cells(grid, radius - 0.61 * q[0], dp.dirichlet, condition)
        k = q[5] * (1 + 0.1 * np.sin(np.arange(grid.faces.size)))
        u = body.solve(b * np.sin(q[3]), values * q[4], k=k, shift=q[6])
        flux = np.sum(body.flux(u, values * q[4], k))
        return np.sum(weights * u * body.volumes) + flux + np.sum(body.areas * body.centroids[-1] ** 2)

    return loss, np.array([1.0, 1.1, 0.9, 0.7, 0.8, 1.2, 0.3])


def test_derivatives_agree_with_differences():
    loss, q = scene(2, dp.robin(1.0, 0.3), 7)
    direction = np.array([1.0, -0.5, 0.7, 0.2, -0.3, 0.4, 0.6])
    exact = np.dot(dp.grad(loss)(q), direction)
    assert np.isclose(dp.jvp(loss, q, direction)[1], exact, rtol=1e-10)
    differences = [(loss(q + h * direction) - loss(q - h * direction)) / (2 * h) for h in (2e-5, 4e-5)]
    assert np.isclose((4 * differences[0] - differences[1]) / 3, exact, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("condition", CONDITIONS, ids=repr)
@pytest.mark.parametrize("dim", [1, 2])
def test_first_and_second_derivatives(dim, condition):
    loss, q = scene(dim, condition, 9)
    assert dp.check.gradient(loss, q, quick=True).verdict == "agrees"
    slope = dp.grad(loss)
    assert dp.check.gradient(lambda q: np.dot(slope(q), np.arange(1.0, 8.0)), q, quick=True).verdict == "agrees"


@pytest.mark.whole
def test_derivatives_in_three_dimensions():
    loss, q = scene(3, dp.dirichlet, 6)
    direction = np.array([1.0, -0.5, 0.7, 0.2, -0.3, 0.4, 0.6])
    value = dp.hvp(loss, q, direction)
    h = 1e-4
    slope = dp.grad(loss)
    assert np.allclose(value, (slope(q + h * direction) - slope(q - h * direction)) / (2 * h), rtol=1e-4, atol=1e-4)


@pytest.mark.whole
def test_the_level_on_a_grid_line_has_the_derivative_of_the_fluid_side():
    grid = dp.Grid(6, size=1.0)

    def size(x):
        rod = dp.cut_cells(grid, lambda c: x - c, dp.dirichlet, dp.dirichlet)
        return np.sum(rod.volumes * rod.solve(np.ones(6))) / (1 / 12)

    assert np.isclose(size(0.5), 0.125, rtol=0.2)
    h = 1e-5
    assert np.isclose(dp.grad(size)(0.5), (size(0.5) - size(0.5 - h)) / h, rtol=1e-3)


# ------------------------------------------------------------ convergence


def disc_errors(n, inside, condition):
    """Error in L2, in the maximum norm, and of the flux, for a field with all derivatives, around and inside a disc."""
    grid = dp.Grid((n, n), size=2.0, origin=-1.0)
    x0, y0, radius = 0.03, -0.021, 0.6183
    side = 1.0 if inside else -1.0
    body = dp.cut_cells(
        grid,
        lambda x, y: side * (radius - hypot(x - x0, y - y0)),
        dp.dirichlet,
        condition,
        nullspace="project",
    )

    def exact(x, y):
        return np.sin(1.7 * x + 0.3) * np.exp(0.8 * y) + x * x * y

    x, y = body.centroids
    distance = hypot(x - x0, y - y0)
    slope_x = 1.7 * np.cos(1.7 * x + 0.3) * np.exp(0.8 * y) + 2 * x * y
    slope_y = 0.8 * np.sin(1.7 * x + 0.3) * np.exp(0.8 * y) + x * x
    slope = side * (slope_x * (x - x0) + slope_y * (y - y0)) / distance
    values = condition.a * exact(x, y) + condition.b * slope
    c = grid.coordinates(0)
    sides = exact(-1, c)[None], exact(1, c)[None], exact(c, -1)[:, None], exact(c, 1)[:, None]
    x, y = grid.centres()
    laplacian = (0.64 - 2.89) * np.sin(1.7 * x + 0.3) * np.exp(0.8 * y) + 2 * y
    u = body.solve(-laplacian, values, dp.lift(grid, dp.dirichlet).domain.join(*sides))
    error = body.is_fluid * (u - exact(x, y))
    if inside and condition == dp.neumann:
        error = body.is_fluid * (error - np.sum(body.volumes * error) / np.sum(body.volumes))
    flux = np.sum(body.flux(u, values))
    expected = side * -0.8693302
    return np.array([np.sqrt(np.sum(body.volumes * error**2)), np.max(abs(error)), abs(flux / expected - 1)])


@pytest.mark.whole
@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize("condition", [*CONDITIONS, dp.robin(1.0, 0.01)], ids=repr)
def test_orders_around_and_inside_a_disc(inside, condition):
    errors = np.array([disc_errors(n, inside, condition) for n in (16, 32, 64, 128)])
    orders = np.log2(errors[0] / errors[-1]) / 3
    assert orders[0] >= 1.9 and orders[1] >= 1.5, orders
    assert errors[2, 2] < 5e-3 and errors[3, 2] < 1e-3


def test_charge_of_a_coaxial_line():
    """Two cylinders at the potentials 1 and 0: the charge is 2 pi / log(b / a)."""
    grid = dp.Grid((64, 64), size=2.0, origin=-1.0)
    line = dp.cut_cells(
        grid, lambda x, y: np.minimum(hypot(x, y) - 0.35, 0.9 - hypot(x, y)), solid_boundary=dp.dirichlet
    )
    inner = hypot(*grid.centres()) < 0.6
    u = line.solve(np.zeros(grid.shape), inner * 1.0)
    charges = line.flux(u, inner * 1.0)
    expected = 2 * np.pi / np.log(0.9 / 0.35)
    assert np.isclose(np.sum(charges[inner]), expected, rtol=5e-3)
    assert np.isclose(np.sum(charges), 0.0, atol=1e-9)


# ------------------------------------------------------------ only neumann conditions


def test_the_free_constant_is_that_of_inverse():
    """The volume-weighted mean is 0, and right-hand sides are projected in the same inner product."""
    grid = dp.Grid(6, spacing=[np.array([1.0, 1.0, 1.0, 1.0, 1.0, 5.0])])
    b = np.cos(np.arange(6.0))
    b = b - np.sum(grid.volumes * b) / 10.0
    everywhere = dp.cut_cells(grid, np.ones(7))
    expected = dp.inverse(-dp.laplacian(grid))(b)
    assert np.allclose(everywhere.solve(b), expected, rtol=1e-12)
    assert abs(np.sum(grid.volumes * everywhere.solve(b))) < 1e-14
    assert np.allclose(dp.cut_cells(grid, np.ones(7), nullspace="project").solve(b + 3.0), expected, rtol=1e-12)
    with pytest.raises(IncompatibleError, match="cut_cells is singular"):
        everywhere.solve(b + 0.1)


def test_the_free_constant_is_continuous_where_the_wall_passes_a_node(rng):
    b = rng.standard_normal(GRID.shape)
    node = GRID.coordinates(0, "nodes")[3]
    solutions = []
    for sliver in (0.0, 1e-12, 1e-8):
        body = dp.cut_cells(GRID, lambda x, y, sliver=sliver: x - node + sliver, nullspace="project")
        u = body.solve(b)
        assert abs(np.sum(body.volumes * u)) < 1e-14
        assert np.allclose(dp.inverse(-body.laplacian, nullspace="project")(b * body.is_fluid), u, atol=1e-12)
        solutions.append(u[3:])
    assert np.allclose(solutions, solutions[0], atol=1e-6)


def test_components_have_a_constant_each(rng):
    b = rng.standard_normal((2, *GRID.shape))
    strip = dp.cut_cells(GRID, lambda x, y: abs(x - 0.5) - 0.11, nullspace="project")
    u = strip.solve(b + 1j * b[::-1])
    sums = strip.volumes * u
    assert np.allclose([np.sum(sums[:, :4], (1, 2)), np.sum(sums[:, 4:], (1, 2))], 0.0, atol=1e-14)
    assert np.allclose(u[0], strip.solve(b[0]) + 1j * strip.solve(b[1]), atol=1e-12)


def test_coefficients_of_0_divide_the_fluid_into_components(rng):
    """Which cells are connected depends on k, also in programs of jit that are recorded with another k."""
    body = dp.cut_cells(GRID, lambda x, y: hypot(x - 0.5, y - 0.45) - 0.13, nullspace="project")
    b = rng.standard_normal(GRID.shape)
    kx, ky = (np.array(part) for part in GRID.faces.split(np.ones(GRID.faces.size)))
    kx[2] = 0.0
    divided = GRID.join(kx, ky)
    u = body.solve(b, k=divided)
    assert np.allclose([np.sum((body.volumes * u)[:2]), np.sum((body.volumes * u)[2:])], 0.0, atol=1e-14)
    program = dp.jit(lambda k: body.solve(b, k=k))
    assert np.array_equal(program(np.ones(GRID.faces.size)), body.solve(b))
    assert np.array_equal(program(divided), u)
    gradient = dp.jit(dp.grad(lambda b, k: np.sum(body.solve(b, k=k) ** 3)))
    plain = dp.grad(lambda b: np.sum(body.solve(b, k=divided) ** 3))(b)
    assert gradient(b, np.ones(GRID.faces.size)).shape == b.shape
    assert np.allclose(gradient(b, divided), plain, rtol=1e-12)


def test_derivatives_of_the_free_constant(rng):
    grid = dp.Grid((5, 4), size=(1.1, 0.9))
    b, weights = rng.standard_normal((2, *grid.shape))

    def loss(q):
        body = dp.cut_cells(grid, lambda x, y: 0.34 * q[0] - hypot(x - 0.52, y - 0.41), nullspace="project")
        u = body.solve(q[1] * b, 0.3 * q[1], k=q[2])
        return np.sum(weights * u * body.volumes) + np.sum(body.volumes * np.sin(3 * u))

    q, direction = np.array([1.05, 0.9, 1.1]), np.array([1.0, -0.5, 0.7])
    h = 1e-5
    slope = np.dot(dp.grad(loss)(q), direction)
    assert np.isclose(slope, (loss(q + h * direction) - loss(q - h * direction)) / (2 * h), rtol=1e-7)
    assert np.isclose(dp.jvp(loss, q, direction)[1], slope, rtol=1e-9)
    second = (dp.grad(loss)(q + h * direction) - dp.grad(loss)(q - h * direction)) / (2 * h)
    assert np.allclose(dp.hvp(loss, q, direction), second, rtol=1e-6)


# ------------------------------------------------------------ flows around a body


def stream(n, radius=0.61):
    """A body in a stream along x, a velocity that enters and leaves, and the exact potential flow in a plane."""
    grid = dp.Grid((n, n), size=4.0, origin=-2.0)
    body = dp.cut_cells(grid, lambda x, y: hypot(x - 0.013, y + 0.021) - radius)

    def exact(axis):
        x, y = grid.face_centres(axis)
        x, y = x - 0.013, y + 0.021
        squares = np.maximum(x * x + y * y, 0.1)
        along = 1.0 - radius**2 * (x * x - y * y) / squares**2
        return along if axis == 0 else -2.0 * radius**2 * x * y / squares**2

    u, v = exact(0), exact(1)
    start_u, start_v = np.ones(u.shape), np.zeros(v.shape)
    start_u[[0, -1]], start_v[:, [0, -1]] = u[[0, -1]], v[:, [0, -1]]
    entering = grid.join(start_u, start_v)
    net = np.sum(body.volumes * body.divergence(entering))
    start_u[-1] -= net / 4.0
    return grid, body, grid.join(start_u, start_v), grid.join(u, v)


def test_projection_around_a_body():
    grid, body, entering, exact = stream(32)
    v = body.project(entering)
    assert np.max(abs(body.volumes * body.divergence(v))) < 1e-10
    assert np.sqrt(np.mean(((v - exact) * (body.apertures > 0)) ** 2)) < 0.01
    assert np.allclose(body.project(v), v, atol=1e-9)
    w = np.random.default_rng(0).standard_normal(grid.faces.size)
    w = dp.interior(grid)(w) * (body.apertures > 0)
    weights = body.apertures * grid.faces.volumes  # the projection is orthogonal in this inner product
    assert np.isclose(np.sum(weights * body.project(w) * (w - body.project(w))), 0.0, atol=1e-9)
    with pytest.raises(
        IncompatibleError,
        match="^project of cut_cells: inflow and outflow through the walls of a connected region differ; make the "
        "velocity on the walls balance, or open a wall with boundary=dp.dirichlet$",
    ):
        body.project(entering * (grid.join(grid.face_centres(0)[0], grid.face_centres(1)[0]) < 1.9))
    with pytest.raises(
        ValueError,
        match="^project of cut_cells needs solid_boundary=dp.neumann, got dirichlet; build another body$",
    ):
        dp.cut_cells(GRID, np.ones(GRID.nodes.shape), dp.dirichlet, dp.dirichlet).project(np.ones(GRID.faces.size))


@pytest.mark.whole
def test_explicit_transport_with_small_cells_is_stable_and_conservative():
    grid, body, entering, _ = stream(32)
    assert np.min(body.fractions[body.is_fluid]) < 0.02
    v = body.project(entering)
    x, y = grid.centres()
    u = np.exp(-((x + 1.2) ** 2 + (y - 0.1) ** 2) / 0.1) * body.is_fluid
    dt = 0.4 * (4.0 / 32) / np.max(abs(v))
    mass = np.sum(body.volumes * u)
    for _ in range(15):
        u = u + dt * body.advection(u, v)
    assert np.isclose(np.sum(body.volumes * u), mass, rtol=1e-6)  # almost nothing has arrived at the walls
    for _ in range(100):
        u = u + dt * body.advection(u, v)
    assert -1e-6 < np.min(u) and np.max(u) < 1.0
    ones = 1.0 * body.is_fluid
    assert np.allclose(body.advection(ones, v, 1.0), 0.0, atol=1e-7)  # constants are kept
    rate = np.random.default_rng(0).standard_normal(grid.shape) * body.is_fluid
    assert np.isclose(np.sum(body.volumes * body.redistribute(rate)), np.sum(body.volumes * rate), atol=1e-14)


@pytest.mark.whole
def test_derivatives_of_flows_around_a_body():
    grid = dp.Grid((7, 6), size=(1.1, 0.9))
    u, w = np.random.default_rng(0).standard_normal((2, *grid.shape))
    wind = dp.interior(grid)(np.random.default_rng(1).standard_normal(grid.faces.size))

    def loss(q):
        body = dp.cut_cells(grid, lambda x, y: hypot(x - 0.52, y - 0.41) - 0.2 * q[0])
        v = body.project(q[1] * wind)
        return np.sum(w * body.advection(u * q[2], v, 0.3)) + np.sum(w * body.divergence(v**2))

    q = np.array([1.05, 0.9, 1.1])
    direction = np.array([1.0, -0.5, 0.7])
    slope = np.dot(dp.grad(loss)(q), direction)
    h = 1e-5
    assert np.isclose(slope, (loss(q + h * direction) - loss(q - h * direction)) / (2 * h), rtol=1e-6)
    assert np.isclose(dp.jvp(loss, q, direction)[1], slope, rtol=1e-9)


# ------------------------------------------------------------ errors


def test_errors_name_the_argument():
    level = np.ones(GRID.nodes.shape)
    body = dp.cut_cells(GRID, lambda x, y: x - 0.5, dp.dirichlet)
    wrong_shape = (
        r"^the level of cut_cells takes a field on nodes\(7, 6\) of shape \(8, 7\), got an array of shape \(7, 6\)$"
    )
    with pytest.raises(ShapeError, match=wrong_shape):
        dp.cut_cells(GRID, ONES)
    with pytest.raises(NonFiniteError, match="the level of cut_cells must be finite"):
        dp.cut_cells(GRID, np.nan * level)
    with pytest.raises(TypeError, match="the level of cut_cells must hold real numbers"):
        dp.cut_cells(GRID, 1j * level)
    with pytest.raises(TypeError, match="solid_boundary needs one condition"):
        dp.cut_cells(GRID, level, solid_boundary={"x": dp.neumann})
    with pytest.raises(
        ShapeError, match=r"^b of cut_cells takes a field on cells\(7, 6\), got an array of shape \(3,\)$"
    ):
        body.solve(np.ones(3))
    with pytest.raises(
        ShapeError,
        match=r"^values of cut_cells takes a number or a field on cells\(7, 6\), got an array of shape \(3,\)$",
    ):
        body.solve(ONES, np.ones(3))
    with pytest.raises(ShapeError, match="v of cut_cells takes a number or a field on faces"):
        body.project(np.ones(3))
    with pytest.raises(ShapeError, match="u of cut_cells takes a number or a field on cells"):
        body.advection(np.ones(3), np.ones(GRID.faces.size))
    with pytest.raises(NonFiniteError, match="v of cut_cells must be finite"):
        body.project(np.full(GRID.faces.size, np.nan))
    with pytest.raises(NonFiniteError, match="values of cut_cells must be finite"):
        body.solve(ONES, np.inf)
    outside = np.where(body.is_fluid, 0.0, 1.0)
    with pytest.raises(IncompatibleError, match="the right-hand side must be 0 where there is no unknown"):
        dp.inverse(-body.laplacian)(ONES + outside)
    assert np.all(dp.inverse(-body.laplacian)(ONES * body.is_fluid)[~body.is_fluid] == 0)
    with pytest.raises(ValueError, match=r"^k of cut_cells must be >= 0, got -2$"):
        body.solve(ONES, k=-2.0)
    with pytest.raises(IncompatibleError, match="cut_cells is singular"):
        dp.cut_cells(GRID, lambda x, y: x - 0.5).solve(ONES)
    with pytest.raises(
        JitError,
        match="^dp.jit cannot record the level of cut_cells, whose values decide which cells are cut; call the "
        "function without dp.jit$",
    ):
        dp.jit(lambda level: np.sum(dp.cut_cells(GRID, level, dp.dirichlet).solve(ONES)))(level)
    with pytest.raises(
        DerivativeError,
        match=r"^the laplacian of cut_cells needs a plain level, got a traced one; write body.diffusion\(u\) or "
        r"body.solve\(b\)$",
    ):
        dp.grad(lambda r: np.sum(dp.cut_cells(GRID, lambda x, y: x - r).laplacian(ONES)))(0.5)


def test_a_robin_condition_without_u_divides_by_b(rng):
    """robin(0, b) with the value b g is neumann with the value g, and whole numbers give float results."""
    grid = dp.Grid((8, 8), size=2.0, origin=-1.0)
    bodies = [
        dp.cut_cells(grid, lambda x, y: 0.7 - np.sqrt(x**2 + y**2), solid_boundary=wall)
        for wall in (dp.robin(0.0, 2.0), dp.neumann)
    ]
    b = rng.standard_normal(grid.shape)
    scaled, plain = (body.solve(b, values=value, shift=1.0) for body, value in zip(bodies, (2.0, 1.0), strict=True))
    onp.testing.assert_allclose(scaled, plain, rtol=1e-12)
    slopes = [body.slopes(b, value) for body, value in zip(bodies, (2.0, 1.0), strict=True)]
    onp.testing.assert_allclose(*slopes, rtol=1e-14)
    assert bodies[1].diffusion(onp.ones(grid.shape, onp.int8)).dtype == float


@pytest.mark.parametrize("outside", [True, False])
@pytest.mark.parametrize("condition", [dp.dirichlet, dp.robin(1.0, 0.5)])
def test_derivatives_are_one_sided_where_the_wall_touches_nodes(outside, condition):
    """They were of neither side: the normal in a cell that the wall touches in a node was the diagonal of the cell."""
    grid = dp.Grid((16, 16), size=2.0, origin=-1.0)
    sign = 1.0 if outside else -1.0

    def flux(radius):
        level = lambda x, y: sign * (np.sqrt(x**2 + y**2) - radius)
        body = dp.cut_cells(grid, level, dp.dirichlet, condition)
        return np.sum(body.flux(body.solve(np.ones(grid.shape))))

    step = sign * 1e-6  # towards a level that sinks
    slope = (flux(0.375 + step) - flux(0.375)) / step
    assert dp.grad(flux)(0.375) == pytest.approx(slope, rel=1e-4)
