"""Matrix: a linear map given by its entries."""

import numpy as np

from sparsedp.ledger import active, count
from sparsedp.structure.base import Structure, compact

__all__ = ["Matrix", "assembled"]


class Matrix(Structure):
    """The explicit form: a csr_array with 32-bit indices, owned and never changed.

    Parameters
    ----------
    matrix : sparse matrix or array
        Copied when it is not already compact.
    """

    def __init__(self, matrix):
        self.matrix = compact(matrix)
        if self.matrix.dtype not in (np.float64, np.complex128):
            wide = np.complex128 if self.matrix.dtype.kind == "c" else np.float64
            self.matrix = self.matrix.astype(wide)
        for part in (self.matrix.data, self.matrix.indices, self.matrix.indptr):
            part.flags.writeable = False  # an Operator is constant: nobody may write into it
        self.shape = self.matrix.shape
        self.dtype = self.matrix.dtype

    def apply(self, x, out):
        wide = x.astype(np.result_type(x.dtype, np.float64), copy=False)  # SciPy has no product in half precision
        np.copyto(out, self.matrix @ wide, casting="same_kind")

    def transpose(self):
        return Matrix(self.matrix.T.tocsr())

    def explicit(self):
        return self.matrix

    def scaled(self, factor):
        return Matrix(self.matrix * factor)


def assembled(structure, name):
    """Structure -> its entries as a Matrix, counted under the name of the operator."""
    if active:
        count(name, "assembled")
    return Matrix(structure.explicit())
