"""The Jacobian of a residual whose unknowns lie on ranks: each rank assembles the rows that make its block.

Residuals made of operators on a grid meet the same few neighbours everywhere. Which, a few probes tell: products with
one entry, in the middle of each component and at its ends. From these steps every rank knows where the entries of its
rows are, and a colour for each column, without looking at the rest of the grid (see solvers/sparsity.py); a product for
each colour gives the entries. Before a derivative is taken, and where a Newton step does not do well, the matrix is
compared with a product along a random direction (solvers/jacobian.py): what it lacks is looked for again, or refused.
"""

from __future__ import annotations

from itertools import permutations
from itertools import product as combinations
from typing import Any

import numpy as np

from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix
from sparsedp.parallel.cut import Columns, OwnRows, Rows, reads
from sparsedp.parallel.fields import DistributedField
from sparsedp.parallel.partition import lengths
from sparsedp.solvers.sparsity import (
    LARGEST_STENCIL,
    ColouredPattern,
    field_indices,
    find_lattice,
    pattern_of,
    probe_positions,
    stencil_entries,
    stencil_steps,
)

__all__ = ["Stencil", "stencil_of"]

COLOURS = 8  # times the entries of the fullest row: more are no stencil's


def stencil_of(name: str, space: Any, products: Any, lacking: Any = None) -> Any:
    """Return the Stencil of a Jacobian from products with it at several points; `lacking`: a Stencil to extend.

    Raises
    ------
    TypeError
        If a number meets too many others, or far ones.
    """
    own, (ends, n, around) = _own(space), _sides(space)
    steps = {(one, one, *[0] * len(n)) for one in range(len(ends))}
    steps.update(lacking.steps if lacking else ())
    for one, act, cell in probe_positions(ends, products):
        here = np.all(own == [[one], *cell], axis=0)
        row = np.flatnonzero(act(DistributedField(here.astype(float), space)).flat)[: LARGEST_STENCIL + 1]
        found, _ = stencil_steps(one, cell, own[0, row], own[1:, row], n, around)
        steps.update(*space.backend.agreement.gathered(found))
    least, lattice = np.bincount([row for _, row, *_ in steps]).max(), None
    if least <= LARGEST_STENCIL and not (lacking and steps == lacking.steps):
        lattice = find_lattice(_differences(space, steps), least, COLOURS * least + 1)
    if lattice is None:
        raise TypeError(
            f"{name} takes, for fields on ranks, residuals in which a number meets few others, all of them near; "
            "write dp.gather(u) for what every rank solves alone"
        )
    return Stencil(space, steps, *lattice)


def _own(space):
    """Of each number of the block of this rank its component, and its index there."""
    boxes = [*map(space.backend.box, space.parts)]
    return field_indices([*map(lengths, boxes)], [[start for start, _ in box] for box in boxes])


def _sides(space):
    """Lengths of each component; of each axis the number of cells, and whether it is periodic."""
    columns = [np.reshape(line, (-1, 1)) for line in (*space.parts, space.grid.shape, space.grid.periodic)]
    return columns[:-2], *columns[-2:]


def _differences(space, steps):
    """Of the places (component, index) of two columns in one row, an axis in each row."""
    gaps = [
        (one - other, *np.subtract(back, step))
        for (one, row, *step), (other, same, *back) in permutations(steps, 2)
        if row == same
    ]
    turns = combinations(*([0, n, -n] if around else [0] for n, around in zip(space.grid.shape, space.grid.periodic)))
    shifts = np.concatenate([np.reshape(gaps, (-1, 1 + space.grid.dim)) + (0, *turn) for turn in turns]).astype(int)
    near = np.all(np.abs(shifts[:, 1:]) < np.max(space.parts, axis=0), axis=1)
    return np.unique(shifts[near & np.any(shifts, axis=1)], axis=0).T


class Stencil(ColouredPattern):
    """Where the rows of this rank have entries, and which columns one product serves: (vector . place) mod count.

    Parameters
    ----------
    space : Space
    steps : set of tuples
        (component of the column, component of the row, cells from the column to the row along each axis).
    vector : int array
    count : int
        Of colours.
    """

    def __init__(self, space: Any, steps: Any, vector: Any, count: Any) -> None:
        self.space, self.steps, self.count, self.by_rows = space, steps, count, False
        own, (ends, _, around), found = _own(space), _sides(space), []
        for row, one, there in stencil_entries(steps, own[0], own[1:], ends, around):
            column = space.offsets[one] + np.ravel_multi_index(tuple(there), space.parts[one])
            found.append((row, column, (vector[0] * one + vector[1:] @ there) % count))
        row, column, colour = map(np.concatenate, zip(*found))
        place, self.exchange = reads(column, space.backend, space.parts)
        colours = np.zeros(self.exchange.read[0], int)
        colours[place], self.seeds = colour, vector @ own % count
        self._set_pattern(pattern_of(row, place, (len(own[0]), colours.size)), colours)

    def operator(self, act: Any, name: str) -> Any:
        """Return the matrix that acts as ``act(v)``, as an Operator."""
        space, own = self.space, Matrix(self.matrix(lambda v: act(DistributedField(v, self.space)).flat))
        shape, exchange = (self.seeds.size,) * 2, self.exchange
        both = Rows(own, shape, exchange.forward), Columns(own.transpose(), shape, exchange.backward)
        return Operator(OwnRows((*both, self), (space.size,) * 2), space, space, name, "matrix-free")
