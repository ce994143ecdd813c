"""Sources that move: walls whose values change in time, and Prothero and Robinson's equation, at full order."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad

ORDERS = {"backward_euler": 1, "crank_nicolson": 2, "tr_bdf2": 2, "imex": 2, "etdrk4": 4}
GRID = dp.Grid(48, size=1.0)
X = GRID.centres()[0]
ENDS = np.array([0.0, 1.0])
WEIGHTS = 1 + np.exp(GRID.centres()[0])
G = dp.gradient(GRID, dp.dirichlet)
D = dp.divergence(GRID)
B = dp.lift(GRID, dp.dirichlet)
L = dp.laplacian(GRID, dp.dirichlet)


def exact(x, t, w):
    """The solution, on walls and inside. At the start it does not depend on w."""
    return anp.cos(3 * x + w * t) + x * anp.sin(5 * t)


def problem(reaction):
    """(rate, source) of u' = nu u_xx - r u^3 + f, walls by lift, f such that the cells have the solution exactly."""

    def source(params, t):
        nu, w = params
        u = exact(X, t, w)
        walls = B(exact(ENDS, t, w))
        f = -w * anp.sin(3 * X + w * t) + 5 * X * anp.cos(5 * t) - nu * D(G(u) + walls) + reaction * u**3
        return nu * D(walls) + f

    return (lambda u, params: -reaction * u**3) if reaction else None, source


def errors(method, reaction, n):
    """Of the state (root mean square), and of the gradient of a weighted sum in (nu, w), after n steps to t = 1."""
    rate, source = problem(reaction)
    step = dp.stepper(method, rate, 1.0 / n, linear=(L, lambda p: p[0]), source=source, rtol=1e-13)
    params = (1.0, 2.0)

    def end(p):
        return dp.rollout(step, (exact(X, 0.0, p[1]), 0.0), p, n)[0]

    of_nu, of_w = value_and_grad(lambda p: anp.sum(WEIGHTS * end(p)) / X.size)(params)[1]
    wanted = np.mean(WEIGHTS * -np.sin(3 * X + params[1]))  # the solution is the same for every nu
    return np.sqrt(np.mean((end(params) - exact(X, 1.0, params[1])) ** 2)), np.hypot(of_nu, of_w - wanted)


CHEAP = {("backward_euler", 0.0), ("crank_nicolson", 0.0), ("tr_bdf2", 0.0), ("imex", 1.0), ("etdrk4", 0.0)}
WALLS = list(product(ORDERS, (0.0, 1.0)))  # with a reaction, steps of many methods are Newton's


@pytest.mark.whole
@pytest.mark.parametrize(
    "method, reaction", [pytest.param(*row, marks=[pytest.mark.whole] * (row not in CHEAP)) for row in WALLS]
)
def test_moving_walls(method, reaction):
    """The errors of value and gradient fall with the order of the method."""
    found = np.array([errors(method, reaction, n) for n in (16, 128)])
    order = ORDERS[method]
    slopes = np.log2(found[0] / found[-1]) / 3
    assert np.all(slopes >= order - 0.2) and np.all(slopes <= order + 0.6), found
    assert np.all(found[-1] <= {1: 2e-2, 2: 3e-4, 4: 1e-7}[order]), found


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", ORDERS)
def test_prothero_robinson(method):
    """u' = -a (u - g(t)) + g'(t), u = g: the error at the end, the largest over all stiffnesses a."""
    one = dp.Grid(1, size=1.0)
    op = dp.laplacian(one, dp.dirichlet) * 0.25  # the number -1
    g = lambda t: anp.sin(3 * t) + anp.cos(t)
    slope = lambda t: 3 * anp.cos(3 * t) - anp.sin(t)
    worst = []
    for n in (32, 128):
        found = []
        for a in 10.0 ** np.arange(0, 9, 2):
            step = dp.stepper(method, op, 2.0 / n, source=lambda a, t: np.array([a * g(t) + slope(t)]), rtol=1e-13)
            end = dp.rollout(step, (np.array([g(0.0)]), 0.0), a, n)[0]
            found.append(abs(end[0] - g(2.0)))
        worst.append(max(found))
    assert np.log2(worst[0] / worst[-1]) / 2 >= ORDERS[method] - 0.15, worst


def test_stages_of_imex_by_hand():
    """ARS(2,2,2) with dense matrices, the source at the times of its implicit stages."""
    d = 1 - np.sqrt(0.5)
    e = 1 - 1 / (2 * d)
    h = 0.3
    nu = 0.7
    t = 0.2
    A = nu * L.matrix.toarray()
    eye = np.eye(X.size)
    s = lambda t: np.cos(X + 4 * t)
    rate = lambda u, t: np.sin(u) * t
    u = np.exp(X)
    n0 = rate(u, t)
    x1 = np.linalg.solve(eye - d * h * A, u + h * d * n0 + d * h * s(t + d * h))
    f1 = A @ x1 + s(t + d * h)
    n1 = rate(x1, t + d * h)
    right = u + h * (e * n0 + (1 - e) * n1) + (1 - d) * h * f1 + d * h * s(t + h)
    step = dp.stepper("imex", lambda u, p, t: rate(u, t), h, linear=(L, nu), source=lambda p, t: s(t))
    found, at = step((u, t))
    np.testing.assert_allclose(found, np.linalg.solve(eye - d * h * A, right), rtol=1e-11)
    assert at == t + h


def test_sources_of_etdrk4_are_integrated():
    """A cubic in time is exact: one step against small ones of rk4."""

    def source(p, t):
        return p[1] * (1 + t - 2 * t**2 + 3 * t**3) * np.cos(X)

    step = dp.stepper("etdrk4", dt=0.5, linear=(L, lambda p: p[0]), source=source)
    end, _ = step((np.sin(X), 0.0), (0.02, 1.0))
    fine = dp.stepper("rk4", lambda u, p, t: p[0] * L(u) + source(p, t), 0.5 / 1000)
    wanted, _ = dp.rollout(fine, (np.sin(X), 0.0), (0.02, 1.0), 1000)
    np.testing.assert_allclose(end, wanted, rtol=1e-10)
    assert (
        dp.check.gradient(lambda p: anp.sum(step((np.sin(X), 0.0), p)[0] ** 2), (0.02, 1.0), quick=True).verdict
        == "agrees"
    )
