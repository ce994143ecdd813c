"""Kronecker: block matrices whose blocks are sums of Kronecker products of 1-D factors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import cached_property, partial, reduce
from itertools import product
from math import prod
from operator import add
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from sparsedp import kernels
from sparsedp.grid.space import components
from sparsedp.operators.structure.base import INT32_LIMIT, BoundProduct, Structure, compact, rows_of
from sparsedp.operators.structure.factor import Factor

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Kronecker", "Term"]


class Term(NamedTuple):
    """The Kronecker product scale * (factor of axis 0) x (factor of axis 1) x ...; None stands for the identity."""

    scale: float
    factors: tuple[Any, ...]

    @property
    def axes(self) -> tuple[int, ...]:
        """Axes whose factor is not the identity."""
        return tuple(axis for axis, factor in enumerate(self.factors) if factor is not None)

    def transpose(self) -> Term:
        """Return the plain transpose."""
        return Term(self.scale, tuple(factor and factor.T for factor in self.factors))

    def __matmul__(self, other: Term) -> Term:
        pairs = zip(self.factors, other.factors, strict=True)
        return Term(self.scale * other.scale, tuple(_product(a, b) for a, b in pairs))


def _product(a, b):
    """Return a @ b, where None is the identity."""
    if a is None:
        return b
    if b is None:
        return a
    return a @ b


class Kronecker(Structure):
    """A block matrix with one block for each pair (component of the result, component of the argument).

    Parameters
    ----------
    out_parts, in_parts : tuples of shapes
        Shapes of the components of the result and of the argument. All have the same number of axes.
    blocks : dict
        Keys are pairs (component of the result, component of the argument). Values are tuples of Terms, whose sum is
        the block. Missing blocks are 0.
    """

    takes_complex = False  # the kernels support float64 only

    def __init__(self, out_parts: Sequence, in_parts: Sequence, blocks: dict) -> None:
        self.out_parts = tuple(out_parts)
        self.in_parts = tuple(in_parts)
        merged = {key: _merge(terms) for key, terms in blocks.items()}
        self.blocks = {key: terms for key, terms in sorted(merged.items()) if terms}
        self.shape = (sum(map(prod, self.out_parts)), sum(map(prod, self.in_parts)))
        self.passes = max(1, len(self.blocks))

    @classmethod
    def identity(cls, parts: Sequence) -> Kronecker:
        """Return the identity on components of these shapes."""
        term = (Term(1.0, (None,) * len(parts[0])),)
        return cls(parts, parts, {(c, c): term for c in range(len(parts))})

    @cached_property
    def is_identity(self) -> bool:  # type: ignore[override]
        """Whether this is exactly the identity."""
        return self.out_parts == self.in_parts and self.blocks == Kronecker.identity(self.out_parts).blocks

    # ------------------------------------------------------------ properties of a Kronecker sum

    @cached_property
    def separable(self) -> bool:  # type: ignore[override]
        """Whether this is a Kronecker sum: it has one component, and each term has a factor along at most one axis."""
        has_one_component = len(self.out_parts) == 1 and self.out_parts == self.in_parts
        return has_one_component and all(len(term.axes) <= 1 for term in self.terms)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms of block (0, 0), which is the only one of a Kronecker sum."""
        return self.blocks.get((0, 0), ())

    @cached_property
    def lines(self) -> dict[int, Factor]:
        """The scaled factors of a Kronecker sum by axis. The terms without factors are in `shift`."""
        return {axis: term.factors[axis].scaled(term.scale) for term in self.terms for axis in term.axes}

    @property
    def shift(self) -> float:
        """The multiple of the identity that a Kronecker sum contains."""
        return sum(term.scale for term in self.terms if not term.axes)

    def diagonal(self) -> NDArray:
        """Return the diagonal of a Kronecker sum."""
        lines = [np.zeros(n) for n in self.out_parts[0]]
        for axis, factor in self.lines.items():
            lines[axis] = factor.matrix.diagonal()
        return reduce(np.add.outer, lines, np.full((), float(self.shift))).reshape(-1)

    def components(self) -> tuple[NDArray, int]:
        """Return the label of the connected component of each unknown, and the number of components.

        The components of a Kronecker sum are products of components along the axes.
        """
        labels: Any = np.zeros((), np.int64)
        count = 1
        for axis, n in enumerate(self.out_parts[0]):
            axis_count = n
            axis_labels = np.arange(n)
            if axis in self.lines:
                axis_count, axis_labels = connected_components(self.lines[axis].matrix, directed=False)
            labels = np.add.outer(labels * axis_count, axis_labels)
            count *= axis_count
        return labels.reshape(-1), count

    def may_be_triangular(self) -> bool:
        """Return whether the graph of a Kronecker sum can have nodes that are on no cycle.

        This requires, for every axis, that the graph of its factor has such nodes.
        """
        for axis, n in enumerate(self.out_parts[0]):
            if axis in self.lines:
                count, labels = connected_components(self.lines[axis].matrix, directed=True, connection="strong")
                if n and not np.any(np.bincount(labels, minlength=count) == 1):
                    return False
        return True

    # ------------------------------------------------------------ algebra

    def transpose(self) -> Structure:
        """Return the plain transpose."""
        blocks = {(c, r): tuple(term.transpose() for term in terms) for (r, c), terms in self.blocks.items()}
        return Kronecker(self.in_parts, self.out_parts, blocks)

    def scaled(self, factor: complex) -> Structure | None:
        """Return factor * A."""
        if isinstance(factor, complex) or np.iscomplexobj(factor):
            return None
        return self._each(lambda term: Term(factor * term.scale, term.factors))

    def _each(self, change):
        """Return the structure with the function `change` applied to every term."""
        blocks = {key: tuple(map(change, terms)) for key, terms in self.blocks.items()}
        return Kronecker(self.out_parts, self.in_parts, blocks)

    def composed(self, other: Kronecker) -> Kronecker:
        """Return self @ other; the components of self's argument and of other's result must match."""
        blocks: defaultdict = defaultdict(tuple)
        for ((r, k), mine), ((j, c), theirs) in product(self.blocks.items(), other.blocks.items()):
            if k == j:
                blocks[r, c] += tuple(a @ b for a in mine for b in theirs)
        return Kronecker(self.out_parts, other.in_parts, blocks)

    def added(self, other: Kronecker) -> Kronecker:
        """Return self + other; both must have the same components."""
        keys = self.blocks | other.blocks
        blocks = {key: self.blocks.get(key, ()) + other.blocks.get(key, ()) for key in keys}
        return Kronecker(self.out_parts, self.in_parts, blocks)

    def magnitude(self) -> Callable[[NDArray], NDArray]:
        """Return the function that bounds abs(A) x for x >= 0."""
        return self.absolute.product

    @cached_property
    def absolute(self) -> Kronecker:
        """The structure with every entry of every term replaced by its absolute value."""
        return self._each(_absolute)

    # ------------------------------------------------------------ forms

    def explicit(self) -> sp.csr_array:
        """Return the entries as a csr_array with 32-bit indices."""
        if not self.blocks:
            return compact(sp.csr_array(self.shape))
        columns = list(enumerate(self.in_parts))
        rows = [[_block(self.blocks.get((r, c), ()), m, n) for c, n in columns] for r, m in enumerate(self.out_parts)]
        return compact(rows[0][0] if len(rows) == len(columns) == 1 else sp.block_array(rows))

    def act(self, x: NDArray, out: NDArray) -> None:
        """Write A x into `out`: see `Structure.act`."""
        if self._only_step is not None:
            self._only_step(x, out, False)
            return
        inputs = components(x, self.in_parts)
        for steps, target in zip(self._plan, components(out, self.out_parts)):
            if not steps:
                target[...] = 0
            for number, (column, step) in enumerate(steps):
                step(inputs[column], target, number > 0)

    def bound(self, dtype: np.dtype) -> BoundProduct:
        """Return the product with arrays of this dtype: see `Structure.bound`."""
        if not dtype == self.dtype == float:
            return super().bound(dtype)
        if self._only_step is not None:
            return BoundProduct(partial(self._only_step, accumulate=False))
        return BoundProduct(self.act)

    @cached_property
    def _only_step(self):
        """The function ``run(x, out, accumulate)`` of flat arrays that computes the whole product, or None."""
        if len(self._plan) == len(self.in_parts) == 1 and len(self._plan[0]) == 1:
            return self._plan[0][0][1]
        return None

    @cached_property
    def _plan(self):
        """For each component of the result, pairs (component of the argument, function) whose results are added."""
        plans: list[list] = [[] for _ in self.out_parts]
        for (r, c), terms in self.blocks.items():
            shape = self.in_parts[c]
            fusible = [t for t in terms if len(t.axes) <= 1 and all(t.factors[a].tridiagonal for a in t.axes)]
            if len(fusible) > 1 and shape == self.out_parts[r] and not plans[r]:
                plans[r].append((c, _fused_pass(fusible, shape)))
                terms = [t for t in terms if t not in fusible]
            plans[r] += [(c, _pass(term, shape)) for term in terms]
        return plans


def _fused_pass(terms, shape):
    """Return a function ``run(u, out, False)`` that computes a sum of tridiagonal terms in one pass over memory."""
    shift = sum(term.scale for term in terms if not term.axes)
    axes = [None] * 3
    first = 3 - len(shape)
    for term in terms:
        for axis in term.axes:
            axes[first + axis] = term.factors[axis].scaled(term.scale).tridiagonal
    return kernels.summed((1,) * first + shape, axes, shift)


def _pass(term, shape):
    """Return a function ``run(u, out, accumulate)`` that applies a term axis by axis; the last result goes to `out`."""
    if _is_on_one_plane(term):
        return _plane_pass(term, shape)
    steps = []
    for axis in term.axes or (0,):
        factor = term.factors[axis] or Factor(sp.eye_array(shape[axis]))
        before = prod(shape[:axis])
        after = prod(shape[axis + 1 :])
        steps.append((factor.rows, (before, factor.shape[1], after), (before, factor.shape[0], after)))
        shape = shape[:axis] + factor.shape[:1] + shape[axis + 1 :]

    def run(u, out, accumulate):
        for rows, in_shape, out_shape in steps[:-1]:
            result = np.empty(out_shape)
            kernels.along_axis(u.reshape(in_shape), result, rows, 1.0, False)
            u = result
        rows, in_shape, out_shape = steps[-1]
        kernels.along_axis(u.reshape(in_shape), out.reshape(out_shape), rows, term.scale, accumulate)

    return run


def _is_on_one_plane(term):
    """Return whether a term has one factor with a single entry, and others that only select entries.

    The boundary conditions on part of a wall are such terms.
    """
    factors = [factor for factor in term.factors if factor is not None]
    if len(factors) < 2 or all(factor.matrix.nnz != 1 for factor in factors):
        return False
    others = [factor for factor in factors if not _is_selection(factor)]
    return not others or (len(others) == 1 and others[0].matrix.nnz == 1)


def _is_selection(factor):
    """Return whether a factor is a diagonal matrix of zeros and ones."""
    matrix = factor.matrix
    is_diagonal = matrix.shape[0] == matrix.shape[1] and np.array_equal(rows_of(matrix), matrix.indices)
    return is_diagonal and bool(np.all(matrix.data == 1))


def _plane_pass(term, shape):
    """Return the function of `_pass` for a term on one plane, which visits only the entries of the plane."""
    out_shape = []
    rows = []
    columns = []
    value = 1.0
    for factor, n in zip(term.factors, shape, strict=True):
        if factor is None:
            factor = Factor(sp.eye_array(n))
        out_shape.append(factor.shape[0])
        rows.append(rows_of(factor.matrix))
        columns.append(factor.matrix.indices)
        if factor.matrix.nnz == 1:
            value = value * factor.matrix.data[0]
    row = np.ravel_multi_index(np.ix_(*rows), out_shape).reshape(-1)
    column = np.ravel_multi_index(np.ix_(*columns), shape).reshape(-1)
    scale = term.scale

    def run(u, out, accumulate):
        if not accumulate:
            out[...] = 0
        out.reshape(-1)[row] += scale * (value * u.reshape(-1)[column])

    return run


def _absolute(term):
    """Return a term with every entry replaced by its absolute value."""
    return Term(abs(term.scale), tuple(factor and Factor(abs(factor.matrix)) for factor in term.factors))


def _block(terms, out_part, in_part):
    """Return the sum of terms as a sparse matrix."""
    if not terms:
        return sp.csr_array((prod(out_part), prod(in_part)))
    return reduce(add, [_product_matrix(term, in_part) for term in terms])


def _product_matrix(term, in_part):
    """Return the Kronecker product of the factors of a term as a matrix."""
    sides = []
    for factor, n in zip(term.factors, in_part, strict=True):
        if factor is None:
            sides.append(sp.eye_array(n, format="csr"))
        else:
            sides.append(factor.matrix)
    return term.scale * reduce(_kronecker_product, sides)


def _kronecker_product(left, right):
    """Return the Kronecker product of two canonical csr_arrays, with the entries of ``scipy.sparse.kron``.

    Each entry is written to its place. SciPy sorts them, which takes three times as long for small factors.
    """
    shape = (left.shape[0] * right.shape[0], left.shape[1] * right.shape[1])
    index_type = np.int32 if max(*shape, left.nnz * right.nnz) < INT32_LIMIT else np.int64
    lengths = np.diff(right.indptr).astype(index_type)  # of the rows of the right factor
    starts = np.zeros(shape[0] + 1, index_type)
    np.cumsum(np.outer(np.diff(left.indptr), lengths), out=starts[1:])
    left_rows = rows_of(left)
    right_rows = rows_of(right)
    rank_in_left_row = np.arange(left.nnz, dtype=index_type) - left.indptr[left_rows]
    rank_in_right_row = np.arange(right.nnz, dtype=index_type) - right.indptr[right_rows]
    places = starts[:-1].reshape(left.shape[0], right.shape[0])[left_rows[:, None], right_rows]
    places += rank_in_left_row[:, None] * lengths[right_rows] + rank_in_right_row
    columns = np.empty(places.size, index_type)
    columns[places] = left.indices.astype(index_type)[:, None] * index_type(right.shape[1]) + right.indices
    values = np.empty(places.size, np.result_type(left.data, right.data))
    values[places] = left.data[:, None] * right.data
    return sp.csr_array((values, columns, starts), shape)


def _merge(terms):
    """Merge terms with factors along the same single axis, and terms with equal factors; drop terms that are 0."""
    merged: dict = {}
    for term in terms:
        has_one_axis = len(term.axes) == 1
        key: Any = term.axes
        if not has_one_axis:
            key = tuple(factor and factor.key for factor in term.factors)
        if key not in merged:
            merged[key] = term
        elif has_one_axis:
            merged[key] = _sum_on_axis(merged[key], term)
        else:
            merged[key] = Term(merged[key].scale + term.scale, term.factors)
    return tuple(term for term in merged.values() if not _is_zero(term))


def _sum_on_axis(first, second):
    """Return the sum of two terms with factors along the same single axis."""
    (axis,) = first.axes
    factors: list = [None] * len(first.factors)
    factors[axis] = first.factors[axis].scaled(first.scale) + second.factors[axis].scaled(second.scale)
    return Term(1.0, tuple(factors))


def _is_zero(term):
    """Return whether a term has no entries."""
    return term.scale == 0 or any(factor and factor.matrix.nnz == 0 for factor in term.factors)
