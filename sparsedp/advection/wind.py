"""The velocity at the points of a field, and the places it comes from.

Interpolation to the points is the mean of the two neighbours along each axis in which they differ;
at a wall the only cell. For the x-faces that is the mean of the four y-faces around.

A point looks back along the velocity: with s = dt / spacing, from its own index i to

    euler:     i - s w(i)
    midpoint:  i - s m,    m = w at i - (s / 2) w(i), linear between points.

The pullback of the velocity m that is used gives that of w: for euler it is the same; for midpoint

    g_w = I^T g_m + slopes of I w in w,    g_dt += slopes . w / dt,

where I looks at i - (s / 2) w, and the slopes are those of `sampling.slopes`.
"""

import numpy as np

from sparsedp.advection.law import component_shapes
from sparsedp.advection.places import points_of
from sparsedp.kernels import sampling
from sparsedp.operator import Operator
from sparsedp.operators.stencils import cell_beside, pick
from sparsedp.space import Space
from sparsedp.structure.kronecker import Kronecker, Term

__all__ = ["Euler", "Midpoint", "three", "wind_of"]

NOTHING = np.empty(0)


def wind_of(setting):
    """Setting -> Operator from the velocity as it is given to (component, axis, point); None when that is the same."""
    grid, shapes = setting.grid, component_shapes(setting)
    given = grid.faces.parts if setting.velocity == "faces" else (grid.shape,) * grid.dim
    if (setting.velocity == "cells" and setting.of == "cells") or (setting.velocity == setting.of and grid.dim == 1):
        return None
    own = [None] if setting.of == "cells" else range(grid.dim)
    parts = [shape for shape in shapes for _ in range(grid.dim)]
    blocks = {
        (grid.dim * c + axis, axis): (Term(1.0, _factors(setting, component, axis)),)
        for c, component in enumerate(own)
        for axis in range(grid.dim)
    }
    structure = Kronecker(parts, given, blocks)
    rows, columns = structure.shape
    return Operator(structure, Space(columns), Space(rows), "velocity at the points")


def _factors(setting, component, axis):
    """Factors that take velocity component `axis` to the points of field component `component` (None: cells)."""
    grid, factors = setting.grid, [None] * setting.grid.dim
    if component == axis and setting.velocity == "faces":
        return tuple(factors)
    if setting.velocity == "faces":
        factors[axis] = _mean(pick, grid, axis)
    if component is not None:
        factors[component] = _mean(cell_beside, grid, component)
    return tuple(factors)


def _mean(stencil, grid, axis):
    return stencil(grid, axis, False).scaled(0.5) + stencil(grid, axis, True).scaled(0.5)


class Euler:
    """Places i - s w."""

    def __init__(self, setting):
        pass

    def used(self, number, w, scale):
        """Velocities with which component `number` looks back."""
        return w

    def pull(self, number, w, scale, g):
        """Cotangent of what `used` gave -> cotangent of w, and what the step alone adds to w . g_w / dt."""
        return g, 0.0

    def push(self, number, w, scale, dw):
        """Tangents of w -> tangents of what `used` gives, without that of the step."""
        return dw

    def faster(self, number, w, scale):
        """Change of what `used` gives when the step grows by itself, or 0."""
        return 0.0


class Midpoint:
    """Places i - s m, m being the velocity half way."""

    def __init__(self, setting):
        self.points = points_of(setting, "linear", closed=True)

    def _samples(self, number, w):
        return [sampling.extend(self.points[number], part, NOTHING) for part in w]

    def used(self, number, w, scale):
        points, half = self.points[number], _half(scale)
        return np.stack(
            [sampling.gather(points, s, three(w), half, np.empty(w.shape[1])) for s in self._samples(number, w)]
        )

    def pull(self, number, w, scale, g):
        points, half = self.points[number], _half(scale)
        direct, bent = np.zeros_like(w), np.zeros_like(w)
        for axis, samples in enumerate(self._samples(number, w)):
            sampling.fold(points, sampling.scatter(points, g[axis], three(w), half), direct[axis], NOTHING)
            sampling.slopes(points, samples, three(w), half, g[axis], three(bent))
        return direct + bent, float(np.sum(bent * w))

    def push(self, number, w, scale, dw):
        points, half = self.points[number], _half(scale)
        carried = [sampling.gather(points, s, three(w), half, np.empty(w.shape[1])) for s in self._samples(number, dw)]
        return np.stack(carried) + self._bent(number, w, scale, dw)

    def faster(self, number, w, scale):
        return self._bent(number, w, scale, w)

    def _bent(self, number, w, scale, dw):
        """Change of the velocities half way when the place half way moves by -(s / 2) dw."""
        points, half, found = self.points[number], _half(scale), np.empty_like(w)
        for axis, samples in enumerate(self._samples(number, w)):
            steep = np.zeros_like(w)
            sampling.slopes(points, samples, three(w), half, np.ones(w.shape[1]), three(steep))
            found[axis] = np.sum(steep * dw, axis=0)
        return found


def three(w):
    """One array for each of three axes; those that are not there get the first one, and nothing comes of it."""
    return (w[0],) * (3 - len(w)) + tuple(w)


def _half(scale):
    return tuple(0.5 * s for s in scale)
