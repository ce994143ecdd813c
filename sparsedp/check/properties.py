"""What an operator is: its signs and its spectrum.

Facts for the summary of an operator, not verdicts.
"""

from typing import Any

import numpy as np
from scipy.sparse.linalg import ArpackError, eigs, eigsh

from sparsedp.grid.space import fits

__all__ = ["facts_of"]

DENSE_UP_TO = 256  # rows up to which all eigenvalues are computed
LARGEST_SPECTRUM = 100_000  # rows above which no eigenvalue is sought
ZERO = 1e-10  # of the largest: a smaller eigenvalue or row sum is 0
OUTER = 1e-4  # the same where only the ends of the spectrum are computed
SYMMETRIC = 1e-13


@np.errstate(all="ignore")
def facts_of(op, listed, right):
    """Operator -> dict of what it is.

    Parameters
    ----------
    op : Operator
    listed : bool
        Whether its entries are listed.
    right : bool
        Whether nothing is wrong with it: else its spectrum is left out.
    """
    square = fits(op.domain, op.codomain)
    facts = _signs(op.matrix, square) if listed else {}
    spectrum = right and square and op.dtype.kind != "c"
    if spectrum and 0 < op.shape[0] <= (LARGEST_SPECTRUM if listed else DENSE_UP_TO):
        facts |= _spectrum(op.tangent, facts.get("symmetric", False))
    return facts


# ------------------------------------------------------------ entries and eigenvalues


def _signs(A, square):
    """Row sums and symmetry, from the entries."""
    sums, largest = A.sum(axis=1), np.max(abs(A).sum(axis=1), initial=0.0)
    still = np.all(np.abs(sums) <= ZERO * largest)
    facts: dict[str, Any] = {"row sums": "0" if still else f"{sums.real.min():.3g} to {sums.real.max():.3g}"}
    if square:
        facts["symmetric"] = not A.nnz or bool(abs(A - A.T).max() <= SYMMETRIC * abs(A).max())
    return facts


def _spectrum(op, symmetric):
    """Spectral radius, definiteness, null space and the largest stable step of u' = A u.

    All eigenvalues of a small operator; of a large one the ends only, by Lanczos or Arnoldi from a fixed start.
    Explicit Euler is stable when |1 + dt e| <= 1 for every eigenvalue e: dt <= -2 Re(e) / |e|^2.
    """
    whole = op.shape[0] <= DENSE_UP_TO
    if whole:
        entries = op.matrix.toarray()
        values = np.linalg.eigvalsh(entries) if symmetric else np.linalg.eigvals(entries)
    else:
        options = {"v0": np.random.default_rng(0).standard_normal(op.shape[0]), "tol": 1e-6}
        search, ends = (eigsh, {"k": 2, "which": "BE"}) if symmetric else (eigs, {"k": 1, "which": "LM"})
        try:
            values = search(op.to_scipy(), **ends, **options, return_eigenvectors=False)
        except ArpackError:
            return {}
    radius = np.max(np.abs(values))
    kept = values[np.abs(values) > (ZERO if whole else OUTER) * radius]
    facts: dict[str, Any] = {"spectral radius": float(radius)}
    if whole:
        facts["null space"] = values.size - kept.size
    if symmetric:
        kind = "semidefinite" if kept.size < values.size else "definite" if whole else "definite or semidefinite"
        side = "positive" if np.all(kept > 0) else "negative" if np.all(kept < 0) else ""
        facts["definite"] = f"{side} {kind}" if side else "indefinite"
    if whole or symmetric:
        step = float(np.min(-2 * np.minimum(kept.real, 0.0) / np.abs(kept) / np.abs(kept), initial=np.inf))
        facts["stable step"] = 0.0 if step * radius <= ZERO else step
    return facts
