"""newton_cg, bounds and projections of minimize."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear, minimize

import sparsedp as dp
from sparsedp.autodiff import tape
from sparsedp.errors import UnstableStepError


def valley(x):
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


@pytest.mark.parametrize("start", [[-1.2, 1.0], [0.5, 1.0] * 4, [0.0] * 6])
def test_newton(start):
    best = dp.minimize(valley, np.array(start), "newton_cg", maxiter=200)
    assert best.converged and np.allclose(best.x, 1, atol=1e-6)


@pytest.mark.parametrize("scale", [2.0**-600, 1e-9, 1e9, 2.0**600])
def test_newton_does_not_see_the_size_of_the_loss(scale):
    plain, scaled = (
        dp.minimize(lambda x, s=s: s * valley(x), np.array([-1.2, 1.0]), "newton_cg", maxiter=8) for s in (1.0, scale)
    )
    assert np.allclose(plain.x, scaled.x, rtol=1e-6)


def test_newton_on_a_quadratic_and_past_a_wall(rng):
    matrix = rng.standard_normal((8, 8))
    matrix = matrix @ matrix.T + np.eye(8)
    best = dp.minimize(lambda x: 0.5 * anp.sum(x * (matrix @ x)) - anp.sum(x), np.zeros(8), "newton_cg", tolerance=1e-9)
    assert np.allclose(best.x, np.linalg.solve(matrix, np.ones(8))) and len(best.history) < 12

    def walled(x):
        if abs(tape.plain(x)[0]) > 1.05:
            raise UnstableStepError("beyond")
        return valley(x)

    assert np.allclose(dp.minimize(walled, np.zeros(2), "newton_cg").x, 1, atol=1e-5)


def test_newton_leaves_a_saddle():
    best = dp.minimize(lambda x: (x[0] ** 2 - 1) ** 2 + x[1] ** 2, np.array([1e-3, 1.0]), "newton_cg")
    assert abs(best.x[0]) == pytest.approx(1) and best.value < 1e-10


# ---- bounds --------------------------------------------------------------------------------------------------------

METHODS = ["lbfgs", "gd", "newton_cg"]


@pytest.mark.parametrize("method", METHODS)
def test_bounds_against_scipy(rng, method):
    matrix = rng.standard_normal((10, 10))
    matrix = matrix @ matrix.T + 2 * np.eye(10)
    data = 3 * rng.standard_normal(10)
    loss = lambda x: 0.5 * anp.sum(x * (matrix @ x)) - anp.sum(data * x)
    best = dp.minimize(loss, np.full(10, 0.1), method, bounds=(0.0, 0.3), maxiter=3000, tolerance=1e-9)
    known = minimize(loss, np.full(10, 0.1), jac=lambda x: matrix @ x - data, bounds=[(0, 0.3)] * 10, tol=1e-14)
    assert np.all(best.x >= 0) and np.all(best.x <= 0.3)
    assert np.allclose(best.x, known.x, atol=1e-5)


@pytest.mark.parametrize("method", ["levenberg_marquardt", "gauss_newton"])
@pytest.mark.parametrize("options", [{}, {"dense": False}, {"apart": True}])
def test_bounded_least_squares_against_scipy(rng, method, options):
    """A step that counts on an unknown at its bound is no descent for the others; it must not pass for converged."""
    matrix = rng.standard_normal((12, 8))
    data = 3 * rng.standard_normal(12)
    misses = lambda x: anp.sum(matrix * x, axis=-1) - data  # of copies of x too
    best = dp.minimize(misses, np.zeros(8), method, bounds=(-0.3, 0.4), **options)
    known = lsq_linear(matrix, data, bounds=(-0.3, 0.4), tol=1e-14)
    assert best.converged and np.allclose(best.x, known.x, atol=1e-7)
    options = {name: value for name, value in options.items() if name != "apart"}
    bent = lambda x: anp.concatenate([10 * (x[1:] - x[:-1] ** 2), 1 - x[:-1]])
    start = np.array([-0.5, 0.3, -0.5, 0.4])
    best = dp.minimize(bent, start, method, bounds=(-1.0, 0.5), **options)
    known = least_squares(bent, start, bounds=(-1.0, 0.5), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert best.converged and best.value == pytest.approx(known.cost, rel=1e-9)


def test_half_inverse_leaves_what_presses_against_a_bound():
    draw = np.random.default_rng(1)
    matrix = draw.standard_normal((12, 8))
    data = 3 * draw.standard_normal(12)
    best = dp.minimize(lambda x: matrix @ x - data, np.zeros(8), "half_inverse", bounds=(-0.3, 0.4))
    assert best.converged and np.allclose(best.x, lsq_linear(matrix, data, bounds=(-0.3, 0.4), tol=1e-14).x, atol=1e-6)


def test_bounds_as_trees_and_on_one_side():
    start = {"a": np.zeros(2), "b": 5.0, "n": 3}
    best = dp.minimize(
        lambda x: anp.sum((x["a"] - 2.0) ** 2) + (x["b"] - 1.0) ** 2,
        start,
        bounds=({"a": None, "b": 4.0, "n": None}, {"a": np.array([1.0, 9.0]), "b": None, "n": None}),
    )
    assert np.allclose(best.x["a"], [1, 2]) and best.x["b"] == 4.0 and best.x["n"] == 3 and best.converged
    assert np.allclose(dp.minimize(lambda x: anp.sum(x**2), np.ones(3), "adam", bounds=(0.5, None), rate=0.1).x, 0.5)
    assert np.allclose(dp.minimize(lambda x: x - 2.0, np.zeros(3), "levenberg_marquardt", bounds=(None, 1.0)).x, 1.0)


def test_bounds_do_not_see_what_is_no_unknown():
    """A static leaf may be far too large to be filled."""
    huge = np.broadcast_to(1, (10**7, 10**7))
    loss = lambda tree: anp.sum((tree["x"] - 2.0) ** 2)
    for bounds in ((None, 1.0), (None, {"A": None, "x": 1.0, "word": None})):
        best = dp.minimize(loss, {"A": huge, "x": np.zeros(2), "word": "a"}, bounds=bounds)
        assert np.allclose(best.x["x"], 1, rtol=1e-14) and best.x["A"] is huge


def test_a_start_outside_is_moved_inside():
    best = dp.minimize(lambda x: anp.sum(x**2), np.full(3, -7.0), bounds=(1.0, 2.0), maxiter=0)
    assert np.array_equal(best.x, np.ones(3))


# ---- projections ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["lbfgs", "newton_cg"])
def test_a_projection_is_kept(method):
    mean_free = lambda x: x - anp.mean(x)
    target = np.array([1.0, 2.0, 6.0])
    best = dp.minimize(lambda x: anp.sum((x - target) ** 2), np.ones(3), method, project=mean_free)
    assert np.allclose(best.x, target - 3) and abs(np.sum(best.x)) < 1e-12


NOT_PROJECTIONS = {
    "a clip to a box": (lambda x: anp.clip(x, 0.5, 1.0), "not affine near the start"),
    "a clip from below": (lambda x: anp.maximum(x, 0.0), "not affine near the start"),
    "a sphere": (lambda x: x / anp.sqrt(anp.sum(x**2)), "not affine near the start"),
    "a wide box": (lambda x: anp.clip(x, -1e4, 1e4), "not affine near the start"),
    "no projection": (lambda x: 2 * x, r"project\(project\(x\)\) is not project\(x\)"),
}


@pytest.mark.parametrize("method", ["lbfgs", "gd", "adam", "newton_cg", "gauss_newton", "half_inverse"])
@pytest.mark.parametrize("kind", NOT_PROJECTIONS)
def test_what_is_no_projection_onto_an_affine_space_is_refused(kind, method):
    """Searches stopped at the start, where the derivative of the clip is 0, and called it converged."""
    project, reason = NOT_PROJECTIONS[kind]
    loss = (lambda x: x) if method in ("gauss_newton", "half_inverse") else lambda x: anp.sum(x**2)
    with pytest.raises(ValueError, match=f"{reason}.*Write bounds="):
        dp.minimize(loss, np.ones(2), method, project=project)


def test_a_projection_that_is_not_affine_only_near_the_result_is_refused():
    project = lambda x: anp.where(anp.abs(x - 3.0) < 0.5, 2.5 + 0 * x, x)
    with pytest.raises(ValueError, match="not affine near the result"):
        dp.minimize(lambda x: anp.sum((x - 3.0) ** 2), np.array([1.0, 1.5]), "gd", rate=0.5, project=project)


@pytest.mark.parametrize("method", ["lbfgs", "gd", "newton_cg", "gauss_newton", "levenberg_marquardt"])
def test_an_affine_projection_and_a_gradient_of_the_user(method):
    """The gradient of the user is the gradient of the loss; with project it was taken at x, and not projected."""
    target = np.array([1.0, 2.0, 6.0])
    mean_two = lambda x: x - anp.mean(x) + 2.0
    squares = method in ("gauss_newton", "levenberg_marquardt")
    loss = (lambda x: x - target) if squares else lambda x: anp.sum((x - target) ** 2)
    options = {} if squares or method == "newton_cg" else {"gradient": lambda x: 2 * (x - target)}
    best = dp.minimize(loss, np.array([5.0, 1.0, 1.0]), method, project=mean_two, **options)
    assert best.converged and np.allclose(best.x, target - 1.0, atol=1e-7)


def test_a_projection_and_bounds_are_not_taken_together():
    with pytest.raises(ValueError, match="project and bounds cannot be used together"):
        dp.minimize(lambda x: anp.sum(x**2), np.ones(2), project=lambda x: x - anp.mean(x), bounds=(0.0, 1.0))


def test_history_counts_forward_and_adjoint_solves(tmp_path):
    solve = dp.inverse(-dp.laplacian(dp.Grid((6, 5)), dp.dirichlet))
    target = np.arange(30.0).reshape(6, 5)

    def run(maxiter, **options):
        return dp.minimize(lambda b: anp.sum((solve(b) - target) ** 2), 0 * target, maxiter=maxiter, **options)

    best = run(6)
    assert [record.solves for record in best.history] == [2 * record.evaluations for record in best.history]
    assert dp.minimize(lambda x: anp.sum(x**2), np.ones(2)).history[-1].solves == 0
    run(3, checkpoint=tmp_path)
    again = run(6, checkpoint=tmp_path)
    assert again.resumed.startswith("resumed") and again.history[-1].solves == best.history[-1].solves


def test_convergence_is_drawn():
    pytest.importorskip("matplotlib")
    from sparsedp.report.plots import figure

    best = dp.minimize(lambda x: anp.sum((x - 1.0) ** 2) - 2.0, np.zeros(2), "gd", rate=0.25, maxiter=4)
    ax = dp.report.convergence(best, figure().add_subplot(), against="evaluations")
    assert [line.get_label() for line in ax.lines] == ["loss - least loss", "gradient norm"]
    assert list(ax.lines[1].get_ydata()) == [record.gradient_norm for record in best.history]
    assert ax.get_yscale() == "log" and ax.get_xlabel() == "evaluations"
    with pytest.raises(
        ValueError, match="against of convergence must be one of iteration, seconds, evaluations, solves, got 'time'"
    ):
        dp.convergence(best, against="time")
