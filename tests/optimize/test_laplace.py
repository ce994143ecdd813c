"""The posterior of laplace: beside dense linear algebra, for all kinds of priors and unknowns, and its intervals."""

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.linalg

import sparsedp as dp

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


def test_multiple_eigenvalues():
    """35 equal eigenvalues, more than the vectors of a block: new random vectors show those that were missed."""
    posterior = dp.laplace(lambda x: 3.0 * anp.concatenate([x[:35], 0.0 * x]), np.zeros(50), 1.0, rank=49)
    assert posterior.eigenvalues == pytest.approx(np.full(35, 9.0))
    assert posterior.variance() == pytest.approx(np.where(np.arange(50) < 35, 0.1, 1.0))
