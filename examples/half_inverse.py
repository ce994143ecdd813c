"""A network steers two oscillators, trained three ways. Run: python examples/half_inverse.py [epochs] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp
from sparsedp import network

epochs, rng = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 4, np.random.default_rng(0)
SPRINGS = np.array([[0, 0, -1.2, 0.2], [0, 0, 0.2, -1.2], [1, 0, 0, 0], [0, 1, 0, 0]])  # to the wall 1, between 0.2
move = dp.stepper("rk4", lambda u, force: u @ SPRINGS + force[:, None] * np.eye(4)[3], 0.5)  # two places, two speeds
free = dp.rollout(move, np.eye(4), np.zeros(4), 24)  # linear physics: the ends of unit states, and of unit forces
driven = dp.rollout(lambda u, _, force: move(u, force), np.zeros((24, 4)), None, 24, inputs=np.eye(24))
seen, unseen = rng.random((2, 4096, 4))
sizes, curves = ((4, 20), (20, 20), (20, 20), (20, 24)), {}
start = [{"weight": rng.uniform(-1, 1, s) * np.sqrt(6 / sum(s)), "bias": np.zeros(s[1])} for s in sizes]  # Glorot


def misses(weights, states):
    """End minus wanted end, which is the start, under the forces that the network chooses."""
    hidden = states
    for layer in weights[:-1]:
        hidden = network.tanh(network.dense(layer, hidden))
    return states @ free + network.dense(weights[-1], hidden) @ driven - states


loss = lambda weights, states=seen: np.mean(np.sum(misses(weights, states) ** 2, axis=1))


def train(label, f, method, maxiter, every, budget=np.inf, published="", **options):
    def watch(record, x):
        if record.iteration % every == 0 or record.seconds > budget:
            curves.setdefault(label, []).append((record.seconds, loss(x)))
            told = f"{label:22} {record.iteration:9} {record.seconds:8.2f} {loss(x):10.1e} {loss(x, unseen):10.1e}"
            print(told, *published.split()[len(curves[label]) - 1 :][:1])
        return record.seconds > budget

    return dp.minimize(f, start, method, maxiter, 0, watch, **options)


print("method                 gradients  seconds       loss     unseen published")
batches = list(seen[rng.permuted(np.tile(np.arange(4096), (epochs, 1)), axis=1)].reshape(-1, 32, 4))
options = {"batches": batches, "rate": 2 / 32, "apart": True}  # the published loss is a mean: 2 / 32 of the misses
train("half-inverse", misses, "half_inverse", 128 * epochs, 128, published="5.4e-5 1.1e-5 3.2e-6 1.2e-6", **options)
few, options = seen[:128], {"apart": True, "damping": 1e-4}  # 512 misses for 1444 weights
best = train("Levenberg-Marquardt", lambda w: misses(w, few), "levenberg_marquardt", 90, 30, **options)
print(f"  on the 128 samples that it sees: {loss(best.x, few):.1e}")
train("Adam, equal time", loss, "adam", 10**6, 1500, max(curve[-1][0] for curve in curves.values()), batches=batches)

if "--out" in sys.argv:
    from matplotlib import pyplot

    for label, curve in curves.items():
        pyplot.loglog(*zip(*curve), "o-", label=label)
    pyplot.legend()
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    pyplot.savefig(Path(sys.argv[-1]) / "half_inverse.png", dpi=120)
