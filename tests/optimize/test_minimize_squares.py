"""Least squares: number of products for the Jacobian, and the covariance of the unknowns."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import curve_fit, least_squares

import sparsedp as dp

METHODS = ["levenberg_marquardt", "gauss_newton"]


class Counted:
    """exp that counts its derivatives in forward and in reverse mode."""

    def __init__(self, jvp=True):
        self.forward = self.reverse = 0
        forward = self.along if jvp else None
        self.rule = dp.differentiable("counted", np.exp, lambda nums, ans, x: self.back(ans), jvp=forward)

    def along(self, nums, tangents, ans, x):
        self.forward += 1
        return tangents[0] * ans

    def back(self, ans):
        def pull(g):
            self.reverse += 1
            return (g * ans,)

        return pull


TIMES = np.linspace(0, 2, 30)


@pytest.mark.parametrize("method", METHODS)
def test_jacobian_by_columns_for_few_unknowns_and_by_rows_for_few_residuals(rng, method):
    tall = Counted()
    data = 3 * np.exp(-1.3 * TIMES) + 0.1 * rng.standard_normal(30)
    best = dp.minimize(lambda x: x[0] * tall.rule(-x[1] * TIMES) - data, np.ones(2), method)
    assert best.converged and tall.reverse <= 1  # the gradient at the start, before the shape is known
    assert tall.forward <= 2 * len(best.history)  # the covariance takes the last Jacobian
    wide = Counted()
    matrix = rng.standard_normal((3, 20))
    best = dp.minimize(lambda x: anp.dot(matrix, wide.rule(x)) - 1.0, np.zeros(20), method)
    assert best.value < 1e-12 and wide.forward == 0 and wide.reverse >= 3 * (len(best.history) - 1)


@pytest.mark.parametrize("method", METHODS)
def test_a_rule_without_a_forward_derivative(rng, method):
    data = 3 * np.exp(-1.3 * TIMES) + 0.1 * rng.standard_normal(30)
    fit = lambda rule: dp.minimize(lambda x: x[0] * rule(-x[1] * TIMES) - data, np.ones(2), method)
    with_it = fit(Counted().rule)
    without = fit(Counted(jvp=False).rule)
    assert np.allclose(with_it.x, without.x, rtol=1e-9) and np.allclose(with_it.covariance, without.covariance)


@pytest.mark.slow
def test_lotka_volterra(rng):
    """Three rates from 42 noisy numbers, against SciPy; 200 steps of rk4 for each evaluation."""

    def rate(u, p):
        return anp.array([p[0] * u[0] - p[1] * u[0] * u[1], p[1] * u[0] * u[1] - p[2] * u[1]])

    step = dp.stepper("rk4", rate, 0.1)
    path = lambda p: dp.rollout(step, np.array([1.0, 0.5]), p, 200, keep="all")[::10].ravel()
    data = path(np.array([1.0, 0.8, 0.6])) + 0.02 * rng.standard_normal(42)
    start = np.array([0.9, 0.9, 0.7])
    passes = []
    best = dp.minimize(lambda p: passes.append(p) or path(p) - data, start, "levenberg_marquardt")
    expected, spread = curve_fit(lambda _, *p: path(np.array(p)), np.arange(42.0), data, start, xtol=1e-12, ftol=1e-12)
    assert best.converged and np.allclose(best.x, expected, rtol=1e-6)
    assert np.allclose(best.covariance, spread, rtol=1e-4)
    assert len(best.history) < 10  # each takes its residuals and three forward products, and not 42 in reverse
    assert len(passes) <= 2 + best.evaluations + 3 * len(best.history)


def test_rejected_points_need_no_jacobian():
    rule = Counted()
    loss = lambda x: rule.rule(x * TIMES) - np.exp(TIMES)
    best = dp.minimize(loss, np.array([-2.0]), "levenberg_marquardt")  # the first steps are far too long
    assert best.converged and np.allclose(best.x, 1)
    assert best.evaluations > len(best.history) >= rule.forward - 1


# ---- the covariance ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1.0, 1e-9])
def test_covariance_against_the_formula_and_curve_fit(rng, method, scale):
    sizes = np.array([1.0, scale, 1.0 / scale])
    model = lambda t, a, b, c: a / sizes[0] * np.exp(-b / sizes[1] * t) + c / sizes[2]
    data = model(TIMES, *(np.array([3.0, 1.3, 0.5]) * sizes)) + 0.1 * rng.standard_normal(30)
    loss = lambda x: x["a"] / sizes[0] * anp.exp(-x["b"][0] / sizes[1] * TIMES) + x["b"][1] / sizes[2] - data
    start = {"a": 2.5, "n": 7, "b": np.array([1.0, 0.4]) * sizes[1:]}
    best = dp.minimize(loss, start, method, maxiter=300, tolerance=1e-10)
    a, (b, _) = best.x["a"], best.x["b"]
    jacobian = np.stack([np.exp(-b / sizes[1] * TIMES), -a * TIMES * np.exp(-b / sizes[1] * TIMES), np.ones(30)], 1)
    by_hand = np.linalg.inv(jacobian.T @ jacobian) * 2 * best.value / 27 * np.outer(sizes, sizes)
    assert np.allclose(best.covariance, by_hand, rtol=1e-9, atol=0)
    if scale == 1:
        expected = curve_fit(model, TIMES, data, [2.5, 1.0, 0.4], xtol=1e-12, ftol=1e-12)[1]
        assert np.allclose(best.covariance, expected, rtol=1e-4)


def test_covariance_where_it_is_not_known(rng):
    data = rng.standard_normal(10)
    matrix = rng.standard_normal((10, 3))
    run = lambda columns, loss=None, **options: dp.minimize(
        loss or (lambda x: anp.dot(columns, x) - data), np.zeros(columns.shape[1]), "levenberg_marquardt", **options
    )
    assert np.all(np.isinf(run(matrix[:, [0, 1, 1]]).covariance))
    assert np.all(np.isinf(run(matrix * [1.0, 1.0, 0.0]).covariance))
    square = rng.standard_normal((10, 10))
    many = lambda x: anp.sum(x) * np.ones(5001) - 1.0
    unknown = [
        (run(square), "10 residuals of 10 unknowns do not determine their variance.* absolute_sigma=True"),
        (
            run(matrix, dense=False),
            r"the Jacobian is not formed \(dense=False.*dp.vjp\(residuals, x\).*cg.*dense=True forms it",
        ),
        (run(np.zeros((1, 5000)), many, maxiter=0), "there are 5000 unknowns, and it is formed for up to 4000"),
        (dp.minimize(lambda x: anp.sum(x**2), np.ones(2)), "return the residuals"),
        (dp.minimize(lambda x, _: x, np.ones(2), "half_inverse", batches=[0], maxiter=1), "without batches"),
    ]
    for best, reason in unknown:
        with pytest.raises(ValueError, match=f"the covariance is not known: .*{reason}"):
            best.covariance
    exact = run(square, absolute_sigma=True).covariance
    assert np.allclose(exact, np.linalg.inv(square.T @ square), rtol=1e-6)
    assert np.all(np.isinf(run(square[:3], lambda x: square[:3] @ x - 1.0, absolute_sigma=True).covariance))
    expected = run(matrix).covariance
    assert np.allclose(
        expected,
        np.linalg.inv(matrix.T @ matrix) * least_squares(lambda x: matrix @ x - data, np.zeros(3)).cost * 2 / 7,
    )
    copies = lambda x: anp.sum(matrix * x, axis=-1) - data
    assert np.allclose(run(matrix, copies, apart=True).covariance, expected)


@pytest.mark.parametrize("method", [*METHODS, "half_inverse"])
def test_absolute_sigma_against_curve_fit(rng, method):
    """Residuals divided by known standard deviations: the posterior covariance of a linear model is exact."""
    matrix = rng.standard_normal((20, 3))
    sigma = rng.uniform(0.5, 2.0, 20)
    data = matrix @ np.array([1.0, -2.0, 0.5]) + sigma * rng.standard_normal(20)
    weighted = matrix / sigma[:, None]
    run = lambda **options: dp.minimize(lambda x: anp.dot(weighted, x) - data / sigma, np.zeros(3), method, **options)
    model = lambda _, *x: matrix @ np.array(x)
    expected = curve_fit(model, np.arange(20), data, np.zeros(3), sigma, absolute_sigma=True)[1]
    found = run(absolute_sigma=True).covariance
    assert np.allclose(found, expected, rtol=1e-5)
    assert np.allclose(found, np.linalg.inv(weighted.T @ weighted), rtol=1e-9)
    if method != "half_inverse":  # it ends short of the minimum
        expected = curve_fit(model, np.arange(20), data, np.zeros(3), sigma, absolute_sigma=False)[1]
        assert np.allclose(run().covariance, expected, rtol=1e-5)
    with pytest.raises(ValueError, match="absolute_sigma must be one of True, False, got 1"):
        run(absolute_sigma=1)


@pytest.mark.parametrize("exponent", [-1000, -700, 500])
def test_covariance_of_residuals_of_any_magnitude(rng, exponent):
    """The covariance is independent of a factor of the residuals; with absolute_sigma it has its inverse square."""
    matrix = rng.standard_normal((10, 3))
    data = rng.standard_normal(10)
    factor = 2.0**exponent
    run = lambda factor, **options: dp.minimize(
        lambda x: factor * (anp.dot(matrix, x) - data), np.zeros(3), "levenberg_marquardt", **options
    )
    assert np.allclose(run(factor).covariance, run(1.0).covariance, rtol=1e-9)
    if exponent == 500:
        assert np.allclose(
            run(factor, absolute_sigma=True).covariance * factor * factor, np.linalg.inv(matrix.T @ matrix)
        )


@pytest.mark.parametrize("method", ["gauss_newton", "levenberg_marquardt"])
def test_steps_of_low_accuracy_take_fewer_products(method):
    """The step is computed by LSMR with this tolerance, and the search ends at the same point."""
    matrix = np.diag(np.geomspace(1.0, 30.0, 40)) + 0.01 * np.sin(np.arange(1600.0)).reshape(40, 40)
    products = []
    row = dp.from_functions(lambda v: products.append(0) or matrix @ v, lambda w: matrix.T @ w, 40, 40)
    counts = []
    for accuracy in (1e-10, 1e-2):
        products.clear()
        best = dp.minimize(lambda x: row(x) - 1.0, np.zeros(40), method, 1, dense=False, accuracy=accuracy)
        counts.append(len(products))
    assert counts[1] < 0.6 * counts[0]
    best = dp.minimize(lambda x: row(x) - 1.0, np.zeros(40), method, dense=False, accuracy=1e-2)
    assert best.converged and np.allclose(best.x, np.linalg.solve(matrix, np.ones(40)))
