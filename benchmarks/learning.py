"""Update directions and layers beside the linear algebra they come down to.

Run ``python -m benchmarks.learning [--quick]`` in the root of the repository; OPENBLAS_NUM_THREADS=1 gives ratios that
hold on a shared machine.
"""

import argparse
import time
import tracemalloc

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.triad import best_times
from sparsedp import network
from sparsedp._utils import pytree
from sparsedp.autodiff.flattening import Packing
from sparsedp.optimize.linearization import Linearization
from sparsedp.optimize.update_direction import DirectionFamily

SIZES = (64, 64), (64, 128), (128, 64), (64, 64)  # 24896 weights


def poisson(rng, samples):
    """Misses of a network that chooses the source of an 8 x 8 Poisson problem, and its first weights."""
    grid = dp.Grid((8, 8), size=1.0)
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet), "direct")
    answers = np.stack([solve(unit.reshape(8, 8)).ravel() for unit in np.eye(64)])
    wanted = rng.standard_normal((samples, 64)) @ answers

    def misses(weights):
        hidden = wanted
        for layer in weights[:-1]:
            hidden = network.tanh(network.dense(layer, hidden))
        return network.dense(weights[-1], hidden) @ answers - wanted

    return misses, [network.dense_weights(rng, *size) for size in SIZES]


def flat(tree):
    """All numbers of a tree."""
    return np.concatenate([leaf.ravel() for leaf in pytree.leaves(tree)])


def measured(misses, weights, options):
    """Direction, seconds and peak memory [MB] of one step; memory in a run of its own."""
    task = lambda: dp.update_direction(misses, weights, method="krylov", **options)
    seconds = best_times({"step": task}, 1)["step"]
    tracemalloc.start()
    found, peak = task(), tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    return found, seconds, peak


def bidiagonalisation(quick):
    """Half-inverse steps without the Jacobian: 4096 x 24896 in < 1 s and < 100 MB; as the dense one on 8 samples."""
    for samples, options in (
        (8, {"truncation": 1e-10}),
        (8, {"truncation": 1e-2}),
        (64, {"truncation": 1e-2, "rank": 64}),
        (64, {"truncation": 1e-2, "rank": 128}),
    )[: 2 if quick else 4]:
        misses, weights = poisson(np.random.default_rng(0), samples)
        found, seconds, peak = measured(misses, weights, options)
        told = f"{samples * 64} x 24896, {options}: {len(found.spectrum)} steps, {seconds:.2f} s, {peak:.0f} MB"
        if samples == 8:
            clock = time.perf_counter()
            dense = flat(dp.update_direction(misses, weights, method="dense", apart=True, **options).step)
            gap = np.linalg.norm(flat(found.step) - dense) / np.linalg.norm(dense)
            told += f"; dense {time.perf_counter() - clock:.2f} s, apart by {gap:.0e} (limit 1e-6)"
        print(told, flush=True)


def oscillators(rng):
    """Misses of a network that steers two oscillators, on a batch of 32, and its weights: examples/half_inverse.py."""
    springs = np.array([[0, 0, -1.2, 0.2], [0, 0, 0.2, -1.2], [1, 0, 0, 0], [0, 1, 0, 0]])
    move = dp.stepper("rk4", lambda u, force: u @ springs + force[:, None] * np.eye(4)[3], 0.5)
    free = dp.rollout(move, np.eye(4), np.zeros(4), 24)
    driven = dp.rollout(lambda u, _, force: move(u, force), np.zeros((24, 4)), None, 24, inputs=np.eye(24))
    states = rng.random((32, 4))

    def misses(weights):
        hidden = states
        for layer in weights[:-1]:
            hidden = network.tanh(network.dense(layer, hidden))
        return states @ free + network.dense(weights[-1], hidden) @ driven - states

    return misses, [network.dense_weights(rng, *size) for size in ((4, 20), (20, 20), (20, 20), (20, 24))]


def by_svd(quick):
    """A half-inverse direction for the 128 x 1444 Jacobian of the oscillators: limit 4 x a dense SVD."""
    misses, weights = oscillators(np.random.default_rng(0))
    packing, family = Packing(weights), DirectionFamily()
    point = packing.pack(weights)

    def by_hand(jacobian, g):
        left, s, right = np.linalg.svd(jacobian, full_matrices=False)
        kept = s > 1e-10 * s[0]
        return right[kept].T @ (left.T[kept] @ g / np.sqrt(s[kept]))

    def dense(apart):
        linearised = Linearization(misses, packing, point, apart=apart)
        return by_hand(linearised.rows(), linearised.flat)

    linearised = Linearization(misses, packing, point, apart=True)
    jacobian, g = linearised.rows(), linearised.flat
    known = by_hand(jacobian, g)
    gap = np.linalg.norm(family(linearised, g).step - known) / np.linalg.norm(known)
    tasks = {
        "direction": lambda: family.dense(jacobian, g),
        "by SVD": lambda: by_hand(jacobian, g),
        "update": lambda: dp.update_direction(misses, weights, method="dense", apart=True),
        "its SVD": lambda: dense(True),
        "rows": lambda: dense(False),
    }
    spent = best_times(tasks, 3 if quick else 20)
    alone, whole, by_rows = spent["by SVD"] / spent["direction"], spent["its SVD"] / spent["update"], spent["rows"]
    print(f"128 x 1444: dense SVD {alone:.1f} x the time of our direction, apart by {gap:.0e}")
    print(f"  with the Jacobian {whole:.1f} x, with the Jacobian row by row {by_rows / spent['update']:.1f} x")


def convolutions(quick):
    """Value and gradient at 64^2, 32 channels, 5 x 5, batch 8: >= 30 % of one gemm of equal flops."""
    rng, n, channels = np.random.default_rng(0), 32 if quick else 64, 32
    p = network.convolution_weights(rng, channels, channels, (5, 5))
    x, goal = rng.standard_normal((2, 8, channels, n, n))
    loss = dp.value_and_grad(lambda both: 0.5 * anp.sum((network.convolution(*both) - goal) ** 2))
    filters, columns = rng.standard_normal((channels, channels * 25)), rng.standard_normal((channels * 25, 8 * n * n))
    square = rng.standard_normal((1024, 1024))
    tasks = {"conv": lambda: loss((p, x)), "gemm": lambda: filters @ columns, "square": lambda: square @ square}
    spent = best_times(tasks, 3)
    speed = 6e-9 * channels**2 * 25 * 8 * n * n / spent["conv"]  # forward, and both products of the backward pass
    same, best = 2e-9 * channels**2 * 25 * 8 * n * n / spent["gemm"], 2e-9 * 1024**3 / spent["square"]
    print(
        f"convolution {n}^2: {100 * speed / same:.0f} % of one gemm of its shape, {100 * speed / best:.0f} % of 1024^3"
    )


SECTIONS = {f.__name__: f for f in (by_svd, convolutions, bidiagonalisation)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    for section in given.sections or SECTIONS:
        SECTIONS[section](given.quick)
