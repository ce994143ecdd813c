"""imex, exponential steps and functions of an operator: orders, exactness, stiff reactions."""

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from step_methods import METHODS

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback, value_and_grad
from sparsedp.integrators.exponential import Function, PhiFunctions, phi

GRID = dp.Grid(16, size=1.0)
L = dp.laplacian(GRID, dp.dirichlet)
X = GRID.centres()[0]


def reaction(u, p):
    return p["r"] * u * (1 - u**2)


def run(step, state, params, n):
    for _ in range(n):
        state = step(state, params)
    return state


@pytest.mark.whole
@pytest.mark.parametrize(("method", "order"), [("imex", 2), ("etdrk4", 4)])
def test_order_of_solution_and_gradient(method, order):
    """Bistable reaction and diffusion, stiff for every dt used; against steps eight times as fine."""
    start = np.sin(np.pi * X) + 0.3 * np.sin(3 * np.pi * X)
    params = {"nu": 0.05, "r": 4.0}

    def found(n):
        step = dp.stepper(method, reaction, 0.5 / n, linear=(L, lambda p: p["nu"]))
        loss = lambda x: anp.sum(run(step, x[0], x[1], n) * (1 + X))
        value, (of_u, of_p) = value_and_grad(loss)((start, params))
        return value, np.concatenate([of_u, [of_p["nu"], of_p["r"]]])

    exact = found(512)
    errors = [[abs(value - exact[0]), np.linalg.norm(g - exact[1])] for value, g in map(found, (16, 32, 64))]
    for column in np.log2(errors).T:
        assert -np.diff(column)[-1] == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("dt", [1e-6, 1.0, 1e6])
def test_a_linear_problem_is_exact(dt):
    """exp(dt nu L) and its derivative, with a constant source too, against dense matrices."""
    dense = L.matrix.toarray()
    forced = dp.stepper("etdrk4", dt=dt, linear=(L, lambda p: p[0]), source=lambda p: p[1])
    u = np.cos(3 * X)
    f = 1 + X
    nu = 0.3
    grown = scipy.linalg.expm(dt * nu * dense)
    wanted = grown @ u + np.linalg.solve(nu * dense, grown @ f - f)
    assert forced(u, (nu, f)) == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    alone = dp.stepper("etdrk4", L, dt)
    value, g = value_and_grad(lambda nu: anp.sum(f * alone(u, nu)))(nu)
    assert value == pytest.approx(f @ grown @ u, rel=1e-11)
    assert g == pytest.approx(dt * f @ dense @ grown @ u, rel=1e-10)


def test_factor_of_a_sine_mode_is_the_exponential():
    """A4: exact to round-off at any dt."""
    mode = np.sin(np.pi * X)
    eigenvalue = 4 * 16**2 * np.sin(np.pi / 32) ** 2
    for dt in (1e-12, 1e-3, 1.0, 1e4):
        factor = dp.stepper("etdrk4", L, dt)(mode, 1.0) / mode
        assert factor == pytest.approx(np.full(16, np.exp(-dt * eigenvalue)), rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("x", [-1e5, -40.0, -3.0, -2.9, -0.1, -1e-9, 0.0, 1e-3, 2.0, 5.0])
def test_phi_against_the_integral(x):
    """phi_k(x) = the integral of exp((1 - s) x) s^(k-1) / (k-1)! over 0 < s < 1."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    s = (nodes + 1) / 2
    weights = weights / 2
    found = phi(5, np.array(x))
    assert found[0] == pytest.approx(np.exp(x), rel=1e-14)
    if x == -1e5:
        assert found[1:3] == pytest.approx([1e-5, 1e-5 * (1 - 1e-5)], rel=1e-13)
        return
    factorial = 1
    for k in range(1, 6):
        factorial *= max(k - 1, 1)
        assert found[k] == pytest.approx(np.sum(weights * np.exp((1 - s) * x) * s ** (k - 1)) / factorial, rel=2e-13)


@pytest.mark.parametrize("power", [False, True])
def test_functions_against_the_dense_matrix(power):
    grid = dp.Grid((4, 5), size=1.0, periodic=(True, False))
    op = dp.laplacian(grid, dp.dirichlet)
    op = dp.matrix_power(op, 2) if power else op
    dense = np.array([op(unit.reshape(4, 5)).ravel() for unit in np.eye(20)]).T
    f = PhiFunctions(op, "f")
    z = -1e-4 if power else 0.01
    u = np.random.default_rng(0).standard_normal((4, 5))
    whole = (f(Function((1.0,)), z, u) + f(Function((0.0, 2.0), 0.5), z, 2 * u)).ravel()
    grown = scipy.linalg.expm(z * dense)
    half = np.linalg.solve(z / 2 * dense, scipy.linalg.expm(z / 2 * dense) - np.eye(20))
    assert whole == pytest.approx((grown + 4 * half) @ u.ravel(), rel=1e-9)


def test_derivatives_of_functions():
    f = PhiFunctions(L, "f")
    table = (Function((1.0, 0.0, 2.0), 0.5), Function((0.0, 1.0)))
    loss = lambda x: anp.sum((f(table[0], x[0], x[1]) + f(table[1], x[0], x[2])) ** 2)
    for z in (0.0, 0.01, 1.0):
        slope = lambda x: anp.sum(anp.sin(value_and_grad(loss)(x)[1][1]) * X) + value_and_grad(loss)(x)[1][0] ** 2
        x = (z, np.cos(X), np.sin(X))
        if z:
            assert dp.check.gradient(loss, x, quick=True).verdict == "agrees"
            assert dp.check.gradient(slope, x, quick=True).verdict == "agrees"
        h = 1e-5
        central = (loss((z + h, *x[1:])) - loss((z - h, *x[1:]))) / (2 * h)
        assert value_and_grad(loss)(x)[1][0] == pytest.approx(central, rel=1e-3)


# ---- linear steps, against the dense matrix, in loops --------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("nu", [0.7, 0.0, None])
def test_derivatives_of_linear_steps(method, nu):
    """On a stretched axis, where the operator is not symmetric: transpose, tangent, slope in nu, and a rollout."""
    grid = dp.Grid(8, spacing=[np.linspace(1, 2, 8)])
    step = dp.stepper(method, dp.laplacian(grid, {"x": (dp.dirichlet, dp.neumann)}), 0.1)
    u, g = np.random.default_rng(1).standard_normal((2, 8))
    new, pull = pullback(lambda x: step(*x), (u, nu))
    of_u, of_nu = pull(g)
    dense = np.array([step(unit, nu) for unit in np.eye(8)]).T
    assert new == pytest.approx(dense @ u, rel=1e-13, abs=1e-15)
    assert of_u == pytest.approx(dense.T @ g, rel=1e-13, abs=1e-15)
    tangent = dp.jvp(lambda x: step(*x), (u, nu), (np.cos(u), None if nu is None else 0.3))[1]
    assert np.sum(tangent * g) == pytest.approx(np.sum(of_u * np.cos(u)) + 0.3 * (of_nu or 0), rel=1e-12)
    if nu:
        central = (step(u, nu + 1e-5) - step(u, nu - 1e-5)) / 2e-5
        assert of_nu == pytest.approx(np.sum(g * central), rel=1e-8)
    value, slopes = value_and_grad(lambda x: anp.sum(g * dp.rollout(step, *x, 1)))((u, nu))
    assert value == np.sum(g * new) and np.array_equal(slopes[0], of_u) and slopes[1] == of_nu


def test_backward_is_one_transposed_solve():
    step = dp.stepper("backward_euler", L, 0.1)
    _, pull = pullback(lambda x: step(*x), (X, 0.5))
    with recording() as calls:
        pull(X)
    assert calls["stepper(backward_euler)", "adjoint"] == 1 and not calls["stepper(backward_euler)", "solve"]


# ---- chaos: Kuramoto and Sivashinsky -------------------------------------------------------------------------------


def chaos(n, dt):
    """u_t = -u u_x - u_xx - u_xxxx on 22 lengths, periodic."""
    grid = dp.Grid(n, size=22.0, periodic=True)
    second = dp.laplacian(grid)
    rows = sp.diags_array([1.0, -1.0, 1.0, -1.0], offsets=[1, -1, 1 - n, n - 1], shape=(n, n)) / (2 * grid.widths[0][0])
    slope = dp.from_matrix(rows, grid.cells, grid.cells, name="slope")
    step = dp.stepper("etdrk4", lambda u, p: -0.5 * slope(u**2), dt, linear=-1.0 * (second + second @ second))
    phase = 2 * np.pi * grid.centres()[0] / 22
    return step, np.cos(phase) * (1 + np.sin(phase))


def test_chaos_keeps_its_mean_and_its_size():
    step, u = chaos(64, 0.25)
    for _ in range(400):
        u = step(u, None)
    assert abs(np.mean(u)) <= 1e-10 and 0.5 <= np.std(u) <= 2.0


@pytest.mark.slow
def test_growth_of_the_gradient_is_the_lyapunov_exponent():
    """0.043 to 0.05 in the literature, within 25 %; and the loop says that the gradient is of little use."""
    step, u = chaos(128, 0.1)
    start = dp.rollout(step, u, None, 2000)
    runs = []
    weights = np.random.default_rng(0).standard_normal(128)
    with pytest.warns(UserWarning, match="the cotangent grew by"):
        value_and_grad(lambda u: anp.sum(weights * dp.rollout(step, u, None, 15000, record=runs.append)))(start)
    assert 0.75 * 0.043 <= runs[-1].growth / 0.1 <= 1.25 * 0.05


def test_a_field_that_blows_up_is_reported_in_its_step():
    """The state before the step is finite: the rate overflows in it, or a stage does."""
    step = dp.stepper("imex", lambda u, p: u**2, 0.2, linear=(dp.laplacian(dp.Grid(8, size=1.0), dp.neumann), 0.01))
    start = np.ones(8)
    states = [start]
    with np.errstate(over="ignore", invalid="ignore"), pytest.raises(dp.errors.NonFiniteError) as caught:
        while True:
            states.append(step(states[-1]))
    last = len(states) - 1
    assert np.all(np.isfinite(states[-1])) and "got NaN or infinity from a finite state with dt = 0.2" in str(
        caught.value
    )
    with (
        np.errstate(over="ignore", invalid="ignore"),
        pytest.raises(
            dp.errors.NonFiniteError, match=f"in step {last} of rollout: .*got NaN or infinity from a finite state"
        ),
    ):
        dp.rollout(step, start, None, 40)
