"""The slope of a velocity component at the wall of a body, from the values on the faces in front of it.

A polynomial through the value u_w at the centroid of the wall is fitted to the values on the faces around it, by
weighted least squares: all terms of degree 1 and 2, and the cube of the distance from the tangent plane. Its slope is

    du/dn = sum of s_j (u_j - u_w),        n points out of the fluid.

The weight of a face is proportional to its aperture and decreases to 0 with the distance, so that the slope is a
continuous function of the level. Only faces in front of the wall take part.
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

    from sparsedp.flow.cut_faces import Walls
    from sparsedp.grid.grid import Grid

__all__ = ["WallFit", "wall_fit"]

RADIUS = 2.5  # faces up to this distance take part, in cell widths
REACH = 3  # number of faces on each side of a wall that may be within this distance
SLOPE_DAMPING = 1e-10  # regularization of the fit relative to the sum of the weights: of slopes
CURVATURE_DAMPING = 1e-4  # and of all other coefficients
# The weighted sum of squared distances of faces from the wall, in cell widths, from which on the fit alone is used.
ENOUGH = 0.4


class WallFit(NamedTuple):
    """The slopes at walls: sum of weights * (u[faces] - u_w).

    Attributes
    ----------
    walls, faces : int arrays, shape (pairs,)
        Number of the wall, and flat number of the face among the faces of the component.
    weights : array, shape (pairs,)
    """

    walls: NDArray[np.int64]
    faces: NDArray[np.int64]
    weights: Any


def wall_fit(grid: Grid, component: int, walls: Walls, apertures: Any, centres: Any) -> WallFit:
    """Return the fit of a velocity component to its walls.

    Parameters
    ----------
    grid : Grid
    component : int
    walls : Walls
    apertures, centres : arrays, flat, one value for each face of the component
        Open fraction, and the coordinate of the centre of the open part along the other axis.
    """
    m = walls.places.size
    number, faces, positions, widths = _faces_in_front(grid, component, walls, apertures, centres)
    r = [(positions[a] - walls.centroids[a][number]) / widths[a][number] for a in (0, 1)]
    ahead = reduce(add, [r[a] * walls.normals[a][number] for a in (0, 1)])
    squares = reduce(add, [x**2 for x in r])
    nearness = (anp.maximum(1.0 - squares / RADIUS**2, 0.0) / (0.25 + squares)) ** 2
    weights = apertures[faces] * nearness * anp.maximum(ahead, 0.0) ** 2
    basis = [r[0], r[1], r[0] ** 2, r[0] * r[1], r[1] ** 2, ahead**3]

    gather = sum_at_places(number, m)
    total = gather(weights)
    total = total + (np.asarray(sample(total)) == 0)
    matrix = []
    for i, first in enumerate(basis):
        row = [gather(weights * first * second) for second in basis[: i + 1]]
        row[i] = row[i] + (SLOPE_DAMPING if i < 2 else CURVATURE_DAMPING) * total
        matrix.append(row)
    outward = [-walls.normals[a] / widths[a] for a in (0, 1)]
    solution = solve_definite(matrix, outward + [0.0] * (len(basis) - 2))
    slopes = weights * reduce(add, [z[number] * term for z, term in zip(solution, basis, strict=True)])

    # Where no face is well in front of the wall, extrapolation would be unstable: there the slope goes over to that
    # between the wall and the face of the control volume itself.
    information = gather(weights * ahead**2)
    blind = anp.maximum(1.0 - information / ENOUGH, 0.0) ** 2
    slopes = slopes * (1.0 - blind)[number]
    own = np.flatnonzero(np.asarray(sample(blind)) > 0)
    smallest = np.minimum(*widths)
    return WallFit(
        np.concatenate([number, own]),
        np.concatenate([faces, walls.places[own]]),
        anp.concatenate([slopes, -blind[own] / smallest[own]]),
    )


def _faces_in_front(grid, component, walls, apertures, centres):
    """Return pairs of a wall and an open face in front of it.

    Returns
    -------
    number, faces : int arrays, shape (pairs,)
    positions : list of arrays, shape (pairs,)
        Coordinates of the centres of the open parts; across a periodic side, of the image next to the wall.
    widths : list of arrays, shape (m,)
        Widths of the control volumes.
    """
    shape = grid.face_shape(component)
    places: Any = np.unravel_index(walls.places, shape)
    offsets = np.array(list(product(range(-REACH, REACH + 1), repeat=2)))
    chosen = np.ones((len(offsets), walls.places.size), bool)
    turns = []
    wrapped = []
    for axis, n in enumerate(shape):
        turn, index = np.divmod(places[axis] + offsets[:, axis, None], n)
        if not grid.periodic[axis]:
            chosen &= turn == 0
        turns.append(turn * grid.size[axis])
        wrapped.append(index)
    faces: Any = np.ravel_multi_index(wrapped, shape)
    lines = np.broadcast_to(np.expand_dims(grid.coordinates(component, "nodes"), 1 - component), shape).reshape(-1)
    coordinates = [lines, centres] if component == 0 else [centres, lines]
    ahead = np.zeros(chosen.shape)
    widths = []
    for axis in (0, 1):
        lengths = grid.spacings(axis) if axis == component else grid.widths[axis]
        widths.append(lengths[places[axis]])
        positions = np.asarray(sample(coordinates[axis]))[faces] + turns[axis]
        distance = (positions - np.asarray(sample(walls.centroids[axis]))) / widths[axis]
        ahead += distance * np.asarray(sample(walls.normals[axis]))
    chosen &= (np.asarray(sample(apertures))[faces] > 0) & (ahead > 0)
    _, number = np.nonzero(chosen)
    faces = faces[chosen]
    return number, faces, [coordinates[axis][faces] + turns[axis][chosen] for axis in (0, 1)], widths
