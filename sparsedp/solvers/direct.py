"""Direct solves: factor once, keep the factors, solve with them and with their transpose.

Dense LU up to 64 unknowns, banded LU for 1-D chains, sparse LU (SuperLU) otherwise. A singular system
is factored with one unknown of each component pinned. Rounding is left to the contract's refinement.
SciPy changes the pivots of LAPACK while a solve runs, and back: every solve gets pivots of its own, for another
thread may be solving with the same factors.
"""

from functools import partial

import numpy as np
import scipy.linalg as la
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from sparsedp.errors import ConvergenceError
from sparsedp.solvers.contract import Engine
from sparsedp.solvers.record import failure
from sparsedp.structure.base import probes

__all__ = ["Direct", "direct_engine"]

DENSE_UP_TO = 64
BAND_UP_TO = 8  # half bandwidth up to which banded LU is used
MOST_GROWTH = 2.0**49  # |A^-1| |A| beyond this leaves no digit


def direct_engine(system):
    """System -> Direct: LU factors, kept.

    Parameters
    ----------
    system : System

    Returns
    -------
    Direct

    Raises
    ------
    ConvergenceError
        With status setup_failed, when the matrix cannot be inverted and its null space is not known.
    """
    return Direct(system)


class Direct(Engine):
    """The engine that solves with kept LU factors."""

    method = "direct"
    overwrites = False

    def __init__(self, system):
        matrix = system.regular_matrix
        self._anchors = system.null_space.anchors()
        lower, upper = _bandwidths(matrix)
        if system.size <= DENSE_UP_TO:
            self._solve, words = _dense(matrix)
        elif max(lower, upper) <= BAND_UP_TO:
            self._solve, words = _banded(matrix, lower, upper)
        else:
            self._solve, words = _sparse(matrix, system)
        self.hierarchy = f"{words}, {system.size} rows, {matrix.nnz} entries"
        self._refuse_singular(system, matrix)

    def solve(self, b, goal, transposed):
        """One pair of triangular solves."""
        if self._anchors.size:
            b = b.copy()
            b[self._anchors] = 0.0
        return self._solve(b, transposed), 0, ""

    def _refuse_singular(self, system, matrix):
        """Solutions for row sums times random signs are of order |A^-1| |A|: huge when A is singular."""
        if not system.size:
            return
        sums = abs(matrix) @ np.ones(system.size)
        with np.errstate(all="ignore"):
            growth = max(
                np.max(np.abs(self._solve((sums * probe).astype(matrix.dtype), False))) for probe in probes(system.size)
            )
        if not growth < MOST_GROWTH:
            raise ConvergenceError(
                f"{system.given} is singular and its null space is neither constant nor that of the volumes, or its "
                "condition number is beyond 1e14; add a shift, or remove the rows that depend on others",
                info=failure("setup_failed"),
            )


def _dense(matrix):
    factors, pivots = la.lapack.get_lapack_funcs("getrf", dtype=matrix.dtype)(matrix.toarray())[:2]
    getrs = la.lapack.get_lapack_funcs("getrs", dtype=matrix.dtype)
    return (lambda b, transposed: getrs(factors, pivots.copy(), b, trans=int(transposed))[0]), "dense LU"


def _bandwidths(matrix):
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    offsets = matrix.indices - row
    return -int(offsets.min(initial=0)), int(offsets.max(initial=0))


def _banded(matrix, lower, upper):
    size = matrix.shape[0]
    bands = np.zeros((2 * lower + upper + 1, size), matrix.dtype)  # `lower` extra rows for the pivots
    row = np.repeat(np.arange(size), np.diff(matrix.indptr))
    bands[lower + upper + row - matrix.indices, matrix.indices] = matrix.data
    factor, solve = la.lapack.get_lapack_funcs(("gbtrf", "gbtrs"), dtype=matrix.dtype)
    factors, pivots, _ = factor(bands, lower, upper)
    return (
        lambda b, transposed: solve(factors, lower, upper, b, pivots.copy(), trans=int(transposed))[0]
    ), f"banded LU of {lower + upper + 1} diagonals"


def _sparse(matrix, system):
    # With a symmetric pattern and a strong diagonal, pivots stay on it: less fill, three times faster.
    symmetric = system.sign != 0 and system.symmetric
    options = dict(permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.001, options=dict(SymmetricMode=True))
    try:
        factors = splu(csc_array(matrix), **(options if symmetric else {}))
    except RuntimeError:  # exactly singular
        return partial(_never, matrix.dtype), "sparse LU"
    except MemoryError:
        message = f"sparse LU of {system.given} does not fit into memory; write method='multigrid'"
        raise ConvergenceError(message, info=failure("setup_failed")) from None
    words = f"sparse LU, {factors.nnz} entries in the factors"
    return (lambda b, transposed: factors.solve(b, trans="T" if transposed else "N")), words


def _never(dtype, b, transposed):
    return np.full(b.shape, np.nan, dtype)
