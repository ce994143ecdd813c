"""Whether the derivatives of an operator are right: linearity, JVP, VJP and second order."""

from math import inf

import autograd.numpy as anp
import numpy as np

from sparsedp.check.findings import attempted
from sparsedp.check.probes import field, listable, unit
from sparsedp.derivative import pullback, pushforward, value_and_grad

__all__ = ["derivative_rows"]

LIMIT = 10.0
PLAIN = 1e-100, 1e100  # sizes whose square can be held


def derivative_rows(op, size, rng):
    """Rows: linear, JVP, VJP, second order. Differences in units of rounding times the size of the operator."""
    kinds = [np.dtype(float)] + ([np.dtype(complex)] if op.dtype.kind == "c" else [])
    rows = []
    for dtype in kinds:
        u, v = (field(rng, op.domain.shape, dtype) for _ in range(2))
        g = field(rng, op.codomain.shape, op.apply(u).dtype)
        rows += [
            attempted(f"linearity, {dtype}", LIMIT, lambda u=u, v=v: _linearity(op, size, u, v)),
            attempted(f"JVP, {dtype}", LIMIT, lambda u=u, v=v: _jvp(op, size, u, v)),
            attempted(f"VJP, {dtype}", LIMIT, lambda u=u, g=g: _vjp(op, size, u, g)),
        ]
    if PLAIN[0] < size < PLAIN[1]:
        u, v = (field(rng, op.domain.shape, float) for _ in range(2))
        rows.append(attempted("second order", LIMIT, lambda: _second_order(op, size, u, v)))
    return rows


def _linearity(op, size, u, v):
    """A (a u + b v) - a A u - b A v."""
    a, b = 0.75, -1.5  # short numbers: the combination itself rounds once
    gap = op.apply(a * u + b * v) - (a * op.apply(u) + b * op.apply(v))
    return _relative(gap, op, size * (_norm(a * u) + _norm(b * v)))


def _jvp(op, size, u, tangent):
    value, slope = pushforward(op, u, tangent)
    if not np.array_equal(value, op.apply(u)):
        return inf
    return _relative(slope - op.apply(tangent), op, size * _norm(tangent))


def _vjp(op, size, u, g):
    """The pullback against the transposed matrix, or against `.T` when no matrix can be listed."""
    value, pull = pullback(op, u)
    if not np.array_equal(value, op.apply(u)):
        return inf
    wanted = _transposed(op, g)
    gap = pull(g) - (wanted if u.dtype.kind == "c" else wanted.real)
    return _relative(gap, op, size * _norm(g))


def _second_order(op, size, u, v):
    """The Hessian of Re sum(op(u)^2) / 2 along v, reverse over reverse, against Re(A^T A v)."""
    gradient = value_and_grad(lambda x: anp.sum(anp.real(op(x) ** 2)) / 2)
    _, pull = pullback(lambda x: anp.sum(gradient(x)[1] * v), u)
    gap = pull(1.0) - _transposed(op, op.apply(v)).real
    return _relative(gap, op, size * size * _norm(v))


def _transposed(op, g):
    if listable(op.structure):
        return (op.explicit().matrix.T @ g.reshape(-1)).reshape(op.domain.shape)
    return op.T.apply(g)


def _relative(gap, op, scale):
    gap = _norm(gap)
    return 0.0 if gap == 0 else gap / (unit(op.structure, float) * scale) if scale > 0 else inf


def _norm(u):
    """Euclidean norm that neither over- nor underflows."""
    largest = float(np.max(np.abs(u), initial=0.0))
    return largest * float(np.linalg.norm(np.ravel(u / largest))) if 0 < largest < inf else largest
