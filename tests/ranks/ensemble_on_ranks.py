"""An ensemble by the workers of mpi4py: the bits that one process has, call after call, on any number of them.

mpirun -n 3 python -m mpi4py tests/ranks/ensemble_on_ranks.py
"""

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI
from mpi4py.futures import MPICommExecutor

import sparsedp as dp
from sparsedp._utils.pytree import leaves

GRID = dp.Grid((6, 5), size=1.0)
SOLVE = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
RNG = np.random.default_rng(3)
SCENES = list(RNG.random((7, *GRID.shape)))
WEIGHTS = RNG.random(7)
X, T = ({"k": RNG.random(GRID.faces.size), "s": s} for s in (2.0, 1.0))


def loss(x, b):
    if np.sum(b) < 0:
        raise dp.errors.NonFiniteError("planted")
    return x["s"] ** 3 * anp.sum(SOLVE(anp.exp(x["k"]), b) ** 2)


def bits(total, factor):
    """Value, gradient and Hessian product at a multiple of X."""
    x = {name: factor * value for name, value in X.items()}
    return [np.asarray(part).tobytes() for part in leaves((dp.value_and_grad(total)(x), dp.hvp(total, x, T)))]


if __name__ == "__main__":
    with MPICommExecutor(MPI.COMM_WORLD, root=0) as executor:
        if executor is not None:  # the root; all others work
            for chunk in (1, 3):
                here, there = (dp.ensemble(loss, SCENES, some, WEIGHTS, chunk) for some in (None, executor))
                assert all(bits(here, factor) == bits(there, factor) for factor in (1.0, 0.7, 0.5, 0.4))
            try:
                dp.ensemble(loss, [*SCENES, -SCENES[0]], executor)(X)
                raise AssertionError("nothing was raised")
            except dp.errors.NonFiniteError as error:
                assert str(error) == "scene 7 of 8: planted", error
            print("all agree")
