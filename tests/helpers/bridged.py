"""Functions of this library that test_interop_torch.py and test_interop_jax.py take across, with their arguments."""

import autograd.numpy as anp
import numpy as np

import sparsedp as dp

GRID = dp.Grid((5, 4), size=1.0)
L = dp.laplacian(GRID)
INVERSE = dp.inverse(dp.identity(GRID.cells) - L)


def numbers(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


def heated(u, p):
    """A rollout of a nonlinear step, with a tree of parameters."""
    return dp.rollout(lambda u, p: u + 0.002 * p["k"] * L(anp.exp(0.1 * u)) + p["b"], u, p, 3)


def in_trees(p):
    return {"a": anp.sin(p["x"]) * p["y"], "more": (anp.sum(p["x"] ** 2 * p["y"]), p["x"])}


def gradient_with_a_reused_constant(f):
    """Return the gradient in a = (1, 1) of sums of f(a, w), where w is overwritten between the calls and afterwards."""
    work = np.array([2.0, 3.0])

    def loss(a):
        total = 0.0
        for k in (1.0, 2.0):
            work[:] = [k, 2 * k]
            total = total + anp.sum(f(a, work))
        work[:] = np.nan
        return total

    return dp.grad(loss)(np.array([1.0, 1.0]))


FIELD = numbers(*GRID.shape)
SIDES = np.exp(0.3 * numbers(GRID.faces.size))
SCENES = {  # function of arrays, its arguments
    "operator": (dp.gradient(GRID), (FIELD,)),
    "inverse": (INVERSE, (FIELD,)),
    "elliptic_solver": (dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet)), (SIDES, FIELD)),
    "rollout": (heated, (FIELD, {"k": np.asarray(1.5), "b": numbers(*GRID.shape, seed=2)})),
    "trees": (in_trees, ({"x": numbers(3), "y": numbers(3, seed=3)},)),
    "complex": (lambda z: anp.exp(1j * z) * z, (numbers(3) + 1j * numbers(3, seed=4),)),
}
