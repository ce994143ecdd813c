"""Sizes of arrays and their scaling by powers of two, which is exact."""

import numpy as np

__all__ = ["in_range", "largest", "norm", "shifted"]

SMALL, LARGE = 2.0**-200, 2.0**200  # norms between which nothing a solve computes leaves the range of floats


def norm(x):
    """2-norm of a flat array, without BLAS: its threads would stall compiled kernels."""
    x = x.view(float) if x.dtype.kind == "c" else x
    return float(np.sqrt(np.einsum("i,i->", x, x)))


def in_range(size):
    """Whether a norm is finite, not 0, and far from both ends of the range of floats."""
    return SMALL < size < LARGE


def largest(x):
    """Largest magnitude of a real or imaginary part; NaN when there is one."""
    x = x.view(float) if x.dtype.kind == "c" else x
    top = float(x.max(initial=0.0))
    return top if np.isnan(top) else max(top, -float(x.min(initial=0.0)))


def shifted(x, exponent):
    """x * 2^exponent, exact unless it leaves the range of floats; always a fresh array."""
    if x.dtype.kind == "c":
        return shifted(x.view(float), exponent).view(complex)
    with np.errstate(over="ignore", under="ignore"):  # what overflows is found by the caller
        return x * 2.0**exponent if -1000 < exponent < 1000 else np.ldexp(x, exponent)
