"""The velocity at the points of a field, and with which velocity a point looks back to its departure point.

Interpolation to the points is linear along each axis in which they differ; at a wall the only cell. For the
x-faces of cells of equal width that is the mean of the four y-faces around.

With s = dt / spacing the departure point of point i is, in index coordinates,

    euler:     i - s w(i)
    midpoint:  i - s m,    m = w at i - (s / 2) w(i), linear between points.

For euler the cotangent of m is that of w. For midpoint, with I the interpolation at i - (s / 2) w,

    g_w = I^T g_m + (gradient of I w in w) g_m,    g_dt += (the second term) . w / dt.
"""

import numpy as np

from sparsedp.advection.interpolant import Interpolant
from sparsedp.advection.law import component_shapes
from sparsedp.conditions import neumann
from sparsedp.operator import Operator
from sparsedp.operators.stencils import means, pick
from sparsedp.space import Space
from sparsedp.structure.kronecker import Kronecker, Term

__all__ = ["Euler", "Midpoint", "velocity_at_points"]

NONE = np.empty(0)


def velocity_at_points(setting):
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
    """Departure points i - s w."""

    def velocity(self, number, w, step):
        """Velocity w at the points of component `number` -> the one used all along the step, m."""
        return w

    def vjp(self, number, w, step, g):
        """Cotangent of m -> that of w; the part of it that comes from the departure points half way, or None."""
        return g, None

    def jvp(self, number, w, trajectory, dw, ddt):
        """Tangents of w and, relative, of the step -> that of step m, over the step."""
        return dw + ddt * w


class Midpoint:
    """Departure points i - s m, m being the velocity half way."""

    def __init__(self, setting):
        many = len(component_shapes(setting))
        self.interpolants = [Interpolant(setting, number, "linear", closed=True) for number in range(many)]

    def _half_way(self, number, w, step):
        """Interpolant, trajectory half way, samples of each component of w."""
        interpolant = self.interpolants[number]
        return interpolant, interpolant.trajectory(w, 0.5 * step), [interpolant.pad(row, NONE) for row in w]

    def velocity(self, number, w, step):
        """See Euler."""
        interpolant, half, samples = self._half_way(number, w, step)
        return np.stack([interpolant.gather(row, half, np.empty(w.shape[1])) for row in samples])

    def vjp(self, number, w, step, g):
        """See Euler."""
        (interpolant, half, samples), direct, bent = self._half_way(number, w, step), np.empty_like(w), np.zeros_like(w)
        for axis, row in enumerate(samples):
            interpolant.pad_vjp(interpolant.scatter(g[axis], half), direct[axis], NONE)
            bent += interpolant.gradient(row, half, g[axis])
        direct += bent
        return direct, bent

    def jvp(self, number, w, trajectory, dw, ddt):
        """See Euler."""
        interpolant, half, samples = self._half_way(number, w, trajectory.step)
        changes, dhalf = [interpolant.pad(row, NONE) for row in dw], dw + ddt * w
        moved = [interpolant.jvp(*pair, half, dhalf) for pair in zip(samples, changes, strict=True)]
        return np.stack(moved) + ddt * trajectory.velocity
