"""Full tensors as coefficients: order 2 by manufactured solutions, derivatives, symmetry, refusals."""

import re

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import elementwise_grad
from test_elliptic import stretched
from test_elliptic_complex import close

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward, value_and_grad

SHAPES = pytest.mark.parametrize("shape", [(6, 5), (4, 3, 5)], ids=str)


def solver(grid, boundary=dp.dirichlet, method="auto", **options):
    return dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, boundary), method, **options)


def tensors(grid, seed=0, skew=0.0):
    """A random positive definite matrix in each cell, symmetric but for `skew`."""
    rng = np.random.default_rng(seed)
    dim = grid.dim
    root = rng.standard_normal((dim, dim, *grid.shape))
    identity = np.eye(dim).reshape(dim, dim, *[1] * dim)
    twist = skew * np.triu(np.ones((dim, dim)), 1).reshape(identity.shape)
    return np.einsum("ik...,jk...->ij...", root, root) + 0.5 * identity + twist - twist.swapaxes(0, 1)


def dense(solve, K, shift=0.0):
    """The matrix, column by column, from the solver's own operator."""
    return solve.operator(K, shift).matrix.toarray()


# ---------------------------------------------------------------- values


def exact(dim, kind):
    """(entries of K, u, -div(K grad u) + u) as functions of the coordinates."""
    wave = 2 * np.pi
    factors = {
        "dirichlet": lambda x: anp.sin(np.pi * x) * anp.exp(0.5 * x),
        "periodic": lambda x: anp.exp(0.5 * anp.sin(wave * x + 0.3)),
        "neumann": lambda x: anp.cos(np.pi * x) + 0.2 * anp.cos(wave * x),  # with no cross terms on the walls
    }
    wall = (lambda x: anp.sin(np.pi * x)) if kind == "neumann" else (lambda x: 1.0)

    def u(*x):
        total = 1.0
        for coordinate in x:
            total = total * factors[kind](coordinate)
        return total

    def entry(i, j):
        if i == j:
            return lambda *x: 2.0 + 0.5 * anp.sin(wave * x[i]) * anp.cos(wave * x[i - 1])
        return lambda *x: (
            0.6
            * anp.cos(wave * x[i] * x[j] if kind == "dirichlet" else wave * (x[i] + x[j]))
            * (wall(x[i]) * wall(x[j]))
        )

    K = [[entry(i, j) for j in range(dim)] for i in range(dim)]
    flux = lambda i: lambda *x: sum(K[i][j](*x) * elementwise_grad(u, j)(*x) for j in range(dim))
    return K, u, lambda *x: u(*x) - sum(elementwise_grad(flux(i), i)(*x) for i in range(dim))


@pytest.mark.whole
@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["dirichlet", "periodic", "neumann"])
@pytest.mark.parametrize("sizes", [(16, 32, 64), (6, 12, 24)], ids=["2-D", "3-D"])
def test_order_two_by_a_manufactured_solution(kind, sizes):
    dim = 2 if sizes[0] == 16 else 3
    errors = []
    K, u, f = exact(dim, kind)
    for n in sizes:
        grid = dp.Grid((n,) * dim, size=1.0, periodic=kind == "periodic")
        x = [np.array(centre) for centre in grid.centres()]
        k = np.array([[entry(*x) * np.ones(grid.shape) for entry in row] for row in K])
        solution = solver(grid, dp.dirichlet if kind == "dirichlet" else dp.neumann)(k, f(*x), 1.0)
        errors.append(np.sqrt(np.mean((solution - u(*x)) ** 2)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert 1.85 <= orders[-1] <= 2.2, (errors, orders)


def test_no_flux_through_closed_walls_at_any_angle():
    """The slope across the wall is not 0, the flux is: order 2 as well."""
    errors, (a, c, d) = [], (2.0, 0.8, 1.0)
    for n in (16, 32, 64):
        grid = dp.Grid((n, n), size=1.0, periodic=(False, True))
        x, y = grid.centres()
        u = np.sin(2 * np.pi * (y - c / a * x))  # a du/dx + c du/dy = 0
        f = (1 + (d - c**2 / a) * (2 * np.pi) ** 2) * u
        K = np.array([[a, c], [c, d]])[..., None, None] * np.ones(grid.shape)
        errors.append(np.max(np.abs(solver(grid, dp.neumann)(K, f, 1.0) - u)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert 1.85 <= orders[-1] <= 2.2, (errors, orders)


@SHAPES
def test_a_tensor_that_is_a_number_gives_what_the_number_gives(shape):
    grid = stretched(*shape)
    for boundary in (dp.dirichlet, dp.neumann, {"x": (dp.dirichlet, dp.robin(1, 2))}):
        solve = solver(grid, boundary)
        b = np.random.default_rng(0).standard_normal(shape)
        K = 1.7 * np.eye(grid.dim).reshape(grid.dim, grid.dim, *[1] * grid.dim) * np.ones(shape)
        close(solve(K, b, 0.3), solve(1.7, b, 0.3), 1e-10)


@SHAPES
def test_symmetric_and_positive_where_the_tensor_is(shape):
    grid = stretched(*shape)
    solid = np.zeros(shape, dtype=bool)
    solid[1, 1] = True
    weights = grid.volumes.reshape(-1, 1)
    for G in (dp.gradient(grid, dp.dirichlet), dp.gradient(grid), dp.gradient(grid, dp.dirichlet, solid)):
        solve = dp.elliptic_solver(dp.divergence(grid), G)
        energy = weights * dense(solve, tensors(grid))
        assert np.max(np.abs(energy - energy.T)) <= 1e-14 * np.max(np.abs(energy))
        least = np.linalg.eigvalsh(energy)[0] / np.max(np.abs(energy))
        assert (
            least >= -1e-14 and np.max(np.abs(weights.T @ dense(solve, tensors(grid)) @ np.ones(grid.cells.size))) >= 0
        )
        twisted = weights * dense(solve, tensors(grid, skew=0.7))
        assert np.max(np.abs(twisted - twisted.T)) > 1e-2 * np.max(np.abs(twisted))
        assert np.linalg.eigvalsh(twisted + twisted.T)[0] >= -1e-13 * np.max(np.abs(twisted))
    closed = weights.T * 1.0 @ dense(solver(grid, dp.neumann), tensors(grid))
    assert np.max(np.abs(closed)) <= 1e-13 * np.max(np.abs(energy))  # what flows out of a cell flows into the next


# ---------------------------------------------------------------- derivatives


@SHAPES
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann], ids=["dirichlet", "neumann"])
def test_gradient_tangent_and_second_order_in_the_tensor(shape, boundary):
    grid = stretched(*shape)
    rng = np.random.default_rng(2)
    solve = solver(grid, boundary, rtol=1e-12)
    K = tensors(grid, skew=0.3)
    b = rng.standard_normal(shape)
    point = (K, b, 0.4)
    direction = (rng.uniform(-0.1, 0.1, K.shape), rng.standard_normal(shape), 0.2)
    loss = lambda t: anp.sum(anp.sin(2 * solve(*t)))
    gradient = lambda t: value_and_grad(loss)(t)[1]
    along = lambda h: tuple(p + h * d for p, d in zip(point, direction))
    dot = lambda one: sum(np.sum(a * d) for a, d in zip(one, direction))
    h = 1e-5
    assert dot(gradient(point)) == pytest.approx((loss(along(h)) - loss(along(-h))) / (2 * h), rel=1e-7)
    x, tangent = pushforward(lambda t: solve(*t), point, direction)
    assert np.sum(2 * np.cos(2 * x) * tangent) == pytest.approx(dot(gradient(point)), rel=1e-9)
    slope = lambda t: sum(anp.sum(g * d) for g, d in zip(gradient(t), direction))
    reverse = value_and_grad(slope)(point)[1]
    forward = pushforward(gradient, point, direction)[1]
    for one, other, up, down in zip(reverse, forward, gradient(along(h)), gradient(along(-h))):
        close(one, other, 1e-8)
        close((up - down) / (2 * h), one, 1e-6)


def test_twin_in_autograd_on_a_periodic_grid():
    """The energy, written down with np.roll: its Hessian is the matrix, and autograd differentiates the dense solve."""
    grid = dp.Grid((5, 4), size=1.0, periodic=True)
    rng = np.random.default_rng(0)
    K = tensors(grid)
    b = rng.standard_normal(grid.shape)
    h = [1 / 5, 1 / 4]

    def matrix(K):
        columns = []
        for number in range(20):
            u = np.eye(20)[number].reshape(grid.shape)
            out = u
            for sides in np.ndindex(2, 2):
                g = [(np.roll(u, -s, a) - np.roll(u, 1 - s, a)) / h[a] for a, s in enumerate(sides)]
                for a, s in enumerate(sides):
                    flux = sum(K[a, c] * g[c] for c in range(2)) / (4 * h[a])
                    out = out + anp.roll(flux, s, a) - anp.roll(flux, s - 1, a)
            columns.append(anp.reshape(out, -1))
        return anp.array(columns).T

    solve = solver(grid)
    twin = lambda K, b: anp.reshape(anp.linalg.solve(matrix(K), anp.reshape(b, -1)), grid.shape)
    close(dense(solve, K, 1.0), matrix(K), 1e-13)
    losses = [lambda t: anp.sum(solve(*t, 1.0) ** 3), lambda t: anp.sum(twin(*t) ** 3)]
    for one, other in zip(*(value_and_grad(loss)((K, b))[1] for loss in losses)):
        close(one, other)


def test_complex_tensors():
    grid = dp.Grid((5, 4), size=1.0)
    solve = solver(grid, rtol=1e-12)
    b = np.random.default_rng(1).standard_normal((5, 4))
    K = tensors(grid) * (1 - 0.4j)
    assert np.linalg.solve(dense(solve, K), b.ravel()) == pytest.approx(solve(K, b).ravel(), rel=1e-9)
    loss = lambda K: anp.sum(anp.abs(solve(K, b)) ** 2)
    slope = np.real(np.sum(value_and_grad(loss)(K)[1] * 1j * K))
    h = 1e-6
    assert slope == pytest.approx((loss(K * (1 + h * 1j)) - loss(K * (1 - h * 1j))) / (2 * h), rel=1e-6)


# ---------------------------------------------------------------- hard cases and refusals


def rotated(grid, ratio, angle=0.5):
    c = np.cos(angle)
    s = np.sin(angle)
    matrix = np.array([[c, -s], [s, c]]) @ np.diag([1.0, ratio]) @ np.array([[c, s], [-s, c]])
    return matrix[..., None, None] * np.ones(grid.shape)


@pytest.mark.parametrize("method", ["direct", "multigrid"])
@pytest.mark.parametrize("ratio", [1e-3, 1e-6])
def test_rotated_anisotropy_solves_or_raises(method, ratio):
    grid = dp.Grid((48, 48), size=1.0)
    b = np.random.default_rng(0).standard_normal(grid.shape)
    solve = solver(grid, dp.dirichlet, method)
    x = solve(rotated(grid, ratio), b)
    assert solve.info.forward.residual <= 1e-10 and f"method      {method}" in str(solve)
    close(x, solver(grid, dp.dirichlet, "direct")(rotated(grid, ratio), b), 1e-5)


def test_invalid_tensors_raise():
    grid = dp.Grid((4, 3))
    solve = solver(grid)
    K = tensors(grid)
    b = np.ones((4, 3))
    message = "k, a tensor for each cell, must have shape (2, 2, 4, 3), got (3, 3, 4, 3)"
    with pytest.raises(dp.errors.ShapeError, match=f"^{re.escape(message)}$"):
        solve(np.ones((3, 3, 4, 3)), b)
    K[:, :, 2, 1] = [[1.0, 2.0], [2.0, 1.0]]
    message = (
        "k must be positive definite in every cell, but in cell (2, 1) it is [[1.0, 2.0], [2.0, 1.0]]; "
        "give it eigenvalues > 0"
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        solve(K, b)
    for ratio in (0.0, 1e-16):  # singular, but for rounding
        with pytest.raises(ValueError, match="k must be positive definite in every cell, but in cell"):
            solve(rotated(grid, ratio), b)
    K[:, :, 2, 1] = np.nan
    with pytest.raises(dp.errors.NonFiniteError, match="k must be finite, got 4 that are NaN"):
        solve(K, b)
    bare = dp.elliptic_solver(dp.from_matrix(np.eye(3)), dp.from_matrix(np.eye(3)))
    with pytest.raises(
        dp.errors.ShapeError, match="a tensor needs D from the faces to the cells of a grid, got <matrix"
    ):
        bare(np.ones((1, 1, 3)), np.ones(3))


# ---------------------------------------------------------------- kinds of arrays and grids


def test_kinds_of_arrays_and_units():
    grid = stretched(6, 5)
    solve = solver(grid)
    K = tensors(grid)
    b = np.random.default_rng(0).standard_normal((6, 5))
    x = solve(K, b)
    for given in (K.tolist(), np.asfortranarray(K), np.repeat(K, 2, axis=3)[..., ::2]):
        assert np.array_equal(solve(given, b), x)
    assert np.array_equal(solve(K, np.stack([b, 2 * b])), np.stack([x, 2 * x]))
    for exponent in (-900, 900):
        assert np.array_equal(np.ldexp(solve(np.ldexp(K, exponent), b), exponent), x)
    single = K.astype(np.float32)
    assert np.array_equal(solve(single, b), solve(single.astype(float), b))  # tensors are taken apart in double
    assert value_and_grad(lambda K: anp.sum(solve(K, b)))(single)[1].dtype == np.float32
    with pytest.raises(TypeError, match="elliptic_solver takes plain arrays, got a masked array; fill it first"):
        solve(np.ma.masked_array(K), b)


def test_small_and_thin_grids():
    for shape, periodic in (((1, 1), False), ((1, 4), (True, False)), ((2, 2), True), ((5,), False), ((0, 3), False)):
        grid = dp.Grid(shape, periodic=periodic)
        number = 2.0 * np.eye(grid.dim).reshape(grid.dim, grid.dim, *[1] * grid.dim) * np.ones(shape)
        b = np.sin(np.arange(grid.cells.size)).reshape(shape)
        assert solver(grid)(number, b, 0.5) == pytest.approx(solver(grid)(2.0, b, 0.5), rel=1e-12)
    line = dp.Grid(5)
    k = 1.0 + np.arange(5.0)
    faces = np.array([1.0, 1.5, 2.5, 3.5, 4.5, 5.0])
    assert solver(line)(k[None, None], np.ones(5)) == pytest.approx(solver(line)(faces, np.ones(5)), rel=1e-12)


def test_solids_and_singular_systems():
    grid = dp.Grid((6, 5), size=1.0)
    rng = np.random.default_rng(0)
    solid = np.zeros(grid.shape, dtype=bool)
    solid[2:4, 1:3] = True
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.neumann, solid), nullspace="project")
    b = np.where(solid, 0.0, rng.standard_normal(grid.shape))
    x = solve(tensors(grid), b)
    assert not np.any(x[solid]) and abs(np.sum(x)) <= 1e-13 * np.sum(np.abs(x))
    assert dp.check.gradient(lambda K: anp.sum(solve(K, b) ** 2), tensors(grid), quick=True).verdict == "agrees"
    with pytest.raises(dp.errors.IncompatibleError, match="elliptic_solver is singular"):
        solver(grid, dp.neumann)(tensors(grid), b + 1)


# ---- the same term in steps, and with values at walls ----------------------------------------------------------------

WALLS = {"x": dp.dirichlet, "y": (dp.neumann, dp.dirichlet)}


def turned(grid, angle=0.5):
    """A tensor that varies."""
    c = np.cos(angle)
    s = np.sin(angle)
    big = 3.0 + np.sin(np.arange(grid.cells.size)).reshape(grid.shape)
    return np.array([[c * c + big * s * s, (1 - big) * s * c], [(1 - big) * s * c, s * s + big * c * c]])


@pytest.mark.parametrize("kind", ["number", "faces", "tensor"])
def test_flux_operator_and_solve_are_one_term(kind, rng):
    grid = dp.Grid((6, 5), size=1.0)
    D = dp.divergence(grid)
    G = dp.gradient(grid, WALLS)
    solve = dp.elliptic_solver(D, G)
    u = rng.normal(size=grid.shape)
    k = {"number": 0.7, "faces": 0.5 + rng.random(grid.faces.size), "tensor": turned(grid)}[kind]
    b = 2.0 * u - D(solve.flux(k, G(u)))
    np.testing.assert_allclose(solve.operator(k, 2.0)(u), b, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(solve(k, b, 2.0), u, rtol=1e-8, atol=1e-9)
    weights = rng.normal(size=grid.faces.size)
    loss = lambda x: anp.sum(weights * solve.flux(x["k"], x["g"]) ** 2)
    assert dp.check.gradient(loss, {"k": np.asarray(k), "g": G(u)}, quick=True).verdict == "agrees"


def test_values_at_walls_beside_a_tensor():
    """A ramp is a steady state of a constant tensor: of second differences nothing is left, at walls too."""
    grid = dp.Grid((7, 6), size=1.0)
    k = np.array([[2.0, 0.5], [0.5, 1.0]])[:, :, None, None] * np.ones((7, 6))
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    lift = dp.lift(grid, dp.dirichlet)
    ramp = lambda x, y: 1.0 + 2.0 * x - 3.0 * y
    walls = []
    for axis in (0, 1):
        x, y = grid.face_centres(axis)
        walls += [np.take(ramp(x, y), side, axis) for side in (0, -1)]
    solve = dp.elliptic_solver(D, G)
    values = lift(lift.domain.join(*walls))
    np.testing.assert_allclose(solve(k, D(solve.flux(k, values))), ramp(*grid.centres()), rtol=1e-9)


@pytest.mark.whole
@pytest.mark.parametrize("method", ["imex", "backward_euler", "crank_nicolson", "tr_bdf2"])
def test_steps_with_a_tensor(method, rng):
    """As the stiff part they equal steps with the matrix; as a rate they have a derivative in every entry."""
    grid = dp.Grid((5, 4), size=1.0)
    D = dp.divergence(grid)
    G = dp.gradient(grid, WALLS)
    solve = dp.elliptic_solver(D, G)
    u = rng.normal(size=grid.shape)
    k = turned(grid)
    dt = 0.01
    L = -1.0 * solve.operator(k)
    stiff, matrix = (
        dp.stepper(method, None, dt, linear=op) for op in (L, dp.from_matrix(L.matrix, grid.cells, grid.cells))
    )
    np.testing.assert_allclose(stiff(u), matrix(u), rtol=1e-8, atol=1e-9)
    if method == "imex":
        return
    step = dp.stepper(method, lambda u, k: D(solve.flux(k, G(u))), dt)
    np.testing.assert_allclose(step(u, k), stiff(u), rtol=1e-7, atol=1e-8)
    assert dp.check.gradient(lambda k: anp.sum(step(u, k) ** 2), k, quick=True).verdict == "agrees"


def test_the_operator_of_a_traced_tensor_raises():
    grid = dp.Grid((3, 2))
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid))
    with pytest.raises(
        dp.errors.DerivativeError,
        match=re.escape("elliptic_solver.operator takes plain k and shift, got a traced one; write solve.flux"),
    ):
        dp.grad(lambda k: anp.sum(solve.operator(k, 1.0)(np.ones((3, 2)))))(turned(grid))
