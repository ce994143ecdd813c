"""What an operator is: its cost in each form, its signs and spectrum, what it is adjoint to, which derivative it is.

Facts for the summary of an operator, not verdicts.
"""

from functools import partial
from itertools import product
from timeit import repeat
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import ArpackError, eigs, eigsh
from scipy.special import factorial

from sparsedp.check.nodes import bytes_of
from sparsedp.errors import DerivativeError
from sparsedp.grid import node_axes
from sparsedp.operators.boundary import interior
from sparsedp.operators.difference import divergence, gradient
from sparsedp.space import fits
from sparsedp.structure.base import Structure
from sparsedp.tree import norm

__all__ = ["facts_of"]

DENSE_UP_TO = 256  # rows up to which all eigenvalues are found
LARGEST_SPECTRUM = 100_000  # rows above which no eigenvalue is sought
ZERO = 1e-10  # of the largest: a smaller eigenvalue, row sum or entry is 0
OUTER = 1e-4  # the same where only the ends of the spectrum are found
SYMMETRIC = 1e-13
REPEATS = 5  # of a measurement of time
OPENED = Structure, sp.sparray  # types whose attributes an operator stores
HOLDS = 1e-12  # gap of a rule of integration by parts, of the sizes of both sides
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
    facts: dict[str, Any] = {"seconds": _seconds(op.tangent, listed), "integration by parts": _by_parts(op.tangent)}
    if not hasattr(op, "solver"):  # factors and hierarchies of a solver are not the operator's
        facts["bytes"] = bytes_of(op._acting, OPENED)
    square = fits(op.domain, op.codomain)
    facts |= _signs(op.matrix, square) if listed else {}
    try:
        facts |= _stencil(op.tangent)
    except _UnknownError as reason:
        facts["order"] = f"not known: {reason}"
    spectrum = right and square and op.dtype.kind != "c"
    if spectrum and 0 < op.shape[0] <= (LARGEST_SPECTRUM if listed else DENSE_UP_TO):
        facts |= _spectrum(op.tangent, facts.get("symmetric", False))
    return facts


def _seconds(op, listed):
    """Seconds of one application in each form that exists: dict, the least of several."""
    u, seconds = np.ones(op.domain.shape), {}
    for one in (op.explicit(), op.matrix_free()) if listed else (op,):
        again = partial(one.apply, u, one.apply(u))  # the first application may compile
        seconds[one.form] = min(repeat(again, number=1, repeat=REPEATS))
    return seconds


# ------------------------------------------------------------ entries and eigenvalues


def _signs(A, square):
    """Row sums, symmetry and M-matrix, from the entries."""
    sums, largest = A.sum(axis=1), ZERO * np.max(abs(A).sum(axis=1), initial=0.0)
    still = np.all(np.abs(sums) <= largest)
    facts: dict[str, Any] = {"row sums": "0" if still else f"{sums.real.min():.3g} to {sums.real.max():.3g}"}
    if square:
        facts["symmetric"] = not A.nnz or bool(abs(A - A.T).max() <= SYMMETRIC * abs(A).max())
        facts["M-matrix"] = _m_matrix(A, sums, largest) if A.dtype.kind != "c" else "no: complex"
    return facts


def _m_matrix(A, sums, rounding):
    """Off-diagonal entries of one sign, diagonal of the other and weakly dominant: then A, or -A, has A^-1 >= 0."""
    diagonal = A.diagonal()
    sign = 1.0 if np.sum(diagonal) >= 0 else -1.0
    wrong = np.count_nonzero((sign * (A - sp.diags_array(diagonal))).data > rounding)
    if wrong:
        return f"no: {wrong} entries beside the diagonal have its sign"
    if np.any(sign * sums < -rounding) or np.any(sign * diagonal < 0):
        return "no: the diagonal is not dominant"
    return "yes" if sign > 0 else "yes, of -A"


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


# ------------------------------------------------------------ integration by parts


def _by_parts(op):
    """Operator -> what it is adjoint to in the volumes of its grid, in words.

    With V and W the volumes of cells and faces and I the inner faces: a gradient has <W I G u, v> = -<V u, D I v>
    with the divergence of its grid, a divergence the same with the gradient; an operator of one space may be
    self-adjoint, <V A u, v> = <V u, A v>. Tried on random fields.
    """
    one, other, rng = op.domain, op.codomain, np.random.default_rng(1)
    if one.grid is None or one.grid != other.grid or op.dtype.kind == "c":
        return "not known: it is between no two real fields of one grid"
    partners = {("cells", "faces"): divergence, ("faces", "cells"): gradient}
    partner, rule = partners.get((one.kind, other.kind)), "self-adjoint in the volumes of its grid"
    if partner:
        rule = f"with the {partner.__name__} of its grid"
    elif one != other or node_axes(one.kind, 0, one.grid.dim) is None:
        return f"not known: no rule for {one.kind} -> {other.kind}"
    u, v = (rng.standard_normal(space.shape) * _open(space) for space in (one, other))
    value = op.apply(u)
    v = v * (value != 0)
    left, back = other.volumes * value * v, partner(one.grid).apply(v) if partner else -op.apply(v)
    gap, scale = abs(left.sum() + np.sum(one.volumes * u * back)), norm(left) * np.sqrt(left.size)
    gap = gap / (scale or 1.0)
    return f"{rule}, to {gap:.0e}" if gap <= HOLDS else f"not {rule} (off by {gap:.0e})"


def _open(space):
    """1 where a value takes part: not on walls."""
    return interior(space.grid).apply(np.ones(space.shape)) if space.kind == "faces" else 1.0


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
    orders, words = zip(*(_row(op, component) for component in range(len(op.codomain.parts))))
    order = min(orders)
    return {"order": int(order) if order < np.inf else "exact on polynomials", "acts as": "; ".join(words)}


def _row(op, component):
    """(order, words) of the row in the middle of one component."""
    moments = _moments(op, *_weights(op, component))
    low, *more = sorted(moments) or [0]
    words = _terms(moments.get(low, {}), op)
    if not words:
        raise _UnknownError("its row in the middle is 0 on polynomials")
    if not more:
        return np.inf, words
    h = max(np.max(widths) for widths in op.domain.grid.widths)
    size, error = (max(map(abs, moments[degree].values())) for degree in (low, more[0]))
    if error > size * h ** (more[0] - low):
        raise _UnknownError(f"it mixes {words} with {_terms(moments[more[0]], op)}")
    return more[0] - low, words


def _weights(op, component):
    """(place, weights) of the row in the middle of one component."""
    part = op.codomain.parts[component]
    for share in INSIDE:  # a row may be closed by a solid
        place = op.codomain.offsets[component] + np.ravel_multi_index([int(share * n) for n in part], part)
        unit = (np.arange(op.codomain.size) == place).astype(float)
        try:
            weights = op.T.apply(unit.reshape(op.codomain.shape)).reshape(-1)
        except DerivativeError as error:
            raise _UnknownError("it has no transpose") from error
        used = np.count_nonzero(weights)
        if used > min(MOST, weights.size / 2):
            raise _UnknownError("a row is no stencil of neighbours")
        if used:
            return place, weights
    raise _UnknownError("its rows in the middle are 0")


def _positions(space):
    """Positions of all values and the component of each, shape (size, dim + 1)."""
    grid, lines = space.grid, []
    for component in range(len(space.parts)):
        on_nodes = node_axes(space.kind, component, grid.dim)
        at = [grid.coordinates(a, "nodes" if a in on_nodes else "cells") for a in range(grid.dim)]
        lines.append(np.stack(np.meshgrid(*at, component, indexing="ij"), axis=-1).reshape(-1, grid.dim + 1))
    return np.concatenate(lines)


def _moments(op, place, weights):
    """Degree -> {(component, powers): moment}, where it is more than rounding; powers of x first."""
    grid, used = op.domain.grid, weights != 0
    found: dict[int, dict] = {}
    at, weights = _positions(op.domain)[used], weights[used]
    away = at[:, :-1] - _positions(op.codomain)[place, :-1]
    away -= np.where(grid.periodic, grid.size * np.round(away / grid.size), 0.0)  # the short way round
    powers = [power for power in product(range(DEGREES), repeat=grid.dim) if sum(power) < DEGREES]
    for component, power in product(np.unique(at[:, -1]), powers[::-1]):
        degree, terms = sum(power), weights * np.prod(away**power / factorial(power), axis=1)
        moment = float(terms @ (at[:, -1] == component))
        reach = np.abs(weights) @ np.max(np.abs(away), axis=1) ** degree / factorial(degree)
        if abs(moment) > MOMENT * reach:
            found.setdefault(degree, {})[component, power] = moment
    return found


def _terms(moments, op):
    """The moments of one degree as a sum of derivatives, such as 2 u_xx + u_yy."""
    text = ""
    for (component, power), moment in moments.items():
        name = f"u{component + 1:.0f}" if len(op.domain.parts) > 1 else "u"
        slopes = "".join(axis * p for axis, p in zip(op.domain.grid.axes, power))
        size = "" if abs(abs(moment) - 1) < MOMENT else f"{abs(moment):.4g} "
        text += f" {'-' if moment < 0 else '+'} {size}{name}{'_' * bool(slopes)}{slopes}"
    return text.removeprefix(" + ").replace(" - ", "-", text.startswith(" - "))
