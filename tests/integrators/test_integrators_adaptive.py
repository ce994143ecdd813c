"""Error control: the tolerance is met by value and derivatives, lengths suit the method, stiff kinetics."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pushforward, value_and_grad


def robertson(u, p):
    """Three species and the integral of the third: A6."""
    slow = p[0] * u[0]
    back = p[1] * u[1] * u[2]
    fast = p[2] * u[1] ** 2
    return anp.array([back - slow, slow - back - fast, fast, u[2]])


@pytest.mark.whole
def test_robertson_and_its_gradient():
    """A6: G and every component of its gradient within 1e-3."""
    start = np.array([1.0, 0.0, 0.0, 0.0])
    p = np.array([0.04, 1e4, 3e7])
    step = dp.stepper("tr_bdf2", robertson, 50.0, tolerance=1e-4)
    value, g = value_and_grad(lambda p: step(start, p)[3])(p)
    assert value == pytest.approx(10.948648481, rel=1e-3)
    assert g == pytest.approx([1.734140891e2, -5.059191406e-4, 8.432346465e-8], rel=1e-3)
    assert len(step.taken) < 60 and sum(step.taken) == pytest.approx(1.0)
    assert max(step.taken) > 20 * min(step.taken)


def pendulum(u, p, t):
    return {"a": u["s"], "s": -p["g"] * anp.sin(u["a"]) * (1 + 0.1 * anp.cos(t))}


def pendulum_by_scipy(a, g, end):
    """The angle at the end."""
    rate = lambda t, u: [u[1], -g * np.sin(u[0]) * (1 + 0.1 * np.cos(t))]
    return solve_ivp(rate, (0.0, end), [a, 0.0], method="DOP853", rtol=1e-13, atol=1e-14).y[0, -1]


@pytest.mark.sampled(0)
@pytest.mark.parametrize(
    "method",
    [
        "euler",
        "heun",
        "ssprk3",
        "rk4",
        *(pytest.param(m, marks=pytest.mark.whole) for m in ("backward_euler", "tr_bdf2")),
    ],
)
def test_tolerance_and_derivatives(method):
    """On a tree with time: value, gradient and tangent beside SciPy's."""
    tolerance = {"euler": 4e-3, "heun": 1e-3, "backward_euler": 4e-3, "tr_bdf2": 1e-3}.get(method, 1e-4)
    step = dp.stepper(method, pendulum, lambda p: p["T"], tolerance=tolerance)
    loss = lambda x: step(({"a": x[0], "s": 0.0}, 0.0), {"g": x[1], "T": x[2]})[0]["a"]
    x = np.array([1.0, 2.0, 1.5])
    value, g = value_and_grad(loss)(x)
    wanted = [(pendulum_by_scipy(*(x + d)) - pendulum_by_scipy(*(x - d))) / 2e-4 for d in 1e-4 * np.eye(3)]
    assert value == loss(x) == pytest.approx(pendulum_by_scipy(*x), abs=5 * tolerance)
    assert np.max(np.abs(x * (g - wanted))) <= 5 * tolerance * np.max(np.abs(x * wanted))
    assert pushforward(loss, x, np.array([0.3, 0.5, -0.2]))[1] == pytest.approx(g @ [0.3, 0.5, -0.2], rel=1e-9)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", ["backward_euler", "tr_bdf2", "imex", "etdrk4"])
def test_operators_take_halves_of_halves(method):
    """Lengths are powers of two, so that few set-ups serve many steps."""
    grid = dp.Grid(16, size=1.0)
    (x,) = grid.centres()
    rate = lambda u, p: p * u * (1 - u**2)
    rate = rate if method in ("imex", "etdrk4") else None
    step = dp.stepper(method, rate, 1.0, linear=dp.laplacian(grid, dp.dirichlet), tolerance=1e-3)
    with recording() as calls:
        new = step(np.sin(np.pi * x) + 0.5 * np.sin(5 * np.pi * x), 3.0)
    assert all(np.frexp(share)[0] == 0.5 for share in step.taken) and len(step.taken) > 3
    assert calls[f"stepper({method})", "setup"] <= 2 * len(set(step.taken)) + 6
    exact = dp.stepper("etdrk4", rate, 1.0, linear=dp.laplacian(grid, dp.dirichlet), tolerance=1e-8)
    wanted = exact(np.sin(np.pi * x) + 0.5 * np.sin(5 * np.pi * x), 3.0)
    assert np.max(np.abs(new - wanted)) <= 0.05 * 1.0


def test_a_stiff_problem_keeps_explicit_steps_small():
    """No step of the result is unstable: error control finds the limit by itself."""
    grid = dp.Grid(32, size=1.0)
    step = dp.stepper("rk4", dp.laplacian(grid, dp.dirichlet), 0.05, tolerance=1e-5)
    new = step(np.sin(np.pi * grid.centres()[0]), 1.0)
    assert np.max(np.abs(new)) == pytest.approx(np.exp(-0.05 * np.pi**2), rel=2e-2)
    assert np.median(step.taken) * 0.05 * 4 * 32**2 / 2 < 4


def test_nothing_moves():
    step = dp.stepper("rk4", lambda u, p: 0.0 * u, 1.0, tolerance=1e-6)
    assert np.array_equal(step(np.ones(3), None), np.ones(3)) and step.taken == [1.0]


@pytest.mark.parametrize("method", ["rk4", pytest.param("tr_bdf2", marks=pytest.mark.whole), "radau"])
def test_a_rate_that_is_at_rest_at_the_start_is_not_skipped(method):
    """A bell in time: at the start its rate is 0 to rounding, and so is the error of one step over all of it."""
    bell = lambda u, p, t: p * anp.exp(-(((t - 2.0) / 0.3) ** 2))  # in the end it leaves the range of floats
    step = dp.stepper(method, bell, 10.0, tolerance=1e-5 if method == "tr_bdf2" else 1e-6)
    assert step((0.0, 0.0), 1.0)[0] == pytest.approx(0.3 * np.sqrt(np.pi), rel=1e-4)
