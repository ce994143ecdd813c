"""What the implicit adjoint saves over taping every iteration. Run: python examples/implicit_or_unrolled.py [cells]"""

import sys
import tracemalloc
from functools import partial
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

finest = int(sys.argv[1]) if len(sys.argv) > 1 else 96


def problem(n):
    """Operator, loss, and a source b: how far is the solution of -lap u = b from the wanted one?"""
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    wanted = np.sin(3 * x) * y * (1 - y)
    source = np.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2) / 0.02) + 0.3 * x
    return -dp.laplacian(grid, dp.dirichlet), lambda solve, b: np.mean((solve(b) - wanted) ** 2), source


def seconds(action):
    start = perf_counter()
    action()
    return perf_counter() - start


def peak(action):
    """Most memory held at one time during action() [MB]."""
    tracemalloc.start()
    action()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most / 1e6


# Unrolled: the tape keeps every iteration; the gradient is that of the loop, right or not, where it was cut off.
# Implicit: a second solve, A^T w = g, gives the gradient. Nothing of the first one is kept, and both keep their rtol.
print("gradient of a solve             cells  time [ms]  memory [MB]  error")
for n in (finest // 2, finest):
    op, loss, source = problem(n)
    solvers = {
        "CG, 200 iterations unrolled": dp.inverse(op, "krylov", diff="unrolled", iterations=200),
        "CG, 20 iterations unrolled": dp.inverse(op, "krylov", diff="unrolled", iterations=20),
        "CG, implicit": dp.inverse(op, "krylov"),
        "multigrid, implicit": dp.inverse(op, "multigrid"),
        "chosen by itself, implicit": dp.inverse(op),
    }
    gradients = {label: dp.value_and_grad(partial(loss, solve)) for label, solve in solvers.items()}
    exact = gradients["chosen by itself, implicit"](source)[1]  # a direct solve
    rounds = [[seconds(partial(f, source)) for f in gradients.values()] for _ in range(10)]
    for (label, f), times in zip(gradients.items(), zip(*rounds)):
        error = np.linalg.norm(f(source)[1] - exact) / np.linalg.norm(exact)
        print(f"{label:29}  {n:4}^2  {1e3 * min(times):9.2f}  {peak(partial(f, source)):11.2f}  {error:.0e}")
