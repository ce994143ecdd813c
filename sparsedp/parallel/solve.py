"""Solves on ranks: PETSc's Krylov methods and multigrid inside the contract of one process.

The contract (solvers/solve.py) is unchanged: true residual, powers of two, both null spaces, refinement, refusal. It
asks a System for sizes, and here these are sums over all ranks, with the same bits on each: all ranks take the same
branch, and raise together. The true residual is computed with the operator itself, not with PETSc's matrix.
"""

from __future__ import annotations

from functools import cached_property, reduce
from typing import Any

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc
from scipy.sparse.csgraph import connected_components

from sparsedp.operators.structure.lazy import Chain, Diagonal, Mask, Sum
from sparsedp.parallel.cut import Rows
from sparsedp.parallel.fields import DistributedField
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.system import System

__all__ = ["PetscEngine", "RanksSystem"]

# Measured in 3-D: 204 ns a cell and iteration, 479 with what hypre takes by itself, and half of the messages.
HYPRE_3D = {
    "pc_hypre_boomeramg_coarsen_type": "HMIS",
    "pc_hypre_boomeramg_interp_type": "ext+i",
    "pc_hypre_boomeramg_P_max": 4,
    "pc_hypre_boomeramg_agg_nl": 1,
    "pc_hypre_boomeramg_strong_threshold": 0.5,
}
GAMG = {"ksp_type": "gmres", "pc_type": "gamg", "ksp_pc_side": "right"}
# Of fields on cells and on faces, as velocity and pressure: no multigrid of PETSc knows what to do with them.
LU = {"ksp_type": "gmres", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps", "ksp_pc_side": "right"}
SPARE = 14, 200  # of MUMPS: percent of memory beyond its estimate, which the pivots of saddle points exceed
# On the coarsest level BoomerAMG eliminates, which a singular matrix may end by a pivot of 0.
HYPRE_SINGULAR = {"pc_hypre_boomeramg_relax_type_coarse": "symmetric-SOR/Jacobi"}
MOST = 500  # iterations of one call
TIGHT = 1e-14  # least relative residual that PETSc is asked for; the contract refines


# ---- matrices ----


def assembled(block: Any, layout: Any) -> Any:
    """Return a structure of blocks as a matrix of PETSc, which computes the products."""
    if isinstance(block, Chain):
        return reduce(PETSc.Mat.matMult, [assembled(member, layout) for member in block.members])
    if isinstance(block, Sum):
        total, *matrices = (assembled(member, layout) for member in block.members)
        for matrix in matrices:
            total.axpy(1.0, matrix, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        return total
    entries, rank = block.explicit(), layout.comm.rank
    # PETSc numbers the entries rank by rank. They are exchanged as floats, exact up to 2^53.
    columns = sum(layout.agreement.gathered(block.shape[1])[:rank]) + np.arange(block.shape[1], dtype=float)
    if isinstance(block, Rows):
        columns = block.read(columns)
    return _matrix(block.shape, entries.indptr, columns[entries.indices], entries.data, layout)


def _matrix(shape, indptr, columns, data, layout):
    """PETSc's matrix of the rows of each rank; `shape`: of blocks."""
    held = indptr.astype(PETSc.IntType), columns.astype(PETSc.IntType), data
    return PETSc.Mat().createAIJ([(n, None) for n in shape], csr=held, comm=layout.comm)


# ---- what the contract asks ----


class RanksSystem(System):
    """What the contract and the engine ask of the operator, for fields on ranks. Arrays are flat blocks."""

    faces = splitting = None

    def __init__(self, op: Any, rtol: Any = 1e-10, maxiter: Any = None) -> None:
        self.layout, self.parts = op.domain.backend, op.domain.parts
        self.side = self.layout, self.parts
        self.seed = [7, self.layout.comm.rank]
        super().__init__(op, rtol, maxiter)

    # sizes, over all ranks

    @property
    def local_size(self) -> Any:
        """The number of entries of the blocks of this rank."""
        return self.layout.size(self.parts)

    def size_of(self, x: Any) -> Any:
        """2-norm."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.sqrt(self.layout.sum(np.vdot(x, x).real)))

    def largest(self, x: Any) -> Any:
        """Largest magnitude; NaN when there is one."""
        return float(self.layout.max(np.max(np.abs(x), initial=0.0)))

    def total(self, numbers: Any) -> Any:
        """Return sums over all ranks."""
        return self.layout.sum(np.asarray(numbers, float))  # of an empty block bincount gives whole numbers

    def extremes(self, x: Any) -> Any:
        """Return the least and the largest entry."""
        low, high = super().extremes(x)
        return self.layout.min(low), self.layout.max(high)

    def shaped(self, x: Any, space: Any) -> Any:
        """Return the field of a flat block."""
        return DistributedField(x.copy(), space)

    def flat(self, field: Any) -> Any:
        """Return the flat block of a field."""
        return field.flat

    def whole(self, x: Any) -> Any:
        """Return the flat array of all entries, on every rank."""
        return self.layout.gather(x, self.parts)

    # products

    def structure_of(self, op: Any) -> Any:
        """Return what an operator does to blocks."""
        return self.layout.cut(op)

    def product(self, x: Any, transposed: bool = False) -> Any:
        """Return a x or A^T x for the unknowns."""
        return self.masked(self.structure_of(self.op.T if transposed else self.op).product(x))

    def applied(self, x: Any) -> Any:
        """Return a x as it was given: not scaled, for all that is not an unknown too."""
        return self.structure_of(self.unscaled).product(x)

    def residual(self, x: Any, b: Any, transposed: bool = False) -> Any:
        """(b - A x, its norm; that of x)."""
        r = b - self.product(x, transposed)
        return r, self.size_of(r), self.size_of(x)

    @cached_property
    def assembled(self) -> Any:
        """The operator as PETSc's matrix."""
        return assembled(self.structure_of(self.op), self.layout)

    def vector(self, x: Any) -> Any:
        """Return a flat block as PETSc's vector, on the same memory."""
        return PETSc.Vec().createWithArray(x, size=(x.size, self.size), comm=self.layout.comm)

    @cached_property
    def components(self) -> Any:
        """(labels, count) of the connected components of the unknowns: those of the blocks, joined across ranks."""
        indptr, indices, data = self.matrix.getValuesCSR()
        links = _matrix((self.local_size,) * 2, indptr, indices, (data != 0).astype(float), self.layout)
        starts, columns, ones = links.getDiagonalBlock().getValuesCSR()
        block = sp.csr_array((ones, columns, starts), shape=(self.local_size,) * 2)
        block.eliminate_zeros()
        many, labels = connected_components(block, directed=False)
        counts = self.layout.agreement.gathered(many)
        labels = labels + sum(counts[: self.layout.comm.rank])
        links.diagonalScale(R=self.vector(labels + 1.0))  # each link by the label of its column: 0 where there is none
        others = links.getValuesCSR()[2].astype(np.int64)
        pairs = np.stack([np.repeat(labels, np.diff(indptr)), others - 1])[:, others > 0]
        pairs = np.concatenate(self.layout.agreement.gathered(np.unique(pairs, axis=1)), axis=1)
        graph = sp.coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(sum(counts),) * 2)
        count, joined = connected_components(graph, directed=False)
        return joined[labels], count

    @property
    def entries(self) -> None:
        """Where the contract would look for a null vector itself."""
        raise ArithmeticError("the null vector of one side is not known on ranks")

    def kernel(self, labels: Any, right: Any, left: Any, count: Any) -> Any:
        """Return the NullSpace of these vectors."""
        return RanksNullSpace(self, labels, right, left, count)

    # symmetry

    @cached_property
    def volumes(self) -> Any:
        """Volumes of the entries of the block, divided by the largest of all."""
        flat = self.op.domain.volumes.flat
        return flat / 2.0 ** np.frexp(self.largest(flat))[1]

    @cached_property
    def diagonal(self) -> Any:
        """The diagonal on the unknowns."""
        return self.masked(self.assembled.getDiagonal().getArray().copy())

    @cached_property
    def matrix(self) -> Any:
        """PETSc's matrix, with a row and a column of the identity, scaled, for what is no unknown."""
        if self.active is None:
            return self.assembled
        keep, size = Mask(self.active), self.largest(self.diagonal) * (self.sign or 1)
        rest = Diagonal(np.where(self.active, 0.0, size))
        return assembled(Sum([Chain([keep, self.structure_of(self.op), keep]), rest]), self.layout)


class RanksNullSpace(NullSpace):
    """Null vectors whose blocks lie on ranks: sums and sizes are those of the system."""

    def __init__(self, system: Any, *given: Any) -> None:
        self.total, self.whole, self.size_of = system.total, system.whole, system.size_of
        super().__init__(*given)


# ---- the engine ----


class PetscEngine(Engine):
    """KSP: conjugate gradients with BoomerAMG where rows can be weighed to symmetry, else GMRES with GAMG.

    hypre's transposed cycle leaves 0 and calls it converged; that of GAMG is exact.
    """

    method, iterative, hierarchical = "petsc", True, True

    def __init__(self, system: Any) -> None:
        comm, w = system.layout.comm, system.weights
        PETSc.garbage_cleanup(comm)  # what Python has dropped is freed here, on all ranks together
        self.system, sign = system, -1.0 if system.sign < 0 else 1.0
        self.rows = np.full(system.local_size, sign) * (1.0 if w is None else w)  # by these the matrix is positive
        matrix = system.matrix.copy()
        matrix.diagonalScale(L=system.vector(self.rows))
        space, symmetric = system.null_space, w is not None
        if space.count:
            sides = [space.right, space.right if symmetric else space.left]
            for vectors, attach in zip(sides, (matrix.setNullSpace, matrix.setTransposeNullSpace)):
                found = [np.where(space.labels == k, vectors, 0.0) for k in range(space.count)]
                found = [system.vector(v / system.size_of(v)) for v in found]
                attach(PETSc.NullSpace().create(vectors=found, comm=comm))
        mixed = len({inner.kind for inner in getattr(system.op.domain, "spaces", ())}) > 1
        chosen: dict = LU if mixed else {"ksp_type": "cg", "pc_type": "hypre"} if symmetric else GAMG
        chosen = chosen | (HYPRE_3D if symmetric and not mixed and len(system.parts[0]) == 3 else {})
        chosen = chosen | (HYPRE_SINGULAR if space.count and not mixed else {})
        options = PETSc.Options("sparsedp_")
        for name, value in chosen.items():
            options[name] = value
        self.ksp = ksp = PETSc.KSP().create(comm)
        ksp.setOptionsPrefix("sparsedp_")
        ksp.setOperators(matrix)
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setFromOptions()
        for name in chosen:  # there is one table of options for the whole process
            options.delValue(name)
        if mixed:
            ksp.getPC().setFactorSetUpSolverType()
            ksp.getPC().getFactorMatrix().setMumpsIcntl(*SPARE)
        ksp.setUp()
        self.hierarchy = f"{ksp.getType()} with {ksp.getPC().getType()} on {comm.size} ranks"

    def solve(self, b: Any, goal: Any, transposed: bool) -> Any:
        """See solvers/solve.py."""
        system, reasons = self.system, PETSc.KSP.ConvergedReason
        rtol = max(0.5 * goal / (system.size_of(b) or 1.0), TIGHT)
        self.ksp.setTolerances(rtol=rtol, atol=0.0, divtol=1e8, max_it=system.maxiter or MOST)
        x, act = np.zeros(b.size), self.ksp.solve
        if transposed and system.weights is None:
            act = self.ksp.solveTranspose
        system.layout.agreement.meet("solve by PETSc")
        act(system.vector(b.copy() if transposed else self.rows * b), system.vector(x))
        if transposed:
            x *= self.rows
        reason = self.ksp.getConvergedReason()
        words = {reasons.DIVERGED_MAX_IT: "max_iterations", reasons.DIVERGED_DTOL: "diverged"}
        word = "" if reason >= 0 else words.get(reason, "stagnated")
        return x, self.ksp.getIterationNumber(), word


RanksSystem.engine_builder = PetscEngine
