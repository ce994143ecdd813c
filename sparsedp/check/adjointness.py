"""Whether `.T` is the transpose: the scaled dot test."""

import numpy as np

from sparsedp.check.findings import Findings, attempted, skipped
from sparsedp.check.probes import DTYPES, field, generator, representable, size_of, unit
from sparsedp.operators.given import check_operator

__all__ = ["transpose", "transpose_rows"]

LIMIT = 10.0


def transpose(op, seeds=5, rng=None):
    """Operator -> findings of the scaled dot test, |<A u, v> - <u, A^T v>| / (eps sqrt(|A|_1 |A|_inf) |u| |v|).

    Parameters
    ----------
    op : Operator
    seeds : int
        Pairs of random fields for each dtype.
    rng : None, int or numpy Generator
        Source of the fields; default a fixed seed of its own.

    Returns
    -------
    Findings
        One row for float64, complex128, float32 and complex64, each <= 10. `.verdict`, `.ok`,
        `.worst`, `.rows`; str() is the table.

    Notes
    -----
    The products are plain, without conjugation, as `.T` is. The norms come from the entries; without
    entries they are lower bounds from products with A, which makes the test stricter. An operator
    that contains a solve is judged by the tolerance of the solve in place of eps.

    Examples
    --------
    >>> from sparsedp import Grid, from_functions, gradient
    >>> transpose(gradient(Grid((4, 3)))).verdict
    'agrees'
    >>> transpose(from_functions(np.cumsum, np.cumsum, 5, 5)).verdict
    'disagrees'
    """
    check_operator("check.transpose", op)
    rng = generator(rng)
    title = f"transpose of {op.name}, {op.domain} -> {op.codomain}"
    return Findings(title, transpose_rows(op.tangent, size_of(op.tangent, rng), seeds, rng), LIMIT)


def transpose_rows(op, size, seeds, rng):
    """One row of the dot test for each dtype; `size` is sqrt(|A|_1 |A|_inf)."""
    rows = []
    for dtype in map(np.dtype, DTYPES):
        name = f"transpose, {dtype}"
        if not representable(size, dtype):
            rows.append(skipped(name, f"entries of size {size:.1e} do not fit into {dtype}"))
            continue
        # A clean refusal of complex fields is fine where real fields work.
        optional = dtype.kind == "c" and op.dtype.kind != "c" and rows[0].ok is True
        rows.append(attempted(name, LIMIT, lambda dtype=dtype: _worst(op, size, seeds, rng, dtype), optional))
    return rows


def _worst(op, size, seeds, rng, dtype):
    pairs = [(field(rng, op.domain.shape, dtype), field(rng, op.codomain.shape, dtype)) for _ in range(max(seeds, 1))]
    return np.max([_gap(op, size, u, v, dtype) for u, v in pairs])


def _gap(op, size, u, v, dtype):
    """The defect of one pair in units of rounding. Sums in double precision: they are not what is tested."""
    there, back = _dot(op.apply(u), v), _dot(u, op.T.apply(v))
    defect = abs(there - back)
    scale = unit(op.structure, dtype) * size * np.linalg.norm(u.astype(complex)) * np.linalg.norm(v.astype(complex))
    return 0.0 if defect == 0 else defect / scale if scale > 0 else np.inf


def _dot(a, b):
    wide = complex if "c" in (a.dtype.kind, b.dtype.kind) else float
    return np.sum(a.astype(wide) * b.astype(wide))
