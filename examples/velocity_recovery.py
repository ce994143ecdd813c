"""Recover the velocity that carried a marker. Run: python examples/velocity_recovery.py [cells] [--out picture.png]"""

import sys

import autograd.numpy as np

import sparsedp as dp

sizes = [int(word) for word in sys.argv[1:] if word.isdigit()]
n, steps = sizes[0] if sizes else 64, 60 * (sizes[0] if sizes else 64) // 64
grid = dp.Grid(n, size=1.0, periodic=True)
(x,) = grid.centres()
move, dt = dp.transport(grid, velocity="cells"), 0.5 / n / 1.3  # upwind, one velocity for each cell
step = lambda u, v: move(u, v, dt)
start = np.exp(-(((x - 0.3) / 0.06) ** 2) / 2)
hidden = 1 + 0.3 * np.sin(2 * np.pi * x)


def carried(v):
    return dp.rollout(step, start, v, steps)


seen = carried(hidden)


def loss(v):
    return np.sum((carried(v) - seen) ** 2)


# A marker that does not overlap with what was seen has no slope towards it: try a few constant velocities first.
trials = np.linspace(-1, 1.25, 10)
guess = min(trials, key=lambda speed: loss(np.full(n, speed)))
passed = np.max(dp.rollout(step, start, hidden, steps, keep="all"), axis=0) > 0.2  # elsewhere nothing can be known

print(f"{n} cells, {steps} upwind steps; the marker passes {np.count_nonzero(passed)} cells\n")
print("start                    method        loss at start   after   gradients   error where it passed")
found = {}
for label, first in (("rest", np.zeros(n)), (f"constant {guess:+.2f}", np.full(n, guess))):
    for method in ("gd", "lbfgs"):
        options = {"rate": 0.01} if method == "gd" else {}
        best = dp.minimize(loss, first, method, maxiter=200, **options)
        error = np.max(np.abs(best.x - hidden)[passed])
        found[label, method] = best.x
        print(f"{label:24} {method:12} {loss(first):10.2f} {best.value:12.1e} {len(best.history):8} {error:16.3f}")

if "--out" in sys.argv:
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    left.plot(x, start, ":", x, seen, "k", x, carried(best.x), "--")
    left.legend(["start", "seen", "carried by the velocity found"], loc="upper right")
    right.plot(x, hidden, "k", x, np.where(passed, best.x, np.nan), "--", x, best.x, ":")
    right.legend(["hidden velocity", "found where the marker passed", "found elsewhere"], loc="lower left")
    figure.savefig(sys.argv[sys.argv.index("--out") + 1])
