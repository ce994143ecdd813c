"""Where the points of a field are, what lies around them, and how a solid is filled: for schemes that look back.

Beyond a wall the field goes on with the value of the nearest point (neumann) or with the inflow
value (dirichlet), as if that stood one spacing away from the last point. A sample in a solid cell has
the mean of the cells next to it that are fluid or filled already, layer by layer inwards: what a
neumann wall does too. Faces that touch a solid keep their value and lend it to others.
"""

from math import prod

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.law import component_shapes
from sparsedp.conditions import neumann
from sparsedp.kernels.sampling import LIKE, Points, layers

__all__ = ["filling", "points_of"]

WIDTH = {"linear": 2, "cubic": 4}


def points_of(setting, interpolation, closed=False):
    """Setting -> Points of every component; `closed`: go on with the nearest point at all walls."""
    found, wall = [], 0
    for shape in component_shapes(setting):
        sources = _sources(setting.sides, shape, layers(WIDTH[interpolation]), wall, closed)
        found.append(_points(setting.sides, shape, WIDTH[interpolation], sources))
        wall += sum(2 * prod(shape) // n for n, pair in zip(shape, setting.sides, strict=True) if pair)
    return found


def _points(sides, shape, width, sources):
    absent, pad = 3 - len(shape), layers(width)
    inside = np.zeros(sources.shape, bool)
    inside[tuple(slice(pad, pad + n) for n in shape)] = True
    targets = np.flatnonzero(~inside)
    wide = (1,) * absent + sources.shape
    return Points(
        (1,) * absent + tuple(shape),
        (False,) * absent + tuple(pair is None for pair in sides),
        (LIKE[1],) * absent + (LIKE[width],) * len(shape),
        (wide[1] * wide[2], wide[2]),
        int(np.argmax(inside)),
        sources.size,
        targets,
        sources.ravel()[targets],
    )


def _sources(sides, shape, pad, wall, closed):
    """For every sample the number of its point, or points + number of its inflow value."""
    points = _extended(np.arange(prod(shape)).reshape(shape), sides, [pad] * len(shape))
    wall += prod(shape)
    for axis, pair in enumerate(sides):
        for side, condition in enumerate(pair or ()):
            plate = np.arange(prod(shape) // shape[axis]).reshape([1 if a == axis else n for a, n in enumerate(shape)])
            if condition != neumann and not closed:
                around = [0 if a == axis else pad for a in range(len(shape))]
                layer = slice(pad) if side == 0 else slice(pad + shape[axis], None)
                points[(slice(None),) * axis + (layer,)] = wall + _extended(plate, sides, around)
            wall += plate.size
    return points


def _extended(numbers, sides, pads):
    for axis, (pair, pad) in enumerate(zip(sides, pads, strict=True)):
        around = [(pad, pad) if a == axis else (0, 0) for a in range(numbers.ndim)]
        numbers = np.pad(numbers, around, mode="wrap" if pair is None else "edge")
    return numbers


def filling(solid, periodic):
    """Solid cells -> csr_array that leaves fluid cells alone and fills the others from them."""
    known, total = ~solid, sp.eye_array(solid.size, format="csr")
    pairs = _neighbours(solid.shape, periodic)
    while True:
        here, there = pairs[:, (~known.ravel()[pairs[0]]) & known.ravel()[pairs[1]]]
        if not here.size:  # all is filled, or there is no fluid to fill it from
            return total
        layer = sp.csr_array((np.ones(here.size), (here, there)), (solid.size,) * 2)
        share = np.asarray(layer.sum(axis=1)).ravel()
        keep = sp.diags_array((share == 0).astype(float))
        total = sp.csr_array((sp.diags_array(1 / np.maximum(share, 1)) @ layer + keep) @ total)
        known = known | (share > 0).reshape(known.shape)


def _neighbours(shape, periodic):
    """Pairs (cell, cell beside it), both ways round."""
    cells, found = np.arange(prod(shape)).reshape(shape), []
    for axis, wraps in enumerate(periodic):
        line = np.arange(shape[axis] if wraps else shape[axis] - 1)
        one, two = (np.take(cells, (line + k) % shape[axis], axis).ravel() for k in (0, 1))
        found += [np.stack([one, two]), np.stack([two, one])]
    return np.concatenate(found, axis=1)
