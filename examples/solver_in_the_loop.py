r"""
A network inside a coarse solver
================================

Trained through 1, 4 and 8 steps of the solver; and what cut gradients and old frames cost.

A coarse grid smears what a fine one resolves. A small network sees the coarse field in every step and corrects the
flux. Trained on single steps it meets, in use, states that it has itself disturbed, and which it was never shown.
Trained *through* several steps it meets them while it learns, and the gradient says what a correction does to the steps
after it. That is what a differentiable solver is for.

The idea: K. Um, R. Brand, Y. Fei, P. Holl, N. Thuerey, "Solver-in-the-loop", NeurIPS 2020.

Run it: ``python examples/solver_in_the_loop.py [gradients] [--seeds N] [--out FOLDER]``
"""

import argparse
from functools import cache
from pathlib import Path
from time import perf_counter, process_time

import autograd.numpy as np

import sparsedp as dp
from sparsedp.network import convolution, convolution_weights, tanh

parser = argparse.ArgumentParser(description="A network inside a coarse solver.")
parser.add_argument("gradients", nargs="?", type=int, default=600)
parser.add_argument("--seeds", type=int, default=1, help="repeat the trainings with this number of seeds")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

RUNS = 16  # with forces of their own, side by side
COARSE, FINE = 32, 128  # cells of a ring
dt = 0.1  # of a coarse step; a fine one is an eighth
viscosity = 0.01

# %%
# The solver
# ----------
# Burgers' equation with a force, in conservation form, with fluxes through the faces of cells:
#
# .. math:: u_t + \left( \frac{u^2}{2} - \nu \, u_x + N(u) \right)_x = f .
#
# :math:`N` is the output of the network, or zero. It corrects the flux, so the sum of :math:`u` is conserved for any
# output: what leaves a cell enters its neighbour. The upwind flux causes numerical diffusion on coarse cells.
#
# All runs are computed at once, each as one row of a two-dimensional grid. The rows are far apart, so that there is no
# diffusion between them.


def network(weights, u):
    """Return the fluxes that the convolutions compute from fields of shape (runs, cells); 0 without weights."""
    if not weights:
        return 0.0
    *hidden, last = weights
    signal = u[:, None]
    for layer in hidden:
        signal = tanh(convolution(layer, signal))
    return convolution(last, signal)[:, 0]


def solver(cells, dt):
    """Return an explicit step on a ring of `cells` cells, and the positions of the cells."""
    h = 2 * np.pi / cells
    sheet = dp.Grid((RUNS, cells), spacing=(1e9, h), periodic=True)
    along = dp.component(sheet, 1)  # of a face field: the faces along the ring
    to_faces = along @ dp.average(sheet)
    slope = along @ dp.gradient(sheet)
    divergence = dp.divergence(sheet) @ along.T

    def step(u, weights, force):
        smear = viscosity + 0.5 * h * abs(to_faces(u))
        flux = 0.5 * to_faces(u**2) - smear * slope(u) + network(weights, u)
        return u + dt * (force - divergence(flux))

    return step, sheet.centres()[1]


coarse, _ = solver(COARSE, dt)
fine, x = solver(FINE, dt / 8)


def coarsen(u):
    """Mean of the four fine cells in each coarse one."""
    return u.reshape(-1, RUNS, COARSE, FINE // COARSE).mean(axis=3)


# %%
# What the network learns from
# ----------------------------
# In each run of the fine solver, the force is a sum of 20 travelling sine waves with random amplitudes, speeds, phases
# and wavenumbers. Its states and forces, averaged over coarse cells, are the training data.


@cache
def record(number, frames=160):
    """States and forces of one set of runs, at every coarse step."""
    rng = np.random.default_rng(number)
    t = (np.arange(8 * frames) + 0.5)[:, None, None] * dt / 8
    force = 0.0
    for _ in range(20):
        height = rng.uniform(-0.5, 0.5, (RUNS, 1))
        speed = rng.uniform(-0.4, 0.4, (RUNS, 1))
        phase = rng.uniform(0, 2 * np.pi, (RUNS, 1))
        waves = rng.integers(3, 7, (RUNS, 1))
        force = force + height * np.sin(speed * t + waves * x + phase)
    u = dp.rollout(fine, 0 * x, (), 8 * frames, inputs=force, keep="all")
    mean_force = coarsen(force).reshape(frames, 8, RUNS, COARSE).mean(axis=1)
    return coarsen(u[::8]), mean_force


def window(number, begin, steps):
    """A piece of a record: states at its start and after each step, and the forces in between."""
    states, forces = record(number)
    return states[begin : begin + steps + 1], forces[begin : begin + steps]


# %%
# The loss
# --------
# The coarse solver starts from a true state and takes :math:`k` steps, each with the network. The loss contains all
# :math:`k` states:
#
# .. math:: J(\theta) = \text{mean}_{j \le k} \, | u_j(\theta) - \bar u_j |^2 .
#
# Its gradient contains the derivatives of all :math:`k` steps of the solver. With `truncate=1` the backward pass stops
# after each step: then the gradient omits the effect of a correction on later steps.


def miss(weights, seen, **how):
    """Return the errors of the coarse states that the solver with the network computes."""
    states, forces = seen
    run = dp.rollout(coarse, states[0], weights, len(forces), inputs=forces, keep="all", **how)
    return run - states


# %%
# Training
# --------
# Adam, in three rounds with decreasing learning rate. The number of steps may change from round to round. Every 150
# gradients, new training data are generated, unless `fresh` is False: then all gradients use the first data.

LAYERS = (1, 16, 1.0), (16, 16, 1.0), (16, 1, 0.0)  # channels in, out, gain: no correction at the start
RATES = 3e-3, 1e-3, 3e-4


def train(unrolled, truncate=None, fresh=True, seed=0):
    """Return the weights after training. The seed determines the first weights and the training data."""
    rng = np.random.default_rng(seed)
    weights = [convolution_weights(rng, inputs, outputs, 5, gain) for inputs, outputs, gain in LAYERS]
    each = options.gradients // 3
    for turn, (k, rate) in enumerate(zip(unrolled, RATES)):

        def draw(i):
            number = (turn * each + i) // 150 if fresh else 0
            return window(1000 * seed + number, 20 + 37 * i % 120, k)

        def loss(weights, seen):
            return np.mean(miss(weights, seen, truncate=truncate) ** 2)

        weights = dp.minimize(loss, weights, "adam", each, 0, batches=draw, rate=rate).x
    return weights


# %%
# Six trainings
# -------------
# Each network then runs 100 steps on test data. Its error is compared with the error of the coarse solver alone. Mass
# is conserved up to rounding.

unseen = window(10**6, 50, 100)


def size(off):
    """Root mean square of the misses, at each step."""
    return np.sqrt(np.mean(off**2, axis=(1, 2)))


def after_training(weights):
    """The misses on unseen runs; infinite where the network drove the solver beyond all bounds."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return miss(weights, unseen)
    except dp.errors.NonFiniteError:
        return np.full_like(unseen[0], np.inf)


trainings = {
    "1 step of the same frames": {"unrolled": (1, 1, 1), "fresh": False},
    "1 step": {"unrolled": (1, 1, 1)},
    "4 steps, gradients stopped": {"unrolled": (4, 4, 4), "truncate": 1},
    "4 steps, truncated at 2": {"unrolled": (4, 4, 4), "truncate": 2},
    "4 steps": {"unrolled": (4, 4, 4)},
    "1, then 4, then 8 steps": {"unrolled": (1, 4, 8)},
}

ratios = {label: [] for label in trainings}
off = miss((), unseen)
curves = {"no network": size(off)}
without = np.sqrt(np.mean(off**2))
print(f"100 steps of {RUNS} unseen runs   seconds    cpu  ms each   error  coarse/hybrid  mass lost")
print(f"{'no network':52} {without:7.4f}")
for label, how in trainings.items():
    clock, cpu = perf_counter(), process_time()
    weights = train(**how)
    seconds, work = perf_counter() - clock, process_time() - cpu
    off = after_training(weights)
    curves[label] = size(off)
    error = np.sqrt(np.mean(off**2))
    ratios[label].append(without / error)
    lost = np.max(abs(np.mean(off, axis=2)))
    spent = f"{seconds:8.1f} {work:6.1f} {1e3 * work / options.gradients:8.1f}"
    print(f"{label:28} {spent} {error:7.4f} {without / error:14.2f} {lost:10.0e}", flush=True)

# %%
# When does unrolling pay?
# ------------------------
# One training is one draw of first weights and of training data. With ``--seeds 5`` each training is repeated. The
# ratios coarse/hybrid of five seeds, as median (least to largest):
#
# ==========================  ====================  ====================
# training                    150 gradients         600 gradients
# ==========================  ====================  ====================
# 1 step of the same frames   1.99 (1.28 to 3.28)   7.00 (6.64 to 8.90)
# 1 step                      1.99 (1.28 to 3.28)   7.01 (5.84 to 7.79)
# 4 steps                     3.52 (2.67 to 3.96)   9.45 (9.02 to 10.14)
# 1, then 4, then 8 steps     3.54 (2.54 to 4.28)   8.74 (7.08 to 8.89)
# ==========================  ====================  ====================
#
# Training on single steps is supervised learning of the next state. Four steps are better for each of the seeds, with
# both numbers of gradients. After 600 gradients the worst seed with four steps is better than the best seed with one,
# for a quarter more CPU time. After 2400 gradients (two seeds) the ratios are 12.9 and 13.2 with four steps, 12.0 and
# 10.1 with one. Eight steps at the end are no clear gain over four. The range of one row is as wide as the differences
# between some rows, so compare trainings by several seeds.

print(f"{'coarse/hybrid, seeds: ' + str(options.seeds):28}   least  median  largest")
for label, how in trainings.items():
    for seed in range(1, options.seeds):
        off_of_seed = after_training(train(**how, seed=seed))
        ratios[label].append(without / np.sqrt(np.mean(off_of_seed**2)))
    print(f"{label:28} {min(ratios[label]):7.2f} {np.median(ratios[label]):7.2f} {max(ratios[label]):8.2f}", flush=True)

# %%
# The picture
# -----------
# The first run, with x to the right and time upwards: the fine solution, the coarse solution, and the coarse solution
# with the last network. Right: the errors over time.
#
# Exercises
# ---------
# 1. Train through 16 steps from the start. What happens in the first gradients, and why does it help to begin with 1?
# 2. Let the network add to the rate, not to the flux. Watch the column of lost mass.
# 3. Give the network 8 channels, or 32. Is the error limited by its size, or by the training data?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    truth, forces = unseen
    states = {
        "fine": truth,
        "coarse": truth + miss((), unseen),
        "coarse, with the network": truth + off,
    }
    picture, places = pyplot.subplots(1, 4, figsize=(14, 3.8), layout="constrained")
    time = dt * np.arange(len(truth))
    places_of_cells = (np.arange(COARSE) + 0.5) * 2 * np.pi / COARSE
    for ax, (title, u) in zip(places, states.items()):
        field = u[:, 0]
        image = ax.pcolormesh(places_of_cells, time, field, cmap="RdBu_r", vmin=-1.5, vmax=1.5, rasterized=True)
        ax.set(title=title, xlabel="x")
    places[0].set_ylabel("time")
    picture.colorbar(image, ax=places[2], label="velocity u", extend="both")
    errors = places[3]
    for (label, curve), line in zip(curves.items(), ("k-", "C0:", "C0-", "C1:", "C1--", "C1-", "C3-")):
        errors.plot(time[1:], curve[1:], line, label=label)
    errors.set(title="error", xlabel="time", ylabel="root mean square", yscale="log")
    picture.legend(*errors.get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize="small")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "solver_in_the_loop.png", dpi=120)
