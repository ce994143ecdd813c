"""Whether the forms of an operator are one operator: explicit against matrix-free."""

import numpy as np

from sparsedp.check.findings import Findings, Row, attempted, skipped
from sparsedp.check.probes import DTYPES, field, generator, listable, magnitude, representable, unit
from sparsedp.structure.base import result_dtype
from sparsedp.structure.explicit import Matrix

__all__ = ["twin", "twin_rows"]

LIMIT = 10.0


def twin(op, seeds=3, rng=None):
    """Operator -> findings: its matrix against its matrix-free form, forward and transposed.

    Parameters
    ----------
    op : Operator
    seeds : int
        Random fields for each dtype.
    rng : None, int or numpy Generator
        Source of the fields; default a fixed seed of its own.

    Returns
    -------
    Findings
        The difference of the two products, entry by entry, in units of eps |A| |u| (for products of
        operators |A| |B| |u|), and the difference of the matrix of the transpose from the transposed
        matrix. Each <= 10.

    Notes
    -----
    Some operators have one form only, and the first row says so. One that was given as a matrix is
    compared with the product of that matrix by SciPy. One that was given by functions is compared
    with its columns, found one application at a time, up to 512 unknowns; above, only the functions
    are known, nothing can be compared, and the verdict is inconclusive.

    Examples
    --------
    >>> from sparsedp import Grid, divergence
    >>> twin(divergence(Grid((4, 3)))).verdict
    'agrees'
    """
    title = f"twin of {op.name}, explicit against matrix-free"
    return Findings(title, twin_rows(op.tangent, seeds, generator(rng)), LIMIT)


def twin_rows(op, seeds, rng):
    """The rows of the twin test."""
    rows = [skipped("forms", _forms(op))]
    if not listable(op.structure):
        return rows
    sizes = magnitude(op.structure)
    rows += _product_rows("forward", op, sizes, seeds, rng)
    try:
        turned = op.T
        turned.apply(np.zeros(turned.domain.shape))
    except Exception as error:  # what a foreign function raises is for its own row
        return [*rows, Row("transposed", None, LIMIT, False, f"{type(error).__name__}: {error}")]
    rows += _product_rows("transposed", turned, sizes.T.tocsr(), seeds, rng)
    rows.append(attempted("transpose, entry by entry", LIMIT, lambda: _entries_gap(op, sizes.T)))
    return rows


def _forms(op):
    if isinstance(op.structure, Matrix):
        return "one form: given as a matrix; compared with the product by SciPy"
    if op.structure.has_entries:
        return "both" if listable(op.structure) else "too large: the matrix was not built for this test"
    if listable(op.structure):
        return "one form: given by functions; compared with its columns"
    return "one form: given by functions, and too large to list its columns"


def _product_rows(name, op, sizes, seeds, rng):
    """Largest difference of the two products, entry by entry, for each dtype."""
    listed, rows, largest = op.explicit(), [], np.max(sizes.data, initial=0.0)
    for dtype in map(np.dtype, DTYPES[:3]):
        if not representable(largest, dtype):
            rows.append(skipped(f"{name}, {dtype}", f"entries of size {largest:.1e} do not fit into {dtype}"))
            continue
        fields = [field(rng, op.domain.shape, dtype) for _ in range(max(seeds, 1))]
        optional = dtype.kind == "c" and op.dtype.kind != "c" and rows[0].ok is True
        measure = lambda fields=fields: np.max([_gap(op, listed, sizes, u) for u in fields])
        rows.append(attempted(f"{name}, {dtype}", LIMIT, measure, optional))
    return rows


def _gap(op, listed, sizes, u):
    flat = u.reshape(-1).astype(np.result_type(u.dtype, float))
    explicit = listed.apply(u).reshape(-1)
    if isinstance(op.structure, Matrix):
        other = (listed.matrix @ flat).astype(explicit.dtype)
    else:
        other = op.matrix_free().apply(u).reshape(-1)
    scale = _floored(op, sizes @ np.abs(flat), sizes, np.linalg.norm(flat))
    return _largest(np.abs(other - explicit), scale * unit(op.structure, result_dtype(op.structure, u.dtype)))


def _floored(op, scale, sizes, length):
    """Functions round relative to the whole result (transforms, solves), not to each entry: |A| |u| in norms."""
    if op.structure.has_entries:
        return scale
    one, infinite = (np.max(sizes.sum(axis=axis), initial=0.0) for axis in (0, 1))
    return scale + np.sqrt(one) * np.sqrt(infinite) * length


def _largest(gaps, scale):
    """Largest ratio; a difference where there should be none counts as infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(gaps == 0, 0.0, gaps / scale)
    return np.max(ratios, initial=0.0)


def _entries_gap(op, sizes):
    """The matrix of the transpose, from its own definition, against the transposed matrix."""
    gap = abs(op.structure.transpose().explicit() - op.structure.explicit().T.tocsr()).tocoo()
    known = sizes.tocoo()
    at = dict(zip(zip(known.row, known.col, strict=True), known.data, strict=True)) if gap.nnz else {}
    scale = np.array([at.get(place, 0.0) for place in zip(gap.row, gap.col, strict=True)])
    return _largest(gap.data, _floored(op, scale, sizes, 1.0) * unit(op.structure, float))
