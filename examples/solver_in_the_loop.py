"""A network inside a coarse solver. Run: python examples/solver_in_the_loop.py [gradients] [--out FOLDER]"""

import sys
from functools import cache
from pathlib import Path
from time import perf_counter, process_time

import autograd.numpy as np

import sparsedp as dp
from sparsedp.network import convolution, convolution_weights, tanh

count = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 600
runs, dt, nu = 16, 0.1, 0.01


def solver(cells, dt):
    """u_t + (u^2 / 2 - nu u_x + network)_x = f on a ring, explicit and upwind: where cells are coarse, it smears."""
    sheet = dp.Grid((runs, cells), spacing=(1e9, 2 * np.pi / cells), periodic=True)  # a row is a run, far from others
    A, G = (dp.component(sheet, 1) @ op for op in (dp.average(sheet), dp.gradient(sheet)))
    D = dp.divergence(sheet) @ dp.component(sheet, 1).T

    def step(u, weights, f):
        flux = 0.5 * A(u**2) - (nu + np.pi / cells * abs(A(u))) * G(u) + network(weights, u)
        return u + dt * (f - D(flux))  # what leaves a cell enters the next, whatever the network says

    return step, sheet.centres()[1]


def network(weights, u):
    """Fields -> fluxes, by convolutions. No weights: no correction."""
    if not weights:
        return 0.0
    *hidden, last = weights
    u = u[:, None]
    for layer in hidden:
        u = tanh(convolution(layer, u))
    return convolution(last, u)[:, 0]


coarse, _ = solver(32, dt)
fine, x = solver(128, dt / 8)
coarsen = lambda u: u.reshape(-1, runs, 32, 4).mean(axis=3)


@cache
def record(number, frames=160):
    """What the fine solver does under 20 travelling sines for each run: states and forces, on coarse cells."""
    rng, force, t = np.random.default_rng(number), 0.0, (np.arange(8 * frames) + 0.5)[:, None, None] * dt / 8
    for _ in range(20):
        height, speed, phase = (rng.uniform(*ends, (runs, 1)) for ends in ((-0.5, 0.5), (-0.4, 0.4), (0, 2 * np.pi)))
        force = force + height * np.sin(speed * t + rng.integers(3, 7, (runs, 1)) * x + phase)
    u = dp.rollout(fine, 0 * x, (), 8 * frames, inputs=force, keep="all")
    return coarsen(u[::8]), coarsen(force).reshape(frames, 8, runs, 32).mean(axis=1)


def miss(weights, window, **options):
    """Coarse states, with the network in every step, minus the true ones."""
    states, forces = window
    return dp.rollout(coarse, states[0], weights, len(forces), inputs=forces, keep="all", **options) - states


def window(number, begin, k):
    states, forces = record(number)
    return states[begin : begin + k + 1], forces[begin : begin + k]


def train(unrolled, truncate=None, fresh=True):
    """Adam in three rounds of falling rate; the number of unrolled steps may change with the round."""
    rng, done = np.random.default_rng(0), 0
    layers = (1, 16, 1.0), (16, 16, 1.0), (16, 1, 0.0)  # no correction at the start
    weights = [convolution_weights(rng, *sizes, 5, gain) for *sizes, gain in layers]
    for k, rate in zip(unrolled, (3e-3, 1e-3, 3e-4)):
        # Every 150 gradients a new record, made when it is asked for; or the frames of the first one, always.
        draw = lambda i, k=k, done=done: window((done + i) // 150 if fresh else 0, 20 + 37 * i % 120, k)
        loss = lambda weights, seen: np.mean(miss(weights, seen, truncate=truncate) ** 2)
        weights, done = dp.minimize(loss, weights, "adam", count // 3, 0, batches=draw, rate=rate).x, done + count // 3
    return weights


unseen = window(10**6, 50, 100)
size = lambda off: np.sqrt(np.mean(off**2, axis=(1, 2)))  # at each step
curves = {"no network": size(miss((), unseen))}
without = np.mean(curves["no network"] ** 2) ** 0.5
print(f"100 steps of {runs} unseen runs   seconds    cpu  ms each   error  coarse/hybrid  mass lost")
print(f"{'no network':52} {without:7.4f}")
for label, options in {
    "1 step of the same frames": {"unrolled": (1, 1, 1), "fresh": False},
    "1 step": {"unrolled": (1, 1, 1)},
    "4 steps, gradients stopped": {"unrolled": (4, 4, 4), "truncate": 1},
    "4 steps, truncated at 2": {"unrolled": (4, 4, 4), "truncate": 2},
    "4 steps": {"unrolled": (4, 4, 4)},
    "1, then 4, then 8 steps": {"unrolled": (1, 4, 8)},
}.items():
    clock, cpu = perf_counter(), process_time()
    weights = train(**options)
    spent = f"{perf_counter() - clock:8.1f} {process_time() - cpu:6.1f} {1e3 * (process_time() - cpu) / count:8.1f}"
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            off = miss(weights, unseen)
    except dp.errors.NonFiniteError:
        off = np.full_like(unseen[0], np.inf)  # the network drove the solver beyond all bounds
    curves[label], error, lost = size(off), np.mean(off**2) ** 0.5, np.max(abs(np.mean(off, axis=2)))
    print(f"{label:28} {spent} {error:7.4f} {without / error:14.2f} {lost:10.0e}", flush=True)

if "--out" in sys.argv:
    from matplotlib import pyplot

    pyplot.figure(figsize=(12, 3.6))
    states = {"fine": unseen[0], "coarse": unseen[0] + miss((), unseen), "with the network": unseen[0] + off}
    for place, (title, u) in enumerate(states.items(), 1):  # x to the right, time upwards
        axes = pyplot.subplot(1, 4, place, title=title)
        axes.imshow(u[:, 0], "RdBu", aspect="auto", vmin=-1.5, vmax=1.5, origin="lower")
    axes = pyplot.subplot(1, 4, 4, title="error at each step")
    for label, curve in curves.items():
        axes.semilogy(curve, label=label)
    axes.legend(fontsize="x-small")
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    pyplot.savefig(Path(sys.argv[-1]) / "solver_in_the_loop.png", dpi=120, bbox_inches="tight")
