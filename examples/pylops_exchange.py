r"""
Operators to PyLops and back
============================

A heat operator of this library inside a solver of PyLops, and a camera of PyLops inside a scene of this library.

PyLops has linear operators of signals and images, and solvers for them. This library has operators of physics, and
derivatives through what is not linear. Both can hand theirs over: a matrix-free operator is two functions, and each
library takes the other's.

Run it: ``python examples/pylops_exchange.py [cells] [--out FOLDER]``; it needs pylops (in the extra `test`)
"""

import argparse
from pathlib import Path

import autograd.numpy as np
import pylops

import sparsedp as dp

parser = argparse.ArgumentParser(description="Operators to PyLops and back.")
parser.add_argument("cells", nargs="?", type=int, default=48)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# Ours, there
# -----------
# A plate with cold edges held two hot blocks. A moment later we measure its temperature, with some noise. What was the
# plate like at the start? The heat operator :math:`e^{t \Delta}` is ours. ``to_scipy`` makes it what PyLops takes, and
# the first thing PyLops offers is the test of a transpose.

cells = options.cells
grid = dp.Grid((cells, cells), size=1.0)
x, y = grid.centres()
blocks = 1.0 * (abs(x - 0.35) < 0.15) * (abs(y - 0.6) < 0.2) + 0.5 * (abs(x - 0.7) < 0.1) * (abs(y - 0.35) < 0.12)
heat = dp.matrix_exponential(dp.laplacian(grid, dp.dirichlet), 3e-4)

Heat = pylops.LinearOperator(Op=heat.to_scipy())
pylops.utils.dottest(Heat, *Heat.shape, rtol=1e-12)
print("PyLops finds the transpose right")

rng = np.random.default_rng(0)
measured = heat(blocks) + 0.005 * rng.standard_normal(grid.shape)

# %%
# Edges are sharp, so the regularizer counts jumps: PyLops has split Bregman for it,
#
# .. math:: \min_u \; \frac{1}{2} \, | e^{t \Delta} u - d |^2
#           + \epsilon \left(|\partial_x u|_1 + |\partial_y u|_1\right) .

jumps = [pylops.FirstDerivative(grid.shape, axis=axis, edge=True, kind="backward") for axis in (0, 1)]
start = pylops.optimization.sparsity.splitbregman(
    Heat,
    measured.ravel(),
    jumps,
    niter_outer=12,
    niter_inner=3,
    mu=1.0,
    epsRL1s=[0.02, 0.02],
    tol=1e-8,
    tau=1.0,
    iter_lim=20,
    damp=1e-8,
)[0].reshape(grid.shape)

plain = pylops.optimization.leastsquares.regularized_inversion(
    Heat, measured.ravel(), [pylops.Identity(cells**2)], epsRs=[0.03], iter_lim=200
)[0].reshape(grid.shape)


def miss(u):
    """Return the relative error."""
    return np.linalg.norm(u - blocks) / np.linalg.norm(blocks)


print(f"start by PyLops, with our operator: off by {miss(start):.3f} with jumps counted, {miss(plain):.3f} by squares")

# %%
# Theirs, here
# ------------
# Now the plate glows: it loses heat like the fourth power of its temperature, which no linear solver takes. And what is
# measured is a picture of a camera out of focus, a convolution, which PyLops has. ``from_linear_operator`` makes it an
# operator of ours, and it joins in: transpose, gradient, and checks.

width = np.linspace(-2.0, 2.0, 5)
spot = np.exp(-(width[:, None] ** 2) - width**2)
Camera = pylops.signalprocessing.Convolve2D(grid.shape, h=spot / spot.sum(), offset=(2, 2))
camera = dp.from_linear_operator(Camera, grid.cells, grid.cells, name="camera")
print(camera, "-", dp.check.operator(camera).verdict)

L = dp.laplacian(grid, dp.dirichlet)
dt = 0.2 / cells**2


def glow(u, _):
    """One step of heat that is conducted and radiated."""
    return u + dt * (L(u) - 100.0 * u**4)


def loss(u):
    """The picture of the plate after a while, beside the one that was taken, and a price for jumps."""
    return np.sum((camera(dp.rollout(glow, u, None, 8)) - picture) ** 2) + 3e-3 * edges(u)


edges = dp.total_variation(grid, 1e-3)
picture = camera(dp.rollout(glow, blocks, None, 8)) + 0.005 * rng.standard_normal(grid.shape)
print("gradient through the camera of PyLops and eight steps:", dp.check.gradient(loss, picture).verdict)

best = dp.minimize(loss, picture, maxiter=60, bounds=(0.0, None))
print(f"start by our search, with their camera: off by {miss(picture):.3f} -> {miss(best.x):.3f}")

# %%
# The picture
# -----------
# Above, what PyLops finds with our heat. Below, what we find with their camera.
#
# Exercises
# ---------
# 1. Let PyLops have the gradient of this library, ``dp.gradient(grid).to_scipy()``, in the place of its own
#    derivatives. What do the walls do to the result?
# 2. Make the camera see every other cell only, with ``pylops.Restriction``. Compose it with `camera` by ``@``, here
#    or there.

if options.out:
    from matplotlib import pyplot

    fields = {
        "true": blocks,
        "measured": measured,
        "PyLops, our heat": start,
        "true ": blocks,
        "picture": picture,
        "ours, their camera": best.x,
    }
    drawn, places = pyplot.subplots(2, 3, figsize=(11, 6.6), layout="constrained")
    for ax, (title, field) in zip(places.flat, fields.items()):
        dp.plot(grid, field, ax=ax, title=title, label="temperature", limits=(0.0, 1.0))
    options.out.mkdir(parents=True, exist_ok=True)
    drawn.savefig(options.out / "pylops_exchange.png", dpi=120)
