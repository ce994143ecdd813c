"""Smooth exact fields for tests of accuracy: products of 1-D functions that are no eigenfunctions."""

from functools import reduce

import numpy as np

import sparsedp as dp
from sparsedp.grid.boundary_conditions import resolve


def smooth_map(n, extent=1.0):
    """Cell widths of a smooth stretching of n cells over the extent."""
    s = np.linspace(0, 1, n + 1)
    return extent * np.diff(s + 0.12 * np.sin(2 * np.pi * s) / np.pi)


def grid_of(n, dim, periodic, stretched):
    """n cells along each axis of the unit box."""
    return dp.Grid((n,) * dim, spacing=[smooth_map(n)] * dim if stretched else 1.0 / n, periodic=periodic)


class Field:
    """u(x) = product over axes of f(x_a), with f and its derivatives known."""

    def __init__(self, periodic):
        self.periodic = periodic

    def line(self, x, order):
        """The 1-D function and its first two derivatives."""
        if self.periodic:
            k = 2 * np.pi
            f = np.exp(np.sin(k * x) / 2)
            slope = f * k * np.cos(k * x) / 2
            return [f, slope, slope * k * np.cos(k * x) / 2 - f * k**2 * np.sin(k * x) / 2][order]
        t = np.tanh(3 * (x - 0.45))  # its high derivatives peak inside, so walls do not blur the slope
        return [t + 0.5 * x + 1, 3 * (1 - t**2) + 0.5, -18 * t * (1 - t**2)][order]

    def __call__(self, xs, orders=None):
        """At points, or on the full arrays of a grid: there each coordinate changes along its own axis only."""
        orders = orders or (0,) * len(xs)
        dim = len(xs)
        if all(x.ndim == dim for x in xs):
            xs = [x[tuple(slice(None if a == b else 1) for b in range(dim))] for a, x in enumerate(xs)]
        return reduce(np.multiply, [self.line(x, order) for x, order in zip(xs, orders)])

    def along(self, xs, axis, order):
        """Derivative of some order along one axis."""
        return self(xs, tuple(order if a == axis else 0 for a in range(len(xs))))

    def on_faces(self, grid, order=0):
        """Values or normal derivatives at the face centres, flat."""
        return grid.join(*(self.along(grid.face_centres(a), a, order) for a in range(grid.dim)))

    def wall_values(self, grid, boundary):
        """What dp.lift takes: a u + b du/dn at the centres of the wall faces."""
        values = []
        for axis, sides in enumerate(resolve(grid, boundary)):
            for side, condition in enumerate(sides or ()):
                wall = [np.take(x, [-side], axis) for x in grid.face_centres(axis)]
                normal = (2 * side - 1) * self.along(wall, axis, 1)
                values.append((condition.a * self(wall) + condition.b * normal).ravel())
        if values:
            return np.concatenate(values)
        return np.zeros(0)

    # ---------------------------------------------------- (input, wanted) of one operator each

    def slopes(self, grid, boundary):
        return self(grid.centres()), self.on_faces(grid, 1)

    def outflow(self, grid, boundary):
        return self.on_faces(grid), sum(self.along(grid.centres(), a, 1) for a in range(grid.dim))

    def laplacian(self, grid, boundary):
        return self(grid.centres()), sum(self.along(grid.centres(), a, 2) for a in range(grid.dim))

    def first_slope(self, grid, boundary):
        return self(grid.centres()), self.along(grid.centres(), 0, 1)

    def face_values(self, grid, boundary):
        return self(grid.centres()), self.on_faces(grid)

    def curl(self, grid, boundary):
        if grid.dim == 2:
            nodes = np.meshgrid(*(grid.coordinates(a, "nodes") for a in range(2)), indexing="ij")
            wanted = grid.join(self.along(grid.face_centres(0), 1, 1), -self.along(grid.face_centres(1), 0, 1))
            return self(nodes), wanted
        field = [2.0, -1.0, 0.5]  # a vector potential: one multiple of u for each component
        parts = []
        for a in range(3):
            lines = [grid.coordinates(b, "cells" if a == b else "nodes") for b in range(3)]
            parts.append(field[a] * self(np.meshgrid(*lines, indexing="ij")))
        wanted = []
        for a in range(3):
            b = (a + 1) % 3
            c = (a + 2) % 3
            at = grid.face_centres(a)
            wanted.append(field[c] * self.along(at, b, 1) - field[b] * self.along(at, c, 1))
        return grid.join(*parts), grid.join(*wanted)

    def at_points(self, grid, boundary):
        from catalogue import points

        return self(grid.centres()), self(list(points(grid).T))

    def coarse_values(self, grid, boundary):
        coarse = dp.restrict(grid, 2).codomain.grid
        return self(grid.centres()), self(coarse.centres())

    def fine_values(self, grid, boundary):
        coarse = dp.restrict(grid, 2).codomain.grid
        return self(coarse.centres()), self(grid.centres())
