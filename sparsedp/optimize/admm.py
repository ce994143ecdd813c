"""Losses with a sparsity term, loss(x) + weight |K x|_1, by the alternating direction method of multipliers (ADMM)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import described, flatten, is_branch, labels, norm, paired
from sparsedp._utils.validation import check_function, check_number, check_shape, check_whole
from sparsedp.autodiff.derivative import pullback
from sparsedp.optimize.result import Minimum, Record

__all__ = ["ADMM"]

IMBALANCE = 10.0  # the penalty rho changes when one residual is more than this many times the other
PENALTY_FACTOR = 2.0  # factor by which rho is multiplied or divided
ADAPTIVE_ITERATIONS = 50  # rho is constant after this number of iterations, which the convergence theory requires
INNER_TOLERANCE = 1e-6  # tolerance of the minimization over x in each iteration


class Iteration(NamedTuple):
    """The result of one ADMM iteration.

    Attributes
    ----------
    x : tree
    image : array
        The product K x.
    primal, dual : float
        Norms of the primal residual K x - z and of the dual residual rho K^T (z - z_before). The primal norm is divided
        by max(|K x|, |z|), the dual norm by |rho K^T w|.
    """

    x: Any
    image: Any
    primal: float
    dual: float


@dataclass
class ADMM:
    """The method "admm" of `minimize`: minimize loss(x) + weight |K x|_1 by ADMM.

    Parameters
    ----------
    weight : float
        Factor of the 1-norm, which is the plain sum of absolute entries (not an integral over the grid). Required.
    operator : callable, optional
        The linear map K from x to an array. Default: the identity; x must then be a single array.
    rho : float, optional
        Initial penalty parameter. Default: weight divided by the mean absolute entry of K x at the start, so that the
        first threshold equals that mean.
    inner : int or callable
        Number of L-BFGS iterations for the minimization over x in each ADMM iteration. Or a function
        ``inner(target, rho, x)`` that returns the minimizer of loss(x) plus rho / 2 times the sum of (K x - target)^2.
    prox : callable, optional
        Proximal map ``prox(v, t)`` that replaces the soft threshold. The reported values then contain the loss only,
        because the penalty that belongs to this map is unknown.

    Notes
    -----
    With the auxiliary variable z for K x and the scaled multiplier w, each iteration computes

        x = argmin loss(x) + rho / 2 |K x - z + w|^2,    z = prox(K x + w, weight / rho),    w = w + K x - z,

    where prox is the soft threshold sign(v) max(|v| - t, 0), the proximal map of the 1-norm. The primal residual
    K x - z and the dual residual rho K^T (z - z_before) are measured relative to the terms that they consist of, so
    that the units of the loss do not matter. rho is adapted during the first iterations so that both residuals decrease
    at a similar rate. The run has converged when both are at most the tolerance.

    References
    ----------
    S. Boyd, N. Parikh, E. Chu, B. Peleato, J. Eckstein, Distributed optimization and statistical learning via the
    alternating direction method of multipliers, Foundations and Trends in Machine Learning 3, 2011; B. Wohlberg, ADMM
    penalty parameter selection by residual balancing, arXiv:1704.06209, 2017 (relative residuals).
    """

    name: ClassVar[str] = "admm"
    weight: float | None = None
    operator: Callable[[Any], Any] | None = None
    rho: float | None = None
    inner: int | Callable[[Any, float, Any], Any] = 10
    prox: Callable[[Any, float], Any] | None = None

    def __post_init__(self) -> None:
        if self.weight is None:
            raise TypeError("admm needs the weight of the sum of absolute values; write weight=0.1")
        check_number("weight of admm", self.weight, "> 0", "; write weight=0.1")
        if self.rho is not None:
            check_number("rho of admm", self.rho, "> 0", "; write rho=0.1")
        if not callable(self.inner):
            check_whole("inner of admm, steps or a function,", self.inner, 1, "; write inner=10")
        if self.operator is not None:
            check_function("admm, as operator,", self.operator, "lambda x: ...")
        if self.prox is not None:
            check_function("admm, as prox,", self.prox, "lambda v, t: ...")

    def minimize(
        self,
        loss: Callable[[Any], Any],
        start: Any,
        maxiter: int,
        tolerance: Any,
        callback: Callable[[Record, Any], Any] | None,
        bounds: Any,
        minimize_smooth: Callable[..., Minimum],
    ) -> Minimum:
        """Minimize the loss plus the sparsity term.

        Parameters
        ----------
        loss, start, maxiter, tolerance, callback, bounds
            As for `minimize`.
        minimize_smooth : callable
            The function `minimize`, which solves the smooth problem for x in each iteration.

        Returns
        -------
        Minimum
        """
        if callable(self.inner) and bounds is not None:
            raise TypeError("admm with a function as inner does not use bounds; leave them out, or apply them in inner")
        if self.operator is None and is_branch(start):
            raise TypeError(
                f"admm without operator= takes one array as start, got {described(start)}; write the linear map from "
                f"the start to an array, for example operator=lambda x: {labels(start, 'x')[0]}"
            )
        run = _Run(self, loss, start, bounds, minimize_smooth)
        message = f"stopped after {maxiter} iterations, the limit maxiter"
        converged = False
        run.record(run.x, run.z, np.inf)
        try:
            for number in range(maxiter):
                result = run.advance(number)
                record = run.record(result.x, result.image, result.primal)
                if callback is not None and callback(record, result.x):
                    message = "stopped by the callback"
                    break
                if max(result.primal, result.dual) <= tolerance:
                    message = f"converged: both residuals are below {tolerance:g} of their terms"
                    converged = True
                    break
        except KeyboardInterrupt:
            message = "interrupted"
        return Minimum(
            x=run.recorded_x,
            value=run.history[-1].value,
            history=tuple(run.history),
            method=self.name,
            message=message,
            converged=converged,
            evaluations=run.evaluations,
        )


class _Run:
    """The iterates and the history of one run."""

    def __init__(self, options, loss, start, bounds, minimize_smooth):
        self._loss = loss
        self._start = start
        self._bounds = bounds
        self._minimize_smooth = minimize_smooth
        self._inner = options.inner
        self._weight = options.weight
        self._operator = _identity if options.operator is None else options.operator
        self._prox = options.prox
        self._penalized = options.weight
        if options.prox is None:
            self._prox = soft_threshold
        else:
            self._penalized = 0.0  # the function that belongs to the user's proximal map is unknown
        self._start_time = time.perf_counter()
        self._start_solves = thread.solves
        self.history: list[Record] = []
        self.evaluations = 0
        self.x = start
        self.recorded_x = start
        self.z = np.asarray(self._operator(start))
        self._w = np.zeros(self.z.shape)
        self._largest = norm(self.z)
        self._rho = options.rho

    def record(self, x, image, residual):
        """Append a record to the history and return it."""
        value = float(self._loss(x)) + self._penalized * float(np.sum(np.abs(image)))
        seconds = time.perf_counter() - self._start_time
        solves = thread.solves - self._start_solves
        record = Record(len(self.history), value, residual, seconds, self.evaluations, (), solves)
        self.history.append(record)
        self.recorded_x = x
        return record

    def advance(self, number):
        """Perform iteration `number` and return its result."""
        if self._rho is None:
            self._rho = self._first_rho()
        rho = self._rho
        if not 0 < rho < np.inf:
            raise ValueError(
                f"rho of admm, the weight divided by the size of K x, is {rho:g} here; rescale x or write rho="
            )
        if callable(self._inner):
            self.x = self._minimized_by_user(self.z - self._w, rho)
            evaluations = 1
        else:
            self.x, evaluations = self._minimized_by_lbfgs(self.z - self._w, rho)
        image, pull = pullback(self._operator, self.x)
        check_shape("the result of the operator of admm", image, self.z.shape, "; it must not change from call to call")
        z_before = self.z
        self.z = self._prox(image + self._w, self._weight / rho)
        self._w = self._w + image - self.z
        self._largest = max(self._largest, norm(image))
        if np.any(self.z):
            size = max(norm(image), norm(self.z))
        else:  # z is 0, and K x may converge to 0 too: compare with an earlier K x or with the multiplier instead
            size = min(self._largest, norm(self._w))
        primal = norm(image - self.z) / (size or 1.0)
        dual = norm(pull(np.conj(self.z - z_before))) / (norm(pull(np.conj(self._w))) or 1.0)
        self._balance(number, primal, dual)
        self.evaluations += evaluations
        return Iteration(self.x, image, primal, dual)

    def _first_rho(self):
        """Return the initial rho, weight / mean |K x| at the start; the mean is replaced by 1 if it is 0."""
        with np.errstate(over="ignore"):  # `advance` raises ValueError for an infinite rho
            return float(self._weight / np.float64(np.mean(np.abs(self.z)) or 1.0))

    def _balance(self, number, primal, dual):
        """Change rho for the next iteration if one residual is much larger than the other."""
        if number >= ADAPTIVE_ITERATIONS or max(primal, dual) <= IMBALANCE * min(primal, dual):
            return
        factor = PENALTY_FACTOR if primal > dual else 1 / PENALTY_FACTOR
        self._rho = self._rho * factor
        self._w = self._w / factor

    def _minimized_by_lbfgs(self, target, rho):
        """Minimize over x, starting from the previous x. Return the new x and the number of loss evaluations."""
        root = np.sqrt(rho)

        def augmented_loss(x):
            difference = root * (self._operator(x) - target)
            return self._loss(x) + 0.5 * anp.sum(anp.real(difference * anp.conj(difference)))

        best = self._minimize_smooth(
            augmented_loss, self.x, maxiter=self._inner, bounds=self._bounds, tolerance=INNER_TOLERANCE
        )
        if best.message == "interrupted":
            raise KeyboardInterrupt
        return best.x, best.evaluations

    def _minimized_by_user(self, target, rho):
        """Return the new x computed by the user's function, with dict entries in the same order as in the start."""
        x = self._inner(target, rho, self.x)
        entries = paired(x, self._start, "inner(target, rho, x)", advice="; return a tree like start")
        return flatten(self._start)[1](entries)


def soft_threshold(v: Any, t: float) -> Any:
    """Return, elementwise, the minimizer over z of t |z| + |z - v|^2 / 2. Real or complex."""
    size = np.abs(v)
    return v / np.where(size > 0, size, 1.0) * np.maximum(size - t, 0.0)


def _identity(x):
    """Return x as an array; a scalar that autograd traces keeps its derivative."""
    return 1.0 * x
