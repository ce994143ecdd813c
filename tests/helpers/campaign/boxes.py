"""Grids, boundary conditions, obstacles and random numbers as plain data, whose repr builds them again."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from dense import Dense

import sparsedp as dp


@dataclass(frozen=True)
class Box:
    """A grid as plain data.

    Parameters
    ----------
    shape : tuple of int
    periodic : tuple of bool
        One flag for each axis.
    stretched : tuple of bool
        Whether the widths of the cells of an axis differ.
    seed : int
        Of the widths.
    """

    shape: tuple
    periodic: tuple
    stretched: tuple
    seed: int = 0

    @property
    def dim(self):
        return len(self.shape)

    def widths(self):
        """Return one array of cell widths for each axis."""
        rng = np.random.default_rng(self.seed)
        result = []
        for cells, stretched in zip(self.shape, self.stretched):
            common = rng.uniform(0.5, 1.5)
            varied = rng.uniform(0.6, 1.4, cells)
            result.append(common * varied if stretched else np.full(cells, common))
        return result

    def grid(self):
        """Return the `Grid` of the library."""
        return grid_of_box(self)

    def field_shape(self, kind):
        """Return the shape of a field on "cells" or on "faces"."""
        grid = self.grid()
        if kind == "cells":
            return grid.cells.shape
        return grid.faces.shape


@lru_cache(maxsize=64)
def grid_of_box(box):
    spacing = []
    for widths, stretched in zip(box.widths(), box.stretched):
        spacing.append(widths if stretched else float(widths[0]))
    return dp.Grid(box.shape, spacing=spacing, periodic=box.periodic)


def condition(spec):
    """Return the condition of a name of the library, or of a pair of weights (robin)."""
    if isinstance(spec, str):
        return getattr(dp, spec)
    return dp.robin(*spec)


def boundary(box, sides):
    """Return the argument `boundary` of the library.

    Parameters
    ----------
    box : Box
    sides : tuple
        For each axis None (periodic) or a pair of conditions as data.
    """
    result = {}
    for name, pair in zip("xyz", sides):
        if pair is not None:
            result[name] = (condition(pair[0]), condition(pair[1]))
    return result


def obstacle(box, seed):
    """Return the flags of solid cells, or None without a seed. At least one cell stays open."""
    if seed is None:
        return None
    flags = np.random.default_rng(seed).random(box.shape) < 0.25
    flags.flat[0] = False
    return flags


@lru_cache(maxsize=256)
def dense(box, sides=None, solid=None):
    """Return the matrices of `dense.Dense` for a box, the conditions of its sides, and an obstacle."""
    if sides is None:
        sides = tuple(None if periodic else ("neumann", "neumann") for periodic in box.periodic)
    pairs = [pair and (condition(pair[0]), condition(pair[1])) for pair in sides]
    return Dense(box.grid(), pairs, obstacle(box, solid))


def numbers(seed, shape, dtype="float64"):
    """Return random numbers of mean 0 and size about 1."""
    rng = np.random.default_rng(seed)
    values = rng.standard_normal(shape)
    if np.dtype(dtype).kind == "c":
        values = values + 1j * rng.standard_normal(shape)
    return np.asarray(values, dtype)
