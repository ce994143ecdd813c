"""minimize at every magnitude of the loss, the residuals and x, and near kinks: no false convergence."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

MATRIX = np.array([[2.0, 0.3, 0.0], [0.1, 1.5, 0.2], [0.0, 0.4, 1.0], [0.5, 0.5, 0.5]])
DATA = np.array([1.0, 2.0, 3.0, 4.0])
EXPONENTS = [-1000, -550, -520, 520, 1000]
SQUARES = [
    ("gauss_newton", {}),
    ("gauss_newton", {"dense": False}),
    ("levenberg_marquardt", {}),
    ("levenberg_marquardt", {"dense": False}),
]


def residuals(x):
    return anp.concatenate([anp.dot(MATRIX, x) - DATA, 0.3 * (x[1:] - x[:-1] ** 2)])


def loss(x):
    return 0.5 * anp.sum(residuals(x) ** 2)


@pytest.mark.parametrize("method, options", SQUARES)
@pytest.mark.parametrize("bounds", [None, (-1.0, 1.0)])
def test_residuals_of_any_magnitude(method, options, bounds):
    """Squares underflow below 1e-162: without scaling the gradient is 0 and the start seems converged."""
    start = np.array([0.1, 0.0, -0.2])
    unscaled = dp.minimize(residuals, start, method, bounds=bounds, **options)
    assert unscaled.converged
    for exponent in EXPONENTS:
        factor = 2.0**exponent
        best = dp.minimize(lambda x, factor=factor: factor * residuals(x), start, method, bounds=bounds, **options)
        assert best.converged and np.allclose(best.x, unscaled.x, atol=1e-7)
        assert len(best.history) == len(unscaled.history)
        with np.errstate(over="ignore"):
            assert best.value == pytest.approx(np.float64(unscaled.value) * factor * factor, rel=1e-6)


@pytest.mark.parametrize(
    "method, options", [*SQUARES, ("lbfgs", {}), ("gd", {}), ("gd", {"momentum": 0.5}), ("newton_cg", {})]
)
@pytest.mark.parametrize("bounds", [None, 1.0])
def test_unknowns_of_any_magnitude(method, options, bounds):
    """Also where quotients by the gradient, or the squared Jacobian, are beyond the range of floats."""
    misfit = residuals if "dense" in options or method in ("gauss_newton", "levenberg_marquardt") else loss

    def run(size):
        return dp.minimize(
            lambda x: misfit(x / size),
            size * np.array([0.1, 0.0, -0.2]),
            method,
            bounds=bounds and (-bounds * size, bounds * size),
            maxiter=300,
            **options,
        )

    unscaled = run(1.0)
    assert unscaled.converged
    for exponent in (-1000, -550, 700):
        best = run(2.0**exponent)
        assert best.converged and np.allclose(best.x / 2.0**exponent, unscaled.x, atol=1e-6)


@pytest.mark.parametrize("exponent", [-1000, 1000])
@pytest.mark.parametrize("method, options", [("gd", {}), ("newton_cg", {}), ("lbfgs", {}), ("adam", {"rate": 0.05})])
def test_losses_of_any_magnitude(method, options, exponent):
    factor = 2.0**exponent
    start = np.array([0.1, 0.0, -0.2])
    unscaled = dp.minimize(loss, start, method, maxiter=60, **options)
    best = dp.minimize(lambda x: factor * loss(x), start, method, maxiter=60, **options)
    assert np.allclose(best.x, unscaled.x, rtol=1e-9) and best.converged == unscaled.converged


@pytest.mark.parametrize("exponent", [-1000, -550, 550])
def test_half_inverse_far_from_the_minimum_is_not_converged(exponent):
    """Steps scale with the square root of the residuals, so that few steps do not converge at these scales."""
    with np.errstate(over="ignore"):
        best = dp.minimize(lambda x: 2.0**exponent * residuals(x), np.zeros(3), "half_inverse", maxiter=5)
    assert not best.converged


def test_half_inverse_takes_the_same_steps_beyond_the_range_of_squares():
    """The direction scales with the square root of the residuals."""
    unit = 2.0**-600
    rate = 0.25
    best = dp.minimize(residuals, np.zeros(3), "half_inverse", rate=rate, maxiter=3)
    scaled = dp.minimize(
        lambda x: unit * residuals(x), np.zeros(3), "half_inverse", rate=rate / np.sqrt(unit), maxiter=3
    )
    assert np.allclose(scaled.x, best.x, rtol=1e-12)


@pytest.mark.parametrize("bounds", [None, (-0.3, 0.5)])
@pytest.mark.parametrize("method", ["gd", "newton_cg"])
def test_stopping_at_a_kink_is_not_convergence(method, bounds, rng):
    """Steps become so short that no change of the loss is visible, far from the minimum."""
    matrix = rng.normal(size=(8, 5))
    data = rng.normal(size=8)
    matrix[0] *= 30
    kinked = lambda x: anp.sum(anp.abs(anp.dot(matrix, x) - data)) + 0.5 * anp.sum(x**2)
    best = dp.minimize(kinked, np.zeros(5), method, maxiter=500, bounds=bounds)
    assert not best.converged
    assert "changes the loss by less than its rounding, but the gradient is" in best.message


@pytest.mark.parametrize("method", ["gd", "newton_cg", "levenberg_marquardt"])
def test_a_second_run_from_the_minimum_is_converged(method):
    squares = method == "levenberg_marquardt"
    run = lambda start: dp.minimize(residuals if squares else loss, start, method, maxiter=500, tolerance=1e-10)
    again = run(run(np.zeros(3)).x)
    assert again.converged


def test_the_message_names_the_projected_gradient_where_there_are_bounds():
    corner = dp.minimize(lambda x: anp.sum(x), np.array([0.3, 0.9]), bounds=(0.1, 1.0))
    assert corner.message == "converged: the projected gradient is 0"
    assert dp.minimize(lambda x: anp.sum(x**2), np.zeros(2)).message == "converged: the gradient is 0"


def test_the_hint_of_least_squares_sums_the_residuals():
    wrong = dp.differentiable("wrong", lambda x: 1.0 * x, lambda nums, ans, x: lambda g: (-g,))
    best = dp.minimize(lambda x: wrong(x) - 2.0, np.zeros(2), "gauss_newton")
    assert not best.converged and "with loss = lambda x: np.sum(residuals(x) ** 2), dp.check" in best.message


@pytest.mark.parametrize("exponent", [-1000, -550, 550, 1000])
def test_a_tolerance_function_gets_comparable_losses(exponent):
    """Records of residuals near 1e-300 hold a loss and a gradient of 0: the function must get scaled ones."""
    rule = lambda record, first: record.gradient_norm <= 1e-6 * first.gradient_norm
    factor = 2.0**exponent
    start = np.array([0.1, 0.0, -0.2])
    with np.errstate(over="ignore"):
        best = dp.minimize(lambda x: factor * residuals(x), start, "levenberg_marquardt", tolerance=rule)
    unscaled = dp.minimize(residuals, start, "levenberg_marquardt", tolerance=rule)
    assert best.converged and len(best.history) == len(unscaled.history) > 2
    assert np.allclose(best.x, unscaled.x, rtol=1e-9)


@pytest.mark.parametrize("as_function", [False, True])
@pytest.mark.parametrize("resumed", [False, True])
def test_one_batch_with_a_small_gradient_is_not_converged(as_function, resumed, tmp_path):
    """The second batch is nearly constant: the gradients of all batches must be small."""
    weights = [1.0, 1e-12, 0.5]
    batches = (lambda number: weights[number % 3]) if as_function else weights
    target = np.array([2.0, -1.0])

    def run(maxiter, **more):
        return dp.minimize(
            lambda x, weight: weight * anp.sum((x - target) ** 2),
            np.zeros(2),
            "gd",
            rate=0.3,
            batches=batches,
            maxiter=maxiter,
            **more,
        )

    if resumed:
        assert not run(20, checkpoint=tmp_path).converged
    best = run(300, **({"checkpoint": tmp_path} if resumed else {}))
    assert best.converged and np.allclose(best.x, target, atol=1e-7)
    period = 10 if as_function else 3
    assert best.message.startswith(f"converged: the gradients of the last {period} batches are ")
    assert len(best.history) == len(run(300).history)
