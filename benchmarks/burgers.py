"""What a gradient costs where the arrays are small and Python is what takes time: Burgers' equation, case A7.

128 cells, 16 steps; the loss is the mean square of the miss at the end. All rows run in turn, the smallest time counts.
Beside it stands the largest difference of the gradient to that of the tape of autograd, relative to the largest entry.

Run ``python -m benchmarks.burgers`` in the root of the repository.
"""

import subprocess
import sys

import autograd
import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.triad import best_times
from sparsedp import kernels

N, STEPS, DT, NU = 128, 16, 1 / 32, 0.01 / (128 * np.pi)
RING = dp.Grid(N, size=2.0, origin=-1.0, periodic=True)
START = -np.sin(np.pi * RING.centres()[0])
SEEN = 0.5 * START
FIRST = """
import time

import benchmarks.burgers as b
from sparsedp import kernels
kernels.compiled() and __import__("numba")
begun = time.process_time()
b.dp.value_and_grad(b.looped(b.composed()))(b.START)
print(time.process_time() - begun)
"""


def by_slices():
    """The step as a user of autograd writes it."""
    h = 2.0 / N

    def step(u, v):
        d = u + DT * NU / h**2 * (anp.roll(u, -1) - 2 * u + anp.roll(u, 1))
        place = np.arange(N) - DT / h * d
        cell = anp.floor(place).astype(int)
        part = place - cell
        return (1 - part) * d[cell % N] + part * d[(cell + 1) % N]

    return step


def composed():
    """The step of the literature, composed from an operator and a transport."""
    L, carry = dp.laplacian(RING), dp.transport(RING, "semi_lagrangian", velocity="cells")

    def step(u, v):
        d = u + DT * NU * L(u)
        return carry(d, d, DT)

    return step


def donor_cell():
    """A step that is one rule of the library: (as a user of autograd writes it, as it is)."""
    move, share = dp.transport(RING, "upwind", velocity="cells"), DT / 4 * N / 2.0

    def step(u, v):
        ahead, behind = anp.roll(u, -1) - u, u - anp.roll(u, 1)
        return u - share * (anp.minimum(v, 0.0) * ahead + anp.maximum(v, 0.0) * behind)

    return step, lambda u, v: move(u, v, DT / 4)


def looped(step):
    """Loss of a start: every step on the tape."""

    def loss(u):
        for _ in range(STEPS):
            u = step(u, SEEN)
        return anp.mean((u - SEEN) ** 2)

    return loss


def rolled(step):
    """The same, with the time loop as one node."""
    return lambda u: anp.mean((dp.rollout(step, u, SEEN, STEPS) - SEEN) ** 2)


def descents(gradient):
    """51 gradients, one after another."""

    def run():
        u = np.zeros(N)
        for _ in range(51):
            u = u - 5 * gradient(u)
        return u

    return run


def of_autograd():
    """Microseconds that autograd takes for one primitive of one short array, forward and backward."""

    def chain(many):
        def loss(u):
            for _ in range(many):
                u = -u
            return anp.sum(u)

        return lambda: autograd.grad(loss)(START)

    best = best_times({many: chain(many) for many in (20, 120)}, 300)
    return 1e6 * (best[120] - best[20]) / 100


def main():
    ours = lambda loss: lambda u: dp.value_and_grad(loss)(u)[1]
    slices, rule = donor_cell()
    rows = {  # name: gradient, what it is compared with, limit [ms]
        "composed step, autograd's own": (autograd.grad(looped(by_slices())), None, None),
        "composed step, every step on the tape": (ours(looped(composed())), 0, 1.0),
        "composed step, rollout": (ours(rolled(composed())), 0, 1.0),
        "one rule, autograd's own": (autograd.grad(looped(slices)), None, None),
        "one rule, every step on the tape": (ours(looped(rule)), 3, None),
        "one rule, rollout": (ours(rolled(rule)), 3, 0.13),
    }
    gradients = [gradient for gradient, _, _ in rows.values()]
    best = best_times({name: lambda g=g: g(START) for name, (g, _, _) in rows.items()}, 300)
    print(f"{N} cells, {STEPS} steps, value and gradient, kernels: {'numba' if kernels.compiled() else 'NumPy'}")
    print(f"{'':40} {'ms':>8} {'limit':>6} {'x autograd':>11} {'error':>9}")
    for name, (gradient, like, limit) in rows.items():
        line = f"{name:40} {1e3 * best[name]:8.3f} {limit or '':>6}"
        if like is not None:
            known, reference = gradients[like](START), best[list(rows)[like]]
            error = np.max(np.abs(gradient(START) - known)) / np.max(np.abs(known))
            line += f" {reference / best[name]:11.1f} {error:9.1e}"
        print(line)
    tasks = {"on the tape": descents(gradients[1]), "rollout": descents(gradients[2])}
    for name, seconds in best_times(tasks, 10).items():
        print(f"51 gradients, composed step, {name:12} {1e3 * seconds:7.1f} ms, limit 100")
    print(f"autograd's own tape takes {of_autograd():.1f} us a primitive, 5 where the limits were measured")
    first = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True)
    print(f"first gradient of a process, numba loaded {1e3 * float(first.stdout):7.1f} ms, limit 50")


if __name__ == "__main__":
    main()
