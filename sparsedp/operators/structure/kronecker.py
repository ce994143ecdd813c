"""Kronecker: blocks of sums of Kronecker products of 1-D factors. One definition, every form."""

from collections import defaultdict
from functools import cached_property, partial, reduce
from itertools import product
from math import prod
from operator import add
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from sparsedp import kernels
from sparsedp.grid.space import components
from sparsedp.operators.structure.base import Structure, compact
from sparsedp.operators.structure.factor import Factor

__all__ = ["Kronecker", "Term"]


class Term(NamedTuple):
    """scale * (factor of axis 0) x (factor of axis 1) x ...; a factor None is the identity."""

    scale: float
    factors: tuple[Any, ...]

    @property
    def axes(self):
        """Axes whose factor is not the identity."""
        return tuple(axis for axis, factor in enumerate(self.factors) if factor is not None)

    def transpose(self):
        return Term(self.scale, tuple(factor and factor.T for factor in self.factors))

    def __matmul__(self, other):
        pairs = zip(self.factors, other.factors, strict=True)
        return Term(self.scale * other.scale, tuple(_product(a, b) for a, b in pairs))


def _product(a, b):
    return b if a is None else a if b is None else a @ b


class Kronecker(Structure):
    """A matrix of blocks, one for each pair (component of the result, component of the field).

    Parameters
    ----------
    out_parts, in_parts : tuples of shapes
        Shapes of the components, all of one dimension.
    blocks : dict
        (row, column) -> tuple of Terms; a missing pair is a zero block.
    """

    takes_complex = False  # the loops know float64 only

    def __init__(self, out_parts, in_parts, blocks):
        self.out_parts = tuple(out_parts)
        self.in_parts = tuple(in_parts)
        merged = {key: _merge(terms) for key, terms in blocks.items()}
        self.blocks = {key: terms for key, terms in sorted(merged.items()) if terms}
        self.shape = (sum(map(prod, self.out_parts)), sum(map(prod, self.in_parts)))
        self.passes = max(1, len(self.blocks))

    @classmethod
    def identity(cls, parts):
        """The identity on components of the given shapes."""
        term = (Term(1.0, (None,) * len(parts[0])),)
        return cls(parts, parts, {(c, c): term for c in range(len(parts))})

    @cached_property
    def is_identity(self):  # type: ignore[override]
        """Whether this is the identity, exactly."""
        return self.out_parts == self.in_parts and self.blocks == Kronecker.identity(self.out_parts).blocks

    # ------------------------------------------------------------ what is known of a Kronecker sum

    @cached_property
    def separable(self):  # type: ignore[override]
        """Whether it is a Kronecker sum on one component: one factor along one axis in each term."""
        one = len(self.out_parts) == 1 and self.out_parts == self.in_parts
        return one and all(len(term.axes) <= 1 for term in self.terms)

    @property
    def terms(self):
        """The terms of the first component."""
        return self.blocks.get((0, 0), ())

    @cached_property
    def lines(self):
        """The factor along each axis that has one, with its scale; what else there is, is a shift."""
        return {axis: term.factors[axis].scaled(term.scale) for term in self.terms for axis in term.axes}

    @property
    def shift(self):
        """The multiple of the identity beside the factors."""
        return sum(term.scale for term in self.terms if not term.axes)

    def diagonal(self):
        """The diagonal of a Kronecker sum."""
        lines = [
            self.lines[axis].matrix.diagonal() if axis in self.lines else np.zeros(n)
            for axis, n in enumerate(self.out_parts[0])
        ]
        return reduce(np.add.outer, lines, np.full((), float(self.shift))).reshape(-1)

    def components(self):
        """(labels, count): components of a Kronecker sum are the products of those along the axes."""
        labels, count = np.zeros((), np.int64), 1
        for axis, n in enumerate(self.out_parts[0]):
            many, line = n, np.arange(n)
            if axis in self.lines:
                many, line = connected_components(self.lines[axis].matrix, directed=False)
            labels, count = np.add.outer(labels * many, line), count * many
        return labels.reshape(-1), count

    def may_be_triangular(self):
        """Whether some rows of a Kronecker sum are part of no cycle: along each axis there must be such rows."""
        for axis, n in enumerate(self.out_parts[0]):
            if axis in self.lines:
                count, labels = connected_components(self.lines[axis].matrix, directed=True, connection="strong")
                if n and not np.any(np.bincount(labels, minlength=count) == 1):
                    return False
        return True

    # ------------------------------------------------------------ algebra

    def transpose(self):
        turned = {(c, r): tuple(term.transpose() for term in terms) for (r, c), terms in self.blocks.items()}
        return Kronecker(self.in_parts, self.out_parts, turned)

    def scaled(self, factor):
        real = not np.iscomplexobj(factor)
        return self._each(lambda term: Term(factor * term.scale, term.factors)) if real else None

    def _each(self, change):
        """The same blocks with every term changed."""
        blocks = {key: tuple(map(change, terms)) for key, terms in self.blocks.items()}
        return Kronecker(self.out_parts, self.in_parts, blocks)

    def composed(self, other):
        """self @ other, both Kronecker with matching components."""
        blocks: defaultdict = defaultdict(tuple)
        for ((r, k), mine), ((j, c), theirs) in product(self.blocks.items(), other.blocks.items()):
            if k == j:
                blocks[r, c] += tuple(a @ b for a in mine for b in theirs)
        return Kronecker(self.out_parts, other.in_parts, blocks)

    def added(self, other):
        """self + other, both Kronecker with the same components."""
        keys = self.blocks | other.blocks
        return Kronecker(
            self.out_parts,
            self.in_parts,
            {key: self.blocks.get(key, ()) + other.blocks.get(key, ()) for key in keys},
        )

    def magnitude(self):
        return self.absolute.product

    @cached_property
    def absolute(self):
        """The same of magnitudes, term by term."""
        return self._each(_absolute)

    # ------------------------------------------------------------ forms

    def explicit(self):
        if not self.blocks:
            return compact(sp.csr_array(self.shape))
        columns = list(enumerate(self.in_parts))
        rows = [[_block(self.blocks.get((r, c), ()), m, n) for c, n in columns] for r, m in enumerate(self.out_parts)]
        return compact(sp.block_array(rows))

    def act(self, x, out):
        inputs = components(x, self.in_parts)
        for steps, target in zip(self._plan, components(out, self.out_parts)):
            if not steps:
                target[...] = 0
            for number, (column, step) in enumerate(steps):
                step(inputs[column], target, number > 0)

    @cached_property
    def _plan(self):
        """For each component of the result, the passes that add up to it, each with the component that it reads."""
        plans: list[list] = [[] for _ in self.out_parts]
        for (r, c), terms in self.blocks.items():
            shape = self.in_parts[c]
            three = [t for t in terms if len(t.axes) <= 1 and all(t.factors[a].tridiagonal for a in t.axes)]
            if len(three) > 1 and shape == self.out_parts[r] and not plans[r]:
                plans[r].append((c, _fused_pass(three, shape)))
                terms = [t for t in terms if t not in three]
            plans[r] += [(c, _pass(term, shape)) for term in terms]
        return plans


def _fused_pass(terms, shape):
    """Three-point terms of a block -> the function (u, out, False) that adds them up in one pass over memory."""
    shift, axes, first = sum(term.scale for term in terms if not term.axes), [None] * 3, 3 - len(shape)
    for term in terms:
        for axis in term.axes:
            axes[first + axis] = term.factors[axis].scaled(term.scale).tridiagonal
    return kernels.summed((1,) * first + shape, axes, shift)


def _pass(term, shape):
    """A term -> the function (u, out, whether it is added to): one axis after the other, the last into the result."""
    steps = []
    for axis in term.axes or (0,):
        factor = term.factors[axis] or Factor(sp.eye_array(shape[axis]))
        before, after = prod(shape[:axis]), prod(shape[axis + 1 :])
        steps.append((factor.rows, (before, factor.shape[1], after), (before, factor.shape[0], after)))
        shape = shape[:axis] + factor.shape[:1] + shape[axis + 1 :]

    def run(u, out, accumulate):
        for rows, given, made in steps[:-1]:
            u, before = np.empty(made), u.reshape(given)
            kernels.along_axis(before, u, rows, 1.0, False)
        rows, given, made = steps[-1]
        kernels.along_axis(u.reshape(given), out.reshape(made), rows, term.scale, accumulate)

    return run


def _absolute(term):
    return Term(abs(term.scale), tuple(factor and Factor(abs(factor.matrix)) for factor in term.factors))


def _block(terms, out_part, in_part):
    matrices = [_product_matrix(term, in_part) for term in terms]
    return reduce(add, matrices) if matrices else sp.csr_array((prod(out_part), prod(in_part)))


def _product_matrix(term, in_part):
    sides = [
        sp.eye_array(n, format="csr") if factor is None else factor.matrix
        for factor, n in zip(term.factors, in_part, strict=True)
    ]
    return term.scale * reduce(partial(sp.kron, format="csr"), sides)


def _merge(terms):
    """Add up terms that differ in one axis only where that is exact: one term for each axis."""
    merged: dict = {}
    for term in terms:
        single = len(term.axes) == 1
        key = term.axes if single else tuple(factor and factor.key for factor in term.factors)
        if key not in merged:
            merged[key] = term
        elif single:
            merged[key] = _sum_on_axis(merged[key], term)
        else:
            merged[key] = Term(merged[key].scale + term.scale, term.factors)
    return tuple(term for term in merged.values() if not _is_zero(term))


def _sum_on_axis(one, other):
    (axis,) = one.axes
    total = one.factors[axis].scaled(one.scale) + other.factors[axis].scaled(other.scale)
    return Term(1.0, tuple(total if a == axis else None for a in range(len(one.factors))))


def _is_zero(term):
    return term.scale == 0 or any(factor and factor.matrix.nnz == 0 for factor in term.factors)
