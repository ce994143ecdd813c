"""Products with a matrix under test: a Jacobian or Hessian as an array, a sparse matrix or an operator."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from sparsedp.check.programs import WrongResult
from sparsedp.errors import DerivativeError
from sparsedp.operators.operator import Operator

__all__ = ["Products", "adjoint_product", "flattened", "unflattened"]


class Products:
    """Products with a matrix, or with a function of x that returns a matrix.

    Parameters
    ----------
    matrix : array, sparse matrix, LinearOperator, Operator, or callable
        A callable ``matrix(x)`` returns one of the others.
    name : str
        Name in messages.
    rows : str
        What the rows belong to, for messages.

    Attributes
    ----------
    is_function : bool
        Whether the matrix depends on x.
    """

    def __init__(self, matrix: Any, name: str, rows: str = "f(x)") -> None:
        self.name = name
        self.rows = rows
        self.is_function = callable(matrix) and not _is_matrix(matrix)
        self._matrix = matrix
        if not self.is_function:
            self._checked(matrix)

    def _checked(self, matrix: Any) -> Any:
        """Return a matrix; an array of more than two axes is kept, because its axes are those of f(x) and x."""
        if _is_matrix(matrix):
            return matrix
        array = np.asarray(matrix)
        if array.dtype.kind not in "biufc":
            raise TypeError(
                f"{self.name} takes an array, a sparse matrix, an operator, or a function of x that returns one, "
                f"got {type(matrix).__name__}; write an array with one column for each entry of x"
            )
        return array

    def at(self, x: Any) -> Any:
        """Return the matrix at a point."""
        if self.is_function:
            return self._checked(self._matrix(x))
        return self._checked(self._matrix)

    def product(self, x: Any, vector: NDArray[Any], rows: int) -> NDArray[Any]:
        """Return the product of the matrix with a vector."""
        matrix = self._fitted(x, rows, vector.size)
        if isinstance(matrix, Operator):
            return np.ravel(matrix.apply(vector.reshape(matrix.domain.shape)))
        return np.ravel(matrix @ vector)

    def transposed_product(self, x: Any, vector: NDArray[Any], columns: int) -> NDArray[Any]:
        """Return the product of the transposed matrix, without conjugation, with a vector."""
        matrix = self._fitted(x, vector.size, columns)
        if isinstance(matrix, Operator):
            return np.ravel(matrix.T.apply(vector.reshape(matrix.codomain.shape)))
        if hasattr(matrix, "rmatvec"):
            return np.conj(np.ravel(adjoint_product(matrix, np.conj(vector))))
        return np.ravel(matrix.T @ vector)

    def _fitted(self, x: Any, rows: int, columns: int) -> Any:
        """Return the matrix, with the shape (rows, columns)."""
        matrix = self.at(x)
        shape = tuple(matrix.shape)
        if isinstance(matrix, np.ndarray) and matrix.size == rows * columns and matrix.ndim != 2:
            return matrix.reshape(rows, columns)
        if shape != (rows, columns):
            raise WrongResult(
                f"{self.name} has shape {shape}, expected {(rows, columns)}; "
                f"write one row for each entry of {self.rows}, and one column for each entry of x"
            )
        return matrix


def _is_matrix(thing: Any) -> bool:
    """Return whether a value is a matrix or operator that has products."""
    return isinstance(thing, (np.ndarray, Operator)) or sp.issparse(thing) or hasattr(thing, "matvec")


def adjoint_product(op: Any, g: Any) -> Any:
    """Return the product of the conjugate transpose of a LinearOperator with a vector.

    Raises
    ------
    DerivativeError
        If it has no `rmatvec`.
    """
    try:
        return op.rmatvec(g)
    except NotImplementedError as error:  # SciPy raises it for an operator without rmatvec
        raise DerivativeError(
            "the LinearOperator has no rmatvec, the product with its conjugate transpose; "
            "write LinearOperator(shape, matvec=..., rmatvec=...)"
        ) from error


def flattened(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """Return the entries of some arrays as one vector, in which a complex entry is one number."""
    return np.concatenate([np.ravel(array) for array in arrays])


def unflattened(vector: NDArray[Any], like: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Return the parts of a vector as arrays of the shapes of other arrays; real where these are real."""
    arrays = []
    start = 0
    for array in like:
        part = vector[start : start + array.size].reshape(array.shape)
        arrays.append(part if np.iscomplexobj(array) else np.real(part))
        start += array.size
    return arrays
