"""What an operator is on its own grid: its rule of integration by parts, and its order of accuracy inside."""

from itertools import product
from math import factorial

import numpy as np

from sparsedp.check.probes import field
from sparsedp.errors import DerivativeError
from sparsedp.operators.boundary import interior
from sparsedp.operators.difference import divergence, gradient
from sparsedp.spacing import node_axes

__all__ = ["integration_by_parts", "order_inside"]

HOLDS = 1e-12  # of the sizes of both sides
MOST = 400  # entries of a row that is still a stencil
INSIDE = 0.5, 0.3, 0.7  # shares of the way along an axis where a row is looked at, the first that is not 0
FEWEST = 5  # cells along an axis: fewer, and no row is inside
DEGREES = 7  # of the polynomials that a row is tried on
ZERO = 1e-8  # of the sum of sizes: a moment below it is rounding


# ------------------------------------------------------------ integration by parts


def integration_by_parts(op, rng):
    """Operator -> what it is adjoint to in the volumes of its grid, in words.

    With V and W the volumes of cells and faces and I the inner faces: a gradient has <W I G u, v> = -<V u, D I v>
    with the divergence of its grid, a divergence the same with the gradient; an operator of one space may be
    self-adjoint, <V A u, v> = <V u, A v>. Tried on random fields.
    """
    one, other = op.domain, op.codomain
    if one.grid is None or one.grid != other.grid or op.dtype.kind == "c":
        return "not known: it is between no two real fields of one grid"
    kinds = one.kind, other.kind
    try:
        if one == other and node_axes(one.kind, 0, one.grid.dim) is not None:
            return _words("self-adjoint in the volumes of its grid", _self_adjoint(op, rng))
        if kinds == ("cells", "faces"):
            return _words("with the divergence of its grid", _slope(op, rng))
        if kinds == ("faces", "cells"):
            return _words("with the gradient of its grid", _slope(op.T, rng, turned=True))
    except DerivativeError:
        return "not known: it has no transpose"
    return f"not known: no rule for {kinds[0]} -> {kinds[1]}"


def _words(rule, gap):
    return f"{rule}, to {gap:.0e}" if gap <= HOLDS else f"not {rule} (off by {gap:.0e})"


def _gap(left, right, scale):
    return abs(left - right) / scale if scale > 0 else 0.0


def _self_adjoint(op, rng):
    weight, u, v = op.domain.volumes, *(field(rng, op.domain.shape, float) for _ in range(2))
    left, right = weight * op.apply(u) * v, weight * u * op.apply(v)
    return _gap(left.sum(), right.sum(), np.linalg.norm(left) * np.sqrt(left.size))


def _slope(op, rng, turned=False):
    """Gap of the rule of a gradient; of a divergence D, `turned` says that `op` is D^T."""
    grid = op.domain.grid
    u, v = field(rng, op.domain.shape, float), field(rng, op.codomain.shape, float)
    v = v * (interior(grid).apply(np.ones(op.codomain.shape)) != 0) * (op.apply(u) != 0)  # open faces only
    cells, faces = grid.cells.volumes, grid.faces.volumes
    if turned:
        left, right = op.apply(cells * u) * v, -faces * gradient(grid).apply(u) * v
    else:
        left, right = faces * op.apply(u) * v, -cells * u * divergence(grid).apply(v)
    return _gap(left.sum(), right.sum(), np.linalg.norm(left) * np.sqrt(left.size))


# ------------------------------------------------------------ order


def order_inside(op):
    """Operator -> dict: the derivative that a row in the middle of the grid stands for, and how exactly.

    A row with weights w at distances s is w_1 u(x + s_1) + ... = sum over a of M_a d^a u, M_a = sum w s^a / a!.
    The lowest degree with a moment is the derivative; the next one, p higher, the error: order p. On a stretched
    grid that is the order of one row; what errors of neighbouring rows take from each other is not seen.
    """
    reason = _no_stencil(op)
    if reason:
        return {"order": f"not known: {reason}"}
    rows = [_row(op, component) for component in range(len(op.codomain.parts))]
    if any(isinstance(row, str) for row in rows):
        return {"order": f"not known: {next(row for row in rows if isinstance(row, str))}"}
    found = {"acts as": "; ".join(row[1] for row in rows)}
    orders = [row[0] for row in rows]
    return {"order": "exact on polynomials" if min(orders) == np.inf else int(min(orders)), **found}


def _no_stencil(op):
    for space in (op.domain, op.codomain):
        if space.grid is None:
            return "it is no operator between fields of a grid"
        if node_axes(space.kind, 0, space.grid.dim) is None:
            return f"values on {space.kind} have no places"
        if min(space.grid.shape) < FEWEST:
            return f"it needs {FEWEST} cells along each axis"
    return "it is complex" if op.dtype.kind == "c" else ""


def _row(op, component):
    """(order, words) of the row in the middle of one component, or why there is none."""
    for share in INSIDE:  # a row may be closed by a solid
        try:
            place, weights = _weights(op, component, share)
        except DerivativeError:
            return "it has no transpose"
        used = np.flatnonzero(weights)
        if used.size:
            break
    else:
        return "its rows in the middle are 0"
    if used.size > MOST or used.size > weights.size / 2:
        return "a row is no stencil of neighbours"
    away = _distances(op, place, used)
    moments = _moments(weights[used], away, _components(op.domain)[used])
    degrees = sorted({sum(power) for _, power in moments})
    if not degrees:
        return "its row in the middle is 0 on polynomials"
    low, *more = degrees
    if not more:
        return np.inf, _terms(moments, low, op)
    h = np.max([np.max(widths) for widths in op.domain.grid.widths])
    largest = [max(abs(m) for (_, power), m in moments.items() if sum(power) == degree) for degree in (low, more[0])]
    if largest[1] > largest[0] * h ** (more[0] - low):
        return f"it mixes {_terms(moments, low, op)} with {_terms(moments, more[0], op)}"
    return more[0] - low, _terms(moments, low, op)


def _weights(op, component, share):
    """(place, weights) of the row at this share of the way along every axis."""
    part = op.codomain.parts[component]
    place = np.ravel_multi_index([int(share * n) for n in part], part)
    place += sum(int(np.prod(before)) for before in op.codomain.parts[:component])
    unit = np.zeros(op.codomain.size)
    unit[place] = 1.0
    return place, op.T.apply(unit.reshape(op.codomain.shape)).reshape(-1)


def _moments(weights, away, components):
    """(component, powers) -> moment, where it is more than rounding."""
    found, dim = {}, away.shape[1]
    for power in product(range(DEGREES), repeat=dim):
        if sum(power) >= DEGREES:
            continue
        terms = weights * np.prod(away ** np.array(power), axis=1) / np.prod([factorial(p) for p in power])
        reach = np.abs(weights) * np.max(np.abs(away), axis=1) ** sum(power)
        for component in np.unique(components):
            some = components == component
            if abs(np.sum(terms[some])) > ZERO * np.sum(reach) / factorial(sum(power)):
                found[int(component), power] = float(np.sum(terms[some]))
    return found


def _terms(moments, degree, op):
    """The moments of one degree as a sum of derivatives, such as 2 u_xx + u_yy."""
    axes, many = op.domain.grid.axes, len(op.domain.parts) > 1
    words = []
    for (component, power), moment in sorted(moments.items(), key=lambda pair: (pair[0][0], [-p for p in pair[0][1]])):
        if sum(power) == degree:
            name = f"u{component + 1}" if many else "u"
            slopes = "".join(axis * p for axis, p in zip(axes, power, strict=True))
            size = "" if abs(abs(moment) - 1) < ZERO else f"{abs(moment):.4g} "
            words.append(f"{'-' if moment < 0 else '+'} {size}{name}{'_' if slopes else ''}{slopes}")
    text = " ".join(words)
    return text[2:] if text.startswith("+") else "-" + text[2:]


def _distances(op, place, used):
    """Positions of the values of a row relative to its own, the short way round where the grid is periodic."""
    grid = op.domain.grid
    away = _places(op.domain)[used] - _places(op.codomain)[place]
    for axis, period in enumerate(grid.size):
        if grid.periodic[axis]:
            away[:, axis] -= period * np.round(away[:, axis] / period)
    return away


def _places(space):
    """Positions of all values, shape (size, dim)."""
    grid, lines = space.grid, []
    for component in range(len(space.parts)):
        on_nodes = node_axes(space.kind, component, grid.dim)
        at = [grid.coordinates(a, "nodes" if a in on_nodes else "cells") for a in range(grid.dim)]
        lines.append(np.stack([full.ravel() for full in np.meshgrid(*at, indexing="ij")], axis=1))
    return np.concatenate(lines)


def _components(space):
    return np.repeat(np.arange(len(space.parts)), [int(np.prod(part)) for part in space.parts])
