"""Steady states: exact solutions, the flow of the time loop, published figures, gradients, what is refused."""

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from autograd import jacobian

import sparsedp as dp
from sparsedp.errors import ConvergenceError, NonFiniteError, ShapeError
from sparsedp.solvers import newton, preconditioners
from sparsedp.solvers.newton import Newton
from sparsedp.solvers.sparsity import stencil_pattern


def bratu(n, dim=1):
    """L u + lam exp(u) on a unit box, u = 0 on its walls."""
    L = dp.laplacian(dp.Grid((n,) * dim, size=1.0), dp.dirichlet)
    return lambda u, lam: L(u) + lam * anp.exp(u)


def bratu_exact(x, lam):
    """The lower branch: theta = sqrt(2 lam) cosh(theta / 4)."""
    theta = dp.implicit(lambda t, lam: t - anp.sqrt(2 * lam) * anp.cosh(t / 4))(1.0, lam)
    return -2 * anp.log(anp.cosh((x - 0.5) * theta / 2) / anp.cosh(theta / 4))


def burgers(n, nu):
    """Steady Burgers on (-1, 1): -tanh(x / 2 nu), whose values on the walls are the parameters."""
    grid = dp.Grid(n, size=2.0, origin=-1.0)
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    B = dp.lift(grid, dp.dirichlet)
    A = dp.average(grid, dp.dirichlet)

    def residual(u, ends):
        walls = anp.concatenate([ends[:1], np.zeros(n - 1), ends[1:]])
        return D(nu * (G(u) + B(ends)) - 0.5 * (A(u) + walls) ** 2)

    return grid, residual


class Flow:
    """Cavity and convection on n x n cells of the unit square: rates, a state at rest, one figure."""

    def __init__(self, n):
        self.grid = grid = dp.Grid((n, n), size=1.0)
        self.D, self.G, self.inside = dp.divergence(grid), dp.gradient(grid), dp.interior(grid)
        self.L, self.convect = dp.face_laplacian(grid), dp.convection(grid)
        lid = dp.face_lift(grid)
        hot = {"x": dp.dirichlet}
        self.moving = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0))
        self.pin = (np.arange(n * n) == 0.0).reshape(n, n)
        self.slope, self.mean, lift = dp.gradient(grid, hot), dp.average(grid), dp.lift(grid, hot)
        self.hot, self.up = lift(lift.domain.join(1.0, 0.0, 0.0, 0.0)), grid.join(0.0, 1.0)
        self.rest = {"v": np.zeros(grid.faces.size), "p": np.zeros((n, n))}
        self.warm = self.rest | {"T": 1 - grid.centres()[0]}

    def flow(self, v, p, force):
        rate = force - self.convect(v, v) - self.G(p)
        return {"v": self.inside(rate) + v - self.inside(v), "p": self.D(v) + self.pin * p}

    def cavity(self, x, re):
        return self.flow(x["v"], x["p"], (self.L(x["v"]) + self.moving) / re)

    def through(self, x):
        return x["v"] * self.mean(x["T"]) - self.slope(x["T"]) - self.hot

    def convection(self, x, ra):
        force = 0.71 * (self.L(x["v"]) + ra * self.up * self.mean(x["T"]))
        return {**self.flow(x["v"], x["p"], force), "T": -self.D(self.through(x))}

    def nusselt(self, x):
        return anp.mean(self.grid.split(self.through(x))[0][1:-1])

    def lines(self, x):
        """u on x = 1/2, v on y = 1/2."""
        (u, v), half = self.grid.split(x["v"]), self.grid.shape[0] // 2
        return u[half], v[:, half]

    def lowest(self, x):
        """Smallest u on x = 1/2, by a parabola."""
        return -peak(-self.lines(x)[0])

    def figures(self, x):
        u, v = self.lines(x)
        return -peak(-u), peak(v), -peak(-v)


def peak(line):
    low, top, high = line[np.argmax(line) - 1 :][:3]
    return top + (high - low) ** 2 / (8 * (2 * top - low - high))


# ---- exact solutions -------------------------------------------------------------------------------------------------


def test_bratu_in_one_dimension():
    """Second order in the state and in its derivative by lambda."""
    errors = []
    for n in (32, 64):
        (x,), residual = dp.Grid(n, size=1.0).centres(), bratu(n)
        ours = dp.jvp(lambda lam, n=n, r=residual: dp.steady(r, np.zeros(n), lam), 2.0, 1.0)
        exact = dp.jvp(lambda lam, x=x: bratu_exact(x, lam), 2.0, 1.0)
        errors.append([np.max(np.abs(a - b)) for a, b in zip(ours, exact, strict=True)])
    assert np.all(np.log2(np.divide(*errors)) > 1.9) and np.max(errors[1]) < 2e-4


@pytest.mark.whole
def test_burgers_in_one_dimension():
    nu = 0.1
    errors = []
    ends = np.tanh(0.5 / nu) * np.array([1.0, -1.0])
    for n in (50, 100):
        grid, residual = burgers(n, nu)
        u = dp.steady(residual, -grid.centres()[0], ends)
        errors.append(np.max(np.abs(u + np.tanh(grid.centres()[0] / (2 * nu)))))
    assert 1.9 < np.log2(errors[0] / errors[1]) < 2.1 and errors[1] < 3e-3
    weights = np.cos(np.arange(20.0))
    grid, residual = burgers(20, nu)
    find = dp.implicit(residual, rtol=1e-13)
    loss = lambda ends: anp.sum(weights * find(-grid.centres()[0], ends))
    result = dp.check.gradient(loss, 0.9 * ends, quick=True)
    assert result.verdict == "agrees"


def test_derivatives_near_a_fold_are_right_or_raise():
    """Bratu in 2-D by its height: lambda is an unknown of the tree, the fold is where it is largest."""
    rate = bratu(15, 2)
    middle = (7, 7)

    def by_height(x, height):
        return {"u": rate(x["u"], x["lam"]), "lam": x["u"][middle] - height}

    heights = np.arange(0.2, 2.0, 0.2)
    state = {"u": np.zeros((15, 15)), "lam": 1.0}
    branch = dp.implicit(by_height)
    curve = []
    for height in heights:
        state = branch(state, height)
        curve.append(state["lam"])
    fold = heights[np.argmax(curve)]
    assert 1.3 <= fold <= 1.5 and np.max(curve) == pytest.approx(6.808, rel=0.01)
    find = dp.implicit(rate)
    for height in (0.5, 1.0, 1.35, 1.385):  # from far below to just below the fold
        state = branch(state, height)
        slope = dp.grad(lambda h, s=state: branch(s, h)["lam"])(height)
        lam = float(state["lam"])
        ahead = state["u"]
        assert dp.grad(lambda lam, u=ahead: find(u, lam)[middle])(lam) == pytest.approx(1 / slope, rel=1e-6)
    with pytest.raises(ConvergenceError, match=r"after \d+ Newton steps: relative residual .* for nearby parameters"):
        find(np.zeros((15, 15)), 7.0)


# ---- flows -----------------------------------------------------------------------------------------------------------


def test_cavity_equals_the_end_of_a_time_loop():
    scene = Flow(12)
    project = dp.projection(scene.grid)
    x = dp.steady(scene.cavity, scene.rest, 50.0)
    advance = lambda v, re: project(v + 0.02 * ((scene.L(v) + scene.moving) / re - scene.convect(v, v)))
    v = dp.rollout(advance, scene.rest["v"], 50.0, 3000)
    assert np.max(np.abs(x["v"] - v)) < 1e-9
    assert np.max(np.abs(scene.D(x["v"]))) < 1e-12


def test_cavity_at_32():
    scene = Flow(32)
    x = dp.steady(scene.cavity, scene.rest, 100.0)
    assert scene.figures(x) == pytest.approx((-0.21404, 0.17957, -0.25380), rel=0.025)  # Botella and Peyret, 1998


@pytest.mark.parametrize("kind", ["cavity", pytest.param("convection", marks=pytest.mark.whole)])
def test_gradients_of_flows(kind):
    """Min u in Re, Nu in Ra: both orders, forward and backward."""
    scene = Flow(4)
    guess, figure, p = {"cavity": (scene.rest, scene.lowest, 60.0), "convection": (scene.warm, scene.nusselt, 5e3)}[
        kind
    ]
    find = dp.implicit(getattr(scene, kind), rtol=1e-13)
    near = find(guess, p)  # the sweep starts there
    result = dp.check.gradient(lambda p: figure(find(near, p)), p)
    assert result.verdict == "agrees" and "Hessian product: agrees" in str(result), str(result)


def test_convection_at_32_needs_pseudo_time(monkeypatch):
    """Ra 1e5 from rest: Newton's method alone stalls."""
    scene = Flow(32)
    x = dp.steady(scene.convection, scene.warm, 1e5)
    assert scene.nusselt(x) == pytest.approx(4.519, rel=0.04)  # de Vahl Davis, 1983
    monkeypatch.setattr(Newton, "_reach_by_pseudo_time", lambda self: False)
    with pytest.raises(ConvergenceError, match="stagnated"):
        dp.steady(scene.convection, scene.warm, 1e5)


@pytest.mark.slow
def test_cavity_and_convection_at_128():
    scene = Flow(128)
    state = None
    for re, known in {  # Botella and Peyret, 1998; in between Ghia, Ghia and Shin, 1982
        100.0: (-0.2140417, 0.1795728, -0.2538030),
        400.0: (-0.32726, 0.30203, -0.44993),
        1000.0: (-0.3885698, 0.3769447, -0.5270771),
    }.items():
        state = dp.steady(scene.cavity, state or scene.rest, re)
        assert scene.figures(state) == pytest.approx(known, rel=0.016)
    for ra, known in ((1e5, 4.519), (1e6, 8.800)):
        assert scene.nusselt(dp.steady(scene.convection, scene.warm, ra)) == pytest.approx(known, rel=0.01)


# ---- trees -----------------------------------------------------------------------------------------------------------


def test_two_fields_against_a_dense_twin(rng):
    """State and gradient of a reaction, beside Newton's method and one transposed solve with full matrices."""
    L = dp.laplacian(dp.Grid(9, size=1.0), dp.dirichlet)
    dense = L.matrix.toarray()
    weights = rng.standard_normal(18)
    p = {"a": 3.0, "b": rng.uniform(0.5, 1.0, 9)}

    def residual(x, p):
        return [L(x[0]) + p["a"] * x[1] ** 2 + 1.0, 0.1 * L(x[1]) - x[0] * x[1] + p["b"]]

    def twin(x, p):
        u = x[:9]
        w = x[9:]
        return anp.concatenate([anp.dot(dense, u) + p["a"] * w**2 + 1.0, 0.1 * anp.dot(dense, w) - u * w + p["b"]])

    x = np.zeros(18)
    for _ in range(20):
        x = x - np.linalg.solve(jacobian(twin)(x, p), twin(x, p))
    loss = lambda p: anp.sum(weights * anp.concatenate(dp.steady(residual, [np.zeros(9), np.zeros(9)], p)))
    value, slope = dp.value_and_grad(loss)(p)
    y = np.linalg.solve(jacobian(twin)(x, p).T, weights)
    assert value == pytest.approx(weights @ x, rel=1e-10)
    assert slope["a"] == pytest.approx(-y[:9] @ x[9:] ** 2, rel=1e-8)
    assert np.allclose(slope["b"], -y[9:], rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("shape", [(20, 13), (9, 8, 10)])
@pytest.mark.parametrize("periodic", [False, True])
def test_the_pattern_of_fields_on_one_grid_is_guessed(shape, periodic):
    """Velocity and pressure: every place that is not 0, from a few products for each kind of field."""
    grid = dp.Grid(shape, periodic=(periodic,) + (False,) * (len(shape) - 1))
    L = dp.face_laplacian(grid)
    G = dp.gradient(grid)
    D = dp.divergence(grid)
    whole = sp.block_array([[L.matrix, G.matrix], [D.matrix, None]]).tocsr()
    products = []

    def product(v):
        products.append(0)
        return whole @ v

    pattern = stencil_pattern([product], [*grid.faces.parts, grid.shape])
    assert abs(whole).sign().multiply(pattern).sum() == whole.nnz and len(products) == 3 * (len(shape) + 1)
    assert pattern.nnz < 1.6 * whole.nnz


def test_fields_are_paired_by_name():
    """Whatever the order in which a residual names them: the same bits, and each in its own units."""
    scene = Flow(5)
    states = []
    for turned in (False, True):
        residual = lambda x, re, turned=turned: dict(list(scene.cavity(x, re).items())[:: -1 if turned else 1])
        loss = dp.value_and_grad(lambda re, residual=residual: anp.sum(dp.steady(residual, scene.rest, re)["v"] ** 3))
        states.append(loss(20.0))
    assert states[0] == states[1] and states[0][1] != 0


def test_a_mean_over_a_field_fits_no_stencil():
    """A pressure whose mean is 0 in place of a pin: a full row is found, and the flow is the same."""
    scene = Flow(6)

    def free(x, re):
        rates = scene.cavity(x, re)
        return {"v": rates["v"], "p": scene.D(x["v"]) + scene.pin * anp.mean(x["p"])}

    x, y = (dp.steady(residual, scene.rest, 50.0) for residual in (scene.cavity, free))
    assert np.allclose(x["v"], y["v"], atol=1e-10) and np.allclose(x["p"] - x["p"].mean(), y["p"], atol=1e-9)


@pytest.mark.parametrize("size", [1.0, 1e10, 1e-10])
def test_each_field_meets_the_tolerance_by_itself(size):
    """A large field hides no other: with one norm for both, b = 1 would do beside terms of 1e30."""
    residual = lambda x, p: {"a": x["a"] ** 3 - size**3 * p, "b": x["b"] ** 2 - p}
    x = dp.steady(residual, {"a": np.full(40, size * np.cbrt(2.0)), "b": np.ones(40)}, 2.0)
    assert np.allclose(x["a"], size * np.cbrt(2.0), rtol=1e-9) and np.allclose(x["b"], np.sqrt(2.0), rtol=1e-9)


def test_kinds_of_guesses():
    square = lambda x, p: x**2 - p
    assert dp.steady(square, 1.0, 9.0) == 3.0
    assert dp.steady(square, np.ones(3, np.float32), 4.0).dtype == np.float32
    assert dp.steady(square, np.zeros((0, 4)), 1.0).shape == (0, 4)
    assert dp.steady(lambda x: x**2 - 4.0, np.ones(2)) == pytest.approx(2.0, rel=1e-12)  # without parameters
    found = dp.steady(lambda x, p, q: (x[0] - p, {"w": x[1]["w"] - q["c"]}), (0.0, {"w": np.zeros(2)}), 1.0, {"c": 5.0})
    assert found[0] == 1.0 and found[1]["w"].tolist() == [5.0, 5.0]
    single = dp.steady(bratu(8), np.zeros(8, np.float32), np.float32(1.0))
    assert single.dtype == np.float32 and np.allclose(single, dp.steady(bratu(8), np.zeros(8), 1.0), rtol=1e-6)


def test_guesses_are_not_modified(rng):
    """Fortran order, strides, read-only and broadcast arrays give the same bits."""
    scene = Flow(4)
    plain = rng.standard_normal((4, 4))
    want = dp.steady(scene.cavity, scene.rest | {"p": plain.copy()}, 20.0)
    wide = np.repeat(plain, 2, axis=1)[:, ::2]
    still = np.broadcast_to(0.0, scene.rest["v"].shape)
    for p in (np.asfortranarray(plain), wide, plain[::-1].copy()[::-1]):
        before = p.copy()
        x = dp.steady(scene.cavity, {"v": still, "p": p}, 20.0)
        assert all(np.array_equal(x[name], want[name]) for name in want) and np.array_equal(p, before)


@pytest.mark.whole
def test_scaling_the_residual_by_a_power_of_two_keeps_all_bits():
    """At a Rayleigh number that takes pseudo-time."""
    scene = Flow(4)
    want = dp.steady(scene.convection, scene.warm, 2e4)
    for k in (300, -300):
        x = dp.steady(lambda x, ra, k=k: {a: 2.0**k * b for a, b in scene.convection(x, ra).items()}, scene.warm, 2e4)
        assert all(np.array_equal(x[name], want[name]) for name in want)
    units = {"v": 2.0**20, "p": 2.0**-10, "T": -1.0}  # each field in units of its own, and of either sign
    x = dp.steady(lambda x, ra: {a: units[a] * b for a, b in scene.convection(x, ra).items()}, scene.warm, 2e4)
    assert all(np.allclose(x[name], want[name], rtol=1e-9, atol=1e-9 * np.max(np.abs(want[name]))) for name in want)


def test_explain_reports_pseudo_time():
    scene = Flow(16)
    plan = dp.explain(lambda ra: scene.nusselt(dp.steady(scene.convection, scene.warm, ra)), 2e5)
    assert "pseudo-time, as Newton steps stalled" in str(plan)


# ---- what is refused -------------------------------------------------------------------------------------------------


def test_a_pressure_without_a_pin_raises():
    scene = Flow(6)

    def free(x, re):
        return {**scene.cavity(x, re), "p": scene.D(x["v"])}

    with pytest.raises(
        ConvergenceError, match=r"has no inverse there: .* is singular .*add pin \* p, pin 1 in one cell"
    ):
        dp.steady(free, scene.rest, 10.0)


def test_invalid_arguments_raise():
    square = lambda x, p: x**2 - p
    for give, error, message in (
        (lambda: dp.steady(None, 1.0), TypeError, r"steady takes a function, got NoneType"),
        (lambda: dp.steady(square, 1.0, 4.0, maxiter=1), ConvergenceError, r"\(max_iterations\); start from"),
        (lambda: dp.steady(square, np.nan, 4.0), NonFiniteError, "the guess of implicit"),
        (lambda: dp.steady(square, 1.0, np.inf), NonFiniteError, "parameter 1 of implicit"),
        (lambda: dp.steady(lambda x: anp.log(x), -1.0), NonFiniteError, "the residual of implicit.* at the guess"),
        (lambda: dp.steady(lambda x: x[:2], np.ones(3)), ShapeError, "must hold 3 numbers, as many as x, got 2"),
        (lambda: dp.steady(lambda x: x["v"], {"v": np.ones(3), "p": np.ones(2)}), ShapeError, "must hold 5 numbers"),
        (lambda: dp.steady(square, 1.0, 4.0, rtol=2.0), ValueError, "rtol must be between 0 and 1"),
        (lambda: dp.steady(square, 1j, 4.0), TypeError, "solves for real unknowns"),
    ):
        with pytest.raises(error, match=message):
            give()


@pytest.mark.parametrize(("most", "own"), [(12, False), (1, True)])
def test_factors_of_an_earlier_jacobian_precondition_the_next(monkeypatch, most, own):
    """GMRES with the LU of a matrix nearby, an LU of its own where that does not do: the same root, the same bits."""
    grid, residual = burgers(200, 0.1)
    ends = np.array([1.0, -1.0])
    factored = []
    made = preconditioners.direct_engine
    find = dp.implicit(residual)
    loss = dp.value_and_grad(lambda ends: anp.sum(find(-grid.centres()[0], ends) ** 2))
    exact = loss(ends)
    monkeypatch.setattr(preconditioners, "direct_engine", lambda system: factored.append(system) or made(system))
    monkeypatch.setattr(preconditioners, "MOST_ITERATIONS", most)
    monkeypatch.setattr(newton, "REUSE_LU_FROM", 100)
    found = loss(ends)
    again = loss(ends)
    assert found[0] == again[0] and np.array_equal(found[1], again[1]) and bool(factored) == own
    assert found[0] == pytest.approx(exact[0], rel=1e-9) and found[1] == pytest.approx(exact[1], rel=1e-6)
