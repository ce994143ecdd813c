"""Compiled loops on plain arrays, and NumPy implementations of them (`reference`) that are used without numba.

Arrays must be C-contiguous and of dtype float64, unless stated otherwise; callers check and cast them. numba is
imported at the first use of a compiled loop. To disable it, set the environment variable ``SPARSEDP_NUMBA=0`` before.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import math
import operator
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp.kernels import reference

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from sparsedp.kernels.reference import Rows, Tridiagonal

__all__ = [
    "along_axis",
    "bound",
    "compiled",
    "product_loop",
    "run",
    "set_threads",
    "summed",
    "sweep",
    "threads",
]


@functools.cache
def compiled() -> bool:
    """Return whether numba is installed and not disabled; does not import numba."""
    return os.environ.get("SPARSEDP_NUMBA", "1") != "0" and importlib.util.find_spec("numba") is not None


@functools.cache
def _available_threads() -> int:
    """Return the number of processors that this process may use, limited by NUMBA_NUM_THREADS."""
    if hasattr(os, "sched_getaffinity"):
        usable = len(os.sched_getaffinity(0))
    else:
        usable = os.cpu_count() or 1
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    if limit.isdigit() and int(limit):
        return min(usable, int(limit))
    return usable


_chosen_threads: list[int] = []  # the number that `set_threads` was given; empty for all available threads


def threads() -> int:
    """Return the number of threads that the compiled loops use."""
    if _chosen_threads:
        return _chosen_threads[0]
    return _available_threads()


def set_threads(n: int | None = None) -> None:
    """Set the number of threads that the compiled loops use.

    The results of the loops are bit-identical for every number of threads.

    Parameters
    ----------
    n : int, optional
        From 1 to the number of processors that this process may use. Default: all of them.

    Raises
    ------
    TypeError
        If `n` is not an integer.
    ValueError
        If `n` is out of range.

    See Also
    --------
    ensemble

    Examples
    --------
    >>> set_threads(1)
    >>> threads()
    1
    >>> set_threads()
    """
    if n is None:
        _chosen_threads.clear()
        return
    try:
        n = operator.index(n)
    except TypeError:
        raise TypeError(f"set_threads got {n!r}; it needs an integer, for example 1, or None for the default") from None
    if not 1 <= n <= _available_threads():
        raise ValueError(
            f"set_threads got {n}; it needs 1 to {_available_threads()}, the processors this process may use; "
            "write None for the default"
        )
    _chosen_threads[:] = [n]


_import_module = functools.cache(importlib.import_module)  # cached: import_module takes longer than a small loop


def run(module: str, name: str, rows: int, work: int, threads: int, *args: Any) -> bool:
    """Run a compiled loop over some rows, and return whether it is available.

    Parameters
    ----------
    module, name : str
        Name of a module of this package, and name of a loop in it.
    rows : int
        Number of rows, which are distributed over the threads.
    work : int
        Number of values to process. Several threads are used only if it is large enough.
    threads : int
        Maximum number of threads.
    *args
        Arguments of the loop except the last two, the range of rows.
    """
    if not compiled():
        return False
    loop = getattr(_import_module(f"{__name__}.{module}"), name)
    return loop.run_all(rows, work, threads, args)


def bound(module: str, name: str, rows: int, work: int, most_threads: int | None = None) -> Callable[..., bool]:
    """Return a function ``act(*args)`` that runs a compiled loop over all its rows, as `run` does, with less overhead.

    Parameters
    ----------
    module, name, rows, work
        Arguments of `run`.
    most_threads : int, optional
        Default: the number that `set_threads` sets, at the time of the call.

    Returns
    -------
    callable
        It returns whether the loop is available. numba is imported at its first call.
    """
    loop: Any = None  # the loop as a function of its arguments

    def act(*args):
        nonlocal loop
        if not compiled():
            return False
        if loop is None:
            loop = getattr(_import_module(f"{__name__}.{module}"), name).over(rows, work, most_threads or threads)
        return loop(*args)

    return act


def summed(shape: tuple[int, int, int], axes: Sequence[Tridiagonal | None], shift: float) -> Callable[..., None]:
    """Return a function ``act(u, out)`` that sets out = shift u + sum over a of T_a u in one pass.

    Parameters
    ----------
    shape : (n0, n1, n2)
        Shape of `u` and `out`, float64 arrays that must not overlap.
    axes : sequence of three
        For each axis a, the `Tridiagonal` T_a with n_a rows, or None if the sum has no term for this axis.
    shift : float
        Factor of `u` itself.

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
    uniform = (inner == inner[:, :1]).all()
    loop = bound("stencil", "kronecker_sum", shape[0] * shape[1], math.prod(shape))

    def act(u, out, accumulate=False):
        fields = u.reshape(shape), out.reshape(shape)
        if u.size and not loop(*fields, *bands, uniform, shift):
            reference.kronecker_sum(*fields, axes, shift)

    return act


@functools.cache
def product_loop() -> Callable[..., None] | None:
    """Return SciPy's loop ``add_product(rows, columns, indptr, indices, data, x, out)``, or None.

    It adds the product of a CSR matrix and a vector to `out`. SciPy's operator ``@`` calls it too, after dispatch and
    checks that take longer than a small product. The loop is in a private module. It is used only if it exists and
    gives the right result for a small matrix.
    """
    indptr = np.array([0, 2, 3], np.int32)
    indices = np.array([0, 2, 1], np.int32)
    out = np.zeros(2)
    try:
        from scipy.sparse._sparsetools import csr_matvec

        csr_matvec(2, 3, indptr, indices, np.array([1.5, 0.25, -3.0]), np.array([2.0, 0.5, -4.0]), out)
    except (ImportError, TypeError, ValueError):
        return None
    if not np.array_equal(out, [2.0, -1.5]):
        return None
    return csr_matvec


def along_axis(u: NDArray, out: NDArray, rows: Rows, scale: float, accumulate: bool) -> None:
    """Set `out` to scale M u, or add scale M u to it, for a sparse matrix M that acts along the middle axis.

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
        Whether to add to `out` instead of replacing it.

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
    args: tuple[Any, ...]
    if out.shape[2] == 1 and rows.offsets.size:
        name = "along_rows"
        count = out.size
        args = u[:, :, 0], out[:, :, 0], rows.offsets, rows.start, rows.stop, rows.values
    else:
        name = "across_rows"
        count = out.shape[0] * out.shape[1]
        args = u, out, rows.indptr, rows.indices, rows.data
    if not out.size or not run("stencil", name, count, out.size, threads(), *args, scale, accumulate):
        reference.product_along(u, out, rows, scale, accumulate)


def sweep(x: NDArray, lower: NDArray, upper: NDArray, inverses: NDArray) -> None:
    """Solve tridiagonal systems along the first axis in place, for given pivots of the elimination.

    First, for increasing i, x_i = (x_i - lower_i x_(i-1)) inverses_i; then, for decreasing i,
    x_i -= upper_i x_(i+1) inverses_i.

    Parameters
    ----------
    x : float64 array, shape (n, m)
        C-contiguous. Each column is the right-hand side of one system and is replaced by its solution.
    lower, upper : float64 arrays, shape (n,)
    inverses : float64 array, shape (n, m)
        The inverse pivots of each system.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.array([[1.0], [3.0]])
    >>> sweep(x, np.array([0.0, 1.0]), np.array([1.0, 0.0]), np.array([[0.5], [2 / 3]]))
    >>> x  # 2 a + b = 1, a + 2 b = 3
    array([[-0.33333333],
           [ 1.66666667]])
    """
    if not x.size or not run("elimination", "eliminate", x.shape[1], x.size, threads(), x, lower, upper, inverses):
        reference.eliminate(x, lower, upper, inverses)
