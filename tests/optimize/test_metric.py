"""The argument metric of minimize: search directions in the inner product of the unknowns."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse.linalg import LinearOperator, cg

import sparsedp as dp
from sparsedp.autodiff.flattening import Packing
from sparsedp.optimize.metric import Metric
from sparsedp.optimize.newton_cg import truncated_cg

METHODS = "lbfgs", "gd", "newton_cg"
MOSTLY_WHOLE = ["lbfgs", *(pytest.param(method, marks=pytest.mark.whole) for method in ("gd", "newton_cg"))]
GRID = dp.Grid(9, size=1.0)
SMOOTH = dp.identity(GRID.cells) - 0.02 * dp.laplacian(GRID)
DENSE = SMOOTH.to_scipy() @ np.eye(9)
TARGET = np.cos(np.arange(9.0) ** 2)


def valley(x):
    return anp.sum((x[1:] - x[:-1] ** 2) ** 2) + 0.5 * anp.sum((x - TARGET) ** 2)


@pytest.mark.parametrize("method", METHODS)
def test_a_metric_is_a_change_of_variables(method):
    """With M = L L^T, the run in the metric is the Euclidean one for z = L^T x."""
    lower = cholesky(DENSE, lower=True)
    start = np.sin(np.arange(9.0))
    points = []
    plain_points = []
    best = dp.minimize(
        valley, start, method, 8, 0.0, lambda record, x: points.append((record.gradient_norm, x)), metric=SMOOTH
    )
    inverse = solve_triangular(lower.T, np.eye(9))
    dp.minimize(
        lambda z: valley(inverse @ z),
        lower.T @ start,
        method,
        8,
        0.0,
        lambda record, z: plain_points.append((record.gradient_norm, inverse @ z)),
    )
    assert len(points) == len(plain_points) >= 5
    for (gradient_norm, x), (plain_norm, plain_x) in zip(points, plain_points):
        assert np.allclose(x, plain_x, rtol=1e-5, atol=1e-6) and gradient_norm == pytest.approx(plain_norm, rel=1e-4)
    gradient = dp.grad(valley)(best.x)
    assert best.history[-1].gradient_norm == pytest.approx(np.sqrt(gradient @ np.linalg.solve(DENSE, gradient)))


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_the_inner_iteration_is_the_preconditioned_one_of_scipy(rng, steps):
    hessian = rng.standard_normal((9, 9))
    hessian = hessian @ hessian.T + np.eye(9)
    metric = Metric(SMOOTH, Packing(TARGET))
    inverse = LinearOperator((9, 9), lambda r: np.linalg.solve(DENSE, r))
    expected, _ = cg(hessian, -TARGET, rtol=0.0, maxiter=steps, M=inverse)
    step, decrease, on_boundary = truncated_cg(TARGET, lambda p: hessian @ p, np.inf, 0.0, steps, metric)
    assert np.allclose(step, expected) and not on_boundary
    assert decrease == pytest.approx(-(TARGET @ step + 0.5 * step @ hessian @ step))
    radius = 0.5 * np.sqrt(expected @ DENSE @ expected)
    step, _, on_boundary = truncated_cg(TARGET, lambda p: hessian @ p, radius, 0.0, steps, metric)
    assert on_boundary and np.sqrt(step @ DENSE @ step) == pytest.approx(radius)


def test_descent_with_a_rate_is_the_written_out_iteration():
    x = np.sin(np.arange(9.0))
    best = dp.minimize(valley, x, "gd", 5, rate=0.1, metric=SMOOTH)
    for _ in range(5):
        x = x - 0.1 * np.linalg.solve(DENSE, dp.grad(valley)(x))
    assert np.allclose(best.x, x)


def control(n):
    """Return the loss, the start and the metric of a source in H1 that gives a wanted temperature, on n x n cells."""
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    wanted = x * (1 - x**2) * y**2 * (1 - y)
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet))
    metric = n**-2.0 * (dp.identity(grid.cells) - dp.laplacian(grid))
    loss = lambda u: 0.5 * anp.sum((solve(u) - wanted) ** 2) / n**2 + 5e-5 * anp.sum(u * metric(u))
    return loss, np.zeros((n, n)), metric


LONG = [pytest.param(method, 24, marks=pytest.mark.whole) for method in METHODS]


@pytest.mark.parametrize("method, n", [("newton_cg", 12), *LONG])
def test_iterations_do_not_grow_with_the_grid(method, n):
    counts = {}
    for cells in (6, n):
        loss, start, metric = control(cells)
        for name, chosen in (("plain", None), ("in metric", metric)):
            best = dp.minimize(loss, start, method, 90, 1e-6, metric=chosen)
            counts[name, cells] = best.history[-1].iteration, best.evaluations, best.history[-1].solves
            assert best.converged or (name == "plain" and method != "newton_cg")
    work = 2 if method == "newton_cg" else 0  # the outer iterations of Newton's method hardly grow
    in_metric = counts["in metric", n][work]
    assert abs(in_metric - counts["in metric", 6][work]) <= max(3, 0.1 * in_metric)
    assert counts["plain", n][work] >= 1.4 * in_metric


@pytest.mark.parametrize("method", METHODS)
def test_the_scale_of_the_metric_does_not_matter(method):
    def saddle(x):
        return anp.sum(anp.sin(x)) + 0.1 * anp.sum(x**4)

    for start in (0.1 * TARGET, np.zeros(9)):
        one, two = (dp.minimize(saddle, start, method, 6, metric=c * SMOOTH) for c in (1.0, 1e12))
        assert np.allclose(one.x, two.x, rtol=1e-6, atol=1e-9)
        assert one.history[-1].gradient_norm == pytest.approx(1e6 * two.history[-1].gradient_norm, rel=1e-3)
    huge = dp.minimize(saddle, 0.1 * TARGET, method, 6, metric=2.0**600 * SMOOTH)
    assert np.allclose(huge.x, dp.minimize(saddle, 0.1 * TARGET, method, 6, metric=SMOOTH).x, rtol=1e-6)


def test_a_metric_that_is_nearly_singular():
    """The condition number is 1e13, and step and gradient have the same mean."""
    metric = dp.identity(GRID.cells) - 2e10 * dp.laplacian(GRID)
    best = dp.minimize(lambda x: anp.sum((x - TARGET) ** 2), np.zeros(9), "gd", 1, rate=0.5, metric=metric)
    assert np.allclose(best.x, np.mean(TARGET), rtol=1e-3)


@pytest.mark.parametrize("method", MOSTLY_WHOLE)
def test_the_identity_is_no_metric(method):
    plain, identity = (dp.minimize(valley, TARGET, method, 5, metric=m) for m in (None, dp.identity(GRID.cells)))
    assert np.allclose(plain.x, identity.x, rtol=1e-12)
    assert [r.evaluations for r in plain.history] == [r.evaluations for r in identity.history]


@pytest.mark.parametrize("method", MOSTLY_WHOLE[:2])
def test_trees_batches_and_complex_unknowns(method):
    start = {"u": np.zeros((2, 9), np.float32), "k": 0.5, "n": 3, "z": np.zeros(9, complex)}

    def loss(p):
        return (
            valley(p["u"][0])
            + valley(p["u"][1])
            + (p["k"] - 2.0) ** 2
            + anp.sum(anp.abs(p["z"] - 1 - TARGET * 1j) ** 2)
        )

    best = dp.minimize(loss, start, method, metric={"u": SMOOTH, "k": None, "n": None, "z": SMOOTH}, tolerance=1e-4)
    assert best.converged and best.x["u"].dtype == np.float32 and best.x["n"] == 3
    assert np.allclose(best.x["u"][0], dp.minimize(valley, TARGET).x, atol=1e-2)
    assert abs(best.x["k"] - 2.0) < 1e-2 and np.allclose(best.x["z"], 1 + TARGET * 1j, atol=1e-2)
    nested = {"a": (TARGET, TARGET), "b": 1.0}
    best = dp.minimize(lambda p: valley(p["a"][0]) + p["b"] ** 2, nested, method, 3, metric={"a": None, "b": None})
    plain = dp.minimize(lambda p: valley(p["a"][0]) + p["b"] ** 2, nested, method, 3)
    assert np.allclose(best.x["a"][0], plain.x["a"][0], rtol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_bounds_in_a_diagonal_metric(method):
    """The run is the Euclidean one of the scaled unknowns, whose bounds are scaled."""
    weights = 4.0 ** np.arange(-4.0, 5.0)
    roots = np.sqrt(weights)
    best = dp.minimize(valley, 0 * TARGET, method, 6, bounds=(-0.3, 0.2), metric=dp.diagonal(GRID.cells, weights))
    scaled = dp.minimize(lambda z: valley(z / roots), 0 * TARGET, method, 6, bounds=(-0.3 * roots, 0.2 * roots))
    assert np.any(best.x == 0.2) and np.any(np.abs(best.x - 0.05) < 0.2)
    assert np.allclose(best.x, scaled.x / roots, rtol=1e-6)
    assert best.history[-1].gradient_norm == pytest.approx(scaled.history[-1].gradient_norm, rel=1e-4)


@pytest.mark.parametrize("method", MOSTLY_WHOLE)
def test_a_projection_in_a_metric_that_does_not_commute_with_it(method):
    def centred(x):
        return x - anp.mean(x[:5])

    best, expected = (dp.minimize(valley, TARGET, method, 300, project=centred, metric=m) for m in (SMOOTH, None))
    assert best.converged and np.allclose(best.x, expected.x, atol=1e-6)


def test_an_inverse_as_metric_is_applied_and_not_solved():
    covariance = dp.matrix_power(SMOOTH, -1.0)
    best = dp.minimize(valley, TARGET, maxiter=8, metric=dp.inverse(covariance))
    assert np.allclose(best.x, dp.minimize(valley, TARGET, maxiter=8, metric=SMOOTH).x)
    assert best.history[-1].solves <= len(best.history)  # for norms of x; directions take products only


@pytest.mark.parametrize("method", MOSTLY_WHOLE)
def test_a_checkpoint_holds_the_metric(tmp_path, method):
    def run(folder, metric, callback=None):
        return dp.minimize(valley, TARGET, method, 6, 0.0, callback, checkpoint=tmp_path / folder, metric=metric)

    whole = run("whole", SMOOTH)
    run("parts", SMOOTH, lambda record, x: record.iteration == 3)
    resumed = run("parts", SMOOTH)
    assert resumed.resumed.startswith("resumed from iteration 3") and np.array_equal(resumed.x, whole.x)
    run("plain", None, lambda record, x: record.iteration == 3)
    message = "holds a run with another metric; call minimize as that run began, or write another checkpoint folder$"
    for folder, metric in (("parts", 2.0 * SMOOTH), ("parts", None), ("plain", SMOOTH)):
        with pytest.raises(ValueError, match=message):
            run(folder, metric)
