"""What acts on a velocity besides pressure: viscosity (face_laplacian, face_lift) and convection.

Every component lives on its own faces. Along its own axis it is a field on nodes, and the wall faces
hold the wall values; along the other axes it is a field between walls half a cell away, with the
condition that what the fluid does there implies (`along` of grid/boundary_conditions.py).

The velocity of a wall therefore has two parts. Its normal component stands on the faces of the wall. Its tangential
components are the wall velocities, a flat array on ``face_lift(grid, boundary).domain``: those of walls that move along
themselves, and those of a flow that enters at an angle. Viscosity takes them by `face_lift`, convection by its argument
`walls`.
"""

from functools import cached_property
from itertools import product

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.pytree import copied
from sparsedp._utils.reconstruction import Made
from sparsedp._utils.validation import check_on
from sparsedp.autodiff.backend import gathered
from sparsedp.autodiff.tape import plain
from sparsedp.flow.projection_setup import faces_that
from sparsedp.grid.boundary_conditions import dirichlet, free_slip, inflow, no_slip, outflow, resolve
from sparsedp.grid.grid import Grid
from sparsedp.grid.space import Space
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.masks_and_lift import check_solid, solid_faces
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import (
    along,
    differences,
    kronecker_operator,
    mean_of_faces,
    means,
    slopes,
    wall_slopes,
    with_ends,
)  # fmt: skip
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker
from sparsedp.operators.structure.lazy import Mask, compose, total

__all__ = [
    "MomentumFluxes",
    "check_walls",
    "convection",
    "face_laplacian",
    "face_lift",
    "free_faces",
    "stresses",
    "velocities_of",
    "wall_stresses",
    "wall_velocities",
]


def face_laplacian(grid, boundary=no_slip, solid=None, solid_boundary=no_slip):
    """Faces -> faces: the Laplacian of each component of a velocity, 0 on faces that are not free.

    Parameters
    ----------
    grid : Grid
    boundary : flow condition or dict
        What the fluid does at the walls: no_slip, free_slip, inflow, outflow, for all bounded
        sides or as {"x": (lower, upper), ...}. Moving walls enter through `face_lift`.
    solid : bool array, shape `grid.shape`, optional
        Obstacles.
    solid_boundary : no_slip or free_slip
        What the fluid does along the obstacles.

    Returns
    -------
    Operator
        in: faces [velocity]; out: faces [velocity / length^2]. Order 2 inside; values on walls and on
        faces that touch an obstacle are taken as they are.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    ValueError
        If an axis is named that is periodic or not there.
    TypeError
        If `boundary` or `solid_boundary` holds what is no flow condition.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> L = face_laplacian(Grid((2, 2)))
    >>> L(np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    array([ 0.,  0., -4., -4.,  0.,  0.,  0.,  0.,  0.,  0.,  0.,  0.])
    """
    sides = resolve(grid, boundary, no_slip)
    free = Mask(free_faces(grid, sides, solid))
    stress = stresses(grid, sides, solid, solid_boundary)
    structure = compose(free, stress) if solid is None else Matrix(free.explicit() @ stress.explicit())
    return Operator(structure, grid.faces, grid.faces, "face_laplacian")


def face_lift(grid, boundary=no_slip, solid=None):
    """Return the operator from tangential wall velocities to their part of the Laplacian, L(v) + B(values).

    Parameters
    ----------
    grid : Grid
    boundary : flow condition or dict
        The same as for `face_laplacian`. Walls that are no_slip and inflows have a velocity along them; sides of
        free_slip and outflow have none, and no entry in the domain.
    solid : bool array, shape `grid.shape`, optional
        The same as for `face_laplacian`: faces that touch an obstacle get 0.

    Returns
    -------
    Operator
        in: one flat array [velocity], wall after wall (x-lower, x-upper, y-lower, ...), for each the
        components along it; ``op.domain.join(...)`` builds it from one number or array for each.
        out: faces [velocity / length^2].

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    ValueError
        If an axis is named that is periodic or not there.
    TypeError
        If `boundary` holds what is no flow condition.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> B = face_lift(Grid((2, 2)))
    >>> B(B.domain.join(0.0, 0.0, 0.0, 1.0))  # y-upper moves along x: a lid
    array([0., 0., 0., 2., 0., 0., 0., 0., 0., 0., 0., 0.])
    """
    sides = resolve(grid, boundary, no_slip)
    structure = compose(Mask(free_faces(grid, sides, solid)), wall_stresses(grid, sides))
    return Operator(structure, wall_velocities(grid, sides), grid.faces, "face_lift")


def convection(grid, boundary=no_slip, solid=None):
    """Return ``convect(v, w, walls=None)``: the momentum that w carries, div(w v) on faces, by central differences.

    Each component of v and the velocity w that carries it are averaged to the sides of its control
    volume. The flux form conserves momentum and, where w has no divergence, energy.

        N(v, w) = C ((A v + E walls) (B w))

    Parameters
    ----------
    grid : Grid
    boundary : flow condition or dict
        As in `face_laplacian`.
    solid : bool array, shape `grid.shape`, optional

    Returns
    -------
    callable
        ``convect(v, w)`` with two face fields [velocity] -> faces [velocity^2 / length], 0 on faces that
        are not free; differentiable in all arguments, to every order. Order 2.
        ``convect(v, w, walls)``: with the tangential velocity of v at walls and inflows, one flat array on
        ``face_lift(grid, boundary).domain`` [velocity]. Without it, it is 0: flow enters at right angles.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid; on use, if a field or `walls` has another shape.
    ValueError
        If an axis is named that is periodic or not there.
    TypeError
        If `boundary` holds what is no flow condition.

    Notes
    -----
    Source: Harlow and Welch, Physics of Fluids 8 (1965).

    Examples
    --------
    >>> from sparsedp import Grid
    >>> convect = convection(Grid(4, periodic=True))
    >>> v = np.array([1.0, 2.0, 1.0, 0.0])
    >>> convect(v, v)
    array([ 2.,  0., -2.,  0.])

    A uniform flow that enters at an angle is steady:

    >>> from sparsedp import inflow, outflow
    >>> grid, sides = Grid((3, 3)), {"x": (inflow, outflow), "y": (inflow, outflow)}
    >>> convect, walls = convection(grid, sides), face_lift(grid, sides).domain
    >>> v = grid.join(1.0, 0.5)
    >>> float(np.max(np.abs(convect(v, v, walls.join(0.5, 1.0)))))  # v at x-lower, u at y-lower
    0.0
    """
    sides = resolve(grid, boundary, no_slip)
    fluxes = MomentumFluxes(grid, sides)
    gain = fluxes.gain
    C = Operator(compose(Mask(free_faces(grid, sides, solid)), gain.structure), gain.domain, grid.faces, "gain")

    def convect(v, w, walls=None):
        # On walls where the carrying velocity w needs a wall velocity, the faces are not free: C drops the flux.
        return C(fluxes.carried(v, walls) * fluxes.carrier(w))

    return Made(convect, convection, *copied((grid, boundary, solid)))


# ------------------------------------------------------------ the same on every face, walls and obstacles too


def stresses(grid, sides, solid, solid_boundary):
    """The Laplacian of each component: what passes through the sides of a control volume, over its size -> structure.

    With obstacles also that of the faces they close: the friction there.
    """
    if solid_boundary not in (no_slip, free_slip):
        raise TypeError(f"solid_boundary needs dp.no_slip or dp.free_slip, got {solid_boundary!r}")
    if solid is None:
        blocks = {
            (c, c): sum((along(a, grid.dim, _second(grid, c, a, sides)) for a in range(grid.dim)), ())
            for c in range(grid.dim)
        }
        return Kronecker(grid.faces.parts, grid.faces.parts, blocks)
    flags = grid.faces.split(np.logical_or(*solid_faces(grid, check_solid(grid, solid))))
    lines = [_around(grid, c, sides, flags[c], solid_boundary.along) for c in range(grid.dim)]
    return Matrix(sp.block_diag(lines, format="csr"))


class MomentumFluxes:
    """The parts of div(w v) = gain (carried(v) * carrier(w)), on all faces, as in `convection`.

    Parameters
    ----------
    grid : Grid
    sides : tuple
        The flow conditions as `resolve` returns them.

    Attributes
    ----------
    gain : Operator
        From the fluxes through the sides of control volumes to faces.
    """

    def __init__(self, grid, sides):
        self._walls = wall_velocities(grid, sides)
        carried = {}
        carrier = {}
        gain = {}
        sites = []
        # At walls: the tangential velocity is the value on the side itself.
        wall_carried = {}
        wall_carrier = {}
        numbers = {pair: number for number, pair in enumerate(product(range(grid.dim), repeat=2))}
        for (c, a), number in numbers.items():  # component c through the sides across axis a
            if a == c:
                mean = other = _to_centres(grid, c)
                back = _from_centres(grid, c)
            else:
                mean, other = (means(grid, b, _conditions(sides[b])) for b in (a, c))
                back = differences(grid, a)
            carried[number, c], carrier[number, a] = along(a, grid.dim, mean), along(c, grid.dim, other)
            gain[c, number] = along(a, grid.dim, back)
            sites.append(tuple(mean.shape[0] if b == a else n for b, n in enumerate(grid.face_shape(c))))
        for part, (a, side, c) in enumerate(_moving_sides(grid, sides)):
            at_wall = along(a, grid.dim, _at_wall(grid, a, side))
            wall_carried[numbers[c, a], part] = at_wall
            wall_carrier[numbers[a, c], part] = at_wall
        fluxes = Space(None, "fluxes", grid, sites)
        self._carried = kronecker_operator(grid.faces, fluxes, carried, "carried")
        self._carrier = kronecker_operator(grid.faces, fluxes, carrier, "carrier")
        self._at_walls = fluxes, wall_carried, wall_carrier
        self.gain = kronecker_operator(fluxes, grid.faces, gain, "gain")

    @cached_property
    def _wall_carried(self):
        fluxes, blocks, _ = self._at_walls
        return kronecker_operator(self._walls, fluxes, blocks, "carried at walls")

    @cached_property
    def _wall_carrier(self):
        fluxes, _, blocks = self._at_walls
        return kronecker_operator(self._walls, fluxes, blocks, "carrier at walls")

    def carried(self, v, walls=None):
        """Return the velocity that is carried, at the sides of the control volumes of its components."""
        if walls is None:
            return self._carried(v)
        check_walls("convection", walls, self._walls)
        return self._carried(v) + self._wall_carried(walls)

    def carrier(self, w, walls=None):
        """Return the velocity that carries, at the same sides."""
        if walls is None:
            return self._carrier(w)
        check_walls("convection", walls, self._walls)
        return self._carrier(w) + self._wall_carrier(walls)


# ------------------------------------------------------------ tangential velocities of walls


def wall_velocities(grid, sides):
    """Return the space of tangential wall velocities."""
    parts = [
        tuple(1 if b == a else n for b, n in enumerate(grid.face_shape(c))) for a, _, c in _moving_sides(grid, sides)
    ]
    return Space(None, "moving walls", grid, parts)


def check_walls(name, walls, space):
    """Refuse wall velocities, one array or a batch of them, of another shape than their space."""
    if np.shape(walls)[-1:] != space.shape:
        check_on(f"{name}, as walls,", walls, space, "; write face_lift(grid, boundary).domain.join(...)")


def velocities_of(lifted, grid, sides):
    """Return the wall velocities at inflows that `face_lift` turned into an array on faces, and 0 at other walls.

    Raises
    ------
    ValueError
        If a face at an inflow lies at another wall too: the array holds the sum of their parts.
    """
    matrix = compose(Mask(free_faces(grid, sides, None)), wall_stresses(grid, sides)).explicit().tocsr()
    walls = wall_velocities(grid, sides)
    enters = [sides[a][side] == inflow for a, side, _ in _moving_sides(grid, sides)]
    wanted = np.repeat(np.array(enters, bool), np.diff(walls.offsets))
    values = gathered(plain(lifted))
    count = np.diff(matrix.indptr)  # walls that a face touches
    entering = abs(matrix) @ wanted > 0
    if np.any(values[entering & (count > 1)]):
        raise ValueError(
            "walls of flow_step does not tell which of the walls that meet at an inflow has which velocity; write "
            "walls=lambda params: values, with values on face_lift(grid, boundary).domain"
        )
    face, wall = matrix.nonzero()
    alone = (count[face] == 1) & wanted[wall]
    weights = 1.0 / matrix.data[alone]
    back = sp.csr_array((weights, (wall[alone], face[alone])), shape=matrix.shape[::-1])
    return Operator(Matrix(back), grid.faces, walls, "wall velocities")(lifted)


def wall_stresses(grid, sides):
    """Return the structure from tangential wall velocities to their part of the Laplacian, on all faces."""
    blocks = {}
    for part, (a, side, c) in enumerate(_moving_sides(grid, sides)):
        factor = differences(grid, a) @ wall_slopes(grid, a, side, dirichlet)
        blocks[c, part] = along(a, grid.dim, factor)
    return Kronecker(grid.faces.parts, wall_velocities(grid, sides).parts, blocks)


def _moving_sides(grid, sides):
    """Return (axis, side, component) for each tangential component of each wall that has one."""
    return [
        (a, side, c)
        for a in range(grid.dim)
        for side, condition in enumerate(sides[a] or ())
        for c in range(grid.dim)
        if c != a and condition.along == dirichlet
    ]


def _at_wall(grid, axis, side):
    """Return the factor from the value at a wall to the faces across an axis."""
    nodes = grid.node_count(axis)
    wall = np.full(min(nodes, 1), side * (nodes - 1))
    return Factor.from_diagonals((nodes, 1), (wall, np.zeros_like(wall), np.ones(wall.size)))


# ------------------------------------------------------------ the factors


def _conditions(pair):
    return None if pair is None else tuple(condition.along for condition in pair)


def free_faces(grid, sides, solid):
    """Faces whose velocity is found: not on closed walls or inflows, and not at an obstacle."""
    return faces_that(grid, sides, solid, lambda condition: condition == outflow)


def _second(grid, c, a, sides):
    """Second differences of component c along axis a."""
    if a == c:
        return slopes(grid, c, sides[c] and (dirichlet, dirichlet)) @ differences(grid, c)
    return differences(grid, a) @ slopes(grid, a, _conditions(sides[a]))


def _around(grid, c, sides, closed, condition):
    """The Laplacian of component c with the faces `closed` by obstacles, as a matrix: on cells of a grid of its own."""
    spacing = [np.ones(n) if a == c else grid.widths[a] for a, n in enumerate(grid.face_shape(c))]
    lattice = Grid(grid.face_shape(c), spacing=spacing, periodic=grid.periodic)
    named = {name: _conditions(sides[a]) for a, name in enumerate(grid.axes) if sides[a] and a != c}
    beside = Mask(lattice.join(*(a != c for a in range(grid.dim))))
    slope = gradient(lattice, named, closed, condition).structure
    across = compose(divergence(lattice).structure, compose(beside, slope))
    # Along its own axis a closed face holds the value of the obstacle itself.
    blocks = {(0, 0): along(c, grid.dim, _second(grid, c, c, sides))}
    return total(across, Kronecker(lattice.cells.parts, lattice.cells.parts, blocks)).explicit()


def _to_centres(grid, c):
    """Nodes -> cells: means; on a bounded axis the wall values stand before and after them, for the half control volume
    of an open side.
    """
    inner = mean_of_faces(grid, c)
    return inner if grid.periodic[c] else with_ends(inner.matrix)


def _from_centres(grid, c):
    """Fluxes at cells (and walls) -> nodes: (F[i] - F[i - 1]) / d[i]."""
    if grid.periodic[c]:
        return slopes(grid, c, None)
    lower, upper = (wall_slopes(grid, c, side, dirichlet).matrix for side in (0, 1))
    return Factor(sp.hstack([lower, slopes(grid, c, (dirichlet, dirichlet)).matrix, upper], format="csr"))
