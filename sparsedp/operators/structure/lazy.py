"""Lazy structures: diagonals, products, sums and functions. Matrices of products are assembled only when needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, reduce
from math import prod
from operator import add, matmul
from operator import mul as multiply
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp import kernels
from sparsedp._utils import buffers
from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.validation import check_shape
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import DerivativeError
from sparsedp.grid.space import components
from sparsedp.operators.structure.base import BoundProduct, Structure, compact, rows_of
from sparsedp.operators.structure.kronecker import Kronecker

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike, NDArray

__all__ = [
    "Chain",
    "Diagonal",
    "Functions",
    "Mask",
    "Sum",
    "compose",
    "face_entries",
    "times",
    "total",
]

DEEPEST = 200  # maximum nesting depth of products and sums; deeper ones would exceed Python's recursion limit
FUSED_FROM = 16384  # with fewer cells, separate passes are as fast as a fused one
ROW_FROM = 80  # with fewer cells along the last axis, the inner loop, a fused pass is slower than separate ones


class Diagonal(Structure):
    """A diagonal matrix: elementwise multiplication by constant values."""

    def __init__(self, values: ArrayLike) -> None:
        self.values = np.array(values, np.result_type(values, float)).reshape(-1)
        self.values.flags.writeable = False
        self.shape = (self.values.size, self.values.size)
        self.dtype = self.values.dtype

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`: see `Structure.act`."""
        np.multiply(x, self.values, out=out)

    def bound(self, dtype: np.dtype) -> BoundProduct:
        """Return the product with arrays of this dtype: see `Structure.bound`."""
        if dtype == self.dtype == float:
            return BoundProduct(self.act)
        return super().bound(dtype)

    def transpose(self) -> Structure:
        """Return the plain transpose."""
        return self

    def explicit(self) -> sp.csr_array:
        """Return the entries as a csr_array with 32-bit indices."""
        return compact(sp.diags_array(self.values, format="csr"))

    def scaled(self, factor: complex) -> Structure | None:
        """Return factor * A."""
        return Diagonal(self.values * factor)

    def magnitude(self) -> Callable[[NDArray], NDArray]:
        """Return the function that bounds abs(A) x for x >= 0."""
        return lambda x: np.abs(self.values) * x


class Mask(Diagonal):
    """A diagonal matrix whose product is exactly 0 where `keep` is False, even for NaN."""

    def __init__(self, keep: ArrayLike, values: ArrayLike = 1.0) -> None:
        self.keep = np.array(keep, dtype=bool).reshape(-1)
        super().__init__(np.where(self.keep, values, 0.0))

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`: see `Structure.act`."""
        out.fill(0)
        np.multiply(x, self.values, out=out, where=self.keep)

    def scaled(self, factor: complex) -> Structure | None:
        """Return factor * A."""
        return Mask(self.keep, self.values * factor)


class Chain(Structure):
    """A product of structures, applied from right to left. Members that are products are flattened."""

    def __init__(self, members: Sequence) -> None:
        self.members = tuple(inner for member in members for inner in _members(member, Chain))
        self.shape = (members[0].shape[0], members[-1].shape[1])
        self.dtype = np.result_type(*(member.dtype for member in members))
        self.has_entries = all(member.has_entries for member in members)
        self.depth = _nested(self.members)
        self.passes = max(member.passes for member in members)

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`: see `Structure.act`."""
        large = x.dtype == float == self.dtype and x.size >= FUSED_FROM and kernels.compiled()
        if large and self._fused is not None and self._fused(x, out):
            return
        for member in self.members[:0:-1]:
            x = member.product(x)
        self.members[0].apply(x, out)

    def bound(self, dtype: np.dtype) -> BoundProduct:
        """Return the product with arrays of this dtype: see `Structure.bound`."""
        is_large = self.shape[1] >= FUSED_FROM
        if not dtype == self.dtype == float or (is_large and self._fused is not None):
            return super().bound(dtype)
        inner = [_allocated(member) for member in self.members[:0:-1]]
        last = self.members[0].bound(dtype)
        write_last = last.write

        def write(x, out):
            for new_array, write_product in inner:
                product = new_array()
                write_product(x, product)
                x = product
            write_last(x, out)

        return BoundProduct(write, last.zeros)

    @cached_property
    def _fused(self):
        """A function that applies all members in one pass if they are differences through faces; else None."""
        middle = self.members[1:-1]
        if not all(isinstance(member, Diagonal) for member in middle):
            return None
        return through_faces(self.members[0], middle, self.members[-1])

    def transpose(self) -> Structure:
        """Return the plain transpose."""
        return Chain([member.transpose() for member in reversed(self.members)])

    def explicit(self) -> sp.csr_array:
        """Return the entries as a csr_array with 32-bit indices."""
        return compact(reduce(matmul, (member.explicit() for member in self.members)))

    def scaled(self, factor: complex) -> Structure | None:
        """Return factor * A."""
        return compose(times(self.members[0], factor), Chain(self.members[1:]))

    def magnitude(self) -> Callable[[NDArray], NDArray]:
        """Return the function that bounds abs(A) x for x >= 0."""
        bounds = [member.magnitude() for member in reversed(self.members)]

        def bound(x: NDArray) -> NDArray:
            for member_bound in bounds:
                x = member_bound(x)
            return x

        return bound


class Sum(Structure):
    """A sum of structures."""

    def __init__(self, members: Sequence) -> None:
        # Complex members come first, so that the real ones are added to a complex result.
        self.members = tuple(sorted(members, key=lambda member: member.dtype.kind))
        self.shape = members[0].shape
        self.dtype = self.members[0].dtype
        self.has_entries = all(member.has_entries for member in members)
        self.depth = _nested(self.members)

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`: see `Structure.act`."""
        first, *rest = self.members
        first.apply(x, out)
        for member in rest:
            out += member.product(x)

    def bound(self, dtype: np.dtype) -> BoundProduct:
        """Return the product with arrays of this dtype: see `Structure.bound`."""
        if not dtype == self.dtype == float:
            return super().bound(dtype)
        first = self.members[0].bound(dtype)
        write_first = first.write
        rest = [_allocated(member) for member in self.members[1:]]

        def write(x, out):
            write_first(x, out)
            for new_array, write_product in rest:
                product = new_array()
                write_product(x, product)
                out += product

        return BoundProduct(write, first.zeros)

    def transpose(self) -> Structure:
        """Return the plain transpose."""
        return Sum([member.transpose() for member in self.members])

    def explicit(self) -> sp.csr_array:
        """Return the entries as a csr_array with 32-bit indices."""
        return compact(reduce(add, (member.explicit() for member in self.members)))

    def scaled(self, factor: complex) -> Structure | None:
        """Return factor * A."""
        return Sum([times(member, factor) for member in self.members])

    def magnitude(self) -> Callable[[NDArray], NDArray]:
        """Return the function that bounds abs(A) x for x >= 0."""
        bounds = [member.magnitude() for member in self.members]

        def bound(x: NDArray) -> NDArray:
            total: Any = 0
            for member_bound in bounds:
                total = total + member_bound(x)
            return total

        return bound


class Functions(Reconstructible, Structure):
    """A linear map given by two functions on fields: the product and the transposed product."""

    name = "an operator of two functions"
    has_entries = False

    def __init__(
        self,
        forward: Callable | None,
        backward: Callable | None,
        domain: tuple[int, ...],
        codomain: tuple[int, ...],
        dtype: DTypeLike = float,
    ) -> None:
        self.forward = forward
        self.backward = backward
        self.domain = domain  # shapes of the fields
        self.codomain = codomain
        self.shape = (int(np.prod(codomain)), int(np.prod(domain)))
        self.dtype = np.dtype(dtype)

    def recipe(self) -> tuple:
        """Return the call that builds an equal object: see _utils/base_classes.py."""
        return Functions, (self.forward, self.backward, self.domain, self.codomain, self.dtype)

    def apply(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`: see `Structure.apply`."""
        if self.forward is None:
            raise DerivativeError("this operator has no transpose; give from_functions its second function")
        y = np.asarray(self.forward(frozen(x.reshape(self.domain))))  # read-only, so the function cannot modify x
        check_shape("what the function returns", y, self.codomain)
        if y.dtype.kind == "c" and out.dtype.kind != "c":
            raise DerivativeError(
                "the function returned complex values for a real field; give its operator dtype=complex"
            )
        np.copyto(out, y.reshape(-1), casting="same_kind")

    def transpose(self) -> Structure:
        """Return the plain transpose."""
        return Functions(self.backward, self.forward, self.codomain, self.domain, self.dtype)


# ---- products and sums: merged where that is exact, lazy otherwise ----


def compose(a: Structure, b: Structure) -> Structure:
    """Return the structure of a @ b.

    Identities are dropped. Products of Kronecker structures are Kronecker structures, and products of diagonals are
    diagonals. All other products are a Chain. So is the product of two Kronecker sums if it is not a Kronecker sum,
    because a solver can invert the two sums one after the other.
    """
    members = _members(a, Chain)
    for member in _members(b, Chain):
        while members:
            merged = _merged_product(members[-1], member)
            if merged is None:
                break
            members.pop()
            member = merged
        members.append(member)
    if len(members) == 1:
        return members[0]
    return Chain(members)


def _allocated(structure):
    """Return a function that returns a new array for a product in float64, and the function that writes it there."""
    bound = structure.bound(np.dtype(float))
    return buffers.allocator(structure.shape[:1], float, bound.zeros), bound.write


def _nested(members):
    """Return the nesting depth of a product or sum; raise ValueError if Python could not recurse over it."""
    depth = 1 + max((member.depth for member in members), default=0)
    if depth > DEEPEST:
        raise ValueError(
            f"an operator nests sums and products of operators more than {DEEPEST} deep; apply the operators one after "
            "the other, as in v = A(v) + u, or assemble a part of it: dp.from_matrix(part.matrix)"
        )
    return depth


def _members(structure, kind):
    """Return the members of a product or sum; for another structure, the structure itself."""
    if isinstance(structure, kind):
        return list(structure.members)
    return [structure]


def _merged_product(a, b):
    """Return a single structure that equals a @ b, or None if a Chain is needed."""
    if b.is_identity:
        return a
    if a.is_identity:
        return b
    if isinstance(a, Kronecker) and isinstance(b, Kronecker) and a.in_parts == b.out_parts:
        product = a.composed(b)
        if a.separable and b.separable and not product.separable:
            return None  # as a Chain, a product such as L @ L can be inverted by the eigenvectors of L
        return product
    if isinstance(a, Diagonal) and isinstance(b, Diagonal):
        masks = [member.keep for member in (a, b) if isinstance(member, Mask)]
        if masks:
            return Mask(np.all(masks, axis=0), a.values * b.values)
        return Diagonal(a.values * b.values)
    return None


def times(structure: Structure, factor: complex) -> Structure:
    """Return the structure of factor * structure."""
    scaled = structure.scaled(factor)
    if scaled is not None:
        return scaled
    return compose(Diagonal(np.full(structure.shape[0], factor)), structure)


def total(a: Structure, b: Structure) -> Structure:
    """Return the structure of a + b."""
    members = _members(a, Sum)
    for member in _members(b, Sum):
        for number, other in enumerate(members):
            merged = _merged_sum(other, member)
            if merged is not None:
                members[number] = merged
                break
        else:
            members.append(member)
    if len(members) == 1:
        return members[0]
    return Sum(members)


def _merged_sum(a, b):
    """Return a single structure that equals a + b, or None if a Sum is needed."""
    if isinstance(a, Kronecker) and isinstance(b, Kronecker) and (a.out_parts, a.in_parts) == (b.out_parts, b.in_parts):
        return a.added(b)
    if isinstance(a, Diagonal) and isinstance(b, Diagonal):
        return Diagonal(a.values + b.values)
    return None


# ---- products such as divergence @ diagonal @ gradient in one pass over memory ----


def through_faces(left: Structure, middle: Sequence[Any], right: Structure) -> Callable | None:
    """Return a function that computes the product L K R x in one pass over memory.

    Parameters
    ----------
    left, right : Structure
        L maps faces to cells, R maps cells to faces.
    middle : sequence of Diagonal
        The factors of the diagonal matrix K.

    Returns
    -------
    callable or None
        ``run(x, out)`` writes the product into `out` and returns True, or False if no compiled kernel is available.
        None if the structures do not have this form.
    """
    if not (isinstance(left, Kronecker) and isinstance(right, Kronecker) and middle):
        return None
    if len(right.in_parts) != 1 or left.out_parts != right.in_parts or left.in_parts != right.out_parts:
        return None
    shape = right.in_parts[0]
    if len(shape) not in (2, 3) or len(left.in_parts) != len(shape) or min(shape) < 2 or shape[-1] < ROW_FROM:
        return None
    lines: list = [face_entries(left, right, axis, n) for axis, n in enumerate(shape)]
    has_mask = any(isinstance(member, Mask) for member in middle)
    k = reduce(multiply, (member.values for member in middle))
    if any(line is None for line in lines) or k.dtype != float:
        return None
    if has_mask and not all(np.all(member.values[getattr(member, "keep", ...)] != 0) for member in middle):
        return None  # K has zeros from masks (0 * NaN = 0) and other zeros (0 * NaN = NaN), which the kernel mixes up
    parts = components(k, right.out_parts)
    if len(shape) == 2:  # insert an axis of one cell without faces, because the kernel is for 3-D
        shape = (shape[0], 1, shape[1])
        parts = [parts[0][:, None], np.zeros((0, 0, 0)), parts[1][:, None]]
        lines.insert(1, np.zeros((4, 2)))

    def run(x, out):
        fields = x.reshape(shape), *parts, *lines, out.reshape(shape)
        return kernels.run("stencil", "through_faces", prod(shape[:2]), x.size, kernels.threads(), *fields, has_mask)

    return run


def face_entries(left: Any, right: Any, axis: int, n: int) -> NDArray | None:
    """Return the entries of R and of L for the lower and the upper cell of each face of an axis of n cells.

    Return None if a face has entries for other cells than these two, or if there are several terms or axes. On a
    periodic axis, the last face is a copy of the first.
    """
    right_terms = right.blocks.get((axis, 0), ())
    left_terms = left.blocks.get((0, axis), ())
    for terms in (right_terms, left_terms):
        if len(terms) != 1 or terms[0].axes != (axis,):
            return None
    (slope,) = right_terms
    (difference,) = left_terms
    sides = (
        _entries_beside_faces(slope.factors[axis], slope.scale, n),
        _entries_beside_faces(difference.factors[axis].T, difference.scale, n),
    )
    for side in sides:
        if side is None or np.any(side[:, 1:n] == 0):  # the kernel would multiply a NaN in such a cell by 0
            return None
    return np.concatenate(sides)


def _entries_beside_faces(factor, scale, n):
    """Return the entries of a factor from n cells to faces, for the lower and upper cell of each face, or None."""
    matrix = factor.matrix
    row = rows_of(matrix)
    faces = factor.shape[0]
    is_below = matrix.indices == (row - 1) % faces
    is_above = matrix.indices == row
    if faces not in (n, n + 1) or not np.all(is_above ^ is_below):
        return None  # a face has entries of other cells, or (one periodic cell) the two cells of a face are the same
    sides = np.zeros((2, n + 1))
    sides[np.where(is_below, 0, 1), row] = scale * matrix.data
    sides[:, faces:] = sides[:, : n + 1 - faces]
    return sides
