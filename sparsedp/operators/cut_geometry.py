"""Geometry of cells that a level set cuts: fluid fractions of cells and faces, and the wall inside of each cell.

A cell is divided into simplices that meet in its centre, and the level is taken as linear in each of them. The level of
a centre is the mean over the corners. In a simplex with the levels v_i at its vertices, the fraction where the level is
positive, and its derivative in a common shift of all levels, are rational functions of v_i (d: number of dimensions)::

    one positive level a:              a^d / prod(a - v_j),               d a^(d-1) / prod(a - v_j)
    one other level n <= 0:            1 - (-n)^d / prod(v_j - n),        d (-n)^(d-1) / prod(v_j - n)
    two positive a, b, two others:     (a^2 b^2 - a b (a + b)(c + d) + c d (a^2 + a b + b^2)) / q,
                                       3 (c d (a + b) - a b (c + d)) / q,   q = (a - c)(a - d)(b - c)(b - d)

The area of the wall in the simplex is the volume of the simplex times the second value times the slope of the level.
No term is a difference of nearly equal numbers, so that tiny fractions have all their digits. If the level is 0 at a
node, the node belongs to the solid; the formulas then give the derivatives for the side of the fluid.
"""

from __future__ import annotations

from functools import reduce
from itertools import product
from operator import add
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.validation import check_finite, check_kind, check_on, check_plain
from sparsedp.autodiff.program_trace import recording_trace
from sparsedp.autodiff.tape import cast, isbox, sample
from sparsedp.errors import JitError
from sparsedp.operators.given import from_matrix

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.grid.space import Space
    from sparsedp.operators.operator import Operator

__all__ = ["CutGeometry", "cut_geometry", "level_at_nodes", "protect", "sum_at_places"]

# A level below this share of the largest one around it is taken as 0, so that powers of fractions do not underflow.
TINY = 1e-10
# By how much the level sinks, relative to its values around, to find the normal of a wall that touches a cell in a
# point.
SINKING = 1e-6


class CutGeometry(NamedTuple):
    """The geometry of the fluid, where the level is positive.

    Attributes
    ----------
    cut : int array, shape (m,)
        Flat numbers of the cells that hold a part of the wall.
    fractions : array, shape (cells,)
        Fluid fraction of the volume of each cell.
    apertures : array, shape (faces,)
        Fluid fraction of the area of each face.
    areas : array, shape (m,)
        Area of the wall in the cells `cut`.
    normals, centroids : list of arrays, shape (m,), one for each axis
        Unit normal of the wall that points into the fluid, and the centroid of the wall.
    """

    cut: NDArray[np.int64]
    fractions: Any
    apertures: Any
    areas: Any
    normals: list
    centroids: list


def level_at_nodes(name: str, grid: Grid, level: Any) -> Any:
    """Return a level at the nodes, traced or not, in double precision; raise an error for an invalid one.

    Parameters
    ----------
    name : str
        Name of the caller, for error messages.
    grid : Grid
    level : array, shape `grid.nodes.shape`, or callable
    """
    if callable(level) and not isbox(level):
        level = level(*np.meshgrid(*(grid.coordinates(a, "nodes") for a in range(grid.dim)), indexing="ij"))
    if recording_trace([level]) is not None:
        raise JitError(
            f"dp.jit cannot record the level of {name}, whose values decide which cells are cut; call the function "
            "without dp.jit"
        )
    check_plain(name, level)
    values = np.asarray(sample(level))
    check_on(f"the level of {name}", values, grid.nodes)
    check_kind(f"the level of {name}", values.dtype, "real numbers", "; write level.real")
    check_finite(f"the level of {name}", values)
    return cast(level if isbox(level) else values, np.dtype(float))


def protect(*arrays: Any) -> None:
    """Make arrays read-only, except traced ones: a body does not change."""
    for array in arrays:
        if not isbox(array):
            array.flags.writeable = False


def cut_geometry(grid: Grid, level: Any) -> CutGeometry:
    """Return the volumes, apertures and walls of the cells.

    Parameters
    ----------
    grid : Grid
    level : array, shape `grid.nodes.shape`, traced or not
        > 0 in the fluid.

    Returns
    -------
    CutGeometry
        Differentiable in the level.
    """
    dim = grid.dim
    level = anp.reshape(_scaled_level(grid, level), (-1,))
    positive = np.asarray(sample(level)) > 0

    nodes = _corner_nodes(grid, None)
    counts = np.sum(positive[nodes], axis=0)
    cut = np.flatnonzero((counts > 0) & (counts < len(nodes)))
    corners = level[nodes[:, cut]]
    widths = _cell_lengths(grid, [np.asarray(h) for h in grid.widths], cut)
    lower = _cell_lengths(grid, [grid.coordinates(axis, "nodes")[:n] for axis, n in enumerate(grid.shape)], cut)
    volume, areas, vectors, moments = _wall(corners, widths)
    fractions = (counts == len(nodes)).astype(float) + sum_at_places(cut, counts.size)(volume)

    squares = reduce(add, [v**2 for v in vectors])
    has_normal = np.asarray(sample(squares)) > 0
    limits = _normals_of_points(np.asarray(sample(corners)), widths, has_normal)
    length = anp.sqrt(anp.where(has_normal, squares, 1.0))
    normals = [anp.where(has_normal, v / length, limit) for v, limit in zip(vectors, limits, strict=True)]
    has_area = np.asarray(sample(areas)) > 0
    lowest = np.argmin(np.asarray(sample(corners)), axis=0)
    corner_bits = np.array(list(product((0, 1), repeat=dim)))
    centroids = []
    for axis in range(dim):
        in_cell = anp.where(has_area, moments[axis] / anp.where(has_area, areas, 1.0), 0.0)
        at_corner = np.where(has_area, 0.0, corner_bits[lowest, axis] * widths[axis])
        centroids.append(lower[axis] + in_cell + at_corner)
    apertures = [_apertures(grid, axis, level, positive) for axis in range(dim)]
    return CutGeometry(cut, fractions, anp.concatenate(apertures), areas, normals, centroids)


def _normals_of_points(corners, widths, has_normal):
    """Return the normals where the wall touches a cell in a point: normals of the wall that appears if the level sinks.

    The derivative of an integral over the wall is then one-sided. The other cells get the diagonal.
    """
    dim = len(widths)
    normals = np.full((dim, has_normal.size), 1.0 / np.sqrt(dim))
    points = np.flatnonzero(~has_normal)
    if points.size:
        touching = corners[:, points]
        sunk = touching - SINKING * np.max(np.abs(touching), axis=0)
        vectors = np.array(_wall(sunk, [h[points] for h in widths])[2])
        length = np.sqrt(np.sum(vectors**2, axis=0))
        normals[:, points] = np.where(length > 0, vectors / np.where(length > 0, length, 1.0), normals[:, points])
    return normals


def _scaled_level(grid, level):
    """Return the level with values up to 1, where values much smaller than their neighbours are 0.

    The factor is a power of two. The derivatives of the small values are kept.
    """
    largest = np.max(np.abs(np.asarray(sample(level))), initial=0.0)
    exponent = int(np.frexp(largest)[1])
    half = exponent // 2  # 2^-exponent alone overflows for the smallest numbers
    level = 2.0**-half * level * 2.0 ** (half - exponent)
    values = np.asarray(sample(level))
    if not values.size:
        return level
    largest = np.abs(values)
    for axis, is_periodic in enumerate(grid.periodic):
        if is_periodic:
            padded = np.concatenate([largest.take([-1], axis), largest, largest.take([0], axis)], axis)
        else:
            padded = np.concatenate([largest.take([0], axis), largest, largest.take([-1], axis)], axis)
        n = largest.shape[axis]
        shifted = [padded.take(np.arange(first, first + n), axis) for first in range(3)]
        largest = np.maximum.reduce(shifted)
    return level - np.where(np.abs(values) <= TINY * largest, values, 0.0)


def _corner_nodes(grid: Grid, face_axis: int | None) -> NDArray[np.int64]:
    """Return the flat numbers of the nodes at the corners of cells or, with `face_axis`, of the faces across this axis.

    There is one row for each corner.
    """
    shape = grid.nodes.shape
    rows = []
    for bits in product((0, 1), repeat=grid.dim - (face_axis is not None)):
        bits_of_axis = iter(bits)
        lines = []
        for axis in range(grid.dim):
            if axis == face_axis:
                lines.append(np.arange(shape[axis]))
            else:
                lines.append((np.arange(grid.shape[axis]) + next(bits_of_axis)) % shape[axis])
        rows.append(np.ravel_multi_index(np.ix_(*lines), shape).ravel())
    return np.array(rows)


def _cell_lengths(grid, lines, cells):
    """Return for each axis the entries of a line of numbers that belong to some cells, given by their flat numbers."""
    places = np.unravel_index(cells, grid.shape)
    return [line[place] for line, place in zip(lines, places, strict=True)]


def _simplices(dim: int) -> NDArray[np.float64]:
    """Return the simplices of a cube, shape (simplices, vertices, corners): vertices as weights of the corners."""
    corners = list(product((0, 1), repeat=dim))

    def divided(fixed):
        """Return the simplices of the part of the cube where some coordinates are fixed."""
        mean = np.array([all(corner[axis] == side for axis, side in fixed.items()) for corner in corners], float)
        mean /= mean.sum()
        if len(fixed) == dim:
            return [[mean]]
        free = [axis for axis in range(dim) if axis not in fixed]
        if len(free) == 1:
            return [[point for side in (0, 1) for [point] in divided({**fixed, free[0]: side})]]
        return [[*s, mean] for axis in free for side in (0, 1) for s in divided({**fixed, axis: side})]

    return np.array(divided({}))


def sum_at_places(places: NDArray[np.int64], size: int | Space) -> Operator:
    """Return the operator that adds the entries of a flat array to places of a field.

    Parameters
    ----------
    places : int array, shape (m,)
        Flat number of the place for each entry; it may occur several times.
    size : int or Space
        The space of the result, or the length of a flat result.

    Returns
    -------
    Operator
        From arrays of shape (m,). Its transpose reads the entries at the places.
    """
    rows = size if isinstance(size, int) else size.size
    matrix = sp.csr_array((np.ones(places.size), (places, np.arange(places.size))), shape=(rows, places.size))
    return from_matrix(matrix, codomain=size, name="sum at places")


class _Sorted(NamedTuple):
    """Simplices with the same number of positive levels, positive vertices first."""

    positive: int
    columns: NDArray[np.int64]
    order: NDArray[np.int64]
    levels: list


def _by_sign(levels):
    """Yield the simplices that the wall cuts, grouped by the number of their positive levels; shape (vertices, n)."""
    values = np.asarray(sample(levels))
    order = np.argsort(-values, axis=0, kind="stable")
    counts = np.sum(values > 0, axis=0)
    for positive in range(1, len(values)):
        columns = np.flatnonzero(counts == positive)
        if columns.size:
            rows = order[:, columns]
            yield _Sorted(positive, columns, rows, [levels[row, columns] for row in rows])


def _fraction(simplices: _Sorted) -> Any:
    """Return the positive fraction of the volume."""
    v = simplices.levels
    if simplices.positive == 1:
        return reduce(lambda product, other: product * (v[0] / (v[0] - other)), v[1:], 1.0)
    if simplices.positive == len(v) - 1:
        return 1.0 - reduce(lambda product, other: product * (v[-1] / (v[-1] - other)), v[:-1], 1.0)
    a, b, c, d = v
    return (a**2 * b**2 - a * b * (a + b) * (c + d) + c * d * (a**2 + a * b + b**2)) / _pairs(v)


def _slope(simplices: _Sorted) -> Any:
    """Return the derivative of the positive fraction of the volume in a common shift of all levels."""
    v = simplices.levels
    dim = len(v) - 1
    if simplices.positive == 1:
        return reduce(lambda product, other: product * (v[0] / (v[0] - other)), v[1:-1], dim / (v[0] - v[-1]))
    if simplices.positive == dim:
        return reduce(lambda product, other: product * (v[-1] / (v[-1] - other)), v[1:-1], dim / (v[0] - v[-1]))
    a, b, c, d = v
    return 3.0 * (c * d * (a + b) - a * b * (c + d)) / _pairs(v)


def _pairs(v):
    """Return the product of all differences between a positive level and another level."""
    a, b, c, d = v
    return (a - c) * (a - d) * (b - c) * (b - d)


def _apertures(grid, axis, level, positive):
    """Return the fluid fractions of the faces across an axis."""
    nodes = _corner_nodes(grid, axis)
    counts = np.sum(positive[nodes], axis=0)
    full = (counts == len(nodes)).astype(float)
    cut = np.flatnonzero((counts > 0) & (counts < len(nodes)))
    if grid.dim == 1 or not cut.size:
        return full
    simplices = _simplices(grid.dim - 1)
    corners = level[nodes[:, cut]]
    levels = anp.reshape(anp.tensordot(simplices, corners, axes=([2], [0])), (len(simplices), grid.dim, -1))
    levels = anp.concatenate([levels[s] for s in range(len(simplices))], axis=1)
    places = np.tile(cut, len(simplices))
    share = 1.0 / len(simplices)
    result = full + _full_share(levels, places, full.size, share)
    for group in _by_sign(levels):
        result = result + sum_at_places(places[group.columns], full.size)(share * _fraction(group))
    return result


def _full_share(levels, places, size, share):
    """Return for each place the share of the simplices with only positive levels."""
    is_full = np.all(np.asarray(sample(levels)) > 0, axis=0)
    return share * np.bincount(places[is_full], minlength=size)


def _wall(corners, widths):
    """Return the geometry inside of cut cells, given the levels at their corners and their widths.

    Parameters
    ----------
    corners : array, shape (corners, m)
    widths : list of arrays, shape (m,)

    Returns
    -------
    fractions, areas : arrays, shape (m,)
    vectors, moments : lists of arrays, shape (m,)
        The integral of the normal, and of the position from the lower corner, over the wall.
    """
    dim = len(widths)
    m = np.shape(corners)[1]
    simplices = _simplices(dim)
    cell_volume = reduce(np.multiply, widths)
    cells = np.arange(m)
    zeros = np.zeros(m)
    fractions: Any = zeros
    areas: Any = zeros
    vectors: list = [zeros] * dim
    moments: list = [zeros] * dim
    for simplex in simplices:
        share = 1.0 / len(simplices)
        levels = anp.dot(simplex, corners)
        points = simplex @ np.array(list(product((0.0, 1.0), repeat=dim)))
        inverse = np.linalg.inv(points[1:] - points[0])
        differences = levels[1:] - levels[0]
        slopes = [anp.dot(inverse[axis], differences) / widths[axis] for axis in range(dim)]
        fractions = fractions + _full_share(levels, cells, m, share)
        for group in _by_sign(levels):
            columns = group.columns
            scatter = sum_at_places(columns, m)
            fractions = fractions + scatter(share * _fraction(group))
            slope = [s[columns] for s in slopes]
            steepness = anp.sqrt(reduce(add, [s**2 for s in slope]))
            factor = share * cell_volume[columns] * _slope(group)
            area = factor * steepness
            areas = areas + scatter(area)
            vertices = points[group.order]  # (vertices, n, dim)
            lengths = [h[columns] for h in widths]
            direction = [s / steepness for s in slope]
            moment = _moment(group, vertices, lengths, area, direction)
            for axis in range(dim):
                vectors[axis] = vectors[axis] + scatter(factor * slope[axis])
                moments[axis] = moments[axis] + scatter(moment[axis])
    return fractions, areas, vectors, moments


def _moment(group, vertices, lengths, area, direction):
    """Return the integral of the position over the wall in simplices, one array for each axis."""
    axes = range(len(lengths))

    def crossing(i, j):
        """Return the point where the level is 0 between the vertices i (positive) and j."""
        a = group.levels[i]
        t = a / (a - group.levels[j])
        return [
            lengths[axis] * (vertices[i, :, axis] + t * (vertices[j, :, axis] - vertices[i, :, axis])) for axis in axes
        ]

    count = len(vertices)
    if group.positive == 1 or group.positive == count - 1:
        if group.positive == 1:
            polygon = [crossing(0, j) for j in range(1, count)]
        else:
            polygon = [crossing(i, count - 1) for i in range(count - 1)]
        return [area * reduce(add, [point[axis] for point in polygon]) / len(polygon) for axis in axes]
    ac, ad, bd, bc = crossing(0, 2), crossing(0, 3), crossing(1, 3), crossing(1, 2)
    diagonal = [q - p for p, q in zip(ac, bd, strict=True)]
    first = _triangle([q - p for p, q in zip(ac, ad, strict=True)], diagonal, direction)
    second = _triangle(diagonal, [q - p for p, q in zip(ac, bc, strict=True)], direction)
    sign = np.sign(np.asarray(sample(first + second)))  # the same for both triangles
    thirds = [(sign / 3 * first, (ac, ad, bd)), (sign / 3 * second, (ac, bd, bc))]
    return [reduce(add, [weight * (p[axis] + q[axis] + r[axis]) for weight, (p, q, r) in thirds]) for axis in axes]


def _triangle(p, q, direction):
    """Return the signed area of the triangle of two edges, seen from a direction normal to it."""
    cross = [p[(axis + 1) % 3] * q[(axis + 2) % 3] - p[(axis + 2) % 3] * q[(axis + 1) % 3] for axis in range(3)]
    return 0.5 * reduce(add, [c * n for c, n in zip(cross, direction, strict=True)])
