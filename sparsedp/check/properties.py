"""What an operator is: its signs and spectrum, and which derivative it stands for.

Facts for the summary of an operator, not verdicts.
"""

from itertools import product
from typing import Any

import numpy as np
from scipy.sparse.linalg import ArpackError, eigs, eigsh
from scipy.special import factorial

from sparsedp.errors import DerivativeError
from sparsedp.grid import node_axes
from sparsedp.space import fits

__all__ = ["facts_of"]

DENSE_UP_TO = 256  # rows up to which all eigenvalues are found
LARGEST_SPECTRUM = 100_000  # rows above which no eigenvalue is sought
ZERO = 1e-10  # of the largest: a smaller eigenvalue or row sum is 0
OUTER = 1e-4  # the same where only the ends of the spectrum are found
SYMMETRIC = 1e-13
MOST = 400  # entries of a row that is still a stencil
INSIDE = 0.5, 0.3, 0.7  # shares of the way along an axis where a row is looked at, the first that is not 0
FEWEST = 5  # cells along an axis: fewer, and no row is inside
DEGREES = 7  # of the polynomials that a row is tried on
MOMENT = 1e-8  # of the sum of sizes: a moment below it is rounding


@np.errstate(all="ignore")
def facts_of(op, listed, right):
    """Operator -> dict of what it is.

    Parameters
    ----------
    op : Operator
    listed : bool
        Whether its entries are known.
    right : bool
        Whether nothing is wrong with it: else its spectrum is left out.
    """
    square = fits(op.domain, op.codomain)
    facts = _signs(op.matrix, square) if listed else {}
    try:
        facts |= _stencil(op.tangent)
    except _UnknownError as reason:
        facts["order"] = f"not known: {reason}"
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
        step = float(np.min(-2 * np.minimum(kept.real, 0.0) / np.abs(kept) ** 2, initial=np.inf))
        facts["stable step"] = 0.0 if step * radius <= ZERO else step
    return facts


# ------------------------------------------------------------ the derivative that a row stands for


class _UnknownError(Exception):
    """Why an operator has no order."""


def _stencil(op):
    """Operator -> dict: the derivative that a row in the middle of the grid stands for, and how exactly.

    A row with weights w at distances s is w_1 u(x + s_1) + ... = sum over a of M_a d^a u, M_a = sum w s^a / a!.
    The lowest degree with a moment is the derivative; the next one, p higher, the error: order p. On a stretched
    grid that is the order of one row; what errors of neighbouring rows take from each other is not seen.
    """
    for space in (op.domain, op.codomain):
        if space.grid is None:
            raise _UnknownError("it is no operator between fields of a grid")
        if node_axes(space.kind, 0, space.grid.dim) is None:
            raise _UnknownError(f"values on {space.kind} have no places")
        if min(space.grid.shape) < FEWEST:
            raise _UnknownError(f"it needs {FEWEST} cells along each axis")
    if op.dtype.kind == "c":
        raise _UnknownError("it is complex")
    orders, words = zip(*(_derivative(op, component) for component in range(len(op.codomain.parts))))
    order = min(orders)
    return {"order": int(order) if order < np.inf else "exact on polynomials", "acts as": "; ".join(words)}


def _derivative(op, component):
    """(order, words) of the row in the middle of one component."""
    moments = _moments(op.domain, *_row(op, component))
    low, *more = sorted(moments) or [0]
    words = _terms(moments.get(low, {}), op.domain)
    if not words:
        raise _UnknownError("its row in the middle is 0 on polynomials")
    if not more:
        return np.inf, words
    h = max(np.max(widths) for widths in op.domain.grid.widths)
    size, error = (max(map(abs, moments[degree].values())) for degree in (low, more[0]))
    if error > size * h ** (more[0] - low):
        raise _UnknownError(f"it mixes {words} with {_terms(moments[more[0]], op.domain)}")
    return more[0] - low, words


def _row(op, component):
    """Coordinates and weights of the row in the middle of one component."""
    space, lines = op.codomain, _coordinates(op.codomain, component)
    for share in INSIDE:  # a row may be closed by a solid
        index = [int(share * line.size) for line in lines]
        unit = np.zeros(space.size)
        unit[space.offsets[component] + np.ravel_multi_index(index, space.parts[component])] = 1.0
        try:
            weights = op.T.apply(unit.reshape(space.shape)).reshape(-1)
        except DerivativeError as error:
            raise _UnknownError("it has no transpose") from error
        used = np.count_nonzero(weights)
        if used > min(MOST, weights.size / 2):
            raise _UnknownError("a row is no stencil of neighbours")
        if used:
            return [line[i] for line, i in zip(lines, index)], weights
    raise _UnknownError("its rows in the middle are 0")


def _coordinates(space, component):
    """Coordinates of the values of a component, along each axis."""
    on_nodes = node_axes(space.kind, component, space.grid.dim)
    return [space.grid.coordinates(a, "nodes" if a in on_nodes else "cells") for a in range(space.grid.dim)]


def _moments(space, place, weights):
    """Degree -> {(component, powers): moment}, where it is more than rounding; powers of x first."""
    grid, found = space.grid, {}  # type: Any, dict[int, dict]
    powers = [power for power in product(range(DEGREES), repeat=grid.dim) if sum(power) < DEGREES]
    for component, part in enumerate(space.parts):
        start = space.offsets[component]
        block = weights[start : start + np.prod(part)].reshape(part)
        used = np.nonzero(block)
        away = np.stack([x[i] for x, i in zip(_coordinates(space, component), used)], axis=1) - place
        away -= np.where(grid.periodic, grid.size * np.round(away / grid.size), 0.0)  # the short way round
        for power in powers[::-1]:
            terms = block[used] * np.prod(away**power / factorial(power), axis=1)
            reach = np.max(np.abs(away), axis=1) ** sum(power) / factorial(sum(power))
            if abs(terms.sum()) > MOMENT * (np.abs(block[used]) @ reach):
                found.setdefault(sum(power), {})[component, power] = float(terms.sum())
    return found


def _terms(moments, space):
    """The moments of one degree as a sum of derivatives, such as 2 u_xx + u_yy."""
    text = ""
    for (component, power), moment in moments.items():
        name = f"u{component + 1}" if len(space.parts) > 1 else "u"
        slopes = "".join(axis * p for axis, p in zip(space.grid.axes, power))
        size = "" if abs(abs(moment) - 1) < MOMENT else f"{abs(moment):.4g} "
        text += f" {'-' if moment < 0 else '+'} {size}{name}{'_' * bool(slopes)}{slopes}"
    return text.removeprefix(" + ").replace(" - ", "-", text.startswith(" - "))
