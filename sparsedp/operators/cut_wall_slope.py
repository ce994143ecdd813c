"""The slope of a cell field at a wall that cuts the cells, out of the fluid, as a linear function of the cell values.

A quadratic polynomial through the value u_w at the centroid of the wall is fitted to the cells in front of the wall, by
weighted least squares. The weight is proportional to the fluid fraction of a cell and decreases with the distance. The
slope of the polynomial is (sum of c_j u_j) - C u_w, where C is the sum of the c_j. The condition a u_w + b du/dn = g
then gives

    du/dn = (a (sum of c_j u_j) - C g) / (a - b C).

Gaps. In a gap that is narrower than about a cell, the cells in front lie behind the opposite wall. There the slope is
that of a parabola between two walls: u is taken as the mean over the fluid of the cell, and du/dn = -(u - u_w) / (L/3),
where L = V / A is half of the width of the gap: the fluid volume around the wall, divided by the area of the walls.
Where the values at the walls around differ, u and u_w are deviations from a linear function l through the value at the
wall, which is fitted to the values at the other walls:

    du/dn = dl/dn - (u - l(centre of the cell)) / (L/3).

The differences of the values at the walls are those of the condition, (g_j - g_i) / a, times a L / (a L + b): the share
that falls off between the walls. So linear fields are exact, and so are sources between walls with one value. Between
L = 0.6 and 0.9 cells the slope changes smoothly into the slope of the fit, so that derivatives in the level exist.

Gaps between the body and a wall of the grid, both with dirichlet conditions. The wall of the grid is then the other
wall, if the normals differ by more than 120 degrees. L is half of the distance of the walls, and u and the centre are
means over the fluid of the cells between them: fields that are quadratic across the gap have exact integrals. On the
face of the grid the slope -(u - u_w) / (h/2) of `gradient` changes into the slope in the gap, too. The change happens
for 2 L between 2 and 2.4 cells. With another condition on one of both walls, the slope on a wall of the grid is that of
`gradient`.
"""

from __future__ import annotations

from functools import reduce
from itertools import product
from operator import add
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.tape import sample
from sparsedp.operators.cut_geometry import sum_at_places
from sparsedp.operators.cut_grid_walls import are_near, grid_walls
from sparsedp.operators.small_systems import solve_definite

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.operators.cut_geometry import CutGeometry

__all__ = ["WallSlope", "wall_slope"]

# The polynomial is fitted to the cells around the wall up to this distance, in cell widths. The weights go to 0 there,
# so that the solution is a continuous function of the level.
RADIUS = 2.5
# Regularization of the fit, relative to the sum of the weights: of slopes and of curvatures. It only matters where the
# cells around do not determine them.
SLOPE_DAMPING = 1e-10
CURVATURE_DAMPING = 1e-3
# The same for the slopes of a linear function through the values at walls, times (L / 3 / cell width)^2: the distance
# of two walls in a gap counts, the curvature of one wall does not.
VALUE_DAMPING = 1e-4
# The weighted sum of squared distances of cells in front from the wall, in cell widths, from which on the fit alone is
# used.
ENOUGH = 0.4
# Ratios of fluid volume to wall area, in cell widths: up to the first one the slope is that in a gap, from the second
# one on the slope of the fit. A plane wall has 1.2, a gap half of its width.
NARROW = 0.6
WIDE = 0.9
# The same for gaps between the body and a wall of the grid, whose width is the distance of the walls.
NARROW_GRID = 1.0
WIDE_GRID = 1.2
# The radius around a wall in which other walls of its gap lie, in cell widths, and in which number of cells.
WIDE_RADIUS = 3.5
WIDE_REACH = 4
# Two walls are a gap if the area of the opposite wall is at least 1 / FACING of the area of the own wall.
FACING = 3.0
THINNEST = 1e-3  # half of the width of a gap below which the slope does not become steeper, in cell widths


class WallSlope(NamedTuple):
    """The slopes at walls, out of the fluid, as linear functions of a field u and of the values of the conditions.

    A slope is the sum of coefficients * u[cells] over the pairs of the wall, plus of_value * value, plus the sum of
    of_difference * (v[others] - v[gap_walls]) over pairs of walls in gaps, where v is value / scale. Walls are
    numbered: first the m cut cells, then the q faces on the walls of the grid.

    Attributes
    ----------
    walls, cells : int arrays, shape (pairs,)
        Number of the wall, and flat number of the cell of each coefficient.
    coefficients : array, shape (pairs,)
    of_value : array, shape (m + q,)
    faces : int array, shape (q,)
        Flat numbers of the faces on the walls of the grid.
    lengths, signs : arrays, shape (q,)
        The value of the condition, divided by what it adds to the slope of `gradient`; the sign of du/dn in this slope.
    scales : array, shape (m + q,)
        a of the conditions, or b if a is 0.
    gap_walls, others : int arrays, shape (pairs of walls,)
    of_difference : array, shape (pairs of walls,)
    """

    walls: NDArray[np.int64]
    cells: NDArray[np.int64]
    coefficients: Any
    of_value: Any
    faces: NDArray[np.int64]
    lengths: NDArray[Any]
    signs: NDArray[Any]
    scales: NDArray[np.float64]
    gap_walls: NDArray[np.int64]
    others: NDArray[np.int64]
    of_difference: Any

    def terms_of_values(self, values: Any, lifted: Any) -> tuple[Any, Any]:
        """Return the parts of the slopes that the values of the conditions add.

        Parameters
        ----------
        values : array, shape (..., m)
            In the cut cells.
        lifted : array, shape (..., faces of the grid), or 0.0
            What the values on the walls of the grid add to `gradient`.

        Returns
        -------
        in_cells : array, shape (..., m)
        on_faces : array, shape (..., q)
            In the direction of the axis.
        """
        q = self.faces.size
        m = self.scales.size - q
        if q:
            on_faces = lifted[..., self.faces] * self.lengths if np.ndim(lifted) else np.zeros(q)
            batch = np.broadcast_shapes(np.shape(values)[:-1], np.shape(on_faces)[:-1])
            values = anp.concatenate([part + np.zeros((*batch, 1)) for part in (values, on_faces)], axis=-1)
        of_walls = values / self.scales
        terms = self.of_difference * (of_walls[..., self.others] - of_walls[..., self.gap_walls])
        slopes = self.of_value * values + sum_at_places(self.gap_walls, self.scales.size)(terms)
        return slopes[..., :m], slopes[..., m:] * self.signs


class Pairs(NamedTuple):
    """Pairs of a cut cell and a cell around its wall.

    Attributes
    ----------
    walls, cells : int arrays, shape (pairs,)
        Number of the cut cell, and flat number of the other cell.
    offsets : list of arrays, shape (pairs,), one for each axis
        From the centroid of the wall to the centre of the cell, in widths of the cut cell; across a periodic side, of
        the image next to the wall.
    """

    walls: NDArray[np.int64]
    cells: NDArray[np.int64]
    offsets: list


def wall_slope(grid: Grid, geometry: CutGeometry, condition: Any, sides: tuple) -> WallSlope:
    """Return the slope at the walls of all cut cells, and on faces of the grid in gaps; see the module docstring.

    Parameters
    ----------
    grid : Grid
    geometry : CutGeometry
    condition : condition
        On the wall of the body. For neumann there is nothing to compute.
    sides : tuple
        Conditions on the walls of the grid, as `resolve` returns them.
    """
    is_dirichlet = bool(condition.a) and not condition.b
    faces = grid_walls(grid, geometry, sides if is_dirichlet else (), WIDE_REACH)
    walls = _joined_walls(geometry, faces, condition)
    m = geometry.cut.size
    widths = _widths(grid, walls)
    if condition.a:
        subset = np.arange(m)
    else:
        subset = np.zeros(0, int)
    pairs = _pairs(grid, geometry, walls, widths, subset, RADIUS)
    coefficients, information = _fitted_slopes(geometry, pairs, [h[:m] for h in widths])
    lack = anp.maximum(1.0 - information / ENOUGH, 0.0) ** 2 if condition.a else np.zeros(m)
    gap = _gap(grid, geometry, walls, pairs, widths, faces, lack)

    of_fit = 1.0 - gap.share
    half_widths = _half_widths(grid, faces)
    numbers = np.concatenate([pairs.walls, np.arange(m, m + faces.cells.size)])
    cells = np.concatenate([pairs.cells, faces.cells])
    slopes = anp.concatenate([coefficients, -1.0 / half_widths])
    of_u = sum_at_places(numbers, walls.cells.size)(slopes)
    denominators = _nonzero(walls.a - walls.b * of_u)
    has_u = walls.a != 0
    of_value = of_fit * -of_u / denominators + gap.share / (_nonzero(walls.a) * gap.distance)
    signs = 2.0 * (faces.sides % 2) - 1.0
    return WallSlope(
        np.concatenate([numbers, gap.walls]),
        np.concatenate([cells, gap.cells]),
        anp.concatenate([slopes * (of_fit * walls.a / denominators)[numbers], gap.coefficients]),
        anp.where(has_u, of_value, 1.0 / _nonzero(walls.b)),
        faces.faces,
        signs * faces.a * half_widths,
        signs,
        np.where(has_u, walls.a, walls.b),
        gap.first,
        gap.others,
        gap.of_difference,
    )


class _Walls(NamedTuple):
    """The walls in cut cells, and after them the faces on the walls of the grid, as `CutGeometry` and `GridWalls`.

    The side of a wall in a cut cell is -1.
    """

    cells: NDArray[np.int64]
    sides: NDArray[np.int64]
    a: NDArray[np.float64]
    b: NDArray[np.float64]
    areas: Any
    normals: list
    centroids: list


def _joined_walls(geometry, faces, condition):
    """Return the walls in cut cells and the faces on the walls of the grid."""
    m = geometry.cut.size
    return _Walls(
        np.concatenate([geometry.cut, faces.cells]),
        np.concatenate([np.full(m, -1), faces.sides]),
        np.concatenate([np.full(m, float(condition.a)), faces.a]),
        np.concatenate([np.full(m, float(condition.b)), np.zeros(faces.a.size)]),
        anp.concatenate([geometry.areas, faces.areas]),
        [anp.concatenate(pair) for pair in zip(geometry.normals, faces.normals, strict=True)],
        [anp.concatenate(pair) for pair in zip(geometry.centroids, faces.centroids, strict=True)],
    )


def _widths(grid, walls):
    """Return the widths of the cells of the walls, one array for each axis."""
    places = np.unravel_index(walls.cells, grid.shape)
    return [grid.widths[axis][places[axis]] for axis in range(grid.dim)]


def _half_widths(grid, faces):
    """Return half the widths of the cells next to faces on the walls of the grid, across these walls."""
    widths = np.array(_widths(grid, faces))
    return 0.5 * widths[faces.sides // 2, np.arange(faces.cells.size)]


def _pairs(grid, geometry, walls, widths, subset, radius) -> Pairs:
    """Return the pairs of some walls with the fluid cells, and with the cut cells, up to a distance in cell widths."""
    reach = int(np.ceil(radius + 0.5))  # the centroid of a wall lies in its cell
    places: Any = np.unravel_index(walls.cells[subset], grid.shape)
    steps = np.array(list(product(range(-reach, reach + 1), repeat=grid.dim)))
    is_near = np.ones((len(steps), subset.size), bool)
    squares = np.zeros(is_near.shape)
    positions = []
    indices = []
    for axis, n in enumerate(grid.shape):
        turns, index = np.divmod(places[axis] + steps[:, axis, None], n)
        if not grid.periodic[axis]:
            is_near &= turns == 0
        positions.append(grid.coordinates(axis)[index] + turns * grid.size[axis])
        indices.append(index)
        centroid = np.asarray(sample(walls.centroids[axis]))[subset]
        squares += ((positions[axis] - centroid) / widths[axis][subset]) ** 2
    cells: Any = np.ravel_multi_index(indices, grid.shape)
    is_in_use = np.asarray(sample(geometry.fractions)) > 0
    is_in_use[walls.cells] = True
    is_near &= is_in_use[cells] & (squares < radius**2)
    numbers = subset[np.nonzero(is_near)[1]]
    offsets = [
        (positions[axis][is_near] - walls.centroids[axis][numbers]) / widths[axis][numbers] for axis in range(grid.dim)
    ]
    return Pairs(numbers, cells[is_near], offsets)


def _fitted_slopes(geometry, pairs, widths):
    """Return the coefficients c_j of the fitted polynomial, and how well the cells determine its slope.

    Returns
    -------
    coefficients : array, shape (pairs,)
    information : array, shape (m,)
        Weighted sum of the squared distances of the cells in front of the wall, in cell widths.
    """
    walls, cells, offsets = pairs
    axes = range(len(widths))
    gather = sum_at_places(walls, geometry.cut.size)
    ahead = reduce(add, [offsets[a] * geometry.normals[a][walls] for a in axes])
    squares = reduce(add, [x**2 for x in offsets])
    nearness = (anp.maximum(1.0 - squares / RADIUS**2, 0.0) / (0.25 + squares)) ** 2
    weights = geometry.fractions[cells] * nearness * anp.maximum(ahead, 0.0) ** 2
    basis = offsets + [offsets[a] * offsets[b] for a in axes for b in axes if b >= a]
    total = gather(weights)
    total = total + (np.asarray(sample(total)) == 0)
    matrix = []
    for i, first in enumerate(basis):
        row = [gather(weights * first * second) for second in basis[: i + 1]]
        row[i] = row[i] + (SLOPE_DAMPING if i < len(widths) else CURVATURE_DAMPING) * total
        matrix.append(row)
    outward: list = [-geometry.normals[a] / widths[a] for a in axes]
    solution = solve_definite(matrix, outward + [0.0] * (len(basis) - len(outward)))
    coefficients = weights * reduce(add, [z[walls] * term for z, term in zip(solution, basis, strict=True)])
    return coefficients, gather(weights * ahead**2)


class _Gap(NamedTuple):
    """The slopes at walls of gaps.

    Attributes
    ----------
    share : array, shape (all walls,)
        The share of the slope in a gap in the slope at the wall.
    distance : array, shape (all walls,)
        d + r, where r = b / a.
    walls, cells : int arrays, shape (pairs,)
    coefficients : array, shape (pairs,)
        -share / distance, times the weights of the mean over the gap.
    first, others : int arrays, shape (pairs of walls,)
    of_difference : array, shape (pairs of walls,)
        What differences between the values at two walls, value / a, add to the slopes.
    """

    share: Any
    distance: Any
    walls: NDArray[np.int64]
    cells: NDArray[np.int64]
    coefficients: Any
    first: NDArray[np.int64]
    others: NDArray[np.int64]
    of_difference: Any


def _gap(grid, geometry, walls, pairs, widths, faces, lack):
    """Return the slopes at walls of gaps.

    Parameters
    ----------
    grid, geometry, walls, pairs, widths, faces
        As above.
    lack : array, shape (m,)
        The least share of the slope in a gap, for each cut cell.
    """
    m = geometry.cut.size
    size = walls.cells.size
    width = 1.0 / anp.sqrt(reduce(add, [(n / h) ** 2 for n, h in zip(walls.normals, widths, strict=True)]))
    has_slope = walls.a[:m] != 0
    thickness = _thickness(grid, geometry, pairs)
    narrowness = has_slope * _smooth_step((WIDE - thickness / width[:m]) / (WIDE - NARROW))
    q = size - m
    share = anp.concatenate([1.0 - (1.0 - narrowness) * (1.0 - lack), np.zeros(q)])
    is_candidate = np.asarray(sample(share)) > 0
    is_candidate[m:] = True
    if q:
        is_candidate[:m] |= are_near(grid, faces.cells, WIDE_REACH).reshape(-1)[geometry.cut] & has_slope
    subset = np.flatnonzero(is_candidate)
    around = _pairs(grid, geometry, walls, widths, subset, WIDE_RADIUS)
    index, others = _pairs_of_walls(grid, walls, around)
    first = around.walls[index]
    steps = _steps_between_walls(grid, walls, around, index, others, widths)
    squares_of_cells = reduce(add, [x**2 for x in around.offsets])
    near = _smooth_step(4.0 * (1.0 - squares_of_cells / WIDE_RADIUS**2))
    kernel = near[index] * anp.maximum(1.0 - reduce(add, [x**2 for x in steps]) / WIDE_RADIUS**2, 0.0) ** 2

    has_u = walls.a != 0
    ratios = walls.b / np.where(has_u, walls.a, 1.0)
    half = anp.concatenate([thickness, WIDE_GRID * width[m:]]) if q else thickness
    shares: Any = np.ones(first.size)
    facing: Any = np.zeros(size)
    if q:
        is_grid_gap = (walls.sides[first] < 0) != (walls.sides[others] < 0)
        products = reduce(add, [normal[first] * normal[others] for normal in walls.normals])
        shares = anp.where(is_grid_gap, anp.maximum(-2.0 * products - 1.0, 0.0) ** 2, 1.0)
        ahead = reduce(add, [x * h[first] * n[first] for x, h, n in zip(steps, widths, walls.normals, strict=True)])
        ahead = 0.5 * (ahead + anp.sqrt(ahead**2 + (THINNEST * width[first]) ** 2))
        gather = sum_at_places(first, size)
        area = walls.areas[others] * shares * kernel
        area_ahead = area * is_grid_gap
        opposite = gather(area_ahead)
        same = gather(area * (walls.sides[first] == walls.sides[others]))
        facing = 1.0 - anp.maximum(1.0 - FACING * opposite / _nonzero(same), 0.0) ** 2
        between = gather(area_ahead * ahead) / _nonzero(opposite)
        half = (1.0 - facing) * half + facing * 0.5 * between
        closeness = facing * _smooth_step((WIDE_GRID - half / width) / (WIDE_GRID - NARROW_GRID))
        share = 1.0 - (1.0 - share) * (1.0 - closeness)
    half = anp.sqrt(half**2 + (THINNEST * width) ** 2)
    length = half / 3.0
    distance = _nonzero(length + ratios)

    # In a gap at a wall of the grid, the mean over the fluid between the walls; else the value in the cell.
    depth_of_cell = anp.sqrt(reduce(add, [(n * h) ** 2 for n, h in zip(walls.normals, widths, strict=True)]))
    ahead_of_wall = [
        x * (h * n / depth_of_cell)[around.walls] for x, h, n in zip(around.offsets, widths, walls.normals, strict=True)
    ]
    depths = reduce(add, ahead_of_wall)
    aside = anp.maximum(1.0 - (squares_of_cells - depths**2), 0.0) ** 2
    across = _smooth_step(2.0 * (2.0 * (half / depth_of_cell)[around.walls] + 1.0 - depths))
    weights = (geometry.fractions * grid.volumes.reshape(-1))[around.cells] * aside * across * near
    gather_cells = sum_at_places(around.walls, size)
    weights = weights * (facing / _nonzero(gather_cells(weights)))[around.walls]
    own = [
        (c.reshape(-1)[walls.cells] - x) / h for c, x, h in zip(grid.centres(), walls.centroids, widths, strict=True)
    ]
    to_centre = [gather_cells(weights * x) + (1.0 - facing) * o for x, o in zip(around.offsets, own, strict=True)]
    numbers = np.concatenate([around.walls, subset])
    cells = np.concatenate([around.cells, walls.cells[subset]])
    coefficients = -(share / distance)[numbers] * anp.concatenate([weights, 1.0 - facing[subset]])
    used = np.flatnonzero(first != others)
    first, others, steps = first[used], others[used], [x[used] for x in steps]
    of_difference = _slopes_of_differences(
        walls, widths, first, others, steps, (shares * kernel)[used], length, to_centre
    )
    inside = half / (half + ratios)
    of_difference = (share * inside / distance)[first] * of_difference
    return _Gap(share, distance, numbers, cells, coefficients, first, others, of_difference)


def _smooth_step(x):
    """Return 0 for x <= 0, 1 for x >= 1, and a smooth function between."""
    x = anp.clip(x, 0.0, 1.0)
    return x**2 * (3.0 - 2.0 * x)


def _nonzero(x):
    """Return an array with 1 in place of 0."""
    return x + (np.asarray(sample(x)) == 0)


def _pairs_of_walls(grid, walls, pairs):
    """Return the pairs of each wall with the walls in the cells around, and with itself.

    Faces on two different sides of the grid are no pair.

    Returns
    -------
    index : int array, shape (pairs of walls,)
        Numbers of the pairs of a wall and a cell.
    others : int array, shape (pairs of walls,)
        Numbers of the walls in these cells.
    """
    indices, others = [np.zeros(0, int)], [np.zeros(0, int)]
    for side in np.unique(walls.sides):
        of_side = np.flatnonzero(walls.sides == side)
        numbers = np.full(grid.cells.size, -1)
        numbers[walls.cells[of_side]] = of_side
        other = numbers[pairs.cells]
        first_side = walls.sides[pairs.walls]
        is_pair = (other >= 0) & ((side < 0) | (first_side < 0) | (first_side == side))
        indices.append(np.flatnonzero(is_pair))
        others.append(other[is_pair])
    return np.concatenate(indices), np.concatenate(others)


def _steps_between_walls(grid, walls, pairs, index, others, widths):
    """Return the steps from walls to the centroids of others, which may be those of images across periodic sides."""
    first = pairs.walls[index]
    centres = [centre.reshape(-1) for centre in grid.centres()]
    return [
        pairs.offsets[a][index] + (walls.centroids[a][others] - centres[a][walls.cells[others]]) / widths[a][first]
        for a in range(grid.dim)
    ]


def _slopes_of_differences(walls, widths, first, others, steps, shares, length, to_centre):
    """Return what differences between the values at two walls add to the slopes, times d: d dl/dn + l(mean) - u_w.

    Parameters
    ----------
    walls, widths
        As above.
    first, others : int arrays, shape (pairs of walls,)
        Numbers of two walls.
    steps : list of arrays, shape (pairs of walls,)
        From the first wall to the other.
    shares : array, shape (pairs of walls,)
        By which the areas of the other walls are multiplied.
    length : array, shape (all walls,)
        The length d.
    to_centre : list of arrays, shape (all walls,)
        From the wall to the mean of the centres of the cells, with the weights of the mean of u.
    """
    axes = range(len(widths))
    weights = walls.areas[others] * (walls.a[others] != 0) * shares
    gather = sum_at_places(first, walls.cells.size)
    total = _nonzero(gather(weights))
    matrix = []
    for i in axes:
        row = [gather(weights * steps[i] * steps[j]) for j in range(i + 1)]
        row[i] = row[i] + VALUE_DAMPING * (length / widths[i]) ** 2 * total
        matrix.append(row)
    right = [to_centre[a] - length * walls.normals[a] / widths[a] for a in axes]
    solution = solve_definite(matrix, right)
    return weights * reduce(add, [z[first] * step for z, step in zip(solution, steps, strict=True)])


def _thickness(grid, geometry, pairs):
    """Return the fluid volume around each wall, divided by the area of the walls there: half of the width of a gap."""
    walls, cells, offsets = pairs
    gather = sum_at_places(walls, geometry.cut.size)
    kernel = anp.maximum(1.0 - reduce(add, [x**2 for x in offsets]) / RADIUS**2, 0.0) ** 2
    areas = sum_at_places(geometry.cut, geometry.fractions.size)(geometry.areas)
    area = gather(kernel * areas[cells])
    has_area = np.asarray(sample(area)) > 0
    volume = gather(kernel * (geometry.fractions * grid.volumes.reshape(-1))[cells])
    return anp.where(has_area, volume, np.max(grid.size, initial=0.0)) / anp.where(has_area, area, 1.0)
