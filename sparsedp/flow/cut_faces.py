"""Geometry of the faces and of the control volumes of a velocity that a level set cuts, in 2-D.

The level is interpolated to a grid with twice as many cells along each axis (cubic polynomials), on which
`cut_geometry` divides all cells. The control volume of a face consists of the four small cells around it, so that
cells, faces and control volumes have one common wall.
"""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp.autodiff.tape import sample
from sparsedp.grid.grid import Grid
from sparsedp.operators.cut_geometry import cut_geometry, sum_at_places
from sparsedp.operators.given import from_matrix

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["ComponentGeometry", "Walls", "cut_faces"]

SMALLEST_AREA = 1e-12  # in widths of the smallest cell: a wall with less is a point


class Walls(NamedTuple):
    """The wall of the body in control volumes.

    Attributes
    ----------
    places : int array, shape (m,)
        Flat numbers of the control volumes that hold a part of the wall.
    areas : array, shape (m,)
    normals, centroids : list of arrays, shape (m,), one for each axis
        Unit normal that points into the fluid, and the centroid of the wall.
    """

    places: NDArray[np.int64]
    areas: Any
    normals: list
    centroids: list


class ComponentGeometry(NamedTuple):
    """The faces across one axis, the control volumes around them and the sides of these.

    Sides across the axis of the component lie between the faces i and i + 1, in the middle of cell i; `outer` sides
    are all the others, those on the walls of the grid included.

    Attributes
    ----------
    apertures, centres : arrays, shape (axis of the component, other axis)
        Open fraction of each face, and the coordinate of the centre of its open part along the other axis; in closed
        faces, of the place that opens first.
    middle_areas, middle_centres : arrays, shape (cells, other axis)
        Open length of the sides across the axis of the component, and the coordinate of its centre.
    outer_areas : array, shape (axis of the component, nodes of the other axis)
        Open length of the sides across the other axis.
    walls : Walls
    """

    apertures: Any
    centres: Any
    middle_areas: Any
    middle_centres: Any
    outer_areas: Any
    walls: Walls


def cut_faces(grid: Grid, level: Any) -> tuple[list[ComponentGeometry], Walls]:
    """Return the geometry of both components, and the walls in cells.

    Parameters
    ----------
    grid : Grid
        In 2-D.
    level : array, shape `grid.nodes.shape`, traced or not

    Returns
    -------
    components : list of ComponentGeometry
        One for each axis.
    walls : Walls
        The parts of the wall in cells.

    Notes
    -----
    The level is interpolated to a grid with cells of half the size, whose geometry `cut_geometry` computes. Its parts
    are collected to the control volumes of the faces.
    """
    spacing = [np.repeat(0.5 * widths, 2) for widths in grid.widths]
    fine = Grid([2 * n for n in grid.shape], spacing=spacing, origin=grid.origin, periodic=grid.periodic)
    refine = sp.kron(_midpoint_interpolation(grid, 0), _midpoint_interpolation(grid, 1), format="csr")
    fine_level = anp.reshape(from_matrix(refine)(anp.reshape(level, (-1,))), fine.nodes.shape)
    geometry = cut_geometry(fine, fine_level)
    centres = [_open_centres(fine, axis, fine_level, geometry.apertures) for axis in (0, 1)]
    components = [_component(grid, fine, fine_level, geometry, centres, component) for component in (0, 1)]
    return components, _joined_walls(grid, fine, fine_level, geometry, None)


def _midpoint_interpolation(grid, axis):
    """Return the matrix from the nodes of an axis to the nodes and the centres between them."""
    widths = grid.widths[axis]
    n = widths.size
    cells = np.arange(n)[:, None]
    if grid.periodic[axis]:
        places = cells + np.arange(-1, 3)
        turns, indices = np.divmod(places, n)
        ends = np.append(0.0, np.cumsum(widths))
        x = ends[indices] + turns * ends[-1]
    else:
        count = min(4, n + 1)
        indices = np.clip(cells - 1, 0, n + 1 - count) + np.arange(count)
        ends = np.append(0.0, np.cumsum(widths))
        x = ends[indices]
    middle = (ends[:-1] + ends[1:])[:, None] / 2
    weights = np.ones(x.shape)
    for k in range(x.shape[1]):
        for other in range(x.shape[1]):
            if other != k:
                weights[:, k] *= (middle[:, 0] - x[:, other]) / (x[:, k] - x[:, other])
    nodes = grid.node_count(axis)
    rows = np.append(2 * np.arange(nodes), np.repeat(2 * np.arange(n) + 1, x.shape[1]))
    columns = np.append(np.arange(nodes), indices)
    entries = np.append(np.ones(nodes), weights)
    return sp.coo_array((entries, (rows, columns)), shape=(nodes + n, nodes)).tocsr()


def _open_centres(fine, axis, level, apertures):
    """Return the coordinate of the centre of the open part of each face across an axis, along the other axis; flat."""
    other = 1 - axis
    levels = np.asarray(sample(level))
    lower = levels.take(np.arange(fine.shape[other]), other)
    upper = levels.take((np.arange(fine.shape[other]) + 1) % levels.shape[other], other)
    shift = np.sign(upper - lower) * np.expand_dims(fine.widths[other], axis) / 2
    centre = np.broadcast_to(np.expand_dims(fine.coordinates(other), axis), shift.shape)
    return centre.reshape(-1) + shift.reshape(-1) * (1.0 - _part(fine, axis, apertures))


def _part(grid, axis, faces):
    """Return the values on the faces across an axis, flat."""
    first = grid.faces.offsets[axis]
    return faces[first : first + int(np.prod(grid.face_shape(axis)))]


def _component(grid, fine, level, geometry, centres, component):
    """Return the geometry of one component; arrays have the axis of the component first."""
    other = 1 - component
    numbers = [np.arange(np.prod(fine.face_shape(axis))).reshape(fine.face_shape(axis)) for axis in (0, 1)]
    along = np.moveaxis(numbers[component], component, 0)
    pairs = along.reshape(along.shape[0], grid.shape[other], 2)
    apertures = _part(fine, component, geometry.apertures)
    own, own_centres = _joined(apertures, centres[component], pairs[::2])
    own_centres = anp.where(np.asarray(sample(own)) > 0, own_centres, _nearest_to_fluid(grid, fine, level, component))
    middle, middle_centres = _joined(apertures, centres[component], pairs[1::2])

    sides = np.moveaxis(numbers[other], component, 0)[:, ::2]
    lengths = np.expand_dims(fine.widths[component], 1)
    open_lengths = _part(fine, other, geometry.apertures)[sides] * lengths
    if grid.periodic[component]:
        outer = open_lengths[0::2] + anp.roll(open_lengths[1::2], 1, 0)
    else:
        none = np.zeros((1, sides.shape[1]))
        outer = anp.concatenate([open_lengths[0::2], none]) + anp.concatenate([none, open_lengths[1::2]])
    walls = _joined_walls(grid, fine, level, geometry, component)
    return ComponentGeometry(own, own_centres, middle * grid.widths[other], middle_centres, outer, walls)


def _joined(apertures, centres, pairs):
    """Return the aperture of faces of two halves, and the coordinate of the centre of their open part."""
    halves = apertures[pairs]
    total = halves[..., 0] + halves[..., 1]
    is_open = np.asarray(sample(total)) > 0
    places = centres[pairs]
    moment = halves[..., 0] * places[..., 0] + halves[..., 1] * places[..., 1]
    middle = 0.5 * (np.asarray(sample(places))[..., 0] + np.asarray(sample(places))[..., 1])
    return 0.5 * total, anp.where(is_open, moment / anp.where(is_open, total, 1.0), middle)


def _nearest_to_fluid(grid, fine, level, component):
    """Return the coordinate, along the other axis, of the place in closed faces that opens first.

    It is a mean of the ends and the middle of the face. The weight of each is the product of the other two levels, so
    that the place is a continuous function of the level when the face opens.
    """
    other = 1 - component
    level = anp.transpose(level) if component else level
    level = level[::2]
    count = grid.shape[other]
    lower, middle = level[:, 0 : 2 * count : 2], level[:, 1 : 2 * count : 2]
    upper = level[:, (2 * np.arange(count) + 2) % level.shape[1]]
    weights = [middle * upper, lower * upper, lower * middle]
    total = reduce(add, weights)
    is_known = np.asarray(sample(total)) > 0
    places = grid.coordinates(other)
    shift = anp.where(is_known, (weights[2] - weights[0]) / anp.where(is_known, total, 1.0), 0.0)
    return places + 0.5 * grid.widths[other] * shift


def _joined_walls(grid, fine, level, geometry, component):
    """Return the walls of the control volumes of a component, numbered as its faces; of cells, if it is None."""
    smallest = min(float(np.min(widths)) for widths in fine.widths)
    is_point = np.asarray(sample(geometry.areas)) <= SMALLEST_AREA * smallest
    cells = np.array(np.unravel_index(geometry.cut, fine.shape))
    volumes = cells // 2
    shape = grid.shape
    areas = geometry.areas
    points = list(geometry.centroids)
    normals = [
        anp.where(is_point, of_level, normal)
        for of_level, normal in zip(_directions(fine, level, cells), geometry.normals, strict=True)
    ]
    if component is not None:
        volumes[component] = (cells[component] + 1) // 2
        shape = grid.face_shape(component)
        if grid.periodic[component]:
            turns = volumes[component] // grid.shape[component]
            volumes[component] %= grid.shape[component]
            points[component] = points[component] - turns * grid.size[component]
    flat = np.ravel_multi_index(tuple(volumes), shape)
    places, group = np.unique(flat, return_inverse=True)
    group = group.reshape(-1)
    gather = sum_at_places(group, places.size)
    total = gather(areas)
    # Walls that are a point have no area, but their area has a derivative.
    is_empty = np.asarray(sample(total)) <= SMALLEST_AREA * smallest
    weights = areas + is_empty[group] * smallest
    vectors = [gather(weights * normal) for normal in normals]
    squares = reduce(add, [vector**2 for vector in vectors])
    is_flat = np.asarray(sample(squares)) > 0
    length = anp.sqrt(anp.where(is_flat, squares, 2.0))
    joined_normals = [anp.where(is_flat, vector, 1.0) / length for vector in vectors]
    sums = gather(weights)
    return Walls(places, total, joined_normals, [gather(weights * point) / sums for point in points])


def _directions(fine, level, cells):
    """Return the unit vector along which the level increases in cells; the components one after the other."""
    levels = np.asarray(sample(level))
    corners = {}
    for shift in ((0, 0), (0, 1), (1, 0), (1, 1)):
        corners[shift] = levels[tuple((cells[a] + shift[a]) % levels.shape[a] for a in (0, 1))]
    along_x = corners[1, 0] + corners[1, 1] - corners[0, 0] - corners[0, 1]
    along_y = corners[0, 1] + corners[1, 1] - corners[0, 0] - corners[1, 0]
    along_x = along_x / fine.widths[0][cells[0]]
    along_y = along_y / fine.widths[1][cells[1]]
    length = np.hypot(along_x, along_y)
    length[length == 0] = 1.0
    return along_x / length, along_y / length
