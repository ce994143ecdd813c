"""What explain counts on ranks: exchanges, their bytes and reductions as exact numbers, the same on every rank.

mpirun -n 2 python -m mpi4py tests/ranks/explain_on_ranks.py
"""

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI

import sparsedp as dp

COMM = MPI.COMM_WORLD
GRID = dp.distribute(dp.Grid((12, 10), size=1.0), COMM)
L = dp.laplacian(GRID, dp.dirichlet)
SOLVE = dp.inverse(-L)
SEAMS = {1: 0, 2: 2 * 10, 3: 4 * 10, 4: 2 * 10 + 2 * 12 + 4}[COMM.size]  # cells that another rank reads, and corners


def counted(loss, x):
    """The second plan of a loss, when all is set up: the same on every rank."""
    dp.explain(loss, x)
    plan = dp.explain(loss, x)
    counts_of_ranks = COMM.allgather((plan.totals, plan.skipped, plan.tape_nodes, plan.tape_bytes))
    assert counts_of_ranks == [counts_of_ranks[0]] * COMM.size, counts_of_ranks
    assert f"{plan.totals['reductions']} reductions" in str(plan)
    assert plan.tape_bytes >= 8 * GRID.cells.size  # a field on ranks counts, all of it
    return [plan.totals[word] for word in ("exchanges between ranks", "bytes in them", "reductions")]


if __name__ == "__main__":
    u = GRID.centres()[0] * 1.0
    talks = COMM.size > 1
    step = lambda u, k: u + k * 1e-3 * L(u)
    there_and_back = [2 * talks, 2 * 8 * SEAMS, 1]
    assert counted(lambda u: anp.sum(L(u) ** 2), u) == there_and_back
    assert counted(lambda u: anp.sum(L(u) ** 2), np.ones(GRID.shape)) == there_and_back
    assert counted(lambda k: anp.sum(dp.rollout(step, u, k, 5) ** 2), 1.0)[:2] == [9 * talks, 9 * 8 * SEAMS]
    assert counted(lambda u: anp.sum(SOLVE(u) ** 2), u)[:2] == there_and_back[:2]  # true residuals; not PETSc's own
    if COMM.rank == 0:
        print("all agree")
