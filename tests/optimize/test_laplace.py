"""The posterior of laplace: beside dense linear algebra, for all kinds of priors and unknowns, and its intervals."""

import pickle
from fractions import Fraction
from operator import mul

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.linalg
from scipy.stats import binom

import sparsedp as dp
from sparsedp.optimize import laplace, prior_covariance

GRID = dp.Grid((6, 5), size=1.0)
HEAT = 20.0 * dp.identity(GRID.cells) - dp.laplacian(GRID)
MATERN = 500.0 * dp.matrix_power(HEAT, -2)
N = 30


def dense(op):
    """The matrix of an operator, column by column."""
    return np.array([op(unit.reshape(op.domain.shape)).reshape(-1) for unit in np.eye(op.domain.size)]).T


def linear_problem(rng, prior, count=20, noise=0.5):
    """A random linear problem with its exact posterior: rows, data, residuals, mean, covariance."""
    n = len(prior)
    rows = rng.standard_normal((count, n)) / noise
    data = rows @ scipy.linalg.cholesky(prior, lower=True) @ rng.standard_normal(n) + rng.standard_normal(count)
    gain = np.linalg.solve(rows @ prior @ rows.T + np.eye(count), rows @ prior)
    covariance = prior - prior @ rows.T @ gain
    mean = gain.T @ data
    return rows, lambda x: anp.dot(rows, anp.reshape(x, -1)) - data, mean, covariance


def divergence(mean, covariance, prior):
    """Kullback-Leibler divergence of N(mean, covariance) from N(0, prior)."""
    ratio = np.linalg.solve(prior, covariance)
    return 0.5 * (np.trace(ratio) - len(mean) - np.linalg.slogdet(ratio)[1] + mean @ np.linalg.solve(prior, mean))


def check_against(posterior, covariance, rng, rtol=1e-9, above=None):
    """Compare variances, the deviation of a quantity, products and the information gain with a covariance."""
    exact = np.diag(covariance)
    above = rtol if above is None else above
    ratio = np.ravel(posterior.variance()) / exact
    assert np.all(ratio >= 1 - rtol) and np.all(ratio <= 1 + above)
    weights = rng.standard_normal((2, len(exact)))
    deviations = posterior.std_of(lambda x: anp.dot(weights, anp.reshape(x, -1)))
    wanted = np.sqrt(np.diag(weights @ covariance @ weights.T))
    assert np.all(deviations >= wanted * (1 - rtol)) and np.all(deviations <= wanted * (1 + above))
    product = np.ravel(posterior.covariance(weights[0].reshape(posterior.covariance.domain.shape)))
    assert np.linalg.norm(product - covariance @ weights[0]) <= above * np.linalg.norm(covariance) * np.sqrt(len(exact))


def test_linear_problem_with_few_residuals(rng):
    """The posterior of a linear problem is exact, and x + step is its mean from anywhere."""
    prior = dense(MATERN)
    rows, residuals, mean, covariance = linear_problem(rng, prior)
    posterior = dp.laplace(residuals, mean.reshape(6, 5), MATERN)
    check_against(posterior, covariance, rng)
    exact = scipy.linalg.eigvalsh(rows @ prior @ rows.T)[::-1]
    assert posterior.eigenvalues == pytest.approx(exact, rel=1e-9)
    assert posterior.information_gain == pytest.approx(divergence(mean, covariance, prior), rel=1e-9)
    assert posterior.expected_information_gain == pytest.approx(0.5 * np.sum(np.log1p(exact)), rel=1e-9)
    assert posterior.mean_square == pytest.approx(np.mean(residuals(mean) ** 2))
    assert posterior.expected_mean_square == pytest.approx(np.mean(1 / (1 + exact)), rel=1e-9)
    assert posterior.shift < 1e-9 and posterior.products == 20 and posterior.error == 0
    assert np.all(posterior.variance_error() == 0)
    with pytest.warns(dp.errors.PosteriorWarning, match="from the mode"):
        elsewhere = dp.laplace(residuals, np.ones((6, 5)), MATERN, prior_mean=0.3)
    shifted = 0.3 + covariance @ rows.T @ -residuals(np.full(30, 0.3))
    assert np.ravel(elsewhere.x + elsewhere.step) == pytest.approx(shifted, rel=1e-8)
    assert elsewhere.shift > 1


@pytest.mark.parametrize("as_loss", [False, True])
def test_products_only(rng, as_loss):
    """Many residuals, or a loss: eigenpairs from products with the Hessian, variances at most 1 % too large."""
    prior = dense(MATERN)
    rows, residuals, mean, covariance = linear_problem(rng, prior, 40, noise=20.0)
    misfit = (lambda x: 0.5 * anp.sum(residuals(x) ** 2)) if as_loss else residuals
    posterior = dp.laplace(misfit, mean, MATERN, rank=22)
    exact = scipy.linalg.eigvalsh(prior, np.linalg.inv(rows.T @ rows + 1e-13 * np.eye(N)))[::-1]
    count = np.count_nonzero(exact > 0.01)
    assert 5 <= count <= len(posterior.eigenvalues) <= 22
    assert posterior.eigenvalues[:count] == pytest.approx(exact[:count], rel=1e-6)
    check_against(posterior, covariance, rng, 1e-3, posterior.error)
    assert 0.0 < posterior.error <= 0.011
    assert posterior.information_gain == pytest.approx(divergence(mean, covariance, prior), rel=0.01)


@pytest.mark.parametrize("rank", [3, 12, 25])
def test_multiple_eigenvalues_above_the_rank(rank):
    """Variances are too large by at most the stated factor, if 40 equal eigenvalues are more than the rank."""
    weights = np.where(np.arange(150) < 40, 3.0, 0.1)
    with pytest.warns(dp.errors.PosteriorWarning, match="^eigenvalues of the misfit up to .* there are more than"):
        posterior = dp.laplace(lambda x: weights * x, np.zeros(150), 1.0, rank=rank, tolerance=1e-3)
    assert posterior.eigenvalues == pytest.approx(np.full(rank, 9.0))
    assert 9.0 * (1 - 1e-9) <= posterior.neglected <= 90.0
    ratio = posterior.variance() * (1 + weights**2)
    assert np.all(ratio >= 1 - 1e-9) and np.all(ratio <= 1 + posterior.error)


def test_long_jacobian(rng, monkeypatch):
    """With few unknowns and very many residuals, the Jacobian is not stored."""
    monkeypatch.setattr(laplace, "MOST_ENTRIES", 10)
    _, residuals, mean, covariance = linear_problem(rng, dense(MATERN), 40)
    posterior = dp.laplace(residuals, mean, MATERN)
    assert str(posterior).count("products with the Hessian") == 1
    check_against(posterior, covariance, rng, 1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_number_of_products(seed):
    """Two and a half products for each eigenpair, and those that show that none was missed."""
    weights = 10.0 * 0.8 ** (0.5 * np.arange(300))
    posterior = dp.laplace(lambda x: weights * x, np.zeros(300), 1.0, seed=seed)
    assert posterior.eigenvalues[:40] == pytest.approx(weights[:40] ** 2, rel=1e-4)
    assert 41 <= len(posterior.eigenvalues) <= 43 and posterior.products <= 2.5 * 42 + 30


def test_multiple_eigenvalues():
    """35 equal eigenvalues, more than the vectors of a block: new random vectors show those that were missed."""
    posterior = dp.laplace(lambda x: 3.0 * anp.concatenate([x[:35], 0.0 * x]), np.zeros(50), 1.0, rank=49)
    assert posterior.eigenvalues == pytest.approx(np.full(35, 9.0))
    assert posterior.variance() == pytest.approx(np.where(np.arange(50) < 35, 0.1, 1.0))


@pytest.mark.filterwarnings("ignore:eigenvalues:sparsedp.errors.PosteriorWarning")
def test_jacobian_and_products_agree(rng, monkeypatch):
    """The two ways to the eigenpairs, and a prior whose square root takes an iteration."""
    _, residuals, mean, covariance = linear_problem(rng, dense(MATERN))
    direct = dp.laplace(residuals, mean, MATERN)
    monkeypatch.setattr(prior_covariance, "MOST_COLUMNS", 1)
    functions = dp.from_functions(MATERN, MATERN, GRID.cells, GRID.cells)
    posterior = dp.laplace(residuals, mean, functions, rank=19, tolerance=1e-3)
    assert posterior.eigenvalues == pytest.approx(direct.eigenvalues[:19], rel=1e-6)
    with pytest.warns(dp.errors.PosteriorWarning, match="^variances have a standard error of .* % with probes=4; inc"):
        posterior.variance(4)
    ratio = posterior.variance(30) / np.diag(covariance)  # as many probes as unknowns
    assert np.all(ratio >= 1 - 1e-4) and np.all(ratio <= 1 + posterior.error)
    assert np.all(posterior.variance_error(30) == 0)


def test_samples_by_a_lanczos_iteration(monkeypatch):
    """The square root of a prior without a root is the symmetric one of the dense matrix."""
    monkeypatch.setattr(prior_covariance, "MOST_COLUMNS", 1)
    functions = dp.from_functions(MATERN, MATERN, GRID.cells, GRID.cells)
    posterior = dp.laplace(lambda x: np.zeros(0), np.zeros(GRID.shape), functions)
    [sample] = posterior.sample(1, seed=3)
    normal = np.random.default_rng(3).standard_normal((1, N))[0]
    exact = scipy.linalg.sqrtm(dense(MATERN)) @ normal
    assert np.linalg.norm(sample.ravel() - exact) <= 2e-4 * np.linalg.norm(exact)


def test_stated_error_of_estimated_variances(rng, monkeypatch):
    """The errors of estimated variances have the stated size."""
    monkeypatch.setattr(prior_covariance, "MOST_COLUMNS", 1)
    grid = dp.Grid((16, 16), size=1.0)
    prior = dp.matrix_power(40.0 * dp.identity(grid.cells) - dp.laplacian(grid), -2)
    functions = dp.from_functions(prior, prior, grid.cells, grid.cells)
    residuals = lambda x: anp.reshape(x, -1)[::30] * 30.0
    exact = dp.laplace(residuals, np.zeros(grid.shape), prior).variance()
    posterior = dp.laplace(residuals, np.zeros(grid.shape), functions)
    off = (posterior.variance(60) - exact) / posterior.variance_error(60)
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.2
    assert np.max(np.abs(posterior.variance(60) / exact - 1)) < 0.5
    assert "estimated" in str(posterior)


def test_estimated_variances_of_low_rank(rng, monkeypatch):
    """The estimate is exact where the rank of the prior, beside a small remainder, is below the number of probes."""
    monkeypatch.setattr(prior_covariance, "MOST_COLUMNS", 1)
    columns = rng.standard_normal((60, 5))
    apply = lambda x: 1e-9 * x + columns @ (columns.T @ x)
    posterior = dp.laplace(lambda x: x[:0], np.zeros(60), dp.from_functions(apply, apply, 60, 60))
    assert posterior.variance(20) == pytest.approx(1e-9 + np.sum(columns**2, axis=1), rel=1e-6)
    assert np.max(posterior.variance_error(20)) < 1e-7


def test_estimated_variances_beside_the_definition(rng, monkeypatch):
    """XDiag: each random vector is tested with a projection onto the products with the others."""
    monkeypatch.setattr(prior_covariance, "MOST_COLUMNS", 1)
    root = rng.standard_normal((12, 12))
    matrix = root @ root.T
    functions = dp.from_functions(lambda x: matrix @ x, lambda x: matrix @ x, 12, 12)
    signs = np.random.default_rng(3).choice([-1.0, 1.0], (5, 12))
    estimates = []
    for i in range(5):
        basis = np.linalg.qr(matrix @ np.delete(signs, i, axis=0).T)[0]
        remainder = matrix - basis @ (basis.T @ matrix)
        estimates.append(np.diag(basis @ basis.T @ matrix) + signs[i] * (remainder @ signs[i]))
    posterior = dp.laplace(lambda x: x[:0], np.zeros(12), functions)
    with pytest.warns(dp.errors.PosteriorWarning, match="standard error"):
        variance = posterior.variance(5)
    assert variance == pytest.approx(np.maximum(np.mean(estimates, axis=0), 0.0), rel=1e-9)
    wanted = 1.5 * np.std(estimates, axis=0, ddof=1) / 5**0.5
    with pytest.warns(dp.errors.PosteriorWarning, match="standard error"):
        assert posterior.variance_error(5) == pytest.approx(wanted, rel=1e-9)


def of_root(root):
    return {"prior": root @ root.T, "prior_root": root}


STRETCHED = dp.Grid(12, spacing=np.linspace(1.0, 2.0, 12))
SOLVE = dp.inverse(dp.identity(STRETCHED.cells) - dp.laplacian(STRETCHED), "direct")
RING = dp.Grid(12, periodic=True)
RECTANGULAR = dp.from_matrix(np.random.default_rng(0).standard_normal((12, 20)))
PRIORS = {
    "a variance": {"prior": 3.0},
    "a diagonal": {"prior": dp.diagonal(STRETCHED.cells, np.linspace(1.0, 2.0, 12))},
    "a sparse matrix": {"prior": dp.from_matrix(np.eye(12) + 0.3 * (np.eye(12, k=1) + np.eye(12, k=-1)))},
    "a stretched grid": {"prior": SOLVE @ SOLVE @ dp.diagonal(STRETCHED.cells, 1 / STRETCHED.volumes)},
    "a root": of_root(SOLVE @ dp.diagonal(STRETCHED.cells, STRETCHED.volumes**-0.5)),
    "a rectangular root": of_root(RECTANGULAR),
    "a periodic grid": {"prior": dp.matrix_power(dp.identity(RING.cells) - dp.laplacian(RING), -1)},
    "functions": {"prior": dp.from_functions(lambda x: 2.0 * x, None, 12, 12)},
}


@pytest.mark.parametrize("name", PRIORS)
def test_priors(name, rng):
    """Variances, deviations and the covariance of samples, for each kind of prior."""
    options = PRIORS[name]
    prior = options["prior"]
    matrix = prior * np.eye(12) if name == "a variance" else dense(prior)
    _, residuals, mean, covariance = linear_problem(rng, matrix, count=4)
    posterior = dp.laplace(residuals, mean, **options)
    assert posterior.shift < 1e-6
    check_against(posterior, covariance, rng, 1e-7)
    samples = np.array(posterior.sample(2000, seed=5)) - mean
    whitened = np.linalg.solve(scipy.linalg.cholesky(covariance, lower=True), samples.T)
    assert np.max(np.abs(whitened @ whitened.T / 2000 - np.eye(12))) < 0.15  # standard error 0.022 and 0.032
    assert np.max(np.abs(np.mean(whitened, axis=1))) < 0.1


def test_samples_depend_on_the_seed_only():
    posterior = dp.laplace(lambda x: x[:2], np.zeros(5), 1.0)
    first, second = posterior.sample(2, seed=1)
    assert np.array_equal(first, posterior.sample(1, seed=1)[0]) and not np.array_equal(first, second)
    assert not np.array_equal(first, posterior.sample(1, seed=2)[0])
    assert np.array_equal(posterior.sample(1)[0], posterior.sample(1, seed=0)[0])
    assert posterior.sample(0) == []


def test_results_may_be_modified():
    """A caller may write into the arguments and the results."""
    x = np.zeros(5)
    posterior = dp.laplace(lambda x: x[:2] + x[2] ** 2, x, 1.0)
    expected = posterior.variance(), posterior.sample(1)[0], posterior.std_of(lambda x: anp.sum((x + 1.0) ** 2))
    x[:] = 3.0
    for array in (posterior.x, posterior.eigenvalues, posterior.variance(), posterior.variance_error(), posterior.step):
        array[:] = 7.0
    again = posterior.variance(), posterior.sample(1)[0], posterior.std_of(lambda x: anp.sum((x + 1.0) ** 2))
    assert all(map(np.array_equal, again, expected))
    assert np.all(posterior.variance_error() == 0)


def test_trees(rng):
    """A prior for each leaf, or one for all; constants stay, and have no variance."""
    x = {"u": np.zeros((6, 5)), "rate": 0.0, "n": 3}
    rows = rng.standard_normal((5, 31))
    residuals = lambda x: anp.dot(rows, anp.concatenate([anp.reshape(x["u"], -1), anp.reshape(x["rate"], 1)])) * x["n"]
    prior = scipy.linalg.block_diag(dense(MATERN), 4.0)
    covariance = np.linalg.inv(np.linalg.inv(prior) + 9.0 * rows.T @ rows)
    for given in ({"rate": 4.0, "n": None, "u": MATERN}, dp.from_matrix(prior)):
        posterior = dp.laplace(residuals, x, given)
        variance = posterior.variance()
        assert variance["u"].reshape(-1) == pytest.approx(np.diag(covariance)[:30], rel=1e-8)
        assert variance["rate"] == pytest.approx(covariance[30, 30], rel=1e-8) and variance["n"] is None
        assert posterior.std_of(lambda x: 2.0 * x["rate"]) == pytest.approx(2 * covariance[30, 30] ** 0.5)
        [sample] = posterior.sample(1)
        assert sample["n"] == 3 and sample["u"].shape == (6, 5) and type(sample["rate"]) is float
        assert dense(posterior.covariance) == pytest.approx(covariance, rel=1e-6, abs=1e-9)


@pytest.mark.filterwarnings("ignore:eigenvalues:sparsedp.errors.PosteriorWarning")
@pytest.mark.parametrize("unit", [1e-150, 1e-9, 1e9])
def test_units(unit, rng):
    """The posterior does not depend on the unit of the unknowns."""
    rows = rng.standard_normal((40, 30))
    run = lambda unit, **options: dp.laplace(
        lambda x: anp.dot(rows, anp.reshape(x, -1) / unit), np.zeros((6, 5)), (unit * MATERN) * unit, **options
    )
    for options in ({}, {"rank": 29}):
        posterior = run(unit, **options)
        expected = run(1.0, **options)
        assert posterior.eigenvalues == pytest.approx(expected.eigenvalues, rel=1e-8)
        assert posterior.variance() / unit**2 == pytest.approx(expected.variance(), rel=1e-8)


def test_numbers_whose_squares_are_not_representable():
    """A prior of 1e200, the deviation of a quantity with a gradient of 1e200 or 1e-200, and x 1e160 from the mode."""
    rows = np.random.default_rng(0).standard_normal((5, 4))
    mean = np.linalg.solve(rows.T @ rows, rows.T @ np.ones(5))
    posterior = dp.laplace(lambda x: anp.dot(rows, x) - 1.0, mean, 1e200)
    covariance = np.linalg.inv(rows.T @ rows)
    assert np.allclose(posterior.variance(), np.diag(covariance), rtol=1e-9) and posterior.shift < 1e-9
    for size in (1e-200, 1e200):
        assert posterior.std_of(lambda x: size * x[1]) == pytest.approx(size * covariance[1, 1] ** 0.5, rel=1e-9)
    with pytest.warns(dp.errors.PosteriorWarning, match="x is 2.4e\\+160 posterior") as caught:
        prior = dp.from_matrix(np.eye(4) + 0.3)
        far = dp.laplace(lambda x: anp.dot(rows[:2], x) - 1.0, np.full(4, 1e160), prior)
    assert len(caught) == 1 and far.information_gain == np.inf and np.allclose(far.x + far.step, 0.0, atol=1e146)


def test_single_precision():
    x = np.zeros(40, np.float32)
    posterior = dp.laplace(lambda x: 3.0 * x[:20], x, 1.0)
    assert posterior.sample(1)[0].dtype == np.float32 and posterior.variance().dtype == float
    assert posterior.variance() == pytest.approx(np.where(np.arange(40) < 20, 0.1, 1.0), rel=1e-6)
    posterior = dp.laplace(lambda x: 0.5 * anp.sum(9.0 * x[:20] ** 2), x, 1.0)
    assert posterior.variance() == pytest.approx(np.where(np.arange(40) < 20, 0.1, 1.0), rel=1e-4)


def test_nothing_to_learn():
    """No unknowns, no data, and data that do not depend on the unknowns: the posterior is the prior."""
    empty = dp.laplace(lambda x: x, np.zeros(0), 1.0)
    assert empty.variance().shape == (0,) and empty.sample(1)[0].shape == (0,) and empty.information_gain == 0
    for misfit in (lambda x: x[:0], lambda x: np.ones(3), lambda x: 0.0 * x, lambda x: 0.0, lambda x: 0.0 * anp.sum(x)):
        posterior = dp.laplace(misfit, np.zeros(4), 2.0, rank=2)
        assert posterior.eigenvalues.shape == (0,) and np.all(posterior.variance() == 2.0)
        assert posterior.information_gain == 0 and posterior.expected_information_gain == 0
        assert np.std(posterior.sample(2000)) == pytest.approx(2.0**0.5, rel=0.05)


def test_exact_data():
    """Noise of 1e-9: no digits of the small variances are lost, and none of the large ones."""
    posterior = dp.laplace(lambda x: 1e9 * x[:3], np.zeros(5), 1.0)
    assert posterior.variance() == pytest.approx([1e-18, 1e-18, 1e-18, 1.0, 1.0], rel=1e-9)
    assert posterior.std_of(lambda x: x[0]) == pytest.approx(1e-9, rel=1e-9)
    assert np.std(np.array(posterior.sample(500))[:, 0]) == pytest.approx(1e-9, rel=0.1)


def test_accurate_and_inaccurate_data_together():
    """Eigenvalues that span 21 decades: the Hilbert matrix beside exact arithmetic."""
    hilbert = 1e3 / (np.arange(10)[:, None] + np.arange(10) + 1.0)
    posterior = dp.laplace(lambda x: anp.dot(hilbert, x), np.zeros(10), 1.0)
    exact = np.linalg.svd(hilbert)[1][:9] ** 2
    assert posterior.eigenvalues == pytest.approx(exact, rel=1e-6)
    assert exact[0] / exact[-1] > 1e21
    fractions = [[Fraction(float(entry)) for entry in row] for row in hilbert]
    precision = [[sum(map(mul, a, b)) + (a is b) for b in fractions] for a in fractions]  # the matrix is symmetric
    assert posterior.variance() == pytest.approx(diagonal_of_inverse(precision), rel=1e-8)


def diagonal_of_inverse(matrix):
    """The diagonal of the inverse of a matrix of fractions, by Gauss-Jordan elimination."""
    n = len(matrix)
    rows = [[*row, *(Fraction(i == j) for j in range(n))] for i, row in enumerate(matrix)]
    for i in range(n):
        rows[i] = [entry / rows[i][i] for entry in rows[i]]
        for j in range(n):
            if j != i:
                rows[j] = [a - rows[j][i] * b for a, b in zip(rows[j], rows[i], strict=True)]
    return [float(rows[i][n + i]) for i in range(n)]


def test_wide_prior_is_the_covariance_of_least_squares():
    """Without prior knowledge, the covariance equals `covariance` of minimize with absolute_sigma."""
    times = np.linspace(0.0, 2.0, 30)
    data = 3.0 * np.exp(-1.5 * times) + 0.05 * np.random.default_rng(2).standard_normal(30)
    residuals = lambda p: (p["size"] * anp.exp(-p["rate"] * times) - data) / 0.05
    best = dp.minimize(residuals, {"size": 1.0, "rate": 1.0}, "gauss_newton", absolute_sigma=True)
    posterior = dp.laplace(residuals, best.x, 1e12)
    assert dense(posterior.covariance) == pytest.approx(best.covariance, rel=1e-6)
    assert list(posterior.variance().values()) == pytest.approx(np.diag(best.covariance), rel=1e-6)
    assert posterior.shift < 1e-4


def test_hessian_of_a_loss_may_be_indefinite():
    """An eigenvalue between -1 and 0 makes the posterior wider than the prior."""
    posterior = dp.laplace(lambda x: 0.5 * anp.sum(np.array([4.0, -0.5, 0.0]) * x**2), np.zeros(3), 1.0)
    assert posterior.variance() == pytest.approx([0.2, 2.0, 1.0])
    assert posterior.eigenvalues == pytest.approx([4.0, -0.5])
    assert np.var(np.array(posterior.sample(4000)), axis=0) == pytest.approx([0.2, 2.0, 1.0], rel=0.1)


def test_covariance_is_a_differentiable_operator(rng):
    posterior = dp.laplace(lambda x: anp.reshape(x, -1)[:4] * 3.0, np.zeros((6, 5)), MATERN)
    assert dp.check.operator(posterior.covariance).ok
    assert posterior.covariance.domain == GRID.cells
    weights = rng.standard_normal((6, 5))
    loss = lambda u: anp.sum(weights * posterior.covariance(u) ** 2)
    assert dp.check.gradient(loss, weights, quick=True).verdict == "agrees"


def test_deviation_of_a_nonlinear_quantity(rng):
    """std_of uses the derivative of the quantity at x."""
    mean = rng.standard_normal(12)
    posterior = dp.laplace(lambda x: 2.0 * (x[:5] - mean[:5]), mean, 1e-8, prior_mean=mean)
    quantity = lambda x: anp.stack([anp.sum(x**3), anp.exp(x[0])])
    values = np.array([quantity(x) for x in posterior.sample(1000)])
    assert posterior.std_of(quantity) == pytest.approx(np.std(values, axis=0), rel=0.1)
    assert posterior.std_of(lambda x: 3.0) == 0.0


def test_jitted_misfit_and_pickles():
    posterior = dp.laplace(dp.jit(lambda x: 2.0 * x[:5]), np.zeros(8), 1.0)
    again = pickle.loads(pickle.dumps(posterior))
    assert np.array_equal(again.variance(), posterior.variance())
    assert posterior.eigenvalues == pytest.approx(np.full(5, 4.0))
    assert "eigenvalues" in posterior._repr_html_()


def coverage(rng, data_sets, prior, samples_of_prior, rows):
    """Count how often intervals of 90 % and 95 % hold the truth: of a weighted sum and of an entry."""
    weights = rng.standard_normal(rows.shape[1])
    held = np.zeros((2, 2), int)
    for truth in samples_of_prior(data_sets):
        data = rows @ truth + rng.standard_normal(len(rows))
        residuals = lambda x, data=data: anp.dot(rows, x) - data
        posterior = dp.laplace(residuals, np.zeros(truth.size), prior)
        error = posterior.x + posterior.step - truth
        off = [
            abs(weights @ error) / posterior.std_of(lambda x: anp.dot(weights, x)),
            abs(error[7]) / np.sqrt(posterior.variance()[7]),
        ]
        held += np.less.outer(off, [1.6449, 1.9600])
    return held


@pytest.mark.filterwarnings("ignore:x is:sparsedp.errors.PosteriorWarning")
@pytest.mark.parametrize("data_sets", [40, pytest.param(200, marks=pytest.mark.slow)])
def test_coverage(rng, data_sets):
    """Intervals hold the truth as often as they say, for data sets drawn from the prior: binomial bounds."""
    rows = rng.standard_normal((25, 30)) * 3.0
    held = coverage(rng, data_sets, MATERN, lambda count: sampled(MATERN, rng, count), rows)
    for share, counts in zip((0.9, 0.95), held.T):
        least, most = binom.ppf([1e-4, 1 - 1e-4], data_sets, share)
        assert np.all(counts >= least) and np.all(counts <= most)


def sampled(prior, rng, count):
    root = scipy.linalg.cholesky(dense(prior), lower=True)
    return [root @ rng.standard_normal(len(root)) for _ in range(count)]


@pytest.mark.slow
def test_4096_unknowns_beside_dense_matrices():
    from benchmarks.posterior import row

    figures = row(64)
    assert figures["eigenpairs"] == 163 and figures["products"] <= figures["double pass"]
    assert figures["mean"] < 1e-4 and figures["gain"] < 1e-4
    assert figures["variances"] < figures["stated"] and figures["deviations"] < figures["stated"]


@pytest.mark.slow
def test_coverage_of_4096_unknowns(rng):
    """200 data sets drawn from the prior: intervals of sums, of a temperature and of single cells hold the truth."""
    from benchmarks.posterior import Problem

    problem = Problem(64)
    posterior = problem.posterior(np.zeros(problem.grid.shape))
    cells = [(8, 8), (32, 32), (50, 20), (1, 40)]
    weights = rng.standard_normal(problem.grid.shape)
    quantities = [
        lambda x: anp.sum(x),
        lambda x: anp.sum(weights * x),
        lambda x: anp.sum(x[40:, :10]),
        lambda x: problem.solve(x)[30, 40],
        *(lambda x, cell=cell: x[cell] for cell in cells),
    ]
    deviations = [posterior.std_of(quantity) for quantity in quantities]
    assert deviations[4:] == pytest.approx([posterior.variance()[cell] ** 0.5 for cell in cells])
    held = np.zeros((len(quantities), 2), int)
    for _ in range(200):
        truth = problem.root(rng.standard_normal(problem.grid.shape))
        data = problem.readings(truth) / problem.noise + rng.standard_normal(len(problem.data))
        mean = posterior.covariance(problem.solve.T(problem.sensors.T(data))) / problem.noise
        off = [abs(q(mean - truth)) / deviation for q, deviation in zip(quantities, deviations, strict=True)]
        held += np.less.outer(off, [1.6449, 1.9600])
    for share, counts in zip((0.9, 0.95), held.T):
        least, most = binom.ppf([1e-4, 1 - 1e-4], 200, share)
        assert np.all(counts >= least) and np.all(counts <= most)


SPECTRA = {
    "geometric": lambda i, n, rng: 100 * 0.8**i,
    "algebraic": lambda i, n, rng: 10 / (1.0 + i),
    "quadratic": lambda i, n, rng: 100 / (1.0 + i) ** 2,
    "equal": lambda i, n, rng: np.where(i < n // 3, 10.0, 0.0),
    "equal, and equal below": lambda i, n, rng: np.where(i < n // 4, 10.0, 0.009),
    "three groups": lambda i, n, rng: np.where(i < 5, 1e6, np.where(i < n // 5, 0.02, 1e-4)),
    "random": lambda i, n, rng: 10 ** rng.uniform(-6, 4, n),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::sparsedp.errors.PosteriorWarning")
@pytest.mark.parametrize("name", SPECTRA)
def test_stated_errors_for_random_problems(name, rng, monkeypatch):
    """Variances are too large by at most the stated error, for any spectrum, prior, rank and tolerance."""
    for trial in range(30):
        n = int(rng.integers(20, 250))
        values = SPECTRA[name](np.arange(n), n, rng)
        vectors = np.linalg.qr(rng.standard_normal((n, n)))[0]
        axes = np.linalg.qr(rng.standard_normal((n, n)))[0] if trial % 2 else np.eye(n)
        variances = rng.permutation(np.geomspace(1.0, 10 ** -rng.uniform(0.0, 8.0), n))
        prior = (axes * variances) @ axes.T
        inverse_root = (axes / np.sqrt(variances)) @ axes.T
        rows = np.sqrt(values)[:, None] * vectors.T @ inverse_root
        monkeypatch.setattr(prior_covariance, "MOST_COLUMNS", 1024 if trial % 3 else 1)
        functions = dp.from_functions(lambda x, prior=prior: prior @ x, None, n, n)
        tolerance = float(rng.choice([0.1, 0.01, 0.001]))
        misfit = lambda x, rows=rows: 0.5 * anp.sum(anp.dot(rows, x) ** 2)
        posterior = dp.laplace(misfit, np.zeros(n), functions, rank=int(rng.integers(1, n)), tolerance=tolerance)
        gain = np.linalg.solve(rows @ prior @ rows.T + np.eye(n), rows @ prior)
        weights = rng.standard_normal((5, n)) @ inverse_root
        exact = np.diag(weights @ (prior - prior @ rows.T @ gain) @ weights.T)
        ratio = posterior.std_of(lambda x, weights=weights: anp.dot(weights, x)) ** 2 / exact
        assert np.all(ratio >= 1 - 0.3 * tolerance - 1e-6)
        assert np.all(ratio <= 1 + 1.02 * posterior.error + 1e-6)
