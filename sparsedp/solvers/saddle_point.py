"""Method "schur": GMRES for flows and other systems with constraints, preconditioned by blocks.

The unknowns are fields, one after the other. The last ones in a flow, the pressure, are multipliers: their equations,
the constraint div v = 0, do not contain them. With the multipliers last the matrix is

    [ A  G ]                              [ H  G ]
    [ D  C ],    and one step solves with [ 0  S ],

where H is the upper block triangle of A, with one block for each field. The inverses of its diagonal blocks are
approximated by one cycle of algebraic multigrid each, on an upwind form of the block where convection is strong. The
inverse of the Schur complement C - D A^-1 G is approximated by the sum (Cahouet and Chabard)

    S^-1 = S_d^-1 + (C - D A_c^-1 G)^-1,        S_d the diagonal of C - D diag(A)^-1 G.

The first term represents diffusion: for A = nu L on the faces of a grid, S_d is -1 / nu, which has the spectrum of the
Schur complement on every grid. The second term represents convection: A_c is the diagonal matrix that upwind
differences add to the diagonal of A, and one cycle approximates the inverse. On 32^2 cells of a cavity at Reynolds
number 100 the second term reduces 280 iterations to 90. An entry of S_d that cancels, or nearly so, although the Schur
complement need not be 0, is replaced by the sum of the magnitudes of its terms.

The number of iterations grows with the Reynolds number; the number of cells adds few. Where cells are many diffusion
lengths wide, the upwind form is a poor approximation of central differences.

**Constants.** A pressure that only its value in one cell fixes gives A one tiny eigenvalue, on which GMRES loses tens
of iterations. Its right vector e is 1 on the multipliers of a connected region. Its left vector w has the ratios that
make w D = 0, the volumes of cells. After each step, the multiple of e is added that makes the residual orthogonal to w.

For A^T, the transpose of the same step is used.

References
----------
H. C. Elman, D. J. Silvester, A. J. Wathen, Finite Elements and Fast Iterative Solvers, Oxford University Press, 2014,
chapters 4 and 9.
J. Cahouet, J.-P. Chabard, Some fast 3D finite element solvers for the generalized Stokes problem, Int. J. Numer.
Methods Fluids 8 (1988) 869-895.
M. Benzi, G. H. Golub, J. Liesen, Numerical solution of saddle point problems, Acta Numerica 14 (2005) 1-137.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, connected_components

from sparsedp.errors import ConvergenceError
from sparsedp.solvers.algebraic_multigrid import DENSE_UP_TO, Hierarchy, ruge_stueben
from sparsedp.solvers.krylov import Krylov
from sparsedp.solvers.records import failure
from sparsedp.solvers.scaling import exponent_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sparsedp.solvers.system import System

__all__ = ["SchurComplement", "find_multipliers", "schur_engine"]

MAXITER = 600
RESTART = 100
MOST_NUMBERS = 2**25  # in the basis of GMRES, 0.25 GB
STRENGTH = 0.25
LEVELS = 25
MOST_REGIONS = 20  # regions with separate constants that are treated; GMRES finds the constants of further regions
ROUNDING = 1e-12  # a sum below this share of its terms is 0
CANCELLED = 1e-3  # an entry of the estimate of the Schur complement below this share of its terms says nothing
WEAK_CONVECTION = 1e-3  # share of the diagonal of A: smaller entries of A_c are replaced by it
SHARE_OF_ZEROS = 0.5  # a field of which more diagonal entries are 0 is a multiplier


def schur_engine(system: System) -> SchurComplement:
    """Build GMRES for a system with multipliers, such as the pressure of a flow.

    Parameters
    ----------
    system : System
        Its matrix entries must be known.

    Returns
    -------
    SchurComplement

    Raises
    ------
    ValueError
        If the entries are not known, or no field has a diagonal of zeros.
    ConvergenceError
        With status "setup_failed", if a field cannot be coarsened.
    """
    if not system.op.structure.has_entries:
        raise ValueError(
            f"schur needs the entries of a matrix, but {system.unscaled} is matrix-free; write method='krylov'"
        )
    is_multiplier = find_multipliers(system)
    if not is_multiplier.any():
        raise ValueError(
            f"schur needs multipliers, such as a pressure, whose diagonal entries are 0; {system.unscaled} has none; "
            "write method='direct' or 'multigrid'"
        )
    return SchurComplement(system, is_multiplier)


def find_multipliers(system: System) -> NDArray[np.bool_]:
    """Return for each unknown whether it belongs to a field whose diagonal entries are 0.

    Some of its entries may differ from 0, such as the one that fixes the constant of a pressure.

    Parameters
    ----------
    system : System

    Returns
    -------
    bool array, shape (n,)
    """
    is_unknown = _unknowns(system)
    is_zero = (system.matrix.diagonal() == 0) & is_unknown
    is_multiplier = is_zero.copy()
    for part in _fields(system):
        if part.stop - part.start < system.size:
            is_multiplier[part] = np.sum(is_zero[part]) > SHARE_OF_ZEROS * np.sum(is_unknown[part])
    return is_multiplier & is_unknown


def _unknowns(system: System) -> NDArray[np.bool_]:
    """Return for each entry of a field whether it is an unknown."""
    if system.active is None:
        return np.ones(system.size, dtype=bool)
    return system.active


def _fields(system: System) -> Iterator[slice]:
    """Yield the places of the fields among the unknowns."""
    offsets = system.op.domain.offsets
    for start, stop in zip(offsets[:-1], offsets[1:], strict=True):
        if stop > start:
            yield slice(start, stop)


class Block(NamedTuple):
    """A cycle that approximates the inverse of the diagonal block of some unknowns.

    Attributes
    ----------
    places : int array
    scale : array
        Factors of the rows, which give a positive diagonal of the size 1.
    hierarchy : Hierarchy
    convection : array
        What upwind differences add to the diagonal, with its sign.
    """

    places: NDArray[Any]
    scale: NDArray[Any]
    hierarchy: Hierarchy
    convection: NDArray[Any]

    def solve(self, r: NDArray[Any], transposed: bool) -> NDArray[Any]:
        """Return the result of one cycle for the block, or for its transpose."""
        if transposed:
            return self.scale * self.hierarchy.T.cycle(r)
        return self.hierarchy.cycle(self.scale * r)


class Constants:
    """The constants of the multipliers that hardly any equation determines, one for each connected region.

    Parameters
    ----------
    multipliers : int array
        Those of these regions, as places among the unknowns.
    region : int array
        The region of each.
    weights : array
        The entry of each in the left vector of its region.
    scale : array
        w A e for each region.
    """

    def __init__(
        self, multipliers: NDArray[Any], region: NDArray[Any], weights: NDArray[Any], scale: NDArray[Any]
    ) -> None:
        self.multipliers = multipliers
        self.region = region
        self.weights = weights
        self.scale = scale

    @classmethod
    def of(
        cls, divergence: sp.csr_array, gradient: sp.csr_array, matrix: sp.csr_array, multipliers: NDArray[Any]
    ) -> Constants | None:
        """Return the constants of a matrix; None if there are none."""
        columns = sp.csc_array(divergence)
        columns.eliminate_zeros()
        first = columns.indptr[:-1][np.diff(columns.indptr) == 2]  # faces between two cells
        one, two = columns.indices[first], columns.indices[first + 1]
        size = multipliers.size
        links = sp.coo_array((np.ones(first.size), (one, two)), shape=(size, size)).tocsr()
        count, region = connected_components(links, directed=False)
        has_gradient = np.abs(gradient @ np.ones(size)) > ROUNDING * (abs(gradient) @ np.ones(size))
        touched = sp.csr_array(gradient[has_gradient]).indices
        is_free = np.ones(count, dtype=bool)
        is_free[region[touched]] = False
        logarithms = np.log(np.abs(columns.data[first + 1])) - np.log(np.abs(columns.data[first]))
        weights = np.exp(_sums_along_trees(links, one, two, logarithms, region, count))
        pinned = matrix.diagonal()[multipliers]
        scale = np.bincount(region, weights * pinned, count)
        is_free &= scale != 0
        if not is_free.any():
            return None
        kept = is_free[region]
        scale[~is_free] = 1.0
        return cls(multipliers[kept], region[kept], weights[kept], scale)

    def amount(self, r: NDArray[Any], transposed: bool) -> NDArray[Any]:
        """Return for each region the multiple of its vector that makes a residual orthogonal to its left vector."""
        residual = r[self.multipliers]
        if not transposed:
            residual = residual * self.weights
        return np.bincount(self.region, residual, self.scale.size) / self.scale

    def vector(self, amount: NDArray[Any], transposed: bool, size: int) -> NDArray[Any]:
        """Return these multiples of the right vectors, or of the left ones for the transposed matrix."""
        values = amount[self.region]
        if transposed:
            values = values * self.weights
        result = np.zeros(size)
        result[self.multipliers] = values
        return result


def _sums_along_trees(links, one, two, differences, region, count):
    """Return numbers f, 0 at the first node of each region, with f(one) - f(two) = differences on a spanning tree."""
    size = region.size
    places = np.concatenate([one, two]), np.concatenate([two, one])
    step = sp.coo_array((np.concatenate([differences, -differences]), places), shape=(size, size)).tocsr()
    number = sp.coo_array((np.ones(places[0].size), places), shape=(size, size)).tocsr()
    roots = np.unique(region, return_index=True)[1]
    parent = np.arange(size)
    for root in roots[:MOST_REGIONS]:
        _, predecessors = breadth_first_order(links, root, directed=False)
        reached = predecessors >= 0
        parent[reached] = predecessors[reached]
    total = np.zeros(size)
    moving = np.flatnonzero(parent != np.arange(size))
    if moving.size:  # two cells of a periodic axis have two faces: their mean
        total[moving] = step[moving, parent[moving]] / number[moving, parent[moving]]
    while np.any(parent != parent[parent]):  # each pass doubles the length of the paths that are summed
        total = total + total[parent]
        parent = parent[parent]
    return total


class SchurComplement(Krylov):
    """GMRES with the block preconditioner of a system with multipliers.

    Parameters
    ----------
    system : System
    is_multiplier : bool array, shape (n,)
    """

    method = "schur"
    hierarchical = True
    advice = (
        "; write method='direct', refine cells that are many diffusion lengths wide, or approach a large Reynolds "
        "number by dp.continuation"
    )

    def __init__(self, system: System, is_multiplier: NDArray[np.bool_]) -> None:
        super().__init__(system, maxiter=MAXITER)
        self.symmetric = False
        self.restart = int(np.clip(MOST_NUMBERS // max(system.size, 1), 20, RESTART))
        matrix = sp.csr_array(system.matrix)
        self.multipliers = np.flatnonzero(is_multiplier)
        is_other = _unknowns(system) & ~is_multiplier
        self.others = np.flatnonzero(is_other)
        self.blocks = []
        names = []
        for part in _fields(system):
            places = np.arange(part.start, part.stop)[is_other[part]]
            if places.size:
                self.blocks.append(_block(system, _own_block(matrix, places), places))
                names.append(self.blocks[-1].hierarchy.words)
        self.couplings = []
        for number, block in enumerate(self.blocks):
            is_later = np.zeros(system.size, dtype=bool)
            for later in self.blocks[number + 1 :]:
                is_later[later.places] = True
            start, stop = block.places[0], block.places[-1] + 1
            rows = matrix[start:stop]
            if stop - start > block.places.size:
                rows = rows[block.places - start]
            self.couplings.append(sp.csr_array(rows @ sp.diags_array(is_later.astype(float))))
            self.couplings[-1].eliminate_zeros()
        rows = sp.csr_array(matrix[self.others])
        self.gradient = sp.csr_array(rows[:, self.multipliers])
        divergence = sp.csr_array(matrix[self.multipliers][:, self.others])
        self.schur = self._diagonal_schur(matrix, divergence)
        self.convective = self._convective_schur(matrix, divergence)
        if self.convective is not None:
            names.append(self.convective.hierarchy.words)
        self.constants = Constants.of(divergence, self.gradient, matrix, self.multipliers)
        self.hierarchy = (
            f"GMRES, restarted after {self.restart} iterations; {self.multipliers.size} multipliers; "
            + "; ".join(names)
        )

    def _diagonal_schur(self, matrix, divergence):
        """Return S_d."""
        diagonal = matrix.diagonal()
        own = diagonal[self.others]
        inverse = np.divide(1.0, own, out=np.zeros_like(own), where=own != 0)
        ones = np.ones(self.others.size)
        products = divergence.multiply(self.gradient.T.multiply(inverse))
        schur = diagonal[self.multipliers] - products @ ones
        terms = np.abs(diagonal[self.multipliers]) + abs(products) @ ones
        is_known = np.abs(schur) > CANCELLED * terms
        if np.all(is_known):
            return schur
        sign = np.sign(np.sum(schur[is_known])) or -1.0
        sizes = (abs(divergence) @ np.abs(inverse)) * (abs(self.gradient).T @ ones)
        sizes = np.where(terms > 0, terms, sizes)
        return np.where(is_known, schur, sign * np.where(sizes > 0, sizes, 1.0))

    def _convective_schur(self, matrix, divergence):
        """Return the cycle for C - D A_c^-1 G; None without convection."""
        own = matrix.diagonal()
        added = np.zeros(own.size)
        for block in self.blocks:
            added[block.places] = block.convection
        own = own[self.others]
        added = added[self.others]
        is_weak = np.abs(added) <= WEAK_CONVECTION * np.abs(own)
        if np.all(is_weak) or not np.all(own):
            return None
        added[is_weak] = WEAK_CONVECTION * own[is_weak]
        fixed = sp.diags_array(matrix.diagonal()[self.multipliers])
        schur = sp.csr_array(fixed - divergence @ sp.diags_array(1 / added) @ self.gradient)
        if not np.all(schur.diagonal()):
            return None
        try:
            return _block(self.system, schur, self.multipliers)
        except ConvergenceError:  # it cannot be coarsened
            return None

    def precondition(self, r: NDArray[Any], transposed: bool) -> NDArray[Any]:
        """Return the result of one step for A, or for A^T."""
        constants = self.constants
        if constants is None:
            return self._block_solve(r, transposed)
        if transposed:
            amount = constants.amount(r, transposed)
            moved = constants.vector(amount, transposed, r.size)
            return self._block_solve(r - self.system.product(moved, transposed), transposed) + moved
        z = self._block_solve(r, transposed)
        amount = constants.amount(r - self.system.product(z), transposed)
        return z + constants.vector(amount, transposed, r.size)

    def _block_solve(self, r, transposed):
        """Return the solution of the block triangular system, or of its transpose."""
        z = np.zeros_like(r)
        multiplier = r[self.multipliers]
        if not transposed:
            multiplier = self._schur_solve(multiplier, transposed)
            z[self.multipliers] = multiplier
            r = r.copy()
            r[self.others] -= self.gradient @ multiplier
        if transposed:
            r = r.copy()
            for block, coupling in zip(self.blocks, self.couplings, strict=True):
                z[block.places] = block.solve(r[block.places], transposed)
                r -= coupling.T @ z[block.places]
        else:
            for block, coupling in zip(self.blocks[::-1], self.couplings[::-1], strict=True):
                z[block.places] = block.solve(r[block.places] - coupling @ z, transposed)
        if transposed:
            z[self.multipliers] = self._schur_solve(multiplier - self.gradient.T @ z[self.others], transposed)
        return z

    def _schur_solve(self, r, transposed):
        """Return S^-1 r, or S^-T r."""
        z = r / self.schur
        if self.convective is not None:
            z += self.convective.solve(r, transposed)
        return z


def _upwinding(matrix):
    """Return the diffusion that leaves no positive entry off the diagonal of a matrix; None if there is none.

    On central differences of convection over more than two diffusion lengths a cell, sweeps diverge. The diffusion
    turns them into upwind differences.
    """
    links = matrix - sp.diags_array(matrix.diagonal())
    positive = sp.csr_array(links.maximum(0))
    diffusion = sp.csr_array(positive.maximum(sp.csr_array(positive.T)))
    if not diffusion.nnz:
        return None
    return sp.csr_array(sp.diags_array(diffusion @ np.ones(matrix.shape[0])) - diffusion)


def _own_block(matrix, places):
    """Return the diagonal block of some unknowns."""
    start, stop = places[0], places[-1] + 1
    if stop - start == places.size:
        return sp.csr_array(matrix[start:stop, start:stop])
    return sp.csr_array(matrix[places][:, places])


def _block(system, own, places):
    """Return the Block of some unknowns, given their matrix."""
    diagonal = own.diagonal()
    signs = np.where(diagonal < 0, -1.0, 1.0)
    unit = 2.0 ** -exponent_of(np.max(np.abs(diagonal), initial=0.0) or 1.0)
    scale = unit * signs
    scaled = sp.csr_array(own.multiply(scale[:, None]))
    convection = np.zeros(places.size)
    upwinding = _upwinding(scaled)
    if upwinding is not None:
        convection = upwinding.diagonal() / scale
        scaled = sp.csr_array(scaled + upwinding)
    levels = ruge_stueben(scaled, STRENGTH, LEVELS, second_pass=False)
    coarsest = levels[-1].A.shape[0]
    if coarsest > DENSE_UP_TO:
        raise ConvergenceError(
            f"the coarsest level of schur on {system.unscaled} has {coarsest} unknowns, the limit is {DENSE_UP_TO}; "
            "write method='direct'",
            info=failure("setup_failed"),
        )
    return Block(places, scale, Hierarchy(levels, 1, ("forward",), ("backward",)), convection)
