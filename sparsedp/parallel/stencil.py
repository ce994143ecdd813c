"""The Jacobian of a residual whose unknowns lie on ranks: each rank assembles the rows that make its block.

Residuals made of operators on a grid meet the same few neighbours everywhere. Which, a few probes tell: products with
one entry, in the middle of each component and at its ends. From these steps every rank knows where the entries of its
rows are, and a colour for each column, without looking at the rest of the grid (see solvers/sparsity.py); a product for
each colour gives the entries. Before a derivative is taken, and where a Newton step does not do well, the matrix is
compared with a product along a random direction (solvers/jacobian.py): what it lacks is looked for again, or refused.
"""

from functools import cached_property
from itertools import product as combinations
from math import prod
from typing import Any

import numpy as np
import scipy.sparse as sp

from sparsedp.operator import Operator
from sparsedp.parallel.cut import OwnRows, reads
from sparsedp.parallel.fields import DistributedField
from sparsedp.parallel.partition import lengths
from sparsedp.solvers.sparsity import WIDEST, lattice
from sparsedp.structure.base import Matrix

__all__ = ["Stencil", "stencil_of"]

COLOURS = 8  # times the entries of the fullest row: more are no stencil's


def stencil_of(name, space, products, lacking=None):
    """Products with one Jacobian at several points -> its Stencil; with all that one has in which entries are lacking.

    Raises
    ------
    TypeError
        If a number meets too many others, or far ones.
    """
    steps = {(number, number) + (0,) * space.grid.dim for number in range(len(space.parts))}
    steps.update(lacking.steps if lacking else ())
    for number, part in enumerate(space.parts):
        for act, place in combinations(products, ("first", "middle", "last")):
            if prod(part):
                at = [{"first": 0, "middle": n // 2, "last": n - 1}[place] for n in part]
                steps.update(_met(space, act, number, at))
    stencil = Stencil(space, sorted(steps))
    if lacking and stencil.steps == lacking.steps or stencil.vector is None:
        raise TypeError(
            f"{name} takes, for fields on ranks, residuals in which a number meets few others, all of them near; "
            "write dp.gather(u) for what every rank solves alone"
        )
    return stencil


def _met(space, act, number, at):
    """The steps (component of the column, of the row, cells along each axis) to all that one entry of a field meets."""
    layout, (part, index) = space.layout, _own(space)
    here = (part == number) & np.all(index == np.reshape(at, (-1, 1)), axis=0)
    rows = np.flatnonzero(act(DistributedField(here.astype(float), space)).flat)
    n, around = _lengths(space)
    steps = index[:, rows] - np.reshape(at, (-1, 1))
    steps = np.where(around, (steps + n // 2) % n - n // 2, steps)  # round a periodic axis the short way
    here = np.vstack([part[rows], steps]).T[: WIDEST + 1]
    return [(number, *step) for step in np.concatenate(layout.agreement.gathered(here)).tolist()]


def _lengths(space):
    """Of each axis the number of cells, and whether it is periodic."""
    return (np.reshape(line, (-1, 1)) for line in (space.grid.shape, space.grid.periodic))


def _own(space):
    """Of each number of the block of this rank: its component, and its index there."""
    index = []
    for box in map(space.layout.box, space.parts):
        here = np.indices(lengths(box)).reshape(len(box), -1)
        index.append(here + np.reshape([start for start, _ in box], (-1, 1)))
    return np.repeat(np.arange(len(index)), [here.shape[1] for here in index]), np.hstack(index)


class Stencil:
    """Where the rows of this rank have entries, and which columns one product serves.

    Parameters
    ----------
    space : Space
    steps : sorted list of tuples
        (component of the column, component of the row, cells from the column to the row along each axis).

    Attributes
    ----------
    count : int
        Of colours: products that one matrix takes.
    """

    def __init__(self, space, steps):
        self.space, self.steps = space, steps
        differences, least = self._differences(), np.bincount([row for _, row, *_ in steps]).max()
        apart = np.any(differences, axis=1)
        apart[-1] = True
        found = lattice(differences[apart], least, COLOURS * least + 1) if least <= WIDEST else None
        self.vector: Any = None
        self.count = 0
        if found:
            self.vector, self.count = np.zeros(apart.size, int), found[1]
            self.vector[apart] = found[0]

    def _differences(self):
        """Of the places (component, index) of two columns in one row."""
        grid, steps = self.space.grid, np.array(self.steps).reshape(len(self.steps), -1)
        one, other = (index.reshape(-1) for index in np.indices((len(steps),) * 2))
        one, other = (index[steps[one, 1] == steps[other, 1]] for index in (one, other))
        gaps = np.hstack([steps[one, :1] - steps[other, :1], steps[other, 2:] - steps[one, 2:]])
        turns = combinations(*([0, n, -n] if around else [0] for n, around in zip(grid.shape, grid.periodic)))
        gaps = np.unique(np.concatenate([gaps + (0, *turn) for turn in turns]), axis=0)
        reach = np.max(self.space.parts, axis=0)
        return gaps[np.any(gaps, axis=1) & np.all(np.abs(gaps[:, 1:]) < reach, axis=1)].T

    @cached_property
    def _places(self):
        """Of each entry in the rows of this rank: row, number of the column in the whole field, and its colour."""
        space, (part, index), found = self.space, _own(self.space), []
        n, around = _lengths(space)
        for one, other, *step in self.steps:
            row = np.flatnonzero(part == other)
            column = index[:, row] - np.reshape(step, (-1, 1))
            column = np.where(around, column % n, column)
            inside = np.all((column >= 0) & (column < np.reshape(space.parts[one], (-1, 1))), axis=0)
            row, column = row[inside], column[:, inside]
            number = space.offsets[one] + np.ravel_multi_index(tuple(column), space.parts[one])
            found.append((row, number, self._colour(one, column)))
        return [np.concatenate(line) for line in zip(*found)]

    def _colour(self, part, index):
        return (self.vector[0] * part + self.vector[1:] @ index) % self.count

    @cached_property
    def _pattern(self):
        """The order of these entries in a csr_array, its ends of rows and columns, and the Exchange of what is read."""
        row, column, _ = self._places
        matrix = sp.csr_array((np.arange(row.size), (row, column)), shape=(len(_own(self.space)[0]), self.space.size))
        matrix.sort_indices()
        return matrix.data, matrix.indptr, *reads(matrix.indices, self.space.layout, self.space.parts)

    def _rows(self, act):
        """The matrix that acts as ``act(v)``."""
        (row, _, colour), (order, indptr, places, exchange) = self._places, self._pattern
        mine = self._colour(*_own(self.space))
        table = [act(DistributedField((mine == number).astype(float), self.space)).flat for number in range(self.count)]
        entries = np.array(table)[colour, row][order]
        return OwnRows(
            Matrix(sp.csr_array((entries, places, indptr), shape=(mine.size, exchange.read[0]))), exchange, self
        )

    def operator(self, act, name):
        """The matrix that acts as ``act(v)``, as an Operator."""
        return Operator(self._rows(act), self.space, self.space, name, "matrix-free")
