r"""
The least force that ends a flow as wanted
==========================================

A hundred scenes at once, by gradients through the physics, beside a search without gradients.

In each scene two humps of velocity run into each other. An unknown steady force brought the flow to a known final
state. We look for the weakest force that leads to the same final state; it may differ in every cell and every step.
Published solutions used reinforcement learning and a learned controller; this example uses adjoint gradients.

Run it: ``python examples/control.py [scenes] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="The least force that ends a flow as wanted, in many scenes at once.")
parser.add_argument("scenes", nargs="?", type=int, default=100)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()
scenes = options.scenes

# %%
# Many scenes, one grid
# ---------------------
# Each scene is a periodic interval with 32 cells. All scenes are the columns of one two-dimensional grid. The columns
# are so far apart that they do not influence each other: one call of an operator then computes all scenes.
#
# In each scene the velocity satisfies Burgers' equation with a force,
#
# .. math:: u_t + u \, u_x = \nu \, u_{xx} + f .

CELLS, STEPS = 32, 32
dt = 0.03
viscosity = 0.003

sheet = dp.Grid((CELLS, scenes), spacing=(1 / CELLS, 1e9), periodic=True)
x = sheet.centres()[0]
carry = dp.transport(sheet, "semi_lagrangian", velocity="cells")
spread = dp.identity(sheet.cells) + viscosity * dt * dp.laplacian(sheet)
along_x = np.array([1.0, 0.0])[:, None, None]  # a velocity has two components; ours has the first


def step(u, _, push):
    """One time step: advection of the velocity by itself, diffusion, then the force."""
    return spread(carry(u, u * along_x, dt)) + push


# %%
# Starts and ends
# ---------------
# One hump moves to the right and one to the left. Both humps and a steady force are random in each scene.

rng = np.random.default_rng(0)


def bell(heights, places, widths):
    """Return a bell curve in x for each scene, with random height, position and width."""
    height = rng.uniform(*heights, scenes)
    place = rng.uniform(*places, scenes)
    width = rng.uniform(*widths, scenes)
    return height * np.exp(-0.5 * ((x - place) / width) ** 2)


start = bell((0, 3), (0.2, 0.4), (0.05, 0.15)) + bell((-3, 0), (0.6, 0.8), (0.05, 0.15))
steady = bell((-1.6, 1.6), (0.4, 0.6), (0.1, 0.4))
truth = steady + np.zeros((STEPS, 1, 1))  # the same force in every step: shape (steps, cells, scenes)


def run(force, keep="last"):
    """Return the velocity at the end, under a force."""
    return dp.rollout(step, start, None, STEPS, inputs=dt * force, keep=keep)


wanted = run(truth)

# %%
# What is asked
# -------------
# The least total force that leads to the wanted final state:
#
# .. math:: \min_f \; \Delta t \sum |f| \quad \text{with} \quad \Phi(f) = u_{\text{wanted}} .
#
# Two things prevent a direct minimization. The absolute value has a kink at 0, so it is smoothed to
# :math:`\sqrt{f^2 + \epsilon^2}`, with an :math:`\epsilon` that decreases. And there is a constraint in every cell. The
# **augmented Lagrangian** adds a term with a multiplier :math:`\lambda` and a penalty for the deviation
# :math:`m = \Phi(f) - u_{\text{wanted}}`,
#
# .. math:: \Delta t \sum \sqrt{f^2 + \epsilon^2} + \lambda^T m + \frac{\mu}{2} |m|^2 ,
#
# and after each minimization :math:`\mu \, m` is added to the multiplier.


def size(force, eps=0.0):
    """Return the total force of each scene; eps > 0 smooths the absolute value."""
    return dt * np.sum(np.sqrt(force**2 + eps**2), (0, 1))


def tell(label, number, force, seconds):
    """Print one row of the table: the cost, and how good the force is."""
    share = np.sum(size(force)) / np.sum(size(truth))
    worst = np.max(size(force) / size(truth))
    miss = np.max(abs(run(force) - wanted))
    spent = f"{number:6} {seconds:8.1f} {1e3 * seconds / number:8.1f}"
    print(f"{label:20} {spent} {share:9.3f} {worst:9.3f} {miss:9.1e}", flush=True)


# %%
# The search with gradients
# -------------------------
# Seven rounds; each starts from the result of the previous one. The total force can be smaller than the true one, since
# a steady force is not optimal.

rounds = [(0.1, 1e2), (0.1, 1e2), (0.1, 1e3), (0.05, 1e3), (0.03, 1e4), (0.03, 1e5), (0.03, 1e6)]
force = np.zeros_like(truth)
price = np.zeros(sheet.shape)
gradients = 0
clock = perf_counter()
print(f"{scenes:3} scenes           number  seconds  ms each |f|/truth     worst   largest error at the end")
for eps, weight in rounds:

    def lagrangian(force):
        """Return the augmented Lagrangian: total force, multiplier term and penalty."""
        miss = run(force) - wanted
        return np.sum(size(force, eps)) + np.sum(price * miss + 0.5 * weight * miss**2)

    best = dp.minimize(lagrangian, force, maxiter=min(100, 10 * scenes))
    force = best.x
    gradients += best.evaluations
    price = price + weight * (run(force) - wanted)
    tell("adjoint, gradients", gradients, force, perf_counter() - clock)

# %%
# The search without
# ------------------
# The cross-entropy method only simulates the flow. For each scene it draws 32 random forces, constant on blocks of
# 4 x 4, and selects the best 8; their mean and standard deviation define the distribution of the next 32. It may use as
# many simulations as the gradients cost; a gradient counts as three.


def blocks(coarse):
    """Expand a force on 8 x 8 blocks to a force in each step and cell."""
    return coarse.repeat(4, axis=0).repeat(4, axis=1)


mean, deviation = 0.0, 1.0
turns = 3 * gradients // 32
clock = perf_counter()
for _ in range(turns):
    drawn = mean + deviation * rng.standard_normal((32, 8, 8, scenes))
    cost = []
    for trial in map(blocks, drawn):
        miss = run(trial) - wanted
        cost.append(size(trial) + 100 * np.sum(miss**2, 0))
    chosen = np.argsort(cost, axis=0)[:8]
    elite = np.take_along_axis(drawn, chosen[:, None, None], axis=0)
    mean = np.mean(elite, axis=0)
    deviation = np.std(elite, axis=0) + 0.01
tell("cross-entropy, runs", 32 * turns, blocks(mean), perf_counter() - clock)
print("published |f|/truth: reinforcement learning 1.31 after 15.6 h, a learned controller 1.27 after 1.3 h")

# %%
# The picture
# -----------
# The first scene, with x to the right and time upwards. The least force is not steady: it acts at positions and times
# at which it has a strong effect on the final state, and is zero elsewhere.
#
# Exercises
# ---------
# 1. Ask for the least energy, :math:`\sum f^2`, instead. What does the force look like now, and why?
# 2. Give the search without gradients ten times as many runs. How much does the miss shrink?
# 3. Let the force act in the left half only (`dp.mask`). In which scenes is the final state not reached?

if options.out:
    from matplotlib import pyplot

    picture, places = pyplot.subplots(1, 4, figsize=(12, 3.2), sharey=True, layout="constrained")
    flows = {"velocity, steady force": run(truth, "all"), "velocity, least force": run(force, "all")}
    shown = {**flows, "the steady force": truth, "the least force": force}
    for ax, (title, values) in zip(places, shown.items()):
        time = dt * np.arange(len(values))
        image = ax.pcolormesh(x[:, 0], time, values[:, :, 0], cmap="RdBu_r", vmin=-2, vmax=2, rasterized=True)
        ax.set(title=title, xlabel="x")
    places[0].set_ylabel("time")
    picture.colorbar(image, ax=places, label="u, f", extend="both", pad=0.01)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "control.png", dpi=120)
