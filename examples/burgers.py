r"""
Burgers: forward, and back
==========================

A field that carries itself: published figures forward, and its start found from a later state.

Burgers' equation is the simplest equation in which a flow steepens into a shock. We solve it forward in time and
compare with published figures. Then we reconstruct the initial state from one later state. Gradient descent shows how a
search behaves; the last section shows that the inverse problem needs a regularization to have a unique answer.

Run it: ``python examples/burgers.py [cells] [--out FOLDER]``. With ``--observation FILE`` (one number for each cell)
the state that is seen is read from a file.
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Burgers: forward, and back to the start by gradients.")
parser.add_argument("cells", nargs="?", type=int, default=128)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
parser.add_argument("--observation", type=Path, metavar="FILE", help="the state that is seen after 16 steps")
options = parser.parse_args()

# %%
# The equation
# ------------
# On the periodic interval :math:`-1 \le x < 1` the velocity :math:`u` satisfies
#
# .. math:: u_t + u \, u_x = \nu \, u_{xx} .
#
# The second term is advection of the field by itself: fast fluid overtakes slow fluid, and slopes grow. The right-hand
# side is diffusion, which makes them smaller.
#
# A step computes advection first, then diffusion. Advection is *semi-Lagrangian*: the new value is the old value at the
# departure point, at the distance :math:`u \, \Delta t` upstream. This is stable for steps of any length, but the
# interpolation between cells adds some diffusion.

ring = dp.Grid(options.cells, size=2.0, origin=-1.0, periodic=True)
L = dp.laplacian(ring)
carry = dp.transport(ring, "semi_lagrangian", velocity="cells")

dt = 1 / 32
viscosity = 0.01 / (128 * np.pi)


def step(u, nu):
    """One time step: diffusion, then advection of the velocity by itself."""
    u = u + nu * dt * L(u)
    return carry(u, u, dt)


# %%
# Forward
# -------
# From :math:`u = -\sin \pi x` both halves move towards the middle and form a shock there.

(x,) = ring.centres()
truth = dp.rollout(step, -np.sin(np.pi * x), viscosity, 32, keep="all")

print("u at t = 1:", *(f"{value:.7f}" for value in truth[32][:5]))
print("published :  0.0057228 0.0171672 0.0286103 0.0400520 0.0514921   (128 cells)")

# %%
# The question backwards
# ----------------------
# Now only the state after 16 steps is known. The loss of an initial state is the mean squared difference of this state,
#
# .. math:: J(u_0) = \frac{1}{n} \, | \Phi_{16}(u_0) - u_{\text{seen}} |^2 ,
#
# where :math:`\Phi_{16}` denotes 16 steps. Its gradient takes one backward pass through the steps, each of which maps
# the cotangent of its result to the cotangent of its argument.

seen = np.loadtxt(options.observation) if options.observation else truth[16]


def loss(u):
    """Mean squared error of the state after 16 steps."""
    return np.mean((dp.rollout(step, u, viscosity, 16) - seen) ** 2)


# %%
# Gradient descent
# ----------------
# We start from :math:`u_0 = 0` and take 200 steps with rate 5. Three of the iterates are kept for comparison.

loss_and_slope = dp.value_and_grad(loss)
starts = {}
losses = []
u = np.zeros(options.cells)
for descents in range(1, 201):
    value, slope = loss_and_slope(u)
    losses.append(value)
    u = u - 5 * slope
    if descents in (49, 50, 200):
        starts[f"{descents} gradient descents"] = u

shown = [0, 1, 2, 3, 4, 5, *range(10, 46, 5)]
print("loss before descent 1 to 6, 11, 16, 21 ... 46:", *(f"{losses[k]:.6f}" for k in shown))

# %%
# A better question
# -----------------
# Many initial states lead to this state: the later state contains no information about the fluid that has entered the
# shock. A small penalty on slopes selects the smoothest of these initial states, and L-BFGS finds it:
#
# .. math:: J(u_0) + 10^{-5} \cdot \text{mean} \, |\nabla u_0|^2 .

G = dp.gradient(ring)


def smooth_loss(u):
    """The mean squared error plus a small penalty on slopes."""
    return loss(u) + 1e-5 * np.mean(G(u) ** 2)


starts["L-BFGS"] = dp.minimize(smooth_loss, np.zeros(options.cells), "lbfgs", maxiter=200).x

# %%
# How good are they?
# ------------------
# The mean error covers the whole run, frames 0 to 31; the last column counts 33 frames and divides by 32, as
# published figures for an observation in a file do.

print("the start, found by           loss  mean error  at the start  33 frames over 32")
for name, u in starts.items():
    off = np.abs(dp.rollout(step, u, viscosity, 32, keep="all") - truth)
    mean = np.mean(off[:32])
    published = np.sum(off) / (32 * options.cells)
    print(f"{name:22} {loss(u):11.1e} {mean:11.4f} {np.mean(off[0]):13.4f} {published:18.5f}")

# %%
# The picture
# -----------
# Gradient descent finds the smooth parts first. The fluid from around :math:`x = \pm 1/2` just reaches the shock; there
# the result oscillates from cell to cell, which has almost no effect on the loss.
#
# Exercises
# ---------
# 1. Use the state after 4 steps instead of 16. How much better is the initial state, and why?
# 2. Try 1e-3 and 1e-7 as weights of the penalty. What is wrong with each of the results?
# 3. Make the viscosity an unknown too: `dp.minimize` takes a tuple `(u, log_nu)` as it is.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3.8), sharey=True, layout="constrained")
    left.set(title="what is known", xlabel="x", ylabel="velocity u")
    left.plot(x, truth[16], label="seen at t = 1/2")
    left.plot(x, dp.rollout(step, starts["L-BFGS"], viscosity, 16), ":", label="from the start by L-BFGS")
    right.set(title="the start", xlabel="x")
    right.plot(x, truth[0], color="black", linewidth=4, alpha=0.3, label="true")
    for name, line in (("50 gradient descents", "-"), ("200 gradient descents", "-"), ("L-BFGS", "k--")):
        right.plot(x, starts[name], line, label=name)
    left.legend(frameon=False, loc="upper right")
    right.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "burgers.png", dpi=120)
