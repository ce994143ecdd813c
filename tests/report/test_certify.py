"""Certificates: the estimated errors are the true ones; and tolerances as loose as a gradient allows."""

import json
import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording, thread
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.inverse import Inverse, Solution
from sparsedp.solvers.records import SolveLog
from sparsedp.solvers.solve import Solver
from sparsedp.solvers.system import System

GRID = dp.Grid((20, 20), size=1.0)
L = dp.laplacian(GRID, dp.dirichlet)
D = dp.divergence(GRID)
G = dp.gradient(GRID, dp.dirichlet)
X, Y = GRID.centres()
B = np.exp(-20 * ((X - 0.3) ** 2 + (Y - 0.6) ** 2))
GOAL = 0.01 * np.sin(3 * X) * Y
K = 1 + 0.5 * np.sin(np.arange(GRID.faces.size))


def poisson(method, rtol):
    solve = dp.inverse(-L, method, rtol=rtol)
    return lambda b: anp.sum((solve(b) - GOAL) ** 2), B


def weighted(method, rtol):
    solve = dp.elliptic_solver(D, G, method, rtol=rtol)
    return lambda k: anp.sum((solve(k, B) - GOAL) ** 2), K


def implicit_steps(method, rtol):
    solve = dp.inverse(dp.identity(GRID.cells) - 0.01 * L, method, rtol=rtol)

    def loss(u):
        for _ in range(4):
            u = solve(u)
        return anp.sum((u - GOAL) ** 2)

    return loss, B


def nonlinear(method, rtol):
    root = dp.implicit(lambda u, p: u**3 - 0.01 * L(u) + u - p, method=method, rtol=rtol)
    return lambda p: anp.sum((root(0.5 * p, p) - GOAL) ** 2), B


SCENES = {"poisson": poisson, "weighted": weighted, "implicit steps": implicit_steps, "nonlinear": nonlinear}


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", ["krylov", "multigrid"])
@pytest.mark.parametrize("name", SCENES)
def test_effectivity(name, method):
    """Estimated over true error of the gradient, and of the value, for tolerances from 1e-2 to 1e-8."""
    loss, x = SCENES[name](method, 1e-13)
    value, gradient = dp.value_and_grad(loss)(x)
    for rtol in (1e-2, 1e-4, 1e-6, 1e-8):
        loss, x = SCENES[name](method, rtol)
        found = dp.certify(loss, x)
        true = np.linalg.norm(found.gradient - gradient) / np.linalg.norm(gradient)
        assert 0.9 <= found.gradient_error / true <= 1.1
        left = np.linalg.norm(found.corrected_gradient - gradient) / np.linalg.norm(gradient)
        assert left <= 0.1 * true
        if abs(value - found.value) > 1e-12 * abs(value):
            assert 0.5 <= found.value_error / (value - found.value) <= 2.0
        assert found.gradient_error <= sum(found.causes.values()) * (1 + 1e-9)


def test_split_by_solve_and_advice():
    """Two solvers, one of them loose: it gets the blame, and the advice helps."""

    def loss(rtol):
        first = dp.inverse(-L, "krylov", rtol=rtol)
        second = dp.inverse(dp.identity(GRID.cells) - L, "krylov", rtol=1e-9)
        return lambda b: anp.sum((second(first(b)) - GOAL) ** 2)

    found = dp.certify(loss(1e-2), B, target=1e-4)
    by = {row["solver"]: row for row in found.solves}
    assert by["inverse(-laplacian)"]["error"] > 100 * by["inverse(identity + -laplacian)"]["error"]
    assert by["inverse(-laplacian)"]["forward"] == by["inverse(-laplacian)"]["adjoint"] == 1
    assert 1e-4 < by["inverse(-laplacian)"]["forward residual"] <= 1e-2
    assert "tighten the" in found.advice and "inverse(-laplacian) from 1e-02 to" in found.advice
    wanted = float(found.advice.split(" to ")[1].split()[0])
    assert dp.certify(loss(wanted), B).gradient_error <= 1e-4
    assert "may stop at" in dp.certify(loss(1e-10), B, target=0.5).advice


def test_exact_solves():
    found = dp.certify(*poisson("direct", 1e-10))
    assert found.gradient_error < 1e-12 and found.advice == "all solves are direct: nothing to change"
    without = dp.certify(lambda u: anp.sum(u**2), B)
    assert without.gradient_error == without.value_error == 0.0 and without.solves == []


def test_solves_of_parallel_branches_are_not_confused():
    """Solves of one inverse on two branches: y and r cannot be paired by order, and the value is right still."""
    exact, loose = (dp.inverse(-L, "krylov", rtol=rtol) for rtol in (1e-13, 1e-3))

    def loss(solve):
        return lambda b: anp.sum(solve(b) * GOAL) + anp.sum(solve(b[::-1]) ** 2)

    value = loss(exact)(B)
    found = dp.certify(loss(loose), B)
    assert 0.5 <= found.value_error / (value - found.value) <= 2


def test_text_data_and_state():
    solve = dp.inverse(-L, "krylov", rtol=1e-4)
    found = dp.certify(lambda b: anp.sum(solve(b) ** 2), B)
    text = str(found)
    for words in ("gradient off by about", "from forward solves", "from adjoint solves", "advice:"):
        assert words in text
    assert json.loads(json.dumps(found.to_dict()))["advice"] == found.advice and repr(found) == text
    assert not thread.solve_hooks and solve.solver.system.rtol == 1e-4
    with pytest.raises(AttributeError, match="Certificate is frozen; make a new one instead of setting value"):
        found.value = 0.0
    with pytest.raises(
        ValueError, match="target of certify must be between 0 and 1, got 2; write for example target=0.01"
    ):
        dp.certify(lambda u: anp.sum(u), B, target=2)
    with pytest.raises(ZeroDivisionError):
        dp.certify(lambda u: 1 / 0, B)
    assert not thread.solve_hooks


# ---- tolerances for an optimizer -----------------------------------------------------------------------------------


def control(method, rtol=1e-10):
    solve = dp.inverse(-L, method, rtol=rtol)
    goal = X * (1 - X**2) * Y**2 * (1 - Y)
    return lambda u: 0.5 * (anp.sum((solve(u) - goal) ** 2) + 1e-2 * anp.sum(u**2)) / u.size


@pytest.mark.parametrize("method", ["krylov", "multigrid"])
def test_certified_control(method):
    best = dp.minimize(control("direct"), 0 * X, tolerance=1e-12)
    with recording() as calls:
        full = dp.minimize(control(method), 0 * X, tolerance=1e-6)
    iterations = sum(n for (_, kind), n in calls.items() if kind == "iterations")
    loose = dp.certified(0.1, 1e-6)
    found = dp.minimize(control(method), 0 * X, tolerance=loose)
    assert found.converged and found.evaluations <= full.evaluations + 1
    assert control("direct")(found.x) / best.value - 1 <= 1e-10
    assert loose.iterations <= 0.7 * iterations
    assert loose.evaluations == found.evaluations and loose.passes >= 2 * found.evaluations
    assert f"{loose.iterations} iterations in {loose.evaluations} evaluations" in str(loose) == repr(loose)
    assert str(pickle.loads(pickle.dumps(loose))) == str(loose)  # also after a run


class Sweeps(Engine):
    """Jacobi sweeps: u += (b - A u) / diagonal."""

    method = "sweeps"
    unit = "sweeps"
    iterative = True

    def __init__(self, system):
        self.system = system

    def solve(self, b, goal, transposed):
        u = np.zeros_like(b)
        used = 0
        while np.linalg.norm(r := b - self.system.product(u, transposed)) > goal and used < 100_000:
            u = u + r / self.system.diagonal
            used = used + 1
        return u, used, ""


def test_case_b7():
    """Fit theta in u'' = -theta sin(2 pi x) by 125 steps of gradient descent: 80 % fewer sweeps, no larger error."""
    n = 30
    h = 1 / (n + 1)
    A = -dp.laplacian(dp.Grid(n, spacing=h), dp.robin(2, h))
    load = np.sin(2 * np.pi * np.linspace(h, 1 - h, n))
    wanted = dp.inverse(A)(2 * load)
    system = System(A, 1e-10)
    swept = Inverse(Solution(Solver(system, Sweeps(system), "raise", SolveLog(), "sweeps", (None, ()))))
    loose = dp.certified(0.5, 0.0)
    options = dict(method="gd", maxiter=125, rate=275.0, tolerance=loose)
    best = dp.minimize(lambda theta: anp.sum((swept(theta * load) - wanted) ** 2) / (2 * n), 5.0, **options)
    assert abs(best.x / 2 - 1) <= 1.30e-5
    assert loose.iterations <= 0.2 * 75000


def test_direct_solves_and_refusals():
    loose = dp.certified(0.1)
    assert dp.minimize(control("direct"), 0 * X, tolerance=loose).converged
    assert loose.passes == loose.evaluations and loose.iterations == 0
    solve = dp.inverse(-L, "direct")
    misfit = lambda s: anp.sum((solve(s * X) - solve(0.5 * X)) ** 2)  # not the quadratic model of its first solves
    assert dp.minimize(misfit, 2.0, tolerance=dp.certified(0.1)).x == pytest.approx(0.5, rel=1e-7)
    with pytest.raises(
        ValueError,
        match=r"fraction of certified must be between 0 and 1, got 2; write for example certified\(0.1\)",
    ):
        dp.certified(2, 0)
    assert dp.minimize(control("direct"), 0 * X, tolerance=dp.certified(0.1, np.inf)).converged
    with pytest.raises(
        ValueError, match="certified sees the solves of the loss, not of a gradient that is given; leave it out"
    ):
        dp.minimize(lambda u: anp.sum(u**2), X, gradient=lambda u: 2 * u, tolerance=dp.certified())


def test_the_error_of_the_value_is_absolute_and_that_of_the_gradient_relative():
    """A loss times 1000 has a value that is off by 1000 times as much, and the same relative error of the gradient."""
    solve = dp.inverse(-dp.laplacian(dp.Grid((12, 12)), dp.dirichlet), "krylov", rtol=1e-3)
    b = np.sin(np.arange(144.0)).reshape(12, 12)
    one, thousand = (dp.certify(lambda b, size=size: size * anp.sum(solve(b) ** 2), b) for size in (1.0, 1000.0))
    assert thousand.value_error == pytest.approx(1000 * one.value_error, rel=1e-6)
    assert thousand.gradient_error == pytest.approx(one.gradient_error, rel=1e-6)
    assert "(absolute); corrected" in str(one) and "of itself" in str(one)
