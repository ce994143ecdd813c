"""Facts about an operator for its summary: row sums, symmetry, spectrum and definiteness.

These are information only. They do not change the verdict of a check.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackError, eigs, eigsh

from sparsedp.grid.space import fits
from sparsedp.operators.operator import Operator

__all__ = ["facts_of"]

MOST_DENSE_ROWS = 256  # all eigenvalues are computed up to this number of rows
MOST_ROWS = 100_000  # no eigenvalue is computed for more rows
ZERO_SHARE = 1e-10  # an eigenvalue or row sum below this share of the largest counts as 0
ZERO_SHARE_OF_ENDS = 1e-4  # the same if only the extreme eigenvalues are computed
SYMMETRIC_SHARE = 1e-13


@np.errstate(all="ignore")
def facts_of(op: Operator, listed: bool, is_right: bool) -> dict[str, Any]:
    """Return facts about an operator, by name.

    Parameters
    ----------
    op : Operator
    listed : bool
        Whether the matrix of the operator may be used.
    is_right : bool
        Whether all checks of the operator passed. If not, the spectrum is omitted.
    """
    is_square = fits(op.domain, op.codomain)
    facts: dict[str, Any] = _facts_of_entries(op.matrix, is_square) if listed else {}
    if listed:
        most_rows = MOST_ROWS
    else:
        most_rows = MOST_DENSE_ROWS
    if is_right and is_square and op.dtype.kind != "c" and 0 < op.shape[0] <= most_rows:
        facts |= _facts_of_spectrum(op.tangent, facts.get("symmetric", False))
    return facts


def _facts_of_entries(A: Any, is_square: bool) -> dict[str, Any]:
    """Return the range of the row sums, and whether the matrix is symmetric."""
    sums = A.sum(axis=1)
    largest = np.max(abs(A).sum(axis=1), initial=0.0)
    facts: dict[str, Any] = {"row sums": "0"}
    if not np.all(np.abs(sums) <= ZERO_SHARE * largest):
        facts["row sums"] = f"{sums.real.min():.3g} to {sums.real.max():.3g}"
    if is_square:
        facts["symmetric"] = not A.nnz or bool(abs(A - A.T).max() <= SYMMETRIC_SHARE * abs(A).max())
    return facts


def _facts_of_spectrum(op: Operator, is_symmetric: bool) -> dict[str, Any]:
    """Return spectral radius, definiteness, null space and the largest stable step of u' = A u.

    For a small operator all eigenvalues are computed. For a large one, Lanczos or Arnoldi iteration from a fixed start
    vector gives only the extreme eigenvalues. Explicit Euler is stable if |1 + dt e| <= 1 for every eigenvalue e, that
    is, dt <= -2 Re(e) / |e|^2.
    """
    is_whole = op.shape[0] <= MOST_DENSE_ROWS
    values = _all_eigenvalues(op, is_symmetric) if is_whole else _ends_of_spectrum(op, is_symmetric)
    if values is None:
        return {}
    radius = np.max(np.abs(values))
    nonzero = values[np.abs(values) > (ZERO_SHARE if is_whole else ZERO_SHARE_OF_ENDS) * radius]
    facts: dict[str, Any] = {"spectral radius": float(radius)}
    if is_whole:
        facts["null space"] = values.size - nonzero.size
    if is_symmetric:
        facts["definite"] = _definiteness(values, nonzero, is_whole)
    if is_whole or is_symmetric:
        steps = -2 * np.minimum(nonzero.real, 0.0) / np.abs(nonzero) / np.abs(nonzero)
        step = float(np.min(steps, initial=np.inf))
        if step * radius <= ZERO_SHARE:
            facts["stable step"] = 0.0
        else:
            facts["stable step"] = step
    return facts


def _all_eigenvalues(op: Operator, is_symmetric: bool) -> NDArray[Any]:
    """Return all eigenvalues of a small operator."""
    entries = op.matrix.toarray()
    if is_symmetric:
        return np.linalg.eigvalsh(entries)
    return np.linalg.eigvals(entries)


def _ends_of_spectrum(op: Operator, is_symmetric: bool) -> NDArray[Any] | None:
    """Return the two extreme eigenvalues if A is symmetric, else that of largest modulus; None if ARPACK fails."""
    start = np.random.default_rng(0).standard_normal(op.shape[0])
    options = {"v0": start, "tol": 1e-6, "return_eigenvectors": False}
    try:
        if is_symmetric:
            return eigsh(op.to_scipy(), k=2, which="BE", **options)
        return eigs(op.to_scipy(), k=1, which="LM", **options)
    except ArpackError:
        return None


def _definiteness(values: NDArray[Any], nonzero: NDArray[Any], is_whole: bool) -> str:
    """Return a word such as "positive definite" or "indefinite" for a symmetric operator."""
    if np.all(nonzero > 0):
        sign = "positive"
    elif np.all(nonzero < 0):
        sign = "negative"
    else:
        return "indefinite"
    if nonzero.size < values.size:
        return f"{sign} semidefinite"
    if is_whole:
        return f"{sign} definite"
    return f"{sign} definite or semidefinite"
