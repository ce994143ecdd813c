r"""
A law from twelve experiments
=============================

A network learns how conductivity depends on temperature; two processes give the same bits as one.

Heat spreads through a material whose conductivity is an unknown function of the temperature. The data are the initial
and the final fields of twelve experiments. A small network represents the unknown law in every implicit step. Each
gradient is a sum over all experiments, which are independent of each other, so that two processes can share them.

Run it: ``python examples/ensemble.py [iterations] [--out FOLDER]``
"""

import argparse
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from sparsedp.network import dense, dense_weights, softplus, tanh

parser = argparse.ArgumentParser(description="A conductivity law from twelve experiments, by two processes.")
parser.add_argument("iterations", nargs="?", type=int, default=60)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")

# %%
# The physics
# -----------
# The temperature :math:`u` obeys :math:`u_t = \nabla \cdot (k(u) \, \nabla u)`. A step takes :math:`k` from the field
# before it, on the faces between cells, and is implicit in all else:
#
# .. math:: \left( \frac{1}{\Delta t} - \nabla \cdot k(u) \, \nabla \right) u_{\text{new}} = \frac{u}{\Delta t} .
#
# `solve(k, b, shift)` does that, and has derivatives in :math:`k` and :math:`b`, so that both the law and the field
# before it get theirs.

grid = dp.Grid((16, 16), size=1.0)
dt = 0.01
steps = 4
to_faces = dp.average(grid)
solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid), rtol=1e-9)


def end(conductivity, u):
    """Return the field after all steps, for a law k(u)."""
    for _ in range(steps):
        k = conductivity(to_faces(u))
        u = solve(k, u / dt, 1 / dt)
    return u


# %%
# The truth and the network
# -------------------------
# In truth, what is hot conducts better. The network has one hidden layer of eight numbers, and ends with
# :math:`\log(1 + e^z)`, which is positive for any weights: a negative conductivity would not be physics, and no
# implicit step could save it.


def law(u):
    """The true conductivity."""
    return 0.02 + 0.2 * u**2


def network(weights, u):
    """Return the conductivity that the network predicts for each value of u."""
    hidden, last = weights
    layer = tanh(dense(hidden, u[:, None]))
    return softplus(dense(last, layer))[:, 0]


# %%
# The experiments
# ---------------
# Three hot spots at random places. The loss of one experiment is the mean squared miss at the end; all of them together
# have the mean of these,
#
# .. math:: J(w) = \sum_{i=1}^{12} \frac{1}{12} \, \operatorname{mean} \left( u_i(w) - d_i \right)^2 .


def experiment(seed):
    """Return the initial and the final field of a random experiment."""
    places = np.random.default_rng(seed).uniform(0.1, 0.9, (3, 2))
    x, y = grid.centres()
    spots = [np.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.02) for a, b in places]
    start = np.minimum(sum(spots), 1.0)
    return start, end(law, start)


def misfit(weights, scene):
    """Return the mean squared error of one experiment."""
    start, wanted = scene
    return np.mean((end(lambda u: network(weights, u), start) - wanted) ** 2)


# %%
# Many processes, the same bits
# -----------------------------
# A sum of gradients depends on the order of its terms in the last digits. `dp.ensemble` computes each experiment on
# whichever process is free, but adds up always in the same order. So the numbers do not depend on how many processes
# there are, nor on which is faster today, and a run can be repeated to the last bit.
#
# A process that is *spawned* reads this file again to find `misfit`. What it must not do again stands below the line
# that asks whether this is the main program.


def learn(iterations):
    """The weights before and after the search, with what they say on the way."""
    scenes = [experiment(seed) for seed in range(12)]
    even = np.full(12, 1 / 12)
    rng = np.random.default_rng(0)
    start = dense_weights(rng, 1, 8), dense_weights(rng, 8, 1)

    alone = dp.ensemble(misfit, scenes, weights=even)
    value, gradient = dp.value_and_grad(alone)(start)

    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn) as pool:
        total = dp.ensemble(misfit, scenes, pool, weights=even)
        value_of_two, gradient_of_two = dp.value_and_grad(total)(start)
        same = value == value_of_two and np.array_equal(gradient[0]["weight"], gradient_of_two[0]["weight"])
        print(f"value and gradient, here and by two processes: {'the same bits' if same else 'DIFFERENT'}")

        clock = perf_counter()
        best = dp.minimize(total, start, "lbfgs", maxiter=iterations)
        seconds = perf_counter() - clock
        print(f"{len(best.history) - 1} iterations of 12 experiments in {seconds:.1f} s")

    return start, value, best


# %%
# What was learned
# ----------------
# The network never saw the law, only fields. Two tests: the law at all temperatures, and a field that was not among
# the twelve.

if __name__ == "__main__":
    options = parser.parse_args()
    start, first_misfit, best = learn(options.iterations)
    u = np.linspace(0.0, 1.0, 101)
    off = np.max(np.abs(network(best.x, u) - law(u)))
    unseen = misfit(best.x, experiment(99)) ** 0.5
    print(f"misfit {first_misfit:.1e} -> {best.value:.1e}; k(u) off by {off:.1e}, a field not seen by {unseen:.1e}")

# %%
# The picture
# -----------
# The law, and what the network says before and after. After 60 iterations it is on the law but at the hottest
# temperatures: few cells are that hot, so that little is to be learned of them.
#
# Exercises
# ---------
# 1. How many experiments are enough? Take three of the twelve, and look at the field that was not seen.
# 2. Add noise to the ends. How large may it be until more iterations make the law worse?
# 3. Replace the network by :math:`k = a + b \, u^2` with unknown :math:`a` and :math:`b`. How many iterations does this
#    take, and what does it presuppose?

if __name__ == "__main__" and options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, ax = pyplot.subplots(figsize=(5.5, 3.8), layout="constrained")
    ax.plot(u, law(u), color="black", linewidth=4, alpha=0.3, label="the law")
    ax.plot(u, network(start, u), ":", label="network, before")
    ax.plot(u, network(best.x, u), label="network, learned")
    ax.set(xlabel="temperature u", ylabel="conductivity k(u)")
    ax.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "ensemble.png", dpi=120)
