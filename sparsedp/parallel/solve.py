"""Linear solves with distributed fields, by PETSc's Krylov methods and multigrid.

The contract (solvers/solve.py) is unchanged: true residual, powers of two, both null spaces, refinement, errors. Sizes
that it takes from a System are sums over all ranks here, with the same bits on each: all ranks take the same branch,
and raise together. The true residual is computed with the operator itself, not with PETSc's matrix.
"""

from __future__ import annotations

from functools import cached_property, reduce
from typing import Any, NoReturn

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from petsc4py import PETSc
from scipy.sparse.csgraph import connected_components

from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Structure
from sparsedp.operators.structure.lazy import Chain, Diagonal, Mask, Sum
from sparsedp.parallel.cut import Rows
from sparsedp.parallel.fields import DistributedField
from sparsedp.parallel.partition import Partition, partition_of
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.system import System

__all__ = ["PetscEngine", "RanksSystem"]

# Measured in 3-D: 204 ns per cell and iteration, and half of the messages; 479 ns with hypre's defaults.
HYPRE_3D = {
    "pc_hypre_boomeramg_coarsen_type": "HMIS",
    "pc_hypre_boomeramg_interp_type": "ext+i",
    "pc_hypre_boomeramg_P_max": 4,
    "pc_hypre_boomeramg_agg_nl": 1,
    "pc_hypre_boomeramg_strong_threshold": 0.5,
}
CG: dict[str, Any] = {"ksp_type": "cg", "pc_type": "hypre"}
GAMG: dict[str, Any] = {"ksp_type": "gmres", "pc_type": "gamg", "ksp_pc_side": "right"}
# For fields on cells and on faces together, such as velocity and pressure, PETSc has no suitable multigrid.
LU = {"ksp_type": "gmres", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps", "ksp_pc_side": "right"}
SPARE = 14, 200  # MUMPS option ICNTL(14): 200 % more memory than estimated, because saddle points need more pivots
# On the coarsest level BoomerAMG uses Gaussian elimination, which may find a pivot of 0 in a singular matrix.
HYPRE_SINGULAR = {"pc_hypre_boomeramg_relax_type_coarse": "symmetric-SOR/Jacobi"}
MAX_ITERATIONS = 500  # maximum number of iterations of one call of PETSc
LEAST_RTOL = 1e-14  # smallest relative tolerance given to PETSc; iterative refinement reaches smaller ones


# ---- matrices ----


def assembled(block: Structure, layout: Partition) -> Any:
    """Return a structure of blocks as a matrix of PETSc, which computes the products."""
    if isinstance(block, Chain):
        return reduce(PETSc.Mat.matMult, [assembled(member, layout) for member in block.members])
    if isinstance(block, Sum):
        total, *matrices = (assembled(member, layout) for member in block.members)
        for matrix in matrices:
            total.axpy(1.0, matrix, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        return total
    entries = block.explicit()
    size = block.shape[1]
    sizes_before = layout.agreement.gather(size)[: layout.comm.rank]
    # PETSc numbers the entries rank by rank. They are exchanged as floats, exact up to 2^53.
    columns = sum(sizes_before) + np.arange(size, dtype=float)
    if isinstance(block, Rows) and block.read is not None:
        columns = block.read(columns)
    return _matrix(block.shape, entries.indptr, columns[entries.indices], entries.data, layout)


def _matrix(shape, indptr, columns, data, layout):
    """Return the distributed PETSc matrix built from the rows that each rank owns, of the local `shape`."""
    rows = (indptr.astype(PETSc.IntType), columns.astype(PETSc.IntType), data)
    return PETSc.Mat().createAIJ([(n, None) for n in shape], csr=rows, comm=layout.comm)


# ---- the system ----


class RanksSystem(System):
    """See `System`, for fields on ranks. Arrays are flat blocks."""

    faces = None
    splitting = None

    def __init__(self, op: Operator, rtol: float = 1e-10, maxiter: int | None = None) -> None:
        self.layout = partition_of(op.domain)
        self.parts = op.domain.parts
        self.seed = [7, self.layout.comm.rank]
        super().__init__(op, rtol, maxiter)

    # sizes, over all ranks

    @property
    def local_size(self) -> int:
        """The number of entries of the blocks of this rank."""
        return self.layout.size(self.parts)

    def size_of(self, x: NDArray) -> float:
        """Return the 2-norm."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.sqrt(self.layout.sum(np.vdot(x, x).real)))

    def largest(self, x: NDArray) -> float:
        """Return the largest magnitude; NaN if there is one."""
        return float(self.layout.max(np.max(np.abs(x), initial=0.0)))

    def total(self, numbers: ArrayLike) -> Any:
        """Return sums over all ranks."""
        return self.layout.sum(np.asarray(numbers, float))  # bincount returns integers for an empty block

    def extremes(self, x: NDArray) -> tuple[float, float]:
        """Return the least and the largest entry."""
        low, high = super().extremes(x)
        return self.layout.min(low), self.layout.max(high)

    def shaped(self, x: NDArray, space: Space) -> DistributedField:
        """Return the field of a flat block."""
        return DistributedField(x.copy(), space)

    def flat(self, field: Any) -> NDArray:
        """Return the flat block of a field."""
        return field.flat

    def whole(self, x: NDArray) -> NDArray:
        """Return the flat array of all entries, on every rank."""
        return self.layout.gather(x, self.parts)

    # products

    def product(self, x: NDArray, transposed: bool = False) -> NDArray:
        """Return A x or A^T x for the unknowns."""
        return self.masked(self.structure_of(self.op.T if transposed else self.op).product(x))

    def applied(self, x: NDArray) -> NDArray:
        """Return A x for the unscaled operator, in all rows."""
        return self.structure_of(self.unscaled).product(x)

    def residual(self, x: NDArray, b: NDArray, transposed: bool = False) -> tuple[NDArray, float, float]:
        """Return b - A x, its norm, and the norm of x."""
        r = b - self.product(x, transposed)
        return r, self.size_of(r), self.size_of(x)

    @cached_property
    def assembled(self) -> Any:
        """The operator as PETSc's matrix."""
        return assembled(self.structure_of(self.op), self.layout)

    def vector(self, x: NDArray) -> Any:
        """Return a flat block as PETSc's vector, on the same memory."""
        return PETSc.Vec().createWithArray(x, size=(x.size, self.size), comm=self.layout.comm)

    @cached_property
    def components(self) -> tuple[NDArray, int]:
        """Labels of the connected components of the unknowns, and their number.

        Components of the blocks are found first, then joined across ranks.
        """
        indptr, indices, data = self.matrix.getValuesCSR()
        links = _matrix((self.local_size,) * 2, indptr, indices, (data != 0).astype(float), self.layout)
        starts, columns, ones = links.getDiagonalBlock().getValuesCSR()
        block = sp.csr_array((ones, columns, starts), shape=(self.local_size,) * 2)
        block.eliminate_zeros()
        local_count, labels = connected_components(block, directed=False)
        counts = self.layout.agreement.gather(local_count)
        labels = labels + sum(counts[: self.layout.comm.rank])
        # Each link gets 1 + the label of its column; 0 where there is no link.
        links.diagonalScale(R=self.vector(labels + 1.0))
        linked = links.getValuesCSR()[2].astype(np.int64)
        pairs = np.stack([np.repeat(labels, np.diff(indptr)), linked - 1])[:, linked > 0]
        pairs = np.concatenate(self.layout.agreement.gather(np.unique(pairs, axis=1)), axis=1)
        graph = sp.coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(sum(counts),) * 2)
        count, joined = connected_components(graph, directed=False)
        return joined[labels], count

    @property
    def entries(self) -> NoReturn:
        """Not available: the contract would compute a null vector from them."""
        raise ArithmeticError("the null vector of one side is not known on ranks")

    def kernel(self, labels: NDArray, right: NDArray, left: NDArray, count: int) -> RanksNullSpace:
        """Return the NullSpace of these vectors."""
        return RanksNullSpace(self, labels, right, left, count)

    # symmetry

    @cached_property
    def volumes(self) -> NDArray:
        """Volumes of the entries of the block, divided by a power of two near the largest of all."""
        flat = self.op.domain.volumes.flat
        return flat / 2.0 ** np.frexp(self.largest(flat))[1]

    @cached_property
    def diagonal(self) -> NDArray:
        """The diagonal on the unknowns."""
        return self.masked(self.assembled.getDiagonal().getArray().copy())

    @cached_property
    def matrix(self) -> Any:
        """PETSc's matrix, with scaled rows and columns of the identity for entries that are not unknowns."""
        if self.active is None:
            return self.assembled
        mask = Mask(self.active)
        size = self.largest(self.diagonal) * (self.sign or 1)
        remainder = Diagonal(np.where(self.active, 0.0, size))
        return assembled(Sum([Chain([mask, self.structure_of(self.op), mask]), remainder]), self.layout)


class RanksNullSpace(NullSpace):
    """Null vectors in blocks: sums and norms over all ranks are those of the system."""

    def __init__(self, system: RanksSystem, labels: NDArray, right: NDArray, left: NDArray, count: int) -> None:
        self.total = system.total
        self.whole = system.whole
        self.size_of = system.size_of
        super().__init__(labels, right, left, count)


# ---- the engine ----


class PetscEngine(Engine):
    """KSP: conjugate gradients with BoomerAMG if row weights make the matrix symmetric, else GMRES with GAMG.

    hypre's transposed cycle returns 0 and reports convergence; that of GAMG is exact.
    """

    method = "petsc"
    iterative = True
    hierarchical = True

    def __init__(self, system: RanksSystem) -> None:
        self.system = system
        comm = system.layout.comm
        PETSc.garbage_cleanup(comm)  # frees the objects that Python has dropped, on all ranks together
        self.row_weights = _positive_weights(system)
        matrix = system.matrix.copy()
        matrix.diagonalScale(L=system.vector(self.row_weights))
        _attach_null_space(matrix, system)
        domain: Any = system.op.domain
        mixes_kinds = len({inner.kind for inner in getattr(domain, "spaces", ())}) > 1
        chosen_options = _options(system, mixes_kinds)
        options = PETSc.Options("sparsedp_")
        for name, value in chosen_options.items():
            options[name] = value
        ksp = PETSc.KSP().create(comm)
        self.ksp = ksp
        ksp.setOptionsPrefix("sparsedp_")
        ksp.setOperators(matrix)
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setFromOptions()
        for name in chosen_options:  # there is one table of options for the whole process
            options.delValue(name)
        if mixes_kinds:
            ksp.getPC().setFactorSetUpSolverType()
            ksp.getPC().getFactorMatrix().setMumpsIcntl(*SPARE)
        ksp.setUp()
        self.hierarchy = f"{ksp.getType()} with {ksp.getPC().getType()} on {comm.size} ranks"

    def solve(self, b: NDArray, goal: float, transposed: bool) -> tuple[NDArray, int, str]:
        """See `Engine.solve`."""
        system = self.system
        rtol = max(0.5 * goal / (system.size_of(b) or 1.0), LEAST_RTOL)
        self.ksp.setTolerances(rtol=rtol, atol=0.0, divtol=1e8, max_it=system.maxiter or MAX_ITERATIONS)
        x = np.zeros(b.size)
        solve = self.ksp.solve
        if transposed and system.weights is None:
            solve = self.ksp.solveTranspose
        system.layout.agreement.synchronize("solve by PETSc")
        if transposed:
            solve(system.vector(b.copy()), system.vector(x))
            x *= self.row_weights
        else:
            solve(system.vector(self.row_weights * b), system.vector(x))
        return x, self.ksp.getIterationNumber(), _status(self.ksp.getConvergedReason())


def _positive_weights(system):
    """Return weights of the rows with which the matrix is positive, and symmetric if such weights are known."""
    sign = 1.0
    if system.sign < 0:
        sign = -1.0
    signs = np.full(system.local_size, sign)
    if system.weights is None:
        return signs
    return signs * system.weights


def _attach_null_space(matrix, system):
    """Attach the null vectors of both sides, of norm 1, to PETSc's matrix with weighted rows."""
    space = system.null_space
    if not space.count:
        return
    left = space.right
    if system.weights is None:
        left = space.left
    for vectors, attach in ((space.right, matrix.setNullSpace), (left, matrix.setTransposeNullSpace)):
        of_components = [np.where(space.labels == k, vectors, 0.0) for k in range(space.count)]
        units = [system.vector(v / system.size_of(v)) for v in of_components]
        attach(PETSc.NullSpace().create(vectors=units, comm=system.layout.comm))


def _options(system, mixes_kinds):
    """Return the options of PETSc for a system; `mixes_kinds`: its fields are on cells and on faces."""
    if mixes_kinds:
        return LU
    options = GAMG
    if system.weights is not None:
        options = CG
        if len(system.parts[0]) == 3:
            options = options | HYPRE_3D
    if system.null_space.count:
        options = options | HYPRE_SINGULAR
    return options


def _status(reason):
    """Return the status word of a solve for PETSc's reason to stop; empty if it converged."""
    reasons = PETSc.KSP.ConvergedReason
    if reason >= 0:
        return ""
    return {reasons.DIVERGED_MAX_IT: "max_iterations", reasons.DIVERGED_DTOL: "diverged"}.get(reason, "stagnated")


RanksSystem.engine_builder = PetscEngine  # type: ignore[assignment]
