"""The velocity at the points of a field, and the places it comes from.

Interpolation to the points is linear along each axis in which they differ; at a wall the only cell. For the
x-faces of cells of equal width that is the mean of the four y-faces around.

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
from sparsedp.advection.ruler import ruler_of
from sparsedp.conditions import neumann
from sparsedp.kernels import sampling
from sparsedp.operator import Operator
from sparsedp.operators.stencils import means, pick
from sparsedp.space import Space
from sparsedp.structure.kronecker import Kronecker, Term

__all__ = ["Euler", "Midpoint", "wind_of"]

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
        factors[axis] = pick(grid, axis, False).scaled(0.5) + pick(grid, axis, True).scaled(0.5)
    if component is not None:
        factors[component] = means(grid, component, None if grid.periodic[component] else (neumann, neumann))
    return tuple(factors)


class Euler:
    """Places i - s w."""

    def __init__(self, setting):
        pass

    def used(self, number, w, step):
        """Velocities with which component `number` looks back."""
        return w

    def pull(self, number, w, step, g):
        """Cotangent of what `used` gave -> cotangent of w, and what the step alone adds to w . g_w / dt."""
        return g, 0.0

    def push(self, number, w, step, dw):
        """Tangents of w -> tangents of what `used` gives, without that of the step."""
        return dw

    def faster(self, number, w, step):
        """Change of what `used` gives when the step grows by itself, or 0."""
        return 0.0


class Midpoint:
    """Places i - s m, m being the velocity half way."""

    def __init__(self, setting):
        self.points = points_of(setting, "linear", closed=True)
        self.ruler = ruler_of(setting, "linear")

    def _samples(self, number, w):
        return [sampling.extend(self.points[number], part, NOTHING) for part in w]

    def _half_way(self, number, w, step):
        return self.ruler.look(number, w, 0.5 * step)

    def _carried(self, number, w, half):
        samples, (places, scale) = self._samples(number, w), half
        return np.stack([sampling.gather(self.points[number], s, places, scale, np.empty_like(w[0])) for s in samples])

    def used(self, number, w, step):
        return self._carried(number, w, self._half_way(number, w, step))

    def pull(self, number, w, step, g):
        points, half = self.points[number], self._half_way(number, w, step)
        direct, bent = np.zeros_like(w), np.zeros_like(w)
        for axis, samples in enumerate(self._samples(number, w)):
            sampling.fold(points, sampling.scatter(points, g[axis], *half), direct[axis], NOTHING)
            bent += self.ruler.steepness(points, samples, half, g[axis])
        return direct + bent, float(np.sum(bent * w))

    def push(self, number, w, step, dw):
        half = self._half_way(number, w, step)
        return self._carried(number, dw, half) + self._bent(number, w, half, dw)

    def faster(self, number, w, step):
        return self._bent(number, w, self._half_way(number, w, step), w)

    def _bent(self, number, w, half, dw):
        """Change of the velocities half way when the place half way moves by -(s / 2) dw."""
        found = np.empty_like(w)
        for axis, samples in enumerate(self._samples(number, w)):
            steep = self.ruler.steepness(self.points[number], samples, half, np.ones(w.shape[1]))
            found[axis] = np.sum(steep * dw, axis=0)
        return found
