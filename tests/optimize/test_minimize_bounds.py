"""lbfgs with bounds: steps against dense matrices, cost against SciPy, refused trial points."""

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad
from scipy.optimize import lsq_linear, minimize, rosen_der

import sparsedp as dp
from benchmarks.bounded import PROBLEMS, compared
from sparsedp.autodiff.tape import plain
from sparsedp.errors import UnstableStepError
from sparsedp.optimize.lbfgs import quasi_newton_step


@pytest.mark.parametrize("k", [1, 2, 7])
def test_quasi_newton_step_against_the_dense_formula(rng, k):
    """Return B of the BFGS formula for steps s and changes y with s.y > 0, pair by pair."""
    root = rng.standard_normal((12, 12))
    steps = rng.standard_normal((k, 12))
    changes = steps @ (root @ root.T / 12 + 0.1 * np.eye(12)) + 0.01 * rng.standard_normal((k, 12))
    dense = np.eye(12) * (changes[-1] @ changes[-1]) / (steps[-1] @ changes[-1])
    for s, y in zip(steps, changes):
        dense = dense - np.outer(dense @ s, dense @ s) / (s @ dense @ s) + np.outer(y, y) / (s @ y)
    g = rng.standard_normal(12)
    assert np.allclose(quasi_newton_step(g, steps, changes, 1.0), -np.linalg.solve(dense, g), rtol=1e-9)


def test_quasi_newton_step_without_curvature_or_memory():
    g = np.array([3.0, -4.0])
    s = np.array([[1.0, 0.0], [0.0, 1.0]])
    assert np.array_equal(quasi_newton_step(g, s[:0], s[:0], 0.5), -g / 2)
    assert np.array_equal(quasi_newton_step(g, s, -s, 0.5), -g / 2)


@pytest.mark.parametrize("seed", range(12))
def test_starts_on_bounds_and_close_to_them(seed):
    """Quadratics of conditions up to 1e5 from starts on bounds, where a short step may be lost to rounding."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 60))
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    matrix = (basis * np.geomspace(1, 10 ** rng.uniform(0, 5), n)) @ basis.T
    linear = matrix @ rng.uniform(-2, 2, n)
    lower = -rng.uniform(0.1, 1, n)
    upper = rng.uniform(0.1, 1, n)
    near = lower + 10.0 ** -rng.uniform(1, 14, n) * (upper - lower)
    start = [lower, near, np.where(rng.random(n) < 0.5, lower + 1e-9, upper - 1e-9)][seed % 3]
    loss = lambda x: 0.5 * anp.dot(x, anp.dot(matrix, x)) - anp.dot(linear, x)
    best = dp.minimize(loss, start, bounds=(lower, upper), maxiter=3000)
    expected = minimize(
        loss,
        start,
        jac=lambda x: matrix @ x - linear,
        bounds=list(zip(lower, upper)),
        method="L-BFGS-B",
        options={"maxiter": 5000, "maxfun": 20000, "ftol": 1e-15, "gtol": 1e-10},
    )
    assert best.converged and best.value <= expected.fun + 1e-9 * abs(expected.fun)


LONG = {"deconvolution", "tomography"}


@pytest.mark.sampled(0)
@pytest.mark.parametrize(
    "problem",
    [pytest.param(one, id=one.__name__, marks=[pytest.mark.whole] * (one.__name__ in LONG)) for one in PROBLEMS],
)
def test_number_of_evaluations_against_scipy(problem):
    """At most 1.5 times as many as SciPy needs to reach its final loss."""
    best, ours, scipys = compared(problem)
    lower, upper = (
        np.inf * sign if side is None else side for side, sign in zip(problem(np.random.default_rng(0))[2], (-1, 1))
    )
    assert np.all((lower <= best.x) & (best.x <= upper))
    assert ours <= 1.5 * scipys


def valley(x):
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def test_bounds_at_all_scales(rng):
    start = rng.uniform(-1, 0.4, 20)
    upper = np.where(np.arange(20) % 3, 2.0, 0.5)
    plain_run = dp.minimize(valley, start, bounds=(-1.5, upper))
    for height, length in ((2.0**600, 1.0), (2.0**-600, 1.0), (1.0, 2.0**400), (2.0**-300, 2.0**-300)):
        scaled = dp.minimize(
            lambda x, height=height, length=length: height * valley(x / length),
            length * start,
            bounds=(-1.5 * length, upper * length),
        )
        assert np.array_equal(scaled.x / length, plain_run.x) and plain_run.converged


def test_refused_trial_points_with_bounds(rng):
    """Refused points on one side and bounds on the other: both shorten the steps."""

    def walled(x):
        if np.max(plain(x)) > 0.95:
            raise UnstableStepError("beyond 0.95")
        return valley(x)

    upper = np.where(np.arange(8) % 4, 2.0, 0.9)
    best = dp.minimize(walled, np.zeros(8), bounds=(-0.5, upper), maxiter=300)
    expected = minimize(valley, np.zeros(8), jac=rosen_der, bounds=[(-0.5, min(b, 0.95)) for b in upper], tol=1e-15)
    assert best.value == pytest.approx(expected.fun, rel=1e-3)
    assert any(record.failed for record in best.history)


def test_equal_bounds_and_corners():
    best = dp.minimize(valley, np.zeros(4), bounds=(np.array([-1.0, 0.3, -1.0, -1.0]), np.array([2.0, 0.3, 2.0, 2.0])))
    expected = minimize(valley, [0, 0.3, 0, 0], jac=rosen_der, bounds=[(-1, 2), (0.3, 0.3), (-1, 2), (-1, 2)])
    assert best.x[1] == 0.3 and best.value == pytest.approx(expected.fun, rel=1e-6)
    corner = dp.minimize(lambda x: anp.sum(x), np.array([0.3, 0.9]), bounds=(0.1, 1.0))
    assert np.array_equal(corner.x, [0.1, 0.1]) and corner.converged and corner.evaluations < 5
    still = dp.minimize(valley, np.full(3, 0.5), bounds=(0.5, 0.5))
    assert np.array_equal(still.x, np.full(3, 0.5)) and still.converged and still.evaluations == 1
    single = dp.minimize(valley, np.zeros(4, np.float32), bounds=(-1.0, 0.7))
    assert single.x.dtype == np.float32 and np.all(single.x <= np.float32(0.7))


def test_a_real_bound_on_a_complex_leaf_bounds_both_parts():
    """A real array as bound acts like a real number."""
    goal = np.array([2.0 + 3.0j, -1.0 + 0.25j])
    bounds = {"z": np.zeros(2)}, {"z": np.array([1.0, 0.5])}
    best = dp.minimize(lambda x: anp.sum(anp.abs(x["z"] - goal) ** 2), {"z": np.zeros(2, complex)}, bounds=bounds)
    assert np.allclose(best.x["z"], [1.0 + 1.0j, 0.25j])
    best = dp.minimize(lambda z: anp.sum(anp.abs(z - goal) ** 2), np.zeros(2, complex), bounds=(0.0, 1.0 + 2.0j))
    assert np.allclose(best.x, [1.0 + 2.0j, 0.25j])


# ---- least squares inside bounds -----------------------------------------------------------------------------------


def bounded_problem(seed):
    """Return random residuals, bounds (some infinite, some equal) and a start inside; every third one on bounds."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 8))
    matrix = rng.normal(size=(n + 3, n)) * np.exp(rng.normal(size=n))
    data = 3 * rng.normal(size=n + 3)
    corner = rng.integers(-1, 2, n).astype(float)
    residuals = [
        lambda x: anp.dot(matrix, x) - data,
        lambda x: anp.dot(matrix[: n - 1], x) - data[: n - 1],  # more unknowns than residuals
        lambda x: anp.dot(matrix, x - corner),  # the minimum is a corner, with multipliers of 0
        lambda x: anp.concatenate([10 * (x[1:] - x[:-1] ** 2), 1 - x[:-1]]),
        lambda x: anp.concatenate([anp.dot(matrix, x) - data, 0.3 * anp.dot(x, x) * np.ones(1) - 4]),
    ][seed % 5]
    lower = rng.uniform(-1.5, 0.2, n)
    upper = lower + rng.uniform(0.1, 2.5, n)
    if seed % 5 == 2:
        lower = -np.ones(n)
        upper = np.ones(n)
    kind = rng.integers(0, 5, n)
    lower[kind == 0], upper[kind == 1] = -np.inf, np.inf
    upper[kind == 2] = lower[kind == 2]
    start = np.clip(rng.normal(size=n) * (5 if seed % 3 == 0 else 1), lower, upper)
    return residuals, lower, upper, start


def projected_gradient(residuals, x, lower, upper):
    slope = grad(lambda x: 0.5 * anp.sum(residuals(x) ** 2))(x)
    return np.linalg.norm(x - np.clip(x - slope, lower, upper))


METHODS = [
    ("gauss_newton", {}),
    ("gauss_newton", {"dense": False}),
    ("levenberg_marquardt", {}),
    ("levenberg_marquardt", {"dense": False}),
    ("lbfgs", {}),
    ("newton_cg", {}),
    ("gd", {}),
    ("adam", {"rate": 0.02}),
]


@pytest.mark.whole
@pytest.mark.parametrize("method, options", METHODS)
def test_random_bounded_problems_against_scipy(method, options):
    squares = method in ("gauss_newton", "levenberg_marquardt")
    first_order = method in ("gd", "adam")
    for seed in range(3 if first_order else 10):
        residuals, lower, upper, start = bounded_problem(seed)
        half_square = lambda x, r=residuals: 0.5 * anp.sum(r(x) ** 2)
        best = dp.minimize(
            residuals if squares else half_square,
            start,
            method,
            bounds=(lower, upper),
            maxiter=400 if first_order else 200,
            **options,
        )
        expected = minimize(
            half_square,
            start,
            jac=grad(half_square),
            bounds=np.c_[lower, upper],
            method="L-BFGS-B",
            options={"maxiter": 2000, "ftol": 1e-15, "gtol": 1e-9},
        )
        assert np.all((lower <= best.x) & (best.x <= upper))
        size = max(projected_gradient(residuals, start, lower, upper), 1e-3)
        if best.converged:
            assert projected_gradient(residuals, best.x, lower, upper) <= 1e-5 * size
            assert best.value <= expected.fun * (1 + 1e-5) + 1e-8
        assert best.converged or first_order


def test_gauss_newton_with_large_residuals_is_damped(rng):
    """Undamped steps are accepted at 2^-7 of their length only: 300 iterations do not reach the minimum."""
    residuals = lambda x: anp.concatenate([10 * (x[1:] - x[:-1] ** 2), 1 - x[:-1]])
    lower = np.array([-1.4, -1.4659497, -0.07, -0.5, -1.1])
    upper = np.array([0.45, -1.4659497, 0.98, np.inf, np.inf])
    start = np.array([-0.36, -1.4659497, 0.03, -0.5, 0.6])
    best = dp.minimize(residuals, start, "gauss_newton", bounds=(lower, upper), maxiter=300)
    expected = dp.minimize(lambda x: 0.5 * anp.sum(residuals(x) ** 2), start, bounds=(lower, upper))
    assert best.converged and best.evaluations < 400
    assert np.allclose(best.x, expected.x, atol=1e-5)


def test_a_linear_problem_in_a_box_takes_one_step(rng):
    """The step is the minimum inside the bounds: exact for linear residuals."""
    for _ in range(20):
        matrix = rng.normal(size=(30, 20))
        data = 5 * rng.normal(size=30)
        best = dp.minimize(lambda x, a=matrix, d=data: a @ x - d, np.zeros(20), "gauss_newton", bounds=(-0.3, 0.4))
        expected = lsq_linear(matrix, data, bounds=(-0.3, 0.4), tol=1e-14)
        assert best.converged and len(best.history) <= 3 and np.allclose(best.x, expected.x, atol=1e-8)
