"""Sparse matrices whose symmetry is examined or kept: equal to their mirror image, rows pinned with their columns."""

import numpy as np
import scipy.sparse as sp

from sparsedp.solvers.nullspace import ROUNDING

__all__ = ["factor_symmetric", "matrix_symmetric", "pinned"]


def pinned(matrix, flags):
    """Matrix -> copy whose flagged rows and columns are those of the identity, scaled to its entries."""
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    keep = ~(flags[row] | flags[matrix.indices])
    size = matrix.diagonal()[~flags]
    largest = size[np.argmax(np.abs(size))] if size.size and np.any(size) else 1.0
    kept = sp.csr_array((matrix.data * keep, matrix.indices, matrix.indptr), shape=matrix.shape)
    result = sp.csr_array(kept + sp.diags_array(np.where(flags, largest, 0.0), format="csr"))
    result.eliminate_zeros()
    return result


def factor_symmetric(term, widths, power):
    for axis in term.axes:
        factor = term.factors[axis].matrix
        scale = np.ones(factor.shape[0]) if widths is None else widths[axis] ** power
        if not matrix_symmetric(sp.csr_array(factor * scale[:, None])):
            return False
    return True


def matrix_symmetric(matrix):
    """Whether the entries equal their mirror images up to rounding."""
    turned = matrix.T.tocsr()
    excess = abs(matrix - turned) - ROUNDING * (abs(matrix) + abs(turned))
    return excess.nnz == 0 or float(excess.max()) <= 0
