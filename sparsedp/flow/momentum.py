"""Momentum: viscosity (face_laplacian, face_lift) and convection of a velocity on faces.

Each velocity component is defined on the faces across its own axis. Along this axis its points include the walls, so
that the faces on a wall hold the wall values themselves. Along the other axes the nearest wall is half a cell away from
the outermost points; the boundary condition there is `FlowCondition.along`.

The velocity of a wall is therefore given in two places. Its normal component is part of the face field. Its tangential
components, of moving walls and of a flow that enters at an angle, are a separate flat array on
``face_lift(grid, boundary).domain``, called the wall velocities. They enter viscosity through `face_lift`, and
convection through its argument `walls`.
"""

from __future__ import annotations

from functools import cached_property
from itertools import product
from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.base_classes import ReconstructibleFunction
from sparsedp._utils.pytree import copied
from sparsedp._utils.validation import check_on
from sparsedp.flow.projection_setup import mask_of_faces
from sparsedp.grid.boundary_conditions import (
    MixedWall,
    describe_patches,
    dirichlet,
    free_slip,
    inflow,
    mixed_wall,
    neumann,
    no_slip,
    outflow,
    points_touching,
    resolve,
    walls_of,
)
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
    mean_terms,
    on_faces,
    slope_terms,
    slopes,
    wall_slopes,
    with_ends,
)
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term
from sparsedp.operators.structure.lazy import Mask, compose, total

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from sparsedp.operators.structure.base import Structure

__all__ = [
    "MomentumFluxes",
    "WallSide",
    "at_wall",
    "check_walls",
    "conditions_along",
    "convection",
    "face_laplacian",
    "face_lift",
    "free_face_mask",
    "gradient_around",
    "inflow_points",
    "stresses",
    "wall_sides",
    "wall_stresses",
    "wall_velocities",
]


def face_laplacian(
    grid: Grid, boundary: Any = no_slip, solid: ArrayLike | None = None, solid_boundary: Any = no_slip
) -> Operator:
    """Return the Laplacian of each component of a velocity on faces, 0 on faces that are not free.

    Parameters
    ----------
    grid : Grid
    boundary : flow condition or dict
        no_slip, free_slip, inflow or outflow, for all bounded sides or as {"x": (lower, upper), ...}. Walls are at rest
        here; add the contribution of moving walls with `face_lift`. For an opening in part of a wall write a `patch`.
        The tangential velocity at the end of a patch is the one of the no_slip or inflow boundary, if there is one.
    solid : bool array, shape `grid.shape`, optional
        Obstacles.
    solid_boundary : no_slip or free_slip
        Condition for the tangential velocity at obstacles.

    Returns
    -------
    Operator
        in: faces [velocity]; out: faces [velocity / length^2]. Order 2 in the interior; the values on walls and on
        faces that touch an obstacle are boundary values.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    ValueError
        If an axis is named that is periodic or does not exist.
    TypeError
        If `boundary` or `solid_boundary` is not a flow condition.

    See Also
    --------
    laplacian, flow_step, face_lift, convection

    Examples
    --------
    >>> from sparsedp import Grid
    >>> L = face_laplacian(Grid((2, 2)))
    >>> L(np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    array([ 0.,  0., -4., -4.,  0.,  0.,  0.,  0.,  0.,  0.,  0.,  0.])
    """
    sides = resolve(grid, boundary, no_slip, patches=True)
    free = Mask(free_face_mask(grid, sides, solid))
    stress = stresses(grid, sides, solid, solid_boundary)
    if solid is None:
        structure = compose(free, stress)
    else:
        structure = Matrix(free.explicit() @ stress.explicit())
    return Operator(structure, grid.faces, grid.faces, f"face_laplacian{describe_patches(sides)}")


def face_lift(grid: Grid, boundary: Any = no_slip, solid: ArrayLike | None = None) -> Operator:
    """Return the operator B from tangential wall velocities to their contribution: the Laplacian is L(v) + B(walls).

    Parameters
    ----------
    grid : Grid
    boundary : flow condition or dict
        As for `face_laplacian`. Only no_slip and inflow boundaries have a tangential velocity; the domain has no
        entries for free_slip and outflow boundaries. A wall with such a boundary on a part of it has entries on its
        whole length; those on other parts are not used.
    solid : bool array, shape `grid.shape`, optional
        As for `face_laplacian`. The result is 0 on faces that touch an obstacle.

    Returns
    -------
    Operator
        in: one flat array [velocity], ordered by wall (x-lower, x-upper, y-lower, ...) and for each wall by tangential
        component; ``op.domain.join(...)`` builds it from one number or array for each of these components.
        out: faces [velocity / length^2].

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    ValueError
        If an axis is named that is periodic or does not exist.
    TypeError
        If `boundary` is not a flow condition.

    See Also
    --------
    lift, flow_step, face_laplacian, no_slip, inflow

    Examples
    --------
    >>> from sparsedp import Grid
    >>> B = face_lift(Grid((2, 2)))
    >>> B(B.domain.join(0.0, 0.0, 0.0, 1.0))  # y-upper moves along x: a lid
    array([0., 0., 0., 2., 0., 0., 0., 0., 0., 0., 0., 0.])
    """
    sides = resolve(grid, boundary, no_slip, patches=True)
    structure = compose(Mask(free_face_mask(grid, sides, solid)), wall_stresses(grid, sides))
    name = f"face_lift{describe_patches(sides)}"
    return Operator(structure, wall_velocities(grid, sides), grid.faces, name)


def convection(grid: Grid, boundary: Any = no_slip, solid: ArrayLike | None = None) -> Callable[..., Any]:
    """Return ``convect(v, w, walls=None)``: the convection div(w v) of v by w on faces, by central differences.

    Each component of v, and the convecting velocity w, are averaged to the sides of the control volumes of this
    component. The flux form conserves momentum; if w is free of divergence, it also conserves energy.

        N(v, w) = C ((A v + E walls) (B w))

    A and B are these averages, E inserts the wall velocities, and C is the divergence over the control volumes.

    Parameters
    ----------
    grid : Grid
    boundary : flow condition or dict
        As in `face_laplacian`.
    solid : bool array, shape `grid.shape`, optional

    Returns
    -------
    callable
        ``convect(v, w)`` takes two face fields [velocity] and returns a face field [velocity^2 / length], 0 on faces
        that are not free; differentiable in all arguments, to every order. Order 2.
        ``convect(v, w, walls)`` also takes the tangential velocity of v at walls and inflow boundaries, one flat array
        on ``face_lift(grid, boundary).domain`` [velocity]. Default: 0, so that flow enters at a right angle.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid; on use, if a field or `walls` has another shape.
    ValueError
        If an axis is named that is periodic or does not exist.
    TypeError
        If `boundary` is not a flow condition.

    See Also
    --------
    transport, flow_step, face_laplacian

    References
    ----------
    F. H. Harlow, J. E. Welch, Physics of Fluids 8 (1965) 2182-2189.

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
    sides = resolve(grid, boundary, no_slip, patches=True)
    fluxes = MomentumFluxes(grid, sides)
    gain = fluxes.gain
    free = Mask(free_face_mask(grid, sides, solid))
    C = Operator(compose(free, gain.structure), gain.domain, grid.faces, f"gain{describe_patches(sides)}")

    def convect(v, w, walls=None):
        # w needs no wall velocities: they would matter only in fluxes to faces that are not free, which C sets to 0.
        return C(fluxes.carried(v, walls) * fluxes.carrier(w))

    return ReconstructibleFunction(convect, convection, *copied((grid, boundary, solid)))


# ---- stresses and fluxes on all faces, walls and obstacles included --------------------------------------------------


def stresses(grid: Grid, sides: tuple, solid: ArrayLike | None, solid_boundary: Any) -> Structure:
    """Return the Laplacian of each component: the net stress on the sides of a control volume, divided by its size.

    It is not set to 0 on faces that an obstacle closes: there it is the viscous force on the obstacle.
    """
    if solid_boundary not in (no_slip, free_slip):
        raise TypeError(f"solid_boundary needs dp.no_slip or dp.free_slip, got {solid_boundary!r}")
    if solid is None:
        blocks: dict = {}
        for component in range(grid.dim):
            terms: tuple = ()
            for axis in range(grid.dim):
                terms += _second_differences(grid, component, axis, sides)
            blocks[component, component] = terms
        return Kronecker(grid.faces.parts, grid.faces.parts, blocks)
    closed = grid.faces.split(np.logical_or(*solid_faces(grid, check_solid(grid, solid))))
    matrices = [_laplacian_around(grid, c, sides, closed[c], solid_boundary.along) for c in range(grid.dim)]
    return Matrix(sp.block_diag(matrices, format="csr"))


class MomentumFluxes:
    """The factors of div(w v) = gain(carried(v) * carrier(w)) on all faces, closed ones included.

    Parameters
    ----------
    grid : Grid
    sides : tuple
        The flow conditions as `resolve` returns them.

    Attributes
    ----------
    gain : Operator
        From the fluxes through the sides of control volumes to their divergence on faces.
    """

    def __init__(self, grid: Grid, sides: tuple) -> None:
        self._walls = wall_velocities(grid, sides)
        carried: dict = {}
        carrier: dict = {}
        gain: dict = {}
        sites = []
        # Sides that lie on a wall: the value there is the tangential velocity of the wall itself, not an average.
        wall_carried: dict = {}
        wall_carrier: dict = {}
        numbers = {pair: number for number, pair in enumerate(product(range(grid.dim), repeat=2))}
        for (c, a), number in numbers.items():  # component c through the sides across axis a
            if a == c:
                centres = _nodes_to_centres(grid, c)
                carried[number, c] = carrier[number, c] = along(c, grid.dim, centres)
                back = _centres_to_nodes(grid, c)
                count = centres.shape[0]
            else:
                carried[number, c] = mean_terms(grid, a, conditions_along(grid, sides, a, c))
                carrier[number, a] = mean_terms(grid, c, conditions_along(grid, sides, c, a))
                back = differences(grid, a)
                count = grid.node_count(a)
            gain[c, number] = along(a, grid.dim, back)
            sites.append(tuple(count if b == a else n for b, n in enumerate(grid.face_shape(c))))
        for part, (a, side, c) in enumerate(wall_sides(grid, sides)):
            terms = at_wall(grid, sides, WallSide(a, side, c), _wall_to_faces(grid, a, side))
            wall_carried[numbers[c, a], part] = terms
            wall_carrier[numbers[a, c], part] = terms
        fluxes = Space(None, "fluxes", grid, sites)
        self._fluxes = fluxes
        self._wall_carried_blocks = wall_carried
        self._wall_carrier_blocks = wall_carrier
        self._carried = kronecker_operator(grid.faces, fluxes, carried, "carried")
        self._carrier = kronecker_operator(grid.faces, fluxes, carrier, "carrier")
        self.gain = kronecker_operator(fluxes, grid.faces, gain, "gain")

    @cached_property
    def _wall_carried(self) -> Operator:
        return kronecker_operator(self._walls, self._fluxes, self._wall_carried_blocks, "carried at walls")

    @cached_property
    def _wall_carrier(self) -> Operator:
        return kronecker_operator(self._walls, self._fluxes, self._wall_carrier_blocks, "carrier at walls")

    def carried(self, v: Any, walls: Any = None) -> Any:
        """Return the convected velocity v, averaged to the sides of the control volumes of its components."""
        if walls is None:
            return self._carried(v)
        check_walls("convection", walls, self._walls)
        return self._carried(v) + self._wall_carried(walls)

    @property
    def matrices(self) -> tuple:
        """The matrices of `carried` and `carrier`, without walls."""
        return self._carried.matrix, self._carrier.matrix

    def carrier(self, w: Any, walls: Any = None) -> Any:
        """Return the convecting velocity w, averaged to the same sides."""
        if walls is None:
            return self._carrier(w)
        check_walls("convection", walls, self._walls)
        return self._carrier(w) + self._wall_carrier(walls)


# ---- tangential velocities of walls ----------------------------------------------------------------------------------


class WallSide(NamedTuple):
    """One tangential velocity component of one wall."""

    axis: int  # axis to which the wall is perpendicular
    side: int  # 0 lower, 1 upper
    component: int  # velocity component


def wall_sides(grid: Grid, sides: tuple) -> list[WallSide]:
    """Return one entry for each tangential component of each wall with a no_slip or inflow boundary."""
    entries = []
    for axis, side, wall in walls_of(sides):
        for component in range(grid.dim):
            if component != axis and _at_points(grid, wall, axis, component) != neumann:
                entries.append(WallSide(axis, side, component))
    return entries


def wall_velocities(grid: Grid, sides: tuple) -> Space:
    """Return the space of tangential wall velocities."""
    parts = []
    for axis, _, component in wall_sides(grid, sides):
        parts.append(tuple(1 if b == axis else n for b, n in enumerate(grid.face_shape(component))))
    return Space(None, "moving walls", grid, parts)


def inflow_points(grid: Grid, sides: tuple) -> NDArray[np.bool_]:
    """Return the flat mask of the tangential wall velocities at inflow boundaries."""
    masks = [np.zeros(0, bool)]
    for (axis, side, component), part in zip(wall_sides(grid, sides), wall_velocities(grid, sides).parts, strict=True):
        wall = sides[axis][side]
        if isinstance(wall, MixedWall):
            touching = points_touching(grid, wall, axis, component, lambda condition: condition == inflow)
            masks.append(touching.reshape(-1))
        else:
            masks.append(np.full(prod(part), wall == inflow))
    return np.concatenate(masks)


def check_walls(name: str, walls: Any, space: Space) -> None:
    """Raise unless an array of wall velocities, or a batch of such arrays, has the shape of their space."""
    if np.shape(walls)[-1:] != space.shape:
        check_on(f"{name}, as walls,", walls, space, "; write face_lift(grid, boundary).domain.join(...)")


def wall_stresses(grid: Grid, sides: tuple) -> Kronecker:
    """Return the map from tangential wall velocities to their contribution to the Laplacian on all faces."""
    blocks: dict = {}
    for part, (axis, side, component) in enumerate(wall_sides(grid, sides)):
        factor = differences(grid, axis) @ wall_slopes(grid, axis, side, dirichlet)
        blocks[component, part] = at_wall(grid, sides, WallSide(axis, side, component), factor)
    return Kronecker(grid.faces.parts, wall_velocities(grid, sides).parts, blocks)


def free_face_mask(grid: Grid, sides: tuple, solid: ArrayLike | None) -> NDArray[np.bool_]:
    """Return the mask of the faces whose velocity is unknown: all except those on walls, inflows and obstacles."""
    return mask_of_faces(grid, sides, solid, lambda condition: condition == outflow)


# ---- 1-D factors -----------------------------------------------------------------------------------------------------


def conditions_along(grid: Grid, sides: tuple, axis: int, component: int) -> tuple | None:
    """Return the conditions of a tangential component at both walls of an axis; None if the axis is periodic."""
    pair = sides[axis]
    if pair is None:
        return None
    return tuple(_at_points(grid, wall, axis, component) for wall in pair)


def _at_points(grid: Grid, wall: Any, axis: int, component: int) -> Any:
    """Return the condition of a tangential component at a wall, or a MixedWall of its points there.

    Along their own axis, the points of the component lie between two faces of the wall. At the end of a patch these
    have different conditions: the point is part of the no_slip or inflow boundary if one of them is.
    """
    if not isinstance(wall, MixedWall):
        return wall.along
    is_fixed = points_touching(grid, wall, axis, component, lambda condition: condition.along == dirichlet)
    return mixed_wall([(dirichlet, is_fixed), (neumann, ~is_fixed)])


def at_wall(grid: Grid, sides: tuple, entry: WallSide, factor: Factor) -> tuple[Term, ...]:
    """Return the terms of a factor along the axis across a wall, at the points that have the velocity of the wall."""
    wall = _at_points(grid, sides[entry.axis][entry.side], entry.axis, entry.component)
    if isinstance(wall, MixedWall):
        return tuple(on_faces(entry.axis, factor, wall.faces_with(lambda condition: condition == dirichlet)))
    return along(entry.axis, grid.dim, factor)


def _second_differences(grid: Grid, component: int, axis: int, sides: tuple) -> tuple[Term, ...]:
    """Return the second differences of a component along an axis, as Kronecker terms."""
    if axis == component:
        wall_values = sides[component] and (dirichlet, dirichlet)
        return along(axis, grid.dim, slopes(grid, component, wall_values) @ differences(grid, component))
    (difference,) = along(axis, grid.dim, differences(grid, axis))
    across = slope_terms(grid, axis, conditions_along(grid, sides, axis, component))
    return tuple(difference @ slope for slope in across)


def gradient_around(grid: Grid, c: int, sides: tuple, closed: NDArray, condition: Any) -> Operator:
    """Return the gradient of component c with faces `closed` by obstacles, across the other axes.

    The faces of the component are taken as the cells of an auxiliary grid, on which the obstacles are solid cells.
    """
    spacing = [np.ones(n) if a == c else grid.widths[a] for a, n in enumerate(grid.face_shape(c))]
    lattice = Grid(grid.face_shape(c), spacing=spacing, periodic=grid.periodic)
    conditions = {n: conditions_along(grid, sides, a, c) for a, n in enumerate(grid.axes) if sides[a] and a != c}
    return gradient(lattice, conditions, closed, condition)


def _laplacian_around(grid: Grid, c: int, sides: tuple, closed: NDArray, condition: Any) -> sp.csr_array:
    """Return the Laplacian of component c with faces `closed` by obstacles; see `gradient_around`."""
    slope = gradient_around(grid, c, sides, closed, condition)
    lattice = slope.domain.grid
    across = Mask(lattice.join(*(a != c for a in range(grid.dim))))
    laplacian_across = compose(divergence(lattice).structure, compose(across, slope.structure))
    # Along the component's own axis no condition is needed, because the closed faces hold the obstacle's velocity.
    blocks = {(0, 0): _second_differences(grid, c, c, sides)}
    laplacian_along = Kronecker(lattice.cells.parts, lattice.cells.parts, blocks)
    return total(laplacian_across, laplacian_along).explicit()


def _wall_to_faces(grid: Grid, axis: int, side: int) -> Factor:
    """Return the 1-D matrix that puts the value at a wall on the wall's face, among the faces across an axis."""
    nodes = grid.node_count(axis)
    wall = np.full(min(nodes, 1), side * (nodes - 1))
    return Factor.from_diagonals((nodes, 1), (wall, np.zeros_like(wall), np.ones(wall.size)))


def _nodes_to_centres(grid: Grid, c: int) -> Factor:
    """Return the means from nodes to cells.

    On a bounded axis the two wall values are prepended and appended: they are the outer sides of the half control
    volumes at the walls.
    """
    inner = mean_of_faces(grid, c)
    if grid.periodic[c]:
        return inner
    return with_ends(inner.matrix)


def _centres_to_nodes(grid: Grid, c: int) -> Factor:
    """Return the differences (F[i] - F[i - 1]) / d[i] on nodes, of fluxes F at cell centres (and walls)."""
    if grid.periodic[c]:
        return slopes(grid, c, None)
    lower = wall_slopes(grid, c, 0, dirichlet).matrix
    upper = wall_slopes(grid, c, 1, dirichlet).matrix
    return Factor(sp.hstack([lower, slopes(grid, c, (dirichlet, dirichlet)).matrix, upper], format="csr"))
