"""Solves on ranks: PETSc's Krylov methods and multigrid inside the contract of one process.

The contract (solvers/solve.py) is unchanged: true residual, powers of two, both null spaces, refinement, refusal. It
asks a System for sizes, and here these are sums over all ranks, with the same bits on each: all ranks take the same
turn, and raise together. The true residual is that of the operator itself, not of PETSc's matrix.
"""

from functools import cached_property, reduce
from typing import Any

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc
from scipy.sparse.csgraph import connected_components

from sparsedp.parallel.cut import Entries, Rows, between, localized
from sparsedp.parallel.exchange import Exchange
from sparsedp.parallel.fields import DistributedField
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.solve import Engine
from sparsedp.solvers.system import System
from sparsedp.structure.lazy import Chain, Diagonal, Sum

__all__ = ["PetscEngine", "RanksSystem"]

# Measured in 3-D: 204 ns a cell and iteration, 479 with what hypre takes by itself, and half of the messages.
HYPRE_3D = {
    "pc_hypre_boomeramg_coarsen_type": "HMIS",
    "pc_hypre_boomeramg_interp_type": "ext+i",
    "pc_hypre_boomeramg_P_max": 4,
    "pc_hypre_boomeramg_agg_nl": 1,
    "pc_hypre_boomeramg_strong_threshold": 0.5,
}
# On the coarsest level BoomerAMG eliminates, which a singular matrix may end by a pivot of 0.
HYPRE_SINGULAR = {"pc_hypre_boomeramg_relax_type_coarse": "symmetric-SOR/Jacobi"}
MOST = 500  # iterations of one call
TIGHT = 1e-14  # least relative residual that PETSc is asked for; the contract refines


# ---- matrices ----


def assembled(structure, given, made):
    """Structure of whole fields -> PETSc's matrix of it: products are PETSc's own. Sides as for `localized`."""
    if isinstance(structure, Chain):
        sides = between(structure.members, given, made)
        members = zip(structure.members, sides, sides[1:])
        return reduce(PETSc.Mat.matMult, [assembled(member, right, left) for member, left, right in members])
    if isinstance(structure, Sum):
        total = None
        for member in structure.members:
            matrix = assembled(member, given, made)
            if total is not None:
                matrix.axpy(1.0, total, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
            total = matrix
        return total
    shape = tuple((side[0].size(side[1]), _whole(side)) for side in (made, given))
    block, numbers = localized(structure, given, made), _numbers(given)
    if isinstance(block, Diagonal):
        entries, columns_of = sp.diags_array(block.values, format="csr"), numbers
    elif isinstance(block, Rows):
        entries, columns_of = block.entries(), block.exchange.forward(numbers)
    elif isinstance(block, Entries):
        entries, columns_of = block.matrix, block.read(numbers)
    else:
        raise TypeError(f"{type(structure).__name__} has no matrix on ranks; invert a sum or product of operators")
    held = (entries.indptr, columns_of[entries.indices], entries.data)
    indptr, indices = (part.astype(PETSc.IntType) for part in held[:2])
    return PETSc.Mat().createAIJ(shape, csr=(indptr, indices, held[2]), comm=given[0].comm)


def _whole(side):
    """Count of numbers of a side, over all ranks."""
    layout, parts = side
    return sum(layout.size(parts, rank) for rank in range(layout.comm.size))


def _numbers(side):
    """PETSc's numbers of the entries that this rank holds: rank by rank. As floats, exact up to 2^53."""
    layout, parts = side
    sizes = [layout.size(parts, rank) for rank in range(layout.comm.size)]
    return sum(sizes[: layout.comm.rank]) + np.arange(sizes[layout.comm.rank], dtype=float)


# ---- what the contract asks ----


class RanksSystem(System):
    """What the contract and the engine ask of the operator, for fields on ranks. Arrays are flat blocks."""

    faces = last = None
    here: Any = 0

    def __init__(self, op, rtol=1e-10, maxiter=None):
        self.layout, self.parts = op.domain.layout, op.domain.parts
        self.side = self.layout, self.parts
        self.seed = [7, self.layout.comm.rank]
        self.here = self.layout.size(self.parts)
        super().__init__(op, rtol, maxiter)

    # sizes, over all ranks

    def size_of(self, x):
        """2-norm."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.sqrt(self.layout.sum(np.vdot(x, x).real)))

    def largest(self, x):
        """Largest magnitude; NaN when there is one."""
        return float(self.layout.max(np.max(np.abs(x), initial=0.0)))

    def total(self, numbers):
        """Sums over all ranks."""
        return self.layout.sum(numbers)

    def extremes(self, x):
        """The least and the largest entry."""
        low, high = super().extremes(x)
        return self.layout.min(low), self.layout.max(high)

    def counts(self, labels, weights, count):
        """Sums of weights over each label."""
        return self.layout.sum(np.bincount(labels, weights, count).astype(float))

    def shaped(self, x, space):
        """The field of a flat block."""
        return DistributedField(x.copy(), space)

    def whole(self, x):
        """The flat array of all entries, on every rank."""
        return self.layout.gather(x, self.parts)

    def number_of_largest(self, x):
        """Flat number, in the whole field, of the entry of largest magnitude."""
        return int(np.argmax(abs(self.shaped(x, self.op.domain))))

    # products

    @cached_property
    def acts(self):
        """The operator and its transpose on blocks."""
        return tuple(localized(op.structure, self.side, self.side) for op in (self.op, self.op.T))

    def product(self, x, transposed=False):
        """A x or A^T x for the unknowns."""
        y = self.acts[transposed].product(x)
        return self.masked(y)

    def residual(self, x, b, transposed=False):
        """(b - A x, its norm; that of x)."""
        r = b - self.product(x, transposed)
        return r, self.size_of(r), self.size_of(x)

    @cached_property
    def assembled(self):
        """The operator as PETSc's matrix."""
        return assembled(self.op.structure, self.side, self.side)

    @cached_property
    def absolute(self):
        """Magnitudes of its entries."""
        indptr, indices, data = self.assembled.getValuesCSR()
        held = indptr, indices, np.abs(data)
        return PETSc.Mat().createAIJ(self.assembled.getSizes(), csr=held, comm=self.layout.comm)

    def magnitude(self, x, transposed=False):
        """|A| x."""
        y = np.zeros(x.size)
        (self.absolute.multTranspose if transposed else self.absolute.mult)(self.vector(x), self.vector(y))
        return y

    def vector(self, x):
        """A flat block as PETSc's vector, on the same memory."""
        return PETSc.Vec().createWithArray(x, size=(x.size, self.size), comm=self.layout.comm)

    @cached_property
    def components(self):
        """(labels, count) of the connected components of the unknowns: those of the blocks, joined across ranks."""
        indptr, indices, data = self.matrix.getValuesCSR()
        here, first = self.here, int(_numbers(self.side)[0]) if self.here else 0
        indices = indices.astype(np.int64)
        mine = (indices >= first) & (indices < first + here)
        row = np.repeat(np.arange(here), np.diff(indptr))
        links = mine & (data != 0)
        graph = sp.coo_array((np.ones(links.sum()), (row[links], indices[links] - first)), shape=(here, here))
        many, labels = connected_components(graph, directed=False)
        counts = self.layout.agreement.gathered(many)
        labels = labels + sum(counts[: self.layout.comm.rank])
        away, place = np.unique(indices[~mine & (data != 0)], return_inverse=True)
        whole = self._at_numbers(labels.astype(float), away)[place.reshape(-1)].astype(np.int64)
        pairs = np.unique(np.stack([labels[row[~mine & (data != 0)]], whole]), axis=1)
        pairs = np.concatenate(self.layout.agreement.gathered(pairs), axis=1)
        graph = sp.coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(sum(counts),) * 2)
        count, joined = connected_components(graph, directed=False)
        return joined[labels], count

    def _at_numbers(self, x, numbers):
        """Entries of a flat block field at PETSc's numbers, of any rank."""
        sizes = np.cumsum([0, *(self.layout.size(self.parts, rank) for rank in range(self.layout.comm.size))])
        ranks = np.searchsorted(sizes, numbers, side="right") - 1
        places = numbers - sizes[ranks]
        return Exchange(self.layout, x.size, ranks.size, [], np.arange(ranks.size), ranks, places).forward(x)

    @property
    def entries(self):
        """Where the contract would look for a null vector itself."""
        raise ArithmeticError("the null vector of one side is not known on ranks")

    def kernel(self, labels, right, left, count):
        """The NullSpace of these vectors."""
        return RanksNullSpace(self, labels, right, left, count)

    # symmetry

    @cached_property
    def volumes(self):
        """Volumes of the entries of the block, divided by the largest of all."""
        flat = self.op.domain.volumes.flat
        return flat / 2.0 ** np.frexp(self.largest(flat))[1]

    @cached_property
    def diagonal(self):
        """The diagonal on the unknowns."""
        return self.masked(self.assembled.getDiagonal().getArray().copy())

    @cached_property
    def matrix(self):
        """PETSc's matrix, with a row and a column of the identity, scaled, for what is no unknown."""
        if self.active is None:
            return self.assembled
        matrix = self.assembled.copy()
        keep = self.vector(np.where(self.active, 1.0, 0.0))
        matrix.diagonalScale(keep, keep)
        matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        size = self.largest(self.diagonal) * (self.sign or 1)
        matrix.setDiagonal(self.vector(np.where(self.active, self.diagonal, size)))
        return matrix


class RanksNullSpace(NullSpace):
    """Null vectors whose blocks lie on ranks; sums are those of the whole."""

    def __init__(self, system, labels, right, left, count):
        self.layout, self.size_of, self.side = system.layout, system.size_of, system.side
        super().__init__(labels, right, left, count)

    def _dots(self, side, values):
        return self._sums(side * values)

    def _sums(self, values):
        sums = np.bincount(self.labels + 1, values, self.count + 1)[1:]
        return self.layout.sum(sums.astype(float))  # of an empty block they are whole numbers

    def projected(self, b, transposed=False, into=None, sums=None):
        """As in `NullSpace`."""
        b, _ = super().projected(b, transposed, into, sums)
        return b, self.size_of(b)

    def cells(self, number):
        """Numbers, in the whole field, of the unknowns of one component."""
        layout, parts = self.side
        mine = layout.take(np.arange(sum(map(np.prod, parts))), parts)[self.labels == number]
        return np.sort(np.concatenate(layout.agreement.gathered(mine)))


# ---- the engine ----


class PetscEngine(Engine):
    """KSP: conjugate gradients with BoomerAMG where rows can be weighed to symmetry, else GMRES with GAMG.

    hypre's transposed cycle leaves 0 and calls it converged; that of GAMG is exact.
    """

    method, iterative, hierarchical = "petsc", True, True

    def __init__(self, system):
        comm, w = system.layout.comm, system.weights
        PETSc.garbage_cleanup(comm)  # what Python has dropped is freed here, on all ranks together
        self.system, self.sign = system, -1.0 if system.sign < 0 else 1.0
        self.rows = None if w is None or np.isscalar(w) else w
        matrix = system.matrix.copy()
        if self.rows is not None:
            matrix.diagonalScale(L=system.vector(self.rows.copy()))
        matrix.scale(self.sign)
        space = system.null_space
        if space.count:
            sides = [space.right, space.right if w is not None else space.left]
            for vectors, attach in zip(sides, (matrix.setNullSpace, matrix.setTransposeNullSpace)):
                found = [np.where(space.labels == k, vectors, 0.0) for k in range(space.count)]
                found = [system.vector(v / system.size_of(v)) for v in found]
                attach(PETSc.NullSpace().create(vectors=found, comm=comm))
        self.ksp = ksp = PETSc.KSP().create(comm)
        ksp.setOptionsPrefix("sparsedp_")
        ksp.setOperators(matrix)
        ksp.setType("cg" if w is not None else "gmres")
        ksp.getPC().setType("hypre" if w is not None else "gamg")
        if w is None:
            ksp.setPCSide(PETSc.PC.Side.RIGHT)
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        chosen = HYPRE_3D if w is not None and len(system.parts[0]) == 3 else {}
        chosen = chosen | HYPRE_SINGULAR if space.count else chosen
        options = PETSc.Options("sparsedp_")
        for name, value in chosen.items():
            options[name] = value
        ksp.setFromOptions()
        for name in chosen:  # there is one table of options for the whole process
            options.delValue(name)
        ksp.setUp()
        self.hierarchy = f"{ksp.getType()} with {ksp.getPC().getType()} on {comm.size} ranks"

    def solve(self, b, goal, transposed):
        """See solvers/solve.py."""
        system, reasons = self.system, PETSc.KSP.ConvergedReason
        rtol = max(0.5 * goal / (system.size_of(b) or 1.0), TIGHT)
        self.ksp.setTolerances(rtol=rtol, atol=0.0, divtol=1e8, max_it=system.maxiter or MOST)
        weighed = self.sign * (b if self.rows is None or transposed else self.rows * b)
        x, turned = np.zeros(b.size), transposed and system.weights is None
        system.layout.agreement.meet("solve by PETSc")
        (self.ksp.solveTranspose if turned else self.ksp.solve)(system.vector(weighed), system.vector(x))
        if self.rows is not None and transposed:
            x *= self.rows
        reason = self.ksp.getConvergedReason()
        words = {reasons.DIVERGED_MAX_IT: "max_iterations", reasons.DIVERGED_DTOL: "diverged"}
        word = "" if reason >= 0 else words.get(reason, "stagnated")
        return x, self.ksp.getIterationNumber(), word


RanksSystem.make = PetscEngine
