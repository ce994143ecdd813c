"""Structured multigrid against the best set-up of pyamg: one thread against one, on problems no transform takes.

Beside every time stand the iterations, the true relative residual and the error of the gradient, which is
<g, A^-1 b> by the adjoint solve against the forward one. Both solvers are asked for 1e-10. Sizes, masks
and dimensions; then the exponent of the time in the number of unknowns. Times are those of the processor, which
other processes disturb less, and with one thread no others; the smallest of several counts.

Run ``python -m benchmarks.structured [--quick]`` in the root of the repository.
"""

import argparse
from functools import partial
from math import log, prod
from time import process_time

import numpy as np
import pyamg
import scipy.sparse as sp

import sparsedp as dp

RTOL = 1e-10
SOLVE, SETUP, ITERATIONS, EXPONENT = 15, 20, 12, 1.1  # limits at 1024^2 and 128^3
SIZES = ((256, 256), (512, 512), (1024, 1024), (32, 32, 32), (64, 64, 64), (128, 128, 128))
QUICK = ((64, 64), (128, 128), (16, 16, 16), (32, 32, 32))
SMOOTH = {
    "presmoother": ("gauss_seidel", {"sweep": "forward"}),
    "postsmoother": ("gauss_seidel", {"sweep": "backward"}),
}


def smooth(shape):
    """-div(k grad) with k between 0.1 and 1.9."""
    grid = dp.Grid(shape, size=1.0)
    k = dp.harmonic_average(grid)(1 + 0.9 * np.prod([np.sin(3 * x) for x in grid.centres()], axis=0))
    return -dp.divergence(grid) @ dp.diagonal(grid.faces, k) @ dp.gradient(grid, dp.dirichlet)


def masked(shape):
    """The Laplacian around a solid block, held on the walls."""
    grid, solid = dp.Grid(shape, size=1.0), np.zeros(shape, dtype=bool)
    solid[tuple(slice(n // 4, n // 2) for n in shape)] = True
    return -dp.laplacian(grid, dp.dirichlet, solid)


PROBLEMS = {"smooth k": smooth, "mask": masked}


def least(function, repeats):
    """(smallest time, last result)."""
    times, result = [], None
    for _ in range(repeats):
        result = None  # its memory is used again
        start = process_time()
        result = function()
        times.append(process_time() - start)
    return min(times), result


def unknowns(matrix):
    """The matrix of the cells that have an equation, and which they are."""
    kept = np.flatnonzero(matrix.diagonal())
    return sp.csr_matrix(matrix[kept][:, kept]), kept


def peer(hierarchy, b):
    """(solution, iterations) of pyamg."""
    history: list = []
    x = hierarchy.solve(b, tol=RTOL, accel="cg", residuals=history, maxiter=100)
    return x, len(history) - 1


def row(name, shape, repeats):
    """Measure one problem, print its row, and return the seconds of a solve."""
    op = PROBLEMS[name](shape)
    matrix, kept = unknowns(op.matrix)
    b, g = np.zeros((2, prod(shape)))
    b[kept], g[kept] = np.random.default_rng(0).standard_normal((2, kept.size))
    rs_setup, rs = least(lambda: pyamg.ruge_stuben_solver(matrix, **SMOOTH), 1 if prod(shape) > 10**6 else 2)
    rs_solve, (y, rs_iterations) = least(partial(peer, rs, b[kept]), 2)
    setup, inv = least(lambda: dp.inverse(op, "structured", rtol=RTOL), repeats)
    solve, x = least(lambda: inv(b.reshape(shape)), repeats + 2)
    adjoint, z = least(lambda: inv.T(g.reshape(shape)), repeats)
    x, z = x.ravel()[kept], z.ravel()[kept]
    wrong = abs(z @ b[kept] - g[kept] @ x) / (np.linalg.norm(z) * np.linalg.norm(b))
    residuals = [np.linalg.norm(matrix @ v - b[kept]) / np.linalg.norm(b) for v in (x, y)]
    start = f"{name:9} {'x'.join(map(str, shape)):12} {1e3 * solve:8.1f} {1e3 * adjoint:8.1f}"
    print(
        f"{start} {1e9 * solve / prod(shape):8.0f} {inv.info.forward.iterations:3} {residuals[0]:8.1e}"
        f" {wrong:9.1e} {1e3 * setup:8.1f} | {1e3 * rs_solve:8.0f} {rs_iterations:3} {residuals[1]:8.1e}"
        f" {1e3 * rs_setup:8.0f} | {rs_solve / solve:7.1f} {rs_setup / setup:7.1f}",
        flush=True,
    )
    return solve


def exponent(times):
    """Fitted slope of log time over log unknowns."""
    return np.polyfit([log(n) for n, _ in times], [log(t) for _, t in times], 1)[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, few repeats")
    parser.add_argument("--only", help="one size, for example 1024,1024")
    given = parser.parse_args()
    sizes = QUICK if given.quick else SIZES
    sizes = (tuple(map(int, given.only.split(","))),) if given.only else sizes
    dp.set_threads(1)
    for dim in {len(shape) for shape in sizes}:  # compile, or load what was
        dp.inverse(smooth((16,) * dim), "structured")(np.ones((16,) * dim))
    print(
        f"Limits at 1024^2 and 128^3: x solve {SOLVE}, x set-up {SETUP}; iterations {ITERATIONS}; exponent {EXPONENT}."
    )
    print(
        f"{'':22} {'solve ms':>8} {'adjoint':>8} {'ns/cell':>8} {'its':>3} {'residual':>8} {'gradient':>9}"
        f" {'set-up':>8} | {'RS solve':>8} {'its':>3} {'residual':>8} {'set-up':>8} | {'x solve':>7} {'x setup':>7}"
    )
    for name in PROBLEMS:
        for dim in (2, 3):
            times = [(prod(shape), row(name, shape, 2 if given.quick else 5)) for shape in sizes if len(shape) == dim]
            if len(times) > 1:
                print(f"{name}, {dim}-D: time grows with unknowns to the power {exponent(times):.2f}")


if __name__ == "__main__":
    main()
