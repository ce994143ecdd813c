"""Steps against loops written by hand with dense matrices, options, extremes, and Allen-Cahn far beyond the limit."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad

N = 7
GRID = dp.Grid(N, size=1.0)
L = dp.laplacian(GRID, dp.dirichlet)
A = L.matrix.toarray()
X = GRID.centres()[0]
EYE = np.eye(N)
G = 2 - np.sqrt(2)
D = 1 - np.sqrt(0.5)
E = -np.sqrt(0.5)


def cubic(u, p):
    return p["r"] * u - u**3


def solve(z, b):
    return anp.linalg.solve(EYE - z * A, b)


def rk4(u, z, h, f):
    k1 = f(u)
    k2 = f(u + h / 2 * k1)
    k3 = f(u + h / 2 * k2)
    k4 = f(u + h * k3)
    return u + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def ssprk3(u, z, h, f):
    """As Shu and Osher write it."""
    one = u + h * f(u)
    two = 3 / 4 * u + (one + h * f(one)) / 4
    return u / 3 + 2 / 3 * (two + h * f(two))


def tr_bdf2(u, z, h, f):
    """Linear, as Bank writes it: two different solves with one matrix."""
    y = solve(G / 2 * z, u + G / 2 * z * (A @ u))
    return solve((1 - G) / (2 - G) * z, y / (G * (2 - G)) - (1 - G) ** 2 / (G * (2 - G)) * u)


def imex(u, z, h, n):
    x = solve(D * z, u + h * D * n(u))
    return solve(D * z, u + h * (E * n(u) + (1 - E) * n(x)) + (1 - D) * z * (A @ x))


def exp(z):
    """Enough terms for |z A| < 2."""
    total = EYE
    term = EYE
    for k in range(1, 30):
        term = anp.dot(term, z * A) / k
        total = total + term
    return total


def etdrk4(u, z, h, n):
    """Formulas 26 to 29 of Cox and Matthews, with inverses of matrices."""
    half = exp(z / 2)
    whole = exp(z)
    Z = z * A
    q = h * anp.linalg.solve(Z, half - EYE)
    a = half @ u + q @ n(u)
    b = half @ u + q @ n(a)
    c = half @ a + q @ (2 * n(b) - n(u))
    cube = anp.linalg.inv(Z @ Z @ Z)
    f1 = cube @ (-4 * EYE - Z + whole @ (4 * EYE - 3 * Z + Z @ Z))
    f2 = cube @ (2 * EYE + Z + whole @ (Z - 2 * EYE))
    f3 = cube @ (-4 * EYE - 3 * Z - Z @ Z + whole @ (4 * EYE - Z))
    return whole @ u + h * (f1 @ n(u) + 2 * (f2 @ (n(a) + n(b))) + f3 @ n(c))


TWINS = {
    "euler": (lambda u, z, h, f: u + h * f(u), "all"),
    "heun": (lambda u, z, h, f: u + h / 2 * (f(u) + f(u + h * f(u))), "all"),
    "ssprk3": (ssprk3, "all"),
    "rk4": (rk4, "all"),
    "backward_euler": (lambda u, z, h, f: solve(z, u), "linear"),
    "crank_nicolson": (lambda u, z, h, f: solve(z / 2, u + z / 2 * (A @ u)), "linear"),
    "tr_bdf2": (tr_bdf2, "linear"),
    "imex": (imex, "split"),
    "etdrk4": (etdrk4, "split"),
}


@pytest.mark.parametrize("method", TWINS)
def test_twin(method):
    """Value and gradient of three steps in state, coefficient, rate and dt."""
    by_hand, kind = TWINS[method]
    start = np.cos(2 * X)
    params = {"nu": 0.4, "r": 3.0, "dt": 0.01 if kind == "linear" else 0.004}
    rate = None if kind == "linear" else cubic
    step = dp.stepper(method, rate, lambda p: p["dt"], linear=(L, lambda p: p["nu"]))

    def twin(u, p):
        whole = lambda u: p["nu"] * (A @ u) + cubic(u, p)
        return by_hand(u, p["dt"] * p["nu"], p["dt"], whole if kind == "all" else lambda u: cubic(u, p))

    def loss(advance):
        return lambda x: anp.sum((1 + X) * advance(advance(advance(x[0], x[1]), x[1]), x[1]) ** 2)

    (value, (of_u, of_p)), (wanted, (wanted_u, wanted_p)) = (
        value_and_grad(loss(advance))((start, params)) for advance in (step, twin)
    )
    tight = 1e-9 if method == "etdrk4" else 1e-12  # the inverses by hand lose digits
    assert value == pytest.approx(wanted, rel=tight)
    assert of_u == pytest.approx(wanted_u, rel=100 * tight, abs=tight)
    assert [*of_p.values()] == pytest.approx([*wanted_p.values()], rel=100 * tight, abs=1e-13)


# ---- options and extremes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["dense", "sparse", "operator"])
def test_a_jacobian_that_is_given(form):
    def jacobian(u, p):
        J = p["nu"] * L.matrix.toarray() + np.diag(p["r"] - 3 * u**2)
        return {"dense": J, "sparse": dp.from_matrix(J).matrix, "operator": dp.from_matrix(J)}[form]

    rate = lambda u, p: p["nu"] * L(u) + cubic(u, p)
    params = {"nu": 0.4, "r": 3.0}
    found = []
    for given in (None, jacobian):
        step = dp.stepper("tr_bdf2", rate, 0.1, jacobian=given, rtol=1e-12)
        found.append(value_and_grad(lambda p, step=step: anp.sum(step(X, p) ** 2))(params))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-10)
    assert [*found[0][1].values()] == pytest.approx([*found[1][1].values()], rel=1e-9)


@pytest.mark.parametrize("solver", ["direct", "separable", "multigrid", "krylov"])
def test_solver_of_a_linear_step(solver):
    grid = dp.Grid((8, 6), size=1.0)
    op = dp.laplacian(grid)
    u = np.random.default_rng(0).standard_normal((8, 6))
    new = dp.stepper("tr_bdf2", op, 0.3, solver=solver, rtol=1e-12)(u, 0.5)
    assert new == pytest.approx(dp.stepper("tr_bdf2", op, 0.3)(u, 0.5), rel=1e-8, abs=1e-10)
    assert np.mean(new) == pytest.approx(np.mean(u), rel=1e-9)


@pytest.mark.parametrize("shape", [(9,), (6, 5), (40, 40)])
@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2", "imex", "etdrk4"])
def test_the_mean_stays_at_any_diffusion_number(method, shape):
    """Closed walls, stretched cells and a solid: what 1 beside 1e16 would lose."""
    widths = [np.linspace(1, 2, n) / n for n in shape]
    grid = dp.Grid(shape, spacing=widths if len(shape) > 1 and shape[0] < 9 else None, size=None)
    solid = np.zeros(shape, bool)
    solid[:2] = shape == (6, 5) and method != "etdrk4"
    step = dp.stepper(method, dp.laplacian(grid, solid=solid if solid.any() else None), 1.0)
    u = np.where(solid, 0.0, np.random.default_rng(0).standard_normal(shape))
    total = np.sum(grid.volumes * u)
    for nu in (1.0, 1e8, 1e16, 1e100):
        new = step(u, nu)
        assert np.sum(grid.volumes * new) == pytest.approx(total, rel=1e-12, abs=1e-13)
        g = value_and_grad(lambda u, nu=nu: anp.sum(grid.volumes * step(u, nu)))(u)[1]
        assert g == pytest.approx(grid.volumes, rel=1e-12)


@pytest.mark.parametrize("method", [name for name, (_, kind) in TWINS.items()])
def test_scaled_by_powers_of_two(method):
    step = dp.stepper(method, L, 1e-3)
    for exponent in (-900, 900):
        assert np.array_equal(step(np.ldexp(X, exponent), 0.5), np.ldexp(step(X, 0.5), exponent))


@pytest.mark.parametrize("method", TWINS)
def test_any_layout_and_no_writing(method):
    grid = dp.Grid((5, 4), size=1.0)
    step = dp.stepper(method, lambda u, p: -p * u, 1e-3, linear=dp.laplacian(grid, dp.dirichlet))
    u = np.random.default_rng(0).standard_normal((5, 4))
    wanted = step(u.copy(), 2.0)
    for form in (np.asfortranarray(u), np.repeat(u, 2, axis=1)[:, ::2], u[::-1][::-1], u):
        form.flags.writeable = False
        assert np.array_equal(step(form, 2.0), wanted)


@pytest.mark.parametrize("method", TWINS)
@pytest.mark.parametrize("nu", [0.0, 0.5])
def test_complex_and_whole_numbers(method, nu):
    """A complex state is two real ones; whole numbers become floating ones."""
    step = dp.stepper(method, L, 1e-3)
    u = np.cos(X)
    v = np.sin(3 * X)
    both = step(u + 1j * v, nu)
    assert both == pytest.approx(step(u, nu) + 1j * step(v, nu), rel=1e-12)
    value, g = value_and_grad(lambda nu: anp.sum(anp.abs(step(u + 1j * v, nu)) ** 2))(nu)
    parts = value_and_grad(lambda nu: anp.sum(step(u, nu) ** 2 + step(v, nu) ** 2))(nu)
    assert (value, g) == pytest.approx(parts, rel=1e-11)
    assert (
        step(np.arange(N), nu) == pytest.approx(step(np.arange(N) + 0.0, nu)) and step(np.arange(N), nu).dtype == float
    )


# ---- Allen-Cahn at 1000 times the explicit limit ---------------------------------------------------------------------


def allen_cahn(method, cells, **options):
    """(step, start, its dt): nu = 0.01 on the closed unit square."""
    grid = dp.Grid((cells, cells), size=1.0)
    x, y = grid.centres()
    dt = 1000 * 2 / (8 * 256**2 * 0.01)
    start = 0.3 * np.cos(2 * np.pi * x) * np.cos(np.pi * y) + 0.1 * np.cos(5 * np.pi * x)
    return dp.stepper(method, lambda u, nu: u - u**3, dt, linear=(dp.laplacian(grid), lambda nu: nu), **options), start


def check_allen_cahn(method, cells):
    step, start = allen_cahn(method, cells, rtol=1e-12)
    loss = lambda nu: anp.sum(dp.rollout(step, start, nu, 3) ** 2) / cells**2
    value, g = value_and_grad(loss)(0.01)
    h = 1e-5
    central = (8 * (loss(0.01 + h) - loss(0.01 - h)) - loss(0.01 + 2 * h) + loss(0.01 - 2 * h)) / (12 * h)
    assert np.isfinite(value) and g == pytest.approx(central, rel=1e-7)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", ["backward_euler", "tr_bdf2", "imex", "etdrk4"])
def test_allen_cahn(method):
    check_allen_cahn(method, 16)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["backward_euler", "tr_bdf2", "imex", "etdrk4"])
def test_allen_cahn_large(method):
    """1000 times the limit of Euler's method at 256 x 256."""
    check_allen_cahn(method, 256)
