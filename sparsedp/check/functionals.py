"""Functionals sum(w * f(x)) of a program. They are the losses by which its derivative is audited.

All functionals share the runs of the program: it runs once for each point, and all functionals of its value are stored.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.pytree import norm
from sparsedp.check.evaluations import EVALUATION_ERRORS, Evaluations
from sparsedp.check.point import Point
from sparsedp.check.programs import Program

__all__ = ["FunctionalEvaluations", "Functionals", "Pullback", "balanced_weights", "leaf_weights"]


SMALLEST_SIZE = 1e-280  # weights relative to smaller values could overflow
NOISY_EPS = 100.0  # an entry with more noise than this multiple of its rounding error has a smaller share


class FunctionalEvaluations(Evaluations):
    """Evaluations of a functional. The gradient under test is a function of a tree that returns a vector."""

    coarser_steps = ()  # a bounded function looks constant for steps that are much larger than x

    def gradient_at(self, tree: Any) -> NDArray[Any]:
        """Return the gradient under test as a vector."""
        return self.gradient(tree)

    def at(self, point: Point) -> Evaluations:
        """Return evaluations of the same functional and gradient at another point, with the default steps."""
        return FunctionalEvaluations(self.loss, point, self.gradient)


@dataclass
class Functional:
    """One of some functionals, as a function of a tree."""

    functionals: Any
    number: int

    def __call__(self, tree: Any) -> float:
        """Return the functional at a tree."""
        return self.functionals.values(tree)[self.number]


@dataclass
class Pullback:
    """The gradient of a functional by the VJP under test, as a function of a tree that returns a vector."""

    program: Program
    weights: NDArray[Any]

    def __call__(self, tree: Any) -> NDArray[Any]:
        """Return the gradient at a tree."""
        return self.program.pull(tree, self.weights)


class Functionals:
    """Functionals of a program around a point.

    Parameters
    ----------
    program : Program
    point : Point
    base : ndarray
        The value of the program at the point.
    weights : list of ndarray
        One vector for each functional.

    Notes
    -----
    The functional is c + sum(w * (f(x) - base)), where c is the norm of w * base. It has the derivative of
    sum(w * f(x)), and its rounding error relative to its value is that of the entries of f(x): terms of sum(w * base)
    that cancel do not make it smaller.
    """

    def __init__(self, program: Program, point: Point, base: NDArray[Any], weights: Sequence[NDArray[Any]]) -> None:
        self.program = program
        self.point = point
        self.base = base
        self.weights = [*weights]
        self.constants = [norm(weight * base) for weight in self.weights]
        self._stored: dict[bytes, list[float] | Exception] = {}
        self.store(point.fresh(), base)

    def _key(self, tree: Any) -> bytes:
        """Return a short key of a tree."""
        return hashlib.blake2b(self.point.pack(tree).tobytes(), digest_size=16).digest()

    def store(self, tree: Any, value: NDArray[Any]) -> list[float]:
        """Store and return all functionals of the value of the program at a tree."""
        with np.errstate(all="ignore"):
            change = value - self.base
            pairs = zip(self.weights, self.constants, strict=True)
            values = [float(constant + weight @ change) for weight, constant in pairs]
        self._stored[self._key(tree)] = values
        return values

    def values(self, tree: Any) -> list[float]:
        """Return all functionals at a tree. The program runs if it has not run there before."""
        key = self._key(tree)
        if key not in self._stored:
            try:
                return self.store(tree, self.program.value(tree))
            except EVALUATION_ERRORS as error:
                self._stored[key] = error
        values = self._stored[key]
        if isinstance(values, Exception):
            raise values
        return values

    def evaluations(
        self, number: int, slopes: NDArray[Any], gradient: Callable[[Any], Any] | None, like: Evaluations
    ) -> FunctionalEvaluations:
        """Return the evaluations of a functional.

        Parameters
        ----------
        number : int
        slopes : ndarray
            Its gradient at the point by the derivative under test.
        gradient : callable or None
            The gradient under test as a function of a tree.
        like : Evaluations
            Steps, tolerances, precision and names are copied from these evaluations.
        """
        evaluations = FunctionalEvaluations(Functional(self, number), self.point, gradient, like.steps)
        evaluations.may_extend = like.may_extend
        evaluations.base = self.constants[number]
        evaluations.slopes = slopes
        evaluations.solved = like.solved
        evaluations.tolerance = like.tolerance
        evaluations.step_tolerance = like.step_tolerance
        evaluations.noise = like.noise
        evaluations.eps = like.eps
        evaluations.loss_name = like.loss_name
        evaluations.gradient_name = like.gradient_name
        evaluations.digits_needed = like.digits_needed
        return evaluations


def leaf_weights(program: Program, base: NDArray[Any], change: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """Return random weights with which all leaves of the result have about the same share of the functional."""
    weights = rng.standard_normal(base.size)
    for weight, *parts in zip(*(program.result.split(vector) for vector in (weights, base, change))):
        size = max(norm(part) for part in parts) / max(weight.size, 1) ** 0.5
        weight /= max(size, SMALLEST_SIZE) if size else 1.0
    return program.rounded(weights)


def balanced_weights(
    program: Program, base: NDArray[Any], change: NDArray[Any], noise: NDArray[Any], rng: np.random.Generator
) -> NDArray[Any]:
    """Return random weights with which all entries of the result have about the same share of the functional.

    An error of a small entry is then as visible as that of a large one. An entry that consists of rounding errors has a
    small share.
    """
    sizes = np.where(base == 0, np.abs(change), np.abs(base))
    sizes = np.maximum(sizes, noise / (NOISY_EPS * program.result.eps))
    typical = np.median(sizes[sizes > 0]) if np.any(sizes) else 1.0
    sizes = np.where(sizes > 0, sizes, typical)
    weights = rng.choice([-1.0, 1.0], base.size) * rng.uniform(0.5, 1.5, base.size)
    return program.rounded(weights * (np.min(sizes, initial=np.inf) / sizes))
