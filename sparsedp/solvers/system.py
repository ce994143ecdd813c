"""System: what an engine may know about the operator it inverts. Every property is computed on first use."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from sparsedp._utils import buffers
from sparsedp._utils.validation import EPS
from sparsedp.errors import NonFiniteError
from sparsedp.grid.grid import Grid
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix, result_dtype
from sparsedp.operators.structure.kronecker import Kronecker
from sparsedp.operators.structure.lazy import Chain, Diagonal, Mask, Sum
from sparsedp.solvers.nullspace import NullSpace, find_null_space
from sparsedp.solvers.scaling import exponent_of, largest, norm, remainder

if TYPE_CHECKING:
    from collections.abc import Callable

    from sparsedp.grid.space import Space
    from sparsedp.operators.structure.base import Structure
    from sparsedp.solvers.engine import Engine
    from sparsedp.solvers.substitution import Splitting

__all__ = ["System"]

SYMMETRIC = 1e-13  # two products that should be equal may differ by this share of their sizes
# The data of a component are scaled up before the solve if they are below this share of the size of all data.
SMALL_DATA_SHARE = 1e-3
LARGEST_EXPONENT = 200  # an operator whose norm has a larger binary exponent is scaled: squares must not overflow
LARGEST_SCALING = 1000  # binary exponent by which an operator is scaled at most


class System:
    """The square operator of a solve, and its properties.

    Parameters
    ----------
    op : Operator
    rtol : float
    maxiter : int, optional

    Attributes
    ----------
    op : Operator
        The operator to be inverted: `unscaled` times 2^-exponent.
    unscaled : Operator
        The operator as it was given.
    exponent : int
        Not 0 if entries are beyond 2^+-200. The scaling is exact; the contract scales the solution back.
    size, local_size : int
        Number of values of a field, and number of values that this process holds.
    """

    engine_builder: Callable[[System], Engine] | None = None  # set where there is only one method
    size_of = staticmethod(norm)
    largest = staticmethod(largest)
    seed: Any = 0

    def __init__(self, op: Operator, rtol: float = 1e-10, maxiter: int | None = None) -> None:
        self.unscaled = op
        self.op = op
        self.size = op.domain.size
        self.rtol = rtol
        self.maxiter = maxiter
        self.exponent = 0
        self._products: dict[tuple, tuple] = {}  # see `product`
        if self.faces is not None and self.faces.within(LARGEST_EXPONENT - 1):
            return
        exponent = exponent_of(self.norm(False))
        if abs(exponent) > LARGEST_EXPONENT:
            self.exponent = int(np.clip(exponent, -LARGEST_SCALING, LARGEST_SCALING))
            self.op = op * 2.0**-self.exponent
            _check_underflow(op, self.op)
            for name in ("_magnitudes", "sums", "norms", "faces"):  # computed for the unscaled operator
                self.__dict__.pop(name, None)

    @property
    def local_size(self) -> int:
        """The number of entries of a field that this process holds."""
        return self.size

    # ------------------------------------------------------------ products

    def product(self, x: np.ndarray, transposed: bool = False) -> np.ndarray:
        """Return A x or A^T x for the unknowns as a fresh flat array; x is 0 elsewhere. It is not counted."""
        key = transposed, "entries" in self.__dict__, x.dtype
        bound = self._products.get(key)
        if bound is None:
            bound = self._products[key] = self._bound_product(*key)
        new_array, write = bound
        y = new_array()
        write(x, y)
        if self.active is not None:
            y[~self.active] = 0.0
        return y

    def _bound_product(self, transposed, has_entries, dtype):
        """Return a function that allocates the product with an array of this dtype, and a function that writes it."""
        op = self.op.T if transposed else self.op
        if has_entries and not isinstance(op.structure, Kronecker):
            structure = op._matrix_structure  # a product with the matrix is one pass
        else:
            structure = op._acting
        write, zeros = structure.bound(dtype)
        return buffers.allocator(structure.shape[:1], result_dtype(structure, dtype), zeros), write

    def structure_of(self, op: Operator) -> Structure:
        """Return the Structure of an operator on the entries that this process holds."""
        return op.local_structure

    def operator(self, transposed: bool) -> Operator:
        """Return the unscaled operator, or its transpose."""
        if transposed:
            return self.unscaled.T
        return self.unscaled

    def applied(self, x: np.ndarray) -> np.ndarray:
        """Return A x for the unscaled operator, in all rows."""
        return self.unscaled._acting.product(x)

    def residual(self, x: np.ndarray, b: np.ndarray, transposed: bool = False) -> tuple[np.ndarray, float, float]:
        """Return b - A x for the unknowns, as a fresh array, its norm, and the norm of x. b is 0 elsewhere."""
        r = self.product(x, transposed)
        size, length = remainder(b, r, x)
        return r, size, length

    @cached_property
    def grid(self) -> Grid | None:
        """The grid of an operator on cells, with its lengths divided by powers of two; else None."""
        grid = self.op.domain.grid or self.op.codomain.grid
        kinds = {space.kind for space in (self.op.domain, self.op.codomain) if space.grid is not None}
        if grid is None or kinds != {"cells"}:
            return None
        return _rescaled(grid)

    @cached_property
    def faces(self) -> Any:
        """The stencil of an operator that is known to be one without looking at its entries; else None."""
        if self.grid is None or self.grid.dim == 1:
            return None
        from sparsedp.solvers.structured_multigrid.stencil import stencil_without_entries

        return stencil_without_entries(self.op, self.grid)

    @cached_property
    def complex(self) -> bool:
        """Whether the entries are complex."""
        return self.op.dtype.kind == "c"

    # ------------------------------------------------------------ sizes

    def total(self, numbers: Any) -> Any:
        """Return sums over all processes that hold unknowns."""
        return numbers

    def extremes(self, x: np.ndarray) -> tuple[float, float]:
        """Return the least and the largest entry."""
        return np.min(x, initial=np.inf), np.max(x, initial=-np.inf)

    def shaped(self, x: np.ndarray, space: Space) -> Any:
        """Return the field of a flat array."""
        return x.reshape(space.shape)

    def flat(self, field: Any) -> np.ndarray:
        """Return the flat array of a field."""
        return field.reshape(-1)

    def whole(self, x: np.ndarray) -> np.ndarray:
        """Return the flat array of the entries on all processes."""
        return x

    def number_of_largest(self, x: np.ndarray) -> int:
        """Return the flat number of the entry of largest magnitude."""
        return int(np.argmax(np.abs(self.shaped(x, self.op.domain))))

    def counts(self, labels: np.ndarray, weights: np.ndarray | None, count: int) -> np.ndarray:
        """Return the sums of the weights over the entries of each label; with None, the numbers of entries."""
        return self.total(np.bincount(labels, weights, count))

    @cached_property
    def _magnitudes(self) -> tuple[Callable[[np.ndarray], np.ndarray], ...]:
        """Functions that return upper bounds of |A| x and |A^T| x."""
        return self.structure_of(self.op).magnitude(), self.structure_of(self.op.T).magnitude()

    @cached_property
    def sums(self) -> tuple[np.ndarray, np.ndarray]:
        """Sums of the magnitudes of each row and of each column, or upper bounds of them."""
        ones = np.ones(self.local_size)
        return self.magnitude(ones), self.magnitude(ones, True)

    def magnitude(self, x: np.ndarray, transposed: bool = False) -> np.ndarray:
        """Return an upper bound of |A| x, or |A^T| x, for x >= 0."""
        return self._magnitudes[transposed](x)

    def norm(self, transposed: bool = False) -> float:
        """Return |A|_inf, or |A^T|_inf, or an upper bound of it."""
        return self.norms[transposed]

    @cached_property
    def norms(self) -> tuple[float, float]:
        """|A|_inf and |A^T|_inf, or upper bounds. The function that builds an engine may set them."""
        rows, columns = self.sums
        return self.largest(rows), self.largest(columns)

    # ------------------------------------------------------------ unknowns

    @cached_property
    def active(self) -> np.ndarray | None:
        """The unknowns as a boolean array; None when all are.

        Entries that no row uses (columns without entries: solid cells, coefficients that are 0) are not unknowns: they
        are 0 in every solution, and their equations are left out.
        """
        if self.faces is not None and self.faces.connected:
            return None
        used = self.sums[True] > 0
        if not self.largest(~used):
            return None
        return used

    @cached_property
    def unknowns(self) -> int:
        """The number of unknowns."""
        if self.active is None:
            return self.size
        return int(self.total(np.count_nonzero(self.active)))

    @cached_property
    def empty_row(self) -> int | None:
        """The first unknown whose row has no entries, or None."""
        if self.faces is not None and self.faces.connected:
            return None
        empty = self.masked(self.sums[False] == 0)
        if not self.largest(empty):
            return None
        return self.number_of_largest(empty)

    @cached_property
    def unused_unknown(self) -> int | None:
        """The first unknown that no row uses although its own row has entries, or None.

        Its equation would be left out of the solve. That is right where a factor of the operator sets the unknown to 0,
        as the mask in `L @ mask` and the obstacles of a gradient do: those unknowns are not returned.
        """
        if self.active is None:
            return None
        unused = ~self.active & (self.sums[False] > 0)
        if self.largest(unused):
            op = Operator(_without_zero_factors(self.op.structure), self.op.domain, self.op.codomain, self.op.name)
            unused &= self.structure_of(op.T).magnitude()(np.ones(self.local_size)) == 0
        if not self.largest(unused):
            return None
        return self.number_of_largest(unused.astype(float))

    @cached_property
    def components(self) -> tuple[np.ndarray | None, int]:
        """Labels of the connected components of the unknowns, and their number; labels None: one component everywhere.

        The function that builds an engine may set them first, if it knows them without the entries.
        """
        structure: Any = self.op.structure
        labels = None
        count = 1
        if self.active is None and structure.separable:
            labels, count = structure.components()
        elif structure.has_entries:
            matrix = self.matrix  # without zeros, and without links to entries that are not unknowns
            links = sp.csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)
            count, labels = connected_components(links, directed=False)
        if count == 1:
            return None, 1
        return labels, count

    def lift(self, b: np.ndarray, size: float) -> np.ndarray | None:
        """Return, for each entry, the power of two that scales components with small data to the size of all data.

        None if no component has much smaller data than others. `size` is the norm of b.
        """
        labels, count = self.components
        if labels is None:
            return None
        sizes = self.counts(labels, np.abs(b), count)
        faint = (sizes > 0) & (sizes < SMALL_DATA_SHARE * size)
        if not np.any(faint):
            return None
        return np.where(faint, np.frexp(size / np.where(faint, sizes, 1.0))[1], 0)[labels]

    @cached_property
    def null_space(self) -> NullSpace:
        """The null vectors of the singular components. The function that builds an engine may set it."""
        if self.splitting is None:
            return find_null_space(self)
        from sparsedp.solvers.substitution import extended_null_space

        return extended_null_space(self)

    def kernel(self, labels: np.ndarray, right: np.ndarray, left: np.ndarray, count: int) -> NullSpace:
        """Return the NullSpace of these vectors."""
        if not count or np.all(labels == 0):
            return NullSpace(None, right, left, count)
        return NullSpace(labels, right, left, count)

    # ------------------------------------------------------------ symmetry

    @cached_property
    def volumes(self) -> np.ndarray:
        """Cell volumes as a flat array, up to a power of two; ones where there is no grid."""
        space = self.op.domain if self.op.domain.grid is not None else self.op.codomain
        if space.grid is not None:
            space = getattr(_rescaled(space.grid), space.kind)
        return space.volumes.reshape(-1)

    @cached_property
    def uniform(self) -> bool:
        """Whether all volumes are equal."""
        low, high = self.extremes(self.volumes)
        return bool(low >= high)

    @cached_property
    def weights(self) -> Any:
        """Positive w such that diag(w) A is symmetric: 1.0, an array, or None when no such w is known.

        Ones, the cell volumes and their inverses are tested with two random vectors.
        """
        x, y = np.random.default_rng(self.seed).standard_normal((2, self.local_size))
        x = self.masked(x)
        y = self.masked(y)
        ax = self.product(x)
        ay = self.product(y)
        bound = self.magnitude(np.abs(x))
        candidates: list[Any] = [1.0]
        if not self.uniform:
            candidates += [self.volumes, 1.0 / self.volumes]
        for weights in candidates:
            terms = np.array([y @ (weights * ax), x @ (weights * ay), np.abs(y) @ (weights * bound)])
            y_a_x, x_a_y, size = self.total(terms)
            if abs(y_a_x - x_a_y) <= SYMMETRIC * abs(size):
                return weights
        return None

    @property
    def symmetric(self) -> bool:
        """Whether A is symmetric after scaling its rows by `weights`."""
        return self.weights is not None

    def masked(self, x: np.ndarray) -> np.ndarray:
        """Return x with zeros where there is no unknown."""
        if self.active is None:
            return x
        return np.where(self.active, x, 0.0)

    # ------------------------------------------------------------ entries

    @cached_property
    def entries(self) -> sp.csr_array:
        """The operator as a csr_array with 32-bit indices, with all rows and columns."""
        return self.op.matrix

    @cached_property
    def diagonal(self) -> np.ndarray | None:
        """The diagonal on all unknowns and 0 elsewhere; None when only products are known."""
        structure: Any = self.op.structure
        if structure.separable:
            return self.masked(structure.diagonal())
        if structure.has_entries:
            return self.masked(self.entries.diagonal())
        return None

    @cached_property
    def sign(self) -> int:
        """The sign of the diagonal, 1 or -1; 0 when it is mixed or not known."""
        if self.diagonal is None or self.complex:
            return 0
        diagonal = self.diagonal
        if self.active is not None:
            diagonal = diagonal[self.active]
        low, high = self.extremes(diagonal)
        if low > 0:
            return 1
        if high < 0:
            return -1
        return 0

    @cached_property
    def matrix(self) -> sp.csr_array:
        """The entries, with a scaled row of the identity in place of each row that is not one of an unknown.

        Square of size `size`, so that an engine needs no renumbering: its right-hand sides are 0 there.
        """
        matrix = self.entries
        if self.active is not None:
            matrix = _pinned(matrix, ~self.active)
        if np.any(matrix.data == 0):
            matrix = matrix.copy()
            matrix.eliminate_zeros()
        return matrix

    @cached_property
    def splitting(self) -> Splitting | None:
        """The Splitting of a block triangular system; None where substitution finds no unknown.

        The rows of 1 - z L in an obstacle that is held at 0 use values of the fluid, and no row of the fluid uses
        theirs: such rows cannot be smoothed, and are found by substitution.

        Raises
        ------
        ArithmeticError
            If the matrix is singular because an unknown that substitution should find has no pivot.
        """
        structure: Any = self.op.structure
        if self.faces is not None or not structure.has_entries or self.empty_row is not None:
            return None
        if structure.separable and not structure.may_be_triangular():
            return None
        from sparsedp.solvers.substitution import split

        return split(self.matrix, self.active)

    @cached_property
    def coupled(self) -> System:
        """The System of the unknowns that substitution does not find."""
        assert self.splitting is not None
        keep = Operator(Mask(self.splitting.coupled), self.op.domain, self.op.domain, "mask")
        system = System(self.op @ keep, self.rtol, self.maxiter)
        system.unscaled = self.unscaled  # messages name the whole operator
        system.splitting = None
        system.unused_unknown = None
        return system

    @cached_property
    def regular_matrix(self) -> sp.csr_array:
        """`matrix` with one unknown of each singular component pinned, so that it can be factored.

        For data in the range of the operator, set to 0 at these unknowns, its solution is one of the singular system.
        """
        anchors = self.null_space.anchors()
        if not anchors.size:
            return self.matrix
        flags = np.zeros(self.size, dtype=bool)
        flags[anchors] = True
        return _pinned(self.matrix, flags)

    # ------------------------------------------------------------ the test of a solution

    def rounding(self, x: np.ndarray, data: float, transposed: bool = False) -> float:
        """Return the norm of the rounding errors of a residual, row by row.

        On stretched grids this is far below the bound by |A|_inf. `data` is the norm of the right-hand side.
        """
        return EPS * (self.size_of(self.magnitude(np.abs(x), transposed)) + data)


def _without_zero_factors(structure: Structure, leftmost: bool = True) -> Structure:
    """Replace zeros of diagonal factors by ones, except in the leftmost factor, which removes rows, not unknowns."""
    if isinstance(structure, Chain):
        members = [_without_zero_factors(member, False) for member in structure.members]
        if leftmost:
            members[0] = structure.members[0]
        return Chain(members)
    if isinstance(structure, Sum):
        # A diagonal among the summands is no factor: its zeros set nothing to 0.
        members = [m for m in structure.members if isinstance(m, Diagonal)]
        members += [_without_zero_factors(m, leftmost) for m in structure.members if not isinstance(m, Diagonal)]
        return Sum(members)
    if isinstance(structure, Diagonal) and not leftmost:
        return Diagonal(np.where(structure.values == 0, 1.0, structure.values))
    return structure


def _check_underflow(op: Operator, scaled: Operator) -> None:
    """Refuse entries that vanish when the largest is scaled to 1: they are too far apart for one solve."""
    if not isinstance(op.structure, Matrix) or not isinstance(scaled.structure, Matrix):
        return
    if np.count_nonzero(op.structure.matrix.data) != np.count_nonzero(scaled.structure.matrix.data):
        raise NonFiniteError(f"the entries of {op} span more than 1e308; rescale its rows or columns")


def _rescaled(grid: Grid) -> Grid:
    """Divide the lengths of a grid by powers of two, so that volumes and their squares are near 1."""
    widths = [np.ldexp(h, -exponent_of(np.max(h, initial=0.0))) for h in grid.widths]
    return Grid(grid.shape, spacing=widths, periodic=grid.periodic)


def _pinned(matrix: sp.csr_array, flags: np.ndarray) -> sp.csr_array:
    """Return a copy whose flagged rows and columns are those of the identity, scaled to the other diagonal entries."""
    keep = sp.diags_array(np.where(flags, 0.0, 1.0))
    diagonal = matrix.diagonal()[~flags]
    scale = 1.0
    if np.any(diagonal):
        scale = diagonal[np.argmax(np.abs(diagonal))]
    result = sp.csr_array(keep @ matrix @ keep + sp.diags_array(np.where(flags, scale, 0.0)))
    result.eliminate_zeros()
    return result
