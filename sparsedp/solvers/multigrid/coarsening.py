"""Galerkin's coarse matrix P^T A P, and which of its cells stay free.

x.A x = sum of a (x_i - x_j)^2 over pairs of linked cells + sum of extra x_i^2. A link a between cells with weights u
and v on the coarse cells around adds -a (u_p - v_p) (u_q - v_q) to the link between the coarse cells p and q, and to
the extra of p what is left of its row, a (u_p - v_p) (sum of u - sum of v). An extra e of a cell with weights u adds
e u_p (sum of u). Sums of weights are 1 less what is missing: where nothing is, nothing is added up that cancels.
"""

from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from sparsedp.solvers.multigrid import loops
from sparsedp.solvers.multigrid.interpolation import Transfer
from sparsedp.solvers.multigrid.smoother import axis_steps, steps_around

__all__ = ["Natural", "coarsened"]

ROUNDING = 1e-10  # share of the links of a cell below which an extra is rounding


class Natural(NamedTuple):
    """A matrix in natural order: links to the cells at `steps` from each cell, extras, flags of free cells."""

    shape: tuple
    periodic: tuple
    steps: list
    links: np.ndarray
    extra: np.ndarray
    free: np.ndarray


def _corners(cell):
    """Indices of a cell, 0 being those of a coarse cell and 1 those of the next -> the coarse cells around."""
    return list(product(*(range(n // 2, (n + 1) // 2 + 1) for n in cell)))


def _tables(dim, steps):
    """What the links along `steps`, and the extras, add to the next level.

    Rows of `found`: number of the link, first and last of its terms, first and last of its pairs. A term is a
    difference of weights: number and place of both. The last term of a link is that of the sums. A pair: two
    terms, the number of the coarse link or extra, its place. Places are indices of coarse cells.
    """
    kinds, coarse = list(product((0, 1), repeat=dim)), steps_around(dim)
    numbers = {key: n for n, key in enumerate((kind, corner) for kind in kinds for corner in _corners(kind))}
    none, here = len(numbers), (0,) * dim
    found: list = []
    terms: list = []
    pairs: list = []

    def add(link, cell, other):
        around = sorted({*_corners(cell), *(_corners(other) if other else ())})
        first, start = len(terms), len(pairs)
        terms.extend((*weight(cell, corner), *weight(other, corner)) for corner in around)
        terms.append((*missing(cell), *(missing(other) if other else (0, here))))
        for (p, one), (q, two) in combinations(enumerate(around), 2) if other else ():
            pairs.append((p, q, coarse.index(tuple(b - a for a, b in zip(one, two))), one))
        pairs.extend((p, len(around), len(coarse), one) for p, one in enumerate(around))
        pairs[start:] = sorted(pairs[start:], key=lambda pair: pair[0])
        found.append((link, first, len(terms), start, len(pairs)))

    def weight(cell, corner):
        if cell is None or corner not in _corners(cell):
            return none, here
        kind, place = tuple(n % 2 for n in cell), tuple(n // 2 for n in cell)
        return numbers[kind, tuple(a - b for a, b in zip(corner, place))], place

    def missing(cell):
        return none + 1 + kinds.index(tuple(n % 2 for n in cell)), tuple(n // 2 for n in cell)

    for m, step in enumerate(steps):
        for q, kind in enumerate(kinds):
            add(m * len(kinds) + q, kind, tuple(n + d for n, d in zip(kind, step)))
    for q, kind in enumerate(kinds):
        add(len(steps) * len(kinds) + q, kind, None)
    return np.array(found), _flat(terms), _flat(pairs)


def _flat(rows):
    """Rows with tuples in them -> an array."""
    return np.array([[n for part in row for n in (part if isinstance(part, tuple) else (part,))] for row in rows])


TABLES = {
    (dim, steps is axis_steps): _tables(dim, steps(dim)) for dim in (2, 3) for steps in (axis_steps, steps_around)
}


def coarsened(level, weights):
    """Level, the weights of its cells and what they miss (see `interpolation`) -> Natural, the next level."""
    layout, shape = level.layout, level.layout.halves
    steps = steps_around(layout.dim)
    found, terms, pairs = TABLES[layout.dim, level.finest]
    dim, pitch = layout.dim, np.array(layout.pitch)
    one, other = (terms[:, at : at + dim] @ pitch for at in (1, 2 + dim))
    terms = np.stack([terms[:, 0], one, terms[:, 1 + dim], other], axis=1)
    pairs = np.column_stack([pairs[:, :3], pairs[:, 3:] @ pitch])
    out = layout.zeros(len(steps) + 1)
    links = layout.hollow(level.links)
    loops.galerkin.run(layout.halves[0], 0, 1, links, weights, out, found, terms, pairs, layout.sizes)
    layout.fold(out)
    cells = np.array([layout.cells(row, 0) for row in out])
    links, extra = cells[:-1], cells[-1]
    for axis, flag in enumerate(layout.periodic):
        if flag and shape[axis] == 1:
            _merge(links, steps, axis)
    free = _free_below(level, weights)
    _without_negative(links, extra, free, steps)
    periodic = tuple(flag and n > 1 for flag, n in zip(layout.periodic, shape))
    return Natural(shape, periodic, steps, links, extra, free)


def _merge(links, steps, axis):
    """A periodic axis of one cell: a cell is not linked to itself, and to those around it only once."""
    for step, link in zip(steps, links):
        rest = tuple(0 if other == axis else d for other, d in enumerate(step))
        if step[axis] and any(rest):
            there, back = rest in steps, tuple(-d for d in rest)
            links[steps.index(rest if there else back)] += link if there else np.roll(link, rest, range(len(rest)))
        if step[axis]:
            link[:] = 0.0


def _free_below(level, weights):
    """Which cells of the next level are part of a singular component: one where nothing is left of the diagonal.

    A coarse cell is free when all that it stands for are; with one that something holds, it may be held itself. It can
    stand for cells around it without having one of its own, as links across a corner give it weights.
    """
    layout = level.layout
    kept = layout.cells(level.free[0], 0)
    if level.finest or not level.free.any() or np.array_equal(level.free, level.root > 0.0):
        return kept.copy()
    found = layout.zeros(2, dtype=bool)
    for out, flags in zip(found, (level.free, ~level.free)):
        flags = layout.wrap(flags & (level.root > 0.0))
        for number, far, colour, _ in Transfer(layout, range(len(layout.colours))).down:
            layout.body(out)[:] |= layout.body(flags[colour], far) & (layout.body(weights[number], far) != 0.0)
    return layout.cells(found[0], 0) & ~layout.cells(found[1], 0)


def _without_negative(links, extra, free, steps):
    """No link below 0 at a free cell that loses an extra of its own.

    A fine cell beside an obstacle that cannot be interpolated along its axis has no weights, and the constant is
    then not carried exactly: Galerkin's product has an extra where the matrix has none. It is left out, so that the
    coarse matrix has the same null vector; with links >= 0 around it, it stays without negative eigenvalues.
    """
    lost = free & (np.abs(extra) > ROUNDING * np.abs(links).sum(axis=0))
    for link, step in zip(links if lost.any() else (), steps):
        beside = np.roll(lost, [-d for d in step], range(lost.ndim))
        link[(link < 0.0) & (lost | beside)] = 0.0
