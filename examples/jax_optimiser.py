r"""
An optimizer of JAX around a rollout
====================================

A rollout of this library as one more function of JAX, under `jit` and `grad`.

A drop of ink falls into a wind, is advected and spreads. From a picture of the final state we determine where it fell
and how fast it spreads. JAX computes the initial drop, a rollout of this library advances it, and Adam of optax
finds both unknowns. No line of the physics is written in JAX.

Run it: ``python examples/jax_optimiser.py [cells] [--out FOLDER]``; it needs jax and optax
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

import sparsedp as dp

parser = argparse.ArgumentParser(description="An optimizer of JAX around a rollout.")
parser.add_argument("cells", nargs="?", type=int, default=32, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

jax.config.update("jax_enable_x64", True)  # this library computes in double precision

# %%
# Ink in a wind
# -------------
# The wind :math:`v` is the curl of a stream function that is 0 on the walls: it has no divergence and blows along them.
# The ink :math:`c` obeys
#
# .. math:: c_t + \nabla \cdot (v \, c) = \kappa \, \Delta c .
#
# A step is upwind transport and explicit diffusion. It is written as everywhere in this library.

n = options.cells
grid = dp.Grid((n, n), size=1.0)
carry = dp.transport(grid)
spread = dp.laplacian(grid)
wind = dp.curl(grid)(0.3 * np.outer(np.hanning(n + 1), np.hanning(n + 1)))
dt = 0.2 / n


def step(ink, diffusivity):
    """Transport and diffusion."""
    return carry(ink, wind, dt) + dt * diffusivity * spread(ink)


def end(start, diffusivity):
    """The ink after 2 n steps, at t = 0.4."""
    return dp.rollout(step, start, diffusivity, 2 * n)


# %%
# The drop is JAX, and a picture
# ------------------------------
# A round drop at a place. This picture of the end is all that the search sees.

x, y = grid.centres()


def drop(place):
    """Ink where a drop has just fallen."""
    return jnp.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 0.02)


TRUE_PLACE = 0.35, 0.6
TRUE_DIFFUSIVITY = 0.01
picture_of_end = end(np.asarray(drop(TRUE_PLACE)), TRUE_DIFFUSIVITY)

# %%
# The bridge
# ----------
# JAX cannot look into a rollout, and need not. `dp.interop.to_jax` gives it three things: the value, the shape and type
# of the value (`like`), and the vector-Jacobian product. For its chain rule that is all there is to know of a function
# :math:`f`: a cotangent :math:`g` of the result becomes :math:`J_f^T g`, a cotangent of the arguments.

transported = dp.interop.to_jax(end, like=picture_of_end)

# %%
# The loss
# --------
# The diffusivity has to stay positive; so its logarithm is the unknown, :math:`\kappa = e^\ell`.


@jax.jit
@jax.value_and_grad
def loss(unknown):
    """Mean squared difference from the picture."""
    ink = transported(drop(unknown["place"]), jnp.exp(unknown["log"]))
    return jnp.mean((ink - picture_of_end) ** 2)


# %%
# The search
# ----------
# From the middle of the box, with a third of the diffusivity.

unknown = {"place": jnp.array([0.5, 0.5]), "log": jnp.log(0.003)}
first_guess = unknown
optimizer = optax.adam(0.05)
state = optimizer.init(unknown)
path = [unknown["place"]]

for iteration in range(101):
    value, slope = loss(unknown)
    if iteration % 25 == 0:
        print(f"iteration {iteration:3d}: loss {value:.3e}")
    change, state = optimizer.update(slope, state)
    unknown = optax.apply_updates(unknown, change)
    path.append(unknown["place"])

print(f"it fell at ({unknown['place'][0]:.3f}, {unknown['place'][1]:.3f}), true (0.35, 0.60)")
print(f"diffusivity {float(jnp.exp(unknown['log'])):.4f}, true 0.01")

# %%
# The picture
# -----------
# The end that is seen, with the path of the search for the start; and the end of the first guess.
#
# Exercises
# ---------
# 1. Take `optax.lbfgs` instead of Adam. How many gradients does it need?
# 2. Let two drops fall: `jax.vmap` over their places, and the sum of both. From which starts does the search swap them?
# 3. Let a small network of JAX make the wind, from numbers at a few places. What has to be an argument of `step` then?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    guessed = end(np.asarray(drop(first_guess["place"])), float(jnp.exp(first_guess["log"])))
    limits = 0.0, max(np.max(picture_of_end), np.max(guessed))
    dp.plot(grid, picture_of_end, ax=left, title="the end that is seen, and the search", label="ink", limits=limits)
    left.plot(*np.transpose(path), "w.-", linewidth=1, label="path of the search")
    left.plot(*TRUE_PLACE, "x", color="tab:red", markersize=10, label="where it fell")
    left.legend(loc="lower right")
    dp.plot(grid, guessed, ax=right, title="the end of the first guess", label="ink", limits=limits)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "jax_optimiser.png", dpi=120)
