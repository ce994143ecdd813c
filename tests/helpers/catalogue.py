"""Every operator once. One line here buys a new operator all the free tests of test_operators.py.

An entry names its public builder, how to make it on a grid, and (where the theory gives one) the
exact function that it approximates, so that the order of accuracy is tested as well. One that does not
depend on the boundary calls it `_`, and is made once on a grid.
"""

import inspect
from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from fields import Field

import sparsedp as dp


class Entry(NamedTuple):
    builder: str
    make: Callable  # (grid, boundary) -> Operator
    exact: Callable | None = None  # (Field, grid, boundary) -> (input values, wanted result)
    least_dim: int = 1

    def conditions(self, boundaries):
        """Those for which it is made: one when it does not look at them."""
        if inspect.signature(self.make).parameters.keys() - {"_"} >= {"boundary"}:
            return boundaries
        return boundaries[:1]


def solid(grid):
    """A fixed obstacle: about a quarter of the cells."""
    return np.random.default_rng(7).random(grid.shape) < 0.25


def points(grid):
    """One point for each index, at a fixed place inside the cells of the diagonal."""
    n = min(grid.shape)
    return np.stack([grid.coordinates(a)[:n] + 0.3 * grid.widths[a][:n] for a in range(grid.dim)], axis=1)


def factors(grid):
    """A factor for each axis that divides it."""
    return tuple(next((f for f in (2, 3) if n % f == 0), 1) for n in grid.shape)


def advection_diffusion(grid, boundary):
    """A non-symmetric composition that stays factor-defined."""
    return 0.5 * dp.upwind(grid, 0, 1, boundary) - dp.divergence(grid) @ dp.gradient(grid, boundary)


def masked_product(grid, boundary):
    """A lazy chain: a mask and a diagonal between factor-defined operators."""
    weights = dp.diagonal(grid.faces, 1 + np.arange(grid.faces.size))
    return dp.divergence(grid) @ dp.interior(grid) @ weights @ dp.gradient(grid, boundary)


CATALOGUE = [
    Entry("gradient", dp.gradient, Field.slopes),
    Entry("gradient", lambda grid, boundary: dp.gradient(grid, boundary, solid(grid))),
    Entry("gradient", lambda grid, boundary: dp.gradient(grid, boundary, solid(grid), dp.dirichlet)),
    Entry("divergence", lambda grid, _: dp.divergence(grid), Field.outflow),
    Entry("flux", lambda grid, _: dp.flux(grid, solid(grid))),
    Entry("laplacian", dp.laplacian, Field.laplacian),
    Entry("laplacian", lambda grid, boundary: dp.laplacian(grid, boundary, solid(grid), dp.robin(2, 1))),
    Entry("curl", lambda grid, _: dp.curl(grid), Field.curl, least_dim=2),
    Entry("upwind", lambda grid, boundary: dp.upwind(grid, 0, 1, boundary), Field.first_slope),
    Entry("upwind", lambda grid, boundary: dp.upwind(grid, grid.dim - 1, -1, boundary)),
    Entry("average", dp.average, Field.face_values),
    Entry("sample", lambda grid, _: dp.sample(grid, points(grid)), Field.at_points),
    Entry("restrict", lambda grid, _: dp.restrict(grid, factors(grid)), Field.coarse_values),
    Entry("prolong", lambda grid, _: dp.prolong(grid, factors(grid))),
    Entry("prolong", lambda grid, _: dp.prolong(grid, factors(grid), "linear"), Field.fine_values),
    Entry("component", lambda grid, _: dp.component(grid, grid.dim - 1)),
    Entry("lift", dp.lift),
    Entry("face_laplacian", lambda grid, _: dp.face_laplacian(grid, dp.free_slip)),
    Entry("face_laplacian", lambda grid, _: dp.face_laplacian(grid, dp.no_slip, solid(grid), dp.free_slip)),
    Entry("face_lift", lambda grid, _: dp.face_lift(grid)),
    Entry("mask", lambda grid, _: dp.mask(grid.cells, solid(grid))),
    Entry("interior", lambda grid, _: dp.interior(grid, solid(grid))),
    Entry("identity", lambda grid, _: dp.identity(grid.edges)),
    Entry("diagonal", lambda grid, _: dp.diagonal(grid.cells, 1.0 + np.arange(grid.cells.size).reshape(grid.shape))),
    Entry("from_matrix", lambda grid, boundary: dp.from_matrix(dp.laplacian(grid, boundary).matrix)),
    Entry(
        "from_linear_operator",
        lambda grid, boundary: dp.from_linear_operator(dp.gradient(grid, boundary).to_scipy(), grid.cells, grid.faces),
    ),
    Entry(
        "from_functions",
        lambda grid, _: dp.from_functions(lambda u: 2 * u, lambda g: 2 * g, grid.cells, grid.cells, name="double"),
    ),
    Entry("divergence", advection_diffusion),
    Entry("diagonal", masked_product),
]

# What is nonlinear in its argument is a rule, not an Operator: (builder, how to make it on a grid).
RULES = [("harmonic_average", dp.harmonic_average)]

LABELS = [f"{entry.builder}-{number}" for number, entry in enumerate(CATALOGUE)]
SHAPES = [(9,), (1,), (2,), (6, 4), (1, 5), (2, 2), (4, 3, 5), (1, 2, 1)]


def grids(shape, rng):
    """The shape with every combination of periodic axes, uniform and stretched."""
    for periodic in product((False, True), repeat=len(shape)):
        yield dp.Grid(shape, spacing=0.3, origin=-0.2, periodic=periodic)
        yield dp.Grid(shape, spacing=[rng.uniform(0.5, 2.0, n) for n in shape], periodic=periodic)


def boundaries(grid):
    """Every kind of condition, alone and mixed on the two sides of each axis."""
    mixed = {name: (dp.dirichlet, dp.robin(1, 2)) for name, periodic in zip(grid.axes, grid.periodic) if not periodic}
    half = dict.fromkeys(list(mixed)[:1], (dp.neumann, dp.dirichlet))
    return [dp.neumann, dp.dirichlet, dp.robin(2.0, 0.5), mixed, half]
