"""Time steps: orders of solution and gradient, exact factors, derivatives, counts of set-ups and solves."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp._utils.pytree import flatten, leaves
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad

ORDERS = {
    "euler": 1,
    "heun": 2,
    "ssprk3": 3,
    "rk4": 4,
    "backward_euler": 1,
    "crank_nicolson": 2,
    "tr_bdf2": 2,
}
SPLIT = {"imex": 2, "etdrk4": 4}
IMPLICIT = ["backward_euler", "crank_nicolson", "tr_bdf2"]
N = 6
GRID = dp.Grid(N, size=1.0)
L = dp.laplacian(GRID, dp.dirichlet)
X = GRID.centres()[0]


def pendulum(u, params):
    """A tree as state: angle and speed."""
    return {"a": u["s"], "s": -params["g"] * anp.sin(u["a"]) - params["drag"] * u["s"]}


def logistic(u, r, t):
    """Depends on u, a parameter and the time; solution below."""
    return r * u * (1 - u) * anp.cos(t)


def exact_logistic(u, r, t):
    grown = u * anp.exp(r * anp.sin(t))
    return grown / (1 - u + grown)


def run(step, state, params, n):
    for _ in range(n):
        state = step(state, params)
    return state


def slope(errors):
    return np.polyfit(np.arange(len(errors)), -np.log2(errors), 1)[0]


def dot(a, b):
    return sum(np.sum(x * y) for x, y in zip(leaves(a), leaves(b), strict=True))


def random_like(tree, seed):
    rng = np.random.default_rng(seed)
    found, rebuild = flatten(tree)
    return rebuild(
        rng.standard_normal(np.shape(leaf)) if np.ndim(leaf) else float(rng.standard_normal()) for leaf in found
    )


# ---- orders --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ORDERS)
def test_order_of_solution_and_gradient(method):
    """Nonlinear, with time: both errors fall with the order of the method."""
    u = 0.3
    r = 1.5
    span = 1.0
    wanted, of_wanted = value_and_grad(lambda p: exact_logistic(p[0], p[1], span))((u, r))
    errors = []
    for n in (16, 32):
        step = dp.stepper(method, logistic, span / n, rtol=1e-13)
        value, g = value_and_grad(lambda p, step=step, n=n: run(step, (p[0], 0.0), p[1], n)[0])((u, r))
        errors.append([abs(value - wanted), np.hypot(g[0] - of_wanted[0], g[1] - of_wanted[1])])
    for column in np.array(errors).T:
        assert slope(list(column)) == pytest.approx(ORDERS[method], abs=0.1)


# ---- stiff diffusion: A4 -------------------------------------------------------------------------------------------

FINE = dp.Grid(64, size=1.0)
LAMBDA = 4 * 64**2 * np.sin(np.pi / 128) ** 2


@pytest.mark.parametrize(
    ("method", "dt", "factor"),
    [
        ("backward_euler", 1e4, 1.013405041456e-05),
        ("backward_euler", 1e12, 1.0134153114578e-13),
        ("crank_nicolson", 1e4, -0.9999594642091),
    ],
)
@pytest.mark.parametrize("as_rate", [False, True])
def test_factor_of_a_sine_mode(method, dt, factor, as_rate):
    """As an Operator, and as a rate found nonlinear."""
    mode = np.sin(np.pi * FINE.centres()[0])
    op = dp.laplacian(FINE, dp.dirichlet)
    step = dp.stepper(method, (lambda u, nu: nu * op(u)) if as_rate else op, dt)
    assert step(mode, 1.0) / mode == pytest.approx(np.full(64, factor), rel=1e-9)
    value, g = value_and_grad(lambda nu: anp.sum(step(mode, nu) * mode))(1.0)
    z = dt * LAMBDA
    wanted = -z / (1 + z) ** 2 if method == "backward_euler" else -z / (1 + z / 2) ** 2
    assert g == pytest.approx(wanted * np.sum(mode**2), rel=1e-8)


@pytest.mark.parametrize("method", IMPLICIT)
def test_diffusion_number_1e8_and_1e_minus_300(method):
    """The gradient in nu, against the formula for a sine mode."""
    mode = np.sin(np.pi * X)
    eigenvalue = 4 * N**2 * np.sin(np.pi / (2 * N)) ** 2
    step = dp.stepper(method, L, 1.0)
    for nu in (1e8 / N**2, 1e-300):
        factor, of_factor = value_and_grad(lambda nu: growth(method, -nu * eigenvalue))(nu)
        value, g = value_and_grad(lambda nu: anp.sum(step(mode, nu) * mode))(nu)
        assert value == pytest.approx(factor * np.sum(mode**2), rel=1e-9)
        assert g == pytest.approx(of_factor * np.sum(mode**2), rel=1e-7)


def growth(method, z):
    """The stability function R(z)."""
    if method == "backward_euler":
        return 1 / (1 - z)
    if method == "crank_nicolson":
        return (1 + z / 2) / (1 - z / 2)
    d = 1 - np.sqrt(0.5)
    c = 1 / ((2 - 2 * d) * 2 * d)
    return (1 + c * ((1 + d * z) / (1 - d * z) - 1)) / (1 - d * z)


# ---- Prothero and Robinson: A5 -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "error"), [(10, 2.839440050e-08), (20, 1.385533333e-08), (40, 6.841088029e-09)])
def test_prothero_robinson(n, error):
    step = dp.stepper("backward_euler", lambda y, L, t: L * (y - anp.cos(t)) - anp.sin(t), 1.0 / n)
    y, t = run(step, (1.0, 0.0), -1e6, n)
    assert abs(y - np.cos(1.0)) == pytest.approx(error, abs=1e-15)
    assert t == pytest.approx(1.0)


# ---- derivatives ---------------------------------------------------------------------------------------------------


def scenes():
    """Return (step, state, params) by name."""
    heat = (np.cos(X), 0.7)
    tree = ({"a": 0.5, "s": 0.2}, {"g": 2.0, "drag": 0.1})
    forced = dict(linear=(L, lambda p: p["nu"]), source=lambda p, t: p["f"] * anp.cos(t))
    reaction = dict(linear=(L, lambda p: p["nu"]))
    field = {"nu": 0.3, "f": np.sin(3 * X), "dt": 0.001}
    react = lambda u, p: p["f"] * u * (1 - u**2)
    found = {}
    for method in ORDERS:
        found[f"{method} pendulum"] = (dp.stepper(method, pendulum, 0.1), *tree)
    for method in ORDERS | SPLIT:
        found[f"{method} heat"] = (dp.stepper(method, L, 1e-3), *heat)
        found[f"{method} forced"] = (dp.stepper(method, dt=lambda p: p["dt"], **forced), (heat[0], 0.1), field)
        if method == "tr_bdf2" or method not in IMPLICIT:
            found[f"{method} reaction"] = (dp.stepper(method, react, lambda p: p["dt"], **reaction), heat[0], field)
    return found


SCENES = scenes()


@pytest.mark.parametrize("name", SCENES)
def test_gradient_jvp_and_second_order(name):
    step, state, params = SCENES[name]
    weights = random_like(step(state, params), 1)
    many = 1 if name.startswith(tuple(IMPLICIT)) else 2

    def loss(x):
        return sum(anp.sum(w * leaf**2) for w, leaf in zip(leaves(weights), leaves(run(step, *x, many)), strict=True))

    x = (state, params)
    if name != "tr_bdf2 reaction":  # slow; test_integrators_twins.py has it beside a difference
        assert dp.check.gradient(loss, x, quick=True).verdict == "agrees"
    d = random_like(x, 2)
    e = random_like(x, 3)
    g = value_and_grad(loss)(x)[1]
    along = pushforward(loss, x, d)[1]
    assert dot(g, d) == pytest.approx(along, rel=1e-9)
    second = pushforward(lambda x: value_and_grad(loss)(x)[1], x, d)[1]
    other = pushforward(lambda x: value_and_grad(loss)(x)[1], x, e)[1]
    assert dot(second, e) == pytest.approx(dot(other, d), rel=1e-7)


def test_dt_traced_outside():
    """A step built inside a loss is differentiable in the dt it was built with."""
    loss = lambda dt: run(dp.stepper("rk4", lambda u, p: -p * u, dt), 1.0, 2.0, 3)
    value, g = value_and_grad(loss)(0.01)
    assert value == pytest.approx(np.exp(-0.06), rel=1e-9) and g == pytest.approx(-6 * np.exp(-0.06), rel=1e-6)


# ---- what is not needed is left out --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "stages"), [("backward_euler", 1), ("crank_nicolson", 1), ("tr_bdf2", 2), ("imex", 2)]
)
def test_one_setup_and_two_solves_a_stage(method, stages):
    step = dp.stepper(method, L, 0.1)
    n = 5
    name = f"stepper({method})"
    with recording() as calls:
        value_and_grad(lambda p: anp.sum(run(step, p[0], p[1], n) ** 2))((X, 0.5))
    assert (calls[name, "setup"], calls[name, "solve"], calls[name, "adjoint"]) == (1, n * stages, n * stages)


@pytest.mark.parametrize("method", ORDERS | SPLIT)
def test_no_diffusion_is_the_identity(method):
    """nu = 0: bit for bit, nothing set up; the gradient in nu is finite and right."""
    step = dp.stepper(method, L, 1e-3)
    with recording() as calls:
        assert np.array_equal(step(X, 0.0), X)
        g = value_and_grad(lambda nu: anp.sum(step(X, nu) * X))(0.0)[1]
    assert not any(kind in ("setup", "solve", "adjoint") for _, kind in calls)
    assert g == pytest.approx(1e-3 * np.sum(X * L(X)), rel=1e-12)


def test_set_up_is_reused_in_plain_calls():
    step = dp.stepper("tr_bdf2", L, 0.1)
    with recording() as calls:
        run(step, X, 1.0, 4)
    assert calls["stepper(tr_bdf2)", "setup"] == 1
    assert step.info.forward.status == "converged"


@pytest.mark.parametrize("method", ORDERS | SPLIT)
def test_dtype_is_that_of_the_field(method):
    step = dp.stepper(method, L, 1e-3)
    assert step(X.astype(np.float32), 1.0).dtype == np.float32
    assert (
        dp.stepper(method, lambda u, p: p * u, 0.1, linear=L, unstable="allow")(X.astype(np.float32), 2.0).dtype
        == np.float32
    )


def test_step_takes_the_input_of_a_loop():
    step = dp.stepper("heun", lambda u, p: p[0] * u + p[1], 0.5)
    assert step(1.0, 2.0, 3.0) == pytest.approx(1 + 0.5 * (5 + (2 * 3.5 + 3)) / 2)


def test_adjoint_of_a_step_is_its_transpose():
    step = dp.stepper("tr_bdf2", L, 0.1)
    u, g = random_like((X, X), 4)
    back = pullback(lambda u: step(u, 0.7), u)[1](g)
    assert np.sum(g * step(u, 0.7)) == pytest.approx(np.sum(back * u), rel=1e-12)


def test_repr_of_a_step():
    rate = lambda u, p: -p * u
    assert repr(dp.stepper("rk4", rate, 0.25)) == "<stepper(rk4): order 4, dt 0.25>"
    assert repr(dp.stepper("heun", rate, lambda p: 0.1 * p)) == "<stepper(heun): order 2, dt given by the params>"
