"""Constraints of minimize: published optima, multipliers, and what wrong constraints get."""

import importlib.util
from typing import Any

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import LinearConstraint, NonlinearConstraint

import sparsedp as dp

METHODS = ["augmented_lagrangian", "slsqp", "trust_constr"]
METHODS += [name for name, library in (("mma", "nlopt"), ("ipopt", "cyipopt")) if importlib.util.find_spec(library)]

# Problems of W. Hock, K. Schittkowski, Test Examples for Nonlinear Programming Codes, 1981:
# loss, start, bounds, constraints, value and multipliers at the optimum.
ROOT = np.sqrt(3.0)
HOCK: dict[int, Any] = {
    21: (
        lambda x: 0.01 * x[0] ** 2 + x[1] ** 2 - 100,
        [-1.0, -1.0],
        (np.array([2.0, -50.0]), 50.0),
        [lambda x: 10 - 10 * x[0] + x[1]],
        -99.96,
        [0.0],
    ),
    24: (
        lambda x: ((x[0] - 3) ** 2 - 9) * x[1] ** 3 / (27 * ROOT),
        [1.0, 0.5],
        (0.0, None),
        [lambda x: x[1] - x[0] / ROOT, lambda x: -x[0] - ROOT * x[1], lambda x: x[0] + ROOT * x[1] - 6],
        -1.0,
        [ROOT / 2, 0.0, 0.5],
    ),
    35: (
        lambda x: (
            9
            - 8 * x[0]
            - 6 * x[1]
            - 4 * x[2]
            + 2 * x[0] ** 2
            + 2 * x[1] ** 2
            + x[2] ** 2
            + 2 * x[0] * x[1]
            + 2 * x[0] * x[2]
        ),
        [0.5, 0.5, 0.5],
        (0.0, None),
        [lambda x: x[0] + x[1] + 2 * x[2] - 3],
        1 / 9,
        [2 / 9],
    ),
    43: (
        lambda x: anp.sum(np.array([1, 1, 2, 1]) * x**2 + np.array([-5, -5, -21, 7]) * x),
        [0.0, 0.0, 0.0, 0.0],
        None,
        [
            lambda x: anp.sum(x**2 + np.array([1, -1, 1, -1]) * x) - 8,
            lambda x: anp.sum(np.array([1, 2, 1, 2]) * x**2) - x[0] - x[3] - 10,
            lambda x: 2 * x[0] ** 2 + x[1] ** 2 + x[2] ** 2 + 2 * x[0] - x[1] - x[3] - 5,
        ],
        -44.0,
        [1.0, 0.0, 2.0],
    ),
    71: (
        lambda x: x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2],
        [1.0, 5.0, 5.0, 1.0],
        (1.0, 5.0),
        [lambda x: 25 - x[0] * x[1] * x[2] * x[3], dp.equal(lambda x: anp.sum(x**2) - 40)],
        17.0140172891563,
        [0.5522936594190698, 0.1614685641140946],
    ),
    76: (
        lambda x: (
            x[0] ** 2
            + 0.5 * x[1] ** 2
            + x[2] ** 2
            + 0.5 * x[3] ** 2
            - x[0] * x[2]
            + x[2] * x[3]
            - x[0]
            - 3 * x[1]
            + x[2]
            - x[3]
        ),
        [0.5, 0.5, 0.5, 0.5],
        (0.0, None),
        [
            lambda x: x[0] + 2 * x[1] + x[2] + x[3] - 5,
            lambda x: 3 * x[0] + x[1] + 2 * x[2] - x[3] - 4,
            lambda x: 1.5 - x[1] - 4 * x[2],
        ],
        -4.68181818181818,
        [5 / 11, 0.0, 0.0],
    ),
}


QUICK = {("augmented_lagrangian", 71), ("augmented_lagrangian", 76), ("mma", 24), ("slsqp", 71), ("trust_constr", 24)}
QUICK |= {("ipopt", 71)}
PUBLISHED = [
    pytest.param(method, number, marks=[pytest.mark.whole] * ((method, number) not in QUICK))
    for method in METHODS
    for number in HOCK
    if (method, number) != ("mma", 71)  # it has an equality
]


@pytest.mark.parametrize("method, number", PUBLISHED)
def test_published_optima(method, number):
    loss, start, bounds, constraints, value, multipliers = HOCK[number]
    tolerance = {"mma": 1e-5, "trust_constr": 1e-6}.get(method, 1e-7)
    best = dp.minimize(
        loss, np.array(start), method, constraints=constraints, bounds=bounds, maxiter=400, tolerance=tolerance
    )
    assert best.converged and best.message.startswith("converged")
    assert max(best.feasibility, best.optimality) <= tolerance
    assert abs(best.value - value) <= 3 * tolerance * max(1.0, abs(value))
    assert np.allclose(best.multipliers, multipliers, atol=30 * tolerance)


def test_multipliers_are_the_derivative_of_the_optimal_value():
    """A two-sided NonlinearConstraint, an equality and a tree of unknowns, each limit moved by a small step."""

    def optimum(low=0.5, total=2.0):
        def loss(x):
            return anp.sum((x["u"] - 2.0) ** 2) + (x["k"] - 3.0) ** 2 * x["n"]

        constraints = {
            "total": dp.equal(lambda x: anp.sum(x["u"]) - total),
            "low": lambda x: low - x["u"][0] * x["k"],
            "high": lambda x: x["u"] * x["k"] - 4.0,
        }
        start = {"u": np.full(3, 0.5), "k": 1.0, "n": 2}
        return dp.minimize(loss, start, "slsqp", constraints=constraints, tolerance=1e-9)

    best = optimum(2.5)
    step = 1e-4
    by_low = (optimum(2.5 + step).value - optimum(2.5 - step).value) / (2 * step)
    by_total = (optimum(2.5, 2.0 + step).value - optimum(2.5, 2.0 - step).value) / (2 * step)
    assert best.converged and best.x["n"] == 2
    assert by_low > 0.1 and np.isclose(best.multipliers["low"], by_low, rtol=1e-5)
    assert np.isclose(best.multipliers["total"], -by_total, rtol=1e-5)
    assert best.multipliers["high"].shape == (3,) and np.all(best.multipliers["high"] >= 0)


@pytest.mark.parametrize("method", ["augmented_lagrangian", "slsqp"])
def test_constraints_of_scipy(method):
    """Two-sided limits, an equality, a limit that is infinite, and a jac of the user."""
    matrix = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, -1.0], [1.0, 0.0, 1.0]])
    linear = LinearConstraint(matrix, [-np.inf, 0.25, -1.0], [1.0, 0.25, np.inf])
    called = []

    def jac(x):
        called.append(1)
        return 2 * x[None]

    ball = NonlinearConstraint(lambda x: np.array([x @ x]), 0.5, 2.0, jac=jac)
    loss = lambda x: anp.sum((x - np.array([2.0, 2.0, 1.0])) ** 2)
    start = np.array([0.5, 0.2, 0.1])
    best = dp.minimize(loss, start, method, constraints=[linear, ball], tolerance=1e-7)
    # The rows x0 + x1 <= 1 and x1 - x2 == 1/4 are active: minimize over the line (1 - t, t, t - 1/4).
    t = (1 - 2 + 2 + 1.25) / 3
    multiplier = 2 * (1 + t)
    assert called and best.converged and np.allclose(best.x, [1 - t, t, t - 0.25], atol=1e-6)
    assert np.allclose(best.multipliers[0], [multiplier, 4 - 2 * t - multiplier, 0.0], atol=1e-5)
    assert np.allclose(best.multipliers[1], 0.0)


@pytest.mark.parametrize(
    "method", [pytest.param(one, marks=[pytest.mark.whole] * (one == "trust_constr")) for one in METHODS]
)
def test_contradictory_constraints_are_infeasible(method):
    constraints = [lambda x: anp.sum(x) + 1.0, lambda x: 1.0 - anp.sum(x)]
    best = dp.minimize(lambda x: anp.sum((x - 0.1) ** 2), np.full(2, 0.3), method, constraints=constraints, maxiter=60)
    assert not best.converged and best.message.startswith("infeasible: ") and best.feasibility > 0.1
