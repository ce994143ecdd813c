"""Triangular systems: chains and upwind sweeps, steady and in an implicit step, beside SciPy.

Run ``python -m benchmarks.sweeps [--quick]`` in the root of the repository; ``--quick`` leaves out the largest sizes.

A row: unknowns; seconds of the set-up, of one solve, of one adjoint solve, and of value and gradient in all entries,
with a set-up (`matrix_solver.from_coo`); seconds of `scipy.sparse.linalg.spsolve_triangular` and of one product with
the matrix; solve and adjoint solve in units of SciPy's seconds; the larger one of their true residuals; megabytes of
arrays at the peak of set-up, solve and adjoint solve, and of SciPy's solve, by tracemalloc. Our winds blow from
different sides, so that no numbering of the cells is triangular as it stands; SciPy is given the sweep of the same size
whose winds all blow from the first cell, which is lower triangular.

Seconds are of the processor, on one thread: the least of a few runs of all tasks in turn. The exponent of a group is
the slope of log(seconds of a solve) over log(unknowns), by least squares.
"""

import argparse
import tracemalloc
from functools import partial
from time import process_time

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve_triangular

import sparsedp as dp
from sparsedp import kernels

GROUPS = {
    "chain": [(100_000,), (300_000,), (1_000_000,)],
    "2-D": [(256, 256), (512, 512), (1024, 1024)],
    "3-D": [(24, 24, 24), (40, 40, 40), (64, 64, 64)],
}
MIXED = 1, -1, 1  # signs of the winds along the axes
REPEATS = 5
STEP = 0.01  # of the implicit step
COLUMNS = (
    f"{'system':30}{'unknowns':>10}{'set-up':>9}{'solve':>9}{'adjoint':>9}{'gradient':>10}{'SciPy':>9}{'product':>9}"
    f"{'solve/SciPy':>13}{'adjoint/SciPy':>15}{'residual':>10}{'MB':>7}{'MB SciPy':>10}"
)


def sweep(shape, signs, implicit):
    """The operator of unit winds of these signs, or 1 + STEP times it."""
    if len(shape) == 1:
        diagonals = [np.ones(shape[0]), np.full(shape[0] - 1, -0.9)]
        op = dp.from_matrix(sp.diags_array(diagonals, offsets=[0, -1]))
    else:
        grid = dp.Grid(shape, size=1.0)
        op = 0.0 * dp.identity(grid.cells)
        for axis, sign in enumerate(signs[: len(shape)]):
            walls = (dp.dirichlet, dp.neumann)[::sign]
            op = op + sign * dp.upwind(grid, axis, sign, {"xyz"[axis]: walls})
    return dp.identity(op.domain) + STEP * op if implicit else op


def least_seconds(tasks):
    """Run functions in turn, and return the least CPU seconds of each, by name."""
    least = dict.fromkeys(tasks, np.inf)
    for _ in range(REPEATS):
        for name, task in tasks.items():
            start = process_time()
            task()
            least[name] = min(least[name], process_time() - start)
    return least


def peak_megabytes(task):
    """Megabytes of arrays at the peak of a call."""
    tracemalloc.start()
    task()
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    return peak


def all_of(op, b):
    """Set-up, solve and adjoint solve."""
    inv = dp.inverse(op)
    return inv(b), inv.T(b)


def gradient(op):
    """Value and gradient of a sum of squares in all entries, as a function."""
    entries, b = sp.coo_array(op.matrix), np.ones(op.shape[0])
    solve = dp.matrix_solver.from_coo(entries.row, entries.col)
    loss = dp.value_and_grad(lambda data: anp.sum(solve(data, b) ** 2))
    scales = iter(1.0 + 1e-3 * np.arange(2 * REPEATS))  # new entries, and so a new set-up, in each call
    return lambda: loss(next(scales) * entries.data)


def row(shape, implicit):
    """Measure one system, and print its row; return (unknowns, seconds of a solve)."""
    op, b = sweep(shape, MIXED, implicit), np.ones(shape)
    triangular = sp.csc_array(sweep(shape, (1, 1, 1), implicit).matrix)
    matrix, flat = op.matrix, b.reshape(-1)
    inv = dp.inverse(op)
    tasks = {
        "setup": partial(dp.inverse, op),
        "solve": partial(inv, b),
        "adjoint": partial(inv.T, b),
        "gradient": gradient(op),
        "scipy": partial(spsolve_triangular, triangular, flat),
        "product": partial(matrix.dot, flat),
    }
    seconds = least_seconds(tasks)
    residual = max(np.linalg.norm(A(x) - b) for A, x in ((op, inv(b)), (op.T, inv.T(b)))) / np.linalg.norm(b)
    name = f"{' x '.join(map(str, shape))}{', implicit step' * implicit}"
    print(
        f"{name:30}{b.size:10}{seconds['setup']:9.3f}{seconds['solve']:9.4f}{seconds['adjoint']:9.4f}"
        f"{seconds['gradient']:10.3f}{seconds['scipy']:9.4f}{seconds['product']:9.4f}"
        f"{seconds['solve'] / seconds['scipy']:13.2f}{seconds['adjoint'] / seconds['scipy']:15.2f}{residual:10.0e}"
        f"{peak_megabytes(partial(all_of, op, b)):7.0f}{peak_megabytes(tasks['scipy']):10.0f}",
        flush=True,
    )
    return b.size, seconds["solve"]


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--quick", action="store_true", help="leave out the largest sizes")
    quick = parser.parse_args().quick
    kernels.set_threads(1)
    all_of(sweep((8, 8), MIXED, False), np.ones((8, 8)))  # compiles
    print(COLUMNS)
    for name, shapes in GROUPS.items():
        for implicit in (False, True):
            sizes, seconds = np.log([row(shape, implicit) for shape in shapes[: len(shapes) - quick]]).T
            exponent = np.polyfit(sizes, seconds, 1)[0]
            print(f"{name}{', implicit step' * implicit}: exponent {exponent:.2f}", flush=True)


if __name__ == "__main__":
    main()
