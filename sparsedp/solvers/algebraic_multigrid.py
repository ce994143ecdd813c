"""Algebraic multigrid: PyAMG builds the Ruge-Stueben hierarchy; the cycle is implemented here with its transpose.

One cycle is a linear map M ~ A^-1. With pre-smoothing sweeps s_1 ... s_m, prolongation P, restriction R
and post-smoothing sweeps t_1 ... t_n, its transpose is the cycle on A^T with prolongation R^T,
restriction P^T, pre-smoothing t_n^T ... t_1^T and post-smoothing s_m^T ... s_1^T; the transpose of a
forward Gauss-Seidel sweep on A is a backward sweep on A^T.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.linalg as la
from scipy.sparse import csr_array, csr_matrix
from scipy.sparse.csgraph import connected_components

from sparsedp._utils.validation import check_choice, check_number, check_whole
from sparsedp.errors import ConvergenceError
from sparsedp.solvers.krylov import Krylov
from sparsedp.solvers.records import failure
from sparsedp.solvers.scaling import exponent_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from scipy.sparse import sparray

    from sparsedp.solvers.system import System

    Sweeps = Sequence[str]  # "forward" or "backward"
    Solve = Callable[[np.ndarray, bool], np.ndarray]  # solve(b, transposed)

__all__ = [
    "Hierarchy",
    "Level",
    "Multigrid",
    "check_multigrid_options",
    "coarse_solver",
    "colour_graph",
    "multigrid_engine",
    "ruge_stueben",
]

CYCLES = {"V": 1, "W": 2}  # how often one cycle visits the next coarser level
MIRRORED = {"forward": "backward", "backward": "forward"}
COARSEST = 100  # a level with at most this number of unknowns is not coarsened, but solved by dense LU
DENSE_UP_TO = 2000  # largest coarsest level if coarsening ends before COARSEST; its dense matrix takes 32 MB
MAXITER = 200
RESIDUE = 1e-13  # a coarse row is rounding error below this fraction of the fine entries summed for it
ZERO_ROW_SUM = 1e-9  # a row sum below this fraction of the sum of magnitudes counts as 0
SMALLEST_PIVOT = 1e-14  # a pivot below this fraction of the largest entry of its row counts as 0
PINV_CUTOFF = 1e-10  # relative singular value below which the pseudo-inverse treats it as 0


def multigrid_engine(
    system: System,
    *,
    cycle: str = "V",
    strength: float = 0.25,
    sweeps: Sequence[Sweeps] = (("forward",), ("backward",)),
    levels: int = 25,
) -> Multigrid:
    """Build a Krylov solver preconditioned by one multigrid cycle: conjugate gradients, or GMRES if not symmetric.

    Parameters
    ----------
    system : System
        Its matrix entries must be known, and all diagonal entries must have the same sign.
    cycle : "V" or "W"
        A W-cycle costs more per iteration, and needs fewer iterations where coefficients jump. There is no F-cycle,
        because its transpose is not an F-cycle.
    strength : float
        An off-diagonal entry is a strong connection if it is at least this fraction of the largest one in its row,
        0 <= strength < 1.
    sweeps : pair of tuples of "forward" and "backward"
        Gauss-Seidel sweeps before and after the coarse correction.
    levels : int
        Largest number of levels.

    Returns
    -------
    Multigrid

    Raises
    ------
    ValueError
        If the diagonal entries do not have one sign, the matrix entries are not known, or an option is out of range.
    ConvergenceError
        With status "setup_failed", if coarsening ends at a level of more than 2000 unknowns.

    Notes
    -----
    The coarsest level is solved by dense LU. It has at most 100 unknowns, or at most 2000 if `levels` is reached or the
    matrix cannot be coarsened further. The set-up is deterministic.

    References
    ----------
    Ruge and Stueben, Algebraic multigrid, in Multigrid Methods, SIAM (1987) 73-130.
    Bell, Olson and Schroder, PyAMG: algebraic multigrid solvers in Python, Journal of Open Source Software 7 (2022)
    4142.
    """
    strength, levels = check_multigrid_options(cycle, strength, sweeps, levels)
    if not system.op.structure.has_entries:
        raise ValueError(f"multigrid needs the entries, {system.unscaled} has only products; write method='krylov'")
    if not system.sign:
        diagonal: Any = system.diagonal
        if system.active is not None:
            diagonal = diagonal[system.active]
        raise ValueError(
            f"multigrid needs a diagonal of one sign; {system.unscaled} has {diagonal.min():.1e} and "
            f"{diagonal.max():.1e}; write method='direct'"
        )
    before, after = sweeps
    return Multigrid(system, CYCLES[cycle], strength, (tuple(before), tuple(after)), levels)


def check_multigrid_options(
    cycle: str = "V",
    strength: float = 0.25,
    sweeps: Sequence[Sweeps] = (("forward",), ("backward",)),
    levels: int = 25,
) -> tuple[float, int]:
    """Raise an error for invalid options of `multigrid_engine`; return `strength` and `levels` as numbers."""
    check_choice("cycle", cycle, CYCLES, "; the F cycle has no transpose of its own kind")
    strength = check_number("strength", strength, "from 0 to below 1", "; the default is 0.25")
    if not _are_sweeps(sweeps):
        raise ValueError(
            f"sweeps must be two tuples of 'forward' and 'backward', got {sweeps!r}; "
            "write for example (('forward',), ('backward',))"
        )
    return strength, check_whole("levels", levels, 1, "; the default is 25")


def _are_sweeps(sweeps: Any) -> bool:
    """Return whether an argument is a pair of sequences of sweep names that are not both empty."""
    if not isinstance(sweeps, (tuple, list)) or len(sweeps) != 2 or not any(sweeps):
        return False
    names = tuple(MIRRORED)
    return all(isinstance(side, (tuple, list)) and all(sweep in names for sweep in side) for side in sweeps)


class Multigrid(Krylov):
    """The Krylov solver whose preconditioner is one cycle of a stored multigrid hierarchy.

    Parameters
    ----------
    system : System
    visits : int
        How often one cycle visits the next coarser level: 1 for a V-cycle, 2 for a W-cycle.
    strength, sweeps
        See `multigrid_engine`.
    levels : int
        Largest number of levels.
    """

    method = "multigrid"
    hierarchical = True
    unit = "cycles"

    def __init__(
        self, system: System, visits: int, strength: float, sweeps: tuple[Sweeps, Sweeps], levels: int
    ) -> None:
        super().__init__(system, maxiter=MAXITER)
        before, after = sweeps
        self.symmetric = system.symmetric and before == _mirrored(after)
        unit = 2.0 ** -exponent_of(system.norm(False))  # PyAMG prints warnings if entries are far from 1
        self._scale: Any = unit * system.sign
        if self.symmetric:
            self._scale = self._scale * system.weights
        matrix = csr_array(system.matrix * np.broadcast_to(self._scale, system.size)[:, None])
        hierarchy = ruge_stueben(matrix, strength, levels)
        coarsest = hierarchy[-1].A.shape[0]
        if coarsest > DENSE_UP_TO:
            raise ConvergenceError(
                f"multigrid on {system.unscaled} ends at a level of {coarsest} unknowns, after {len(hierarchy)} of "
                f"{levels} levels; it may have {DENSE_UP_TO}; write method='direct' or 'krylov', or raise levels",
                info=failure("setup_failed"),
            )
        self.forward = Hierarchy(hierarchy, visits, before, after)
        self.hierarchy = self.forward.words

    def precondition(self, r: np.ndarray, transposed: bool) -> np.ndarray:
        """Return the result of one cycle, or of one transposed cycle, for the right-hand side r."""
        hierarchy = self.forward.T if transposed else self.forward
        return hierarchy.cycle(self._scale * r)


class Level(NamedTuple):
    """The matrix A of a level, the prolongation P from the next coarser level, and the restriction R to it.

    P and R are None on the coarsest level.
    """

    A: Any
    P: Any = None
    R: Any = None


class Hierarchy:
    """A multigrid hierarchy: the levels, the smoothing sweeps, and the solve on the coarsest level.

    Parameters
    ----------
    levels : list of Levels
    visits : int
        How often one cycle visits the next coarser level.
    before, after : tuples of "forward" and "backward"
        Gauss-Seidel sweeps before and after the coarse correction.
    coarse : callable, optional
        ``coarse(b, transposed)`` solves on the coarsest level. Default: the dense solve of `coarse_solver`.
    """

    def __init__(
        self, levels: list[Level], visits: int, before: Sweeps, after: Sweeps, coarse: Solve | None = None
    ) -> None:
        self.levels = levels
        self.visits = visits
        self.before = before
        self.after = after
        self._coarse = coarse or coarse_solver(levels[-1].A)

    @cached_property
    def T(self) -> Hierarchy:
        """The hierarchy of the transposed cycle."""
        levels = [_transposed(level) for level in self.levels]
        solve = self._coarse

        def coarse(b: np.ndarray, transposed: bool) -> np.ndarray:
            return solve(b, not transposed)

        return Hierarchy(levels, self.visits, _mirrored(self.after), _mirrored(self.before), coarse)

    def cycle(self, b: np.ndarray, number: int = 0) -> np.ndarray:
        """Return the result of one cycle for the right-hand side b, as a new array.

        The cycle starts at level `number` with the initial guess 0.
        """
        level = self.levels[number]
        if level is self.levels[-1]:
            return self._coarse(b, False)
        next_level = self.levels[number + 1]
        x = np.zeros_like(b)
        self._smooth(level.A, x, b, self.before)
        residual = level.R @ (b - level.A @ x)
        correction = self.cycle(residual, number + 1)
        if next_level is not self.levels[-1]:
            for _ in range(self.visits - 1):
                correction += self.cycle(residual - next_level.A @ correction, number + 1)
        x += level.P @ correction
        self._smooth(level.A, x, b, self.after)
        return x

    @staticmethod
    def _smooth(A: csr_array, x: np.ndarray, b: np.ndarray, sweeps: Sweeps) -> None:
        """Apply Gauss-Seidel sweeps for A x = b to x in place."""
        from pyamg import amg_core

        for sweep in sweeps:
            if sweep == "forward":
                amg_core.gauss_seidel(A.indptr, A.indices, A.data, x, b, 0, x.size, 1)
            else:
                amg_core.gauss_seidel(A.indptr, A.indices, A.data, x, b, x.size - 1, -1, -1)

    @property
    def words(self) -> str:
        """A description in one line: number of levels, unknowns of each level, and operator complexity."""
        sizes = " > ".join(str(level.A.shape[0]) for level in self.levels)
        entries = [level.A.nnz for level in self.levels]
        return f"{len(self.levels)} levels, unknowns {sizes}, operator complexity {sum(entries) / entries[0]:.2f}"


def _mirrored(sweeps: Sweeps) -> Sweeps:
    """Return the sweeps of the transposed smoother."""
    return tuple(MIRRORED[sweep] for sweep in reversed(sweeps))


def _transposed(level: Level) -> Level:
    """Return the level of the transposed hierarchy. Its P and R share the entries of R and P."""
    A = csr_array(level.A.T.tocsr())  # sweeps need rows
    if level.P is None:
        return Level(A)
    return Level(A, level.R.T, level.P.T)


def ruge_stueben(matrix: csr_array, strength: float, levels: int, second_pass: bool = True) -> list[Level]:
    """Return the levels that PyAMG builds.

    The result is reproducible, because the coarse-fine splitting that is used here draws no random numbers.

    Parameters
    ----------
    matrix : csr_array
    strength : float
        Couplings above this share of the largest one of a row are strong.
    levels : int
        The largest number of levels.
    second_pass : bool
        Whether strongly coupled fine unknowns get a common coarse one. Needed for convergence if coefficients jump
        randomly; for smooth coefficients in 3-D the levels hold half as many entries without it.

    Returns
    -------
    list of Levels
    """
    from pyamg import ruge_stuben_solver

    solver = ruge_stuben_solver(
        csr_matrix(matrix),  # PyAMG requires csr_matrix and does not accept csr_array
        strength=("classical", {"theta": strength}),
        CF=("RS", {"second_pass": second_pass}),
        max_levels=levels,
        max_coarse=COARSEST,
    )
    return _without_residues(solver.levels)


def colour_graph(links: sparray) -> np.ndarray:
    """Return a colour number for each row of a symmetric sparse matrix, so that linked rows have different colours."""
    from pyamg.graph import vertex_coloring

    return vertex_coloring(csr_matrix(links), method="MIS")  # maximal independent sets: deterministic


def _without_residues(pyamg_levels: Sequence) -> list[Level]:
    """Return the levels of PyAMG as Levels, with rows and columns that are only rounding error set to 0.

    A region without a boundary condition that fixes its level is coarsened to one unknown. The row of this unknown is 0
    up to rounding, and a sweep or the coarsest solve would divide by its diagonal. Both skip empty rows.
    """
    levels: list[Level] = []
    reference = np.zeros(0)
    for level in pyamg_levels:
        A = csr_array(level.A)
        sizes = abs(A) @ np.ones(A.shape[0])
        if levels:
            reference = abs(levels[-1].R) @ reference
        else:
            reference = sizes
        is_residue = sizes <= RESIDUE * reference
        if is_residue.any():
            A = csr_array(A.multiply(~is_residue[:, None]).multiply(~is_residue))
            A.eliminate_zeros()
        if level is pyamg_levels[-1]:
            levels.append(Level(A))
        else:
            P = csr_array(level.P)
            levels.append(Level(A, P, P.T))  # R of PyAMG is a copy of P.T
    return levels


def coarse_solver(matrix: csr_array) -> Solve:
    """Return a function ``solve(b, transposed)`` for the matrix of the coarsest level, by dense LU.

    If all rows of a connected component sum to 0, constants are in its null space. Then a multiple of the averaging
    matrix is added to this block, which makes it regular. For data in the range of the original block, the solution has
    mean 0, and so has the solution of the transposed system. If the null vectors of a singular matrix are not constant,
    the pseudo-inverse is used.
    """
    dense = matrix.toarray()
    ones = np.ones(matrix.shape[0])
    count, labels = connected_components(matrix, directed=False)
    sums = matrix @ ones
    sizes = abs(matrix) @ ones
    for number in range(count):
        cells = np.flatnonzero(labels == number)
        if np.all(np.abs(sums[cells]) <= ZERO_ROW_SUM * sizes[cells]):
            scale = np.max(sizes[cells]) or 1.0
            dense[np.ix_(cells, cells)] += scale / cells.size
    factors, pivots = la.lu_factor(dense, check_finite=False)
    if np.all(np.abs(np.diag(factors)) > SMALLEST_PIVOT * np.max(np.abs(dense), axis=1)):

        def solve(b: np.ndarray, transposed: bool) -> np.ndarray:
            # Copy the pivots: SciPy modifies them during a solve, and another thread may use them at the same time.
            return la.lu_solve((factors, pivots.copy()), b, trans=int(transposed), check_finite=False)

        return solve
    inverse = la.pinv(dense, rtol=PINV_CUTOFF)

    def multiply(b: np.ndarray, transposed: bool) -> np.ndarray:
        return b @ inverse if transposed else inverse @ b

    return multiply
