"""Sizes of arrays and their scaling by powers of two, which is exact.

Sums of squares are taken block by block: what the first look at a block loads, the second finds in the cache, and BLAS
does not wake its threads for so few numbers: they would stall those of compiled kernels.
"""

import numpy as np

from sparsedp._utils.validation import BLOCK
from sparsedp.autodiff.fast_derivatives import ELSEWHERE

__all__ = [
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

SMALL, LARGE = 2.0**-200, 2.0**200  # norms between which nothing a solve computes leaves the range of floats


def _blocks(*arrays):
    """Parts of flat arrays of one size that belong together; what is small, or lies on ranks, is one part itself."""
    size = arrays[0].size
    if size <= BLOCK or type(arrays[0]) in ELSEWHERE:
        return (arrays,)
    return ([x[i : i + BLOCK] for x in arrays] for i in range(0, size, BLOCK))


def dot(x, y):
    """Sum of the products of the entries of flat arrays."""
    return sum(one @ other for one, other in _blocks(x, y))


def _square(x):
    """Sum of the squares of the magnitudes."""
    return np.vdot(x, x).real


def norm(x):
    """2-norm of a flat array in one pass.

    Squares may leave the range of floats (`tree.norm` does not let them); the caller asks `in_range`, and scales.
    """
    return float(np.sqrt(sum(_square(part) for (part,) in _blocks(x))))


def length(x):
    """2-norm of a flat real array of any magnitude; of a field on ranks, that of all of it."""
    size = norm(x)
    if in_range(size):
        return size
    exponent = exponent_of(np.max(np.abs(x), initial=0.0))
    return float(np.ldexp(norm(shifted(x, -exponent)), exponent))


def remainder(b, out, x):
    """out = b - out, in place -> its norm and that of x. All flat."""
    rest = solution = 0.0
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is found by the caller
        for given, part, values in _blocks(b, out, x):
            np.subtract(given, part, out=part)
            rest, solution = rest + _square(part), solution + _square(values)
    return float(np.sqrt(rest)), float(np.sqrt(solution))


def exponent_of(size):
    """Exponent of the power of two next above a size."""
    return int(np.frexp(size)[1])


def in_range(size):
    """Whether a norm is finite, not 0, and far from both ends of the range of floats."""
    return SMALL < size < LARGE


def largest(x):
    """Largest magnitude of a real or imaginary part; NaN when there is one."""
    x = _real_and_imaginary(x) if x.dtype.kind == "c" else x
    top = float(x.max(initial=0.0))
    return top if np.isnan(top) else max(top, -float(x.min(initial=0.0)))


def shifted(x, exponent):
    """x * 2^exponent, one for all or one for each, exact unless it leaves the range of floats; always a fresh array."""
    if x.dtype.kind == "c":
        each = np.repeat(exponent, 2, axis=-1) if np.ndim(exponent) else exponent
        return shifted(_real_and_imaginary(x), each).view(complex).reshape(x.shape)
    with np.errstate(over="ignore", under="ignore"):  # what overflows is found by the caller
        return x * 2.0**exponent if np.max(np.abs(exponent)) < 1000 else np.ldexp(x, exponent)


def _real_and_imaginary(x):
    """Return real and imaginary parts in turn along the last axis; a 0-d array becomes an array of two."""
    return np.ascontiguousarray(x).view(float)


def inverted(values, out=None):
    """1 / values, and 0 where they are 0: the generalised inverse of a diagonal."""
    out = np.empty_like(values) if out is None else out
    out[...] = 0.0
    return np.divide(1.0, values, out=out, where=values != 0)
