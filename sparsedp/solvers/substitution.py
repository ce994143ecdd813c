"""Block triangular systems: unknowns that are found by substitution, before and after the coupled ones.

Row i of A uses unknown j where A[i, j] is not 0. Unknowns that use each other, directly or through others, form the
strongly connected components of that graph. In a topological order of the components A is block lower triangular. A
component of one unknown with a pivot A[i, i] is solved by a division; all others need a solver. With F the unknowns of
that kind which use no component of the other kind, even through others, and L those which no such component uses,

        | A_FF             |
    A = | A_CF  A_CC       |
        | A_LF  A_LC  A_LL |

where A_FF and A_LL are lower triangular in topological order, so that only A_CC has to be factored. The transposed
system is solved in the opposite order. Upwind differences and chains have no C at all.

References
----------
Tarjan, Depth-first search and linear graph algorithms, SIAM Journal on Computing 1 (1972) 146-160.
Duff and Reid, An implementation of Tarjan's algorithm for the block triangularization of a matrix, ACM Transactions on
Mathematical Software 4 (1978) 137-147.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.sparse.linalg import splu

from sparsedp import kernels
from sparsedp.errors import ConvergenceError
from sparsedp.operators.structure.base import probes, rows_of
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.records import failure
from sparsedp.solvers.scaling import norm, shifted

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU


__all__ = [
    "SMALL_BLOCK",
    "BlockFactors",
    "BlockTriangular",
    "Splitting",
    "Substitution",
    "extended_null_space",
    "largest_block",
    "split",
]

SMALL_BLOCK = 64  # unknowns of a component up to which its factors may be full
MOST_OF_ALL = 0.9  # share of the unknowns in one component, from which on block substitution saves nothing
LARGEST_GROWTH = 2.0**49  # |A^-1| |A| beyond this leaves no correct digit in the solution


class Splitting(NamedTuple):
    """Which unknowns of a block triangular system are found by substitution.

    Attributes
    ----------
    first, last : int32 arrays
        The unknowns F and L, each in an order of substitution.
    coupled : bool array, shape (n,)
        The unknowns C.
    """

    first: np.ndarray
    last: np.ndarray
    coupled: np.ndarray

    @property
    def size(self) -> int:
        """The number of unknowns that are found by substitution."""
        return self.first.size + self.last.size


def split(matrix: sp.csr_array, active: np.ndarray | None) -> Splitting | None:
    """Find the unknowns of a matrix that are solved by substitution.

    Parameters
    ----------
    matrix : csr_array
        Square, without explicit zeros.
    active : bool array, shape (n,), or None
        The unknowns; None: all of them.

    Returns
    -------
    Splitting or None
        None if no unknown is found by substitution.

    Raises
    ------
    ArithmeticError
        If an unknown that is a component of its own has no pivot: then the matrix is singular.
    """
    size = matrix.shape[0]
    if active is None:
        active = np.ones(size, dtype=bool)
    graph = _graph(matrix)
    count, labels = connected_components(graph, directed=True, connection="strong")
    has_entries = np.diff(matrix.indptr) + np.bincount(matrix.indices, minlength=size) > 0  # else it is a null vector
    alone = (np.bincount(labels, minlength=count)[labels] == 1) & active & has_entries
    if not alone.any() or not _is_topological(graph, labels):  # SciPy numbers them so, but does not promise it
        return None
    without_pivot = np.flatnonzero(alone & (matrix.diagonal() == 0))
    if without_pivot.size:
        raise ArithmeticError(f"row {without_pivot[0]} has no entry on the diagonal and is not part of a cycle")
    others = np.flatnonzero(active & ~alone)
    first = alone & ~_reached(graph.T.tocsr(), others)
    last = alone & ~first & ~_reached(graph, others)
    if not (first.any() or last.any()):
        return None
    return Splitting(_in_order(first, labels), _in_order(last, labels), active & ~first & ~last)


def largest_block(matrix: sp.csr_array) -> tuple[int, bool]:
    """Return the number of unknowns of the largest strongly connected component, and whether components use others."""
    _, sizes, triangular = _components(matrix)
    return int(np.max(sizes)), triangular


def _components(matrix: sp.csr_array) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the components: their numbers in topological order, their sizes, and whether some use others.

    If the numbers are in no such order, no component is said to use others: SciPy's are in order, but it does not
    promise that.
    """
    graph = _graph(matrix)
    count, labels = connected_components(graph, directed=True, connection="strong")
    regions, _ = connected_components(graph, directed=False)
    triangular = count > regions and _is_topological(graph, labels)
    return labels, np.bincount(labels, minlength=count), triangular


def _graph(matrix: sp.csr_array) -> sp.csr_array:
    """Return the pattern of a csr_array, with ones for entries that may be complex or far from 1."""
    return sp.csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)


def _is_topological(graph: sp.csr_array, labels: np.ndarray) -> bool:
    """Return whether no row uses a component of a higher number."""
    return bool(np.all(labels[rows_of(graph)] >= labels[graph.indices]))


def _in_order(chosen: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return the chosen unknowns, each a component of its own, by increasing number of their component."""
    unknowns = np.flatnonzero(chosen)
    members = np.full(labels.size, -1, dtype=np.int32)
    members[labels[unknowns]] = unknowns
    return members[members >= 0]


def _reached(graph: sp.csr_array, starts: np.ndarray) -> np.ndarray:
    """Return which nodes of a directed graph can be reached from any of the starts, these included."""
    size = graph.shape[0]
    is_reached = np.zeros(size + 1, dtype=bool)
    if starts.size:
        indices = np.concatenate([graph.indices, starts.astype(graph.indices.dtype)])
        indptr = np.append(graph.indptr, graph.indptr.dtype.type(indices.size))  # one more node, linked to all starts
        links = sp.csr_array((np.ones(indices.size), indices, indptr), shape=(size + 1, size + 1))
        is_reached[breadth_first_order(links, size, return_predecessors=False)] = True
    return is_reached[:size]


class Substitution:
    """Forward and backward substitution with some rows of a matrix, in a given order.

    Parameters
    ----------
    matrix : csr_array
        With 32-bit indices.
    order : int32 array
        Rows; each uses only rows before it, and unknowns that are known.
    """

    def __init__(self, matrix: sp.csr_array, order: np.ndarray) -> None:
        self.matrix = matrix
        self.order = order

    def forward(self, b: np.ndarray, x: np.ndarray) -> None:
        """Write the unknowns in order into x: the solution of their rows of A x = b. The others of x are given."""
        if not self.order.size or self._run("forward", b, x):
            return
        reverse = self.order[::-1]
        x[reverse] = 0.0
        x[reverse] = self.factors.solve((b - self.matrix @ x)[reverse])

    def backward(self, r: np.ndarray, x: np.ndarray) -> None:
        """Write the unknowns in order into x: the solution of their columns of A^T x = r; r becomes r - A^T x."""
        if not self.order.size or self._run("backward", r, x):
            return
        reverse = self.order[::-1]
        solution = np.zeros_like(x)
        solution[reverse] = self.factors.solve(r[reverse], trans="T")
        r -= self.matrix.T @ solution
        x[reverse] = solution[reverse]

    def _run(self, name: str, b: np.ndarray, x: np.ndarray) -> bool:
        """Run a compiled loop; return whether there is one."""
        matrix = self.matrix
        if matrix.dtype.kind == "c":
            name = f"{name}_complex"
        entries = (matrix.indptr, matrix.indices, matrix.data)
        return kernels.run("substitution", name, self.order.size, 0, 1, *entries, self.order, b, x)

    @cached_property
    def factors(self) -> SuperLU:
        """Without compiled loops: LU factors of the rows and columns in reverse order, an upper triangular matrix.

        It is its own factor, without fill-in: columns are eliminated one by one, and the only pivot is the diagonal.
        """
        reverse = self.order[::-1]
        block = sp.csc_array(self.matrix[reverse][:, reverse])
        return splu(block, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"Equil": False})

    def row_sums(self) -> np.ndarray:
        """Return the sums of the magnitudes of the entries that link the unknowns in order to each other."""
        members = np.zeros(self.matrix.shape[0])
        members[self.order] = 1.0
        return members * (abs(self.matrix) @ members)


class Stage(NamedTuple):
    """Rows of a block triangular matrix that are factored together.

    Attributes
    ----------
    rows : slice
        In topological order.
    step : 1 or -1
        -1 if the factors are of the rows in reverse order.
    factors : SuperLU
        Of the diagonal blocks.
    links : csr_array
        The entries of these rows in columns of earlier stages.
    columns : int array
        The columns of `links`, in topological order.
    """

    rows: slice
    step: int
    factors: SuperLU
    links: sp.csr_array
    columns: np.ndarray


class BlockFactors:
    """LU factors of the diagonal blocks of a block triangular matrix; what links blocks needs none.

    Components of more than SMALL_BLOCK unknowns have factors of their own. Those between them, one after the other in
    topological order, are factored together: in reverse order they are block upper triangular, and elimination by
    columns chooses pivots in the diagonal blocks.

    Parameters
    ----------
    matrix : csr_array
        Square and block lower triangular in `order`.
    order : int array
    edges : int array
        Where stages begin in this order, and the size of the matrix.
    large : bool array
        For each stage, whether it is one large component.
    """

    def __init__(self, matrix: sp.csr_array, order: np.ndarray, edges: np.ndarray, large: np.ndarray) -> None:
        self.order = order
        position = np.empty_like(order)
        position[order] = np.arange(order.size)
        self.stages = [
            self._stage(matrix, position, low, high, is_large)
            for low, high, is_large in zip(edges[:-1].tolist(), edges[1:].tolist(), large.tolist(), strict=True)
        ]
        entries = sum(stage.factors.nnz for stage in self.stages)
        blocks = ""
        if len(self.stages) > 1:
            blocks = f" of {len(self.stages)} blocks"
        self.words = f"sparse LU{blocks} in block triangular order, {entries} entries in the factors"

    def _stage(self, matrix: sp.csr_array, position: np.ndarray, low: int, high: int, is_large: bool) -> Stage:
        """Factor the rows from `low` to `high` in topological order."""
        rows = matrix[self.order[low:high]]
        row = rows_of(rows)
        column = position[rows.indices]
        is_inside = column >= low
        inside = (rows.data[is_inside], (row[is_inside], column[is_inside] - low))
        block = sp.csc_array(inside, shape=(high - low, high - low))
        columns, link_column = np.unique(column[~is_inside], return_inverse=True)
        links = sp.csr_array((rows.data[~is_inside], (row[~is_inside], link_column)), shape=(high - low, columns.size))
        if is_large:
            return Stage(slice(low, high), 1, splu(block), links, columns)
        factors = splu(sp.csc_array(block[::-1, ::-1]), permc_spec="NATURAL")
        return Stage(slice(low, high), -1, factors, links, columns)

    @classmethod
    def of(cls, matrix: sp.csr_array) -> BlockFactors | None:
        """Return the factors of a matrix; None if one component is most of it, or components do not use others."""
        labels, sizes, triangular = _components(matrix)
        size = matrix.shape[0]
        if not triangular or np.max(sizes) > MOST_OF_ALL * size:
            return None
        ends = np.cumsum(sizes)
        is_large = sizes > SMALL_BLOCK
        large_starts = (ends - sizes)[is_large]
        edges = np.unique(np.concatenate([[0, size], ends[is_large], large_starts]))
        return cls(matrix, np.argsort(labels, kind="stable"), edges, np.isin(edges[:-1], large_starts))

    def solve(self, b: np.ndarray, transposed: bool) -> np.ndarray:
        """Solve A x = b, or A^T x = b, block by block."""
        r = b[self.order]
        if transposed:
            for rows, step, factors, links, columns in reversed(self.stages):
                r[rows] = factors.solve(r[rows][::step], trans="T")[::step]
                r[columns] -= links.T @ r[rows]
        else:
            for rows, step, factors, links, columns in self.stages:
                r[rows] = factors.solve((r[rows] - links @ r[columns])[::step])[::step]
        x = np.empty_like(b)
        x[self.order] = r
        return x


class BlockTriangular(Engine):
    """The engine of a System that is split: substitution around the engine of the coupled unknowns.

    Parameters
    ----------
    system : System
    inner : Engine or None
        That of `system.coupled`; None if there is no coupled unknown.

    Raises
    ------
    ConvergenceError
        If the triangular parts are singular to working precision.
    """

    def __init__(self, system: Any, inner: Engine | None) -> None:
        self.system = system
        self.inner = inner
        splitting = system.splitting
        assert splitting is not None
        self.first = Substitution(system.matrix, splitting.first)
        self.last = Substitution(system.matrix, splitting.last)
        description = f"substitution, {splitting.size} unknowns"
        if inner is None:
            self.method = "direct"
            self.hierarchy = f"{description}, {system.matrix.nnz} entries"
        else:
            self.method = inner.method
            self.unit = inner.unit
            self.hierarchy = f"{inner.hierarchy}; {description}"
            self.iterative = inner.iterative
            self.hierarchical = inner.hierarchical
            self.refines = inner.refines
            self.most_refinements = inner.most_refinements
            self.reduction = inner.reduction
            self.advice = inner.advice
        if not self._growth() < LARGEST_GROWTH:
            raise ConvergenceError(
                f"{system.unscaled} is singular, or its condition number is beyond 1e14: in its triangular part a "
                "pivot is too small for its row, or the solution grows from row to row; add a shift, or remove rows "
                "that depend on others",
                info=failure("setup_failed"),
            )

    def _growth(self) -> float:
        """Return an estimate of |A^-1| |A| for the triangular parts, from solutions for random data."""
        largest = []
        with np.errstate(all="ignore"):
            for part in (self.first, self.last):
                if not part.order.size:
                    continue
                sums = part.row_sums()
                for probe in probes(sums.size):
                    x = np.zeros(sums.size, part.matrix.dtype)
                    part.forward((sums * probe).astype(x.dtype), x)
                    largest.append(np.max(np.abs(x)))
        return np.max(largest)

    def solve(self, b: np.ndarray, goal: float, transposed: bool) -> tuple[np.ndarray, int, str]:
        """Substitute, solve for the coupled unknowns to the residual `goal`, substitute."""
        return self._backward(b, goal) if transposed else self._forward(b, goal)

    def _forward(self, b: np.ndarray, goal: float) -> tuple[np.ndarray, int, str]:
        """Solve A x = b."""
        x = np.zeros_like(b)
        iterations = 0
        status = ""
        self.first.forward(b, x)
        if self.inner is not None:
            residual = b
            if self.first.order.size:
                residual = b - self.system.product(x)
            iterations, status = self._solve_coupled(self.inner, residual, goal, x, False)
        self.last.forward(b, x)
        return x, iterations, status

    def _backward(self, b: np.ndarray, goal: float) -> tuple[np.ndarray, int, str]:
        """Solve A^T x = b."""
        x = np.zeros_like(b)
        residual = b.copy()
        iterations = 0
        status = ""
        self.last.backward(residual, x)
        if self.inner is not None:
            iterations, status = self._solve_coupled(self.inner, residual, goal, x, True)
            if self.first.order.size:
                residual = b - self.system.product(x, True)
        self.first.backward(residual, x)
        return x, iterations, status

    def _solve_coupled(
        self, inner: Engine, residual: np.ndarray, goal: float, x: np.ndarray, transposed: bool
    ) -> tuple[int, str]:
        """Write the coupled unknowns into x, and return iterations and status word."""
        system = self.system.coupled
        assert self.system.splitting is not None
        members = self.system.splitting.coupled
        residual = np.where(members, residual, 0.0)
        if not norm(residual) > goal:
            return 0, ""
        residual = system.null_space.project(residual, transposed)
        y, iterations, status = inner.solve(residual, goal, transposed)
        x[members] = shifted(y[members], -system.exponent)
        return iterations, status


def extended_null_space(system: Any) -> NullSpace:
    """Return the NullSpace of a System that is split, from the NullSpace of its coupled unknowns.

    With A_CC r_C = 0 and l_C A_CC = 0 the null vectors of A are r = (0, r_C, -A_LL^-1 A_LC r_C) and
    l = (-A_FF^-T A_CF^T l_C, l_C, 0).

    Raises
    ------
    ArithmeticError
        If an unknown belongs to the null vectors of two components.
    """
    splitting = system.splitting
    assert splitting is not None
    if not splitting.coupled.any():
        return NullSpace.none(system.size)
    inner = system.coupled.null_space
    if not inner.count:
        return NullSpace.none(system.size)
    first = Substitution(system.matrix, splitting.first)
    last = Substitution(system.matrix, splitting.last)
    if inner.labels is None:
        labels = np.where(splitting.coupled, 0, -1)
    else:
        labels = inner.labels.copy()
    right = inner.right.copy()
    left = inner.left.copy()
    for number in range(inner.count):
        members = labels == number
        r = np.where(members, inner.right, 0.0)
        l = np.where(members, inner.left, 0.0)
        last.forward(np.zeros_like(r), r)
        first.backward(-system.product(l, True), l)
        others = ((r != 0) | (l != 0)) & ~members
        if np.any(labels[others] >= 0):
            raise ArithmeticError("an unknown is linked to two singular components")
        labels[others] = number
        right[others] = r[others]
        left[others] = l[others]
    return system.kernel(labels, right, left, inner.count)
