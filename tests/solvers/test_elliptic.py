"""Solves whose coefficient is a parameter: values, derivatives of every order, set-ups kept by content."""

import pickle
import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad

METHODS = pytest.mark.parametrize("method", ["direct", "multigrid", "krylov"])
NAME = "elliptic_solver"


def stretched(*shape):
    return dp.Grid(shape, spacing=[1.0 + 0.5 * np.sin(np.arange(n)) for n in shape])


def setting(boundary=dp.dirichlet, shape=(19, 17), method="auto", seed=0, **options):
    """A solver on a stretched grid with a coefficient, data and a direction for each argument."""
    grid = stretched(*shape)
    rng = np.random.default_rng(seed)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, boundary), method, **options)
    point = (np.exp(rng.standard_normal(grid.faces.size)), rng.standard_normal(grid.shape), 0.3)
    direction = (point[0] * rng.uniform(-1, 1, grid.faces.size), rng.standard_normal(grid.shape), -0.7)
    return solve, point, direction


def dense(solve, k, shift):
    D, G = (op.matrix.toarray() for op in (solve.D, solve.G))
    return shift * np.eye(D.shape[0]) - (D * k) @ G


def moved(point, direction, h):
    return tuple(value + h * change for value, change in zip(point, direction))


def dot(one, other):
    return sum(np.sum(a * b) for a, b in zip(one, other))


def loss_of(solve):
    return lambda t: anp.sum(anp.sin(3 * solve(*t)))


# ---------------------------------------------------------------- values


@METHODS
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann, dp.robin(1, 2)])
def test_value_and_transpose_against_dense_algebra(method, boundary):
    solve, (k, b, shift), _ = setting(boundary, method=method)
    matrix = dense(solve, k, shift)
    assert solve(k, b, shift).ravel() == pytest.approx(np.linalg.solve(matrix, b.ravel()), rel=1e-7, abs=1e-9)
    g = value_and_grad(lambda b: anp.sum(solve(k, b, shift) * k[0]))(b)[1]
    assert g.ravel() == pytest.approx(np.linalg.solve(matrix.T, np.full(b.size, k[0])), rel=1e-7, abs=1e-9)
    for number in (2, 0.5):
        wanted = np.linalg.solve(dense(solve, number, shift), b.ravel())
        assert solve(number, b, shift).ravel() == pytest.approx(wanted, rel=1e-7, abs=1e-9)


def test_obstacles_are_part_of_the_gradient():
    grid = stretched(14, 12)
    solid = np.zeros(grid.shape, dtype=bool)
    solid[4:7, 3:9] = True
    rng = np.random.default_rng(0)
    k = rng.random(grid.faces.size) + 0.5
    for condition in (dp.neumann, dp.dirichlet):
        G = dp.gradient(grid, dp.dirichlet, solid, condition)
        solve = dp.elliptic_solver(dp.divergence(grid), G)
        b = np.where(solid, 0.0, rng.standard_normal(grid.shape))
        fluid = ~solid.ravel()
        small = dense(solve, k, 0.0)[fluid][:, fluid]
        assert solve(k, b)[~solid] == pytest.approx(np.linalg.solve(small, b[~solid]), rel=1e-9)
        assert not np.any(solve(k, b)[solid])


def test_a_constant_coefficient_gives_what_a_field_of_it_gives():
    solve, (_, b, shift), _ = setting()
    k = np.full(solve.D.domain.shape, 2.0)
    nearly = k.copy()
    nearly[0] += 1e-13
    assert solve(2.0, b, shift) == pytest.approx(solve(nearly, b, shift), rel=1e-9)
    assert np.array_equal(solve(2.0, b, shift), solve(k, b, shift))


# ---------------------------------------------------------------- derivatives


@METHODS
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann])
def test_gradients_against_differences(method, boundary):
    solve, point, direction = setting(boundary, method=method, rtol=1e-12)
    loss = loss_of(solve)
    slope = dot(value_and_grad(loss)(point)[1], direction)
    h = 1e-5
    assert (loss(moved(point, direction, h)) - loss(moved(point, direction, -h))) / (2 * h) == pytest.approx(
        slope, rel=1e-6
    )
    _, tangent = pushforward(lambda t: solve(*t), point, direction)
    x = solve(*point)
    assert np.sum(3 * np.cos(3 * x) * tangent) == pytest.approx(slope, rel=1e-8)


@METHODS
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann])
def test_second_derivatives_in_all_modes(method, boundary):
    """Reverse over reverse, forward over reverse, and differences of gradients; no cotangent is refused."""
    solve, point, direction = setting(boundary, method=method, rtol=1e-12)
    gradient = lambda t: value_and_grad(loss_of(solve))(t)[1]
    slope = lambda t: sum(anp.sum(g * d) for g, d in zip(gradient(t), direction))
    reverse = value_and_grad(slope)(point)[1]
    forward = pushforward(gradient, point, direction)[1]
    h = 1e-5
    ahead = gradient(moved(point, direction, h))
    behind = gradient(moved(point, direction, -h))
    for one, other, up, down in zip(reverse, forward, ahead, behind):
        size = np.max(np.abs(one))
        assert other == pytest.approx(one, rel=1e-6, abs=1e-8 * size)
        assert (up - down) / (2 * h) == pytest.approx(one, rel=1e-4, abs=1e-5 * size)


def test_taylor_orders():
    solve, point, direction = setting()
    loss = loss_of(solve)
    value, gradient = value_and_grad(loss)(point)
    slope = dot(gradient, direction)
    curvature = dot(pushforward(lambda t: value_and_grad(loss)(t)[1], point, direction)[1], direction)
    steps = 0.004 * 0.5 ** np.arange(4)
    left = np.array([loss(moved(point, direction, h)) - value for h in steps])
    rates = lambda rest: np.diff(np.log(np.abs(rest))) / np.log(0.5)
    assert np.all(np.abs(rates(left) - 1) <= 0.05)  # without the gradient: it matters
    assert np.all(rates(left - steps * slope) >= 1.95)
    assert np.all(rates(left - steps * slope - steps**2 / 2 * curvature) >= 2.9)
    wrong = 1.01 * slope
    assert np.all(rates(left - steps * wrong) < 1.95)


@pytest.mark.parametrize("singular", [False, True])
def test_the_pure_neumann_problem_has_all_derivatives(singular):
    grid = stretched(12, 10)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid))
    rng = np.random.default_rng(0)
    k, dk = rng.random((2, grid.faces.size)) + 0.5
    b = dp.divergence(grid)(dp.interior(grid)(rng.standard_normal(grid.faces.size)))
    shift = 0.0 if singular else 0.1
    loss = lambda k: anp.sum(solve(k, b, shift) ** 3)
    gradient = lambda k: value_and_grad(loss)(k)[1]
    h = 1e-5
    assert np.sum(gradient(k) * dk) == pytest.approx((loss(k + h * dk) - loss(k - h * dk)) / (2 * h), rel=1e-6)
    second = pushforward(gradient, k, dk)[1]
    assert second == pytest.approx((gradient(k + h * dk) - gradient(k - h * dk)) / (2 * h), rel=1e-4, abs=1e-4)
    # The gradient in b is an adjoint solve; its own pullback meets a cotangent out of the range.
    slope = lambda b: anp.sum(value_and_grad(lambda b: anp.sum(solve(k, b, shift) ** 3))(b)[1] * grid.volumes**2)
    free = dp.elliptic_solver(solve.D, solve.G, nullspace="project")
    x = solve(k, b, shift)
    reached = free(k, grid.volumes**2, shift)
    wanted = value_and_grad(lambda b: anp.sum(6 * x * reached * solve(k, b, shift)))(b)[1]
    assert value_and_grad(slope)(b)[1] == pytest.approx(wanted, rel=1e-8, abs=1e-8 * np.max(np.abs(wanted)))
    if singular:
        with pytest.raises(dp.errors.IncompatibleError, match="elliptic_solver is singular"):
            solve(k, b + 1.0)
        lenient = dp.elliptic_solver(solve.D, solve.G, nullspace="project")
        assert lenient(k, b + 1.0) == pytest.approx(solve(k, b), abs=1e-10)


def test_scalar_coefficients_and_kinds_of_numbers():
    solve, (k, b, _), _ = setting()
    value, slope = value_and_grad(lambda k: anp.sum(solve(k, b) ** 2))(2.0)
    assert slope == pytest.approx(-value, rel=1e-12)  # x goes with 1 / k
    g = value_and_grad(lambda t: anp.sum(solve(*t) ** 2))((k.astype(np.float32), b, np.float64(0.5)))[1]
    assert g[0].dtype == np.float32 and g[1].dtype == np.float64
    assert solve(1, np.ones(b.shape, dtype=int)).dtype == np.float64
    assert solve(k, b.astype(np.float32)).dtype == np.float32
    c = solve(k, b + 2j * b, 0.1)
    assert c == pytest.approx((1 + 2j) * solve(k, b, 0.1))
    gradient = value_and_grad(lambda k: anp.sum(anp.abs(solve(k, b + 2j * b, 0.1)) ** 2))(k)[1]
    assert gradient == pytest.approx(5 * value_and_grad(lambda k: anp.sum(solve(k, b, 0.1) ** 2))(k)[1], rel=1e-8)


# ---------------------------------------------------------------- counts and set-ups


@pytest.mark.parametrize("places", [(0,), (1,), (0, 1, 2)])
def test_one_adjoint_solve_for_all_arguments(places):
    solve, point, _ = setting(method="multigrid")

    def loss(asked):
        given = list(point)
        for place, value in zip(places, asked):
            given[place] = value
        return anp.sum(solve(*given) ** 2)

    with recording() as calls:
        value_and_grad(loss)(tuple(point[place] for place in places))
    assert (calls[NAME, "solve"], calls[NAME, "adjoint"], calls[NAME, "setup"]) == (1, 1, 1)
    with recording() as calls:
        loss(tuple(point[place] for place in places))
        pullback(lambda u: anp.sum(u) + np.sum(solve(*point)), np.ones(3))[1](1.0)
    assert (calls[NAME, "adjoint"], calls[NAME, "setup"]) == (0, 0)
    gradient_in_k = 1 if 0 in places else 0
    with recording() as calls:
        value_and_grad(loss)(tuple(point[place] for place in places))
    assert calls["gradient", "forward"] == gradient_in_k  # what is not asked for is not computed


@METHODS
def test_set_ups_are_cached_by_content(method):
    solve, (k, b, shift), _ = setting(method=method)
    fresh = lambda: setting(method=method)[0]

    def setups(k, shift):
        with recording() as calls:
            x = solve(k, b, shift)
        assert np.array_equal(x, fresh()(k, b, shift))  # never a stale hierarchy
        return calls[NAME, "setup"]

    assert setups(k, shift) == 1
    assert setups(k.copy(), shift) == 0
    k[5] *= 1.5  # the same array, another content
    assert setups(k, shift) == 1
    assert setups(k, 0.0) == 1
    assert setups(k, shift) == 0 and setups(k, 0.0) == 0  # the last two are kept
    k[5] /= 1.5
    assert setups(k, shift) == 1


def test_the_cache_holds_plain_values():
    """A box kept from one trace and met in the next would give a wrong derivative."""
    solve, (k, b, _), _ = setting()
    gradient = value_and_grad(lambda s: anp.sum(solve(s * k, b)))
    first = gradient(1.0)
    assert gradient(1.0) == first
    assert value_and_grad(lambda s: anp.sum(solve(s * k, s * b)))(1.0)[1] == pytest.approx(
        0.0, abs=1e-9 * abs(first[1])
    )


def test_the_log_and_the_printed_text():
    solve, point, _ = setting(method="multigrid")
    assert "not set up yet" in str(solve) and solve.info.forward is None
    value_and_grad(loss_of(solve))(point)
    assert solve.info.forward.status == solve.info.adjoint.status == "converged" and "levels" in solve.info.hierarchy
    text = str(solve)
    for word in ("1 of 2 set-ups kept", "multigrid: as asked", "levels"):
        assert word in text
    again = pickle.loads(pickle.dumps(solve))
    assert np.array_equal(again(*point), solve(*point))


# ---------------------------------------------------------------- extremes


@METHODS
@pytest.mark.parametrize("exponent", [-900, 900])
def test_bits_do_not_depend_on_units(method, exponent):
    solve, (k, b, _), _ = setting(method=method)
    x = solve(k, b)
    g = value_and_grad(lambda b: anp.sum(solve(k, b)))(b)[1]
    assert np.array_equal(solve(k, np.ldexp(b, exponent)), np.ldexp(x, exponent))
    assert np.array_equal(solve(np.ldexp(k, exponent), b), np.ldexp(x, -exponent))
    turned = value_and_grad(lambda b: anp.sum(solve(np.ldexp(k, exponent), b)))(b)[1]
    assert np.array_equal(turned, np.ldexp(g, -exponent))


@METHODS
def test_cells_cut_off_by_a_coefficient_of_0(method):
    grid = dp.Grid((12, 10))
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method)
    parts = [np.ones(part) for part in grid.faces.parts]
    parts[0][4:6, 3] = parts[1][4, 3:5] = 0.0  # all faces of cell (4, 3)
    k = grid.join(*parts)
    b = np.ones(grid.shape)
    with pytest.raises(dp.errors.IncompatibleError, match=re.escape("is not in cell (4, 3)")):
        solve(k, b)
    b[4, 3] = 0.0
    x = solve(k, b)
    assert x[4, 3] == 0 and np.all(x[b > 0] > 0)
    assert np.all(np.isfinite(value_and_grad(lambda k: anp.sum(solve(k, b)))(k)[1]))
    assert solve(0.0, b, 2.0) == pytest.approx(b / 2)
    with pytest.raises(dp.errors.IncompatibleError):
        solve(0.0, b)


def test_jumps_have_right_gradients():
    """Eight decades from face to face: the gradient agrees with complex arithmetic to many digits."""
    grid = dp.Grid((16, 16), size=1.0)
    rng = np.random.default_rng(3)
    k = 10.0 ** rng.uniform(-4, 4, grid.faces.size)
    b = rng.standard_normal(grid.shape)
    direction = rng.standard_normal(grid.faces.size) * k
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    slope = np.sum(value_and_grad(lambda k: anp.sum(solve(k, b)))(k)[1] * direction)
    matrix = dense(solve, k, 0.0) + 1e-30j * (dense(solve, direction, 0.0))
    exact = np.sum(np.linalg.solve(matrix, b.ravel())).imag / 1e-30
    assert slope == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("exponent", [-1030, -1000, 1000, 1015])
@pytest.mark.parametrize("shape", [(7, 5), (4, 3, 5)])
@pytest.mark.parametrize("kind", ["number", "faces", "tensor"])
def test_coefficients_of_any_magnitude(kind, shape, exponent, rng):
    """A coefficient, a shift and data times 2^e have the same solution, subnormal coefficients included."""
    grid = dp.Grid(shape, size=(1.0,) * len(shape))
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    axes = np.eye(len(shape)).reshape(len(shape), len(shape), *[1] * len(shape))
    coefficients = {
        "number": 1.5,
        "faces": rng.uniform(1.0, 2.0, grid.faces.size),
        "tensor": axes * rng.uniform(1.0, 2.0, shape) + 0.25,
    }
    k = coefficients[kind]
    b = rng.standard_normal(shape)
    shift = rng.uniform(0.0, 2.0, shape)
    scaled = np.ldexp(k, exponent)

    x = solve(float(scaled) if kind == "number" else scaled, np.ldexp(b, exponent), np.ldexp(shift, exponent))
    assert np.allclose(x, solve(k, b, shift), rtol=1e-8, atol=1e-10)

    def loss(k, b):
        return anp.sum(solve(k, b) ** 2)

    if abs(exponent) <= 1000:
        gradient = dp.grad(loss)(scaled, np.ldexp(b, exponent))
        assert np.allclose(np.ldexp(gradient, exponent), dp.grad(loss)(k, b), rtol=1e-7)


@pytest.mark.parametrize("exponent", [-900, 0, 900])
def test_a_complex_shift_of_any_magnitude(exponent, rng):
    """The shift is one complex number."""
    grid = dp.Grid((6, 5), size=1.0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    k = rng.uniform(1, 2, grid.faces.size)
    b = rng.standard_normal(grid.shape)
    shift = -3.0 + 2.0j
    factor = 2.0**exponent
    exact = np.linalg.solve(dense(solve, k, shift), b.ravel()).reshape(b.shape)
    assert np.allclose(solve(factor * k, factor * b, factor * shift), exact, rtol=1e-9)


def test_coefficients_whose_entries_would_overflow():
    grid = dp.Grid((6, 5), size=1.0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    k = np.full(grid.faces.size, 1e308)
    b = np.ones(grid.shape)
    assert np.allclose(solve(k, 1e300 * b), 1e-8 * solve(1.0, b), rtol=1e-10)
    with pytest.raises(dp.errors.NonFiniteError, match="the solution of elliptic_solver is beyond 1.8e308"):
        solve(np.full(grid.faces.size, 1e-309), b * 1e10)
