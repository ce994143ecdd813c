"""Errors of the optimizers: each whole message."""

import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError

LINE = dp.Grid(2)


def run(loss=lambda x: anp.sum(x**2), start=(0.5, 0.5), method="lbfgs", **options):
    return lambda: dp.minimize(loss, np.array(start), method, **options)


def direction(outputs=lambda u: u, x=(1.0, 1.0), g=None, **options):
    return lambda: dp.update_direction(outputs, np.array(x), g, **options)


def back(inverse):
    """Differentiate through a simulator with this inverse."""
    rule = dp.physical_gradient(lambda x: x, inverse)
    return lambda: dp.value_and_grad(lambda x: anp.sum(rule(x)))(np.ones(3))


WRONG = [
    (
        run(batches=[1]),
        ValueError,
        "lbfgs compares losses and cannot use batches; write method='adam', or give gd a rate",
    ),
    (run(method="gd", batches=[1]), ValueError, "gd compares losses and cannot use batches; write method='adam'"),
    (
        run(method="adam", batches=3),
        TypeError,
        "batches must be a list or a function of the iteration, got int; write list(batches)",
    ),
    (run(method="adam", batches=[]), ValueError, "batches is empty; leave it out to call the loss with x alone"),
    (
        run(bounds=3),
        ValueError,
        "bounds must be a pair (lower, upper), each a number, None or a tree like start, "
        "got 3; write (0.0, None) for x >= 0",
    ),
    (
        run(bounds={"a": (0.0, 1.0)}),
        ValueError,
        "bounds must be a pair (lower, upper), each a number, None or a tree like start, "
        "got {'a': (0.0, 1.0)}; write a dict of lower and a dict of upper bounds",
    ),
    (
        run(bounds=np.zeros((2, 2))),
        ValueError,
        "bounds must be a pair (lower, upper), each a number, None or a tree like start, "
        "got array([[0., 0...    [0., 0.]]); write tuple(bounds) if its rows are the lower and the upper bounds",
    ),
    (
        run(bounds=((0, 1), (2, 3))),
        ValueError,
        "bounds is ambiguous: ((0, 1), (2, 3)) may be two pairs (lower, upper), or all lower and all upper bounds; "
        "write tuple(map(np.array, zip(*bounds))) for the former and tuple(map(np.array, bounds)) for the latter, "
        "with -np.inf or np.inf in place of None",
    ),
    (
        run(bounds=[(3, 4), (0, 1)]),
        ValueError,
        "bounds must be (lower, upper), got one pair for each entry of start, [(3, 4), (0, 1)]; write "
        "tuple(map(np.array, zip(*bounds))), with -np.inf or np.inf in place of None",
    ),
    (
        run(bounds=(2.0, 1.0)),
        ValueError,
        "bounds must be numbers with lower <= upper, got 2.0 and 1.0; write None for a side without a bound",
    ),
    (
        run(bounds=(np.inf, None)),
        ValueError,
        "bounds must be numbers with lower <= upper, got inf and inf; write None for a side without a bound",
    ),
    (
        run(bounds=(np.nan, 1.0)),
        ValueError,
        "bounds must be numbers with lower <= upper, got nan and 1.0; write None for a side without",
    ),
    (
        run(bounds=((np.zeros(2), 1.0), None)),
        ValueError,
        "bounds[0]: expected one array or number, got a tuple of length 2; "
        "write one number, None, or a tree like start",
    ),
    (
        run(project=lambda x: (x, x), loss=lambda x: anp.sum(x[0] ** 2)),
        ShapeError,
        "project(x): expected one array or number, got a tuple of length 2; return a tree like start",
    ),
    (
        run(project=lambda x: anp.clip(x, 0.5, 1.0)),
        ValueError,
        "project must be a projection onto a linear or affine space, but it is not affine near the start; with other "
        "maps a search may stop where the loss has no minimum. Write bounds=(lower, upper) to keep x in a box",
    ),
    (
        run(project=lambda x: x, bounds=(0.0, None)),
        ValueError,
        "project and bounds cannot be used together: a projected point may be outside of the bounds; leave one of "
        "them out",
    ),
    (
        lambda: run(maxiter=0)().covariance,
        ValueError,
        "the covariance is not known: only least-squares problems have one; return the residuals and write "
        "method='levenberg_marquardt'",
    ),
    (
        run(lambda x: anp.sum((1e170 * x) ** 2), (1e-170,), "admm", weight=1e200),
        ValueError,
        "rho of admm, the weight divided by the size of K x, is inf here; rescale x or write rho=",
    ),
    (
        lambda: dp.minimize(lambda x: x["a"] ** 2, {"a": 1.0, "b": 2.0}, "admm", weight=1.0),
        TypeError,
        "admm without operator= takes one array as start, got a dict of a, b; write the linear map from the start to "
        "an array, for example operator=lambda x: x['a']",
    ),
    (
        run(method="newton_cg", inner=0),
        ValueError,
        "inner of newton_cg must be a whole number >= 1, got 0; the default is 200",
    ),
    (
        run(method="newton_cg", gradient=lambda x: x),
        TypeError,
        "newton_cg differentiates the loss twice and does not use gradient; leave it out",
    ),
    (
        run(lambda z: anp.sum(anp.abs(z - 1j) ** 2), (0.5j,), "newton_cg"),
        DerivativeError,
        "newton_cg takes real numbers, got complex ones; split them into two real arrays",
    ),
    (
        run(method="levenberg_marquardt", damping=0),
        ValueError,
        "damping of levenberg_marquardt must be > 0, got 0; the default is 1e-3",
    ),
    (
        run(method="gauss_newton", accuracy=1.0),
        ValueError,
        "accuracy of gauss_newton must be from 0 to below 1, got 1; the default is 1e-10",
    ),
    (
        run(method="levenberg_marquardt", accuracy=-1),
        ValueError,
        "accuracy of levenberg_marquardt must be from 0 to below 1, got -1; the default is 1e-10",
    ),
    (
        run(method="half_inverse", rate=0),
        ValueError,
        "rate of half_inverse must be > 0, got 0; leave it out and it is searched for",
    ),
    (
        run(method="physical_gradient"),
        TypeError,
        "physical_gradient needs physics and inverse; write minimize(loss_of_y, x, 'physical_gradient', physics=f, "
        "inverse=f_inverse)",
    ),
    (
        run(method="gauss_newton"),
        DerivativeError,
        "the outputs are one number; return the residuals as an array, do not sum them",
    ),
    (
        run(method="adam", metric=dp.identity(LINE.cells)),
        TypeError,
        "adam takes no metric; leave it out, or write method= one of lbfgs, gd, newton_cg",
    ),
    (
        run(metric=dp.identity(LINE.cells) - dp.laplacian(LINE), bounds=(0.0, None)),
        ValueError,
        "with bounds the metric must be diagonal, such as dp.diagonal(grid.cells, grid.volumes): the direction of "
        "another one leads out of them; leave bounds or metric out",
    ),
    (run(metric=np.eye(2)), TypeError, "metric takes an Operator, got ndarray; write dp.from_matrix(...) first"),
    (run(metric=1j * dp.identity(LINE.cells)), TypeError, "metric must hold real numbers, got dtype complex128"),
    (
        run(metric=dp.identity(dp.Grid(3).cells)),
        ShapeError,
        "metric must map arrays of the shape of start, (2,), to such arrays, got identity from cells(3) to cells(3)",
    ),
    (
        lambda: dp.minimize(lambda p: p["a"] ** 2, {"a": 1.0, "n": 2}, metric=dp.identity(LINE.cells)),
        ShapeError,
        "metric is one Operator, and start is a dict of a, n; write an Operator or None for each array of start",
    ),
    (
        lambda: dp.minimize(lambda p: p["a"] ** 2, {"a": 1.0, "n": 2}, metric={"a": None}),
        ShapeError,
        "metric: missing key 'n'; expected 'a', 'n'; write an Operator or None for each array of start",
    ),
    (
        run(metric=dp.from_functions(lambda u: np.nan * u, None, LINE.cells, LINE.cells)),
        NonFiniteError,
        "the product with metric must be finite, got 6 that are NaN or infinite",
    ),
    (
        run(metric=dp.from_matrix([[2.0, 1.0], [0.0, 2.0]], LINE.cells, LINE.cells)),
        ValueError,
        "metric must be symmetric, and matrix is not; on a grid with cells of different volume multiply it by them, as "
        "in dp.diagonal(grid.cells, grid.volumes) @ op",
    ),
    (
        run(metric=-dp.laplacian(LINE)),
        ValueError,
        "metric must not be singular, and -laplacian is; add a multiple of dp.identity",
    ),
    (
        run(metric=dp.inverse(-dp.laplacian(LINE))),
        ValueError,
        "metric must not be singular, and inverse(-laplacian) is; add a multiple of dp.identity",
    ),
    (
        run(metric=dp.from_matrix([[1.0, -2.0], [-2.0, 4.0]], LINE.cells, LINE.cells)),
        ValueError,
        "metric has no inverse: <matrix: cells(2) -> cells(2), explicit> is singular",
    ),
    (
        run(metric=dp.laplacian(LINE) - dp.identity(LINE.cells)),
        ValueError,
        "metric must be positive definite, and laplacian + -identity is not; check its sign: -dp.laplacian(grid) has "
        "positive eigenvalues",
    ),
    (
        run(metric=dp.diagonal(LINE.cells, [3.0, -1.0])),
        ValueError,
        "metric must be positive definite, and has the diagonal entry -1",
    ),
    (
        run(metric=dp.from_matrix([[1.0, 3.0], [3.0, 5.0]], LINE.cells, LINE.cells), start=(0.5, -0.5)),
        ValueError,
        "metric must be positive definite, and is negative for a vector of this run; check its eigenvalues",
    ),
    (direction(power=2), ValueError, "power must be from 0 to 1, got 2; 0.75 gives half-inverse gradients"),
    (direction(damping=-1), ValueError, "damping must be >= 0, got -1; the default is 0"),
    (direction(truncation=1), ValueError, "truncation must be from 0 to below 1, got 1; the default is 1e-10"),
    (direction(method="svd"), ValueError, "method must be one of auto, dense, krylov, got 'svd'"),
    (direction(rank=0), ValueError, "rank must be a whole number >= 1, got 0; leave it out for no limit"),
    (
        direction(x=(1j, 1.0)),
        DerivativeError,
        "this method takes real numbers, got complex ones; split them into two real arrays",
    ),
    (
        direction(g=np.ones(3)),
        ShapeError,
        "the cotangent must have shape (2,), got (3,); give one like the outputs",
    ),
    (direction(lambda u: u * np.nan), NonFiniteError, "an output must be finite, got 2 that are NaN or infinite"),
    (
        direction(g=np.array([1, np.nan])),
        NonFiniteError,
        "the cotangent must be finite, got 1 that are NaN or infinite",
    ),
    (
        direction(lambda u: anp.ones((6, 2)) @ anp.reshape(u, (-1, 2))[0], apart=True, method="dense"),
        ShapeError,
        "with apart=True every leaf of x gets a leading axis of 6 copies, one for each sample, and the outputs do not "
        "follow them; write a function that broadcasts over it",
    ),
    (
        lambda: dp.physical_gradient(lambda x: x, lambda y, x: y, rate=0),
        ValueError,
        "rate of physical_gradient must be > 0, got 0; the default is 1",
    ),
    (
        back(lambda y, x: y[:1]),
        ShapeError,
        "x from the inverse of physical gradient must have shape (3,), got (1,)",
    ),
]


@pytest.mark.parametrize("call, error, message", WRONG)
def test_refusals(call, error, message):
    with pytest.raises(error, match="^" + re.escape(message)):
        call()
