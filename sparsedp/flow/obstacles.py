"""forces: drag, lift and torque on obstacles, by the balance of momentum on the staggered grid.

On every face the momentum equation says dv/dt = nu L v - div(v v) - G p. On a face that an obstacle closes, v stays 0
although the right-hand side does not: its sum, times the volumes of the faces, is the force on the obstacle. What one
face gains its neighbour loses, so that these sums telescope: over all faces they are what passes through the sides of
the domain, to rounding. Around any other set of faces they are the force on what it holds: the momentum that comes in.
"""

import numpy as np
import scipy.sparse as sp

from sparsedp.conditions import no_slip, resolve
from sparsedp.flow.momentum import momentum_fluxes, stresses
from sparsedp.flow.setup import pressure_conditions
from sparsedp.grid import check_grid, finite_number, per_axis
from sparsedp.operator import Operator
from sparsedp.operators.boundary import check_solid, mask, region_of, solid_faces
from sparsedp.operators.difference import gradient
from sparsedp.recipe import Remade
from sparsedp.space import Space
from sparsedp.structure.base import Matrix
from sparsedp.tree import copied

__all__ = ["Forces", "forces"]


def forces(grid, solid=None, boundary=no_slip, solid_boundary=no_slip, cells=None, about=0.0):
    """Grid -> ``on(v, p, viscosity)``: force and torque on an obstacle, or on what a set of cells holds.

    Parameters
    ----------
    grid : Grid
    solid, boundary, solid_boundary
        As in `flow_step`. Walls are at rest.
    cells : slices or bool array, optional
        Whose faces count, as in `flux`. Default: those of `solid`. An obstacle among others, or a box around one that
        a friction stands for, as of `brinkman`.
    about : float or one per axis [length]
        The point that the torque is taken about.

    Returns
    -------
    Forces
        ``on(v, p, viscosity)`` with faces [velocity], cells [velocity^2] and a number [length^2 / time] -> array of
        shape (1,), (3,) or (6,): the force along x, y, z [velocity^2 length^(dim - 1)] and its torque [times length],
        of which there is one in 2-D; for a fluid of density 1. Differentiable. ``on.viscous`` (for viscosity 1) and
        ``on.pressure`` are its linear parts, Operators; ``on.total`` sums any acceleration given on faces.

    Raises
    ------
    ShapeError
        If `solid` or `cells` has another shape than the grid.
    TypeError
        If they are not boolean, or a condition is none of a flow.
    ValueError
        If neither `solid` nor `cells` is given, or `about` is not finite.

    Notes
    -----
    Exact balance: at a steady state the force equals the momentum that enters through the sides of any box around the
    obstacle. What the cells hold of fluid counts with its change of momentum.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> on = forces(Grid((3, 1), periodic=(False, True)), np.array([[False], [True], [False]]))
    >>> on(np.zeros(7), np.array([[3.0], [9.0], [1.0]]), 0.1)  # pressure 3 before it, 1 behind it
    array([ 2.,  0., -1.])
    """
    check_grid("forces", grid)
    if solid is None and cells is None:
        raise ValueError("forces needs an obstacle or a set of cells, got neither; write cells=np.s_[4:8, 2:6]")
    return Forces(*copied((grid, solid, boundary, solid_boundary, cells, about)))


class Forces(Remade):
    """What `forces` makes."""

    def __init__(self, grid, solid, boundary, solid_boundary, cells, about):
        self.made = grid, solid, boundary, solid_boundary, cells, about
        sides = resolve(grid, boundary, no_slip)
        chosen = np.logical_or(*solid_faces(grid, region_of(grid, solid if cells is None else cells)))
        point = [finite_number(x, "about") for x in per_axis(about, grid.shape, "about")]
        self.total = _total(grid, chosen, point)
        viscous = Operator(stresses(grid, sides, solid, solid_boundary), grid.faces, grid.faces, "stresses")
        wet = np.ones(grid.shape, bool) if solid is None else ~check_solid(grid, solid)
        slope = gradient(grid, pressure_conditions(grid, sides)) @ mask(grid.cells, wet)
        self.carried, self.carrier, gain = momentum_fluxes(grid, sides)
        self.viscous, self.pressure, self.gain = self.total @ viscous, -self.total @ slope, self.total @ gain

    def recipe(self):
        """The call that makes it again: see recipe.py."""
        return Forces, self.made

    def __call__(self, v, p, viscosity):
        return viscosity * self.viscous(v) + self.pressure(p) - self.gain(self.carried(v) * self.carrier(v))


def _total(grid, chosen, point):
    """Faces -> the sum of a field over the chosen ones, by volume, and of its torque about the point."""
    dim, weights = grid.dim, grid.faces.split(chosen * grid.faces.volumes)
    rows = [{c: w} for c, w in enumerate(weights)]
    for c in {1: (), 2: (2,), 3: range(3)}[dim]:  # torque along z in 2-D, along all axes in 3-D
        a, b = (c + 1) % 3, (c + 2) % 3
        forward, backward = grid.face_centres(b)[a] - point[a], grid.face_centres(a)[b] - point[b]
        rows.append({b: forward * weights[b], a: -backward * weights[a]})
    matrix = [[row.get(c, 0.0 * w).reshape(1, -1) for c, w in enumerate(weights)] for row in rows]
    return Operator(Matrix(sp.csr_array(np.block(matrix))), grid.faces, Space(len(rows)), "total")
