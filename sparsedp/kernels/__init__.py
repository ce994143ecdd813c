"""Compiled loops on plain arrays, with NumPy twins for when numba is not installed.

The arrays are not checked: that is the caller's business. numba is
imported at the first use of a kernel, never before. Setting the environment variable
``SPARSEDP_NUMBA=0`` before the first use switches it off.
"""

import functools
import importlib.util
import operator
import os

from sparsedp.kernels import plain

__all__ = ["along_axis", "compiled", "kronecker_sum", "set_threads", "threads"]


@functools.cache
def compiled():
    """Whether numba is installed and not switched off -> bool. Does not import numba."""
    return os.environ.get("SPARSEDP_NUMBA", "1") != "0" and importlib.util.find_spec("numba") is not None


@functools.cache
def _available():
    """Number of processors this process may use, not more than numba may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    return min(usable, int(limit)) if limit.isdigit() and int(limit) else usable


_chosen: list[int] = []  # empty: as many as there are


def threads():
    """Number of threads the compiled kernels use -> int."""
    return _chosen[0] if _chosen else _available()


def set_threads(n=None):
    """Choose how many threads the compiled kernels use.

    The result of a kernel does not depend on it, to the last bit.

    Parameters
    ----------
    n : int, optional
        From 1 to the number of processors this process may use; None goes back to all of them.

    Raises
    ------
    TypeError
        If `n` is not an integer.
    ValueError
        If `n` is out of range.

    Examples
    --------
    >>> set_threads(1)
    >>> threads()
    1
    >>> set_threads()
    """
    if n is None:
        _chosen.clear()
        return
    try:
        n = operator.index(n)
    except TypeError:
        raise TypeError(f"set_threads got {n!r}; it needs an integer, for example 1, or None for the default") from None
    if not 1 <= n <= _available():
        raise ValueError(
            f"set_threads got {n}; it needs 1 to {_available()}, the processors this process may use; "
            "write None for the default"
        )
    _chosen[:] = [n]


@functools.cache
def _native():
    """The module of compiled kernels; imports numba."""
    from sparsedp.kernels import native

    return native


def kronecker_sum(u, out, axes, shift):
    """Field, three tridiagonal matrices -> out = shift u + sum over a of T_a u, T_a along axis a.

    One pass over memory. Sums are float64 (complex128) and rounded once.

    Parameters
    ----------
    u : ndarray, shape (n0, n1, n2)
        C-contiguous; float32, float64, complex64 or complex128.
    out : ndarray, shape (n0, n1, n2)
        C-contiguous, of the same dtype; must not overlap `u`.
    axes : tuple of three
        `Tridiagonal` of n_a rows, or None where nothing is done along the axis.
    shift : float
        Multiple of `u` itself.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp.kernels.layout import Tridiagonal
    >>> line = Tridiagonal(np.array([0.0, 1, 1]), np.array([-2.0, -2, -2]), np.array([1.0, 1, 0]), 1, 2)
    >>> u, out = np.array([[[1.0, 2.0, 4.0]]]), np.zeros((1, 1, 3))
    >>> kronecker_sum(u, out, (None, None, line), 0.0)
    >>> out
    array([[[ 0.,  1., -6.]]])
    """
    if compiled():
        _native().kronecker_sum(u, out, axes, shift, threads())
    else:
        plain.kronecker_sum(u, out, axes, shift)


def along_axis(u, out, rows, scale, accumulate):
    """Field, sparse 1-D matrix M -> out = scale M u or out += scale M u along the middle axis.

    Sums are float64 (complex128) and rounded once a call.

    Parameters
    ----------
    u : ndarray, shape (L, columns, R)
        C-contiguous; float32, float64, complex64 or complex128.
    out : ndarray, shape (L, rows, R)
        C-contiguous, of the same dtype; must not overlap `u`.
    rows : Rows
        The matrix.
    scale : float
        Factor of the product.
    accumulate : bool
        Add to `out` instead of replacing it.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp.kernels.layout import Rows
    >>> whole, none = np.array([0, 2]), np.zeros(0, int)
    >>> difference = Rows(1, 2, whole, np.array([0, 1]), np.array([-1.0, 1.0]), none, none, none, np.zeros((0, 1)))
    >>> u, out = np.array([[[1.0, 2.0], [4.0, 8.0]]]), np.zeros((1, 1, 2))
    >>> along_axis(u, out, difference, 1.0, False)
    >>> out
    array([[[3., 6.]]])
    """
    if compiled():
        _native().along_axis(u, out, rows, scale, accumulate, threads())
    else:
        plain.along_axis(u, out, rows, scale, accumulate)
