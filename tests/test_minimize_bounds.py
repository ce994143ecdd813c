"""lbfgs inside bounds: its model beside dense matrices, its cost beside SciPy's, trials that are refused."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import minimize, rosen_der

import sparsedp as dp
from benchmarks.bounded import PROBLEMS, compared
from sparsedp.errors import UnstableStepError
from sparsedp.optimize.quadratic import Quadratic
from sparsedp.tape import plain


def memory(rng, n, k):
    """Steps and changes with s.y > 0, and the B that the BFGS formula makes of them, one pair after the other."""
    root = rng.standard_normal((n, n))
    bent = root @ root.T / n + 0.1 * np.eye(n)
    steps = rng.standard_normal((k, n))
    changes = steps @ bent + 0.01 * rng.standard_normal((k, n))
    assert np.all(np.sum(steps * changes, axis=1) > 0)
    dense = np.eye(n) * (changes[-1] @ changes[-1]) / (steps[-1] @ changes[-1])
    for s, y in zip(steps, changes):
        dense = dense - np.outer(dense @ s, dense @ s) / (s @ dense @ s) + np.outer(y, y) / (s @ y)
    return steps, changes, dense


@pytest.mark.parametrize("k", [1, 2, 7])
def test_a_free_step_is_that_of_the_dense_formula(rng, k):
    steps, changes, dense = memory(rng, 12, k)
    g = rng.standard_normal(12)
    step = Quadratic(steps, changes, 1.0).minimum(g, None, None, None)
    assert np.allclose(step, -np.linalg.solve(dense, g), rtol=1e-9)


def test_without_a_memory_the_step_is_steepest_descent():
    g, nothing = np.array([3.0, -4.0]), np.zeros((0, 2))
    model = Quadratic(nothing, nothing, 2.0)
    assert np.array_equal(model.minimum(g, None, None, None), -g / 2)
    room = np.array([1.0, 1.0])
    assert np.array_equal(model.minimum(g, -room, room, np.array([True, True])), [-1.0, 1.0])


@pytest.mark.parametrize("n, k", [(6, 3), (12, 7), (40, 5)])
def test_the_path_stops_at_its_first_minimum_and_the_step_is_no_worse(rng, monkeypatch, n, k):
    """By brute force; some entries at a bound, some far from it, and a few breakpoints at a time."""
    monkeypatch.setattr("sparsedp.optimize.quadratic.BLOCK", 4)
    for _ in range(40):
        steps, changes, dense = memory(rng, n, k)
        g = rng.standard_normal(n)
        lower, upper = -rng.choice([0.0, 0.02, 0.3, np.inf], n), rng.choice([0.0, 0.02, 0.3, np.inf], n)
        free = ~(((lower == 0) & (g > 0)) | ((upper == 0) & (g < 0)))
        value = lambda d: g @ d + d @ dense @ d / 2
        way = np.where(free, -g, 0.0)
        at = lambda t: np.clip(t * way, lower, upper)
        stops = np.where(way == 0, np.inf, np.where(way < 0, lower, upper) / np.where(way == 0, 1, way))
        t = Quadratic(steps, changes, 1.0)._first_minimum(way, stops)
        sooner = np.sort(np.concatenate([np.linspace(0, t, 1001), stops[stops < t]]))
        assert np.all(np.diff([value(at(s)) for s in sooner]) <= 1e-12)
        assert value(at(t * (1 + 1e-5))) >= value(at(t)) - 1e-12
        step = Quadratic(steps, changes, 1.0).minimum(g, lower, upper, free)
        assert np.all((lower <= step) & (step <= upper)) and (g @ step < 0 or not free.any())
        held = ~free | (stops <= t)
        bounds = np.where(free, np.where(way < 0, lower, upper), 0.0)  # t way may round to beside the bound it meets
        assert np.array_equal(step[held], bounds[held])
        inside = ~held & (lower < step) & (step < upper)
        if np.array_equal(inside, ~held):  # nothing was cut off: the gradient of the model is 0 there
            assert np.allclose((g + dense @ step)[inside], 0, atol=1e-8)
            assert value(step) <= value(at(t)) + 1e-12


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda problem: problem.__name__)
def test_evaluations_beside_scipy(problem):
    """At most 1.5 times what SciPy takes to the loss that it ends at."""
    best, ours, scipys = compared(problem)
    lower, upper = (
        np.inf * sign if side is None else side for side, sign in zip(problem(np.random.default_rng(0))[2], (-1, 1))
    )
    assert np.all((lower <= best.x) & (best.x <= upper))
    assert ours <= 1.5 * scipys


def valley(x):
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def test_bounds_at_all_scales(rng):
    start, upper = rng.uniform(-1, 0.4, 20), np.where(np.arange(20) % 3, 2.0, 0.5)
    plain_run = dp.minimize(valley, start, bounds=(-1.5, upper))
    for height, length in ((2.0**600, 1.0), (2.0**-600, 1.0), (1.0, 2.0**400), (2.0**-300, 2.0**-300)):
        scaled = dp.minimize(
            lambda x, height=height, length=length: height * valley(x / length),
            length * start, bounds=(-1.5 * length, upper * length),
        )  # fmt: skip
        assert np.array_equal(scaled.x / length, plain_run.x) and plain_run.converged


def test_refused_trials_beside_bounds(rng):
    """A wall on one side and bounds on the other: the search goes back from the wall and along the bounds."""

    def walled(x):
        if np.max(plain(x)) > 0.95:
            raise UnstableStepError("beyond 0.95")
        return valley(x)

    upper = np.where(np.arange(8) % 4, 2.0, 0.9)
    best = dp.minimize(walled, np.zeros(8), bounds=(-0.5, upper), maxiter=300)
    known = minimize(valley, np.zeros(8), jac=rosen_der, bounds=[(-0.5, min(b, 0.95)) for b in upper], tol=1e-15)
    assert best.value == pytest.approx(known.fun, rel=1e-3)
    assert any(record.failed for record in best.history)


def test_fixed_entries_corners_and_no_room():
    best = dp.minimize(valley, np.zeros(4), bounds=(np.array([-1.0, 0.3, -1.0, -1.0]), np.array([2.0, 0.3, 2.0, 2.0])))
    known = minimize(valley, [0, 0.3, 0, 0], jac=rosen_der, bounds=[(-1, 2), (0.3, 0.3), (-1, 2), (-1, 2)])
    assert best.x[1] == 0.3 and best.value == pytest.approx(known.fun, rel=1e-6)
    corner = dp.minimize(lambda x: anp.sum(x), np.array([0.3, 0.9]), bounds=(0.1, 1.0))
    assert np.array_equal(corner.x, [0.1, 0.1]) and corner.converged and corner.evaluations < 5
    still = dp.minimize(valley, np.full(3, 0.5), bounds=(0.5, 0.5))
    assert np.array_equal(still.x, np.full(3, 0.5)) and still.converged and still.evaluations == 1
    single = dp.minimize(valley, np.zeros(4, np.float32), bounds=(-1.0, 0.7))
    assert single.x.dtype == np.float32 and np.all(single.x <= np.float32(0.7))
