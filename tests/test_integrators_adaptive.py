"""Error control: the tolerance is met, derivatives follow the steps that were taken, stiff kinetics with gradients."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.derivative import pushforward, value_and_grad
from sparsedp.ledger import recording


def robertson(u, p):
    """Three species and the integral of the third: A6."""
    slow, back, fast = p[0] * u[0], p[1] * u[1] * u[2], p[2] * u[1] ** 2
    return anp.array([back - slow, slow - back - fast, fast, u[2]])


def test_robertson_and_its_gradient():
    """A6: G and every component of its gradient within 1e-3."""
    start, p = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.04, 1e4, 3e7])
    step = dp.stepper("tr_bdf2", robertson, 50.0, tolerance=1e-4)
    value, g = value_and_grad(lambda p: step(start, p)[3])(p)
    assert value == pytest.approx(10.948648481, rel=1e-3)
    assert g == pytest.approx([1.734140891e2, -5.059191406e-4, 8.432346465e-8], rel=1e-3)
    assert len(step.taken) < 60 and sum(step.taken) == pytest.approx(1.0)
    assert max(step.taken) > 20 * min(step.taken)


def pendulum(u, p, t):
    return {"a": u["s"], "s": -p["g"] * anp.sin(u["a"]) * (1 + 0.1 * anp.cos(t))}


@pytest.mark.parametrize("method", ["euler", "heun", "ssprk3", "rk4", "tr_bdf2"])
def test_tolerance_and_derivatives(method):
    """On a tree with time; the derivative is that of the same steps with their lengths held."""
    start, params = {"a": 1.0, "s": 0.0}, {"g": 2.0, "T": 1.5}
    coarse = dp.stepper(method, pendulum, lambda p: p["T"], tolerance=1e-3 if method == "euler" else 1e-4)
    loss = lambda step: lambda x: step((x[0], 0.0), x[1])[0]["a"]
    exact, of_exact = value_and_grad(loss(dp.stepper("rk4", pendulum, lambda p: p["T"], tolerance=1e-7)))(
        (start, params)
    )
    value, g = value_and_grad(loss(coarse))((start, params))
    assert abs(value - exact) <= (3e-2 if method == "euler" else 2e-3)
    assert [*g[1].values()] == pytest.approx([*of_exact[1].values()], rel=0.1 if method == "euler" else 0.02)
    taken, halves = coarse.taken, dp.stepper(method, pendulum, lambda p: p["T"] * p["share"])

    def replayed(x):
        state = (x[0], 0.0)
        for share in taken:
            for _ in range(2):
                state = halves(state, {**x[1], "share": 0.5 * share})
        return state[0]["a"]

    again, of_again = value_and_grad(replayed)((start, params))
    assert value == pytest.approx(again, rel=1e-12)
    assert [*g[0].values(), *g[1].values()] == pytest.approx([*of_again[0].values(), *of_again[1].values()], rel=1e-9)
    d = ({"a": 0.3, "s": -0.2}, {"g": 0.5, "T": 0.1})
    along = pushforward(loss(coarse), (start, params), d)[1]
    assert along == pytest.approx(0.3 * g[0]["a"] - 0.2 * g[0]["s"] + 0.5 * g[1]["g"] + 0.1 * g[1]["T"], rel=1e-9)


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
