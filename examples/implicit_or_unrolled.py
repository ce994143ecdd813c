r"""
Through the iterations, or around them
======================================

The gradient of a solve, taped through 200 iterations or by one adjoint solve: error, time, memory.

A solver is a loop, and a tape can record it: every iteration is stored, and the backward pass goes through all of them.
This is called unrolling, and it is what automatic differentiation of a solver does. But the solution does not depend on
the method that computed it. Its derivative follows from the equation alone, and no iteration needs to be stored.

Run it: ``python examples/implicit_or_unrolled.py [cells] [--out FOLDER]``
"""

import argparse
import tracemalloc
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="What the implicit adjoint saves over taping every iteration.")
parser.add_argument("cells", nargs="?", type=int, default=96, help="cells along an axis of the finer grid")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The problem
# -----------
# How far is the solution of :math:`A x = b`, with :math:`A = -\Delta`, from the wanted one, and how does that change
# with the source :math:`b`?
#
# .. math:: J(b) = \frac{1}{N} \, | A^{-1} b - x_d |^2 .


class Problem:
    """The operator, the source and the loss on a grid of n cells along an axis."""

    def __init__(self, n):
        self.grid = dp.Grid((n, n), size=1.0)
        x, y = self.grid.centres()
        self.A = -dp.laplacian(self.grid, dp.dirichlet)
        self.wanted = np.sin(3 * x) * y * (1 - y)
        self.source = np.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2) / 0.02) + 0.3 * x

    def value_and_gradient(self, solve):
        """Return a function without arguments that computes the loss and its gradient by a solver."""
        both = dp.value_and_grad(lambda b: np.mean((solve(b) - self.wanted) ** 2))
        return lambda: both(self.source)


# %%
# Unrolled
# --------
# Conjugate gradients (CG) make :math:`x_{i+1} = x_i + \alpha_i \, d_i`, with lengths :math:`\alpha_i` and directions
# :math:`d_i` that depend on :math:`b`, too. The tape keeps them all: memory grows with the number of iterations. And
# what comes out is the derivative of the *loop*. If the loop was cut off early it is the exact derivative of a wrong
# solution, and often further off than the solution itself.
#
# Implicit
# --------
# Let the solution move with the source: :math:`A \, dx = db`. With :math:`g = \partial J / \partial x`,
#
# .. math:: dJ = g^T dx = g^T A^{-1} db = w^T db \quad \text{where} \quad A^T w = g .
#
# One adjoint solve, by any method, whichever was used forward. Nothing of the forward iterations is kept, and both
# solves have a tolerance, so that the gradient has one.


def solvers(A):
    """Return three ways to differentiate CG, and two faster solvers."""
    return {
        "CG, 200 iterations unrolled": dp.inverse(A, "krylov", diff="unrolled", iterations=200),
        "CG, 20 iterations unrolled": dp.inverse(A, "krylov", diff="unrolled", iterations=20),
        "CG, implicit": dp.inverse(A, "krylov"),
        "multigrid, implicit": dp.inverse(A, "multigrid"),
        "chosen by itself, implicit": dp.inverse(A),
    }


# %%
# What is measured
# ----------------
# The table has the shortest time of ten rounds, in which all ways take turns, and the peak memory. The error is the
# difference from the gradient by a direct solve, relative to this gradient.


def seconds(action):
    """Return the run time of an action in seconds."""
    start = perf_counter()
    action()
    return perf_counter() - start


def peak(action):
    """Most memory held at one time during an action [MB]."""
    tracemalloc.start()
    action()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most / 1e6


# %%
# Two grids
# ---------
# On the coarser grid 200 iterations are enough, and unrolled and implicit gradients are the same. On the finer grid
# they are not enough any more; nothing warns of it.

table = {}
print("gradient of a solve             cells  time [ms]  memory [MB]  error")
for n in (options.cells // 2, options.cells):
    problem = Problem(n)
    ways = {label: problem.value_and_gradient(solve) for label, solve in solvers(problem.A).items()}
    _, exact = ways["chosen by itself, implicit"]()

    rounds = [[seconds(way) for way in ways.values()] for _ in range(10)]
    for (label, way), times in zip(ways.items(), zip(*rounds)):
        _, gradient = way()
        error = np.linalg.norm(gradient - exact) / np.linalg.norm(exact)
        memory = peak(way)
        print(f"{label:29}  {n:4}^2  {1e3 * min(times):9.2f}  {memory:11.2f}  {error:.0e}")
        table[label] = memory, error, gradient

# %%
# The picture
# -----------
# Left: memory and error on the finer grid; down and to the left is better. Then the gradient, as it is, and as 20
# unrolled iterations have it, on the same scale: information travels by one cell in an iteration, and has not come
# across the grid.
#
# Exercises
# ---------
# 1. Count how many unrolled iterations are needed on the finer grid for an error of 1e-10. Compare with
#    `solve.info.forward.iterations` of the implicit solve.
# 2. Stop the implicit solve early as well, `rtol=1e-2`. How far off is the gradient now? `dp.certify` estimates it.
# 3. Where may unrolling be right? Think of a loop that is cut off on purpose, as a part of a network.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    for (label, (memory, error, _)), mark in zip(table.items(), "os^Dv"):
        left.loglog(memory, max(error, 1e-16), mark, label=label)
    left.set(title="a gradient", xlabel="memory [MB]", ylabel="relative error", ylim=(1e-17, 1e13))
    left.legend(frameon=False, fontsize="small", loc="upper left")
    unrolled = table["CG, 20 iterations unrolled"][2]
    most = np.max(np.abs(exact))
    fields = {"gradient, implicit": exact, "gradient, 20 iterations unrolled": unrolled}
    for ax, (title, field) in zip((middle, right), fields.items()):
        dp.plot(problem.grid, field, ax=ax, title=title, limits=(-most, most), cmap="RdBu_r", label="slope")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "implicit_or_unrolled.png", dpi=120)
