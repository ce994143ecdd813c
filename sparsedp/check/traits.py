"""What an operator is like: its cost in each form, its spectrum, its signs. Facts for the card, not verdicts."""

from time import perf_counter
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import ArpackError, eigs, eigsh

from sparsedp.check.probes import field, listable
from sparsedp.space import fits
from sparsedp.structure.base import Structure
from sparsedp.structure.explicit import Matrix

__all__ = ["bytes_of", "costs", "signs", "spectrum_of"]

DENSE_UP_TO = 256  # rows up to which all eigenvalues are found
LARGEST_SPECTRUM = 100_000  # rows above which no eigenvalue is sought
ZERO = 1e-10  # of the largest: a smaller eigenvalue is 0
SYMMETRIC = 1e-13
REPEATS, PATIENCE = 20, 0.02  # of a measurement [s]


def costs(op, rng):
    """Seconds of one application in each form that exists: dict, the least of several."""
    u = field(rng, op.domain.shape, float)
    forms = {op.form: op}
    if op.structure.has_entries and listable(op.structure):
        forms |= {"explicit": op.explicit(), op.matrix_free().form: op.matrix_free()}
    return {form: _seconds(one, u) for form, one in sorted(forms.items())}


def _seconds(op, u):
    out = op.apply(u)  # the first application may compile
    found: list[float] = []
    clock = perf_counter()
    while len(found) < 3 or (len(found) < REPEATS and perf_counter() - clock < PATIENCE):
        start = perf_counter()
        op.apply(u, out)
        found.append(perf_counter() - start)
    return min(found)


def bytes_of(op):
    """Bytes of the numbers that an operator stores in its own form, each array once."""
    arrays: dict[int, int] = {}
    _collect(op._matrix_structure if op.form == "explicit" else op.structure, arrays, set())
    return sum(arrays.values())


def _collect(thing, arrays, seen):
    if id(thing) in seen:
        return
    seen.add(id(thing))
    if isinstance(thing, np.ndarray):
        arrays[id(thing)] = thing.nbytes
    elif sp.issparse(thing):
        for name in ("data", "indices", "indptr", "row", "col"):
            _collect(getattr(thing, name, None), arrays, seen)
    elif isinstance(thing, (tuple, list)):
        for part in thing:
            _collect(part, arrays, seen)
    elif isinstance(thing, dict):
        for part in thing.values():
            _collect(part, arrays, seen)
    elif isinstance(thing, Structure) or hasattr(thing, "matrix"):
        _collect(dict(getattr(thing, "__dict__", {})), arrays, seen)


def signs(op):
    """Row sums, symmetry and M-matrix, from the entries: dict; empty where they are not known."""
    if not (op.structure.has_entries and listable(op.structure)):
        return {}
    A = op.structure.matrix if isinstance(op.structure, Matrix) else op.structure.explicit()
    sums, size = np.asarray(A.sum(axis=1)).reshape(-1), np.max(abs(A).sum(axis=1), initial=0.0)
    found: dict[str, Any] = {"row sums": "0" if np.all(np.abs(sums) <= ZERO * size) else _range(sums)}
    if not fits(op.domain, op.codomain):
        return found
    gap = abs(A - A.T)
    found["symmetric"] = bool(gap.nnz == 0 or gap.max() <= SYMMETRIC * abs(A).max())
    found["M-matrix"] = _m_matrix(A, sums, size) if A.dtype.kind != "c" else "no: complex"
    return found


def _range(values):
    values = values.real
    return f"{values.min():.3g} to {values.max():.3g}"


def _m_matrix(A, sums, size):
    """Off-diagonal entries of one sign, diagonal of the other and weakly dominant: then A, or -A, has A^-1 >= 0."""
    diagonal = A.diagonal()
    sign = 1.0 if np.sum(diagonal) >= 0 else -1.0
    rest = sp.csr_array(A - sp.diags_array(diagonal)) * sign
    wrong = int(np.sum(rest.data > ZERO * size))
    if wrong:
        return f"no: {wrong} entries beside the diagonal have its sign"
    if np.any(sign * sums < -ZERO * size) or np.any(sign * diagonal < 0):
        return "no: the diagonal is not dominant"
    return "yes" if sign > 0 else "yes, of -A"


def spectrum_of(op, symmetric):
    """Spectral radius, definiteness, null space and the largest stable step of u' = A u: dict.

    Parameters
    ----------
    op : Operator
        Square.
    symmetric : bool

    Notes
    -----
    Explicit Euler is stable when |1 + dt e| <= 1 for every eigenvalue e: dt <= -2 Re(e) / |e|^2.
    """
    size = op.shape[0]
    if size == 0 or size > LARGEST_SPECTRUM or not (op.structure.has_entries or size <= DENSE_UP_TO):
        return {}
    acting = op.tangent
    if size <= DENSE_UP_TO:
        entries = acting.explicit().matrix.toarray()
        values = np.linalg.eigvalsh(entries) if symmetric else np.linalg.eigvals(entries)
        return _all_known(values, symmetric)
    try:
        return _ends(acting.to_scipy(), symmetric)
    except ArpackError:
        return {}


def _all_known(values, symmetric):
    radius = float(np.max(np.abs(values), initial=0.0))
    kept = values[np.abs(values) > ZERO * radius]
    found = {"spectral radius": radius, "null space": int(values.size - kept.size)}
    if symmetric:
        found["definite"] = _definite(kept.real, values.size > kept.size)
    if kept.size == 0 or np.any(kept.real > ZERO * radius):
        return {**found, "stable step": np.inf if kept.size == 0 else 0.0}
    steps = -2 * np.minimum(kept.real, 0.0) / np.abs(kept) ** 2
    return {**found, "stable step": float(np.min(steps)) if np.min(steps) > ZERO / radius else 0.0}


def _definite(kept, singular):
    word = "semidefinite" if singular else "definite"
    return f"positive {word}" if np.all(kept > 0) else f"negative {word}" if np.all(kept < 0) else "indefinite"


def _ends(A, symmetric):
    """The outer eigenvalues only, by Lanczos or Arnoldi from a fixed start."""
    start = np.random.default_rng(0).standard_normal(A.shape[0])
    if not symmetric:
        radius = float(np.max(np.abs(eigs(A, k=1, which="LM", v0=start, tol=1e-6, return_eigenvectors=False))))
        return {"spectral radius": radius}
    low, high = np.sort(eigsh(A, k=2, which="BE", v0=start, tol=1e-6, return_eigenvectors=False))
    radius = float(max(abs(low), abs(high)))
    near = 1e-4 * radius  # the inner end of the spectrum is found to this only
    word = "negative" if high <= near else "positive" if low >= -near else "indefinite"
    words = word if word == "indefinite" else f"{word} definite or semidefinite"
    return {"spectral radius": radius, "definite": words, "stable step": 2 / radius if word == "negative" else 0.0}
