"""Compiled loops on plain arrays, and the NumPy formulas (`reference`) that run without numba.

The arrays are not checked: that is the caller's business. They are C-contiguous and hold float64; other numbers are
cast by the caller. numba is imported at the first use of a kernel, never before. Setting the environment variable
``SPARSEDP_NUMBA=0`` before the first use switches it off.
"""

import functools
import importlib.util
import operator
import os

import numpy as np

from sparsedp.kernels import reference

__all__ = [
    "along_axis",
    "compiled",
    "run",
    "set_threads",
    "summed",
    "sweep",
    "threads",
]


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


_module = functools.cache(importlib.import_module)  # finding it again takes longer than a small loop


def run(module, name, rows, work, threads, *args):
    """Run a compiled loop of a module of this folder over some rows -> whether there is one and it works here.

    `work` is the count of numbers that decides whether several threads are worth it.
    """
    loop = getattr(_module(f"{__name__}.{module}"), name) if compiled() else None
    if loop is None or not loop.compiled:
        return False
    loop.run(rows, work, threads, *args)
    return True


def summed(shape, axes, shift):
    """Three tridiagonal matrices T_a -> function (u, out): out = shift u + sum over a of T_a u, in one pass.

    What its loop reads is made ready once.

    Parameters
    ----------
    shape : (n0, n1, n2)
        Of `u` and `out`, float64 arrays that must not overlap.
    axes : tuple of three
        `Tridiagonal` of n_a rows, or None where nothing is done along the axis.
    shift : float
        Multiple of `u` itself.

    Examples
    --------
    >>> from sparsedp.kernels.reference import Tridiagonal
    >>> line = Tridiagonal(np.array([0.0, 1, 1]), np.array([-2.0, -2, -2]), np.array([1.0, 1, 0]))
    >>> u, out = np.array([[[1.0, 2.0, 4.0]]]), np.zeros((1, 1, 3))
    >>> summed((1, 1, 3), (None, None, line), 0.0)(u, out)
    >>> out
    array([[[ 0.,  1., -6.]]])
    """
    bands = [np.zeros((3, n)) if axis is None else np.stack(axis) for n, axis in zip(shape, axes, strict=True)]
    inner = bands[2][:, 1:-1]
    uniform, rows = (inner == inner[:, :1]).all(), shape[0] * shape[1]

    def act(u, out, *_):
        given = u.reshape(shape), out.reshape(shape)
        if u.size and not run("stencil", "kronecker_sum", rows, u.size, threads(), *given, *bands, uniform, shift):
            reference.kronecker_sum(*given, axes, shift)

    return act


def along_axis(u, out, rows, scale, accumulate):
    """Field, sparse 1-D matrix M -> out = scale M u or out += scale M u along the middle axis.

    Parameters
    ----------
    u : float64 array, shape (L, columns, R)
    out : float64 array, shape (L, rows, R)
        Must not overlap `u`.
    rows : Rows
        The matrix.
    scale : float
        Factor of the product.
    accumulate : bool
        Add to `out` instead of replacing it.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp.kernels.reference import Rows
    >>> whole, none = np.array([0, 2]), np.zeros(0, int)
    >>> difference = Rows(1, 2, whole, np.array([0, 1]), np.array([-1.0, 1.0]), none, none, none, np.zeros((0, 1)))
    >>> u, out = np.array([[[1.0, 2.0], [4.0, 8.0]]]), np.zeros((1, 1, 2))
    >>> along_axis(u, out, difference, 1.0, False)
    >>> out
    array([[[3., 6.]]])
    """
    given: tuple
    if out.shape[2] == 1 and rows.offsets.size:
        fields, diagonals = (u[:, :, 0], out[:, :, 0]), (rows.offsets, rows.start, rows.stop, rows.values)
        given = "along_rows", out.size, out.size, threads(), *fields, *diagonals, scale, accumulate
    else:
        matrix, many = (rows.indptr, rows.indices, rows.data), out.shape[0] * out.shape[1]
        given = "across_rows", many, out.size, threads(), u, out, *matrix, scale, accumulate
    if not out.size or not run("stencil", *given):
        reference.product_along(u, out, rows, scale, accumulate)


def sweep(x, lower, upper, inverses):
    """Right-hand sides -> solutions, in place: tridiagonal systems along the first axis, eliminated before.

    Down the rows x_i = (x_i - lower_i x_(i-1)) inverses_i, up x_i -= upper_i x_(i+1) inverses_i.

    Parameters
    ----------
    x : float64 array, shape (n, m)
        C-contiguous; one system in each column.
    lower, upper : float64 arrays, shape (n,)
    inverses : float64 array, shape (n, m)
        1 / pivots.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.array([[1.0], [3.0]])
    >>> sweep(x, np.array([0.0, 1.0]), np.array([1.0, 0.0]), np.array([[0.5], [2 / 3]]))
    >>> x  # 2 a + b = 1, a + 2 b = 3
    array([[-0.33333333],
           [ 1.66666667]])
    """
    given = x, lower, upper, inverses
    if not x.size or not run("elimination", "eliminate", x.shape[1], x.size, threads(), *given):
        reference.eliminate(*given)
