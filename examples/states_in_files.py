r"""
A long run within little memory
===============================

The gradient of a loss through many time steps, with checkpoints in files, interrupted and continued.

The backward pass of a time loop needs every state once, in reverse order. If the states do not fit into the memory,
some are kept as checkpoints, and the others are computed again from them. Files hold more checkpoints, so that fewer
steps are run again. An interrupted run continues from them.

Run it: ``python examples/states_in_files.py [cells] [--out FOLDER]``
"""

import argparse
import tempfile
from functools import partial
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="A gradient with states in files.")
parser.add_argument("cells", nargs="?", type=int, default=48)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The scene
# ---------
# A vortex in a closed box carries a drop of ink. A step transports the ink and the velocity of the wind, and the
# projection makes the velocity divergence-free.

grid = dp.Grid((options.cells, options.cells), size=1.0)
n_steps = 400
dt = 0.4 / options.cells
carry_ink = dp.transport(grid)
carry_wind = dp.transport(grid, "semi_lagrangian", boundary=dp.dirichlet, of="faces")
project = dp.projection(grid)
x, y = grid.centres()
ink = np.exp(-((x - 0.3) ** 2 + (y - 0.5) ** 2) / 0.005)
window = np.hanning(options.cells + 1)
wind = dp.curl(grid)(0.12 * np.outer(window, window))


def step(state, _):
    """Return ink and wind after one time step."""
    ink, wind = state
    wind = project(carry_wind(wind, wind, dt))
    return carry_ink(ink, wind, dt), wind


# %%
# The loss
# --------
# The ink at the end in a disk on the right. Its gradient says which change of the initial wind brings more ink there.

target = 1.0 * ((x - 0.7) ** 2 + (y - 0.5) ** 2 < 0.15**2)


def loss(wind, **settings):
    """Return minus the fraction of the ink that is in the target at the end."""
    end, _ = dp.rollout(step, (ink, wind), None, n_steps, **settings)
    return -np.sum(target * end) / np.sum(ink)


# %%
# Four budgets
# ------------
# All states in memory; ten states in memory; ten in memory and 40 in files; ten in memory and all others in files. The
# gradient has the same bits. Only the number of steps that are run again differs, and with it the time.

state_bytes = ink.nbytes + wind.nbytes
memory = 16 * state_bytes
exact = dp.grad(loss)(wind)
rows = []
with tempfile.TemporaryDirectory() as folder:
    budgets = {
        "all in memory": {},
        "ten in memory": {"memory": memory},
        "ten in memory, 40 in files": {"memory": memory, "disk": (folder, 40 * state_bytes)},
        "ten in memory, all in files": {"memory": memory, "disk": folder},
    }
    print(f"{n_steps} steps, a state has {state_bytes / 1e3:.0f} kB")
    print(f"{'states':28} {'in files':>8} {'runs of a step':>15} {'seconds':>8}  gradient")
    for name, settings in budgets.items():
        passes = []  # a record of the forward pass, and one of the backward pass
        start = perf_counter()
        gradient = dp.grad(partial(loss, record=passes.append, **settings))(wind)
        seconds = perf_counter() - start
        forward, backward = passes
        rows.append((name, backward.factor, seconds))
        same = "the same bits" if np.array_equal(gradient, exact) else "DIFFERENT"
        print(f"{name:28} {forward.on_disk:8} {backward.factor:15.2f} {seconds:8.2f}  {same}")

# %%
# Interrupted and continued
# -------------------------
# The run is interrupted by Ctrl-C at step 300. The files remain, and the same call continues from the last one of them.
# After the gradient the folder is empty. The same holds if the process is killed, for instance by the end of a batch
# job.


class InterruptedStep:
    """The same step; its call number 300 is interrupted."""

    def __init__(self):
        self.calls = 0

    def __call__(self, state, _):
        self.calls += 1
        if self.calls == 300:
            raise KeyboardInterrupt
        return step(state, _)


interrupted_step = InterruptedStep()
with tempfile.TemporaryDirectory() as folder:
    passes = []

    def long_loss(wind):
        """The same loss with the step that is interrupted."""
        settings = {"memory": memory, "disk": folder, "record": passes.append}
        end, _ = dp.rollout(interrupted_step, (ink, wind), None, n_steps, **settings)
        return -np.sum(target * end) / np.sum(ink)

    try:
        dp.grad(long_loss)(wind)
    except KeyboardInterrupt:
        print("interrupted at step 299")
    gradient = dp.grad(long_loss)(wind)
    same = "the same bits" if np.array_equal(gradient, exact) else "DIFFERENT"
    print(f"continued from state {passes[0].resumed_at}: {same}, {len(list(Path(folder).iterdir()))} files remain")

# %%
# The picture
# -----------
# Left: the ink at the end, the target, and the change of the initial wind that brings more ink there. Right: how often
# each step was run.
#
# Exercises
# ---------
# 1. Halve the memory again and again. How does the number of runs grow, and when does rollout refuse?
# 2. Replace `step` by a cheaper one. From which time of a step on do files pay off on your disk?
# 3. Kill the process by `kill -9` while it computes the gradient, and run it again.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    end, _ = dp.rollout(step, (ink, wind), None, n_steps)
    picture, axes = pyplot.subplots(1, 2, figsize=(9.5, 3.8), layout="constrained")
    axes[0].contourf(np.array(x), np.array(y), end, 12, cmap="Blues")
    axes[0].contour(np.array(x), np.array(y), target, [0.5], colors="black")
    along_x, along_y = grid.split(-exact)
    u = 0.5 * (along_x[1:] + along_x[:-1])
    v = 0.5 * (along_y[:, 1:] + along_y[:, :-1])
    every = slice(1, None, max(options.cells // 16, 1))
    axes[0].quiver(x[every, every], y[every, every], u[every, every], v[every, every], color="tab:red")
    axes[0].set(title="ink at the end, target, change of the wind", xlabel="x", ylabel="y", aspect="equal")
    names = [name.replace(", ", ",\n") for name, _, _ in rows]
    axes[1].barh(names, [runs for _, runs, _ in rows])
    axes[1].invert_yaxis()
    axes[1].set(title="runs of each step", xlabel="runs")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "states_in_files.png", dpi=120)
