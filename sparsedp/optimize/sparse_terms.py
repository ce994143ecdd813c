"""Sparse terms: loss(x) + weight |K x|_1 by alternating directions (ADMM).

With z = K x and a scaled multiplier w, each round takes

    x = argmin loss(x) + rho / 2 |K x - z + w|^2,    z = prox(K x + w, weight / rho),    w = w + K x - z,

prox being the soft threshold sign(v) max(|v| - t, 0) of the 1-norm, or what the user gives. rho is balanced so that
both residuals, K x - z and rho K^T (z - z_before), fall alike, each relative to its terms: the units of the loss do not
matter. Converged when both are small.

Source: S. Boyd, N. Parikh, E. Chu, B. Peleato, J. Eckstein, Foundations and Trends in Machine Learning 3 (2011) 1-122;
B. Wohlberg, arXiv:1704.06209 (2017) (relative residuals).
"""

import time
from itertools import count, islice

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import flatten, norm, paired
from sparsedp._utils.validation import check_function, check_number, check_shape, check_whole
from sparsedp.autodiff.derivative import pullback
from sparsedp.optimize.result import Minimum, Record

__all__ = ["admm"]

BALANCE, STEP = 10.0, 2.0  # ratio of the residuals beyond which rho changes by this factor
SETTLED = 50  # rounds after which it stays


def admm(
    search, loss, start, maxiter, tolerance, callback, bounds, weight, operator=None, rho=None, inner=10, prox=None
):
    """The method "admm" of `minimize`, which is `search`: see there."""
    for name, value in (("weight", weight), ("rho", 1.0 if rho is None else rho)):
        check_number(f"{name} of admm", value, "> 0", f"; write {name}=0.1")
    if not callable(inner):
        check_whole("inner of admm, steps or a function,", inner, 1, "; write inner=10")
    if callable(inner) and bounds is not None:
        raise TypeError("admm with a function as inner does not use bounds; leave them out, or keep to them in inner")
    K = (lambda x: 1.0 * x) if operator is None else operator
    penalty = weight if prox is None else 0.0  # what another prox belongs to is not said
    prox = soft_threshold if prox is None else prox
    check_function("admm, as operator,", K, "lambda x: ...")
    check_function("admm, as prox,", prox, "lambda v, t: ...")
    clock, solves, evaluations = time.perf_counter(), thread.solves, 0
    history: list = []
    message, converged = f"stopped after {maxiter} rounds, as maxiter asks", False

    def record(x, image, residual):
        value = float(loss(x)) + penalty * float(np.sum(np.abs(image)))
        now = time.perf_counter() - clock
        history.append(Record(len(history), value, residual, now, evaluations, (), thread.solves - solves))
        return callback is not None and len(history) > 1 and callback(history[-1], x)

    def searched(target, rho, x):
        """The x of a round, from that of the last one, and the evaluations it took."""
        root = np.sqrt(rho)

        def split(x):
            difference = root * (K(x) - target)
            return loss(x) + 0.5 * anp.sum(anp.real(difference * anp.conj(difference)))

        best = search(split, x, maxiter=inner, bounds=bounds, tolerance=1e-6)
        if best.message == "interrupted":
            raise KeyboardInterrupt
        return best.x, best.evaluations

    def given(target, rho, x):
        """The x of a round from the function of the user, in the order of the start."""
        found = paired(inner(target, rho, x), start, "inner(target, rho, x)", advice="; return a tree like start")
        return flatten(start)[1](found), 1

    minimized = given if callable(inner) else searched
    x, first = start, np.asarray(K(start))
    record(x, first, np.inf)
    try:
        for x, spent, image, primal, dual in islice(_rounds(minimized, start, K, first, weight, rho, prox), maxiter):
            evaluations += spent
            if record(x, image, primal):
                message = "stopped by the callback"
                break
            if max(primal, dual) <= tolerance:
                message, converged = f"converged: both residuals are below {tolerance:g} of their terms", True
                break
    except KeyboardInterrupt:
        message = "interrupted"
    return Minimum(
        x=x, value=history[-1].value, history=tuple(history), method="admm", message=message, converged=converged,
        evaluations=evaluations,
    )  # fmt: skip


def soft_threshold(v, t):
    """Return the minimum over z of t |z| + |z - v|^2 / 2, real or complex."""
    size = np.abs(v)
    return v / np.where(size > 0, size, 1.0) * np.maximum(size - t, 0.0)


def _rounds(minimized, x, K, z, weight, rho, prox):
    """Round after round: x, the evaluations it took, K x, and both residuals, relative to their terms."""
    w, largest = np.zeros(z.shape), norm(z)
    if rho is None:  # so that the threshold is a typical entry, or 1 where all are 0
        with np.errstate(over="ignore"):
            rho = float(weight / np.float64(np.mean(np.abs(z)) or 1.0))
    for number in count():
        if not 0 < rho < np.inf:
            raise ValueError(
                f"rho of admm, the weight divided by the size of K x, is {rho:g} here; rescale x or write rho="
            )
        x, spent = minimized(z - w, rho, x)
        image, pull = pullback(K, x)
        check_shape("what the operator of admm gives", image, z.shape, "; it must not change from call to call")
        before, z = z, prox(image + w, weight / rho)
        w = w + image - z
        largest = max(largest, norm(image))
        # Where K x goes to 0 its own size is no measure: that of the terms before, and of the multiplier, are.
        size = max(norm(image), norm(z)) if np.any(z) else min(largest, norm(w))
        primal = norm(image - z) / (size or 1.0)
        dual = norm(pull(np.conj(z - before))) / (norm(pull(np.conj(w))) or 1.0)
        yield x, spent, image, primal, dual
        if number < SETTLED and max(primal, dual) > BALANCE * min(primal, dual):
            factor = STEP if primal > dual else 1 / STEP
            rho, w = rho * factor, w / factor
