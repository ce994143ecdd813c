"""System: what an engine may know about the operator it inverts. Every fact is found on first use."""

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from sparsedp._utils.validation import EPS
from sparsedp.errors import NonFiniteError
from sparsedp.grid.grid import Grid
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.kronecker import Kronecker
from sparsedp.operators.structure.lazy import Chain, Diagonal, Mask, Sum
from sparsedp.solvers.nullspace import NullSpace, find_null_space
from sparsedp.solvers.scaling import exponent_of, largest, norm, remainder

__all__ = ["System"]

SYMMETRIC = 1e-13  # share of the sizes of two products that is rounding
FAINT = 1e-3  # share of the size of the data, below which those of a component are solved for at a size of their own
FAR = 200  # binary exponents of |A| beyond this are scaled away: squares of solutions must not overflow


class System:
    """The square operator of a solve, and its facts.

    Parameters
    ----------
    op : Operator
    rtol : float
    maxiter : int or None

    Attributes
    ----------
    op : Operator
        The operator to be inverted. Where the one given has entries beyond 2^+-200 it is that one
        times 2^-exponent, exactly; the contract scales the solution back.
    exponent : int
    """

    make: Any = None  # its own builder of an engine, where there is only one
    size_of, largest = staticmethod(norm), staticmethod(largest)
    here = property(lambda self: self.size)
    seed: Any = 0
    side: Any = None  # (layout, parts) of fields on ranks

    def __init__(self, op, rtol=1e-10, maxiter=None):
        self.given = self.op = op
        self.size = op.domain.size
        self.rtol, self.maxiter = rtol, maxiter
        self.exponent = 0
        known = self.faces is not None and self.faces.within(FAR - 1)
        exponent = 0 if known else exponent_of(self.norm(False))
        if abs(exponent) > FAR:
            self.exponent = int(np.clip(exponent, -1000, 1000))
            self.op = op * 2.0**-self.exponent
            _check_underflow(op, self.op)
            for name in ("_magnitudes", "sums", "norms", "faces"):
                self.__dict__.pop(name, None)

    # ------------------------------------------------------------ products

    def product(self, x, transposed=False):
        """A x or A^T x for the unknowns (x is 0 elsewhere), flat and fresh. Not counted as an application."""
        op = self.op.T if transposed else self.op
        has_matrix = "entries" in self.__dict__ and not isinstance(op.structure, Kronecker)
        structure = op._matrix_structure if has_matrix else op._acting  # a product with the matrix is one pass
        y = structure.matrix @ x if isinstance(structure, Matrix) else structure.product(x)
        if self.active is not None:
            y[~self.active] = 0.0
        return y

    def structure_of(self, op):
        """The Structure of an operator on what this process holds."""
        return op.structure

    def applied(self, x):
        """A x as it was given: not scaled, for all that is not an unknown too."""
        return self.given._acting.product(x)

    def residual(self, x, b, transposed=False):
        """Return b - A x for the unknowns, as a fresh array, its norm, and the norm of x. b is 0 elsewhere."""
        r = self.product(x, transposed)
        size, length = remainder(b, r, x)
        return r, size, length

    @cached_property
    def grid(self):
        """Grid of the cells that a square operator acts on, lengths divided by powers of two; or None."""
        grid = self.op.domain.grid or self.op.codomain.grid
        kinds = {space.kind for space in (self.op.domain, self.op.codomain) if space.grid is not None}
        return _rescaled(grid) if grid is not None and kinds == {"cells"} else None

    @cached_property
    def faces(self):
        """The stencil of all cells, where the operator is one and no entries are needed to see that; else None."""
        if self.grid is None or self.grid.dim == 1:
            return None
        from sparsedp.solvers.multigrid.stencil import stencil_without_entries

        return stencil_without_entries(self.op, self.grid)

    @cached_property
    def complex(self):
        """Whether the entries are complex."""
        return self.op.dtype.kind == "c"

    # ------------------------------------------------------------ sizes

    def total(self, numbers):
        """Sums over all ranks that hold unknowns."""
        return numbers

    def extremes(self, x):
        """The least and the largest entry."""
        return np.min(x, initial=np.inf), np.max(x, initial=-np.inf)

    def shaped(self, x, space):
        """The field of a flat array."""
        return x.reshape(space.shape)

    def flat(self, field):
        """The flat array of a field."""
        return field.reshape(-1)

    def whole(self, x):
        """The flat array of all entries."""
        return x

    def number_of_largest(self, x):
        """Flat number of the entry of largest magnitude."""
        return int(np.argmax(np.abs(self.shaped(x, self.op.domain))))

    def counts(self, labels, weights, count):
        """Sums of weights over each label; None: how often it is there."""
        return self.total(np.bincount(labels, weights, count))

    @cached_property
    def _magnitudes(self):
        return tuple(self.structure_of(op).magnitude() for op in (self.op, self.op.T))

    @cached_property
    def sums(self):
        """Sums of the magnitudes of each row and of each column, or upper bounds of them."""
        return tuple(self.magnitude(np.ones(self.here), transposed) for transposed in (False, True))

    def magnitude(self, x, transposed=False):
        """An upper bound of |A| x for x >= 0."""
        return self._magnitudes[transposed](x)

    def norm(self, transposed=False):
        """|A|_inf (|A^T|_inf), or an upper bound of it."""
        return self.norms[transposed]

    @cached_property
    def norms(self):
        """|A|_inf and |A^T|_inf. An engine builder may set them."""
        return tuple(map(self.largest, self.sums))

    # ------------------------------------------------------------ unknowns

    @cached_property
    def active(self):
        """Boolean array of the unknowns; None when all are.

        What no row reads (a column without entries: solid cells, coefficients that are 0) is not an
        unknown: it is 0 in every solution, and its equation is left out.
        """
        if self.faces is not None and self.faces.connected:
            return None
        read = self.sums[True] > 0
        return read if self.largest(~read) else None

    @cached_property
    def unknowns(self):
        """Number of unknowns."""
        return self.size if self.active is None else int(self.total(np.count_nonzero(self.active)))

    @cached_property
    def empty_row(self):
        """The first unknown whose row has no entries, or None."""
        if self.faces is not None and self.faces.connected:
            return None
        empty = self.masked(self.sums[False] == 0)
        return self.number_of_largest(empty) if self.largest(empty) else None

    @cached_property
    def unused_unknown(self):
        """The first unknown that no row uses although its own row has entries, or None.

        Its equation would be left out of the solve. That is right where a factor of the operator sets the unknown to 0,
        as the mask in `L @ mask` and the obstacles of a gradient do: those unknowns are not returned.
        """
        if self.active is None:
            return None
        unused = ~self.active & (self.sums[False] > 0)
        if self.largest(unused):
            op = Operator(_without_zero_factors(self.op.structure), self.op.domain, self.op.codomain, self.op.name)
            unused &= self.structure_of(op.T).magnitude()(np.ones(self.here)) == 0
        return self.number_of_largest(unused.astype(float)) if self.largest(unused) else None

    @cached_property
    def components(self):
        """(labels, count) of the connected components of the unknowns; labels None: one, everywhere.

        An engine builder that knows them better than the entries do sets them first.
        """
        structure, labels, count = self.op.structure, None, 1
        if self.active is None and structure.separable:
            labels, count = structure.components()
        elif structure.has_entries:
            matrix = self.matrix  # without zeros, and without links to what is not an unknown
            links = sp.csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)
            count, labels = connected_components(links, directed=False)
        return (None, 1) if count == 1 else (labels, count)

    def lift(self, b, size):
        """Powers of two that bring the data of faint components to the size of the whole; None where none is faint."""
        labels, count = self.components
        if labels is None:
            return None
        sizes = self.counts(labels, np.abs(b), count)
        faint = (sizes > 0) & (sizes < FAINT * size)
        if not np.any(faint):
            return None
        return np.where(faint, np.frexp(size / np.where(faint, sizes, 1.0))[1], 0)[labels]

    @cached_property
    def null_space(self):
        """The null vectors of the singular components. An engine builder may set it."""
        if self.splitting is None:
            return find_null_space(self)
        from sparsedp.solvers.substitution import extended_null_space

        return extended_null_space(self)

    def kernel(self, labels, right, left, count):
        """The NullSpace of these vectors."""
        return NullSpace(None if not count or np.all(labels == 0) else labels, right, left, count)

    # ------------------------------------------------------------ symmetry

    @cached_property
    def volumes(self):
        """Cell volumes as a flat array, up to a power of two; ones where there is no grid."""
        space = self.op.domain if self.op.domain.grid is not None else self.op.codomain
        space = space if space.grid is None else getattr(_rescaled(space.grid), space.kind)
        return space.volumes.reshape(-1)

    @cached_property
    def uniform(self):
        """Whether all volumes are equal."""
        low, high = self.extremes(self.volumes)
        return bool(low >= high)

    @cached_property
    def weights(self):
        """Positive w such that diag(w) A is symmetric: 1.0, an array, or None when no such w is known.

        Tried are ones, the cell volumes and their inverses, on two random vectors.
        """
        x, y = map(self.masked, np.random.default_rng(self.seed).standard_normal((2, self.here)))
        ax, ay, size = self.product(x), self.product(y), self.magnitude(np.abs(x))
        for weights in [1.0] if self.uniform else [1.0, self.volumes, 1.0 / self.volumes]:
            terms = y @ (weights * ax), x @ (weights * ay), np.abs(y) @ (weights * size)
            one, other, scale = self.total(np.array(terms))
            if abs(one - other) <= SYMMETRIC * abs(scale):
                return weights
        return None

    @property
    def symmetric(self):
        """Whether A is symmetric after scaling its rows by `weights`."""
        return self.weights is not None

    def masked(self, x):
        """x, 0 on what is not an unknown."""
        return x if self.active is None else np.where(self.active, x, 0.0)

    # ------------------------------------------------------------ entries

    @cached_property
    def entries(self):
        """The operator as a csr_array with 32-bit indices, as it is."""
        return self.op.matrix

    @cached_property
    def diagonal(self):
        """The diagonal on all unknowns (0 on what is not one), or None when only products are known."""
        structure = self.op.structure
        if structure.separable:
            return self.masked(structure.diagonal())
        return self.masked(self.entries.diagonal()) if structure.has_entries else None

    @cached_property
    def sign(self):
        """1 or -1: the sign of the diagonal; 0 when it is mixed or not known."""
        if self.diagonal is None or self.complex:
            return 0
        low, high = self.extremes(self.diagonal if self.active is None else self.diagonal[self.active])
        return 1 if low > 0 else -1 if high < 0 else 0

    @cached_property
    def matrix(self):
        """The entries with every row that is not an unknown replaced by one of the identity (scaled).

        Square of size `size`, so an engine needs no renumbering: the contract gives it right-hand
        sides that are 0 there.
        """
        matrix = self.entries
        if self.active is not None:
            matrix = _pinned(matrix, ~self.active)
        if np.any(matrix.data == 0):
            matrix = matrix.copy()
            matrix.eliminate_zeros()
        return matrix

    @cached_property
    def splitting(self):
        """The Splitting of a block triangular system; None where substitution finds no unknown.

        In an obstacle that is held at 0, 1 - z L takes values from the fluid beside it and gives none back: such
        rows cannot be smoothed, and need not be solved.

        Raises
        ------
        ArithmeticError
            If the matrix is singular because an unknown that substitution should find has no pivot.
        """
        if self.faces is not None or not self.op.structure.has_entries or self.empty_row is not None:
            return None
        if self.op.structure.separable and not self.op.structure.may_be_triangular():
            return None
        from sparsedp.solvers.substitution import split

        return split(self.matrix, self.active)

    @cached_property
    def coupled(self):
        """The System of the unknowns that substitution does not find."""
        keep = Operator(Mask(self.splitting.coupled), self.op.domain, self.op.domain, "mask")
        system = System(self.op @ keep, self.rtol, self.maxiter)
        system.given, system.splitting = self.given, None  # messages name what was given
        system.unused_unknown = None
        return system

    @cached_property
    def regular_matrix(self):
        """`matrix` with one unknown of each singular component pinned: it can be factored.

        With compatible data, 0 in place of those at the anchors, it has a solution of the singular system.
        """
        anchors = self.null_space.anchors()
        if not anchors.size:
            return self.matrix
        flags = np.zeros(self.size, dtype=bool)
        flags[anchors] = True
        return _pinned(self.matrix, flags)

    # ------------------------------------------------------------ the test of a solution

    def rounding(self, x, data, transposed=False):
        """The residual that rounding leaves, row by row: well below the bound with |A|_inf on stretched grids."""
        return EPS * (self.size_of(self.magnitude(np.abs(x), transposed)) + data)


def _without_zero_factors(structure, leftmost=True):
    """Replace zeros of diagonal factors by ones, except in the leftmost factor, which removes rows, not unknowns."""
    if isinstance(structure, Chain):
        members = [_without_zero_factors(member, False) for member in structure.members]
        return Chain([structure.members[0], *members[1:]] if leftmost else members)
    if isinstance(structure, Sum):
        members = [m if isinstance(m, Diagonal) else _without_zero_factors(m, leftmost) for m in structure.members]
        return Sum(members)
    if isinstance(structure, Diagonal) and not leftmost:
        return Diagonal(np.where(structure.values == 0, 1.0, structure.values))
    return structure


def _check_underflow(op, scaled):
    """Entries that vanish when the largest is scaled to 1 are too far apart for one solve."""
    before, after = op.structure, scaled.structure
    if isinstance(before, Matrix) and np.count_nonzero(before.matrix.data) != np.count_nonzero(after.matrix.data):
        raise NonFiniteError(f"the entries of {op} span more than 1e308; rescale its rows or columns")


def _rescaled(grid):
    """The grid with its lengths divided by powers of two, so that volumes are near 1, and so are their squares."""
    widths = [np.ldexp(h, -exponent_of(np.max(h, initial=0.0))) for h in grid.widths]
    return Grid(grid.shape, spacing=widths, periodic=grid.periodic)


def _pinned(matrix, flags):
    """Matrix -> copy whose flagged rows and columns are those of the identity, scaled to its entries."""
    keep, size = sp.diags_array(np.where(flags, 0.0, 1.0)), matrix.diagonal()[~flags]
    largest = size[np.argmax(np.abs(size))] if size.size and np.any(size) else 1.0
    result = sp.csr_array(keep @ matrix @ keep + sp.diags_array(np.where(flags, largest, 0.0)))
    result.eliminate_zeros()
    return result
