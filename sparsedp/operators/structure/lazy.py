"""Lazy structures: diagonals, products, sums and functions. Nothing is multiplied out before it is needed."""

from functools import cached_property, reduce
from math import prod
from operator import add, matmul
from operator import mul as multiply

import numpy as np
import scipy.sparse as sp

from sparsedp import kernels
from sparsedp._utils.reconstruction import Remade
from sparsedp._utils.validation import check_shape
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import DerivativeError
from sparsedp.grid.space import components
from sparsedp.operators.structure.base import Structure, compact, rows_of
from sparsedp.operators.structure.kronecker import Kronecker

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

DEEPEST = 200  # products in sums in products: recursions over deeper operators would leave Python's limit
FEW = 16384  # cells for which passes one after the other are quick
SHORT = 80  # cells along the last axis, the inner loop of the fused pass: below, its rows cost more than they save


class Diagonal(Structure):
    """Multiplication by one number for each entry."""

    def __init__(self, values):
        self.values = np.array(values, np.result_type(values, float)).reshape(-1)
        self.values.flags.writeable = False
        self.shape, self.dtype = (self.values.size,) * 2, self.values.dtype

    def act(self, x, out):
        np.multiply(x, self.values, out=out)

    def transpose(self):
        return self

    def explicit(self):
        return compact(sp.diags_array(self.values, format="csr"))

    def scaled(self, factor):
        return Diagonal(self.values * factor)

    def magnitude(self):
        return lambda x: np.abs(self.values) * x


class Mask(Diagonal):
    """Zero outside `keep`, exactly: what is masked out may be NaN. Inside, one number for each entry."""

    def __init__(self, keep, values=1.0):
        self.keep = np.array(keep, dtype=bool).reshape(-1)
        super().__init__(np.where(self.keep, values, 0.0))

    def act(self, x, out):
        out.fill(0)
        np.multiply(x, self.values, out=out, where=self.keep)

    def scaled(self, factor):
        return Mask(self.keep, self.values * factor)


class Chain(Structure):
    """A product of structures, applied from right to left; products among them are taken apart."""

    def __init__(self, members):
        self.members = tuple(inner for member in members for inner in _members(member, Chain))
        self.shape = (members[0].shape[0], members[-1].shape[1])
        self.dtype = np.result_type(*(member.dtype for member in members))
        self.has_entries = all(member.has_entries for member in members)
        self.depth = _nested(self.members)
        self.passes = max(member.passes for member in members)

    def act(self, x, out):
        large = x.dtype == float == self.dtype and x.size >= FEW and kernels.compiled()
        if large and self._fused is not None and self._fused(x, out):
            return
        for member in self.members[:0:-1]:
            x = member.product(x)
        self.members[0].apply(x, out)

    @cached_property
    def _fused(self):
        """All members in one pass, where they are differences through faces; else None."""
        middle = self.members[1:-1]
        diagonals = all(isinstance(member, Diagonal) for member in middle)
        return through_faces(self.members[0], middle, self.members[-1]) if diagonals else None

    def transpose(self):
        return Chain([member.transpose() for member in reversed(self.members)])

    def explicit(self):
        return compact(reduce(matmul, (member.explicit() for member in self.members)))

    def scaled(self, factor):
        return compose(times(self.members[0], factor), Chain(self.members[1:]))

    def magnitude(self):
        members = [member.magnitude() for member in reversed(self.members)]
        return lambda x: reduce(lambda y, member: member(y), members, x)


class Sum(Structure):
    """A sum of structures."""

    def __init__(self, members):
        self.members = tuple(sorted(members, key=lambda member: member.dtype.kind))  # a complex one first: it has room
        self.shape, self.dtype = members[0].shape, self.members[0].dtype
        self.has_entries = all(member.has_entries for member in members)
        self.depth = _nested(self.members)

    def act(self, x, out):
        first, *rest = self.members
        first.apply(x, out)
        for member in rest:
            out += member.product(x)

    def transpose(self):
        return Sum([member.transpose() for member in self.members])

    def explicit(self):
        return compact(reduce(add, (member.explicit() for member in self.members)))

    def scaled(self, factor):
        return Sum([times(member, factor) for member in self.members])

    def magnitude(self):
        members = [member.magnitude() for member in self.members]
        return lambda x: sum(member(x) for member in members)


class Functions(Remade, Structure):
    """A linear map given by two functions on fields: the product and the transposed product."""

    name = "an operator of two functions"
    has_entries = False

    def __init__(self, forward, backward, domain, codomain, dtype=float):
        self.forward, self.backward = forward, backward
        self.domain, self.codomain = domain, codomain  # shapes of the fields
        self.shape = (int(np.prod(codomain)), int(np.prod(domain)))
        self.dtype = np.dtype(dtype)

    def recipe(self):
        """The call that makes it again: see _utils/reconstruction.py."""
        return Functions, (self.forward, self.backward, self.domain, self.codomain, self.dtype)

    def apply(self, x, out):
        if self.forward is None:
            raise DerivativeError("this operator has no transpose; give from_functions its second function")
        y = np.asarray(self.forward(frozen(x.reshape(self.domain))))  # the field is the caller's
        check_shape("what the function returns", y, self.codomain)
        if y.dtype.kind == "c" and out.dtype.kind != "c":
            raise DerivativeError(
                "the function returned complex values for a real field; give its operator dtype=complex"
            )
        np.copyto(out, y.reshape(-1), casting="same_kind")

    def transpose(self):
        return Functions(self.backward, self.forward, self.codomain, self.domain, self.dtype)


# ---- products and sums: kept as factors where that is exact, lazy elsewhere ----


def compose(a, b):
    """Structure of a @ b.

    Identities vanish, factor-defined maps stay factor-defined, diagonals meet in one diagonal; the rest becomes a
    chain, and so do Kronecker sums of two axes and more, whose product is none.
    """
    members = _members(a, Chain)
    for member in _members(b, Chain):
        while members and (joined := _joined(members[-1], member)) is not None:
            members, member = members[:-1], joined
        members.append(member)
    return members[0] if len(members) == 1 else Chain(members)


def _nested(members):
    """Return the depth of a product or sum of these members; refuse what Python could not recurse over."""
    depth = 1 + max((member.depth for member in members), default=0)
    if depth > DEEPEST:
        raise ValueError(
            f"an operator nests sums and products of operators more than {DEEPEST} deep; apply the operators one after "
            "the other, as in v = A(v) + u, or assemble a part of it: dp.from_matrix(part.matrix)"
        )
    return depth


def _members(structure, kind):
    """The members of a structure of this kind; else the structure itself."""
    return list(structure.members) if isinstance(structure, kind) else [structure]


def _joined(a, b):
    """One structure for a @ b, or None when it has to stay a pair."""
    if b.is_identity:
        return a
    if a.is_identity:
        return b
    if isinstance(a, Kronecker) and isinstance(b, Kronecker) and a.in_parts == b.out_parts:
        product = a.composed(b)
        return (
            None if a.separable and b.separable and not product.separable else product
        )  # L @ L keeps its eigenvectors
    if isinstance(a, Diagonal) and isinstance(b, Diagonal):
        kept = [member.keep for member in (a, b) if isinstance(member, Mask)]
        return Mask(np.all(kept, axis=0), a.values * b.values) if kept else Diagonal(a.values * b.values)
    return None


def times(structure, factor):
    """Structure of factor * structure."""
    scaled = structure.scaled(factor)
    if scaled is not None:
        return scaled
    return compose(Diagonal(np.full(structure.shape[0], factor)), structure)


def total(a, b):
    """Structure of a + b."""
    members = _members(a, Sum)
    for member in _members(b, Sum):
        for place, other in enumerate(members):
            if (joined := _added(other, member)) is not None:
                members[place] = joined
                break
        else:
            members.append(member)
    return members[0] if len(members) == 1 else Sum(members)


def _added(a, b):
    if isinstance(a, Kronecker) and isinstance(b, Kronecker) and (a.out_parts, a.in_parts) == (b.out_parts, b.in_parts):
        return a.added(b)
    if isinstance(a, Diagonal) and isinstance(b, Diagonal):
        return Diagonal(a.values + b.values)
    return None


# ---- products with faces between cells, in one pass ----


def through_faces(left, middle, right):
    """Structures L (faces -> cells), the diagonals between, R (cells -> faces) -> their product in one pass, or None.

    It is a function of x and of the array for the result that says whether it could be done.
    """
    if not (isinstance(left, Kronecker) and isinstance(right, Kronecker) and middle):
        return None
    if len(right.in_parts) != 1 or left.out_parts != right.in_parts or left.in_parts != right.out_parts:
        return None
    shape = right.in_parts[0]
    if len(shape) not in (2, 3) or len(left.in_parts) != len(shape) or min(shape) < 2 or shape[-1] < SHORT:
        return None
    lines = [face_entries(left, right, axis, n) for axis, n in enumerate(shape)]
    closed = [isinstance(member, Mask) for member in middle]
    k = reduce(multiply, (member.values for member in middle))
    if any(line is None for line in lines) or k.dtype != float:
        return None
    if any(closed) and not all(np.all(member.values[getattr(member, "keep", ...)] != 0) for member in middle):
        return None  # 0 times NaN is NaN for some of the zeros, and 0 for others
    parts = components(k, right.out_parts)
    if len(shape) == 2:  # an axis of one cell, without faces
        shape, parts = (shape[0], 1, shape[1]), [parts[0][:, None], np.zeros((0, 0, 0)), parts[1][:, None]]
        lines.insert(1, np.zeros((4, 2)))

    def run(x, out):
        fields = x.reshape(shape), *parts, *lines, out.reshape(shape)
        return kernels.run("stencil", "through_faces", prod(shape[:2]), x.size, kernels.threads(), *fields, any(closed))

    return run


def face_entries(left, right, axis, n):
    """Entries of R for the cells below and above each face across an axis of n cells, and those of L; or None.

    None where another axis, a second term or a further cell takes part. On a periodic axis the last face is the first.
    """
    terms = right.blocks.get((axis, 0), ()), left.blocks.get((0, axis), ())
    if any(len(found) != 1 or found[0].axes != (axis,) for found in terms):
        return None
    (slope,), (back,) = terms
    sides = _beside(slope.factors[axis], slope.scale, n), _beside(back.factors[axis].T, back.scale, n)
    if any(side is None or np.any(side[:, 1:n] == 0) for side in sides):  # what is not read could be NaN
        return None
    return np.concatenate(sides)


def _beside(factor, scale, n):
    """A factor from n cells to faces -> its entries for the cell below and the cell above each face, or None."""
    m, row, faces = factor.matrix, rows_of(factor.matrix), factor.shape[0]
    is_below, is_above = m.indices == (row - 1) % faces, m.indices == row
    if faces not in (n, n + 1) or not np.all(is_above ^ is_below):
        return None  # further cells; or one periodic cell, on both sides of its face
    sides = np.zeros((2, n + 1))
    sides[np.where(is_below, 0, 1), row] = scale * m.data
    sides[:, faces:] = sides[:, : n + 1 - faces]
    return sides
