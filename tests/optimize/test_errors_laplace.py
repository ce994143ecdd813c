"""Errors and warnings of laplace: each whole message."""

import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, PosteriorWarning, ShapeError
from sparsedp.optimize import prior_covariance

GRID = dp.Grid((4, 3), size=1.0)
HEAT = dp.identity(GRID.cells) - dp.laplacian(GRID)
C = dp.matrix_power(HEAT, -2)
LINE = dp.Grid(1100)
STRETCHED = dp.Grid(4, spacing=np.array([1.0, 2.0, 3.0, 4.0]))
ADVICE = "; write an Operator for the array x, one for the flattened x, or a tree of them like x"
SINGULAR = "; add a small multiple of dp.identity, and remove known entries from x"


def of_matrix(matrix):
    return dp.from_matrix(np.asarray(matrix, float))


def run(prior=C, misfit=lambda x: anp.reshape(x, -1)[:2], x=None, **options):
    return lambda: dp.laplace(misfit, np.zeros((4, 3)) if x is None else x, prior, **options)


def on(prior, **options):
    """Laplace of an array that fits a prior."""
    return run(prior, x=np.zeros(prior.domain.shape), **options)


ROTATED = [[2.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]
LOW_RANK = np.random.default_rng(0).standard_normal((3, 5))
KINKED = dp.differentiable(
    "kinked", lambda x: 0.5 * np.sum(x**2), lambda nums, ans, x: lambda g: (g * anp.dot(SKEW, x),)
)
SKEW = np.eye(12) + 0.3 * np.triu(np.ones((12, 12)), 1)

WRONG = [
    (run(misfit=3), TypeError, "laplace takes a function, got int; write lambda x: (predicted(x) - data) / noise"),
    (
        run(x=dp.minimize(lambda x: x**2, 1.0)),
        TypeError,
        "laplace takes the unknowns, got the result of minimize; write best.x",
    ),
    (run(rank=0), ValueError, "rank of laplace must be a whole number >= 1, got 0; the default is 200"),
    (run(tolerance=1.0), ValueError, "tolerance of laplace must be between 0 and 1, got 1; the default is 0.01"),
    (run(seed=-1), ValueError, "seed of laplace must be a whole number >= 0, got -1; the default is 0"),
    (
        run(x=np.zeros((4, 3), int)),
        DerivativeError,
        "floating values are needed, and x holds none; write np.asarray(x, float)",
    ),
    (
        run(x=np.zeros((4, 3), complex)),
        DerivativeError,
        "laplace takes real unknowns, got complex ones; split them into two real arrays",
    ),
    (
        run(x=np.full((4, 3), np.nan)),
        NonFiniteError,
        "x of laplace must be finite, got 12 that are NaN or infinite, the first at (0, 0)",
    ),
    (
        lambda: dp.grad(lambda x: anp.sum(run(x=x)().variance()))(np.zeros((4, 3))),
        DerivativeError,
        "laplace has no derivatives and cannot be recorded; call it outside of the differentiated or recorded function",
    ),
    (
        run(misfit=lambda x: (x, x)),
        DerivativeError,
        "the misfit must return an array of residuals or one number, got tuple; write np.concatenate of its flattened "
        "parts",
    ),
    (
        run(misfit=lambda x: anp.log(-x - 1.0)),
        NonFiniteError,
        "an output must be finite, got 12 that are NaN or infinite, the first at (0, 0)",
    ),
    (
        run(prior=np.eye(12)),
        TypeError,
        "the prior takes an Operator or a variance, got ndarray; write dp.diagonal(grid.cells, variances), "
        "or dp.from_matrix(matrix, grid.cells, grid.cells)",
    ),
    (run(prior=0.0), ValueError, "a number as the prior is a variance and must be > 0 and finite, got 0.0"),
    (
        run(prior=of_matrix(np.eye(3))),
        ShapeError,
        "the prior maps space(3) to space(3), but x has shape (4, 3)" + ADVICE,
    ),
    (
        run(prior={"a": C}, x={"a": np.zeros(5)}),
        ShapeError,
        "prior['a'] maps cells(4, 3) to cells(4, 3), but x['a'] has shape (5,)" + ADVICE,
    ),
    (
        run(prior={"b": C}, x={"a": np.zeros((4, 3))}),
        ShapeError,
        "prior: unknown key 'b'; expected 'a'" + ADVICE,
    ),
    (
        run(prior=dp.diagonal(GRID.cells, 1j)),
        TypeError,
        "the prior has complex entries; laplace takes real unknowns and a real covariance",
    ),
    (
        on(of_matrix(ROTATED)),
        ValueError,
        "the prior is not symmetric (relative difference 2.0e-01); for a power of an operator on a stretched grid "
        "write C @ dp.diagonal(grid.cells, 1 / grid.volumes)",
    ),
    (
        on(of_matrix(np.diag([1.0, 2.0, -0.5]))),
        ValueError,
        "the prior has negative eigenvalues, down to -5.0e-01; a covariance is positive definite",
    ),
    (
        on(of_matrix(LOW_RANK.T @ LOW_RANK)),
        ValueError,
        "the prior is singular: its smallest eigenvalue is 0" + SINGULAR,
    ),
    (
        on(dp.matrix_power(-dp.laplacian(GRID), -1)),
        ValueError,
        "the prior is singular: its smallest eigenvalue is 0" + SINGULAR,
    ),
    (
        on(0.0 * C),
        ValueError,
        "the prior is singular: it maps test vectors to 0; add a small multiple of dp.identity, and remove known "
        "entries from x",
    ),
    (
        on(dp.inverse(-dp.laplacian(LINE), "direct")),
        ValueError,
        "the prior is singular: it maps a constant to 0" + SINGULAR,
    ),
    (
        run(prior_root=HEAT),
        ValueError,
        "prior_root must satisfy R @ R.T = prior, but the products of the prior differ by 7.1e+03",
    ),
    (
        run(prior_root=3.0),
        TypeError,
        "prior_root takes an Operator, got float; write prior_root=R, with R @ R.T equal to the prior",
    ),
    (
        run(prior_root=of_matrix(np.eye(3))),
        ShapeError,
        "prior_root maps to space(3), but the unknowns have shape (4, 3); write R with R @ R.T equal to the prior",
    ),
    (
        run(prior_mean=np.zeros(3)),
        ShapeError,
        "prior_mean must have shape (4, 3), got (3,); write a tree like x",
    ),
    (run(prior_mean=np.nan), NonFiniteError, "prior_mean of laplace must be finite, got nan"),
    (
        run(misfit=lambda x: anp.sum(x**2) - anp.sum(30.0 * x[1] ** 2)),
        ValueError,
        "the Hessian of the loss has the eigenvalue -13.1 in the metric of the prior, so x is not a minimum of the "
        "posterior; continue minimize from x, or return residuals, whose Gauss-Newton Hessian has no negative "
        "eigenvalue",
    ),
    (
        run(misfit=lambda x: KINKED(anp.reshape(x, -1))),
        DerivativeError,
        "products with the Hessian are not symmetric (relative difference 1.1e-01); dp.check.gradient(loss, x) tests "
        "the derivatives of the function",
    ),
    (
        run(misfit=lambda x: 1e200 * anp.reshape(x, -1)[:2]),
        NonFiniteError,
        "the Hessian of the misfit, in the metric of the prior, must be finite, got 4 that are NaN or infinite, the "
        "first at (0, 0); write the residuals and the unknowns in units in which they are closer to 1",
    ),
    (
        run(1e120 * C, lambda x: 1e100 * anp.reshape(x, -1)[:2], rank=1),
        NonFiniteError,
        "the Hessian of the misfit, in the metric of the prior, must be finite, got 100 that are NaN or infinite, the "
        "first at (0, 0); write the residuals and the unknowns in units in which they are closer to 1",
    ),
    (lambda: run()().sample(-1), ValueError, "count of sample must be a whole number >= 0, got -1"),
    (
        lambda: run()().sample(1, "a"),
        ValueError,
        "seed of sample must be a whole number >= 0, got 'a'; the default is 0",
    ),
    (
        lambda: run()().variance(1),
        ValueError,
        "probes of variance must be a whole number >= 2, got 1; the default is 200",
    ),
    (
        lambda: run()().variance_error(1),
        ValueError,
        "probes of variance_error must be a whole number >= 2, got 1; the default is 200",
    ),
    (lambda: run()().std_of(3), TypeError, "std_of takes a function, got int; write lambda x: np.mean(x)"),
    (
        lambda: run()().std_of(lambda x: 1j * x),
        DerivativeError,
        "std_of takes a real quantity, got a complex one; take its real part",
    ),
    (
        lambda: run()().std_of(lambda x: x > 0),
        DerivativeError,
        "std_of takes a differentiable quantity, got dtype bool; return floating numbers",
    ),
    (
        lambda: dp.laplace(lambda x: x, np.zeros(4), 4.0, prior_root=dp.from_matrix(3.0 * np.eye(4))),
        ValueError,
        "prior_root must satisfy R @ R.T = prior, but the products of the prior differ by 1.2e+00",
    ),
    (
        lambda: run()().std_of(lambda x: anp.log(x)),
        NonFiniteError,
        "the quantity of std_of must be finite, got 12 that are NaN or infinite, the first at (0, 0)",
    ),
]


@pytest.mark.filterwarnings("ignore:divide by zero|invalid value")
@pytest.mark.parametrize("call, error, message", WRONG, ids=[str(number) for number in range(len(WRONG))])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message


def test_too_small_rank_is_reported():
    misfit = lambda x: 3.0 * anp.concatenate([x, 0.5 * x])
    message = (
        "eigenvalues of the misfit up to about 11 are neglected, because there are more than rank=2: variances are "
        "too large, by a factor of up to 12.2; increase rank"
    )
    with pytest.warns(PosteriorWarning, match=re.escape(message)):
        posterior = dp.laplace(misfit, np.zeros(4), 1.0, rank=2)
    assert posterior.eigenvalues == pytest.approx([11.25, 11.25])
    assert np.all(posterior.variance() >= 1 / 12.25 - 1e-12)


def test_a_residual_as_one_number_is_reported():
    message = (
        "the misfit returns one number, the negative log-likelihood, and its Hessian at x is 0: the variances are "
        "those of the prior; for one residual write np.array([residual])"
    )
    with pytest.warns(PosteriorWarning, match=re.escape(message)):
        dp.laplace(lambda x: 0.01 * x[0], np.zeros(4), 1.0)


def test_loss_of_precision_is_reported():
    rows = np.array([[1e14, 0.0, 0.0], [0.0, 1.0, 0.0]])
    message = (
        "eigenvalues of the misfit up to about 4.9e+02 are neglected, because they are below the rounding errors of "
        "the largest one: variances are too large, by a factor of up to 494; give data with larger standard "
        "deviations, or a prior with smaller ones"
    )
    with pytest.warns(PosteriorWarning, match=re.escape(message)):
        dp.laplace(lambda x: anp.dot(rows, x), np.zeros(3), 1.0)


def test_distance_from_the_mode_is_reported():
    message = (
        "x is 2.4 posterior standard deviations from the mode of the posterior, for this prior and prior_mean; "
        "continue minimize, or add posterior.step to x"
    )
    with pytest.warns(PosteriorWarning, match=re.escape(message)):
        dp.laplace(lambda x: x[:1] - 1.0, np.array([0.8 + 2.4 * np.sqrt(0.8), 0.0]), 4.0)


def test_square_root_that_does_not_converge(monkeypatch):
    monkeypatch.setattr(prior_covariance, "ROOT_STEPS", 20)
    variances = np.geomspace(1e-4, 1.0, 1100)
    prior = dp.from_functions(lambda x: variances * x, lambda x: variances * x, 1100, 1100)
    posterior = dp.laplace(lambda x: x[:1], np.zeros(1100), prior)
    message = (
        "the square root of the prior was not found in 20 products (relative change 2e-02); write prior_root=R, with "
        "R @ R.T equal to the prior"
    )
    with pytest.raises(ConvergenceError, match=re.escape(message)):
        posterior.sample(1)
