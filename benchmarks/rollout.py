"""What a gradient through many steps costs: against autograd over slices, in memory, and in steps run again.

All rows of a block run in turn and the smallest time counts; only ratios in one run mean anything. The error beside
a time is the largest difference from the gradient of the first row, relative to the largest entry.

Run ``python -m benchmarks.rollout [--quick]`` in the root of the repository.
"""

import argparse
import os
import tempfile
import tracemalloc
from functools import partial
from time import perf_counter
from timeit import repeat

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.triad import best_times
from sparsedp import kernels
from sparsedp.trajectory.checkpoint_plan import advances, slots_within

LIMITS = {1: 35.0, 2: 30.0}  # times faster than autograd over slices, by dimension


# ---------------------------------------------------------------- upwind


def sliced(shape, dt):
    """One donor-cell step in advective form, velocity on cells, as a user of autograd writes it."""

    def step(u, v):
        new = u
        for axis, h in enumerate(1.0 / n for n in shape):
            w = v[axis] if len(shape) > 1 else v
            ahead, behind = anp.roll(u, -1, axis), anp.roll(u, 1, axis)
            new = new - dt / h * (anp.minimum(w, 0.0) * (ahead - u) + anp.maximum(w, 0.0) * (u - behind))
        return new

    return step


def sliced_by_hand(shape, dt):
    """The same with slices of an array with a ghost cell on both sides."""

    def neighbours(u, axis):
        head = tuple(slice(-1, None) if a == axis else slice(None) for a in range(u.ndim))
        tail = tuple(slice(0, 1) if a == axis else slice(None) for a in range(u.ndim))
        wide = anp.concatenate([u[head], u, u[tail]], axis)
        ahead = tuple(slice(2, None) if a == axis else slice(None) for a in range(u.ndim))
        behind = tuple(slice(0, -2) if a == axis else slice(None) for a in range(u.ndim))
        return wide[ahead], wide[behind]

    def step(u, v):
        new = u
        for axis, n in enumerate(shape):
            w = v[axis] if len(shape) > 1 else v
            ahead, behind = neighbours(u, axis)
            new = new - dt * n * (anp.minimum(w, 0.0) * (ahead - u) + anp.maximum(w, 0.0) * (u - behind))
        return new

    return step


def upwind(shape, n, repeats):
    """Print one block: value + gradient in field and velocity of n steps."""
    rng = np.random.default_rng(0)
    u, v = rng.random(shape), rng.uniform(-1, 1, shape if len(shape) == 1 else (len(shape), *shape))
    weights, dt = rng.random(shape), 0.4 / sum(shape)
    move = dp.transport(dp.Grid(shape, size=1.0, periodic=True), velocity="cells")

    def through(step, options=None):
        def loss(x):
            if options is not None:
                return anp.sum(weights * dp.rollout(step, *x, n, **options) ** 2)
            field = x[0]
            for _ in range(n):
                field = step(field, x[1])
            return anp.sum(weights * field**2)

        return lambda: dp.value_and_grad(loss)((u, v))[1]

    tasks = {
        "rollout": through(lambda u, v: move(u, v, dt), {}),
        "move, every step on the tape": through(lambda u, v: move(u, v, dt)),
        "autograd over slices": through(sliced_by_hand(shape, dt)),
        "autograd over roll": through(sliced(shape, dt)),
        "rollout of roll": through(sliced(shape, dt), {}),
    }
    slopes = {name: task() for name, task in tasks.items()}
    best = best_times(tasks, repeats)
    first, trajectory = next(iter(slopes.values())), n * u.nbytes
    print(f"\n{' x '.join(map(str, shape))} cells, {n} upwind steps, {kernels.threads()} threads, kernels: {kind()}")
    print(f"{'':38} {'ms':>9} {'x slices':>9} {'limit':>6} {'error':>9} {'peak / trajectory':>18}")
    for name, seconds in best.items():
        error = max(np.max(np.abs(a - b)) / np.max(np.abs(b)) for a, b in zip(slopes[name], first))
        limit = f"{LIMITS[len(shape)]:g}" if name == "rollout" else ""
        print(
            f"{name:38} {1e3 * seconds:9.1f} {best['autograd over slices'] / seconds:9.1f} {limit:>6} {error:9.1e}"
            f" {peak(tasks[name]) / trajectory:18.2f}"
        )


def kind():
    return "numba" if kernels.compiled() else "NumPy"


def peak(task):
    """Bytes at the worst moment."""
    tracemalloc.start()
    try:
        task()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


# ---------------------------------------------------------------- memory


def memory(shape, n, budgets):
    """Print one block: bytes, steps run again, and whether the bits stay."""
    u, v = np.random.default_rng(0).random(shape), np.full((2, *shape), 0.3)
    move, dt = dp.transport(dp.Grid(shape, size=1.0, periodic=True), velocity="cells"), 0.4 / sum(shape)
    step = lambda u, v: move(u, v, dt)
    print(f"\n{shape[0]} x {shape[1]} cells, {n} upwind steps, a state has {u.nbytes / 1e6:g} MB")
    print(f"{'memory':>10} {'kept':>6} {'steps / n':>10} {'optimum':>8} {'peak MB':>8} {'s':>7}  bits of 1000 steps")
    exact = None
    for budget in budgets:
        runs: list = []

        def gradient(n, runs=runs, budget=budget):
            loss = lambda x: anp.sum(dp.rollout(step, *x, n, memory=budget, record=runs.append) ** 2)
            return dp.value_and_grad(loss)((u, v))[1]

        seconds = min(repeat(lambda: gradient(n), number=1, repeat=1))
        back, most = runs[-1], peak(partial(gradient, n))
        short = b"".join(g.tobytes() for g in gradient(min(n, 1000)))
        exact = exact or short
        least = (advances(n, slots_within(budget, u.nbytes, n, 2 * v.nbytes) if budget else n) + 1) / n
        print(
            f"{budget or 'all':>10} {back.kept:6} {back.factor:10.4f} {least:8.4f} {most / 1e6:8.1f} {seconds:7.2f}"
            f"  {'same' if short == exact else 'OTHER'}"
        )


# ---------------------------------------------------------------- files


def files(shape, n, rows):
    """Print one block: what states in files save, in bytes, steps run again and seconds."""
    u, v = np.random.default_rng(0).random(shape), np.full((2, *shape), 0.3)
    move, dt = dp.transport(dp.Grid(shape, size=1.0, periodic=True), velocity="cells"), 0.4 / sum(shape)
    print(f"\n{shape[0]} x {shape[1]} cells, {n} upwind steps, a state has {u.nbytes / 1e6:g} MB")
    print(f"{'memory':>10} {'disk':>8} {'kept':>6} {'in files':>8} {'steps / n':>10} {'peak MB':>8} {'s':>7}  bits")
    exact = None
    for budget, limit in rows:
        runs: list = []
        with tempfile.TemporaryDirectory() as folder:
            disk = (folder, limit) if limit else None

            def loss(x, budget=budget, disk=disk, runs=runs):
                end = dp.rollout(lambda u, v: move(u, v, dt), *x, n, memory=budget, disk=disk, record=runs.append)
                return anp.sum(end**2)

            tracemalloc.start()
            begin = perf_counter()
            slopes = dp.value_and_grad(loss)((u, v))[1]
            seconds = perf_counter() - begin
            most = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            n_files = len(os.listdir(folder))
        bits = b"".join(g.tobytes() for g in slopes)
        exact = exact or bits
        forward, back = runs
        verdict = "same" if bits == exact else "OTHER"
        if n_files:
            verdict += f", {n_files} files remain"
        print(
            f"{budget:>10} {limit or '-':>8} {forward.kept:6} {forward.on_disk:8} {back.factor:10.4f} "
            f"{most / 1e6:8.1f} {seconds:7.1f}  {verdict}"
        )


# ---------------------------------------------------------------- overhead


def overhead(n=5000):
    """Print microseconds a step of 4 numbers, the user's own functions taken off."""
    u = np.ones(4)

    def loop(step, p):
        field = u
        for _ in range(n):
            field = step(field, p)
        return anp.sum(field)

    grad = lambda loss: dp.value_and_grad(loss)(1.0)
    times = lambda u, p: u * p
    bare = dp.differentiable("bare", lambda u, p: u, lambda nums, ans, u, p: lambda g: (g,))
    tasks = {
        "plain loop": lambda: loop(times, 1.0),
        "rollout, no gradient": lambda: dp.rollout(times, u, 1.0, n),
        "loop on the tape": lambda: grad(lambda p: loop(times, p)),
        "rollout, gradient": lambda: grad(lambda p: anp.sum(dp.rollout(times, u, p, n))),
        "rollout, gradient, 60 states": lambda: grad(lambda p: anp.sum(dp.rollout(times, u, p, n, memory=64 * 32))),
        "rule, no gradient": lambda: dp.rollout(bare, u, 1.0, n),
        "rule, gradient": lambda: dp.value_and_grad(lambda u: anp.sum(dp.rollout(bare, u, 1.0, n)))(u),
    }
    best = {name: 1e6 / n * seconds for name, seconds in best_times(tasks, 5).items()}
    print("\nmicroseconds a step, 4 numbers")
    for name, value in best.items():
        print(f"{name:32} {value:8.2f}")
    print(f"overhead forward {best['rollout, no gradient'] - best['plain loop']:.2f} us")
    print(f"overhead with gradient {best['rollout, gradient'] - best['loop on the tape']:.2f} us, limit 50")
    print(f"a step that is a rule of its own {best['rule, gradient']:.2f} us")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, few repeats")
    parser.add_argument("--part", choices=("upwind", "memory", "files", "overhead"), help="one part only")
    options = parser.parse_args()
    parts = (options.part,) if options.part else ("overhead", "memory", "files", "upwind")
    if "overhead" in parts:
        overhead(1000 if options.quick else 5000)
    if "memory" in parts:
        memory((256, 256), 1000 if options.quick else 10_000, ("1 GB", "100 MB", "20 MB"))
        memory((16, 16), 10_000 if options.quick else 100_000, ("1 GB", "10 MB", "100 kB"))
    if "files" in parts:
        rows = (("20 MB", None), ("20 MB", "500 MB"), ("200 MB", None), ("200 MB", "20 GB"))
        files((256, 256), 1000 if options.quick else 100_000, rows)
    if "upwind" in parts:
        for shape in ((100_000,), (256, 256)) if options.quick else ((1_000_000,), (1024, 1024)):
            upwind(shape, 20 if options.quick else 100, 2)


if __name__ == "__main__":
    main()
