"""Random fields, and the size of an operator: what a rounding error is measured against."""

from functools import reduce
from math import sqrt

import numpy as np

from sparsedp.errors import DerivativeError
from sparsedp.structure.base import Scaled
from sparsedp.structure.explicit import Matrix
from sparsedp.structure.lazy import Chain, Sum

__all__ = ["DTYPES", "LARGEST", "field", "generator", "listable", "magnitude", "representable", "size_of", "unit"]

DTYPES = (np.float64, np.complex128, np.float32, np.complex64)
LARGEST = 2**21  # unknowns above which no matrix is built for a check
MOST_COLUMNS = 512  # columns that are found one application at a time


def generator(rng):
    """None, a seed or a Generator -> a Generator that nobody else draws from."""
    return np.random.default_rng(20240229 if rng is None else rng)


def field(rng, shape, dtype):
    """Random normal field of a dtype."""
    values = rng.standard_normal(shape)
    if np.dtype(dtype).kind == "c":
        values = values + 1j * rng.standard_normal(shape)
    return np.asarray(values, dtype)


def unit(structure, dtype):
    """Size of one rounding: eps of the dtype, or the tolerance of a structure that solves, if it is larger.

    An inverse has it in `solver.system.rtol`: its residual is accepted there, whatever the method.
    """
    members = getattr(structure, "members", None) or (getattr(structure, "inner", None),)
    inner = max((unit(member, dtype) for member in members if member is not None), default=0.0)
    system = getattr(getattr(structure, "solver", None), "system", structure)
    return max(float(np.finfo(dtype).eps), float(getattr(system, "rtol", 0.0)), inner)


def representable(size, dtype):
    """Whether products with an operator of this size fit into the dtype, sums of squares included."""
    narrow = np.finfo(dtype).eps > 1e-10
    low, high = (1e-25, 1e25) if narrow else (1e-290, 1e290)
    return size == 0 or low < size < high


def listable(structure):
    """Whether the entries can be listed at a fair price."""
    if max(structure.shape) > LARGEST:
        return False
    return structure.has_entries or max(structure.shape) <= MOST_COLUMNS


def magnitude(structure):
    """Structure -> sparse matrix of sizes: |A| entry by entry, |A| |B| for a product, |A| + |B| for a sum.

    The rounding error of an application is at most a few units times this matrix times |u|, also
    where entries of the product cancel.
    """
    if isinstance(structure, Chain):
        return reduce(lambda a, b: a @ b, map(magnitude, structure.members))
    if isinstance(structure, Sum):
        return reduce(lambda a, b: a + b, map(magnitude, structure.members))
    if isinstance(structure, Scaled):
        return magnitude(structure.inner) * abs(structure.factor)
    return abs(structure.matrix if isinstance(structure, Matrix) else structure.explicit())


def size_of(op, rng):
    """Operator -> sqrt(|A|_1 |A|_inf): from the entries, or a lower bound from products.

    A bound from below makes the tests stricter, never laxer.
    """
    if op.structure.has_entries and listable(op.structure):
        entries = magnitude(op.structure)
        one, infinite = (np.max(entries.sum(axis=axis), initial=0.0) for axis in (0, 1))
        return sqrt(one) * sqrt(infinite)
    return _size_from_products(op, rng)


def _size_from_products(op, rng):
    """Hager's climb to the largest column and row; only products of A itself count.

    Source: W. W. Hager, SIAM J. Sci. Stat. Comput. 5, 1984. A wrong transpose leads to worse points,
    but the ratios |A x| / |x| stay true lower bounds.
    """
    one = infinite = two = 0.0
    if 0 in op.shape:
        return 0.0
    for x in (np.ones(op.shape[1]), np.sign(rng.standard_normal(op.shape[1])), rng.standard_normal(op.shape[1])):
        for _ in range(3):
            y = np.abs(product := op.apply(x.reshape(op.domain.shape)).reshape(-1))
            one = max(one, float(y.sum() / np.abs(x).sum()))
            infinite = max(infinite, float(y.max() / np.abs(x).max()))
            two = max(two, float(np.linalg.norm(y) / np.linalg.norm(x)))
            x = _climb(op, np.sign(product.real), column=True)
            row = _climb(op, np.eye(1, y.size, int(y.argmax()))[0], column=False)
            y = np.abs(op.apply(row.reshape(op.domain.shape)).reshape(-1))
            infinite = max(infinite, float(y.max() / np.abs(row).max()))
    return max(sqrt(one) * sqrt(infinite), two)


def _climb(op, y, column):
    """The unit vector of the column that A^T y points to, or the signs of A^T y."""
    try:
        z = op.T.apply(y.reshape(op.codomain.shape)).reshape(-1).real
    except DerivativeError:
        z = np.ones(op.shape[1])
    if column:
        return np.eye(1, z.size, int(np.argmax(np.abs(z))))[0]
    return np.where(z < 0, -1.0, 1.0)
