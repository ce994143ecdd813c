"""Expressions of linear operators as nested tuples: built by the library, and filled by loops as dense matrices.

An expression is a tuple (name, *arguments):

    ("gradient", sides, solid, side of the solid), ("divergence",), ("average", sides),
    ("laplacian", sides, solid, side of the solid), ("upwind", sides, axis, direction),
    ("interior", solid), ("face_laplacian", sides, solid, word), ("projection", sides, solid),
    ("diagonal", kind, seed), ("mask", kind, seed), ("identity", kind), ("blocks", factors), ("probe", seed),
    ("matrix", kind, seed), ("functions", kind, seed),
    ("scale", number, expression), ("sum", one, other), ("product", outer, inner), ("transpose", expression).
"""

from functools import lru_cache, reduce
from itertools import product

import numpy as np

import sparsedp as dp
from campaign.boxes import boundary, condition, dense, numbers, obstacle


def operator(box, expression):
    """Return the Operator of an expression."""
    name, *arguments = expression
    return BUILDERS[name](box, *arguments)


@lru_cache(maxsize=512)
def matrix(box, expression):
    """Return the dense matrix of an expression."""
    name, *arguments = expression
    return MATRICES[name](box, *arguments)


def space(box, kind):
    grid = box.grid()
    if kind == "cells":
        return grid.cells
    return grid.faces


def given_entries(box, kind, seed):
    """Return a small sparse matrix without structure, as a dense array."""
    size = space(box, kind).size
    entries = numbers(seed, (size, size))
    kept = np.random.default_rng(seed + 1).random((size, size)) < 0.2
    return entries * kept


def weights_of(box, kind, seed):
    return numbers(seed, space(box, kind).shape)


def flags_of(box, kind, seed):
    return np.random.default_rng(seed).random(space(box, kind).shape) < 0.6


def probe_points(box, seed):
    """Return points between the first and the last cell centre of each axis, as (cell below, share of the next)."""
    rng = np.random.default_rng(seed)
    points = []
    for _ in range(3):
        point = []
        for cells in box.shape:
            if cells == 1:
                point.append((0, 0.0))
            else:
                point.append((int(rng.integers(cells - 1)), float(rng.uniform(0.05, 0.95))))
        points.append(point)
    return points


# ---- by the library ------------------------------------------------------------------------------------------------


def build_probe(box, seed):
    grid = box.grid()
    coordinates = []
    for point in probe_points(box, seed):
        place = []
        for axis, (cell, share) in enumerate(point):
            centres = grid.coordinates(axis)
            upper = centres[cell + 1] if share else centres[cell]
            place.append((1 - share) * centres[cell] + share * upper)
        coordinates.append(place)
    return dp.sample(grid, np.array(coordinates))


def build_functions(box, kind, seed):
    given = given_entries(box, kind, seed)
    shape = space(box, kind).shape

    def forward(u):
        return (given @ u.reshape(-1)).reshape(shape)

    def transpose(g):
        return (given.T @ g.reshape(-1)).reshape(shape)

    return dp.from_functions(forward, transpose, space(box, kind), space(box, kind), name="given")


BUILDERS = {
    "gradient": lambda box, sides, solid, side: dp.gradient(
        box.grid(), boundary(box, sides), obstacle(box, solid), condition(side)
    ),
    "divergence": lambda box: dp.divergence(box.grid()),
    "average": lambda box, sides: dp.average(box.grid(), boundary(box, sides)),
    "laplacian": lambda box, sides, solid, side: dp.laplacian(
        box.grid(), boundary(box, sides), obstacle(box, solid), condition(side)
    ),
    "upwind": lambda box, sides, axis, direction: dp.upwind(box.grid(), axis, direction, boundary(box, sides)),
    "interior": lambda box, solid: dp.interior(box.grid(), obstacle(box, solid)),
    "face_laplacian": lambda box, sides, solid, word: dp.face_laplacian(
        box.grid(), boundary(box, sides), obstacle(box, solid), condition(word)
    ),
    "projection": lambda box, sides, solid: dp.projection(
        box.grid(), obstacle(box, solid), boundary(box, sides), rtol=1e-12
    ),
    "diagonal": lambda box, kind, seed: dp.diagonal(space(box, kind), weights_of(box, kind, seed)),
    "mask": lambda box, kind, seed: dp.mask(space(box, kind), flags_of(box, kind, seed)),
    "identity": lambda box, kind: dp.identity(space(box, kind)),
    "blocks": lambda box, factors: dp.prolong(box.grid(), factors) @ dp.restrict(box.grid(), factors),
    "probe": build_probe,
    "matrix": lambda box, kind, seed: dp.from_matrix(
        given_entries(box, kind, seed), space(box, kind), space(box, kind)
    ),
    "functions": build_functions,
    "scale": lambda box, number, inner: number * operator(box, inner),
    "sum": lambda box, one, other: operator(box, one) + operator(box, other),
    "product": lambda box, outer, inner: operator(box, outer) @ operator(box, inner),
    "transpose": lambda box, inner: operator(box, inner).T,
}


# ---- by loops ------------------------------------------------------------------------------------------------------


def fill_upwind(box, sides, axis, direction):
    """The slope on the lower face of each cell, or on its upper face for direction -1."""
    table = dense(box, sides)
    slopes = table.gradient()
    rows = np.zeros((len(table.cells), slopes.shape[1]))
    for place, row in table.cells.items():
        index = place[axis] if direction == 1 else place[axis] + 1
        rows[row] = slopes[table.face(axis, place, index)]
    return rows


def fill_blocks(box, factors):
    """The mean over each block of cells, weighted by volume, given back to each cell of it."""
    table = dense(box)
    places = list(table.cells)
    volumes = np.array([np.prod([table.width(place, axis) for axis in range(box.dim)]) for place in places])
    block = [tuple(index // factor for index, factor in zip(place, factors)) for place in places]
    means = np.zeros((len(places), len(places)))
    for row, one in enumerate(block):
        members = np.array([other == one for other in block])
        means[row] = members * volumes / volumes[members].sum()
    return means


def fill_probe(box, seed):
    """Multilinear interpolation between the centres of cells."""
    rows = []
    for point in probe_points(box, seed):
        row = np.zeros(box.shape)
        for corner in product((0, 1), repeat=box.dim):
            weight = np.prod([share if up else 1 - share for up, (_, share) in zip(corner, point)])
            if weight:
                row[tuple(cell + up for up, (cell, _) in zip(corner, point))] += weight
        rows.append(row.ravel())
    return np.array(rows)


MATRICES = {
    "gradient": lambda box, sides, solid, side: dense(box, sides, solid).gradient(condition(side)),
    "divergence": lambda box: dense(box).divergence(),
    "average": lambda box, sides: dense(box, sides).average(),
    "laplacian": lambda box, sides, solid, side: (
        dense(box).divergence() @ dense(box, sides, solid).gradient(condition(side))
    ),
    "upwind": fill_upwind,
    "interior": lambda box, solid: np.diag(1.0 * dense(box, None, solid).flags(())),
    "face_laplacian": lambda box, sides, solid, word: dense(box, sides, solid).viscous(condition(word)),
    "projection": lambda box, sides, solid: dense(box, sides, solid).projection()[0],
    "diagonal": lambda box, kind, seed: np.diag(weights_of(box, kind, seed).ravel()),
    "mask": lambda box, kind, seed: np.diag(1.0 * flags_of(box, kind, seed).ravel()),
    "identity": lambda box, kind: np.eye(space(box, kind).size),
    "blocks": fill_blocks,
    "probe": fill_probe,
    "matrix": given_entries,
    "functions": given_entries,
    "scale": lambda box, number, inner: number * matrix(box, inner),
    "sum": lambda box, one, other: matrix(box, one) + matrix(box, other),
    "product": lambda box, outer, inner: matrix(box, outer) @ matrix(box, inner),
    "transpose": lambda box, inner: matrix(box, inner).T,
}


def bound(box, expression):
    """Return the largest sum of magnitudes in a row or column of the matrix, at least 1."""
    magnitudes = np.abs(matrix(box, expression))
    return float(max(1.0, magnitudes.sum(0).max(), magnitudes.sum(1).max()))


def total(members):
    """Return the sum of expressions as one expression."""
    return reduce(lambda one, other: ("sum", one, other), members)
