"""Sparsity patterns and column colourings of Jacobians whose unknowns are distributed fields.

If a residual is composed of operators on a grid, each unknown is coupled to a few neighbours whose relative positions
(the stencil) are the same everywhere. The stencil is found by products of the Jacobian with unit vectors, for an entry
in the middle of each component and at its ends. From the stencil each rank computes the sparsity pattern of its rows
and a colour for each column, without knowledge of the rest of the grid (see solvers/sparsity.py). One Jacobian-vector
product for each colour then gives the entries. Before a derivative is computed, and after a slow Newton step, the
matrix is compared with the Jacobian in a random direction (solvers/jacobian.py). If entries are missing, the search is
repeated, or an error is raised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations
from itertools import product as combinations
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix
from sparsedp.parallel.cut import Columns, OwnRows, Rows, reading
from sparsedp.parallel.fields import DistributedField
from sparsedp.parallel.partition import lengths, partition_of
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

__all__ = ["Stencil", "find_stencil"]

MOST_COLOURS = 8  # maximum number of colours per entry of the fullest row; stencils need fewer

Step: TypeAlias = tuple[int, ...]  # (component of the column, component of the row, cells to the row along each axis)
Product: TypeAlias = Callable[[DistributedField], Any]


def find_stencil(name: str, space: Space, products: Sequence[Product], incomplete: Stencil | None = None) -> Stencil:
    """Return the Stencil of a Jacobian, given functions that multiply it by vectors at several points.

    Parameters
    ----------
    name : str
        Name of the nonlinear solve, for error messages.
    space : Space
        Space of the unknowns.
    products : sequence of callables
        One Jacobian-vector product for each point.
    incomplete : Stencil, optional
        A Stencil whose entries are included in the result.

    Raises
    ------
    TypeError
        If an unknown is coupled to too many others, or to distant ones.
    """
    layout = partition_of(space)
    index = _own_indices(space)
    shapes = _component_columns(space)
    cell_counts = _grid_column(space.grid.shape)
    is_periodic = _grid_column(space.grid.periodic)
    to_itself = [0] * space.grid.dim
    steps: set[Step] = {(component, component, *to_itself) for component in range(len(shapes))}
    if incomplete is not None:
        steps.update(incomplete.steps)
    for component, product, cell in probe_positions(shapes, products):
        is_probed = np.all(index == [[component], *cell], axis=0)
        image = product(DistributedField(is_probed.astype(float), space))
        row = np.flatnonzero(image.flat)[: LARGEST_STENCIL + 1]
        new_steps, _ = stencil_steps(component, cell, index[0, row], index[1:, row], cell_counts, is_periodic)
        steps.update(*layout.agreement.gather(new_steps))
    fullest_row = np.bincount([row for _, row, *_ in steps]).max()
    has_new_steps = incomplete is None or steps != incomplete.steps
    lattice = None
    if fullest_row <= LARGEST_STENCIL and has_new_steps:
        lattice = find_lattice(_differences(space, steps), fullest_row, MOST_COLOURS * fullest_row + 1)
    if lattice is None:
        raise TypeError(
            f"{name} takes, for fields on ranks, residuals in which each number is coupled to a few near ones; write "
            "dp.gather(u) for unknowns that every rank solves for alone"
        )
    return Stencil(space, steps, *lattice)


def _own_indices(space):
    """Return for each number of the block of this rank its component, and its index there."""
    boxes = [space.backend.box(part) for part in space.parts]
    return field_indices([lengths(box) for box in boxes], [[start for start, _ in box] for box in boxes])


def _component_columns(space):
    """Return the lengths of the axes of each component, each as a column."""
    return [np.reshape(part, (-1, 1)) for part in space.parts]


def _grid_column(values):
    """Return one value for each axis of the grid as a column."""
    return np.reshape(values, (-1, 1))


def _differences(space, steps):
    """Return the differences of the places (component, index) of two columns in one row; an axis in each row."""
    gaps = []
    for (first, first_row, *first_step), (second, second_row, *second_step) in permutations(steps, 2):
        if first_row == second_row:
            gaps.append((first - second, *np.subtract(second_step, first_step)))
    periods = []
    for n, is_periodic in zip(space.grid.shape, space.grid.periodic, strict=True):
        if is_periodic:
            periods.append([0, n, -n])
        else:
            periods.append([0])
    gap_array = np.reshape(gaps, (-1, 1 + space.grid.dim))
    shifted = [gap_array + (0, *period) for period in combinations(*periods)]
    differences = np.concatenate(shifted).astype(int)
    is_inside = np.all(np.abs(differences[:, 1:]) < np.max(space.parts, axis=0), axis=1)
    return np.unique(differences[is_inside & np.any(differences, axis=1)], axis=0).T


class Stencil(ColouredPattern):
    """Where the rows of this rank have entries, and which columns one product serves: (vector . place) mod count.

    Parameters
    ----------
    space : Space
    steps : set of Step
    vector : int array
    count : int
        Of colours.
    """

    def __init__(self, space: Space, steps: set[Step], vector: NDArray[np.integer], count: int) -> None:
        self.space = space
        self.steps = steps
        self.count = count
        self.by_rows = False
        index = _own_indices(space)
        is_periodic = _grid_column(space.grid.periodic)
        rows = []
        columns = []
        colours = []
        entries = stencil_entries(steps, index[0], index[1:], _component_columns(space), is_periodic)
        for row, component, position in entries:
            part = space.parts[component]
            rows.append(row)
            columns.append(space.offsets[component] + np.ravel_multi_index(tuple(position), part))
            colours.append((vector[0] * component + vector[1:] @ position) % count)
        self.exchange, place = reading(np.concatenate(columns), partition_of(space), space.parts)
        colour_of_column = np.zeros(self.exchange.read.size, int)
        colour_of_column[place] = np.concatenate(colours)
        self.seeds = vector @ index % count
        shape = (index.shape[1], colour_of_column.size)
        self._set_pattern(pattern_of(np.concatenate(rows), place, shape), colour_of_column)

    def operator(self, product: Product, name: str) -> Operator:
        """Return the matrix with these products as an Operator."""

        def product_of_blocks(v):
            return product(DistributedField(v, self.space)).flat

        space = self.space
        own_rows = Matrix(self.matrix(product_of_blocks))
        shape = (self.seeds.size, self.seeds.size)
        rows = Rows(own_rows, shape, self.exchange.forward)
        columns = Columns(own_rows.transpose(), shape, self.exchange.backward)
        return Operator(OwnRows((rows, columns, self), (space.size, space.size)), space, space, name, "matrix-free")
