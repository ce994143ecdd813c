"""Layout: a grid in natural order with ghost cells around, so that every loop over it is one long row.

A neighbour of a cell lies at a distance in the flat array that is the same for all cells. So a product with a matrix,
of 5 points or of 27, in 2-D or in 3-D, is a sum of products of shifted flat arrays, whole planes at a time. Ghost
cells hold zeros, or what a periodic axis repeats there. A plane is what has the same first index: a row in 2-D.
"""

from itertools import product

import numpy as np

__all__ = ["GHOST", "Layout", "steps_around"]

GHOST = 3  # ghost planes in front and behind; along the other axes there is one ghost cell


def steps_around(dim):
    """Steps to a cell itself, in the middle of the list, and to all around it."""
    return list(product((-1, 0, 1), repeat=dim))


class Layout:
    """Where the cells of a grid are.

    Parameters
    ----------
    shape : tuple of 2 or 3
    periodic : tuple of bool
    threads : int
        Of the loops.

    Attributes
    ----------
    pitch : int64 array
        Distance of neighbours along each axis in the flat array.
    sizes : int64 array
        What the compiled loops need to know: length of a plane, and of a line in it; planes; lines of a plane, and
        where the first begins; cells of a line; which axes are periodic. In 2-D a plane is one line.
    """

    def __init__(self, shape, periodic, threads=1):
        self.shape, self.periodic, self.dim, self.threads = tuple(shape), tuple(periodic), len(shape), threads
        self.before = (GHOST,) + (1,) * (self.dim - 1)  # ghost cells of each axis
        self.padded = tuple(n + 2 * ghosts for n, ghosts in zip(self.shape, self.before))
        plane, width = int(np.prod(self.padded[1:])), self.padded[-1]
        self.pitch = np.array([plane, width, 1] if self.dim == 3 else [plane, 1])
        lines, flag, lead = (shape[1], periodic[1], width) if self.dim == 3 else (1, False, 0)
        self.sizes = np.array(
            [plane, width, shape[0], lines, lead, shape[-1], periodic[0], flag, periodic[-1]], np.int64
        )

    def zeros(self, *count, dtype=float):
        """Fields."""
        return np.zeros((*count, *self.padded), dtype)

    def cells(self, fields, step=(0, 0, 0), every=1):
        """Fields -> their values at a step from the cells of the grid, or from those with even indices. A view."""
        places = zip(self.before, step, self.shape)
        return fields[(..., *(slice(ghosts + d, ghosts + d + n, every) for ghosts, d, n in places))]

    def coarse(self):
        """The layout of the cells with even indices."""
        return Layout([(n + 1) // 2 for n in self.shape], self.periodic, self.threads)

    def wrap(self, fields):
        """Fill the ghost cells of fields along periodic axes. The fields themselves."""
        for axis, (n, ghosts, flag) in enumerate(zip(self.shape, self.before, self.periodic)):
            lines = np.moveaxis(fields, fields.ndim - self.dim + axis, 0)
            if flag:
                lines[:ghosts] = lines[ghosts + np.arange(-ghosts, 0) % n]
                lines[ghosts + n :] = lines[ghosts + np.arange(ghosts) % n]
        return fields

    def run(self, loop, *given):
        """A loop over all planes, in the precision of its second array. Fields are long rows to it."""
        loop = loop.single if given[1].dtype == np.float32 else loop
        rows = (a.reshape(*a.shape[: -self.dim], -1) if getattr(a, "ndim", 0) >= self.dim else a for a in given)
        loop.run(self.shape[0], given[0].size, self.threads, *rows)
