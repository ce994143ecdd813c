"""A law from twelve experiments, by two processes. Run: python examples/ensemble.py [iterations] [--out FOLDER]

Heat spreads by u_t = div(k(u) grad u), and nobody knows k. Each experiment tells how a field began and how it ended.
A small network stands for k inside every implicit step; `dp.ensemble` adds up the misfits and their gradients, each
experiment on whichever process is free, always in the same order: the numbers do not depend on the processes.
"""

import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from sparsedp.network import dense, dense_weights, softplus, tanh

iterations = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 60
grid, dt, steps = dp.Grid((16, 16), size=1.0), 0.01, 4
G, D, A = dp.gradient(grid), dp.divergence(grid), dp.average(grid)
solve = dp.elliptic_solver(D, G, rtol=1e-9)


def network(weights, u):
    """Conductivity at each value of u, always positive."""
    hidden, last = weights
    return softplus(dense(last, tanh(dense(hidden, u[:, None]))))[:, 0]


def law(u):
    """The truth: what is hot conducts better."""
    return 0.02 + 0.2 * u**2


def end(conductivity, u):
    """Implicit steps (1/dt - div k grad) u_new = u / dt, with k of the old u on faces."""
    for _ in range(steps):
        u = solve(conductivity(A(u)), u / dt, 1 / dt)
    return u


def experiment(seed):
    """Three hot spots -> how the field begins, and how it ends."""
    rng, (x, y) = np.random.default_rng(seed), grid.centres()
    spots = [np.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.02) for a, b in rng.uniform(0.1, 0.9, (3, 2))]
    start = np.minimum(sum(spots), 1.0)
    return start, end(law, start)


def misfit(weights, scene):
    start, wanted = scene
    return np.mean((end(lambda u: network(weights, u), start) - wanted) ** 2)


if __name__ == "__main__":  # other processes read this file, too
    scenes, rng = [experiment(seed) for seed in range(12)], np.random.default_rng(0)
    start = dense_weights(rng, 1, 8), dense_weights(rng, 8, 1)
    one = dp.value_and_grad(dp.ensemble(misfit, scenes, weights=np.full(12, 1 / 12)))(start)
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        total = dp.ensemble(misfit, scenes, pool, weights=np.full(12, 1 / 12))
        two = dp.value_and_grad(total)(start)
        same = one[0] == two[0] and np.array_equal(one[1][0]["weight"], two[1][0]["weight"])
        print(f"value and gradient, here and by two processes: {'the same bits' if same else 'DIFFERENT'}")
        clock = perf_counter()
        best = dp.minimize(total, start, "lbfgs", maxiter=iterations)
        print(f"{len(best.history) - 1} iterations of 12 experiments in {perf_counter() - clock:.1f} s")
    u = np.linspace(0.0, 1.0, 101)
    off = np.max(abs(network(best.x, u) - law(u)))
    unseen = misfit(best.x, experiment(99)) ** 0.5
    print(f"misfit {one[0]:.1e} -> {best.value:.1e}; k(u) off by {off:.1e}, a field not seen by {unseen:.1e}")
    if "--out" in sys.argv:
        from matplotlib import pyplot

        pyplot.figure(figsize=(5, 3.5), layout="constrained")
        pyplot.plot(u, law(u), "k", label="the law")
        pyplot.plot(u, network(start, u), ":", label="network, before")
        pyplot.plot(u, network(best.x, u), "--", label="network, learned")
        pyplot.xlabel("u")
        pyplot.ylabel("conductivity k(u)")
        pyplot.legend()
        Path(sys.argv[-1]).mkdir(exist_ok=True)
        pyplot.savefig(Path(sys.argv[-1]) / "ensemble.png", dpi=120)
