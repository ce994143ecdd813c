"""Boundary conditions on part of a wall, against matrices that are assembled face by face from the definition."""

import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.backend import Backend
from sparsedp.grid.boundary_conditions import dirichlet, neumann, patch, resolve, robin

BOX = dp.Grid((3, 4), spacing=[[0.5, 0.3, 0.2], [0.1, 0.4, 0.3, 0.2]], origin=(1.0, -0.5))
CUBE = dp.Grid((2, 3, 4), size=(1.0, 3.0, 2.0))
DISC = np.array([[False, True, True, False], [True, True, True, True], [False, True, True, False]])

# For each grid: the argument boundary=, and the condition (a, b) of each face of each wall, written out by hand.
D, N, R = (1.0, 0.0), (0.0, 1.0), (2.0, 0.5)
SCENES = {
    "2-D": (
        BOX,
        {
            "x": (patch((-0.5, 0.0), dirichlet, patch((0.0, 0.3), robin(2.0, 0.5))), neumann),
            "y": (robin(2.0, 0.5), patch([True, False, True], neumann, elsewhere=dirichlet)),
        },
        [[D, D, R, N], [N, N, N, N], [R, R, R], [N, D, N]],
    ),
    "2-D, one axis periodic": (
        dp.Grid((4, 3), size=1.0, periodic=(True, False)),
        {"y": patch((0.25, 0.5), robin(2.0, 0.5), elsewhere=dirichlet)},
        [[D, R, D, D], [D, R, D, D]],
    ),
    "3-D": (
        CUBE,
        {
            "x": (patch(((1.0, 3.0), (0.0, 1.0)), dirichlet, elsewhere=robin(2.0, 0.5)), patch(DISC, dirichlet)),
            "y": (neumann, dirichlet),
            "z": (patch((None, (1.0, 2.0)), robin(2.0, 0.5), elsewhere=dirichlet), neumann),
        },
        [
            [R, R, R, R, D, D, R, R, D, D, R, R],
            [N, D, D, N, D, D, D, D, N, D, D, N],
            [N] * 8,
            [D] * 8,
            [D, R, D, D, R, D],
            [N] * 6,
        ],
    ),
}


def by_hand(grid, conditions):
    """Return the dense matrices of gradient, divergence, lift and average, from loops over cells, faces and walls."""
    faces = grid.faces.size
    number = np.arange(grid.cells.size).reshape(grid.shape)
    G = np.zeros((faces, number.size))
    average = np.zeros((faces, number.size))
    div = np.zeros((number.size, faces))
    wall_columns = []
    walls = iter(conditions)
    for axis in range(grid.dim):
        h = grid.widths[axis]
        n = h.size
        face = grid.faces.offsets[axis] + np.arange(np.prod(grid.face_shape(axis))).reshape(grid.face_shape(axis))
        face = np.moveaxis(face, axis, 0)
        cells = np.moveaxis(number, axis, 0)
        for i in range(n):
            above = face[(i + 1) % len(face)]
            div[cells[i].ravel(), above.ravel()] += 1 / h[i]
            div[cells[i].ravel(), face[i].ravel()] -= 1 / h[i]
        for i in range(0 if grid.periodic[axis] else 1, n):
            rows = face[i].ravel()
            lower, upper = cells[i - 1].ravel(), cells[i].ravel()
            G[rows, upper] += 2 / (h[i] + h[i - 1])
            G[rows, lower] -= 2 / (h[i] + h[i - 1])
            average[rows, upper] += h[i - 1] / (h[i] + h[i - 1])
            average[rows, lower] += h[i] / (h[i] + h[i - 1])
        if grid.periodic[axis]:
            continue
        for i, sign in ((0, -1), (n, 1)):
            half = h[min(i, n - 1)] / 2
            at_wall = zip(face[i].ravel(), cells[min(i, n - 1)].ravel(), next(walls), strict=True)
            for row, cell, (a, b) in at_wall:
                G[row, cell] = -sign * a / (a * half + b)
                average[row, cell] = b / (a * half + b)
                column = np.zeros(faces)
                column[row] = sign / (a * half + b)
                wall_columns.append(column)
    return G, div, np.transpose(wall_columns), average


@pytest.fixture(params=SCENES)
def scene(request):
    return SCENES[request.param]


def test_matrices_are_those_of_the_definition(scene, rng):
    grid, boundary, conditions = scene
    G, div, B, average = by_hand(grid, conditions)
    wanted = {
        dp.gradient(grid, boundary): G,
        dp.laplacian(grid, boundary): div @ G,
        dp.lift(grid, boundary): B,
        dp.average(grid, boundary): average,
        dp.upwind(grid, "y", -1, boundary): upstream(grid, G),
    }
    for op, matrix in wanted.items():
        np.testing.assert_allclose(op.matrix.toarray(), matrix, rtol=1e-14, atol=1e-13)
        free = op.matrix_free()
        u = rng.standard_normal((2, *op.domain.shape))  # a batch
        product = u.reshape(2, -1) @ matrix.T
        np.testing.assert_allclose(free(u).reshape(2, -1), product, rtol=1e-13, atol=1e-12)
        v = rng.standard_normal(op.codomain.shape)
        np.testing.assert_allclose(free.T(v).ravel(), v.ravel() @ matrix, rtol=1e-13, atol=1e-12)


def upstream(grid, G):
    """Return the rows of G on the upper y-face of each cell."""
    return G[upper_y_faces(grid)]


def upper_y_faces(grid):
    part = np.arange(grid.faces.offsets[1], grid.faces.offsets[2]).reshape(grid.face_shape(1))
    return part.take(range(1, grid.shape[1] + 1), axis=1).ravel()


@pytest.mark.whole
def test_adjoint_identities_hold_in_every_dtype(scene):
    grid, boundary, _ = scene
    for op in (dp.gradient(grid, boundary), dp.lift(grid, boundary)):
        for form in (op.explicit(), op.matrix_free()):
            assert dp.check.operator(form)
    assert dp.check.operator(dp.inverse(-dp.laplacian(grid, boundary)))


def test_a_full_patch_and_a_patch_of_the_same_condition_are_the_plain_condition():
    plain = dp.laplacian(BOX, {"x": (dirichlet, neumann)})
    for wall in (patch((-0.5, 0.5), dirichlet), patch((0.0, 0.3), dirichlet, elsewhere=dirichlet)):
        op = dp.laplacian(BOX, {"x": (wall, neumann)})
        assert op.separable and op.name == "laplacian"
        assert (op.matrix != plain.matrix).nnz == 0
    line = dp.Grid(3)
    assert resolve(line, (patch([True], dirichlet), neumann)) == ((dirichlet, neumann),)


def test_numbers_for_walls_with_several_conditions():
    """Only 0, on the walls that have them; pickled too."""
    domain = dp.lift(BOX, {"x": (patch((0.0, 0.3), dirichlet), neumann)}).domain
    for space in (domain, pickle.loads(pickle.dumps(domain))):
        assert np.count_nonzero(space.join(0.0, 1.0, 2.0, 3.0)) == 4 + 3 + 3
        assert np.count_nonzero(space.join(np.ones(4), 0, 0, 0)) == 4
        with pytest.raises(ValueError, match="x-lower has several conditions, and one number"):
            dp.grad(lambda heat: anp.sum(space.join(heat, 0.0, 0.0, 0.0)))(0.0)


def test_which_faces_belong_to_an_interval():
    """Those whose centre lies in it; an end on a centre belongs to the upper interval only, whatever the rounding."""
    grid = dp.Grid((1, 5), spacing=0.1)
    for start, stop, faces in ((0.06, 0.34, [1, 2]), (0.15, 0.35, [1, 2]), (0.05, 0.15, [0]), (0.0, 0.051, [0])):
        ((wall, _), _) = resolve(grid, {"x": (patch((start, stop), dirichlet), neumann)}, patches=True)
        assert np.flatnonzero(wall.faces_with(lambda condition: condition == dirichlet)).tolist() == faces


def test_ways_to_write_the_same_part_of_a_wall():
    pair = patch((0.0, 0.3), dirichlet)
    assert pair == patch([0.0, 0.3], dirichlet) == patch(np.array([0.0, 0.3]), dirichlet)
    flags = [False, False, True, False]
    walls = [resolve(BOX, {"x": (patch(m, dirichlet), neumann)}, patches=True) for m in (flags, np.array([flags]))]
    assert walls[0] == walls[1] == resolve(BOX, {"x": (pair, neumann)}, patches=True)


def test_grids_without_cells_have_patches():
    grid = dp.Grid((0, 4))
    one_face = {"x": (patch([True, False, False, False], dirichlet), neumann)}
    assert dp.laplacian(grid, one_face).matrix.shape == (0, 0)
    assert not np.any(dp.lift(grid, one_face)(np.ones(8)))


def test_null_space_is_seen_through_patches():
    one_face = patch([False, True, False, False], dirichlet)
    free = patch([False, True, False, False], neumann)
    assert dp.inverse(-dp.laplacian(BOX, {"x": one_face})).solver.system.null_space.count == 0
    assert dp.inverse(-dp.laplacian(BOX, {"x": free})).solver.system.null_space.count == 1


@pytest.mark.parametrize("method", ["auto", "direct", "krylov", "multigrid"])
def test_solves_and_their_transposes_agree_with_a_dense_solve(method, rng):
    grid, boundary, conditions = SCENES["2-D"]
    G, div, B, _ = by_hand(grid, conditions)
    inverse = dp.inverse(-dp.laplacian(grid, boundary), method)
    b = rng.standard_normal((2, *grid.shape))  # a batch
    for solve, matrix in ((inverse, -div @ G), (inverse.T, (-div @ G).T)):
        x = np.linalg.solve(matrix, b.reshape(2, -1).T).T
        np.testing.assert_allclose(solve(b).reshape(2, -1), x, rtol=1e-8, atol=1e-9)
    k = np.exp(rng.standard_normal(grid.faces.shape))
    values = rng.standard_normal(B.shape[1])
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, boundary), method)
    lift = dp.lift(grid, boundary)
    x = solve(k, b[0] + dp.divergence(grid)(k * lift(values)), 0.5)
    matrix = 0.5 * np.eye(grid.cells.size) - div @ (k[:, None] * G)
    dense = np.linalg.solve(matrix, b[0].ravel() + div @ (k * (B @ values)))
    np.testing.assert_allclose(x.ravel(), dense, rtol=1e-8, atol=1e-9)


def test_transforms_do_not_take_a_patch():
    grid = dp.Grid((40, 40), size=1.0)
    op = -dp.laplacian(grid, {"x": patch((0.2, 0.4), dirichlet)})
    assert not op.separable
    with pytest.raises(ValueError, match="separable"):
        dp.inverse(op, "separable")


def errors_of_poisson(n):
    """Return the largest error of -div grad u = f with all three conditions along one wall, u smooth across them."""
    grid = dp.Grid((n, n), size=1.0)
    sides = {
        "x": (patch((0.25, 0.5), dirichlet, patch((0.5, 0.75), robin(3.0, 2.0))), neumann),
        "y": (neumann, patch((0.0, 0.5), robin(1.0, 1.0), elsewhere=dirichlet)),
    }
    x, y = grid.centres()
    t = grid.coordinates(0)
    exact = np.exp(x) * np.sin(2 * y + 0.3)
    # the values of the conditions: u at x = 0 is s, du/dn = -s there
    s = np.sin(2 * t + 0.3)
    left = np.select([(t > 0.25) & (t < 0.5), (t > 0.5) & (t < 0.75)], [s, 3 * s - 2 * s], -s)
    right = np.e * s
    bottom = -2 * np.exp(t) * np.cos(0.3)
    u_top, slope_top = np.exp(t) * np.sin(2.3), 2 * np.exp(t) * np.cos(2.3)
    top = np.where(t < 0.5, u_top + slope_top, u_top)
    div, B = dp.divergence(grid), dp.lift(grid, sides)
    u = dp.inverse(-dp.laplacian(grid, sides))(3 * exact + div(B(B.domain.join(left, right, bottom, top))))
    return np.max(np.abs(u - exact))


def test_mixed_conditions_along_one_wall_have_order_two():
    errors = [errors_of_poisson(n) for n in (16, 32, 64)]
    assert 1.9 <= np.log2(errors[0] / errors[1]) <= 2.2 and 1.9 <= np.log2(errors[1] / errors[2]) <= 2.2


def errors_beside_a_singularity(n):
    """Return the largest and the mean error of sqrt(r) sin(angle / 2): 0 on half of a wall, insulated on the other."""
    grid = dp.Grid((n, n), size=1.0, origin=(-0.5, 0.0))
    sides = {"x": dirichlet, "y": (patch((0.0, 0.5), dirichlet, elsewhere=neumann), dirichlet)}

    def exact(x, y):
        return np.sqrt(np.hypot(x, y)) * np.sin(np.arctan2(y, x) / 2)

    x, y = (grid.coordinates(axis) for axis in range(2))
    div, B = dp.divergence(grid), dp.lift(grid, sides)
    values = B.domain.join(exact(-0.5, y), exact(0.5, y), 0.0, exact(x, 1.0))
    error = np.abs(dp.inverse(-dp.laplacian(grid, sides))(div(B(values))) - exact(*grid.centres()))
    return np.array([np.max(error), np.mean(error)])


def test_the_orders_where_dirichlet_and_neumann_meet_are_those_of_the_documentation():
    largest, mean = np.log2(errors_beside_a_singularity(32) / errors_beside_a_singularity(64))
    assert 0.4 <= largest <= 0.6 and 0.9 <= mean <= 1.1


def loss_of_data(rng):
    """Return a loss of values on a patch, a conductivity and a heat transfer coefficient along a patch; and a point."""
    grid = dp.Grid((4, 4), size=1.0)
    sides = {"x": (patch((0.25, 0.75), dirichlet), patch((0.0, 0.5), dirichlet))}
    div, B = dp.divergence(grid), dp.lift(grid, sides)
    solve = dp.elliptic_solver(div, dp.gradient(grid, sides))
    weights = rng.standard_normal(grid.shape)

    def loss(p):
        films = sides["x"][1].values(grid, "x", 1 / p["transfer"])
        k = 1 / (1 / p["k"] + anp.abs(B(B.domain.join(0.0, films, 0.0, 0.0))))
        walls = B.domain.join(sides["x"][0].values(grid, "x", p["inlet"]), 0.3 * np.ones(4), 0.0, 0.0)
        return anp.sum(weights * solve(k, 1.0 + div(k * B(walls))) ** 2)

    p = {"transfer": 1 + rng.random(4), "k": np.array(0.7), "inlet": rng.standard_normal(4)}
    return loss, p


def test_gradients_in_the_data_of_patches(rng):
    loss, p = loss_of_data(rng)
    gradient = dp.grad(loss)(p)
    assert np.array_equal(gradient["inlet"] != 0, [False, True, True, False])
    assert np.array_equal(gradient["transfer"] != 0, [True, True, False, False])
    change = {name: rng.standard_normal(np.shape(value)) for name, value in p.items()}
    values = [loss({name: p[name] + t * change[name] for name in p}) for t in (1e-5, -1e-5)]
    slope = sum(np.sum(gradient[name] * change[name]) for name in p)
    assert abs((values[0] - values[1]) / 2e-5 - slope) <= 1e-7 * abs(slope)


@pytest.mark.whole
def test_gradients_in_the_data_of_patches_to_second_order(rng):
    audit = dp.check.gradient(*loss_of_data(rng))
    assert audit.verdict == audit.hessian == "agrees"


def test_robin_along_a_patch_is_dirichlet_with_a_resistance():
    """k du/dn = -c (u - T): once as robin(c, k), once as in the guide, where c can be differentiated."""
    c, k, T = 3.0, 0.7, 2.0
    where = (-0.5, 0.0)
    fixed = {"x": (patch(where, dirichlet), neumann)}
    with_film = {"x": (patch(where, robin(c, k)), neumann)}
    div, B = dp.divergence(BOX), dp.lift(BOX, fixed)

    def on_patch(value):
        return B.domain.join(fixed["x"][0].values(BOX, "x", value), 0.0, 0.0, 0.0)

    conductivity = 1 / (1 / k + np.abs(B(on_patch(1 / c))))
    solve = dp.elliptic_solver(div, dp.gradient(BOX, fixed))
    u = solve(conductivity, 1.0 + div(conductivity * B(on_patch(T))))
    lift = dp.lift(BOX, with_film)
    other = dp.inverse(-k * dp.laplacian(BOX, with_film))(1.0 + k * div(lift(on_patch(c * T))))
    np.testing.assert_allclose(u, other, rtol=1e-12)


def test_values_vary_in_time_and_along_a_patch():
    """One line for the wall data; against the matrix exponential of the dense system."""
    from scipy.linalg import expm

    grid, boundary, conditions = SCENES["2-D"]
    G, div, B, _ = by_hand(grid, conditions)
    lift, along = dp.lift(grid, boundary), grid.coordinates(1)
    flow = dp.divergence(grid) @ lift

    def heat(p, t):
        return flow(lift.domain.join(p * anp.cos(t) * along, 0.0, 0.0, 0.0))

    step = dp.stepper("radau", None, 0.01, linear=dp.laplacian(grid, boundary), source=heat)
    u, _ = dp.rollout(step, (np.zeros(grid.shape), 0.0), 2.0, 20)
    # u' = L u + Re(e^{it}) s has the particular solution Re(e^{it} z) with (i - L) z = s
    L = div @ G
    s = div @ B @ np.concatenate([2.0 * along, np.zeros(B.shape[1] - along.size)])
    z = np.linalg.solve(1j * np.eye(len(L)) - L, s)
    exact = (np.exp(0.2j) * z).real - expm(0.2 * L) @ z.real
    np.testing.assert_allclose(u.ravel(), exact, atol=1e-6 * np.max(np.abs(exact)))


def test_operators_name_the_patch():
    op = dp.laplacian(BOX, SCENES["2-D"][1])
    walls = "x-lower: dirichlet on 2, robin(2, 0.5) on 1 of 4 faces, neumann elsewhere; "
    walls += "y-upper: neumann on 2 of 3 faces, dirichlet elsewhere"
    assert op.name == f"laplacian[{walls}]"
    assert walls in str(dp.inverse(-op)) and walls in str(dp.check.operator(op))
    assert repr(patch((0, 1), robin(1, 2))) == "patch((0.0, 1.0), robin(1, 2), elsewhere=neumann)"
    assert repr(patch(DISC, dp.outflow)) == "patch(<mask of 8 faces>, outflow, elsewhere=no_slip)"


def test_patches_are_values_that_travel():
    flags = DISC.copy()
    wall = patch(flags, dirichlet)
    flags[:] = True
    assert wall == patch(DISC, dirichlet) != patch(~DISC, dirichlet)
    assert hash(wall) == hash(patch(DISC, dirichlet))
    assert pickle.loads(pickle.dumps(wall)) == wall
    op = dp.gradient(CUBE, SCENES["3-D"][1])
    assert (pickle.loads(pickle.dumps(op)).matrix != op.matrix).nnz == 0


def test_obstacles_and_patches_work_together():
    solid = np.zeros(BOX.shape, bool)
    solid[0, 0] = True  # at the wall x-lower, where the patch is
    G, _, _, _ = by_hand(BOX, SCENES["2-D"][2])
    op = dp.gradient(BOX, SCENES["2-D"][1], solid)
    below, above = (np.zeros(BOX.faces.size, bool) for _ in range(2))
    for axis in range(2):
        for upper, faces in ((0, above), (1, below)):
            index = [0, 0]
            index[axis] = upper
            faces[BOX.faces.offsets[axis] + np.ravel_multi_index(index, BOX.face_shape(axis))] = True
    G[below | above] = 0.0
    np.testing.assert_allclose(op.matrix.toarray(), G, rtol=1e-14, atol=1e-13)


class OnlyWhole(Backend):
    """A backend that supports no patches, like the backend of ranks."""

    def check(self, name):
        raise TypeError(f"{name} is not supported")


def test_distributed_grids_refuse_patches():
    with pytest.raises(TypeError, match="a patch of a wall is not supported"):
        dp.gradient(BOX.stored_by(OnlyWhole()), {"x": patch((0.0, 0.3), dirichlet)})


# ---- functions without patches ----


FLOW = patch((0.0, 0.3), dp.outflow)
READERS = {
    "conservation_law": lambda: dp.conservation_law(
        BOX, lambda u, p, a: u, lambda u, p, a: (u, u), boundary={"x": (FLOW, dp.outflow)}
    ),
    "shallow_water": lambda: dp.shallow_water(BOX, boundary={"x": (FLOW, dp.outflow)}),
}


@pytest.mark.parametrize("name", READERS)
def test_functions_without_patches_refuse_them_by_name(name):
    with pytest.raises(TypeError) as refused:
        READERS[name]()
    assert str(refused.value) == (
        f"{name} takes one condition for each wall, but x-lower has a patch; write one condition, such as dp.outflow"
    )


def test_every_function_with_boundary_is_named_here():
    """A new reader of boundary= must refuse patches or support them, and say so above."""
    import inspect

    support = {"gradient", "laplacian", "lift", "average", "upwind"}
    support |= {
        "projection",
        "flow_step",
        "face_laplacian",
        "face_lift",
        "convection",
        "forces",
        "transport",
        "free_faces",
        "cut_cells",
        "cut_flow",
    }
    takers = set()
    for name in dp.__all__:
        function = getattr(dp, name)
        if inspect.isfunction(function) and "boundary" in inspect.signature(function).parameters:
            takers.add(name)
    assert takers == support | set(READERS)
