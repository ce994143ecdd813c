"""Structure: what acts linearly on flat arrays. Its plainest kind is a matrix."""

from copy import deepcopy
from operator import is_

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.counters import count
from sparsedp._utils.reconstruction import Uncached

__all__ = [
    "INT32_LIMIT",
    "Matrix",
    "Structure",
    "Turning",
    "assembled",
    "compact",
    "probes",
    "result_dtype",
    "rows_of",
]

INT32_LIMIT = 2**31
PROBES = 3  # random vectors with which a map without entries is examined


class Structure(Uncached):
    """A linear map on flat contiguous arrays. Frozen.

    Attributes
    ----------
    shape : (rows, columns)
    dtype : numpy dtype
        float64 or complex128: the field the entries live in.
    members : tuple of Structures
        What it is made of, where it is made of others.
    has_entries : bool
        Whether `explicit()` can list the entries without applying the map to every unit vector.
    takes_complex : bool
        Whether `act` takes complex arrays; else real and imaginary parts go through it apart.
    separable : bool
        Whether it is a Kronecker sum: one 1-D factor for each axis.
    depth : int
        How deep products and sums are nested in it.
    passes : int
        How many passes over memory the map takes where it is not fused: for the choice of a form.
    """

    shape: tuple[int, int]
    dtype = np.dtype(float)
    members: tuple = ()
    has_entries = True
    takes_complex = True
    is_identity = False
    separable = False
    depth = 0
    passes = 1  # over memory, of the matrix-free form

    def apply(self, x, out):
        """Write A x into `out`. Both flat and contiguous, out of dtype result_dtype(self, x.dtype).

        All is computed in double precision, and rounded once.
        """
        if x.dtype.char in "fF":
            np.copyto(out, self.product(x.astype(np.result_type(x.dtype, float))), casting="same_kind")
        elif x.dtype.kind == "c" and not self.takes_complex:
            out.real, out.imag = (self.product(part.copy()) for part in (x.real, x.imag))
        else:
            self.act(x, out)

    def act(self, x, out):
        """As `apply`, for float64 and, where it takes them, complex128."""
        raise TypeError(f"{type(self).__name__} does not say how it acts")

    def transpose(self):
        """The plain transpose, as a Structure."""
        raise TypeError(f"{type(self).__name__} has no transpose")

    def explicit(self):
        """The entries as a csr_array with 32-bit indices."""
        return columns_by_application(self)

    def scaled(self, factor):
        """factor * A; None where it cannot take the number in."""
        return None

    def magnitude(self):
        """The function x -> an upper bound of |A| x, entry by entry, for x >= 0."""
        if self.has_entries:
            return abs(self.explicit()).dot
        # A map that only acts: the largest response to random signs stands for every row.
        largest = max(float(np.max(np.abs(self.product(x)), initial=0.0)) for x in probes(self.shape[1]))
        return lambda x: np.full(self.shape[0], largest * np.max(np.abs(x), initial=0.0))

    def tangent(self):
        """The same map inside derivative rules: without checks that only primal data must meet."""
        tangents = [member.tangent() for member in self.members]
        return self if all(map(is_, tangents, self.members)) else self.rebuilt(tangents)

    def __deepcopy__(self, memo):
        """The same object, because it is frozen, unless a member holds what changes, as a solver."""
        members = [deepcopy(member, memo) for member in self.members]
        return self if all(map(is_, members, self.members)) else self.rebuilt(members)

    def rebuilt(self, members):
        """The same of other members."""
        return type(self)(members)  # type: ignore[call-arg]

    def product(self, x):
        """A x as a fresh array."""
        out = np.empty(self.shape[0], result_dtype(self, x.dtype))
        self.apply(x, out)
        return out


class Matrix(Structure):
    """The explicit form: a csr_array with 32-bit indices, owned and never changed.

    Parameters
    ----------
    matrix : sparse matrix or array
        Copied when it is not already compact.
    """

    def __init__(self, matrix):
        matrix = compact(matrix)
        self.matrix = matrix.astype(np.result_type(matrix.dtype, float), copy=False)
        for part in (self.matrix.data, self.matrix.indices, self.matrix.indptr):
            part.flags.writeable = False  # an Operator is constant: nobody may write into it
        self.shape, self.dtype = self.matrix.shape, self.matrix.dtype

    def act(self, x, out):
        out[...] = self.matrix @ x

    def transpose(self):
        return Matrix(self.matrix.T.tocsr())

    def explicit(self):
        return self.matrix

    def scaled(self, factor):
        return Matrix(self.matrix * factor)


class Turning(Structure):
    """A map that one thing, `inner`, does both ways: a subclass acts as `transposed` says."""

    has_entries = takes_complex = False

    def __init__(self, inner, shape, transposed=False):
        self.inner, self.shape, self.transposed = inner, shape, transposed

    def transpose(self):
        return type(self)(self.inner, self.shape[::-1], not self.transposed)

    def __deepcopy__(self, memo):
        return type(self)(deepcopy(self.inner, memo), self.shape, self.transposed)


def result_dtype(structure, dtype):
    """Dtype of A x for x of `dtype`: the dtype of x, complex when A is."""
    if structure.dtype.kind == "c" and dtype.kind != "c":
        return np.dtype(np.complex64 if dtype.itemsize <= 4 else np.complex128)
    return dtype


def compact(matrix):
    """Any sparse matrix -> canonical csr_array with 32-bit indices; refuses what needs more."""
    if matrix.nnz >= INT32_LIMIT or max(matrix.shape) >= INT32_LIMIT:
        raise ValueError(f"an explicit matrix of {matrix.nnz} entries needs 64-bit indices; use the matrix-free form")
    matrix = sp.csr_array(matrix)
    matrix.sum_duplicates()
    matrix.sort_indices()
    matrix.indices, matrix.indptr = (part.astype(np.int32, copy=False) for part in (matrix.indices, matrix.indptr))
    return matrix


def assembled(structure, name):
    """Structure -> its entries as a Matrix, counted under the name of the operator."""
    count(name, "assembled")
    return Matrix(structure.explicit())


def probes(size):
    """The same few vectors of random signs in every run."""
    generator = np.random.default_rng(0)
    return [generator.choice([-1.0, 1.0], size) for _ in range(PROBES)]


def rows_of(matrix):
    """csr_array -> the row of each entry."""
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def columns_by_application(structure):
    """Entries of a map that only knows how to act: one application for each column."""
    size = structure.shape[1]
    columns = [sp.csc_array(structure.product(np.eye(1, size, column)[0])[:, None]) for column in range(size)]
    return compact(sp.hstack(columns) if columns else sp.csr_array(structure.shape))
