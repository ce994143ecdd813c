"""What ranks cost and bring: ink carried by a wind, on one process, on 1 rank, and on all ranks that there are.

The three are timed in turn, one thread each, and the smallest time counts; only ratios in one run mean anything.
Messages are those of rank 0, in all steps of a loss, and of a loss with its gradient.

Run ``mpirun -n 2 python -m mpi4py -m benchmarks.ranks [cells along an axis]`` in the root of the repository.
"""

import sys
from functools import partial
from time import perf_counter

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI

import sparsedp as dp
from sparsedp._utils.counters import recording

STEPS, REPEATS = 10, 7
WORDS = {"exchange": "exchanges", "sent": "bytes", "reduction": "reductions"}


def ink(grid):
    """The loss of a wind on a grid, and a wind: some steps of ink, upwind."""
    move, x = dp.transport(grid), grid.centres()
    start = np.exp(-20 * sum((line - 0.4) ** 2 for line in x))
    curl = dp.curl(grid)
    wind = curl(np.sin(np.arange(curl.domain.size)).reshape(curl.domain.shape))
    dt = 0.2 / max(grid.shape) / float(np.max(np.abs(wind)))

    def loss(wind):
        return anp.sum(dp.rollout(lambda u, v: move(u, v, dt), start, wind, STEPS) ** 2)

    return loss, wind


def seconds(act, comm):
    """Of the slowest rank."""
    comm.Barrier()
    start = perf_counter()
    act()
    return comm.allreduce(perf_counter() - start, MPI.MAX)


def messages(act):
    """What an act sends: the bytes are the sum over all ranks."""
    with recording() as calls:
        act()
    return ", ".join(f"{calls['ranks', word]} {text}" for word, text in WORDS.items())


def main():
    """Print milliseconds a step, forward and with the gradient; and what goes between ranks."""
    dp.set_threads(1)
    world, alone, n = MPI.COMM_WORLD, MPI.COMM_SELF, int(sys.argv[1]) if len(sys.argv) > 1 else 1024
    grid, best = dp.Grid((n, n), size=1.0), {}
    places = [(f"{world.size} ranks", world, dp.distribute(grid, world))]
    if world.rank == 0:
        places = [("one process", alone, grid), ("1 rank", alone, dp.distribute(grid, alone)), *places]
    runs = []
    for name, comm, grid in places:
        loss, wind = ink(grid)
        runs += [(name, comm, grid, partial(act, wind)) for act in (loss, dp.grad(loss))]
    for number in REPEATS * [*range(len(runs))]:
        _, comm, _, act = runs[number]
        best[number] = min(best.get(number, np.inf), seconds(act, comm))
    for number, (name, _, grid, act) in enumerate(runs):
        what, sent = ("value", "gradient")[number % 2], messages(act) if grid.layout else ""
        if world.rank == 0:
            print(f"{name:12} {what:9} {1e3 * best[number] / STEPS:8.2f} ms a step  {sent}")


if __name__ == "__main__":
    main()
