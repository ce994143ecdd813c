r"""
A smoke plume
=============

Smoke that rises in a closed box: one line for each law, with the published figures of every step.

Hot smoke enters near the floor, rises, and drives the air that carries it. A step of this flow is a handful of laws,
and each of them is one line. At the end we ask a question that a simulation alone does not answer: where would a little
more smoke lift the whole cloud the most?

Run it: ``python examples/plume.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="A smoke plume in a closed box, step by step.")
parser.add_argument("cells", nargs="?", type=int, default=32, help="cells along x")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture and a film into this folder")
options = parser.parse_args()

# %%
# The box
# -------
# Smoke has values in cells, the wind on the faces between them. Smoke enters in a disc, in every step.

grid = dp.Grid((options.cells, 5 * options.cells // 4), size=(80.0, 100.0))
h = 80 / options.cells  # width of a cell
dt = 1.5
viscosity = 0.01
steps = 11

x, y = grid.centres()
source = 0.2 * ((x - 30) ** 2 + (y - 15) ** 2 <= 10**2)

# %%
# The laws
# --------
# The wind :math:`v` and the smoke :math:`s` satisfy
#
# .. math:: s_t + v \cdot \nabla s = q, \qquad
#           v_t + v \cdot \nabla v = s \, e_y + \nu \, \Delta v - \nabla p, \qquad \nabla \cdot v = 0 .
#
# Smoke is advected and added. The wind is advected by itself, accelerated upwards by smoke, and slowed by viscosity;
# the pressure :math:`p` keeps it free of divergence. Each of these laws needs an operator.

carry_smoke = dp.transport(grid, "semi_lagrangian")
carry_wind = dp.transport(grid, "semi_lagrangian", boundary=dp.dirichlet, of="faces")  # no wind beyond the walls
to_faces = dp.average(grid)
up = grid.join(0.0, 1.0)  # 1 on faces that look upwards, 0 on the others
inside = dp.interior(grid)  # no flow through the walls
project = dp.projection(grid)

# %%
# Viscosity acts on each component of the wind, on the mesh of its own faces. As in the published run, the wind is 0 one
# spacing beyond the last samples; this is a Robin condition.

bend = [dp.laplacian(dp.Grid(grid.face_shape(axis), spacing=h), dp.robin(2, h)) for axis in (0, 1)]


def diffuse(wind):
    """The wind after viscosity has slowed it for one step."""
    parts = [L(part) for L, part in zip(bend, grid.split(wind))]
    return wind + dt * viscosity * grid.join(*parts)


# %%
# A step applies these laws one after the other.


def step(state, source):
    """One time step of smoke and wind."""
    smoke, wind = state
    smoke = carry_smoke(smoke, wind, dt) + source
    wind = carry_wind(wind, wind, dt)
    wind = inside(wind + dt * up * to_faces(smoke))
    wind = diffuse(wind)
    return smoke, project(wind)


# %%
# Forward
# -------
# From air at rest. The table shows the largest wind of each step beside the published one. The divergence is the
# residual of the pressure solve.

still = np.zeros(grid.shape), np.zeros(grid.faces.size)
smoke, wind = dp.rollout(step, still, source, steps, keep="all")

PUBLISHED = [0.1558497, 0.46300, 0.89665, 1.40989, 2.04113, 2.92796, 3.83948, 4.52694, 4.86798, 5.13108, 5.48387]
divergence = dp.divergence(grid)
print("step  largest wind  published (n = 32)  mean smoke  divergence")
for k in range(1, steps + 1):
    largest = np.max(np.abs(wind[k]))
    left = np.max(np.abs(divergence(wind[k])))
    print(f"{k:4} {largest:13.5f} {PUBLISHED[k - 1]:19.5f} {np.mean(smoke[k]):11.6f} {left:11.0e}")

# %%
# Where would more smoke lift the cloud?
# --------------------------------------
# The height of the cloud is that of its centre of mass. One backward pass through transport, buoyancy and eleven
# pressure solves computes its derivative with respect to the source in all cells.
#
# .. math:: J(q) = \frac{\sum_i y_i \, s_i}{\sum_i s_i}


def height(source):
    """Centre of the smoke after all steps."""
    smoke, _ = dp.rollout(step, still, source, steps)
    return np.sum(y * smoke) / np.sum(smoke)


lift = dp.grad(height)(source)
print("gradient of the height in the source, against finite differences:", dp.check.gradient(height, source).verdict)

# %%
# The picture
# -----------
# Left: smoke after the last step. Right: how much one more unit of smoke in a cell, in each step, would lift the cloud.
# High up, additional smoke lifts the centre of mass by its position; in the stream, by its buoyancy. At low positions
# beside the stream it lowers the centre.
#
# Exercises
# ---------
# 1. Take `dp.transport(grid, "maccormack")` for the smoke. Which details survive?
# 2. Put an obstacle into the stream: `dp.projection(grid, solid=...)` and `dp.interior(grid, solid)` take a mask of
#    cells.
# 3. Find the place of the disc that lifts the cloud the most. Why does its gradient vanish with the cell-centre test,
#    and what is a smooth disc?

if options.out:
    from matplotlib import pyplot

    picture, (cloud, slope) = pyplot.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
    dp.plot(grid, smoke[-1], ax=cloud, title=f"smoke after {steps} steps", label="smoke", cmap="magma")
    most = np.max(np.abs(lift))
    label = "lift for each unit of smoke"
    dp.plot(grid, lift, ax=slope, title="where more would lift", label=label, limits=(-most, most), cmap="RdBu_r")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "plume.png", dpi=120)
    film, _ = dp.rollout(step, still, source, 40, keep="all")
    dp.animate(grid, film, options.out / "plume.gif", title="smoke", cmap="magma")
