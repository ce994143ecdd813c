"""Nonlinear implicit steps: reuse of a Jacobian, the grid it is stored on, and that nothing else changes."""

from functools import cache

import autograd.numpy as anp
import numpy as np
import pytest
from residuals import rate as rate_of

import sparsedp as dp
from sparsedp import kernels
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback, value_and_grad
from sparsedp.errors import NonFiniteError
from sparsedp.integrators.exponential import Function
from sparsedp.solvers.inverse import build_dense
from sparsedp.solvers.jacobian import Jacobians
from sparsedp.solvers.newton import Newton

RATES = np.array([0.04, 1e4, 3e7])


def robertson(u, p):
    slow = p[0] * u[0]
    back = p[1] * u[1] * u[2]
    fast = p[2] * u[1] ** 2
    return anp.array([back - slow, slow - back - fast, fast])


def allen_cahn(shape, periodic=False):
    """(rate, state) of u' = nu lap u + u - u^3."""
    grid = dp.Grid(shape, size=1.0, periodic=periodic)
    op = dp.laplacian(grid)
    return lambda u, nu: nu * op(u) + u - u**3, 0.5 * np.cos(np.pi * grid.centres()[0]) + 0.1


# ---- one Jacobian for many Newton steps ----------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "most"), [("backward_euler", 1), ("tr_bdf2", 1), ("crank_nicolson", 1)])
def test_stages_share_a_jacobian(method, most):
    rate, u = allen_cahn((12, 10))
    step = dp.stepper(method, rate, 0.05)
    step(u, 0.01)
    with recording() as calls:
        step(u, 0.01)
    assert calls[f"implicit({method}).jacobian", "setup"] <= most
    assert step.info.forward.residual <= 1e-13 or step.info.forward.status == "converged_at_roundoff"


def test_a_jacobian_that_does_not_contract_is_made_again(monkeypatch):
    """A step of 50 time units of stiff kinetics: the first Jacobian is of no use at the root."""
    u = np.array([1.0, 0.0, 0.0])
    step = dp.stepper("backward_euler", robertson, 50.0)
    count = {"made": 0, "steps": 0}
    made = Jacobians.evaluate
    monkeypatch.setattr(Jacobians, "evaluate", lambda *args: (count.update(made=count["made"] + 1), made(*args))[1])
    new = step(u, RATES)
    residual = new - u - 50.0 * robertson(new, RATES)
    assert np.max(np.abs(residual)) <= 1e-8 and 3 < count["made"] <= step.info.forward.iterations + 1
    cubic = dp.stepper("backward_euler", lambda u, p: -p * u**3, 1.0, maxiter=1000)
    cubic(np.ones(3), 2.0)
    careful = cubic.info.forward.iterations
    monkeypatch.setattr(Newton, "_reuses_jacobian", lambda self, ratio: True)  # without the check of contraction
    cubic(np.ones(3), 2.0)
    assert cubic.info.forward.iterations > 2 * careful


@pytest.mark.whole
def test_nothing_outlives_a_step():
    """A step gives the same bits whatever was done before it, and so do gradients at any budget."""
    rate, u = allen_cahn((9, 8))
    first, second = (dp.stepper("tr_bdf2", rate, 0.1) for _ in range(2))
    second(3 * u, 0.7), second(-u, 0.0)
    np.testing.assert_array_equal(first(u, 0.01), second(u, 0.01))

    def slope(memory):
        loss = lambda x: anp.sum(dp.rollout(first, x[0], x[1], 9, memory=memory) ** 2)
        g = value_and_grad(loss)((u, 0.01))[1]
        return np.append(g[0], g[1])

    wanted = slope(None)
    for memory in (5 * u.nbytes + 16, 7 * u.nbytes + 16):
        np.testing.assert_array_equal(slope(memory), wanted)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson"])
def test_the_end_of_a_step_is_not_solved_for_again(method):
    """Going back through a loop that keeps its states; the gradient has the bits of one under a budget."""
    rate, u = allen_cahn((9, 8))
    params = {"nu": 0.01, "grow": np.full((9, 8), 0.5), "n": 3}
    step = dp.stepper(method, lambda u, p: rate(u, p["nu"]) + p["grow"] * u, lambda p: 0.1)
    loss = lambda x, memory=None: anp.sum(dp.rollout(step, x[0], x[1], 5, memory=memory) ** 2)
    with recording() as calls:
        state, slope = value_and_grad(loss)((u, params))[1]
    with recording() as ahead:
        loss((u, params))
    solves = f"implicit({method}).jacobian", "solve"
    assert calls[solves] == ahead[solves] > 5
    for memory in (12000, "1 MB"):
        again, of_params = value_and_grad(lambda x: loss(x, memory))((u, params))[1]
        np.testing.assert_array_equal(again, state)
        assert of_params["nu"] == slope["nu"] and of_params["n"] is None
        np.testing.assert_array_equal(of_params["grow"], slope["grow"])
    taped = value_and_grad(lambda x: anp.sum(step(step(x[0], x[1]), x[1]) ** 2))((u, params))[1]
    looped = value_and_grad(lambda x: anp.sum(dp.rollout(step, x[0], x[1], 2) ** 2))((u, params))[1]
    np.testing.assert_allclose(taped[0], looped[0], rtol=1e-13)
    np.testing.assert_allclose(taped[1]["grow"], looped[1]["grow"], rtol=1e-13)
    only = value_and_grad(lambda u: loss((u, params)))(u)[1]
    np.testing.assert_array_equal(only, state)


def test_loops_of_trees_and_single_precision():
    """A tree as state and float32 fields."""
    step = dp.stepper("backward_euler", lambda u, p: {"a": u["s"], "s": -p * anp.sin(u["a"])}, 0.1)
    run = lambda x: dp.rollout(step, {"a": x[0], "s": 0.0}, x[1], 4)["a"]
    once = lambda x: step(step(step(step({"a": x[0], "s": 0.0}, x[1]), x[1]), x[1]), x[1])["a"]
    np.testing.assert_allclose(value_and_grad(run)((0.5, 2.0))[1], value_and_grad(once)((0.5, 2.0))[1], rtol=1e-13)
    rate, u = allen_cahn((6, 5))
    field = dp.stepper("backward_euler", rate, 0.1)
    slope = lambda u: value_and_grad(lambda u: anp.sum(dp.rollout(field, u, 0.01, 3) ** 2))(u)[1]
    single = slope(u.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, slope(u), rtol=1e-4)


def test_a_pullback_gives_the_same_bits_twice():
    step = dp.stepper("tr_bdf2", robertson, 0.3)
    u = np.array([0.9, 2e-5, 0.1])
    pull = pullback(lambda p: step(u, p), RATES)[1]
    first = pull(np.ones(3))
    step(u, 2 * RATES)
    np.testing.assert_array_equal(pull(np.ones(3)), first)


@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2"])
def test_small_steps_add_up(method):
    """Each changes the state by less than the tolerance of Newton's method."""
    step = dp.stepper(method, lambda u, p: p * anp.array([u[1], -u[0]]), 1e-12)
    u = np.array([1.0, 0.0])
    for _ in range(50):
        u = step(u, 1.0)
    assert u[1] == pytest.approx(-5e-11, rel=1e-9)


@pytest.mark.parametrize("method", ["backward_euler", "tr_bdf2"])
def test_no_diffusion_and_hardly_any(method):
    """As a rate: nu = 0 is the identity; at 1e-300 and at diffusion number 1e8 the gradient equals the formula."""
    grid = dp.Grid(8, size=1.0)
    op = dp.laplacian(grid, dp.dirichlet)
    mode = np.sin(np.pi * grid.centres()[0])
    nonlinear = dp.stepper(method, lambda u, nu: nu * op(u), 1.0)
    linear = dp.stepper(method, op, 1.0)
    np.testing.assert_array_equal(nonlinear(mode, 0.0), mode)
    for nu in (0.0, 1e-300, 1e8 / 64):
        slopes = [value_and_grad(lambda nu, s=s: anp.sum(s(mode, nu) * mode))(nu)[1] for s in (nonlinear, linear)]
        assert slopes[0] == pytest.approx(slopes[1], rel=1e-8)


# ---- small systems --------------------------------------------------------------------------------------------------


def test_small_systems_take_the_same_path_while_calls_are_counted():
    step = dp.stepper("tr_bdf2", robertson, 0.3)
    u = np.array([0.9, 2e-5, 0.1])
    loss = lambda p: anp.sum(step(u, p) * np.array([1.0, 1e4, -2.0]))
    value, g = value_and_grad(loss)(RATES)
    assert step.info.hierarchy == "dense LU, 3 rows" and step.info.adjoint.residual <= 1e-10
    with recording():
        other, of_other = value_and_grad(loss)(RATES)
    assert value == other
    np.testing.assert_array_equal(g, of_other)


def dense(A):
    return build_dense(dp.from_matrix(A), 1e-12, "raise", "dense")


def test_dense_factors_solve_and_know_when_they_cannot():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((7, 7))
    b = rng.standard_normal(7)
    for scale in (1.0, 2.0**150, 2.0**-150):
        solver = dense(scale * A)
        np.testing.assert_allclose(scale * A @ solver.solve(b), b, rtol=1e-10)
        np.testing.assert_allclose(scale * A.T @ solver.solve(b, True), b, rtol=1e-10)
        assert solver.system.norm() == np.max(np.sum(np.abs(scale * A), 1))
    solver = dense(A)
    np.testing.assert_array_equal(solver.solve(2.0**800 * b), 2.0**800 * solver.solve(b))
    assert solver.log.forward.status == "converged" and solver.log.forward.residual <= 1e-12
    assert not solver.solve(0 * b).any() and solver.log.forward.status == "exact_zero_rhs"
    with pytest.raises(NonFiniteError, match="dense"):
        solver.solve(b * np.nan)
    beyond = (2.0**900 * A, 2.0**-900 * A)  # for these the general path scales
    for matrix in (np.zeros((3, 3)), np.ones((3, 3)), np.diag([1.0, 1e-14]), *beyond):
        assert dense(matrix) is None
    with pytest.raises(NonFiniteError, match=r"^matrix needs finite entries, got 1 .* the first at \(1, 1\)"):
        dense(np.diag([1.0, np.nan]))


# ---- grids ----------------------------------------------------------------------------------------------------------


def test_a_jacobian_stands_on_the_grid_of_its_operators():
    rate, u = allen_cahn((66, 64))
    step = dp.stepper("backward_euler", rate, 0.1)
    slope = value_and_grad(lambda nu: anp.sum(step(u, nu) ** 2))(0.01)[1]
    flat = dp.stepper("backward_euler", rate, 0.1, solver="direct")
    assert slope == pytest.approx(value_and_grad(lambda nu: anp.sum(flat(u, nu) ** 2))(0.01)[1], rel=1e-9)
    words = str(step.scheme.root)
    assert "cells(66, 64) -> cells(66, 64)" in words and ("structured" in words or not kernels.compiled())


def test_a_jacobian_that_is_not_symmetric_does_not():
    grid = dp.Grid((6, 5), size=1.0, periodic=True)
    average = dp.average(grid)
    out = dp.divergence(grid)
    step = dp.stepper("backward_euler", lambda u, p: -out(0.5 * p * average(u) ** 2), 0.01)
    step(np.sin(grid.centres()[0]), 1.0)
    assert "space(30) -> space(30)" in str(step.scheme.root)


def test_one_residual_for_fields_of_several_sizes():
    """The grid that was found for one size is none for another, or for another shape of that size."""
    op = cache(lambda shape: dp.laplacian(dp.Grid(shape)))
    make = lambda: dp.implicit(lambda x, p: x - 0.1 * op(x.shape)(x) + 0.1 * x**3 - p)
    root = make()
    for shape in ((6, 6), (3, 3), (4, 9), (6, 6)):
        b = np.cos(np.arange(np.prod(shape))).reshape(shape)
        np.testing.assert_allclose(root(0 * b, b), make()(0 * b, b), rtol=0, atol=1e-9)


@pytest.mark.parametrize("case", ["stretched", "two fields"])
def test_gradient_on_other_grids(case):
    widths = 1.3 ** np.arange(8.0)
    grid = dp.Grid((8, 9), spacing=(widths, 1.0)) if case == "stretched" else dp.Grid((4, 5))
    op = dp.laplacian(grid, dp.dirichlet)
    if case == "stretched":
        rate = lambda u, p: p * op(u) - u**3
        u = np.cos(grid.centres()[1])
    else:
        rate = lambda u, p: anp.stack([p * op(u[0]) - u[0] * u[1] ** 2, u[0] * u[1] ** 2 - u[1]])
        u = np.stack([np.cos(grid.centres()[0]), np.sin(grid.centres()[1])])
    step = dp.stepper("tr_bdf2", rate, 0.5)
    value, slope = value_and_grad(loss := lambda p: anp.sum(step(u, p) ** 3))(0.7)
    assert rate_of(lambda h: loss(0.7 + h) - value - h * slope) >= 1.95


def test_a_residual_without_vjp_is_still_solved():
    """Its Jacobian is assembled from forward products."""
    ahead = dp.differentiable("ahead", np.arctan, None, lambda nums, ts, ans, x: ts[0] / (1 + x**2))
    op = dp.laplacian(dp.Grid(30, size=1.0), dp.dirichlet)
    root = dp.implicit(lambda x, p: ahead(x) - op(x) - p)
    x = root(np.zeros(30), 1.0)
    assert np.max(np.abs(np.arctan(x) - op(x) - 1.0)) <= 1e-8


# ---- exponential steps ----------------------------------------------------------------------------------------------


def test_functions_are_evaluated_once_for_all_steps_and_the_adjoint(monkeypatch):
    """One set for each c dt, for plain and traced coefficients alike."""
    grid = dp.Grid(16, size=1.0)
    step = dp.stepper("etdrk4", lambda u, p: u - u**3, 0.01, linear=(dp.laplacian(grid), lambda p: p))
    evaluated = []
    values = Function.values
    monkeypatch.setattr(Function, "values", lambda self, *args: (evaluated.append(self), values(self, *args))[1])
    loss = lambda nu: anp.sum(dp.rollout(step, np.cos(grid.centres()[0]), nu, 6) ** 2)
    value_and_grad(loss)(0.1)
    first = len(evaluated)
    assert first == len(set(evaluated)) == 12  # six functions and their derivatives
    loss(0.1), value_and_grad(loss)(0.1)
    assert len(evaluated) == first
    value_and_grad(loss)(0.2)
    assert len(evaluated) == 2 * first


# ---- error control --------------------------------------------------------------------------------------------------


def test_a_stiff_rate_with_an_explicit_pair_is_given_up_early():
    count = [0]

    def stiff(u, p):
        count[0] += 1
        return -p * (u - 0.5)

    step = dp.stepper("heun", stiff, 1.0, tolerance=1e-3)
    with pytest.raises(dp.errors.ConvergenceError, match="a method for stiff problems"):
        step(np.array([0.6]), 1e9)
    assert count[0] < 7000
