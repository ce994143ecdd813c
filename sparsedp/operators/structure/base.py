"""Structure: the base class of linear maps between flat arrays, and Matrix, its simplest subclass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from operator import is_
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from sparsedp import kernels
from sparsedp._utils.base_classes import Uncached
from sparsedp._utils.counters import count

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "INT32_LIMIT",
    "BoundProduct",
    "Matrix",
    "Structure",
    "Transposable",
    "assembled",
    "compact",
    "probes",
    "result_dtype",
    "rows_of",
]

INT32_LIMIT = 2**31
MOST_MAGNITUDES = 2**22  # magnitudes of entries that are stored; those of larger matrices are computed when needed
PROBES = 3  # number of random vectors for estimating the magnitude of a map whose entries are unknown


class BoundProduct(NamedTuple):
    """The product of a linear map with arrays of one dtype: see `Structure.bound`.

    Attributes
    ----------
    write : callable
        ``write(x, out)`` writes A x into `out`, for flat contiguous arrays. It checks nothing, may be called by several
        threads at once, and must not refer to an Operator, because that would be a reference cycle.
    zeros : bool
        Whether `out` must be filled with zeros before.
    """

    write: Callable[[NDArray, NDArray], Any]
    zeros: bool = False


class Structure(Uncached):
    """An immutable linear map between flat contiguous arrays.

    Attributes
    ----------
    shape : (rows, columns)
    dtype : numpy dtype
        Type of the entries, float64 or complex128.
    members : tuple of Structures
        The factors or terms, if the structure is a product or a sum.
    has_entries : bool
        Whether `explicit()` can compute the matrix without applying the map to every unit vector.
    takes_complex : bool
        Whether `act` accepts complex arrays. If not, it is called for the real and the imaginary part separately.
    separable : bool
        Whether the map is a Kronecker sum, that is, a sum of maps along single axes.
    depth : int
        Nesting depth of products and sums.
    passes : int
        Number of passes over memory in matrix-free form without fusion. The default form of an operator depends on it.
    """

    shape: tuple[int, int]
    dtype: np.dtype = np.dtype(float)
    members: tuple = ()
    has_entries = True
    takes_complex = True
    is_identity = False
    separable = False
    depth = 0
    passes = 1

    def apply(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`.

        Both arrays are flat and contiguous, and `out` has the dtype ``result_dtype(self, x.dtype)``. For single
        precision the product is computed in double precision and rounded once.
        """
        if x.dtype.char in "fF":
            np.copyto(out, self.product(x.astype(np.result_type(x.dtype, float))), casting="same_kind")
        elif x.dtype.kind == "c" and not self.takes_complex:
            out.real = self.product(x.real.copy())
            out.imag = self.product(x.imag.copy())
        else:
            self.act(x, out)

    def bound(self, dtype: np.dtype) -> BoundProduct:
        """Return the product with arrays of this dtype.

        It computes the same as `apply`. What depends only on the dtype is decided here instead of in every call.
        """
        return BoundProduct(self.apply)

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`, for float64 and, if `takes_complex`, complex128 arrays."""
        raise TypeError(f"{type(self).__name__} does not say how it acts")

    def transpose(self) -> Structure:
        """Return the plain transpose."""
        raise TypeError(f"{type(self).__name__} has no transpose")

    def explicit(self) -> sp.csr_array:
        """Return the entries as a csr_array with 32-bit indices."""
        return columns_by_application(self)

    def scaled(self, factor: complex) -> Structure | None:
        """Return factor * A as a structure of the same kind, or None if that is not possible."""
        return None

    def magnitude(self) -> Callable[[NDArray], NDArray]:
        """Return a function that computes upper bounds of the entries of abs(A) x for x >= 0.

        If the entries of A are unknown, it computes an estimate.
        """
        if self.has_entries:
            matrix = self.explicit()
            if matrix.nnz > MOST_MAGNITUDES:
                return partial(_product_with_magnitudes, matrix)
            magnitudes = (np.abs(matrix.data), matrix.indices, matrix.indptr)  # the indices are shared, not copied
            return sp.csr_array(magnitudes, shape=matrix.shape).dot
        # Estimate the row sums of abs(A) by the largest entry of A x over a few random vectors x of signs.
        largest = max(float(np.max(np.abs(self.product(x)), initial=0.0)) for x in probes(self.shape[1]))

        def bound(x: NDArray) -> NDArray:
            return np.full(self.shape[0], largest * np.max(np.abs(x), initial=0.0))

        return bound

    def tangent(self) -> Structure:
        """Return the same map without checks of primal data, for the tangents and cotangents of derivative rules."""
        tangents = [member.tangent() for member in self.members]
        if all(map(is_, tangents, self.members)):
            return self
        return self.rebuilt(tangents)

    def __deepcopy__(self, memo: Any) -> Structure:
        """Return the object itself, because it is immutable, unless a member has state, as a solver has."""
        members = [deepcopy(member, memo) for member in self.members]
        if all(map(is_, members, self.members)):
            return self
        return self.rebuilt(members)

    def rebuilt(self, members: Sequence) -> Structure:
        """Return the same kind of product or sum with other members."""
        return type(self)(members)  # type: ignore[call-arg]

    def product(self, x: NDArray) -> NDArray:
        """Return A x as a new array."""
        out = np.empty(self.shape[0], result_dtype(self, x.dtype))
        self.apply(x, out)
        return out


class Matrix(Structure):
    """A linear map given by its matrix, a read-only csr_array with 32-bit indices.

    Parameters
    ----------
    matrix : sparse matrix or array
        Converted to a csr_array in double precision. The arrays of a csr_array that needs no conversion are not copied,
        and become read-only.
    """

    def __init__(self, matrix: Any) -> None:
        matrix = compact(matrix)
        self.matrix = matrix.astype(np.result_type(matrix.dtype, float), copy=False)
        for part in (self.matrix.data, self.matrix.indices, self.matrix.indptr):
            part.flags.writeable = False  # an Operator is constant
        self.shape = self.matrix.shape
        self.dtype = self.matrix.dtype

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`: see `Structure.act`."""
        out[...] = self.matrix @ x

    def bound(self, dtype: np.dtype) -> BoundProduct:
        """Return the product with arrays of this dtype: see `Structure.bound`."""
        add_product = kernels.product_loop()
        if add_product is None or not dtype == self.dtype == float:
            return super().bound(dtype)
        matrix = self.matrix
        write = partial(add_product, *matrix.shape, matrix.indptr, matrix.indices, matrix.data)
        return BoundProduct(write, zeros=True)

    def transpose(self) -> Structure:
        """Return the plain transpose."""
        return Matrix(self.matrix.T.tocsr())

    def explicit(self) -> sp.csr_array:
        """Return the entries as a csr_array with 32-bit indices."""
        return self.matrix

    def scaled(self, factor: complex) -> Structure | None:
        """Return factor * A."""
        return Matrix(self.matrix * factor)


class Transposable(Structure):
    """A map or its transpose, both computed by the same object `inner`; `transposed` selects one of them.

    Parameters
    ----------
    inner : object
    shape : (rows, columns)
    transposed : bool
    """

    has_entries = False
    takes_complex = False

    def __init__(self, inner: Any, shape: tuple[int, int], transposed: bool = False) -> None:
        self.inner = inner
        self.shape = shape
        self.transposed = transposed

    def bound(self, dtype: np.dtype) -> BoundProduct:
        """Return the product with arrays of this dtype: see `Structure.bound`."""
        if dtype == self.dtype == float:
            return BoundProduct(self.act)
        return super().bound(dtype)

    def transpose(self) -> Structure:
        """Return the plain transpose."""
        rows, columns = self.shape
        return type(self)(self.inner, (columns, rows), not self.transposed)

    def __deepcopy__(self, memo: Any) -> Structure:
        return type(self)(deepcopy(self.inner, memo), self.shape, self.transposed)


def result_dtype(structure: Any, dtype: np.dtype) -> np.dtype:
    """Return the dtype of A x: the dtype of x, or its complex counterpart if A is complex."""
    if structure.dtype.kind == "c" and dtype.kind != "c":
        return np.dtype(np.complex64 if dtype.itemsize <= 4 else np.complex128)
    return dtype


def _product_with_magnitudes(matrix: sp.csr_array, x: NDArray) -> NDArray:
    """Return abs(A) x without a copy of A: the magnitudes of some rows at a time."""
    result = np.empty(matrix.shape[0])
    firsts = np.searchsorted(matrix.indptr, np.arange(0, matrix.nnz, MOST_MAGNITUDES))
    bounds = np.unique([0, *firsts, matrix.shape[0]])
    for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
        entries = slice(matrix.indptr[start], matrix.indptr[stop])
        pointers = matrix.indptr[start : stop + 1] - matrix.indptr[start]
        rows = (np.abs(matrix.data[entries]), matrix.indices[entries], pointers)
        result[start:stop] = sp.csr_array(rows, shape=(stop - start, matrix.shape[1])) @ x
    return result


def compact(matrix: Any) -> sp.csr_array:
    """Return a sparse matrix as a canonical csr_array with 32-bit indices; raise ValueError if it is too large."""
    if matrix.nnz >= INT32_LIMIT or max(matrix.shape) >= INT32_LIMIT:
        raise ValueError(f"an explicit matrix of {matrix.nnz} entries needs 64-bit indices; use the matrix-free form")
    matrix = sp.csr_array(matrix)
    matrix.sum_duplicates()
    matrix.sort_indices()
    matrix.indices = matrix.indices.astype(np.int32, copy=False)
    matrix.indptr = matrix.indptr.astype(np.int32, copy=False)
    return matrix


def assembled(structure: Structure, name: str) -> Matrix:
    """Return a structure as a Matrix, and record the assembly in the counters under the name of the operator."""
    count(name, "assembled")
    return Matrix(structure.explicit())


def probes(size: int) -> list[NDArray]:
    """Return a few vectors of random signs. The random generator has a fixed seed."""
    generator = np.random.default_rng(0)
    return [generator.choice([-1.0, 1.0], size) for _ in range(PROBES)]


def rows_of(matrix: sp.csr_array) -> NDArray:
    """Return the row of each entry of a csr_array."""
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def columns_by_application(structure: Structure) -> sp.csr_array:
    """Return the matrix of a map as a csr_array, by applying the map to every unit vector."""
    size = structure.shape[1]
    columns = [sp.csc_array(structure.product(np.eye(1, size, column)[0])[:, None]) for column in range(size)]
    if not columns:
        return compact(sp.csr_array(structure.shape))
    return compact(sp.hstack(columns))
