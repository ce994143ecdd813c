"""Operators defined by the user: from a matrix, a LinearOperator, or two functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

__all__ = ["check_operator", "from_functions", "from_linear_operator", "from_matrix"]


def check_operator(name: str, op: Any) -> None:
    """Raise TypeError if `op` is not an Operator, or if the function `name` does not support its backend."""
    check_type(name, op, Operator, "an Operator", "dp.from_matrix(...) first")
    op.backend.check(name)


def from_matrix(matrix: ArrayLike, domain: Any = None, codomain: Any = None, name: str = "matrix") -> Operator:
    """Return the Operator with a given matrix, in explicit form.

    Parameters
    ----------
    matrix : scipy.sparse matrix or array, or 2-D ndarray, shape (codomain.size, domain.size)
        Any sparse format, real or complex. The matrix is copied. Its entries are converted to double precision.
    domain, codomain : Space, int or tuple of int, optional
        Default: spaces of flat arrays with as many entries as the matrix has columns and rows.
    name : str

    Returns
    -------
    Operator

    Raises
    ------
    TypeError
        If the entries of the matrix are not numbers, or if it is a masked array.
    ShapeError
        If the matrix is not 2-D, or its shape does not match the spaces.
    NonFiniteError
        If an entry is NaN or infinite.

    See Also
    --------
    from_functions, from_linear_operator, Operator

    Notes
    -----
    For complex matrices see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> rows = from_matrix([[1.0, 2.0], [0.0, 3.0]])
    >>> rows(np.array([1.0, 1.0]))
    array([3., 3.])
    >>> rows.T(np.array([1.0, 0.0]))
    array([1., 2.])
    """
    check_plain(name, matrix)
    entries: Any = matrix if sp.issparse(matrix) else _rows(name, matrix)
    if entries.ndim != 2:
        raise ShapeError(
            f"{name} needs a 2-D matrix, got an array of shape {entries.shape}; write matrix[None] for a row"
        )
    check_kind(name, entries.dtype, "numbers", "; write matrix.astype(float)")
    if is_other_precision(entries.dtype):
        entries = entries.astype(complex if entries.dtype.kind == "c" else float)
    structure = Matrix(sp.csr_array(entries, copy=True))

    def row_and_column(number):
        row = np.searchsorted(structure.matrix.indptr, number, side="right") - 1
        return int(row), int(structure.matrix.indices[number])

    check_finite(name, structure.matrix.data, "needs finite entries", row_and_column)
    return Operator(structure, _space(domain, structure.shape[1]), _space(codomain, structure.shape[0]), name)


def _rows(name, matrix):
    """Return the matrix as an array; raise ShapeError for nested lists whose rows have different lengths."""
    try:
        return np.asarray(matrix)
    except ValueError:
        raise ShapeError(f"{name} needs rows of one length, got a list of different ones; fill them with 0") from None


def from_linear_operator(linop: Any, domain: Any = None, codomain: Any = None, name: str = "operator") -> Operator:
    """Return an Operator from a scipy.sparse.linalg.LinearOperator.

    Parameters
    ----------
    linop : LinearOperator, or any object with shape, matvec and rmatvec
        `rmatvec` is the conjugate transpose, as SciPy defines it.
    domain, codomain : Space, int or tuple of int, optional
    name : str

    Returns
    -------
    Operator
        An operator in matrix-free form.

    Raises
    ------
    TypeError
        If `linop` has no attribute `shape` or `matvec`.
    ShapeError
        If the shape of `linop` does not match the spaces.
    DerivativeError
        When the transpose `.T` is applied, if `linop` has no rmatvec.

    See Also
    --------
    from_matrix, from_functions, Operator

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
    forward = partial(_product, linop)
    backward = partial(_transposed_product, linop, name)
    structure = Functions(forward, backward, (columns,), (rows,), _kind(getattr(linop, "dtype", None)))
    return Operator(structure, _space(domain, columns), _space(codomain, rows), name)


def _product(linop, x):
    """Return A x."""
    return np.asarray(linop.matvec(x.reshape(-1)))


def _transposed_product(linop, name, g):
    """Return A^T g, computed as conj(A^H conj(g)) because SciPy's rmatvec is the product with A^H."""
    try:
        return np.conj(np.asarray(linop.rmatvec(np.conj(g.reshape(-1)))))
    except (NotImplementedError, TypeError, AttributeError):
        raise DerivativeError(f"{name} has no transpose: its LinearOperator lacks rmatvec; give it one") from None


def from_functions(
    forward: Callable,
    transpose: Callable | None,
    domain: Any,
    codomain: Any,
    name: str = "operator",
    dtype: DTypeLike = float,
) -> Operator:
    """Return an Operator defined by two functions, which compute its product and its transposed product.

    Parameters
    ----------
    forward : callable
        A linear function ``forward(u)`` from arrays of shape `domain.shape` to arrays of shape `codomain.shape`.
    transpose : callable or None
        ``transpose(g)``, the plain transpose without conjugation: sum(g * forward(u)) == sum(transpose(g) * u).
        If it is None, the operator can be applied, but `op.T` and derivatives cannot.
    domain, codomain : Space, int or tuple of int
    name : str
    dtype : float or complex
        Use complex if the functions return complex values for real fields, or real values for complex fields, as a real
        FFT and its inverse do. Then the real parts of the two sums above must be equal for all complex g.

    Returns
    -------
    Operator
        An operator in matrix-free form. `dp.check.operator(op)` tests whether the two functions agree.

    Raises
    ------
    TypeError
        If `forward` or `transpose` is not callable, or a space is None.
    ShapeError
        When the operator is applied, if a function returns an array of another shape.
    DerivativeError
        When the transpose is applied, if `transpose` is None.

    See Also
    --------
    from_matrix, from_linear_operator, Operator

    Notes
    -----
    For complex fields see docs/guides/complex_numbers.md.

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
    domain = _space(domain, None)
    codomain = _space(codomain, None)
    structure = Functions(forward, transpose, domain.shape, codomain.shape, _kind(dtype))
    return Operator(structure, domain, codomain, name)


def _space(space, size):
    """Convert an argument `domain` or `codomain` to a Space; None stands for flat arrays of the given size."""
    if isinstance(space, Space):
        return space
    return Space(size if space is None else space)


def _kind(dtype):
    """Return complex for complex dtypes, else float."""
    if dtype is not None and np.dtype(dtype).kind == "c":
        return complex
    return float
