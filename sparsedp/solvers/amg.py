"""Algebraic multigrid: hierarchies by PyAMG (Ruge-Stueben), our own cycle, so that it has a transpose.

One cycle is a linear map M ~ A^-1. With pre-smoothing sweeps s_1 ... s_m, prolongation P, restriction R
and post-smoothing sweeps t_1 ... t_n, its transpose is the cycle on A^T with prolongation R^T,
restriction P^T, pre-smoothing t_n^T ... t_1^T and post-smoothing s_m^T ... s_1^T; the transpose of a
forward Gauss-Seidel sweep on A is a backward sweep on A^T.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
from scipy.sparse import csr_array, csr_matrix
from scipy.sparse.csgraph import connected_components

from sparsedp._utils.validation import check_choice, check_number, check_whole
from sparsedp.errors import ConvergenceError
from sparsedp.solvers.krylov import Krylov
from sparsedp.solvers.records import failure
from sparsedp.solvers.scaling import exponent_of

__all__ = [
    "Hierarchy",
    "Level",
    "Multigrid",
    "check_multigrid_options",
    "coarse_solver",
    "coloured_graph",
    "multigrid_engine",
    "ruge_stueben",
]

CYCLES = {"V": 1, "W": 2}
SWEEPS = {"forward": "backward", "backward": "forward"}  # each with its mirror image
COARSEST = 100  # unknowns up to which a level is not coarsened further, but solved by a dense matrix
DENSE_UP_TO = 2000  # unknowns of a coarsest level, where coarsening ends before: its matrix takes 32 MB
MAXITER = 200
RESIDUE = 1e-13  # share of the entries that were added up, below which a row of a coarse level is rounding


def multigrid_engine(system, *, cycle="V", strength=0.25, sweeps=(("forward",), ("backward",)), levels=25):
    """System -> Multigrid: conjugate gradients (GMRES when not symmetric) around one multigrid cycle.

    Parameters
    ----------
    system : System
        With entries, and a diagonal of one sign.
    cycle : "V" or "W"
        W costs more for each iteration and needs fewer where coefficients jump. The F cycle is not
        offered: its transpose is another cycle.
    strength : float
        A coefficient counts as strong from this share of the largest in its row, 0 <= strength < 1.
    sweeps : pair of tuples of "forward" and "backward"
        Gauss-Seidel sweeps before and after the coarse correction.
    levels : int
        Most levels.

    Returns
    -------
    Multigrid

    Raises
    ------
    ValueError
        If the diagonal has both signs or a zero, there are no entries, or an option is out of range.
    ConvergenceError
        With status setup_failed, when coarsening ends at a level of more than 2000 unknowns.

    Notes
    -----
    The coarsest level is solved by a dense matrix. It has at most 100 unknowns, or 2000 where `levels` is reached or
    the matrix does not coarsen further.
    Set-up: deterministic. Source: Ruge and Stueben, Algebraic Multigrid, in Multigrid Methods, SIAM, 1987;
    PyAMG, Bell, Olson and Schroder, J. Open Source Software 7, 2022.
    """
    strength, levels = check_multigrid_options(cycle, strength, sweeps, levels)
    if not system.op.structure.has_entries:
        raise ValueError(f"multigrid needs the entries, {system.unscaled} has only products; write method='krylov'")
    if not system.sign:
        ends = system.diagonal if system.active is None else system.diagonal[system.active]
        raise ValueError(
            f"multigrid needs a diagonal of one sign; {system.unscaled} has {ends.min():.1e} and {ends.max():.1e}; "
            "write method='direct'"
        )
    return Multigrid(system, CYCLES[cycle], strength, tuple(map(tuple, sweeps)), levels)


def check_multigrid_options(cycle="V", strength=0.25, sweeps=(("forward",), ("backward",)), levels=25):
    """Refuse options of `multigrid_engine` that are out of range; return `strength` and `levels` as numbers."""
    check_choice("cycle", cycle, CYCLES, "; the F cycle has no transpose of its own kind")
    strength = check_number("strength", strength, "from 0 to below 1", "; the default is 0.25")
    if not _are_sweeps(sweeps):
        raise ValueError(
            f"sweeps must be two tuples of 'forward' and 'backward', got {sweeps!r}; "
            "write for example (('forward',), ('backward',))"
        )
    return strength, check_whole("levels", levels, 1, "; the default is 25")


def _are_sweeps(given):
    """Whether an argument is two tuples or lists of known words, not both empty."""
    if not isinstance(given, (tuple, list)) or len(given) != 2 or not any(given):
        return False
    return all(isinstance(side, (tuple, list)) and all(sweep in tuple(SWEEPS) for sweep in side) for side in given)


class Multigrid(Krylov):
    """The engine: a kept hierarchy, its cycle and the transposed cycle."""

    method = "multigrid"
    hierarchical = True
    unit = "cycles"

    def __init__(self, system, visits, strength, sweeps, levels):
        mirrored = sweeps[0] == tuple(SWEEPS[sweep] for sweep in reversed(sweeps[1]))
        super().__init__(system, maxiter=MAXITER)
        self.symmetric = system.symmetric and mirrored
        unit = 2.0 ** -exponent_of(system.norm(False))  # PyAMG prints where entries are far from 1
        self._scale = unit * system.sign * (system.weights if self.symmetric else 1.0)
        matrix = csr_array(system.matrix * np.broadcast_to(self._scale, system.size)[:, None])
        found = ruge_stueben(matrix, strength, levels)
        coarsest = found[-1].A.shape[0]
        if coarsest > DENSE_UP_TO:
            raise ConvergenceError(
                f"multigrid on {system.unscaled} ends at a level of {coarsest} unknowns, after {len(found)} of "
                f"{levels} levels; it may have {DENSE_UP_TO}; write method='direct' or 'krylov', or raise levels",
                info=failure("setup_failed"),
            )
        self.forward = Hierarchy(found, visits, *sweeps)
        self.hierarchy = self.forward.words

    def precondition(self, r, transposed):
        """One cycle, or one transposed cycle."""
        return (self.forward.T if transposed else self.forward).cycle(self._scale * r)


class Level(NamedTuple):
    """A matrix with the way down to the next level (None on the coarsest)."""

    A: Any
    P: Any = None
    R: Any = None


class Hierarchy:
    """Levels, sweeps, and a dense solve on the coarsest level that drops the null modes."""

    def __init__(self, levels, visits, before, after, coarse=None):
        self.levels, self.visits = levels, visits
        self.before, self.after = before, after
        self._coarse = coarse or coarse_solver(levels[-1].A)

    @cached_property
    def T(self):
        """The hierarchy of the transposed cycle."""
        levels = [Level(_turned(level.A), _turned(level.R), _turned(level.P)) for level in self.levels]
        before, after = (tuple(SWEEPS[sweep] for sweep in reversed(side)) for side in (self.after, self.before))
        coarse = self._coarse
        return Hierarchy(levels, self.visits, before, after, lambda b, transposed: coarse(b, not transposed))

    def cycle(self, b, number=0):
        """One cycle from 0: M b, as a fresh array."""
        level = self.levels[number]
        if number == len(self.levels) - 1:
            return self._coarse(b, False)
        x = np.zeros_like(b)
        self._smooth(level.A, x, b, self.before)
        rest = level.R @ (b - level.A @ x)
        correction = self.cycle(rest, number + 1)
        for _ in range(self.visits - 1 if number + 2 < len(self.levels) else 0):
            correction += self.cycle(rest - self.levels[number + 1].A @ correction, number + 1)
        x += level.P @ correction
        self._smooth(level.A, x, b, self.after)
        return x

    @staticmethod
    def _smooth(A, x, b, sweeps):
        from pyamg import amg_core

        for sweep in sweeps:  # of Gauss and Seidel
            ends = (0, x.size, 1) if sweep == "forward" else (x.size - 1, -1, -1)
            amg_core.gauss_seidel(A.indptr, A.indices, A.data, x, b, *ends)

    @property
    def words(self):
        """Levels, unknowns and operator complexity in one line."""
        sizes = " > ".join(str(level.A.shape[0]) for level in self.levels)
        entries = [level.A.nnz for level in self.levels]
        return f"{len(self.levels)} levels, unknowns {sizes}, operator complexity {sum(entries) / entries[0]:.2f}"


def _turned(matrix):
    return None if matrix is None else csr_array(matrix.T.tocsr())


def ruge_stueben(matrix, strength, levels):
    """The levels that PyAMG builds; this splitting draws no random numbers."""
    from pyamg import ruge_stuben_solver

    built = ruge_stuben_solver(
        csr_matrix(matrix),  # PyAMG asks for the matrix class, not the array class
        strength=("classical", {"theta": strength}),
        CF=("RS", {"second_pass": True}),  # with random jumps the first pass alone does not converge
        max_levels=levels,
        max_coarse=COARSEST,
    )
    return _without_residues([*built.levels])


def coloured_graph(links):
    """Symmetric sparse matrix -> a colour for each row: of those that are linked, two different ones."""
    from pyamg.graph import vertex_coloring

    return vertex_coloring(csr_matrix(links), method="MIS")  # by maximal independent sets; it draws no random numbers


def _without_residues(built):
    """PyAMG's levels -> Levels, with rows of rounding residues made empty.

    A region that nothing holds ends, levels down, in one unknown whose row is 0 but for rounding: a sweep or the
    coarsest solve would divide by it. Empty rows are left out by both.
    """
    levels: list = []
    reference = np.zeros(0)
    for level in built:
        A = csr_array(level.A)
        sizes = abs(A) @ np.ones(A.shape[0])
        reference = abs(levels[-1].R) @ reference if levels else sizes
        residue = sizes <= RESIDUE * reference
        if residue.any():
            A = csr_array(A.multiply(~residue[:, None]).multiply(~residue))
            A.eliminate_zeros()
        levels.append(Level(A, *(() if level is built[-1] else (csr_array(level.P), csr_array(level.R)))))
    return levels


def coarse_solver(matrix):
    """The matrix of the coarsest level -> solve(b, transposed): dense LU without the null modes.

    A component whose rows sum to 0 (constants are its null mode) is made regular by adding the mean, scaled to its
    entries: for compatible data the solution is the one with mean 0, and that of the transposed system likewise.
    Other singular matrices (null vectors that are not constant) get the pseudo-inverse.
    """
    dense, size = matrix.toarray(), matrix.shape[0]
    count, labels = connected_components(matrix, directed=False)
    sums, sizes = matrix @ np.ones(size), abs(matrix) @ np.ones(size)
    for number in range(count):
        cells = np.flatnonzero(labels == number)
        if np.all(np.abs(sums[cells]) <= 1e-9 * sizes[cells]):
            scale = np.max(sizes[cells]) or 1.0
            dense[np.ix_(cells, cells)] += scale / cells.size
    factors, rows = la.lu_factor(dense, check_finite=False)
    if np.all(np.abs(np.diag(factors)) > 1e-14 * np.max(np.abs(dense), axis=1)):
        # A copy, because SciPy changes them while it solves, and another thread may be solving too.
        return lambda b, transposed: la.lu_solve((factors, rows.copy()), b, trans=int(transposed), check_finite=False)
    inverse = la.pinv(dense, rtol=1e-10)
    return lambda b, transposed: b @ inverse if transposed else inverse @ b
