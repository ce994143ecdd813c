"""Norms of arrays, and their scaling by powers of two, which is exact.

Sums of squares are taken block by block: a block that was read for one sum is in the cache for the next, and BLAS does
not wake its threads, which would stall those of compiled kernels.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from sparsedp._utils.validation import BLOCK

__all__ = [
    "LARGE",
    "SMALL",
    "dot",
    "exponent_of",
    "in_range",
    "inverted",
    "largest",
    "length",
    "norm",
    "remainder",
    "shifted",
]

# Between these norms of the data, squares and products in a solve stay in the range of floats.
SMALL = 2.0**-200
LARGE = 2.0**200
LARGEST_POWER = 1000  # exponents below it have a power of two that is a normal float


def dot(x: Any, y: Any) -> Any:
    """Return the sum of the products of the entries of two flat arrays, without conjugation."""
    if x.size <= BLOCK or not isinstance(x, np.ndarray):
        return x @ y
    total = 0.0
    for start in range(0, x.size, BLOCK):
        total = total + x[start : start + BLOCK] @ y[start : start + BLOCK]
    return total


def norm(x: Any) -> float:
    """Return the 2-norm of a flat array, in one pass.

    Squares may leave the range of floats, unlike those of `pytree.norm`: the caller tests with `in_range`, and scales.
    """
    if x.size <= BLOCK or not isinstance(x, np.ndarray):
        return sqrt(np.vdot(x, x).real)
    squares = 0.0
    for start in range(0, x.size, BLOCK):
        part = x[start : start + BLOCK]
        squares += np.vdot(part, part).real
    return sqrt(squares)


def length(x: Any) -> float:
    """Return the 2-norm of a flat real array of any magnitude; of a distributed field, the norm of all its entries."""
    size = norm(x)
    if in_range(size):
        return size
    exponent = exponent_of(np.max(np.abs(x), initial=0.0))
    return float(np.ldexp(norm(shifted(x, -exponent)), exponent))


def remainder(b: np.ndarray, out: np.ndarray, x: np.ndarray) -> tuple[float, float]:
    """Write b - out into `out`, and return its norm and the norm of x; all arrays are flat."""
    residual_squares = 0.0
    solution_squares = 0.0
    with np.errstate(over="ignore", invalid="ignore"):  # the caller tests for NaN and infinity
        if b.size <= BLOCK:
            np.subtract(b, out, out=out)
            return norm(out), norm(x)
        for start in range(0, b.size, BLOCK):
            block = slice(start, start + BLOCK)
            residual = out[block]
            solution = x[block]
            np.subtract(b[block], residual, out=residual)
            residual_squares += np.vdot(residual, residual).real
            solution_squares += np.vdot(solution, solution).real
    return sqrt(residual_squares), sqrt(solution_squares)


def exponent_of(size: Any) -> int:
    """Return the exponent of the smallest power of two above a size."""
    return int(np.frexp(size)[1])


def in_range(size: float) -> bool:
    """Return whether a norm is finite, not 0, and far from both ends of the range of floats."""
    return SMALL < size < LARGE


def largest(x: np.ndarray) -> float:
    """Return the largest magnitude of a real or imaginary part; NaN if there is one."""
    values = x
    if x.dtype.kind == "c":
        values = _real_and_imaginary(x)
    top = float(values.max(initial=0.0))
    if np.isnan(top):
        return top
    return max(top, -float(values.min(initial=0.0)))


def shifted(x: np.ndarray, exponent: Any) -> np.ndarray:
    """Return x * 2^exponent as a fresh array: exact unless it leaves the range of floats.

    `exponent` is one integer, or one for each entry.
    """
    if x.dtype.kind == "c":
        if np.ndim(exponent):
            exponent = np.repeat(exponent, 2, axis=-1)
        return shifted(_real_and_imaginary(x), exponent).view(complex).reshape(x.shape)
    with np.errstate(over="ignore", under="ignore"):  # the caller tests for overflow
        if np.max(np.abs(exponent)) < LARGEST_POWER:
            return x * 2.0**exponent
        return np.ldexp(x, exponent)


def _real_and_imaginary(x: np.ndarray) -> np.ndarray:
    """Return real and imaginary parts in turn along the last axis; a 0-d array becomes an array of two."""
    return np.ascontiguousarray(x).view(float)


def inverted(values: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return 1 / values, and 0 where they are 0: the generalised inverse of a diagonal."""
    if out is None:
        out = np.empty_like(values)
    out[...] = 0.0
    return np.divide(1.0, values, out=out, where=values != 0)
