"""Operators that the user brings: a matrix, a LinearOperator, or two functions."""

from functools import partial

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.validation import (
    check_finite,
    check_function,
    check_kind,
    check_plain,
    check_type,
    is_other_precision,
)
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.lazy import Functions

__all__ = ["check_operator", "from_functions", "from_linear_operator", "from_matrix"]


def check_operator(name, op):
    """Refuse what is no Operator."""
    check_type(name, op, Operator, "an Operator", "dp.from_matrix(...) first")
    op.backend.check(name)


def from_matrix(matrix, domain=None, codomain=None, name="matrix"):
    """Matrix -> Operator in explicit form.

    Parameters
    ----------
    matrix : scipy.sparse matrix or array, or 2-D ndarray, shape (codomain.size, domain.size)
        Any format, real or complex. Copied; entries of other precision than float32, float64, complex64 and complex128
        are rounded to double precision.
    domain, codomain : Space, int or tuple of int, optional
        Default: flat spaces of the matrix's sizes.
    name : str

    Returns
    -------
    Operator

    Raises
    ------
    TypeError
        If the matrix does not hold numbers, or is a masked array.
    ShapeError
        If the matrix is not 2-D or does not fit the spaces.
    NonFiniteError
        If an entry is NaN or infinite.

    Examples
    --------
    >>> rows = from_matrix([[1.0, 2.0], [0.0, 3.0]])
    >>> rows(np.array([1.0, 1.0]))
    array([3., 3.])
    >>> rows.T(np.array([1.0, 0.0]))
    array([1., 2.])
    """
    check_plain(name, matrix)
    entries = matrix if sp.issparse(matrix) else _rows(name, matrix)
    if entries.ndim != 2:
        raise ShapeError(
            f"{name} needs a 2-D matrix, got an array of shape {entries.shape}; write matrix[None] for a row"
        )
    check_kind(name, entries.dtype, "numbers", "; write matrix.astype(float)")
    if is_other_precision(entries.dtype):
        entries = entries.astype(complex if entries.dtype.kind == "c" else float)
    structure = Matrix(sp.csr_array(entries, copy=True))
    rows, columns = structure.matrix.indptr, structure.matrix.indices
    check_finite(
        name,
        structure.matrix.data,
        "needs finite entries",
        lambda n: (int(np.searchsorted(rows, n, side="right")) - 1, int(columns[n])),
    )
    return Operator(structure, _space(domain, structure.shape[1]), _space(codomain, structure.shape[0]), name)


def _rows(name, matrix):
    try:
        return np.asarray(matrix)
    except ValueError:
        raise ShapeError(f"{name} needs rows of one length, got a list of different ones; fill them with 0") from None


def from_linear_operator(linop, domain=None, codomain=None, name="operator"):
    """scipy.sparse.linalg.LinearOperator -> Operator.

    Parameters
    ----------
    linop : LinearOperator, or any object with shape, matvec and rmatvec
        `rmatvec` is the conjugate transpose, as SciPy defines it.
    domain, codomain : Space, int or tuple of int, optional
    name : str

    Returns
    -------
    Operator
        In matrix-free form.

    Raises
    ------
    TypeError
        If `linop` has no shape or no matvec.
    ShapeError
        If the operator does not fit the spaces.
    DerivativeError
        On use of `.T`, if the LinearOperator has no rmatvec.

    Examples
    --------
    >>> from scipy.sparse.linalg import aslinearoperator
    >>> op = from_linear_operator(aslinearoperator(np.array([[1.0, 2.0], [0.0, 3.0]])))
    >>> op.T(np.array([1.0, 0.0]))
    array([1., 2.])
    """
    if not (hasattr(linop, "shape") and hasattr(linop, "matvec")):
        instead = "from_matrix" if hasattr(linop, "shape") else "from_functions"
        raise TypeError(f"from_linear_operator takes a LinearOperator, got {type(linop).__name__}; write dp.{instead}")
    rows, columns = linop.shape

    forward, backward = partial(_product, linop), partial(_transposed_product, linop, name)
    structure = Functions(forward, backward, (columns,), (rows,), _kind(getattr(linop, "dtype", None)))
    return Operator(structure, _space(domain, columns), _space(codomain, rows), name)


def _product(linop, x):
    return np.asarray(linop.matvec(x.reshape(-1)))


def _transposed_product(linop, name, g):
    try:
        return np.conj(np.asarray(linop.rmatvec(np.conj(g.reshape(-1)))))
    except (NotImplementedError, TypeError, AttributeError):
        raise DerivativeError(f"{name} has no transpose: its LinearOperator lacks rmatvec; give it one") from None


def from_functions(forward, transpose, domain, codomain, name="operator", dtype=float):
    """Two functions, the product and the transposed product -> Operator.

    Parameters
    ----------
    forward : callable
        ``forward(u)``: array of shape `domain.shape` -> array of shape `codomain.shape`, linear.
    transpose : callable or None
        ``transpose(g)``, the plain transpose: sum(g * forward(u)) == sum(transpose(g) * u).
        None when it is not known; then only `op(u)` works.
    domain, codomain : Space, int or tuple of int
    name : str
    dtype : float or complex
        complex when the functions make complex values from real fields, or real ones from complex fields, as a real FFT
        and its inverse do. The real parts of the two sums are equal then, for all complex g.

    Returns
    -------
    Operator
        In matrix-free form. `dp.check.operator(op)` tells whether the two functions agree.

    Raises
    ------
    TypeError
        If a function is not callable, or a space is missing.
    ShapeError
        On use, if a function returns an array of another shape.
    DerivativeError
        On use of the transpose when there is none.

    Examples
    --------
    >>> ends = from_functions(lambda u: u[[0, -1]], lambda g: np.array([g[0], 0.0, g[1]]), 3, 2, name="ends")
    >>> ends(np.array([5.0, 6.0, 7.0]))
    array([5., 7.])
    """
    if domain is None or codomain is None:
        raise TypeError("from_functions needs a domain and a codomain, got None; write from_functions(f, t, 3, 2)")
    check_function("from_functions", forward, "from_functions(f, t, 3, 2)")
    if transpose is not None:
        check_function("from_functions, as transpose,", transpose, "None for a missing one")
    domain, codomain = _space(domain, None), _space(codomain, None)
    structure = Functions(forward, transpose, domain.shape, codomain.shape, _kind(dtype))
    return Operator(structure, domain, codomain, name)


def _space(given, size):
    if isinstance(given, Space):
        return given
    return Space(size if given is None else given)


def _kind(dtype):
    return complex if dtype is not None and np.dtype(dtype).kind == "c" else float
