"""Posterior: the normal distribution that `laplace` returns."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.base_classes import Frozen
from sparsedp._utils.calls import frames_inside
from sparsedp._utils.html import facts
from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_finite, check_function, check_whole
from sparsedp.autodiff.derivative import pullback
from sparsedp.errors import DerivativeError, PosteriorWarning
from sparsedp.grid.space import Space
from sparsedp.operators.given import from_functions
from sparsedp.operators.operator import Operator
from sparsedp.optimize.misfit_eigenpairs import RESCALE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing
    from sparsedp.optimize.misfit_eigenpairs import MisfitEigenpairs
    from sparsedp.optimize.prior_covariance import PriorCovariance

__all__ = ["Posterior"]

SHOWN = 8  # eigenvalues in the table
SMALLEST = np.finfo(float).tiny
CORRELATION = 1.5  # factor of the standard error of a mean, because the corrections are not independent
INACCURATE = 0.1  # root mean square of the relative standard errors of variances above which a warning is issued
NOT_ACCURATE = "variances have a standard error of {:.0f} % with probes={}; increase probes"


class Posterior(Frozen):
    """The posterior of `laplace`: a normal distribution with mean x. Immutable.

    Attributes
    ----------
    x : tree
        The mean.
    eigenvalues : (k,) array
        The eigenvalues lambda of the Hessian of the misfit in the metric of the prior, in descending order. Data reduce
        the variance along an eigenvector by the factor 1 / (1 + lambda).
    neglected : float
        Estimate of the largest neglected eigenvalue. Variances are too large by at most the factor 1 + neglected.
    error : float
        Bound on the relative error of all variances, if the prior variances are exact: the sum of `neglected` and of
        the residuals of the eigenpairs.
    information_gain : float
        Kullback-Leibler divergence of the posterior from the prior [nat]. With the gradient g of the misfit at the mode
        x it is (sum of (log(1 + lambda) - lambda / (1 + lambda)) + g^T C g) / 2, where g^T C g is the squared distance
        of x from the prior mean in the metric C^-1.
    expected_information_gain : float
        The expectation of the information gain over data [nat] if the residuals are linear in x, half of the sum of
        log(1 + lambda).
    shift : float
        The distance from x to the mode of the quadratic model of the posterior, in posterior standard deviations: the
        largest component along an eigenvector or, if that is larger, the root mean square of the remainder of a leaf.
    step : tree
        The Newton step -(H + C^-1)^-1 (g + C^-1 (x - mean)) from x to this mode. If the residuals are linear in x,
        x + step is the mode.
    mean_square, expected_mean_square : float or None
        The mean square of the m residuals at x, and its expectation over data if the residuals are linear in x and x is
        the mode, 1 - (sum of lambda / (1 + lambda)) / m. If they differ much, the residuals may not have been divided
        by the standard deviation of the noise, or the prior is too narrow. None for a loss, and without residuals.
    products : int
        Number of products with the Hessian, or with the Jacobian if it was computed.
    seconds : float
    covariance : Operator
        The covariance (H + C^-1)^-1 as an Operator for the array x, or for the flattened x of a tree.
    """

    x: Any
    eigenvalues: NDArray[np.float64]
    neglected: float
    error: float
    information_gain: float
    expected_information_gain: float
    shift: float
    step: Any
    mean_square: float | None
    expected_mean_square: float | None
    products: int
    seconds: float
    _mean: NDArray[np.float64]
    _pairs: MisfitEigenpairs
    _prior: PriorCovariance
    _packing: Packing
    attribute_suggestions = {
        "mean": "posterior.x",
        "cov": "posterior.covariance, an Operator",
        "std": "posterior.std_of(lambda x: x), or np.sqrt(posterior.variance())",
        "samples": "posterior.sample(count, seed)",
    }

    def __init__(
        self,
        x: Any,
        pairs: MisfitEigenpairs,
        prior: PriorCovariance,
        packing: Packing,
        gradient: NDArray,
        offset: NDArray,
        squares: NDArray | None,
        seconds: float,
    ) -> None:
        values = pairs.values
        preconditioned = prior.apply(gradient[None])[0]
        divergence = np.log1p(values) - values / (1 + values)
        step, shift = _newton_step(offset + preconditioned, pairs, prior)
        super().__init__(
            x=x,
            eigenvalues=values.copy(),
            neglected=pairs.neglected,
            error=pairs.neglected + pairs.residual,
            information_gain=0.5 * float(np.sum(divergence) + max(_product(gradient, preconditioned), 0.0)),
            expected_information_gain=0.5 * float(np.sum(np.log1p(values))),
            shift=shift,
            step=_tree(packing, step),
            **_mean_squares(squares, values),
            products=pairs.products,
            seconds=seconds,
            _mean=packing.pack(x),
            _pairs=pairs,
            _prior=prior,
            _packing=packing,
        )

    @cached_property
    def covariance(self) -> Operator:
        """The covariance as an Operator."""
        values = self._packing.values
        space = Space(values[0].shape if len(values) == 1 else self._packing.size)
        block = self._prior.blocks[0]
        if len(values) == 1 and isinstance(block.covariance, Operator) and block.covariance.domain.shape == space.shape:
            space = block.covariance.domain
        apply = partial(_covariance_of_field, self._pairs, self._prior)
        return from_functions(apply, apply, space, space, name="posterior covariance")

    def variance(self, probes: int = 200) -> Any:
        """Return the variance of each entry of x.

        Parameters
        ----------
        probes : int
            Number of random vectors with which prior variances are estimated where they are not known exactly.

        Returns
        -------
        tree like x
            Float64 arrays in the squared units of x, and None in place of constants.

        Warns
        -----
        PosteriorWarning
            If the standard error of estimated variances is above 10 % of them (root mean square).

        Notes
        -----
        Prior variances are exact for numbers, diagonals, sparse matrices, functions of separable operators, and up to
        1024 unknowns. Otherwise the diagonal of C - sum of v v^T is estimated by the XDiag method, with 2 `probes`
        products with C. See `variance_error`.

        References
        ----------
        E. N. Epperly, J. A. Tropp, R. J. Webber, XTrace: making the most of every sample in stochastic trace
        estimation, SIAM J. Matrix Anal. Appl. 45, 2024.
        """
        probes = check_whole("probes of variance", probes, 2, "; the default is 200")
        return _tree(self._packing, self._variances(probes)[0])

    def variance_error(self, probes: int = 200) -> Any:
        """Return the standard error of each entry of ``variance(probes)``, a tree like it; 0 for exact entries."""
        probes = check_whole("probes of variance_error", probes, 2, "; the default is 200")
        return _tree(self._packing, self._variances(probes)[1])

    def _variances(self, probes):
        """Return the variances and their standard errors as flat vectors."""
        if probes not in self._known_variances:
            self._known_variances[probes] = self._computed_variances(probes)
        variances, errors = self._known_variances[probes]
        if np.any(errors):
            relative = np.sqrt(np.mean((errors / np.maximum(variances, SMALLEST)) ** 2))
            if relative > INACCURATE:
                message = NOT_ACCURATE.format(100 * relative, probes)
                warnings.warn(message, PosteriorWarning, stacklevel=frames_inside() + 1)
        return variances, errors

    @cached_property
    def _known_variances(self):
        """The variances and their errors by the number of probes."""
        return {}

    def _computed_variances(self, probes):
        """Return the variances and their standard errors: sum of v v^T / (1 + lambda), plus C - sum of v v^T."""
        vectors = self._pairs.vectors
        informed = np.sum(vectors**2 / (1 + self._pairs.values)[:, None], axis=0)
        # The variance that the data do not reduce, C - sum of v v^T, is 0 if there is an eigenpair for each unknown.
        others = np.zeros(self._prior.size)
        errors = np.zeros(self._prior.size)
        if len(vectors) < self._prior.size:
            for block in self._prior.blocks:
                part = block.part
                diagonal = block.diagonal
                if diagonal is None and block.size <= probes:
                    diagonal = np.diagonal(block.columns())
                if diagonal is not None:
                    others[part] = diagonal - np.sum(vectors[:, part] ** 2, axis=0)
                else:
                    others[part], errors[part] = _estimated_diagonal(block, vectors[:, part], probes)
        return informed + np.maximum(others, 0.0), errors

    def std_of(self, quantity: Callable[[Any], Any]) -> Any:
        """Return the standard deviation of a quantity that is computed from x.

        Parameters
        ----------
        quantity : callable
            ``quantity(x)`` returns a real number or an array, differentiable. It is replaced by its linearization at x
            (delta method).

        Returns
        -------
        float or array
            In the shape and the units of the quantity: sqrt(g^T (H + C^-1)^-1 g) for each entry, where its gradient g
            takes one backward pass, and the variance one product with C.

        Raises
        ------
        DerivativeError
            If the quantity is complex, or has integer or boolean values.
        NonFiniteError
            If the quantity is NaN or infinite.
        """
        check_function("std_of", quantity, "lambda x: np.mean(x)")
        value, pull = pullback(quantity, self._packing.unpack(self._mean))
        if np.iscomplexobj(value):
            raise DerivativeError("std_of takes a real quantity, got a complex one; take its real part")
        if np.asarray(value).dtype.kind in "biu":
            raise DerivativeError(
                f"std_of takes a differentiable quantity, got dtype {np.asarray(value).dtype}; return floating numbers"
            )
        check_finite("the quantity of std_of", value)
        deviations = np.zeros(np.size(value))
        for number in range(deviations.size):
            cotangent = np.zeros(deviations.size, np.asarray(value).dtype)
            cotangent[number] = 1
            gradient = self._packing.pack_gradient(pull(cotangent.reshape(np.shape(value))))
            unit = power_of_two(norm(gradient))  # squares of very large or small gradients are not representable
            deviations[number] = unit * np.sqrt(self._variance_along(gradient / unit))
        deviations = deviations.reshape(np.shape(value))
        return float(deviations) if deviations.ndim == 0 else deviations

    def _variance_along(self, gradient):
        """Return g^T (H + C^-1)^-1 g."""
        components = self._pairs.vectors @ gradient
        informed = np.sum(components**2 / (1 + self._pairs.values))
        if len(components) == self._prior.size:
            return informed
        others = gradient @ self._prior.apply(gradient[None])[0] - np.sum(components**2)
        return informed + max(others, 0.0)

    def sample(self, count: int, seed: int = 0) -> list:
        """Return samples of the posterior.

        Parameters
        ----------
        count : int
        seed : int
            The same seed gives the same samples.

        Returns
        -------
        list of trees like x

        Raises
        ------
        ConvergenceError
            If the square root of the prior is computed by a Lanczos iteration that does not converge. Then give
            `prior_root`.
        """
        count = check_whole("count of sample", count, 0)
        seed = check_whole("seed of sample", seed, 0, "; the default is 0")
        rows = self._prior.samples(np.random.default_rng(seed), count)
        components = rows @ self._pairs.duals.T
        vectors = self._pairs.vectors
        if len(vectors) == self._prior.size:
            deviations = (components / np.sqrt(1 + self._pairs.values)) @ vectors
        else:
            deviations = rows - (components * _reduction(self._pairs.values)) @ vectors
        return [self._packing.unpack(self._mean + deviation) for deviation in deviations]

    def __str__(self):
        lines = [f"{name + ':':42}{text}" for name, text in self._facts().items()]
        return "\n".join(["posterior of laplace", *lines])

    __repr__ = __str__

    def _repr_html_(self):
        """Return HTML for notebooks."""
        return facts("posterior of laplace", self._facts())

    def _facts(self):
        """Return the entries of the table as a dict of texts."""
        values = self.eigenvalues
        shown = ", ".join(f"{value:.3g}" for value in values[:SHOWN])
        if len(values) > SHOWN:
            shown += f", ..., {values[-1]:.3g}"
        entries = {
            "unknowns": str(self._prior.size),
            "eigenvalues": f"{len(values)}: {shown}" if len(values) else "0",
            "largest neglected eigenvalue, about": f"{self.neglected:.2g}",
            "variances are too large by at most": f"{100 * self.error:.2g} %",
            "information gain": f"{self.information_gain:.4g} nat",
            "expected information gain": f"{self.expected_information_gain:.4g} nat",
            "distance of x from the mode": f"{self.shift:.1e} standard deviations",
        }
        if self.mean_square is not None:
            expected = f"({self.expected_mean_square:.3g} is expected)"
            entries["mean square of the residuals"] = f"{self.mean_square:.3g} {expected}"
        entries["prior variances"] = "exact"
        if any(block.diagonal is None for block in self._prior.blocks):
            entries["prior variances"] = "estimated, see variance_error()"
        entries[self._pairs.kind] = str(self.products)
        entries["seconds"] = f"{self.seconds:.2f}"
        return entries


def _product(u, v):
    """Return u . v, in which the squares of large and small numbers do not overflow or underflow."""
    u_unit = power_of_two(norm(u))
    v_unit = power_of_two(norm(v))
    return (u / u_unit) @ (v / v_unit) * u_unit * v_unit


def _mean_squares(squares, values):
    """Return the mean of the squared residuals, and its expected value."""
    if squares is None or not squares.size:
        return {"mean_square": None, "expected_mean_square": None}
    return {
        "mean_square": float(np.mean(squares)),
        "expected_mean_square": 1 - float(np.sum(values / (1 + values))) / squares.size,
    }


def _reduction(values):
    """Return 1 - (1 + lambda)^(-1/2), without cancellation for small lambda."""
    return -np.expm1(-0.5 * np.log1p(values))


def _covariance_of_field(pairs, prior, field):
    """Return the posterior covariance times a field."""
    if np.iscomplexobj(field):
        real = _covariance_of_field(pairs, prior, np.real(field))
        return real + 1j * _covariance_of_field(pairs, prior, np.imag(field))
    vector = np.asarray(field, float).reshape(1, -1)
    components = vector @ pairs.vectors.T
    if len(pairs.values) == prior.size:
        product = (components / (1 + pairs.values)) @ pairs.vectors
    else:
        product = prior.apply(vector) - (components * pairs.values / (1 + pairs.values)) @ pairs.vectors
    return product.reshape(np.shape(field))


def _newton_step(residual, pairs, prior):
    """Return the step to the mode of the quadratic model, and its length in posterior standard deviations.

    Parameters
    ----------
    residual : (n,) array
        C times the gradient of the negative logarithm of the posterior, x - mean + C g.
    pairs : MisfitEigenpairs
    prior : PriorCovariance
    """
    components = pairs.duals @ residual
    lengths = np.abs(components) / np.sqrt(1 + pairs.values)
    shift = np.max(lengths, initial=0.0)
    others = residual - components @ pairs.vectors
    if len(components) == prior.size:
        others = np.zeros_like(residual)
    step = -others - (components / (1 + pairs.values)) @ pairs.vectors
    for block, trace in zip(prior.blocks, prior.traces(), strict=True):
        remaining = trace - np.sum(pairs.vectors[:, block.part] ** 2)
        if remaining > 1e-6 * trace:
            shift = max(shift, norm(others[block.part]) / np.sqrt(remaining))
    check_finite("the distance of x from the mode", step, advice=RESCALE)
    return step, float(shift)


def _estimated_diagonal(block, vectors, probes):
    """Return an estimate of the diagonal of B = C - sum of v v^T, and its standard errors, by the XDiag method.

    With random signs w_i, the estimate is the mean over i of diag(P_i B) + w_i * (B - P_i B) w_i, where P_i projects on
    the span of the products of B with all signs except w_i. The first term is exact, and the second estimates the
    diagonal of the remainder. From B [w_1 ... w_m] = Q R follows P_i = Q (1 - s_i s_i^T) Q^T, where s_i is column i of
    R^-T, normalized.
    """
    signs = np.random.default_rng(3).choice([-1.0, 1.0], (probes, block.size))

    def product(rows):
        return block.apply(rows) - (rows @ vectors.T) @ vectors

    q, r = np.linalg.qr(product(signs).T)
    images = product(np.ascontiguousarray(q.T)).T
    inverse = np.linalg.pinv(r).T
    directions = inverse / np.linalg.norm(inverse, axis=0)
    left_out = q @ directions
    corrections = signs.T * left_out * np.sum(directions * r, axis=0) - left_out * (images @ directions)
    diagonal = np.sum(q * images, axis=1) + np.mean(corrections, axis=1)
    return diagonal, CORRELATION * np.std(corrections, axis=1, ddof=1) / np.sqrt(probes)


def _tree(packing, vector):
    """Return a flat vector as a tree of float64 arrays like x, with None in place of constants."""
    arrays = [part.reshape(value.shape).copy() for part, value in zip(packing.split(vector), packing.values)]
    return packing.build([array if array.ndim else float(array) for array in arrays], [None] * len(packing.statics))
