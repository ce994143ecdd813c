"""A first guess for CG, learned with and without the solver. Run: python examples/warm_start_learned.py [cells]"""

import sys

import autograd.numpy as np

import sparsedp as dp
from sparsedp import network

n = int(sys.argv[1]) if len(sys.argv) > 1 else 32
k, m, rng = n // 4, n // 8, np.random.default_rng(0)  # iterations of CG; cells in a side of the network's blocks
CG = "guess, again through CG"
grid = dp.Grid((n, n))
box, energy = -dp.laplacian(grid), lambda x, b: np.sum(x * (0.5 * box(x) - b))
solve = dp.inverse(box, "krylov", diff="unrolled", iterations=k, nullspace="project")  # the tape keeps all k
*both, direct = (dp.inverse(box, name, 1e-3, nullspace="project") for name in ("krylov", "multigrid", "direct"))
coarse = dp.prolong(grid, m, "linear").matrix.toarray().T


def smoke_divergence():
    """Divergence of a buoyant flow, scaled to 1: what the pressure solve of a smoke simulation sees."""
    x, y = grid.centres()
    places = zip(rng.uniform(0.2, 0.8, 4) * n, rng.uniform(0.1, 0.5, 4) * n, rng.uniform(0.03, 0.1, 4) * n)
    smoke = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * r**2)) for cx, cy, r in places)
    b = dp.divergence(grid)(dp.interior(grid)(grid.join(0.0, dp.component(grid, 1)(dp.average(grid)(smoke)))))
    return b / np.sqrt(np.mean(b**2))


def guess(w, b):
    """Network: a dense layer on 8 x 8 blocks for what is long, two convolutions for what is short."""
    blocks = b.reshape(-1, 8, m, 8, m).mean((2, 4)).reshape(-1, 64)
    near = network.tanh(network.convolution(w["first"], b[:, None], "replicate"))
    near = network.convolution(w["second"], near, "replicate")[:, 0]
    return np.reshape(network.dense(w["far"], blocks) @ coarse, b.shape) + near


def loss(w, batch, through=True):
    """The energy, which CG itself makes small, after its iterations or before: no answer is needed to train."""
    return sum(energy(solve(b, start=x) if through else x, b) for b, x in zip(batch, guess(w, batch)))


w = {"far": network.dense_weights(rng, 64, 64, 0.0), "first": network.convolution_weights(rng, 1, 8, (5, 5))}
w["second"] = network.convolution_weights(rng, 8, 1, (5, 5), 0.0)  # so that the first guess is 0
seen, unseen = (np.stack([smoke_divergence() for _ in range(count)]) for count in (64, 8))
found, parts = {"": w}, [seen[i : i + 2] for i in range(0, 64, 2)]
print(f"after {k} iterations of CG, from     trained [s]  residual    error  CG to 1e-3  multigrid")
for label, old in (("zero", ""), ("guess", "zero"), ("guess, trained again", "guess"), (CG, "guess")):
    f, steps = (lambda w, b, on=label == CG: loss(w, b, on)), 10 * n if old else 0
    best = dp.minimize(f, found[old], "adam", steps, 0, rate=0.01 if old == "guess" else 0.03, batches=parts)
    found[label] = best.x
    cases = [(b, x, solve(b, start=x), direct(b)) for b, x in zip(unseen, guess(best.x, unseen))]
    left = np.mean([np.linalg.norm(b - box(end)) / n for b, _, end, _ in cases])
    off = np.mean([np.sqrt(1 - energy(end, b) / energy(y, b)) for b, _, end, y in cases])  # in the energy norm
    few, v = np.mean([[(inv(b, start=x), inv.info.forward.iterations)[1] for b, x, *_ in cases] for inv in both], 1)
    print(f"{label:33} {best.history[-1].seconds:9.1f} {left:10.1e} {off:8.1e} {few:10.1f} {v:10.1f}", flush=True)
