"""Layout: the order in which a level keeps its numbers, so that every loop over them is one long row.

Cells are coloured by the parities of their indices: 4 colours in 2-D, 8 in 3-D, number 4 p0 + 2 p1 + p2 (2-D: 2 p0 +
p1). The cells of one colour are a grid of half the size, kept plane by plane with ghost cells around each plane, and
`GHOST` planes in front and behind: zeros, or what a periodic axis repeats there. A neighbour of a cell has another
colour and lies at a distance in the flat array that is the same for all cells of the colour. So a product with a
matrix, of 5 points or of 27, in 2-D or in 3-D, is a sum of products of shifted flat arrays, whole planes at a time.

A coarse cell sits on each cell of colour 0. So the coarse grid in natural order has the layout of one colour.
"""

from itertools import product

import numpy as np

__all__ = ["GHOST", "Layout"]

GHOST = 3  # planes
LINE = 16  # numbers: planes begin with a cache line


class Layout:
    """Where the cells of a grid are.

    Parameters
    ----------
    shape : tuple of 2 or 3
        Of the grid, in natural order.
    periodic : tuple of bool

    Attributes
    ----------
    halves : tuple
        Shape of the grid of colour 0, and of the next level.
    colours : list of tuples
        Parities of the indices.
    pitch : tuple
        Distance of neighbours of the same colour, along each axis.
    size : int
        Length of the flat array of one colour.
    sizes : int64 array
        What the compiled loops need to know: length of a plane and of a row in it, rows in a plane; halves of the
        three axes; which of them are periodic. In 2-D the middle axis has one cell, and there are no ghost rows.
    """

    def __init__(self, shape, periodic):
        self.shape, self.periodic, self.dim = tuple(shape), tuple(periodic), len(shape)
        self.halves = tuple((n + 1) // 2 for n in shape)
        self.colours = list(product((0, 1), repeat=self.dim))
        flat = self.dim == 2
        row, rows = self.halves[-1] + 2, 1 if flat else self.halves[1] + 2
        plane = -(-row * rows // LINE) * LINE
        self.pitch = (plane, 1) if flat else (plane, row, 1)
        self.planes = self.halves[0] + 2 * GHOST
        self.size = self.planes * plane
        middle, flag = (1, False) if flat else (self.halves[1], periodic[1])
        self.sizes = np.array(
            [plane, row, rows, self.halves[0], middle, self.halves[-1], periodic[0], flag, periodic[-1]], np.int64
        )

    def zeros(self, *count, dtype=float):
        """Flat arrays."""
        return np.zeros((*count, self.size), dtype)

    def with_ghosts(self, row):
        """A flat array -> the grid of its colour, with ghost cells. A view."""
        plane, width, rows = self.sizes[:3]
        planes = row.reshape(self.planes, plane)[:, : rows * width]
        return planes if self.dim == 2 else planes.reshape(self.planes, rows, width)

    def cells(self, row, colour):
        """A flat array -> the cells of a colour that the grid has. A view."""
        counts = [(n + 1 - p) // 2 for n, p in zip(self.shape, self.colours[colour])]
        first = GHOST, *(1,) * (self.dim - 1)
        return self.with_ghosts(row)[tuple(slice(at, at + n) for at, n in zip(first, counts))]

    def natural(self, colour):
        """Where the cells of a colour are in an array in natural order."""
        return tuple(slice(p, None, 2) for p in self.colours[colour])

    def body(self, row, far=0):
        """A flat array without the planes in front and behind, or the same at a distance. A view."""
        plane = self.pitch[0]
        return row[..., GHOST * plane + far : (self.planes - GHOST) * plane + far]

    def split(self, array, rows, colours):
        """Array in natural order -> flat arrays, one for each of the colours."""
        for row, colour in zip(rows, colours):
            self.cells(row, colour)[...] = array[self.natural(colour)]

    def merge(self, rows, colours, array):
        """The reverse."""
        for row, colour in zip(rows, colours):
            array[self.natural(colour)] = self.cells(row, colour)

    def wrap(self, rows):
        """Fill the ghost cells of flat arrays along periodic axes. The arrays themselves."""
        for row in rows.reshape(-1, self.size) if any(self.periodic) else ():
            grid = self.with_ghosts(row)
            for axis, (n, flag) in enumerate(zip(self.halves, self.periodic)):
                lines, ghosts = np.moveaxis(grid, axis, 0), 1 if axis else GHOST
                if flag:
                    lines[:ghosts] = lines[ghosts + np.arange(-ghosts, 0) % n]
                    lines[ghosts + n :] = lines[ghosts + np.arange(ghosts) % n]
        return rows

    def hollow(self, rows):
        """Flat arrays, colour after colour, without what is in their ghost cells."""
        if not any(self.periodic):
            return rows
        out = np.zeros_like(rows)
        for number, (row, given) in enumerate(zip(out, rows)):
            self.cells(row, number % len(self.colours))[...] = self.cells(given, number % len(self.colours))
        return out

    def fold(self, rows):
        """Add what is in ghost cells to the cells at the other end of periodic axes."""
        for row in rows if any(self.periodic) else ():
            grid = self.with_ghosts(row)
            for axis, (n, flag) in enumerate(zip(self.halves, self.periodic)):
                lines, ghosts = np.moveaxis(grid, axis, 0), 1 if axis else GHOST
                if flag:
                    lines[ghosts] += lines[ghosts + n]
                    lines[ghosts + n - 1] += lines[ghosts - 1]

    def neighbour(self, colour, step):
        """Colour and distance of the cell at a step from the cells of a colour."""
        there = [p + d for p, d in zip(self.colours[colour], step)]
        distance = sum(n // 2 * pitch for n, pitch in zip(there, self.pitch))
        return self.colours.index(tuple(n % 2 for n in there)), distance
