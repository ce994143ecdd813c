"""Constraints of minimize: published optima, multipliers, units, and results for constraints that contradict."""

import functools
import importlib.util
import re
import sys
from types import ModuleType
from typing import Any

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, minimize

import sparsedp as dp
from sparsedp.optimize.augmented_lagrangian import AugmentedLagrangian

WHOLE = pytest.mark.whole
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
    pytest.param(method, number, marks=[WHOLE] * ((method, number) not in QUICK))
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
    assert abs(best.value - value) <= 10 * tolerance * max(1.0, abs(value))
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


@pytest.mark.parametrize("method", [pytest.param("augmented_lagrangian", marks=WHOLE), "slsqp"])
def test_a_source_with_given_temperatures_against_the_kkt_system(method, rng):
    """The smallest heat source with given readings: one equality for each of three sensors."""
    grid = dp.Grid((6, 5), size=1.0)
    minus_laplacian = -dp.laplacian(grid, dp.dirichlet)
    temperature_of = dp.inverse(minus_laplacian)
    sensors = dp.sample(grid, rng.uniform(0.2, 0.8, (3, 2)))
    readings = np.array([0.1, 0.2, 0.15])

    def loss(source):
        return 0.5 * anp.sum(source**2)

    def misfit(source):
        return sensors(temperature_of(source)) - readings

    best = dp.minimize(loss, np.ones(grid.shape), method, constraints=dp.equal(misfit), tolerance=1e-9, maxiter=300)
    matrix = sensors.matrix.toarray() @ np.linalg.inv(minus_laplacian.matrix.toarray())
    system = np.block([[np.eye(30), matrix.T], [matrix, np.zeros((3, 3))]])
    solution = np.linalg.solve(system, np.concatenate([np.zeros(30), readings]))
    assert best.converged and np.allclose(best.x.ravel(), solution[:30], atol=1e-6 * np.max(np.abs(solution[:30])))
    assert np.allclose(best.multipliers, solution[30:], rtol=1e-6)
    lagrangian = lambda source: loss(source) + anp.sum(best.multipliers * misfit(source))
    assert np.linalg.norm(dp.grad(lagrangian)(best.x)) <= 1e-7 * np.linalg.norm(best.x)
    assert dp.check.gradient(lagrangian, np.ones(grid.shape), quick=True).verdict == "agrees"


def active_set(matrix, target, weight, limit):
    """Return the source u and the multipliers for 1/2 |T u - target|^2 + weight / 2 |u|^2 with T u <= limit."""
    size = len(matrix)
    multipliers = np.zeros(size)
    active = np.zeros(size, dtype=bool)
    for _ in range(50):
        # The rows are the gradient of the Lagrangian, and T u = limit where active, else no multiplier.
        system = np.block(
            [
                [matrix.T @ matrix + weight * np.eye(size), matrix.T],
                [matrix * active[:, None], np.diag(np.where(active, 0.0, 1.0))],
            ]
        )
        solution = np.linalg.solve(system, np.concatenate([matrix.T @ target, np.where(active, limit, 0.0)]))
        u, multipliers = solution[:size], solution[size:]
        before = active
        active = multipliers + (matrix @ u - limit) > 1e-12
        if np.array_equal(active, before):
            return u, multipliers
    raise AssertionError("the active set does not settle")


@pytest.mark.parametrize("cells, inner", [(6, 5), pytest.param(20, 50, marks=WHOLE)])
def test_a_limit_in_each_cell_against_active_sets(cells, inner):
    """The penalty must not grow faster than the inner searches converge."""
    grid = dp.Grid((cells, cells), size=1.0)
    minus_laplacian = -dp.laplacian(grid, dp.dirichlet)
    temperature_of = dp.inverse(minus_laplacian)
    x, y = grid.centres()
    target = np.where((x < 0.5) & (np.abs(y - 0.5) < 0.3), 1.3, 0.5)

    def loss(source):
        return 0.5 * anp.sum((temperature_of(source) - target) ** 2) + 0.5e-3 * anp.sum(source**2)

    best = dp.minimize(
        loss,
        np.ones(grid.shape),
        "augmented_lagrangian",
        constraints=lambda source: temperature_of(source) - 0.6,
        tolerance=1e-8,
        maxiter=500,
        inner=inner,
    )
    matrix = np.linalg.inv(minus_laplacian.matrix.toarray())
    source, multipliers = active_set(matrix, target.ravel(), 1e-3, 0.6)
    assert best.converged and np.any(multipliers > 0.01) and np.any(multipliers == 0.0)
    assert np.allclose(best.x.ravel(), source, atol=1e-5 * np.max(np.abs(source)))
    assert np.allclose(best.multipliers.ravel(), multipliers, atol=1e-4 * np.max(multipliers))


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


SUM_IS_TWO = dp.equal(lambda x: anp.sum(x) - 2.0)


@pytest.mark.parametrize(
    "constraint",
    [
        dp.jit(SUM_IS_TWO),
        functools.partial(SUM_IS_TWO),
        dp.jit(functools.partial(functools.partial(SUM_IS_TWO))),
        functools.lru_cache(SUM_IS_TWO),
        functools.wraps(SUM_IS_TWO)(lambda x: SUM_IS_TWO(x)),
        SUM_IS_TWO.__call__,
    ],
    ids=["jit", "partial", "nested", "cache", "wraps", "method"],
)
def test_a_wrapped_equality_remains_an_equality(constraint):
    loss = lambda x: anp.sum((x - 0.1) ** 2)
    best = dp.minimize(loss, np.array([0.5, 0.5]), "slsqp", constraints=constraint)
    assert best.converged and best.x == pytest.approx(np.ones(2), abs=1e-9)


@pytest.mark.parametrize("method", [pytest.param(one, marks=[WHOLE] * (one == "trust_constr")) for one in METHODS])
def test_contradictory_constraints_are_infeasible(method):
    constraints = [lambda x: anp.sum(x) + 1.0, lambda x: 1.0 - anp.sum(x)]
    best = dp.minimize(lambda x: anp.sum((x - 0.1) ** 2), np.full(2, 0.3), method, constraints=constraints, maxiter=60)
    assert not best.converged and best.message.startswith("infeasible: ") and best.feasibility > 0.1


class StandIn:
    """The class Problem of cyipopt, with its callbacks; it solves the problem by SciPy's SLSQP."""

    def __init__(self, n, m, problem_obj, lb, ub, cl, cu):
        self.callbacks = problem_obj
        self.bounds = Bounds(lb, ub)
        self.limits = cl, cu
        self.shape = m, n
        self.options = {}

    def add_option(self, name, value):
        self.options[name] = value

    def solve(self, start):
        lower, upper = self.limits
        equality = lower == upper
        constraints = [
            {
                "type": kind,
                "fun": lambda z, rows=rows, sign=sign: sign * self.callbacks.constraints(z)[rows],
                "jac": lambda z, rows=rows, sign=sign: sign * self.callbacks.jacobian(z).reshape(self.shape)[rows],
            }
            for kind, rows, sign in (("eq", equality, 1.0), ("ineq", ~equality & (upper == 0), -1.0))
        ]

        class Stop(Exception):
            pass

        iterations = []

        def callback(z):
            iterations.append(z)
            self.callbacks.gradient(z)
            figures = [0.0] * 9
            if not self.callbacks.intermediate(0, len(iterations), *figures):
                raise Stop

        message = b"Solved_To_Acceptable_Level"
        try:
            minimize(
                self.callbacks.objective,
                start,
                jac=self.callbacks.gradient,
                bounds=self.bounds,
                constraints=constraints,
                callback=callback,
                method="SLSQP",
                options={"ftol": 1e-30},
            )
        except Stop:
            message = b"User_Requested_Stop"
        return start, {"status_msg": message}


def test_callbacks_of_ipopt(monkeypatch):
    """Objective, gradient, constraints, Jacobian, bounds and intermediate, without Ipopt."""
    module = ModuleType("cyipopt")
    module.Problem = StandIn
    monkeypatch.setitem(sys.modules, "cyipopt", module)
    loss, start, bounds, constraints, value, multipliers = HOCK[71]
    settings = {"linear_solver": "mumps"}
    best = dp.minimize(loss, np.array(start), "ipopt", constraints=constraints, bounds=bounds, settings=settings)
    assert best.converged and np.isclose(best.value, value, rtol=1e-8)
    assert np.allclose(best.multipliers, multipliers, atol=1e-7) and len(best.history) > 3
    with pytest.raises(ZeroDivisionError):
        dp.minimize(loss, np.array(start), "ipopt", constraints=constraints, callback=lambda record, x: 1 / 0)


# ---- scales and precision --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("x_size, loss_size, constraint_size", [(1e-9, 1e9, 1e9), (1e9, 1e-9, 1e-9)])
@pytest.mark.parametrize("method", ["augmented_lagrangian", "mma", "slsqp"])
def test_units_do_not_matter(method, x_size, loss_size, constraint_size):
    """The unknowns, the loss and the constraints are divided by their sizes."""
    if method not in METHODS:
        pytest.skip("NLopt is not installed")
    loss, start, bounds, constraints, value, multipliers = HOCK[24]
    best = dp.minimize(
        lambda x: loss_size * loss(x / x_size),
        x_size * np.array(start),
        method,
        constraints=[lambda x, one=one: constraint_size * one(x / x_size) for one in constraints],
        bounds=bounds,
        tolerance=1e-6,
    )
    assert best.converged
    assert np.isclose(best.value, value * loss_size, rtol=1e-5)
    assert np.allclose(np.array(best.multipliers) * constraint_size / loss_size, multipliers, atol=1e-5)


@pytest.mark.parametrize("method", METHODS[:2])
def test_single_precision_and_constant_leaves(method):
    def loss(x):
        return anp.sum((x["u"] - x["target"]) ** 2)

    start = {"u": np.zeros(3, np.float32), "target": 2, "name": "a"}
    best = dp.minimize(loss, start, method, constraints={"sum": lambda x: anp.sum(x["u"]) - 3.0}, bounds=(0.0, None))
    assert best.converged and best.x["u"].dtype == np.float32 and best.x["name"] == "a"
    assert np.allclose(best.x["u"], 1.0, atol=1e-4) and np.isclose(best.multipliers["sum"], 2.0, rtol=1e-3)


def test_complex_unknowns():
    """The nearest point to 3 + 4i in the unit disk."""
    best = dp.minimize(
        lambda z: anp.abs(z - (3 + 4j)) ** 2,
        0.5 + 0.1j,
        "augmented_lagrangian",
        constraints=lambda z: anp.abs(z) ** 2 - 1.0,
    )
    assert best.converged and np.isclose(best.x, 0.6 + 0.8j, atol=1e-7) and np.isclose(best.multipliers, 4.0, atol=1e-6)


# ---- the course of a run ---------------------------------------------------------------------------------------------


def without_seconds(best):
    return [record._replace(seconds=0.0) for record in best.history]


@pytest.mark.parametrize("stop", [8, pytest.param(1, marks=WHOLE), pytest.param(30, marks=WHOLE)])
def test_a_resumed_run_has_the_same_bits(tmp_path, stop):
    loss, start, bounds, constraints, _, _ = HOCK[71]

    def run(stop=None, **options):
        return dp.minimize(
            loss,
            np.array(start),
            "augmented_lagrangian",
            constraints=constraints,
            bounds=bounds,
            callback=lambda record, x: record.iteration == stop,
            **options,
        )

    whole = run()
    stopped = run(stop, checkpoint=tmp_path)
    assert stopped.message.startswith("stopped by the callback") and stopped.history[-1].iteration == stop
    resumed = run(checkpoint=tmp_path)
    assert resumed.resumed.startswith(f"resumed from iteration {stop}")
    assert resumed.message == whole.message and resumed.evaluations == whole.evaluations
    assert without_seconds(resumed) == without_seconds(whole)
    assert np.array_equal(resumed.x, whole.x) and np.array_equal(resumed.multipliers, whole.multipliers)
    again = run(checkpoint=tmp_path)
    assert again.converged and np.array_equal(again.x, whole.x)
    constraints = [lambda x: 1.01 * (25 - x[0] * x[1] * x[2] * x[3]), constraints[1]]
    with pytest.raises(ValueError, match="holds a run with another"):
        run(checkpoint=tmp_path)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("where", ["loss", "constraint", "callback"])
def test_exceptions_and_interrupts_come_through(method, where):
    """A library must neither swallow an exception nor lose the best point after Ctrl-C."""
    calls = dict.fromkeys(["loss", "constraint", "callback"], 0)

    def failing(name, error):
        calls[name] += 1
        if name == where and calls[name] == 4:
            raise error

    def run(error):
        calls.update(dict.fromkeys(calls, 0))

        def loss(x):
            failing("loss", error)
            return anp.sum((x - np.array([2.0, 1.0, 0.3])) ** 4)

        def constraint(x):
            failing("constraint", error)
            return anp.sum(x**2) - 1.0

        def callback(record, x):
            failing("callback", error)

        return dp.minimize(loss, np.full(3, 0.1), method, constraints=constraint, callback=callback, bounds=(0.0, 5.0))

    with pytest.raises(ZeroDivisionError, match="by the user"):
        run(ZeroDivisionError("by the user"))
    best = run(KeyboardInterrupt())
    assert best.message == "interrupted" and not best.converged and len(best.history) >= 2
    assert best.value <= best.history[0].value and best.feasibility <= 1e-6


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("error", [dp.errors.ConvergenceError, dp.errors.UnstableStepError, None])
def test_points_that_cannot_be_evaluated_are_avoided(method, error):
    """Beyond x[0] == 1.5 the loss or the constraint raises, or is NaN; the optimum is at (1, 1)."""

    def loss(x):
        return anp.sum((x - 2.0) ** 2)

    def constraint(x):
        if anp.max(x) > 1.5:
            if error is None:
                return anp.log(anp.sum(x) - 100.0)
            raise error("no solution")
        return anp.sum(x) - 2.0

    with np.errstate(invalid="ignore"):
        best = dp.minimize(loss, np.full(2, 0.2), method, constraints=constraint, maxiter=100, tolerance=1e-5)
    assert best.converged and np.allclose(best.x, 1.0, atol=1e-4)


def test_the_message_names_refused_points():
    def constraint(x):
        if anp.max(x) > 1.0:
            raise dp.errors.ConvergenceError("no solution there")
        return anp.sum(x) - 3.0

    best = dp.minimize(lambda x: anp.sum((x - 2.0) ** 2), np.ones(2), "slsqp", constraints=constraint)
    assert not best.converged and np.array_equal(best.x, [1.0, 1.0])
    assert "points refused (ConvergenceError: no solution there); dp.check.gradient" in best.message


@pytest.mark.parametrize("method", METHODS)
def test_adjoint_solves_that_fail_at_a_trial_point(method):
    """The constraint has a value everywhere, but beyond x[0] == 1.5 its backward pass raises."""

    def backward(nums, ans, x):
        def pull(g):
            if x > 1.5:
                raise dp.errors.ConvergenceError("no adjoint solution")
            return (g,)

        return pull

    identity = dp.differentiable("identity", lambda x: 1.0 * x, backward)
    constraint = lambda x: identity(x[0]) + x[1] - 2.0
    loss = lambda x: anp.sum((x - 2.0) ** 2)
    best = dp.minimize(loss, np.full(2, 0.2), method, constraints=constraint, maxiter=100, tolerance=1e-5)
    assert best.converged and np.allclose(best.x, 1.0, atol=1e-4)


def test_one_backward_pass_of_the_constraints_in_an_evaluation():
    passes = []

    def backward(nums, ans, x):
        def pull(g):
            passes.append(1)
            return (g,)

        return pull

    identity = dp.differentiable("identity", lambda x: 1.0 * x, backward)
    loss = lambda x: anp.sum((x - 2.0) ** 2)
    constraint = lambda x: identity(x) - 1.0
    best = dp.minimize(loss, np.full(3, 1.2), "augmented_lagrangian", constraints=constraint)
    assert best.converged and len(passes) <= best.evaluations + 12  # the unit, and updates of the multipliers


@pytest.mark.parametrize("method", METHODS)
def test_no_iterations_and_infeasible_starts(method):
    best = dp.minimize(lambda x: anp.sum(x**2), np.full(2, 0.5), method, constraints=lambda x: 3.0 - x, maxiter=0)
    assert len(best.history) == 1 and not best.converged and np.array_equal(best.x, [0.5, 0.5])
    assert best.feasibility > 0.3 and np.array_equal(best.constraint_values, [2.5, 2.5])
    assert "the constraints are violated by up to" in best.message


@pytest.mark.parametrize("method", [pytest.param("augmented_lagrangian", marks=WHOLE), "mma", "slsqp"])
def test_a_loss_without_a_minimum_is_not_converged(method):
    """At x = -1e20 the step of a gradient of 1 is lost in rounding; that must not count as a bound."""
    if method not in METHODS:
        pytest.skip("NLopt is not installed")
    constraint = lambda x: anp.sum(x) - 1.0
    best = dp.minimize(lambda x: anp.sum(x), np.zeros(2), method, constraints=constraint, maxiter=40)
    assert not best.converged and best.optimality > 0.5


@pytest.mark.parametrize("method", METHODS)
def test_unknowns_that_bounds_hold_fixed(method):
    lower = np.array([0.5, 0.0, 0.0])
    upper = np.array([0.5, 1.0, 1.0])
    start = np.array([0.5, 0.1, 0.1])
    constraint = lambda x: anp.sum(x) - 1.0
    best = dp.minimize(lambda x: anp.sum((x - 2.0) ** 2), start, method, constraints=constraint, bounds=(lower, upper))
    assert best.converged and np.allclose(best.x, [0.5, 0.25, 0.25], atol=1e-6)
    assert np.isclose(best.multipliers, 3.5, atol=1e-6)


def test_the_penalty_grows_only_if_minimizers_differ_too_little(monkeypatch):
    """Not after the first violation, which is the first in which the constraint takes part, and not on the way."""
    updated = AugmentedLagrangian._updated
    penalties = []

    def recorded(*args):
        state = updated(*args)
        penalties.append(state.penalty)
        return state

    monkeypatch.setattr(AugmentedLagrangian, "_updated", recorded)
    loss, limit = lambda x: (x - 1.3) ** 4, lambda x: x - 1.0
    best = dp.minimize(loss, 0.0, "augmented_lagrangian", constraints=limit)
    assert best.converged and penalties[:4] == [1.0, 1.0, 1.0, 10.0]
    best = dp.minimize(loss, 0.0, "augmented_lagrangian", constraints=limit, inner=1)
    assert best.converged and best.evaluations < 30 and penalties[-1] == 10.0
    loss, start, bounds, constraints, *_ = HOCK[76]  # where the violation is below the accuracy of the inner search
    limits = {"bounds": bounds, "constraints": constraints}
    best = dp.minimize(loss, np.array(start), "augmented_lagrangian", penalty=100.0, **limits)
    assert best.converged and best.evaluations < 60


def test_multipliers_of_another_run():
    target = np.array([3.0, 2.0, 1.0])
    constraints = {
        "cells": lambda x: x - 1.5,
        "sum": [dp.equal(lambda x: anp.sum(x) - 2.0)],
        "two": NonlinearConstraint(lambda x: x[:2] * np.array([1.0, -1.0]), [0.0, -0.6], [1.4, -0.5]),
    }

    def run(method, start, **options):
        return dp.minimize(lambda x: anp.sum((x - target) ** 2), start, method, constraints=constraints, **options)

    best = run("slsqp", np.ones(3))
    assert np.allclose(best.x, [1.4, 0.6, 0.0]) and np.allclose(best.multipliers["two"], [1.2, -0.8])
    again = run("augmented_lagrangian", best.x, multipliers=best.multipliers)
    assert again.converged and again.history[0].optimality < 1e-6 and len(again.history) < 4
    for one, other in zip(dp.flatten(again.multipliers)[0], dp.flatten(best.multipliers)[0], strict=True):
        assert one == pytest.approx(other, abs=1e-6)


def test_dependent_constraints_have_multipliers_too():
    """The constraints are the same up to a factor; the sum of their multipliers is determined."""
    constraints = [lambda x: anp.sum(x) - 1.0, lambda x: 2 * anp.sum(x) - 2.0]
    best = dp.minimize(lambda x: anp.sum((x - 2.0) ** 2), np.zeros(2), "slsqp", constraints=constraints)
    first, second = best.multipliers
    assert best.converged and min(first, second) >= 0 and np.isclose(first + 2 * second, 3.0)


@pytest.mark.parametrize(
    ("method", "reason"),
    [
        ("slsqp", r"More equality constraints than independent variables\); for equalities that depend on each other"),
        ("trust_constr", r"there are more equalities \(2\) than unknowns \(1\)"),
    ],
)
def test_dependent_equalities_name_the_method_that_takes_them(method, reason):
    constraints = dp.equal(lambda x: np.array([1.0, 2.0]) * (x - 1.0))
    best = dp.minimize(lambda x: (x - 3.0) ** 2, 0.0, method, constraints=constraints)
    assert not best.converged and re.search(f"{reason}.* write method='augmented_lagrangian'", best.message)
    assert dp.minimize(lambda x: (x - 3.0) ** 2, 0.0, "augmented_lagrangian", constraints=constraints).converged


def test_a_table_and_a_page_show_the_violation():
    best = dp.minimize(lambda x: anp.sum(x**2), np.ones(2), "slsqp", constraints=lambda x: 1.0 - x[0], maxiter=1)
    assert "feasibility  optimality" in str(best) and "optimality" in best._repr_html_()
    assert best.history[-1].summary().startswith("loss 1, feasibility ")
