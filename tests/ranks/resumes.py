"""A run of minimize that was begun on another number of ranks: n iterations of it, to and from a folder.

    mpirun -n 2 python -m mpi4py tests/ranks/resumes.py FOLDER 8

Rank 0 prints what was resumed, the value, and a digest of the point, for each problem.
"""

import sys
from hashlib import sha256
from pathlib import Path

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.optimize import checkpoint

checkpoint.SHARE = np.inf  # every state is written down
COMM = MPI.COMM_WORLD
GRID = dp.Grid((12, 10), size=1.0)
GRID = dp.distribute(GRID, COMM) if COMM.size > 1 else GRID
TARGET = np.random.default_rng(0).standard_normal(GRID.shape)


def diffused():
    """The field that forty steps of diffusion turn into one that was seen: a rollout."""
    L = dp.laplacian(GRID, dp.dirichlet)
    step = lambda u, k: u + k * L(u)
    return lambda u: anp.sum((dp.rollout(step, u, 2e-3, 40, memory=20_000) - TARGET) ** 2), np.zeros(GRID.shape)


def elliptic():
    """A coefficient by what its solution was seen to be, on one number and a field that every rank has."""
    D = dp.divergence(GRID)
    G = dp.gradient(GRID, dp.dirichlet)
    solve = dp.elliptic_solver(D, G)
    mean = dp.harmonic_average(GRID)
    loss = lambda x: anp.sum((solve(mean(anp.exp(x["log k"])), 1.0 + 0.0 * TARGET) * x["a"] - 0.1) ** 2)
    return loss, {"log k": 0.1 * TARGET, "a": 1.0}


def digest(tree):
    """Of the numbers of a tree, which all ranks must have alike."""
    numbers = b"".join(np.asarray(dp.gather(leaf)).tobytes() for leaf in leaves(tree))
    assert len(set(COMM.allgather(numbers))) == 1
    return sha256(numbers).hexdigest()[:16]


def main(folder, iterations):
    """Both problems, each in its folder; and twenty steps more of a rollout that is kept by NumPy."""
    for make in (diffused, elliptic):
        loss, start = make()
        best = dp.minimize(loss, start, maxiter=iterations, tolerance=0, checkpoint=folder / make.__name__)
        row = make.__name__, repr(best.value), digest(best.x), best.resumed.split(" in ")[0]
        if COMM.rank == 0:
            print(*row)
    path = folder / "state.npy"
    L = dp.laplacian(GRID, dp.dirichlet)
    state = np.load(path, mmap_mode="r") if path.exists() else TARGET
    end = dp.gather(dp.rollout(lambda u, k: u + k * L(u), np.array(state), 2e-3, 20))
    row = "steps", np.linalg.norm(end), digest(end)  # all have read the file
    if COMM.rank == 0:
        np.save(path, end)
        print(*row)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
