"""Edges in the ground, by total variation. Run: python examples/edges.py [cells] [--out FOLDER]

The scene of `python -m sparsedp demo`: pump at twelve wells, read the pressure at 480 sensors, ask for log k. Here the
ground is made of blocks. |grad log k|^2 spreads their edges; the total variation, |grad log k|, lets them jump.
"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp
from sparsedp.report.demo.scene import Ground, survey

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 40
grid = dp.Grid((n, n), size=1.0)


def blocks(grid):
    """log k: a conductive block, a tight one, 0 around."""
    x, y = grid.centres()
    hard = (abs(x - 0.7) < 0.15) & (abs(y - 0.65) < 0.2)
    return 1.5 * ((abs(x - 0.3) < 0.17) & (abs(y - 0.35) < 0.2)) - 1.5 * hard


data = survey(dp.Grid((2 * n, 2 * n), size=1.0), blocks(dp.Grid((2 * n, 2 * n), size=1.0)))
ground, hidden = Ground(grid, data.wells, data.sensors), blocks(grid)


def search(regularizer, weight):
    """The ground that fits the readings, as smooth as the regularizer has it."""

    def loss(logk):
        misfit = (ground.readings(logk) - data.readings) / data.noise
        return 0.5 * np.mean(misfit**2) + weight * regularizer(logk)

    return dp.minimize(loss, np.zeros(grid.shape), maxiter=120)


# The best of a scan: readings on a coarser grid than the one they were made on are off by more than noise.
terms = {"smooth": (dp.smoothness(grid), 1e-2), "edges": (dp.total_variation(grid, eps=0.3), 0.2)}
fields = {"the ground": hidden}
print("regularizer     weight  error of log k  of its jumps  evaluations")
for name, (term, weight) in terms.items():
    best = search(term, weight)
    jumps = [dp.gradient(grid)(u) for u in (best.x, hidden)]
    errors = [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in ((best.x, hidden), jumps)]
    print(f"{name:12} {weight:9.0e} {errors[0]:15.3f} {errors[1]:13.3f} {best.evaluations:12}")
    fields[name] = best.x

if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(10.5, 3), layout="constrained")
    for axes, (name, field) in zip(picture.subplots(1, 3), fields.items()):
        dp.plot(grid, field, ax=axes, title=name, limits=(-1.6, 1.6), label="log k")
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "edges.png", dpi=120, bbox_inches="tight")
