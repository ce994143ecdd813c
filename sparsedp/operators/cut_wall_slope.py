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

The values at the walls differ by the values of the condition, (g_j - g_i) / a, times a L / (a L + b): the share
that falls off between the walls. So linear fields are exact, and so are sources between walls with one value. Between
L = 0.6 and 0.9 cells the slope changes smoothly into the slope of the fit, so that derivatives in the level exist.
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
from sparsedp.operators.small_systems import solve_definite

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.operators.cut_geometry import CutGeometry

__all__ = ["WallSlope", "wall_slope"]

# The polynomial is fitted to the cells around the wall up to this distance, in cell widths. The weights go to 0 there,
# so that the solution is a continuous function of the level.
RADIUS = 2.5
REACH = 3  # number of cells on each side of a cut cell that may be within this distance
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
THINNEST = 1e-3  # half of the width of a gap below which the slope does not become steeper, in cell widths


class WallSlope(NamedTuple):
    """The slope at the wall, out of the fluid, as a linear function of a field u and of the values of the condition.

    It is the sum of coefficients * u[cells] over the pairs of a wall, plus of_value * value, plus the sum of
    of_difference * (value[others] - value[gap_walls]) over the pairs of walls in gaps.

    Attributes
    ----------
    walls, cells : int arrays, shape (pairs,)
        Number of the cut cell, and flat number of the cell of each coefficient.
    coefficients : array, shape (pairs,)
    of_value : array, shape (m,)
        For each cut cell.
    gap_walls, others : int arrays, shape (pairs of walls,)
        Numbers of two cut cells.
    of_difference : array, shape (pairs of walls,)
    """

    walls: NDArray[np.int64]
    cells: NDArray[np.int64]
    coefficients: Any
    of_value: Any
    gap_walls: NDArray[np.int64]
    others: NDArray[np.int64]
    of_difference: Any

    def terms_of_values(self, values: Any) -> Any:
        """Return the part of the slopes that the values of the condition add, shape (..., m)."""
        differences = self.of_difference * (values[..., self.others] - values[..., self.gap_walls])
        return self.of_value * values + sum_at_places(self.gap_walls, np.shape(self.of_value)[0])(differences)


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


def wall_slope(grid: Grid, geometry: CutGeometry, condition: Any) -> WallSlope:
    """Return the slope at the walls of all cut cells; see the module docstring.

    Parameters
    ----------
    grid : Grid
    geometry : CutGeometry
    condition : condition
        dirichlet, neumann or robin, on the wall.
    """
    cut = geometry.cut
    places = np.unravel_index(cut, grid.shape)
    widths = [grid.widths[axis][places[axis]] for axis in range(grid.dim)]
    pairs = _pairs(grid, geometry, widths)
    coefficients, information = _fitted_slopes(geometry, pairs, widths)
    thickness = _thickness(grid, geometry, pairs)
    width = 1.0 / anp.sqrt(reduce(add, [(n / h) ** 2 for n, h in zip(geometry.normals, widths, strict=True)]))

    # The share of the slope in a gap: where the gap is narrow, and where no cell is well in front of the wall.
    narrowness = anp.clip((WIDE - thickness / width) / (WIDE - NARROW), 0.0, 1.0)
    of_width = narrowness**2 * (3.0 - 2.0 * narrowness)
    of_information = anp.maximum(1.0 - information / ENOUGH, 0.0) ** 2
    of_fit = (1.0 - of_width) * (1.0 - of_information)
    in_gaps = np.flatnonzero(np.asarray(sample(of_fit)) < 1.0)
    distance = anp.sqrt((thickness / 3.0) ** 2 + (THINNEST / 3.0 * width) ** 2)
    slopes_in_gaps = -(1.0 - of_fit[in_gaps]) / distance[in_gaps]

    walls = np.concatenate([pairs.walls, in_gaps])
    cells = np.concatenate([pairs.cells, cut[in_gaps]])
    slopes = anp.concatenate([of_fit[pairs.walls] * coefficients, slopes_in_gaps])
    of_u = sum_at_places(walls, cut.size)(slopes)
    denominator = condition.a - condition.b * of_u
    gap_walls, others, of_difference = _slopes_of_differences(grid, geometry, pairs, widths, distance)
    inside_gap = condition.a * 3.0 * distance / (condition.a * 3.0 * distance + condition.b)
    of_difference = of_difference * ((1.0 - of_fit) * inside_gap / denominator)[gap_walls]
    return WallSlope(
        walls,
        cells,
        slopes * (condition.a / denominator)[walls],
        -of_u / denominator,
        gap_walls,
        others,
        of_difference,
    )


def _pairs(grid, geometry, widths) -> Pairs:
    """Return the pairs of each cut cell with the fluid cells, and with the cut cells, up to the distance RADIUS."""
    places: Any = np.unravel_index(geometry.cut, grid.shape)
    steps = np.array(list(product(range(-REACH, REACH + 1), repeat=grid.dim)))
    is_near = np.ones((len(steps), geometry.cut.size), bool)
    squares = np.zeros(is_near.shape)
    positions = []
    indices = []
    for axis, n in enumerate(grid.shape):
        turns, index = np.divmod(places[axis] + steps[:, axis, None], n)
        if not grid.periodic[axis]:
            is_near &= turns == 0
        positions.append(grid.coordinates(axis)[index] + turns * grid.size[axis])
        indices.append(index)
        squares += ((positions[axis] - np.asarray(sample(geometry.centroids[axis]))) / widths[axis]) ** 2
    cells: Any = np.ravel_multi_index(indices, grid.shape)
    is_in_use = np.asarray(sample(geometry.fractions)) > 0
    is_in_use[geometry.cut] = True
    is_near &= is_in_use[cells] & (squares < RADIUS**2)
    _, walls = np.nonzero(is_near)
    offsets = [
        (positions[axis][is_near] - geometry.centroids[axis][walls]) / widths[axis][walls] for axis in range(grid.dim)
    ]
    return Pairs(walls, cells[is_near], offsets)


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


def _slopes_of_differences(grid, geometry, pairs, widths, distance):
    """Return what differences between the values at two walls add to the slopes: dl/dn + (l(centre) - u_w) / (L/3).

    Parameters
    ----------
    grid, geometry, pairs, widths
        As above.
    distance : array, shape (m,)
        L/3 for each cut cell.

    Returns
    -------
    walls, others : int arrays, shape (pairs of walls,)
    coefficients : array, shape (pairs of walls,)
    """
    cut = geometry.cut
    axes = range(grid.dim)
    numbers = np.full(grid.cells.size, -1)
    numbers[cut] = np.arange(cut.size)
    is_pair = (numbers[pairs.cells] >= 0) & (cut[pairs.walls] != pairs.cells)
    walls = pairs.walls[is_pair]
    others = numbers[pairs.cells[is_pair]]
    centres = [centre.reshape(-1) for centre in grid.centres()]
    # From the wall to the centroid of the other wall, which may be that of an image across a periodic side.
    steps = [
        pairs.offsets[a][is_pair] + (geometry.centroids[a][others] - centres[a][cut[others]]) / widths[a][walls]
        for a in axes
    ]
    to_centre = [(centres[a][cut] - geometry.centroids[a]) / widths[a] for a in axes]
    weights = geometry.areas[others] * anp.maximum(1.0 - reduce(add, [x**2 for x in steps]) / RADIUS**2, 0.0) ** 2
    gather = sum_at_places(walls, cut.size)
    total = gather(weights)
    total = total + (np.asarray(sample(total)) == 0)
    matrix = []
    for i in axes:
        row = [gather(weights * steps[i] * steps[j]) for j in range(i + 1)]
        row[i] = row[i] + VALUE_DAMPING * (distance / widths[i]) ** 2 * total
        matrix.append(row)
    right = [-geometry.normals[a] / widths[a] + to_centre[a] / distance for a in axes]
    solution = solve_definite(matrix, right)
    return walls, others, weights * reduce(add, [z[walls] * step for z, step in zip(solution, steps, strict=True)])


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
