"""150 set-ups of new operators and their inverses: memory does not grow, though each rank drops them when it likes.

mpirun -n 2 python -m mpi4py tests/ranks/memory.py
"""

import gc
import random

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI

import sparsedp as dp

COMM = MPI.COMM_WORLD
GRID = dp.distribute(dp.Grid((32, 32), size=1.0), COMM)
B = np.random.default_rng(0).standard_normal(GRID.shape)
LEAST = 10  # set-ups before memory is looked at, after, and the bytes that it may grow
COUNT = 150
MOST = 5e6


def resident():
    """Bytes of this process in memory."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096


def set_up(number):
    """One operator and its inverse, forward and adjoint."""
    D = dp.divergence(GRID)
    G = dp.gradient(GRID, dp.dirichlet)
    k = 1.0 + number + np.arange(GRID.faces.size) % 5
    inverse = dp.inverse(dp.identity(GRID.cells) - D @ dp.diagonal(GRID.faces, k) @ G, rtol=1e-6)
    dp.grad(lambda b: anp.sum(inverse(b) ** 2))(B)


def main():
    """Rank 0 prints the growth of each rank in bytes."""
    chance = random.Random(COMM.rank)
    for number in range(LEAST + COUNT):
        if number == LEAST:
            gc.collect()
            start = resident()
        set_up(number)
        if chance.random() < 0.1:
            gc.collect()  # at other times on other ranks
    gc.collect()
    grown = COMM.allgather(resident() - start)
    assert max(grown) < MOST, grown
    if COMM.rank == 0:
        print("grown by", *grown, "bytes; all agree")


if __name__ == "__main__":
    main()
