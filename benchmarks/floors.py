"""The floors of the library in one table: what it must not fall below, and what it reaches on this machine.

Every row is a ratio of times that were taken in turn, in one run; the error of the result, where there is one, stands
beside it. Each runs in a process of its own with one thread of BLAS: the memory and the threads that one row leaves
behind change the next one by up to 20 %. Some rows take gigabytes and a minute; name those you want: ``--only upwind``.

Run ``python -m benchmarks.floors [--only WORD]`` in the root of the repository.
"""

import argparse
import os
import subprocess
import sys
from functools import partial
from itertools import pairwise
from math import prod
from time import perf_counter

import autograd.numpy as anp
import numpy as np
import pyamg
from scipy.fft import dstn, idstn

import sparsedp as dp
from benchmarks import flow, scenes, small, structured
from benchmarks.rollout import sliced_by_hand
from benchmarks.structured import least
from benchmarks.triad import best_times, triad

ROWS = []  # (words, floor, aim, function -> (figure, error))
MORE, LESS = ">=", "<="


def row(words, sign, floor, aim, *arguments):
    """Decorator: the function gives the figure of this row and its error, None where there is none."""
    return lambda function: ROWS.append((words, sign, floor, aim, partial(function, *arguments))) or function


def relative(found, wanted):
    return float(np.max(np.abs(found - wanted)) / np.max(np.abs(wanted)))


# ---- operators -------------------------------------------------------------------------------------------------------


@row("Laplacian 1024^2, out=, % of triad", MORE, 75, 95, (1024, 1024))
@row("Laplacian 4096^2, out=, % of triad", MORE, 75, 95, (4096, 4096))
@row("Laplacian 128^3, out=, % of triad", MORE, 45, 70, (128, 128, 128))
@row("Laplacian 256^3, out=, % of triad", MORE, 60, 70, (256, 256, 256))
def laplacian(shape):
    op = dp.laplacian(dp.Grid(shape, size=1.0), dp.dirichlet).matrix_free()
    u, out = np.random.default_rng(0).random(shape), np.empty(shape)
    best = best_times({"triad": triad(shape), "ours": lambda: op.apply(u, out=out)}, max(12, 2**29 // prod(shape) // 8))
    return 100 * (16 * best["triad"]) / (24 * best["ours"]), None


@row("op(u) over out=, 256^3, times", LESS, 2.0, 1.3)
def fresh():
    op = dp.laplacian(dp.Grid((256,) * 3, size=1.0), dp.dirichlet).matrix_free()
    u, out = np.random.default_rng(0).random((256,) * 3), np.empty((256,) * 3)
    best = best_times({"fresh": lambda: op(u), "out": lambda: op.apply(u, out=out)}, 12)
    return best["fresh"] / best["out"], None


# ---- solves ----------------------------------------------------------------------------------------------------------


@row("separable 1024^2, over the bare transforms", LESS, 1.2, 0.9, (1024, 1024))
@row("separable 128^3, over the bare transforms", LESS, 1.2, 0.9, (128, 128, 128))
def separable(shape):
    op = -dp.laplacian(dp.Grid(shape, size=1.0), dp.dirichlet)
    inv, b = dp.inverse(op, "separable"), np.random.default_rng(0).random(shape)
    tasks = {"ours": lambda: (inv(b), inv.T(b)), "bare": lambda: [idstn(dstn(b, type=2), type=2) for _ in range(2)]}
    best = best_times(tasks, 10)
    return best["ours"] / best["bare"], inv.info.forward.residual


@row("structured 1024^2 smooth, x pyamg's solve", MORE, 8, 15, structured.smooth, (1024, 1024))
@row("structured 96^3 smooth, x pyamg's solve", MORE, 6, 12, structured.smooth, (96, 96, 96))
@row("structured inclusions 1e6 512^2, x pyamg's solve", MORE, 7, 15, scenes.inclusions, (512, 512))
def solve(scene, shape):
    op = scene(shape)
    matrix, _ = structured.unknowns(op.matrix)
    inv, b = dp.inverse(op, "structured"), np.random.default_rng(0).standard_normal(shape)
    best = {}
    for name, theirs in (("rs", pyamg.ruge_stuben_solver(matrix, **structured.SMOOTH)), ("sa", smoothed(matrix))):
        best[name] = least(lambda theirs=theirs: structured.peer(theirs, b.ravel()), 2)[0]
    ours, x = least(lambda: inv(b), 6)
    return min(best.values()) / ours, float(np.linalg.norm(op(x) - b) / np.linalg.norm(b))


def smoothed(matrix):
    return pyamg.smoothed_aggregation_solver(matrix, symmetry="symmetric")


@row("structured 1024^2 with set-up, x pyamg's", MORE, 4, 10, (1024, 1024))
@row("structured 96^3 with set-up, x pyamg's", MORE, 4, 10, (96, 96, 96))
def with_setup(shape):
    """A new coefficient each call; the entries of the matrix are given to pyamg."""
    grid = dp.Grid(shape, size=1.0)
    D, G, rng = dp.divergence(grid), dp.gradient(grid, dp.dirichlet), np.random.default_rng(0)
    ours, b = dp.elliptic_solver(D, G, "structured"), rng.standard_normal(shape)
    ks = [rng.uniform(0.5, 1.5, grid.faces.size) for _ in range(4)]
    matrix = structured.unknowns((-D @ dp.diagonal(grid.faces, ks[0]) @ G).matrix)[0]
    theirs = [
        least(lambda make=make: structured.peer(make(matrix), b.ravel()), 1)[0]
        for make in (partial(pyamg.ruge_stuben_solver, **structured.SMOOTH), smoothed)
    ]
    ours(ks[0], b)
    seconds = min(least(partial(ours, k, b), 1)[0] for k in ks[1:])
    return min(theirs) / seconds, ours.info.forward.residual


@row("iterations, smooth, largest of 128^2 to 1024^2, 32^3 to 96^3", LESS, 12, 12, "smooth")
@row("iterations, inclusions 1e6, 512^2", LESS, 20, 15, (512, 512))
@row("iterations, inclusions 1e6, 64^3", LESS, 20, 15, (64, 64, 64))
def iterations(what):
    smooth = [(n, n) for n in (128, 256, 512, 1024)] + [(n, n, n) for n in (32, 64, 96)]
    ops = map(structured.smooth, smooth) if what == "smooth" else [scenes.inclusions(what)]
    found = []
    for op in ops:
        inv = dp.inverse(op, "structured")
        inv(np.random.default_rng(0).standard_normal(op.domain.shape))
        found.append(inv.info.forward)
    return max(info.iterations for info in found), max(info.residual for info in found)


@row("time exponent, smooth 256^2 to 1024^2", LESS, 1.1, 1.0)
def exponent():
    seconds = []
    for n in (256, 512, 1024):
        inv, b = dp.inverse(structured.smooth((n, n)), "structured"), np.random.default_rng(0).standard_normal((n, n))
        seconds.append(least(lambda inv=inv, b=b: inv(b), 6)[0])
    return max(np.log(b / a) / np.log(4) for a, b in pairwise(seconds)), None


# ---- transport, rollouts, flow ---------------------------------------------------------------------------------------


@row("100 upwind steps in rollout, 1-D 1e6, x autograd's slices", MORE, 30, 45, (1_000_000,), True)
@row("100 upwind steps in rollout, 2-D 1024^2, x autograd's slices", MORE, 30, 45, (1024, 1024), True)
@row("100 upwind steps on the tape, 2-D 512^2, x autograd's slices", MORE, 12, 20, (512, 512), False)
def upwind(shape, rolled, n=100):
    rng = np.random.default_rng(0)
    u, v = rng.random(shape), rng.uniform(-1, 1, shape if len(shape) == 1 else (len(shape), *shape))
    weights, dt = rng.random(shape), 0.4 / sum(shape)
    move = dp.transport(dp.Grid(shape, size=1.0, periodic=True), velocity="cells")
    step = lambda u, v: move(u, v, dt)

    def looped(step, x):
        u, v = x
        for _ in range(n):
            u = step(u, v)
        return anp.sum(weights * u**2)

    ours = (lambda x: anp.sum(weights * dp.rollout(step, *x, n) ** 2)) if rolled else partial(looped, step)
    ours, theirs = dp.value_and_grad(ours), dp.value_and_grad(partial(looped, sliced_by_hand(shape, dt)))
    start = perf_counter()
    wanted = theirs((u, v))[1]
    slow = perf_counter() - start
    best = best_times({"ours": lambda: ours((u, v))}, 3)["ours"]
    return slow / best, max(map(relative, ours((u, v))[1], wanted))


@row("projection 128^2, over NumPy slices and DCT", LESS, 1.2, 0.9, 128)
@row("projection 256^2, over NumPy slices and DCT", LESS, 1.2, 0.9, 256)
@row("projection 512^2, over NumPy slices and DCT", LESS, 1.2, 0.9, 512)
def projection(n):
    tasks, error, _, _ = flow.tasks(n)
    best = best_times(tasks, 20)
    return best["projection on the tape"] / best["NumPy slices and DCT"], error


@row("Burgers composed, rollout, ms", LESS, 3.0, 1.0, small.burgers, small.rolled)
@row("Burgers composed, loop on the tape, ms", LESS, 3.0, 1.0, small.burgers, small.looped)
@row("smoke 32^2 x 20 steps, rollout, ms", LESS, 18.0, 6.0, small.smoke, small.rolled)
@row("smoke 32^2 x 20 steps, loop on the tape, ms", LESS, 18.0, 6.0, small.smoke, small.looped)
def composed(scene, form):
    case = scene()
    ours, theirs = dp.value_and_grad(form(case)), dp.value_and_grad(small.written(case))
    error = relative(ours(case.x)[1], theirs(case.x)[1])
    return 1e3 * best_times({"ours": lambda: ours(case.x)}, 100)["ours"], error


@row("gradient of 200 rk4 steps of two unknowns, over the value", LESS, 8.0, 4.0)
def predators():
    case = small.predators()
    loss = small.rolled(case)
    ours, theirs = dp.value_and_grad(loss), dp.value_and_grad(small.written(case))
    error = relative(ours(case.x)[1], theirs(case.x)[1])
    best = best_times({"value": lambda: loss(case.x), "gradient": lambda: ours(case.x)}, 10)
    return best["gradient"] / best["value"], error


# ---- the package -----------------------------------------------------------------------------------------------------


@row("import sparsedp, s", LESS, 0.35, 0.35)
def imported():
    command = "from time import perf_counter as t; a = t(); import sparsedp; sparsedp.Grid; print(t() - a)"
    runs = [subprocess.run([sys.executable, "-c", command], capture_output=True, check=True) for _ in range(5)]
    return min(float(run.stdout) for run in runs), None


def show(words, sign, floor, aim, measured):
    """Print one row."""
    figure, error = measured()
    fine = figure >= floor if sign == MORE else figure <= floor
    shown, missed = "" if error is None else f"{error:9.1e}", "" if fine else "  MISSED"
    print(f"{words:64} {figure:9.3g} {sign:>3}{floor:6g} {aim:6g} {shown:>9}{missed}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="rows with this word in their name")
    parser.add_argument("--here", action="store_true", help="in this process, with the threads of BLAS that it has")
    given = parser.parse_args()
    if not given.here:
        print(f"{'':64} {'figure':>9} {'floor':>9} {'aim':>6} {'error':>9}", flush=True)
    for row in ROWS[::-1]:
        if given.here and given.only in row[0]:
            show(*row)
        elif given.only in row[0]:
            command = [sys.executable, "-m", "benchmarks.floors", "--here", "--only", row[0]]
            subprocess.run(command, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}, check=True)


if __name__ == "__main__":
    main()
