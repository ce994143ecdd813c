"""laplace: the Laplace approximation of a posterior, a normal distribution, for a misfit and a prior covariance."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp._utils.calls import frames_inside
from sparsedp._utils.pytree import copied, leaves
from sparsedp._utils.validation import check_finite, check_function, check_number, check_whole
from sparsedp.autodiff.backend import backend_of, is_field
from sparsedp.autodiff.derivative import check_loss, pullback, value_and_grad
from sparsedp.autodiff.flattening import Packing
from sparsedp.autodiff.tape import isbox
from sparsedp.errors import DerivativeError, PosteriorWarning, ShapeError
from sparsedp.optimize.linearization import MOST_ENTRIES, Linearization
from sparsedp.optimize.misfit_eigenpairs import eigenpairs_of_jacobian, eigenpairs_of_products
from sparsedp.optimize.posterior import Posterior
from sparsedp.optimize.prior_covariance import PriorCovariance
from sparsedp.optimize.result import Minimum

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["laplace"]

LARGEST_SHIFT = 0.1  # distance of x from the mode, in posterior standard deviations, above which a warning is issued
NOT_COMPLETE = (
    "eigenvalues of the misfit up to about {:.2g} are neglected, because {}: variances are too large, by a factor of "
    "up to {:.3g}; {}"
)
NOT_AT_MODE = (
    "x is {:.2g} posterior standard deviations from the mode of the posterior, for this prior and prior_mean; "
    "continue minimize, or add posterior.step to x"
)

LINEAR = (
    "the misfit returns one number, the negative log-likelihood, and its Hessian at x is 0: the variances are those of "
    "the prior; for one residual write np.array([residual])"
)


def laplace(
    misfit: Callable[[Any], Any],
    x: Any,
    prior: Any,
    prior_mean: Any = 0.0,
    prior_root: Any = None,
    rank: int = 200,
    tolerance: float = 0.01,
    seed: int = 0,
) -> Posterior:
    """Approximate the posterior of unknowns near its mode x by a normal distribution (Laplace approximation).

    Parameters
    ----------
    misfit : callable
        ``misfit(x)`` returns an array of residuals, (prediction - data) / standard deviation of the noise, so that
        their variance is 1; or one number, the negative log-likelihood. It does not contain the prior.
    x : tree of arrays
        The mode of the posterior (maximum a posteriori estimate), such as ``best.x`` of `minimize` for the sum of the
        misfit and the prior. Leaves that are not floating are constants.
    prior : Operator, number, or tree of them
        The prior covariance C: an Operator for the array x, or for the flattened x, or a tree like x with one for each
        leaf. It must be symmetric and positive definite. A number is a variance, the same for all entries. Only
        products with C are computed.
    prior_mean : tree like x, or number
        Mean of the prior, in the units of x.
    prior_root : Operator, or tree of them, optional
        R with R @ R.T equal to C, for samples. Default: C^(1/2), which is computed directly for a number, a diagonal, a
        function of a separable operator (such as ``matrix_power``) and up to 1024 unknowns, and otherwise by a Lanczos
        iteration for each sample.
    rank : int
        Largest number k of eigenpairs. Each takes two vectors of the size of x.
    tolerance : float
        Eigenvalues below this number are neglected, between 0 and 1. Variances are then too large by at most the factor
        1 + tolerance.
    seed : int
        Seed of the random vectors with which the eigenpairs are computed.

    Returns
    -------
    Posterior
        With the attributes `eigenvalues`, `information_gain`, `covariance` (an Operator), `shift` (the distance of x
        from the mode) and `neglected`, and the methods `variance`, `std_of` and `sample`. str() is a table of them.

    Raises
    ------
    ValueError
        If the prior is not symmetric, has a negative eigenvalue or is singular, as far as test vectors show; if rank or
        tolerance is out of range; or if the posterior precision H + C^-1 has a negative eigenvalue, so that x is not a
        minimum.
    ShapeError
        If the prior, its root or its mean does not fit x.
    TypeError
        If the prior contains something else than operators and numbers, or complex ones.
    DerivativeError
        If x or the misfit is complex, x has no floating leaf, or products with the Hessian are not symmetric.
    NonFiniteError
        If x, the misfit or a derivative is NaN or infinite.

    Warns
    -----
    PosteriorWarning
        If eigenvalues above the tolerance are neglected, because there are more than `rank` or because they are lost in
        rounding; if x is more than 0.1 posterior standard deviations from the mode; or if the misfit returns one number
        and its Hessian is 0, so that it is rather a residual.

    See Also
    --------
    minimize, matrix_power, diagonal

    Notes
    -----
    **Covariance.** For residuals r with the Jacobian J at x, H = J^T J is the Gauss-Newton approximation of the Hessian
    of the misfit |r|^2 / 2. For a misfit that returns one number, H is its Hessian. With the eigenpairs
    H v = lambda C^-1 v, normalized by v^T C^-1 v = 1, the posterior covariance is a low-rank update of C (Woodbury
    identity) ::

        (H + C^-1)^-1 = C - sum over the pairs of lambda / (1 + lambda) v v^T

    so that data reduce the variance along v_i by the factor 1 / (1 + lambda_i). If eigenvalues below a number t are
    neglected, all variances are too large, by at most the factor 1 + t.

    **Validity.** If the residuals are linear in x and x is the mode, the result is the exact posterior. Otherwise the
    misfit must be nearly quadratic within some standard deviations of x; `shift` and `step` assume this, too.

    **Computation.** If there are at most `rank` residuals or unknowns, the Jacobian is computed, and no eigenvalue is
    neglected that exceeds rounding errors. Otherwise the eigenpairs are computed by a randomized block Krylov method
    from products with H and C. A product with H = J^T J takes one forward and one backward pass (`jvp`, `vjp`), one
    with the Hessian of a loss is a backward pass through its gradient (`hvp`). Variances have absolute errors of about
    1e-15 times those of the prior, unless there is an eigenpair for each unknown.

    **Quantities.** The standard deviation of a quantity q(x) is sqrt(g^T (H + C^-1)^-1 g) with its gradient g at x,
    which takes one backward pass (delta method).

    References
    ----------
    T. Bui-Thanh, O. Ghattas, J. Martin, G. Stadler, A computational framework for infinite-dimensional Bayesian inverse
    problems, part I, SIAM J. Sci. Comput. 35, 2013; A. Spantini, A. Solonen, T. Cui, J. Martin, L. Tenorio, Y. Marzouk,
    Optimal low-rank approximations of Bayesian linear inverse problems, SIAM J. Sci. Comput. 37, 2015.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import laplace

    The prior is N(0, 4) for two numbers. The first is measured, with a standard deviation of 1:

    >>> posterior = laplace(lambda x: x[:1] - 1.0, np.array([0.8, 0.0]), prior=4.0)
    >>> posterior.eigenvalues
    array([4.])
    >>> posterior.variance()
    array([0.8, 4. ])
    >>> posterior.std_of(lambda x: x[0] + x[1])
    2.19
    """
    started = perf_counter()
    check_function("laplace", misfit, "lambda x: (predicted(x) - data) / noise")
    rank = check_whole("rank of laplace", rank, 1, "; the default is 200")
    tolerance = check_number("tolerance of laplace", tolerance, "between 0 and 1", "; the default is 0.01")
    seed = check_whole("seed of laplace", seed, 0, "; the default is 0")
    if isinstance(x, Minimum):
        raise TypeError("laplace takes the unknowns, got the result of minimize; write best.x")
    backend_of(leaves(x)).check("laplace")
    if any(map(isbox, leaves(x))):
        raise DerivativeError(
            "laplace has no derivatives and cannot be recorded; call it outside of the differentiated or recorded "
            "function"
        )
    packing = Packing(x, "x")
    if packing.complex:
        raise DerivativeError("laplace takes real unknowns, got complex ones; split them into two real arrays")
    for name, value in zip(packing.names, packing.values):
        check_finite(f"{name} of laplace", value)
    x = copied(x)
    vector = packing.pack(x)
    covariance = PriorCovariance(prior, prior_root, packing)
    mean = _mean(prior_mean, packing)

    hessian = _hessian(misfit, packing, vector, rank)
    with np.errstate(over="ignore", invalid="ignore"):  # a Hessian that is not finite raises NonFiniteError
        if hessian.jacobian is not None:
            pairs = eigenpairs_of_jacobian(hessian.jacobian, covariance, tolerance)
        else:
            pairs = eigenpairs_of_products(hessian.product, covariance, rank, tolerance, seed)
    if hessian.squares is None and np.any(hessian.gradient) and not pairs.values.size and pairs.neglected == 0:
        warnings.warn(LINEAR, PosteriorWarning, stacklevel=frames_inside() + 1)
    if not pairs.is_complete:
        reason = f"there are more than rank={rank}"
        advice = "increase rank"
        if pairs.lost_in_rounding:
            reason = "they are below the rounding errors of the largest one"
            advice = "give data with larger standard deviations, or a prior with smaller ones"
        message = NOT_COMPLETE.format(pairs.neglected, reason, 1 + pairs.neglected, advice)
        warnings.warn(message, PosteriorWarning, stacklevel=frames_inside() + 1)
    with np.errstate(over="ignore", invalid="ignore"):  # far from the mode the information gain is infinite
        posterior = Posterior(
            x=x,
            pairs=pairs,
            prior=covariance,
            packing=packing,
            gradient=hessian.gradient,
            offset=vector - mean,
            squares=hessian.squares,
            seconds=perf_counter() - started,
        )
    if posterior.shift > LARGEST_SHIFT:
        warnings.warn(NOT_AT_MODE.format(posterior.shift), PosteriorWarning, stacklevel=frames_inside() + 1)
    return posterior


def _mean(prior_mean, packing):
    """Return the prior mean as a flat vector."""
    if np.ndim(prior_mean) == 0 and not isinstance(prior_mean, dict):
        return np.full(packing.size, check_number("prior_mean of laplace", prior_mean))
    entries = packing.variables(prior_mean, "prior_mean", shapes=False)
    for name, value, entry in zip(packing.names_under("prior_mean"), packing.values, entries):
        if np.shape(entry) != value.shape:
            raise ShapeError(f"{name} must have shape {value.shape}, got {np.shape(entry)}; write a tree like x")
        check_finite(name, entry)
    return packing.pack(prior_mean)


class _Hessian(NamedTuple):
    """The Hessian of the misfit at a point: its Jacobian if that is small, and its products otherwise.

    Attributes
    ----------
    gradient : (n,) array
        Of the misfit.
    squares : array or None
        The squared residuals.
    jacobian : (m, n) array or None
    product : callable or None
        ``product(rows)`` returns H times each row.
    """

    gradient: NDArray
    squares: NDArray | None
    jacobian: NDArray | None = None
    product: Callable[[NDArray], NDArray] | None = None


def _hessian(misfit, packing, vector, rank):
    """Return the Hessian of the misfit: the Gauss-Newton one for residuals, the full one for one number."""
    value = misfit(packing.unpack(vector))
    backend_of([value]).check("a misfit of laplace")
    if not is_field(value):
        raise DerivativeError(
            f"the misfit must return an array of residuals or one number, got {type(value).__name__}; write "
            "np.concatenate of its flattened parts"
        )
    if np.ndim(value) == 0:
        return _hessian_of_loss(misfit, packing, vector)
    count = np.size(value)
    if count == 0 or packing.size == 0:
        return _Hessian(np.zeros(packing.size), None, jacobian=np.zeros((count, packing.size)))
    # A Jacobian with few rows is about as large as the eigenvectors; one with few columns may be much larger.
    is_small = min(count, packing.size) <= rank and (count <= packing.size or count * packing.size <= MOST_ENTRIES)
    linearization = Linearization(misfit, packing, vector, dense=is_small)
    gradient = linearization.vjp(linearization.flat)
    with np.errstate(over="ignore"):  # the mean square is infinite then
        squares = linearization.flat**2
    if is_small:
        return _Hessian(gradient, squares, jacobian=linearization.jacobian())

    def product(rows):
        return np.array([linearization.vjp(linearization.jvp(row)) for row in rows]).reshape(rows.shape)

    return _Hessian(gradient, squares, product=product)


def _hessian_of_loss(loss, packing, vector):
    """Return the Hessian of a loss; its gradient is recorded once, so that each product is one backward pass."""

    def flat_gradient(x):
        value, gradient = value_and_grad(loss)(x)
        check_loss(value)
        return packing.traced(gradient)

    gradient, pull = pullback(flat_gradient, packing.unpack(vector))
    check_finite("the gradient of the misfit", gradient)

    def product(rows):
        return np.array([packing.pack_gradient(pull(row.astype(gradient.dtype))) for row in rows]).reshape(rows.shape)

    return _Hessian(np.asarray(gradient, float), None, product=product)
