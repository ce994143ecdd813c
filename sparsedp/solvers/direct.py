"""Direct solves: factor once, keep the factors, solve with them and with their transpose.

Dense LU up to 64 unknowns, sparse LU (SuperLU) otherwise: on a 1-D chain of 1000 it solves in 20 us, LAPACK for bands
in 30. Of a block triangular matrix only the diagonal blocks are factored (see `BlockFactors`). A singular system
is factored with one unknown of each component pinned. Rounding is left to the contract's refinement, that of factors
in single precision too: they take half the memory, and a solve with them leaves a hundredth of the residual or less,
next to an eigenvector more (see MOST_LEFT).
A full matrix of up to 64 unknowns takes microseconds to factor; finding its components, signs and symmetries takes a
thousand times longer. `DenseSystem` does without them; what needs them, a singular matrix say, is not for it.
SciPy changes the pivots of LAPACK while a solve runs, and back: every solve gets pivots of its own, for another
thread may be solving with the same factors.
"""

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

__all__ = ["DENSE_UP_TO", "DenseSystem", "check_precision", "dense_engine", "dense_lu", "direct_engine"]

DENSE_UP_TO = 64
MOST_GROWTH = 2.0**49  # |A^-1| |A| beyond this leaves no digit
# Share of the data next to an eigenvector that a solve in single precision may leave, each refinement in turn.
# Measured on waves: 0.001 at 256^2, 0.07 at 1024^2, more for slanted ones; a source leaves 0.0003 and 0.005.
MOST_LEFT = 0.8
MOST_ROUNDS = 124  # that lead from 1 to 1e-12
# From here on "auto" keeps the factors of complex matrices in single precision. Measured, value and gradient of waves
# of 10 cells in two speeds at 1024^2: 16 s and 3.0 GB in double, 13 s and 2.2 GB in single precision, 4 solves for a
# residual of 1e-10.
SINGLE_FROM = 2**20
LEAST_CONDITION = 2.0**-40  # 1 / (|A^-1| |A|): below this a full matrix may be a singular one


class Direct(Engine):
    """The engine that solves with kept LU factors.

    Parameters
    ----------
    solve : callable
        solve(b, transposed)
    words : str
        What the factors are.
    anchors : int array
        Unknowns that are pinned.
    single : bool
        Whether the factors are in single precision.
    unknowns : int array, optional
        Those that the factors are of; None: all.
    """

    method = "direct"

    def __init__(self, solve, words, anchors=(), single=False, unknowns=None):
        self._solve, self.hierarchy, self._anchors, self.iterative = solve, words, anchors, single
        self._unknowns = unknowns
        if single:
            self.most_refinements, self.reduction = MOST_ROUNDS, MOST_LEFT
            self.advice = "; write precision='double'"

    def solve(self, b, goal, transposed):
        """One pair of triangular solves."""
        if len(self._anchors):
            b = b.copy()
            b[self._anchors] = 0.0
        if self._unknowns is None:
            return self._solve(b, transposed), 0, ""
        x = np.zeros_like(b)
        x[self._unknowns] = self._solve(b[self._unknowns], transposed)
        return x, 0, ""


def direct_engine(system, *, precision="auto"):
    """System -> Direct.

    Parameters
    ----------
    system : System
    precision : "auto", "single" or "double"
        Of the factors of sparse LU; solutions meet the tolerance in either. "auto": single from 2^20 complex
        unknowns on. Where refinement of single precision would not converge, it is double.

    Raises
    ------
    ValueError
        If `precision` is another word.
    ConvergenceError
        With status setup_failed, when the matrix cannot be inverted and its null space is not known.
    """
    check_precision(precision)
    single = precision == "single" or (precision == "auto" and system.complex and system.unknowns >= SINGLE_FROM)
    matrix, unknowns = system.regular_matrix, None
    if system.active is not None:
        unknowns = np.flatnonzero(system.active)
        matrix = matrix[unknowns][:, unknowns]
    size = matrix.shape[0]
    if size <= DENSE_UP_TO:
        solve, words, single = dense_lu(matrix.toarray())[0], "dense LU", False
    else:
        solve, words = _sparse(matrix, system, single)
    growth, left = _growth(matrix, solve)
    if single and not left < MOST_LEFT:
        return direct_engine(system, precision="double")
    if not growth < MOST_GROWTH:
        raise ConvergenceError(
            f"{system.unscaled} is singular and its null space is neither constant nor that of the volumes, or its "
            "condition number is beyond 1e14; add a shift, or remove the rows that depend on others",
            info=failure("setup_failed"),
        )
    words = f"{words}, {size} rows, {matrix.nnz} entries"
    return Direct(solve, words, system.null_space.anchors(), single, unknowns)


def check_precision(precision="auto"):
    """Refuse a word for the precision that is not known."""
    check_choice("precision", precision, ("auto", "single", "double"))


def _growth(matrix, solve):
    """Solutions for row sums times numbers up to 1 are of order |A^-1| |A|: huge when A is singular.

    The numbers are random signs, then what comes of them: next to an eigenvalue, its own vector. Of these last data
    the share that their solution leaves is returned too.
    """
    size = matrix.shape[0]
    if not size:
        return 0.0, 0.0
    sums = abs(matrix) @ np.ones(size)
    with np.errstate(all="ignore"):
        images = [solve((sums * probe).astype(matrix.dtype), False) for probe in probes(size)]
        growth, image = max(((np.max(np.abs(image)), image) for image in images), key=lambda pair: pair[0])
        data = sums * (image / growth)
        last = solve(data, False)
        return max(growth, np.max(np.abs(last))), norm(data - matrix @ last) / norm(data)


class DenseSystem(System):
    """A small full system, of which only sizes are known.

    Parameters
    ----------
    op : Operator
        Explicit, and real.
    rtol : float
    """

    active, splitting, null_space = None, None, NullSpace.none()
    exponent = 0

    def __init__(self, op, rtol):
        self.unscaled = self.op = op
        self.size, self.rtol, self.maxiter = op.shape[0], rtol, None
        self.dense = op.matrix.toarray()
        sizes = np.abs(self.dense)
        self._magnitudes = sizes.dot, sizes.T.dot
        self.norms = float(sizes.sum(1).max(initial=0.0)), float(sizes.sum(0).max(initial=0.0))

    def product(self, x, transposed=False):
        return (self.dense.T if transposed else self.dense) @ x

    applied = product


def dense_engine(system):
    """DenseSystem -> Direct, or None where the matrix may be a singular one."""
    size = system.norm(False)
    solve, condition = dense_lu(system.dense, size) if in_range(size) else (None, 0.0)
    return Direct(solve, f"dense LU, {system.size} rows") if condition > LEAST_CONDITION else None


def dense_lu(matrix, size=None):
    """2-D array -> (solve(b, transposed), 1 / (|A^-1| |A|) where its norm is given)."""
    getrf, getrs, gecon = la.lapack.get_lapack_funcs(("getrf", "getrs", "gecon"), dtype=matrix.dtype)
    factors, pivots, singular = getrf(matrix)
    condition = 0.0 if size is None or singular else gecon(factors, size, norm="I")[0]
    return (lambda b, transposed: getrs(factors, pivots.copy(), b, trans=int(transposed))[0]), condition


def _sparse(matrix, system, single):
    # With a symmetric pattern and a strong diagonal, pivots stay on it: less fill, three times faster. Waves at 1024^2:
    # 82 million entries and 15 s, where an order of the columns leaves 163 million and takes 32 s. Nested dissection
    # along the axes of the grid leaves 106 million and takes 15 s too.
    diagonal = matrix.diagonal()
    one_sided = np.all((diagonal * np.conj(np.sum(diagonal))).real > 0)  # of one sign; complex ones of one half plane
    options = dict(permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.001, options=dict(SymmetricMode=True))
    symmetric_mode = one_sided and system.symmetric
    given, exponent, low = csc_array(matrix), 0, np.complex64 if system.complex else np.float32
    if single:
        exponent = exponent_of(largest(given.data))
        given = csc_array((shifted(given.data, -exponent).astype(low), given.indices, given.indptr), given.shape)
    try:
        if not (single or symmetric_mode):
            blocks = BlockFactors.of(csr_array(matrix))
            if blocks is not None:
                return blocks.solve, blocks.words
        factors = splu(given, **(options if symmetric_mode else {}))
    except RuntimeError:  # exactly singular
        return (lambda b, transposed: np.full(b.shape, np.nan, matrix.dtype)), "sparse LU"
    except MemoryError:
        advice = "method='krylov', preconditioner='shifted_laplace'" if system.complex else "method='multigrid'"
        message = f"sparse LU of {system.unscaled} does not fit into memory; write {advice}"
        raise ConvergenceError(message, info=failure("setup_failed")) from None
    solve = lambda b, transposed: factors.solve(b, trans="T" if transposed else "N")
    if not single:
        return solve, f"sparse LU, {factors.nnz} entries in the factors"

    def scaled(b, transposed):
        size = exponent_of(largest(b))
        x = solve(shifted(b, -size).astype(low), transposed)
        return shifted(x.astype(matrix.dtype), size - exponent)

    return scaled, f"sparse LU in single precision, {factors.nnz} entries in the factors"
