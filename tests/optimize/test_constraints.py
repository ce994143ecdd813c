"""Bounds and projections of minimize."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import Bounds, least_squares, lsq_linear, minimize

import sparsedp as dp


def valley(x):
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


# ---- bounds --------------------------------------------------------------------------------------------------------

METHODS = ["lbfgs", "gd", "newton_cg"]


@pytest.mark.parametrize("method", METHODS)
def test_bounds_against_scipy(rng, method):
    matrix = rng.standard_normal((10, 10))
    matrix = matrix @ matrix.T + 2 * np.eye(10)
    data = 3 * rng.standard_normal(10)
    loss = lambda x: 0.5 * anp.sum(x * (matrix @ x)) - anp.sum(data * x)
    best = dp.minimize(loss, np.full(10, 0.1), method, bounds=(0.0, 0.3), maxiter=3000, tolerance=1e-9)
    expected = minimize(loss, np.full(10, 0.1), jac=lambda x: matrix @ x - data, bounds=[(0, 0.3)] * 10, tol=1e-14)
    assert np.all(best.x >= 0) and np.all(best.x <= 0.3)
    assert np.allclose(best.x, expected.x, atol=1e-5)


@pytest.mark.parametrize("method", ["levenberg_marquardt", "gauss_newton"])
@pytest.mark.parametrize("options", [{}, {"dense": False}, {"apart": True}])
def test_bounded_least_squares_against_scipy(rng, method, options):
    """A step computed without the bounds may be no descent for the free unknowns; that is not convergence."""
    matrix = rng.standard_normal((12, 8))
    data = 3 * rng.standard_normal(12)
    misses = lambda x: anp.sum(matrix * x, axis=-1) - data  # of copies of x too
    best = dp.minimize(misses, np.zeros(8), method, bounds=(-0.3, 0.4), **options)
    expected = lsq_linear(matrix, data, bounds=(-0.3, 0.4), tol=1e-14)
    assert best.converged and np.allclose(best.x, expected.x, atol=1e-7)
    options = {name: value for name, value in options.items() if name != "apart"}
    bent = lambda x: anp.concatenate([10 * (x[1:] - x[:-1] ** 2), 1 - x[:-1]])
    start = np.array([-0.5, 0.3, -0.5, 0.4])
    best = dp.minimize(bent, start, method, bounds=(-1.0, 0.5), **options)
    expected = least_squares(bent, start, bounds=(-1.0, 0.5), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert best.converged and best.value == pytest.approx(expected.cost, rel=1e-9)


def test_half_inverse_keeps_entries_at_active_bounds():
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


def distance_from_far(x):
    """Return a loss whose minimum in a box is the corner of the upper bounds."""
    return sum(anp.sum((leaf - 9.0) ** 2) for leaf in x)


PAIRS_OR_SIDES = [
    ([0.5, 2.5], ((0, 1), (2, 3))),
    ((0.5, 2.5), [(0, 1), (2, 3)]),
    ([0.5, 2.5], ((0, 1), (0, 1))),  # read as (lower, upper), both unknowns would be fixed
    ([0.5, 2.5], ((0, None), (1, None))),
    ((np.ones(3), 2.5), ((0, 1), (2, 3))),
    ((np.ones(2), np.ones(2)), ((np.zeros(2), 2 * np.ones(2)), (np.ones(2), 3 * np.ones(2)))),
    (((0.5, 0.6), (0.7, 0.8)), (((0, 1), (0, 2)), ((1, 3), (1, 4)))),
    (np.array([0.5, 2.5]), ((0, 1), (2, 3))),
]


@pytest.mark.parametrize("start, bounds", PAIRS_OR_SIDES)
def test_two_pairs_that_may_be_sides_are_refused(start, bounds):
    with pytest.raises(ValueError, match="bounds is ambiguous: .* may be two pairs"):
        dp.minimize(lambda x: 1 / 0, start, bounds=bounds)


@pytest.mark.parametrize("start", [[0.5, 2.5], (0.5, 2.5), np.array([0.5, 2.5])])
def test_both_readings_of_two_pairs_can_be_written_with_arrays(start):
    bounds = (0, 1), (2, 3)
    for written, corner in (
        (tuple(map(np.array, zip(*bounds))), [1.0, 3.0]),
        (tuple(map(np.array, bounds)), [2.0, 3.0]),
        (Bounds([0, 2], [1, 3]), [1.0, 3.0]),
        (Bounds(0, 4), [4.0, 4.0]),
    ):
        best = dp.minimize(distance_from_far, start, bounds=written)
        assert type(best.x) is type(start) and np.array_equal(best.x, corner)


@pytest.mark.parametrize(
    "bounds, corner",
    [
        (((0, -5), (10, 5)), [9.0, 5.0]),  # 0 <= -5 is false: no pairs
        (((0, 1), (1, 3)), [1.0, 3.0]),  # the same box in both readings
        (((0, 0), (1, 1)), [1.0, 1.0]),  # as pairs, both unknowns would be fixed
        ((None, (1, 3)), [1.0, 3.0]),
        (((0, 1), 3), [3.0, 3.0]),
    ],
)
def test_two_sides_that_cannot_be_pairs_are_accepted(bounds, corner):
    assert dp.minimize(distance_from_far, [0.5, 2.5], bounds=bounds).x == pytest.approx(corner)


def test_pairs_that_cannot_be_sides_are_refused():
    for start in ([0.5, 2.5], np.array([0.5, 2.5])):
        with pytest.raises(ValueError, match="bounds must be .lower, upper., got one pair for each entry of start"):
            dp.minimize(lambda x: 1 / 0, start, bounds=((3, 4), (0, 1)))


def test_bounds_ignore_leaves_that_are_not_floating():
    """A static leaf may be too large for an array of bounds."""
    huge = np.broadcast_to(1, (10**7, 10**7))
    loss = lambda tree: anp.sum((tree["x"] - 2.0) ** 2)
    for bounds in ((None, 1.0), (None, {"A": None, "x": 1.0, "word": None})):
        best = dp.minimize(loss, {"A": huge, "x": np.zeros(2), "word": "a"}, bounds=bounds)
        assert np.allclose(best.x["x"], 1, rtol=1e-14) and best.x["A"] is huge


def test_a_start_outside_the_bounds_is_moved_inside():
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
def test_maps_other_than_affine_projections_are_refused(kind, method):
    """The derivative of a clip is 0 beyond its limits: a run would stop there as converged."""
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
    """The user's gradient is evaluated at project(x), and projected."""
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
