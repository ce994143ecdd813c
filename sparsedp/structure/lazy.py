"""Lazy structures: diagonals, products, sums and functions. Nothing is multiplied out before it is needed."""

from functools import cached_property, reduce

import numpy as np
import scipy.sparse as sp

from sparsedp import kernels
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.fields import frozen
from sparsedp.recipe import Remade
from sparsedp.structure.base import Structure, compact, result_dtype, rows_of
from sparsedp.structure.kronecker import Kronecker

__all__ = [
    "Chain",
    "Diagonal",
    "Functions",
    "Mask",
    "Sum",
    "compose",
    "total",
]

FEW = 16384  # cells for which passes one after the other are quick
SHORT = 80  # cells along the last axis, the inner loop of the fused pass: below, its rows cost more than they save


class Diagonal(Structure):
    """Multiplication by one number for each entry."""

    def __init__(self, values):
        values = np.array(values).reshape(-1)
        self.values = values.astype(complex if values.dtype.kind == "c" else float)
        self.values.flags.writeable = False
        self.shape = (values.size, values.size)
        self.dtype = self.values.dtype

    def apply(self, x, out):
        np.multiply(x, self.values, out=out, casting="same_kind")

    def transpose(self):
        return self

    def explicit(self):
        return compact(sp.diags_array(self.values, format="csr"))

    def scaled(self, factor):
        return Diagonal(self.values * factor)

    def magnitude(self):
        return lambda x: np.abs(self.values) * x


class Mask(Diagonal):
    """Zero outside `keep`, exactly: what is masked out may be NaN."""

    def __init__(self, keep):
        self.keep = np.array(keep, dtype=bool).reshape(-1)
        super().__init__(self.keep)

    def apply(self, x, out):
        out.fill(0)
        np.copyto(out, x, where=self.keep)

    def explicit(self):
        kept = np.flatnonzero(self.keep)
        return compact(sp.coo_array((np.ones(kept.size), (kept, kept)), shape=self.shape))


class Chain(Structure):
    """A product of structures, applied from right to left."""

    def __init__(self, members):
        self.members = tuple(members)
        self.shape = (members[0].shape[0], members[-1].shape[1])
        self.dtype = np.result_type(*(member.dtype for member in members))
        self.has_entries = all(member.has_entries for member in members)
        self.passes = max(member.passes for member in members)

    def apply(self, x, out):
        if x.dtype == float == self.dtype and x.size >= FEW and kernels.compiled():
            if self._fused is not None and self._fused.shape[-1] >= SHORT and self._fused.apply(x, out):
                return
        single = x.dtype.char in "fF"
        x = x.astype(np.result_type(x.dtype, np.float64)) if single else x
        for member in self.members[:0:-1]:
            x = member.product(x)
        if single:  # intermediate results in double, one rounding at the end
            np.copyto(out, self.members[0].product(x), casting="same_kind")
        else:
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
        return compact(reduce(lambda a, b: a @ b, (member.explicit() for member in self.members)))

    def scaled(self, factor):
        return Chain([self.members[0].scaled(factor), *self.members[1:]])

    def magnitude(self):
        members = [member.magnitude() for member in reversed(self.members)]
        return lambda x: reduce(lambda y, member: member(y), members, x)

    def tangent(self):
        tangents = [member.tangent() for member in self.members]
        same = all(a is b for a, b in zip(tangents, self.members, strict=True))
        return self if same else Chain(tangents)


class Sum(Structure):
    """A sum of structures."""

    def __init__(self, members):
        self.members = tuple(members)
        self.shape = members[0].shape
        self.dtype = np.result_type(*(member.dtype for member in members))
        self.has_entries = all(member.has_entries for member in members)

    def apply(self, x, out):
        if x.dtype.char in "fF":
            x = x.astype(np.result_type(x.dtype, np.float64))
            np.copyto(out, reduce(np.add, (member.product(x) for member in self.members)), casting="same_kind")
            return
        first, *rest = self.members
        np.copyto(out, first.product(x)) if result_dtype(first, x.dtype) != out.dtype else first.apply(x, out)
        for member in rest:
            out += member.product(x)

    def transpose(self):
        return Sum([member.transpose() for member in self.members])

    def explicit(self):
        return compact(reduce(lambda a, b: a + b, (member.explicit() for member in self.members)))

    def scaled(self, factor):
        return Sum([member.scaled(factor) for member in self.members])

    def magnitude(self):
        members = [member.magnitude() for member in self.members]
        return lambda x: sum(member(x) for member in members)

    def tangent(self):
        tangents = [member.tangent() for member in self.members]
        same = all(a is b for a, b in zip(tangents, self.members, strict=True))
        return self if same else Sum(tangents)


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
        """The call that makes it again: see recipe.py."""
        return Functions, (self.forward, self.backward, self.domain, self.codomain, self.dtype)

    def apply(self, x, out):
        if self.forward is None:
            raise DerivativeError("this operator has no transpose; give from_functions its second function")
        y = np.asarray(self.forward(frozen(x.reshape(self.domain))))  # the field is the caller's
        if y.shape != self.codomain:
            raise ShapeError(f"the function must return an array of shape {self.codomain}, got {y.shape}")
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

    Identities vanish, factor-defined maps stay factor-defined, diagonals meet in one diagonal;
    the rest becomes a chain, whose ends are tried first.
    """
    left = list(a.members) if isinstance(a, Chain) else [a]
    right = list(b.members) if isinstance(b, Chain) else [b]
    while left and right:
        joined = _joined(left[-1], right[0])
        if joined is None:
            break
        left, right = left[:-1], [joined, *right[1:]]
        if len(right) > 1 and (closer := _joined(right[0], right[1])) is not None:
            right = [closer, *right[2:]]
    members = left + right
    return members[0] if len(members) == 1 else Chain(members)


def _joined(a, b):
    """One structure for a @ b, or None when it has to stay a pair."""
    if b.is_identity:
        return a
    if a.is_identity:
        return b
    if isinstance(a, Kronecker) and isinstance(b, Kronecker) and a.in_parts == b.out_parts:
        return a.composed(b)
    if isinstance(a, Mask) and isinstance(b, Mask):
        return Mask(a.keep & b.keep)
    if isinstance(a, Diagonal) and isinstance(b, Diagonal):
        return Diagonal(a.values * b.values)
    return None


def total(a, b):
    """Structure of a + b."""
    left = list(a.members) if isinstance(a, Sum) else [a]
    right = list(b.members) if isinstance(b, Sum) else [b]
    for member in right:
        for place, other in enumerate(left):
            joined = _added(other, member)
            if joined is not None:
                left[place] = joined
                break
        else:
            left.append(member)
    return left[0] if len(left) == 1 else Sum(left)


def _added(a, b):
    if isinstance(a, Kronecker) and isinstance(b, Kronecker) and (a.out_parts, a.in_parts) == (b.out_parts, b.in_parts):
        return a.added(b)
    if isinstance(a, Diagonal) and isinstance(b, Diagonal):
        return Diagonal(a.values + b.values)
    return None


# ---- products with faces between cells, in one pass ----


def entries_beside(left, right, axis, n, periodic):
    """Entries of L (cells <- faces) and of R (faces <- cells) at each face across an axis, for the cells beside it.

    Parameters
    ----------
    left, right : Kronecker
    axis, n : int
        n cells along the axis.
    periodic : bool

    Returns
    -------
    ((r_below, r_above), (l_below, l_above)), arrays of one number for each face, or None
        None where another axis, a second term or a further cell takes part.
    """
    terms, slopes = left.blocks.get((0, axis), ()), right.blocks.get((axis, 0), ())
    if len(terms) != 1 or len(slopes) != 1 or terms[0].axes != (axis,) or slopes[0].axes != (axis,):
        return None
    faces = n if periodic else n + 1
    there = _beside(slopes[0].factors[axis], slopes[0].scale, n, faces, periodic)
    back = _beside(terms[0].factors[axis].T, terms[0].scale, n, faces, periodic)
    return None if there is None or back is None else (there, back)


def _beside(factor, scale, n, faces, periodic):
    """A factor from cells to faces -> its entries for the cell below and the cell above each face, or None."""
    m = factor.matrix
    row = rows_of(m)
    below, above = np.zeros(faces), np.zeros(faces)
    is_above = m.indices == row
    is_below = (m.indices == row - 1) | (periodic & (row == 0) & (m.indices == n - 1))
    if not np.all(is_above ^ is_below):  # further cells; or one periodic cell, on both sides of its face
        return None
    above[row[is_above]], below[row[is_below]] = scale * m.data[is_above], scale * m.data[is_below]
    return below, above


class ThroughFaces:
    """L diag(k) R on fields of float64.

    Parameters
    ----------
    shape : tuple
        Of the cells, in 2-D or 3-D.
    lines : four arrays for each axis
        Entries of R for the cells below and above each face, then those of L.
    k : array
        A number for each face.
    closed : bool
        Whether faces with k = 0 carry 0, whatever the cells hold.
    """

    def __init__(self, shape, lines, k, closed):
        self.closed, none = closed, np.zeros((0, 0, 0))
        counts = [n + (line[0].size > n) for n, line in zip(shape, lines)]
        sizes = [(*shape[:axis], count, *shape[axis + 1 :]) for axis, count in enumerate(counts)]
        pieces = np.split(k, np.cumsum([np.prod(size, dtype=int) for size in sizes])[:-1])
        parts, lines = [part.reshape(size) for part, size in zip(pieces, sizes)], [tuple(line) for line in lines]
        if len(shape) == 2:
            shape, lines = (shape[0], 1, shape[1]), [lines[0], (np.zeros(1),) * 4, lines[1]]
            parts = [parts[0][:, None], none, parts[1][:, None]]
        self.shape, self.parts = shape, tuple(parts)
        ends = [side for line in lines for side in line]
        cells = np.repeat(shape, 4)
        wide = [np.append(side, side[0]) if side.size == n else side for n, side in zip(cells, ends)]
        self.lines = tuple(np.stack(wide[4 * axis : 4 * axis + 4]) for axis in range(3))

    def apply(self, x, out):
        """Write the product into `out` -> whether it could be done."""
        fields, rows = (
            (x.reshape(self.shape), *self.parts, *self.lines, out.reshape(self.shape)),
            np.prod(self.shape[:2]),
        )
        return kernels.run("stencil", "through_faces", rows, x.size, kernels.threads(), *fields, self.closed)


def through_faces(left, middle, right):
    """Structures L (faces -> cells), the diagonals between, R (cells -> faces) -> ThroughFaces, or None."""
    if not (isinstance(left, Kronecker) and isinstance(right, Kronecker) and middle):
        return None
    if len(right.in_parts) != 1 or left.out_parts != right.in_parts or left.in_parts != right.out_parts:
        return None
    shape = right.in_parts[0]
    if len(shape) not in (2, 3) or len(left.in_parts) != len(shape) or min(shape) < 2:
        return None
    lines = [_line(left, right, shape, axis) for axis in range(len(shape))]
    if any(line is None for line in lines):
        return None
    closed = [hasattr(member, "keep") for member in middle]
    if any(closed) and not all(one or np.all(member.values != 0) for one, member in zip(closed, middle)):
        return None  # 0 times NaN is NaN for some of the zeros, and 0 for others
    k = middle[0].values
    for member in middle[1:]:
        k = k * member.values
    return ThroughFaces(shape, lines, k, any(closed)) if k.dtype == float else None


def _line(left, right, shape, axis):
    """Entries of R and of L at the faces across an axis; None where they are not of that kind."""
    n, faces = shape[axis], right.out_parts[axis][axis]
    if faces not in (n, n + 1) or right.out_parts[axis] != (*shape[:axis], faces, *shape[axis + 1 :]):
        return None
    found = entries_beside(left, right, axis, n, faces == n)
    if found is None:
        return None
    (there, back), inner = found, slice(1, n)
    whole = all(np.all(side[inner] != 0) for side in (*there, *back))  # else what is not read could be NaN
    return (*there, *back) if whole else None
