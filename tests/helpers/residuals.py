"""Nonlinear systems for tests of roots: their residual, a guess, parameters of every kind."""

from dataclasses import dataclass
from typing import Any

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from sparsedp._utils.pytree import flatten, leaves


@dataclass(frozen=True)
class Problem:
    """residual(x, params) = 0, solved from a guess; `scale` is the size of its data."""

    residual: Any
    guess: Any
    params: Any
    scale: float

    def loss(self, root):
        """A smooth function of the root that sees every number of it."""

        def measured(params):
            parts = leaves(root(self.guess, params))
            return sum(
                anp.sum(
                    anp.cos(np.arange(np.size(self.guess_of(n)))).reshape(np.shape(self.guess_of(n))) * part + part**2
                )
                for n, part in enumerate(parts)
            )

        return measured

    def guess_of(self, number):
        return leaves(self.guess)[number]


def field(shape, shift=0.0):
    return np.sin(1.3 * np.arange(np.prod(shape)) + shift).reshape(shape)


def diffusion(shape):
    """-div((1 + c u^2) grad u) + r u^3 = f, u = 0 on the walls."""
    grid = dp.Grid(shape, size=1.0)
    G = dp.gradient(grid, dp.dirichlet)
    D = dp.divergence(grid)
    A = dp.average(grid, dp.dirichlet)

    def residual(u, p):
        return -D((1 + p["c"] * A(u) ** 2) * G(u)) + p["reaction"][0] * u**3 - p["f"]

    params = {"c": 0.8, "reaction": (2.0, 3), "f": 20 * (field(grid.shape) + 1)}
    return Problem(residual, np.zeros(grid.shape), params, 400.0)


def advection():
    """u u' - nu u'' = f, one-sided first differences: a Jacobian that is not symmetric."""
    grid = dp.Grid(25, size=1.0)
    first = dp.upwind(grid, boundary=dp.dirichlet)
    second = dp.laplacian(grid, dp.dirichlet)

    def residual(u, p):
        return (1.0 + u) * first(u) - p["nu"] * second(u) - p["f"]

    return Problem(residual, np.zeros(25), {"nu": 0.3, "f": 3 * (field(25) + 1)}, 100.0)


def backward_euler():
    """One implicit step of u' = nu lap u - u^3 from a state that is a parameter, too."""
    grid = dp.Grid(18, size=1.0, periodic=True)
    second = dp.laplacian(grid)

    def residual(u, p):
        return u - p["old"] - p["dt"] * (p["nu"] * second(u) - u**3)

    return Problem(residual, field(18), {"old": field(18), "nu": np.array(0.02), "dt": 0.1}, 1.0)


def two_fields():
    """A tree of two fields of different shapes: u diffuses and feeds one number, the level."""
    second = dp.laplacian(dp.Grid(20, size=1.0), dp.dirichlet)

    def residual(x, p):
        u = x["u"]
        level = x["level"]
        return p["f"] - 0.1 * second(u) + anp.exp(0.1 * u) * level, level**3 + level - p["a"] * anp.sum(u)

    return Problem(residual, {"u": np.zeros(20), "level": 0.5}, {"a": 0.05, "f": 3 * field(20)}, 40.0)


def stacked_fields():
    """Two species that react and diffuse, as one array of shape (2, n)."""
    second = dp.laplacian(dp.Grid(15, size=1.0))

    def residual(x, p):
        u = x[0]
        v = x[1]
        return anp.stack(
            [
                u * (1 + v**2) - p["k"] * second(u) - p["f"],
                v - u**2 / (1 + u**2) - 0.1 * second(v) * p["k"],
            ]
        )

    return Problem(residual, np.ones((2, 15)), {"k": 0.05, "f": 2 + field(15)}, 10.0)


def scalar():
    """Kepler's equation."""
    return Problem(lambda x, p: x - p["e"] * anp.sin(x) - p["m"], 1.0, {"e": 0.6, "m": 0.9}, 1.0)


PROBLEMS = {
    "diffusion 1-D": lambda: diffusion((20,)),
    "diffusion 2-D": lambda: diffusion((6, 5)),
    "advection 1-D": advection,
    "backward Euler": backward_euler,
    "fields in a tree": two_fields,
    "fields in one array": stacked_fields,
    "one number": scalar,
}


# ---- Taylor tests ------------------------------------------------------------------------------------------------


def directions(params):
    """A direction of the size of the parameters; whole numbers do not move."""
    found, rebuild = flatten(params)
    return rebuild(
        0.0 if isinstance(leaf, int) else 0.5 * (1 + np.max(np.abs(leaf))) * np.cos(1.0 + field(np.shape(leaf), number))
        for number, leaf in enumerate(found)
    )


def moved(params, h, direction):
    """params + h direction."""
    found, rebuild = flatten(params)
    steps = leaves(direction)
    return rebuild(leaf if isinstance(leaf, int) else leaf + h * step for leaf, step in zip(found, steps))


def dot(one, other):
    """Inner product of two trees; None and what belongs to whole numbers count as 0."""
    pairs = zip(leaves(one), leaves(other), strict=True)
    return sum(anp.sum(a * b) for a, b in pairs if a is not None and b is not None)


def rate(remainder, start=0.01, levels=4):
    """Smallest order of decrease over halvings of h."""
    values = [abs(remainder(start / 2**level)) for level in range(levels)]
    return min(np.log2(a / b) for a, b in zip(values, values[1:]))
