"""Direct solves: factor once, keep the factors, solve with them and with their transpose.

Dense LU up to 64 unknowns, sparse LU (SuperLU) otherwise: on a 1-D chain of 1000 it solves in 20 us, LAPACK for bands
in 30. Of a block triangular matrix only the diagonal blocks are factored (see `BlockFactors`). A singular system
is factored with one unknown of each component pinned. Rounding errors are reduced by the refinement of the contract,
those of factors in single precision too: they take half the memory, and a solve with them leaves a hundredth of the
residual or less, next to an eigenvector more (see LARGEST_REDUCTION).
A full matrix of up to 64 unknowns takes microseconds to factor; finding its components, signs and symmetries takes a
thousand times longer. `DenseSystem` does without them, and is not for matrices that need them, such as singular ones.
SciPy changes the pivots of LAPACK during a solve, and back: every solve gets a copy of them, because another
thread may be solving with the same factors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg as la
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from sparsedp._utils.validation import check_choice
from sparsedp.errors import ConvergenceError
from sparsedp.operators.structure.base import probes
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.records import failure
from sparsedp.solvers.scaling import exponent_of, in_range, largest, norm, shifted
from sparsedp.solvers.substitution import BlockFactors
from sparsedp.solvers.system import System

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.operators.operator import Operator

    Solve = Callable[[np.ndarray, bool], np.ndarray]  # solve(b, transposed)

__all__ = ["DENSE_UP_TO", "DenseSystem", "check_precision", "dense_engine", "dense_lu", "direct_engine"]

DENSE_UP_TO = 64
LARGEST_GROWTH = 2.0**49  # |A^-1| |A| beyond this leaves no correct digit
LEAST_CONDITION = 2.0**-40  # 1 / (|A^-1| |A|) below which a full matrix may be a singular one
# Share of the data next to an eigenvector that a solve in single precision may leave, in each refinement.
# Measured on waves: 0.001 at 256^2, 0.07 at 1024^2, more for slanted ones; a source leaves 0.0003 and 0.005.
LARGEST_REDUCTION = 0.8
MOST_REFINEMENTS = 124  # with that reduction they lead from 1 to 1e-12
# From here on "auto" keeps the factors of complex matrices in single precision. Measured, value and gradient of waves
# of 10 cells in two speeds at 1024^2: 16 s and 3.0 GB in double, 13 s and 2.2 GB in single precision, 4 solves for a
# residual of 1e-10.
SINGLE_FROM = 2**20
# Options of SuperLU with which pivots stay on the diagonal: for a symmetric pattern and a strong diagonal this gives
# less fill-in and is three times faster. Waves at 1024^2: 82 million entries and 15 s, where an order of the columns
# gives 163 million and takes 32 s. Nested dissection along the axes of the grid gives 106 million and takes 15 s too.
SYMMETRIC_MODE: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.001,
    "options": {"SymmetricMode": True},
}


class Direct(Engine):
    """The engine that solves with kept LU factors.

    Parameters
    ----------
    solve : callable
        solve(b, transposed)
    description : str
        Of the factors.
    anchors : int array
        Unknowns that are pinned.
    single : bool
        Whether the factors are in single precision.
    unknowns : int array, optional
        The unknowns of the factors. Default: all.
    """

    method = "direct"

    def __init__(
        self,
        solve: Solve,
        description: str,
        anchors: Sequence[int] | np.ndarray = (),
        single: bool = False,
        unknowns: np.ndarray | None = None,
    ) -> None:
        self.hierarchy = description
        self.iterative = single
        self._solve = solve
        self._anchors = anchors
        self._unknowns = unknowns
        if single:
            self.most_refinements = MOST_REFINEMENTS
            self.reduction = LARGEST_REDUCTION
            self.advice = "; write precision='double'"

    def solve(self, b: np.ndarray, goal: float, transposed: bool) -> tuple[np.ndarray, int, str]:
        """Solve with both triangular factors."""
        if len(self._anchors):
            b = b.copy()
            b[self._anchors] = 0.0
        if self._unknowns is None:
            return self._solve(b, transposed), 0, ""
        x = np.zeros_like(b)
        x[self._unknowns] = self._solve(b[self._unknowns], transposed)
        return x, 0, ""


def direct_engine(system: System, *, precision: str = "auto") -> Direct:
    """Factor the matrix of a system.

    Parameters
    ----------
    system : System
    precision : "auto", "single" or "double"
        Of the factors of sparse LU; solutions meet the tolerance in either. "auto": single from 2^20 complex
        unknowns on. Where refinement of single precision would not converge, it is double.

    Returns
    -------
    Direct

    Raises
    ------
    ValueError
        If `precision` is another word.
    ConvergenceError
        With status setup_failed, when the matrix cannot be inverted and its null space is not known.
    """
    check_precision(precision)
    single = precision == "single" or (precision == "auto" and system.complex and system.unknowns >= SINGLE_FROM)
    matrix = system.regular_matrix
    unknowns = None
    if system.active is not None:
        unknowns = np.flatnonzero(system.active)
        matrix = matrix[unknowns][:, unknowns]
    size = matrix.shape[0]
    if size <= DENSE_UP_TO:
        single = False
        solve, _ = dense_lu(matrix.toarray())
        description = "dense LU"
    else:
        solve, description = _sparse_lu(matrix, system, single)
    growth, reduction = _growth_and_reduction(matrix, solve)
    if single and not reduction < LARGEST_REDUCTION:
        return direct_engine(system, precision="double")
    if not growth < LARGEST_GROWTH:
        raise ConvergenceError(
            f"{system.unscaled} is singular and its null space is neither the constants nor the volumes, or its "
            "condition number is beyond 1e14; add a shift, or remove the rows that depend on others",
            info=failure("setup_failed"),
        )
    description = f"{description}, {size} rows, {matrix.nnz} entries"
    return Direct(solve, description, system.null_space.anchors(), single, unknowns)


def check_precision(precision: str = "auto") -> None:
    """Refuse a precision that is not known."""
    check_choice("precision", precision, ("auto", "single", "double"))


def _growth_and_reduction(matrix: csr_array, solve: Solve) -> tuple[float, float]:
    """Return an estimate of |A^-1| |A|, and the share of data next to an eigenvector that a solve leaves.

    Solutions for row sums times numbers up to 1 are of order |A^-1| |A|: huge when A is singular. The numbers are
    random signs, then the solution for these: next to an eigenvalue, its own vector.
    """
    size = matrix.shape[0]
    if not size:
        return 0.0, 0.0
    sums = abs(matrix) @ np.ones(size)
    with np.errstate(all="ignore"):
        growth = 0.0
        image: Any = None
        for probe in probes(size):
            solution = solve((sums * probe).astype(matrix.dtype), False)
            largest_entry = np.max(np.abs(solution))
            if image is None or largest_entry > growth:
                growth = largest_entry
                image = solution
        data = sums * (image / growth)
        solution = solve(data, False)
        return max(growth, np.max(np.abs(solution))), norm(data - matrix @ solution) / norm(data)


# ---- small full matrices ----


class DenseSystem(System):
    """A small full system, of which only sizes are known.

    Parameters
    ----------
    op : Operator
        Explicit, and real.
    rtol : float
    """

    active = None
    splitting = None
    null_space = NullSpace.none()

    def __init__(self, op: Operator, rtol: float) -> None:
        self.op = op
        self.unscaled = op
        self.exponent = 0
        self.size = op.shape[0]
        self.rtol = rtol
        self.maxiter = None
        self.dense = op.matrix.toarray()
        sizes = np.abs(self.dense)
        self._magnitudes = (sizes.dot, sizes.T.dot)
        self.norms = (float(sizes.sum(1).max(initial=0.0)), float(sizes.sum(0).max(initial=0.0)))

    def product(self, x: np.ndarray, transposed: bool = False) -> np.ndarray:
        """Return A x or A^T x."""
        return (self.dense.T if transposed else self.dense) @ x

    def applied(self, x: np.ndarray) -> np.ndarray:
        """Return A x."""
        return self.dense @ x


def dense_engine(system: DenseSystem) -> Direct | None:
    """Factor a small full matrix; return None if it may be a singular one."""
    size = system.norm(False)
    if not in_range(size):
        return None
    solve, condition = dense_lu(system.dense, size)
    if not condition > LEAST_CONDITION:  # smaller, or NaN
        return None
    return Direct(solve, f"dense LU, {system.size} rows")


def dense_lu(matrix: np.ndarray, size: float | None = None) -> tuple[Solve, float]:
    """Factor a 2-D array.

    Parameters
    ----------
    matrix : array, shape (n, n)
    size : float, optional
        |A|_inf, if the condition number is wanted.

    Returns
    -------
    solve : callable
        ``solve(b, transposed)``
    condition : float
        1 / (|A^-1| |A|); 0 without `size` and for a singular matrix.
    """
    getrf, getrs, gecon = la.lapack.get_lapack_funcs(("getrf", "getrs", "gecon"), dtype=matrix.dtype)
    factors, pivots, singular = getrf(matrix)
    condition = 0.0
    if size is not None and not singular:
        condition = gecon(factors, size, norm="I")[0]

    def solve(b: np.ndarray, transposed: bool) -> np.ndarray:
        return getrs(factors, pivots.copy(), b, trans=int(transposed))[0]

    return solve, condition


# ---- sparse matrices ----


def _sparse_lu(matrix: csr_array, system: System, single: bool) -> tuple[Solve, str]:
    """Factor a sparse matrix; return solve(b, transposed) and a description of the factors."""
    symmetric_mode = _has_diagonal_of_one_sign(matrix) and system.symmetric
    exponent = 0
    columns = csc_array(matrix)
    if single:
        exponent = exponent_of(largest(columns.data))
        entries: np.ndarray = shifted(columns.data, -exponent).astype(_single_dtype(system))
        columns = csc_array((entries, columns.indices, columns.indptr), columns.shape)
    try:
        if not (single or symmetric_mode):
            blocks = BlockFactors.of(csr_array(matrix))
            if blocks is not None:
                return blocks.solve, blocks.words
        if symmetric_mode:
            factors = splu(columns, **SYMMETRIC_MODE)
        else:
            factors = splu(columns)
    except RuntimeError:  # exactly singular
        return _nan_for(matrix), "sparse LU"
    except MemoryError:
        advice = "method='multigrid'"
        if system.complex:
            advice = "method='krylov', preconditioner='shifted_laplace'"
        message = f"sparse LU of {system.unscaled} does not fit into memory; write {advice}"
        raise ConvergenceError(message, info=failure("setup_failed")) from None

    def solve(b: np.ndarray, transposed: bool) -> np.ndarray:
        return factors.solve(b, trans="T" if transposed else "N")

    def solve_in_single_precision(b: np.ndarray, transposed: bool) -> np.ndarray:
        size = exponent_of(largest(b))
        x = solve(shifted(b, -size).astype(_single_dtype(system)), transposed)
        return shifted(x.astype(matrix.dtype), size - exponent)

    if single:
        return solve_in_single_precision, f"sparse LU in single precision, {factors.nnz} entries in the factors"
    return solve, f"sparse LU, {factors.nnz} entries in the factors"


def _has_diagonal_of_one_sign(matrix: csr_array) -> bool:
    """Return whether the diagonal has one sign; if it is complex, whether it lies in one half plane."""
    diagonal = matrix.diagonal()
    return bool(np.all((diagonal * np.conj(np.sum(diagonal))).real > 0))


def _single_dtype(system: System) -> type:
    """Return the dtype of factors in single precision."""
    return np.complex64 if system.complex else np.float32


def _nan_for(matrix: csr_array) -> Solve:
    """Return the solve of a matrix that has no factors."""

    def solve(b: np.ndarray, transposed: bool) -> np.ndarray:
        return np.full(b.shape, np.nan, matrix.dtype)

    return solve
