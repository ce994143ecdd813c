"""What acts on a velocity besides pressure: viscosity (face_laplacian, face_lift) and convection.

Every component lives on its own faces. Along its own axis it is a field on nodes, and the wall faces
hold the wall values; along the other axes it is a field between walls half a cell away, with the
condition that what the fluid does there implies (`along` of boundary_conditions.py).
"""

from itertools import product

import numpy as np
import scipy.sparse as sp

from sparsedp.boundary_conditions import dirichlet, free_slip, no_slip, outflow, resolve
from sparsedp.flow.projection_setup import faces_that
from sparsedp.grid import Grid
from sparsedp.operator import Operator
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.masks_and_lift import check_solid, solid_faces
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
from sparsedp.recipe import Made
from sparsedp.space import Space
from sparsedp.structure.base import Matrix
from sparsedp.structure.factor import Factor
from sparsedp.structure.kronecker import Kronecker
from sparsedp.structure.lazy import Mask, compose, total
from sparsedp.tree import copied

__all__ = ["convection", "face_laplacian", "face_lift", "momentum_fluxes", "stresses"]


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
    free, whole = Mask(free_faces(grid, sides, solid)), stresses(grid, sides, solid, solid_boundary)
    structure = compose(free, whole) if solid is None else Matrix(free.explicit() @ whole.explicit())
    return Operator(structure, grid.faces, grid.faces, "face_laplacian")


def face_lift(grid, boundary=no_slip):
    """Wall velocities -> faces: what walls that move along themselves add, L(v) + B(values).

    Parameters
    ----------
    grid : Grid
    boundary : flow condition or dict
        The same as for `face_laplacian`. Walls that are no_slip (and inflows) have a velocity along them.

    Returns
    -------
    Operator
        in: one flat array [velocity], wall after wall (x-lower, x-upper, y-lower, ...), for each the
        components along it; ``op.domain.join(...)`` builds it from one number or array for each.
        out: faces [velocity / length^2].

    Raises
    ------
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
    parts: list[tuple[int, ...]] = []
    blocks = {}
    for a in range(grid.dim):
        for side, condition in enumerate(sides[a] or ()):
            for c in range(grid.dim):
                if c != a and condition.along is dirichlet:
                    factor = differences(grid, a) @ wall_slopes(grid, a, side, dirichlet)
                    blocks[c, len(parts)] = along(a, grid.dim, factor)
                    parts.append(tuple(1 if b == a else n for b, n in enumerate(grid.face_shape(c))))
    walls = Space(None, "moving walls", grid, parts)
    structure = compose(Mask(free_faces(grid, sides, None)), Kronecker(grid.faces.parts, parts, blocks))
    return Operator(structure, walls, grid.faces, "face_lift")


def convection(grid, boundary=no_slip, solid=None):
    """Grid -> convect(v, w): the momentum that w carries, div(w v) on the faces, by central differences.

    Each component of v and the velocity w that carries it are averaged to the sides of its control
    volume. The flux form conserves momentum and, where w has no divergence, energy.

        N(v, w) = C ((A v) (B w))

    Parameters
    ----------
    grid : Grid
    boundary : str or dict
        As in `face_laplacian`.
    solid : bool array, shape `grid.shape`, optional

    Returns
    -------
    callable
        ``convect(v, w)`` with two face fields [velocity] -> faces [velocity^2 / length], 0 on faces that
        are not free; differentiable in both, to every order. Order 2.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
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
    """
    sides = resolve(grid, boundary, no_slip)
    A, B, gain = momentum_fluxes(grid, sides)
    C = Operator(compose(Mask(free_faces(grid, sides, solid)), gain.structure), gain.domain, grid.faces, "gain")

    def convect(v, w):
        return C(A(v) * B(w))

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


def momentum_fluxes(grid, sides):
    """Operators A, B, C: div(w v) = C ((A v) (B w)), as in `convection`."""
    carried, carrier, gain, flux = {}, {}, {}, []
    for number, (c, a) in enumerate(product(range(grid.dim), repeat=2)):  # component c through the sides across axis a
        if a == c:
            mean = other = _to_centres(grid, c)
            back = _from_centres(grid, c)
        else:
            mean, other = (means(grid, b, _conditions(sides[b])) for b in (a, c))
            back = differences(grid, a)
        carried[number, c], carrier[number, a] = along(a, grid.dim, mean), along(c, grid.dim, other)
        gain[c, number] = along(a, grid.dim, back)
        flux.append(tuple(mean.shape[0] if b == a else n for b, n in enumerate(grid.face_shape(c))))
    faces, sites = grid.faces, Space(None, "fluxes", grid, flux)
    A = kronecker_operator(faces, sites, carried, "carried")
    B = kronecker_operator(faces, sites, carrier, "carrier")
    return A, B, kronecker_operator(sites, faces, gain, "gain")


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
