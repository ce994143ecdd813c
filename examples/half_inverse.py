r"""
A network that steers two oscillators
=====================================

Half-inverse gradients, Adam and Levenberg-Marquardt, beside each other.

Two masses hang on springs. The input of a network is their wanted final state; its output is 24 pushes on the second
mass that should lead there. It is trained through the physics. The two masses respond to pushes with very different
strength, so that the gradient is badly scaled. The update rule then matters more than the number of steps.

The problem, the method and the figures: P. Schnell, P. Holl, N. Thuerey, "Half-inverse gradients for physical deep
learning", ICLR 2022.

Run it: ``python examples/half_inverse.py [epochs] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp
from sparsedp import network

parser = argparse.ArgumentParser(description="A network steers two oscillators, trained three ways.")
parser.add_argument("epochs", nargs="?", type=int, default=4)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The physics
# -----------
# A state has four numbers: two positions and two velocities. A spring of stiffness 1 connects each mass to the wall,
# and a spring of stiffness 0.2 connects the masses:
#
# .. math:: \ddot x_1 = -x_1 - 0.2 \, (x_1 - x_2), \qquad \ddot x_2 = -x_2 - 0.2 \, (x_2 - x_1) + f .
#
# A row of the matrix contains the effect of one entry of the state on all rates.

SPRINGS = np.array(
    [
        [0, 0, -1.2, 0.2],  # place 1
        [0, 0, 0.2, -1.2],  # place 2
        [1, 0, 0, 0],  # speed 1
        [0, 1, 0, 0],  # speed 2
    ]
)
PUSHED = np.array([0, 0, 0, 1])  # a force changes the speed of the second mass
STEPS = 24


def rate(u, force):
    """Change of states, shape (samples, 4), under forces, shape (samples,)."""
    return u @ SPRINGS + force[:, None] * PUSHED


move = dp.stepper("rk4", rate, 0.5)

# %%
# The physics is linear. So we simulate once from each unit state and once for each unit push: the final state of any
# run is a linear combination of these results.

ends_of_states = dp.rollout(move, np.eye(4), np.zeros(4), STEPS)
ends_of_pushes = dp.rollout(lambda u, _, force: move(u, force), np.zeros((STEPS, 4)), None, STEPS, inputs=np.eye(STEPS))

# %%
# The network
# -----------
# Four inputs, 24 pushes as outputs, three hidden layers of 20 tanh units: 1444 weights. The wanted final state is the
# initial state.

rng = np.random.default_rng(0)
seen, unseen = rng.random((2, 4096, 4))
sizes = (4, 20), (20, 20), (20, 20), (20, STEPS)


def layer(inputs, outputs):
    """Glorot's choice of first weights."""
    bound = np.sqrt(6 / (inputs + outputs))
    return {"weight": rng.uniform(-1, 1, (inputs, outputs)) * bound, "bias": np.zeros(outputs)}


start = [layer(*size) for size in sizes]


def misses(weights, states):
    """Final state minus wanted final state, for the pushes of the network. Shape (samples, 4)."""
    *hidden, last = weights
    signal = states
    for one in hidden:
        signal = network.tanh(network.dense(one, signal))
    pushes = network.dense(last, signal)
    return states @ ends_of_states + pushes @ ends_of_pushes - states


def loss(weights, states=seen):
    """Return the mean squared error of a sample."""
    return np.mean(np.sum(misses(weights, states) ** 2, axis=1))


# %%
# Three ways to make a step
# -------------------------
# Let :math:`r` be the residuals of a batch and :math:`B` their Jacobian in the weights, with singular values
# :math:`\sigma`. The methods differ in the power of :math:`\sigma` in their steps:
#
# - gradient descent uses :math:`B^T r`, with the factor :math:`\sigma`: directions with small singular values are
#   learned slowly. Adam scales each weight, which does not change this;
# - Gauss-Newton uses :math:`B^{+} r`, with the factor :math:`1 / \sigma`: directions with small singular values get
#   very large steps. Levenberg-Marquardt damps these;
# - a **half-inverse** step lies between them: with :math:`B = U \Sigma V^T` it is :math:`V \Sigma^{-1/2} U^T r`, with
#   the factor :math:`1 / \sqrt{\sigma}`. Directions with small singular values are learned, without damping.
#
# The function below trains with one of these methods, and records seconds and loss.

curves = {}
print("method                 gradients  seconds       loss     unseen published")


def train(label, f, method, maxiter, every, budget=np.inf, published="", **settings):
    """Train from the same start; print a row after every `every` gradients, and when the time is used up."""
    curve = curves[label] = []
    figures = published.split()

    def watch(record, weights):
        late = record.seconds > budget
        if record.iteration % every == 0 or late:
            curve.append((record.seconds, loss(weights)))
            known = figures[len(curve) - 1] if len(curve) <= len(figures) else ""
            spent = f"{label:22} {record.iteration:9} {record.seconds:8.2f}"
            print(f"{spent} {curve[-1][1]:10.1e} {loss(weights, unseen):10.1e} {known}".rstrip())
        return late

    return dp.minimize(f, start, method, maxiter, 0, watch, **settings)


# %%
# Half-inverse steps on batches of 32; in an epoch each sample is used once. The published loss is a mean, so that its
# rate 1 corresponds to 2 / 32 for our sum of squared residuals. This is the default for batches of 32 samples.

shuffled = rng.permuted(np.tile(np.arange(4096), (options.epochs, 1)), axis=1)
batches = list(seen[shuffled].reshape(-1, 32, 4))
settings = {"batches": batches, "apart": True, "published": "5.4e-5 1.1e-5 3.2e-6 1.2e-6"}
train("half-inverse", misses, "half_inverse", 128 * options.epochs, 128, **settings)

# %%
# Levenberg-Marquardt uses the same 128 samples in all steps: 512 residuals for 1444 weights.

few = seen[:128]
settings = {"apart": True, "damping": 1e-4}
best = train("Levenberg-Marquardt", lambda weights: misses(weights, few), "levenberg_marquardt", 90, 30, **settings)
print(f"  on the 128 samples that it sees: {loss(best.x, few):.1e}")

# %%
# Adam gets as much time as the slower of the two.

longest = max(curve[-1][0] for curve in curves.values())
train("Adam, equal time", loss, "adam", 10**6, 1500, longest, batches=batches)

# %%
# The picture
# -----------
# Loss on the training samples, over time; both axes are logarithmic.
#
# Exercises
# ---------
# 1. Use a stiffness of 0.02 instead of 0.2 between the masses. The pushes then have little effect on the first mass.
#    Which method becomes worse?
# 2. Give Levenberg-Marquardt 16 samples. How do the two losses change?
# 3. Plot the 24 pushes for one sample. Are they what you would do by hand?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, ax = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for (label, curve), mark in zip(curves.items(), "os^"):
        ax.loglog(*zip(*curve), marker=mark, label=label)
    ax.set(title="training through the physics", xlabel="time [s]", ylabel="mean squared miss")
    ax.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "half_inverse.png", dpi=120)
