"""forces: drag, lift and torque on obstacles, by the balance of momentum on the staggered grid.

On every face the momentum equation says dv/dt = nu L v - div(v v) - G p. On a face that an obstacle closes, v stays 0
although the right-hand side does not: its sum, times the volumes of the faces, is the force on the obstacle. What one
face gains its neighbour loses, so that these sums telescope: over all faces they are what passes through the sides of
the domain, to rounding. Around any other set of faces they are the force on what it holds: the momentum that comes in.

brinkman: a friction nu k v that makes an obstacle of any shape. Beside a wall at rest a velocity grows with the
distance s to it. With U(s) = log(1 + exp(b s)) / b, which is s in the fluid and 0 in the obstacle, and

    k = sum over axes of (U(s + d) - 2 U(s) + U(s - d)) / (h^2 U(s)),     d: how much s changes over the cell width h,

U solves nu (L U - k U) = 0 on the grid itself, wherever the wall passes between two faces and whatever its slope: what
is left is of order h^2. The second difference is log(1 + (cosh(b d) - 1) / (1 + cosh(b s))) / b; s and d are taken from
any level set, in units of its change over a cell.
"""

from functools import cached_property, reduce
from operator import add

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.calls import public
from sparsedp._utils.pytree import copied
from sparsedp._utils.reconstruction import Made, Remade
from sparsedp._utils.validation import check_finite, check_kind, check_number, field_array
from sparsedp.autodiff.tape import plain
from sparsedp.flow.momentum import (
    MomentumFluxes,
    face_laplacian,
    stresses,
    wall_stresses,
    wall_velocities,
)
from sparsedp.flow.projection_setup import pressure_conditions
from sparsedp.grid.boundary_conditions import no_slip, resolve
from sparsedp.grid.grid import check_grid, numbers_per_axis
from sparsedp.grid.space import Space
from sparsedp.operators.difference import gradient
from sparsedp.operators.masks_and_lift import check_solid, mask, region_of, solid_faces
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import along, kronecker_operator
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.factor import Factor

__all__ = ["Forces", "brinkman", "forces"]

SHARP = 8.0  # b, per cell. Drag of a cylinder of 20 cells: 0.29 % off; with 6 and 12 it is 0.43 and 0.23 %
DEEP, FAR = -24.0, 100.0  # b s beyond which k is one number: deep in the obstacle, and where it is 0 beside rounding
FLAT = 1e-10  # change over a cell, of the largest level, that counts as none


def forces(grid, solid=None, boundary=no_slip, solid_boundary=no_slip, cells=None, about=0.0):
    """Return ``on(v, p, viscosity)``: force and torque on an obstacle, or on what a set of cells holds.

    Parameters
    ----------
    grid : Grid
    solid, boundary, solid_boundary
        As in `flow_step`.
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
        ``on(v, p, viscosity, walls)``: with tangential wall velocities, one flat array on
        ``face_lift(grid, boundary).domain``. They matter where the cells touch a wall that moves, or an inflow at an
        angle. Default: 0.

    Raises
    ------
    ShapeError
        If `solid` or `cells` has another shape than the grid.
    TypeError
        If they are not boolean, or a condition is none of a flow; on use, if the viscosity is no number.
    ValueError
        If neither `solid` nor `cells` is given, or `about` is not finite; on use, if the viscosity is < 0.
    NonFiniteError
        On use, if the viscosity is infinite, or the result: NaN or too large numbers around the obstacle.

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
        raise ValueError(
            "forces needs an obstacle or a set of cells, got neither; write cells=(slice(4, 8), slice(2, 6))"
        )
    return Forces(*copied((grid, solid, boundary, solid_boundary, cells, about)))


def brinkman(grid):
    """Grid -> ``friction(level)``: what stands for obstacles of any shape, of order 2, differentiable in the shape.

    In place of a mask of solid cells, the momentum equation gets the term -viscosity * friction(level) * v.

    Parameters
    ----------
    grid : Grid

    Returns
    -------
    callable
        in: level on faces, a level set: 0 on the surface, < 0 in the obstacle, best the distance [any unit];
        out: faces [1 / length^2], >= 0, 0 away from the obstacle. Differentiable, to every order.

    Raises
    ------
    ShapeError
        On use, if the level has another shape.
    TypeError
        On use, if it is no array of real numbers.
    NonFiniteError
        On use, if it is NaN or infinite.

    Notes
    -----
    The obstacle is at rest, and cells are about uniform around it. The fluid goes on inside, hardly moving, and so does
    its pressure: on the surface it is best taken from a cell or two outside. Obstacles thinner than a cell leak. With
    the fraction f of a cell around each face that is solid, 0.5 - f is a level set, a coarse one.
    The force on it is the sum of ``grid.faces.volumes * viscosity * friction(level) * v``; at a steady state also that
    of `forces` on any set of cells around it, two cells wider at least.
    Source: Angot, Bruneau and Fabrie, Numer. Math. 81 (1999); where such a wall is felt: Hester, Vasil and Burns,
    J. Comput. Phys. 430 (2021).

    Examples
    --------
    >>> from sparsedp import Grid
    >>> friction = brinkman(Grid(4))
    >>> np.round(friction(np.array([2.0, 1.0, 0.0, -1.0, -2.0])), 1)  # the wall stands on the third face
    array([0.00000e+00, 1.00000e-01, 9.50000e+00, 2.06460e+03, 1.19138e+04])
    """
    check_grid("brinkman", grid)
    face_laplacian(grid)  # refuses cells whose squares leave the range of floats
    steps = [tuple(_differences(grid, axis, back) for back in (0, 1)) for axis in range(grid.dim)]
    meshes = [np.meshgrid(*grid.control_lengths("faces", c), indexing="ij", sparse=True) for c in range(grid.dim)]
    widths = [grid.join(*(mesh[axis] for mesh in meshes)) for axis in range(grid.dim)]
    rates = [np.divide(1, h, out=np.zeros_like(h), where=h > 0) ** 2 for h in widths]  # 0: an axis without cells
    within = 2 * (np.cosh(SHARP) - 1) * reduce(add, rates)  # where the level may be flat

    def friction(level):
        values = field_array(steps[0][0], plain(level), batch=True)
        check_kind("the level of brinkman", values.dtype, "real numbers", "; write level.real")
        check_finite("brinkman", values, "takes a finite level")
        level = level / (np.max(np.abs(values), initial=0.0) or 1.0)
        changes = [(ahead(level), behind(level)) for ahead, behind in steps]
        squares = [0.5 * (one**2 + other**2) for one, other in changes]
        unit = SHARP / anp.sqrt(reduce(add, squares) + FLAT**2)
        s = anp.clip(unit * level, DEEP, FAR)
        bends = [
            anp.log1p((0.5 * (anp.cosh(unit * one) + anp.cosh(unit * other)) - 1) / (1 + anp.cosh(s))) * rate
            for (one, other), rate in zip(changes, rates, strict=True)
        ]
        return anp.where(plain(s) <= DEEP, within, reduce(add, bends) / anp.log1p(anp.exp(s)))

    return Made(friction, brinkman, grid)


def _differences(grid, axis, back):
    """Faces -> faces: to the value after it (back: from that before it) along an axis; at an end to the only one."""
    blocks = {}
    for c, part in enumerate(grid.faces.parts):
        here, n = np.arange(part[axis]), max(part[axis], 1)
        low = (here - back) % n if grid.periodic[axis] else np.clip(here - back, 0, max(n - 2, 0))
        ones = np.ones(here.size)
        factor = Factor.from_diagonals((here.size,) * 2, (here, (low + 1) % n, ones), (here, low, -ones))
        blocks[c, c] = along(axis, grid.dim, factor)
    return kronecker_operator(grid.faces, grid.faces, blocks, "brinkman")


class Forces(Remade):
    """What `forces` makes."""

    def __init__(self, grid, solid, boundary, solid_boundary, cells, about):
        self.made = Forces, (grid, solid, boundary, solid_boundary, cells, about)
        sides = resolve(grid, boundary, no_slip)
        held = check_solid(grid, solid) if cells is None else region_of(grid, cells)
        chosen = np.logical_or(*solid_faces(grid, held))
        point = numbers_per_axis(about, grid.shape, "about")
        self.total = _total(grid, chosen, point)
        viscous = Operator(stresses(grid, sides, solid, solid_boundary), grid.faces, grid.faces, "stresses")
        wet = ~check_solid(grid, solid)
        slope = gradient(grid, pressure_conditions(grid, sides)) @ mask(grid.cells, wet)
        self.fluxes, self.walls = MomentumFluxes(grid, sides), wall_velocities(grid, sides)
        self.viscous, self.pressure = self.total @ viscous, -self.total @ slope
        self.gain = self.total @ self.fluxes.gain
        self._sides = sides

    @cached_property
    def wall_friction(self):
        """Operator from tangential wall velocities to their part of the viscous force, for viscosity 1."""
        grid = self.total.domain.grid
        return self.total @ Operator(wall_stresses(grid, self._sides), self.walls, grid.faces, "wall stresses")

    @public("dp.forces(grid, solid)")
    def __call__(self, v, p, viscosity, walls=None):
        check_number("the viscosity of forces", plain(viscosity), ">= 0")  # an array would be spread over the torque
        stress = viscosity * self.viscous(v) + self.pressure(p)
        momentum = self.gain(self.fluxes.carried(v, walls) * self.fluxes.carrier(v, walls))
        total = stress - momentum
        if walls is not None:
            total = total + viscosity * self.wall_friction(walls)
        check_finite("what forces finds", plain(total))
        return total


def _total(grid, chosen, point):
    """Faces -> the sum of a field over the chosen ones, by volume, and of its torque about the point."""
    dim, weights = grid.dim, grid.faces.split(chosen * grid.faces.volumes)
    rows = [{c: w} for c, w in enumerate(weights)]
    for c in {1: (), 2: (2,), 3: range(3)}[dim]:  # torque along z in 2-D, along all axes in 3-D
        a, b = (c + 1) % 3, (c + 2) % 3
        forward, backward = grid.face_centres(b)[a] - point[a], grid.face_centres(a)[b] - point[b]
        rows.append({b: forward * weights[b], a: -backward * weights[a]})
    matrix = [grid.join(*(row.get(c, 0.0) for c in range(dim))) for row in rows]
    return Operator(Matrix(sp.csr_array(np.array(matrix))), grid.faces, Space(len(rows)), "forces")
