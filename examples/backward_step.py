r"""
A backward-facing step
======================

Steady flow over a step, followed from Re 100 to 800, beside published lengths of the vortex behind the step.

A channel widens suddenly to twice its height. Behind the step the flow separates, and reaches the lower wall again a
few step heights further on. This reattachment length grows with the Reynolds number. Reference: E. Erturk, Numerical
solutions of 2-D steady incompressible flow over a backward-facing step, Computers and Fluids 37 (2008).

Run it: ``python examples/backward_step.py [cells a step height] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Steady flow over a backward-facing step.")
parser.add_argument("cells", nargs="?", type=int, default=20, help="cells along the height of the step")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

KNOWN = {100: 2.922, 200: 4.982, 300: 6.751, 400: 8.237, 500: 9.420, 600: 10.349, 700: 11.129, 800: 11.834}

# %%
# The scene
# ---------
# The step has the height 1, and so has the channel before it. The mean velocity there is 1, so that with the hydraulic
# diameter 2 the viscosity is :math:`2 / Re`. The solid cells are the step.

UPSTREAM, LENGTH = 4, 34
n = options.cells
long = n // 2  # cells of a unit length along the channel
grid = dp.Grid(((UPSTREAM + LENGTH) * long, 2 * n), size=(UPSTREAM + LENGTH, 2.0), origin=(-UPSTREAM, 0.0))
x, y = grid.centres()
step = (x < 0) & (y < 1)
sides = {"x": (dp.inflow, dp.outflow)}

D = dp.divergence(grid)
G = dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)})  # the pressure at the outflow is 0
L = dp.face_laplacian(grid, sides, step)
convect = dp.convection(grid, sides, step)
free = dp.free_faces(grid, sides, step)

at_inlet, height = grid.face_centres(0)
parabola = np.where((at_inlet == -UPSTREAM) & (height > 1), 6 * (height - 1) * (2 - height), 0.0)
entering = grid.join(parabola, 0.0)


# %%
# The equations
# -------------
# `dp.free_faces` tells on which faces the velocity is unknown. There the momentum balance holds; on all other faces,
# those of walls, of the inlet and of the step, the velocity is given. In solid cells the pressure is set to 0.


def flow(state, reynolds):
    """Return the residuals of the momentum equation and of conservation of mass."""
    v, p = state["v"], state["p"]
    momentum = 2.0 / reynolds * L(v) - convect(v, v) - G(p)
    given = v - entering
    return {"v": free(momentum) + given - free(given), "p": D(v) + step * p}


def reattachment(state):
    """Return where the velocity next to the lower wall changes its sign: the last zero before the outflow."""
    along_x, _ = grid.split(state["v"])
    near_wall = along_x[:, 0]
    positions = grid.face_centres(0)[0][:, 0]
    last = np.flatnonzero(near_wall < 0)[-1]
    share = near_wall[last] / (near_wall[last] - near_wall[last + 1])
    return positions[last] + share * (positions[last + 1] - positions[last])


# %%
# Continuation in the Reynolds number
# -----------------------------------
# Newton's method from rest fails at Re 800. `dp.continuation` follows the flow from Re 100, with steps that it chooses;
# ``branch.solve`` returns the flow at any number between. Its derivative takes one adjoint solve.

clock = perf_counter()
rest = {"v": entering, "p": np.zeros(grid.shape)}
branch = dp.continuation(flow, rest, 100.0, 800.0, largest_step=200.0)
print(f"{branch}, {perf_counter() - clock:.1f} s")


def length_at(reynolds, near):
    """Return the reattachment length at a Reynolds number, from the nearest point of the branch."""
    return reattachment(branch.solve(near, reynolds))


lengths = {}
print("   Re  length  known  off by  d length / d Re")
for reynolds, known in KNOWN.items():
    near = int(np.argmin(np.abs(branch.parameter - reynolds)))
    length, slope = dp.value_and_grad(length_at)(float(reynolds), near)
    lengths[reynolds] = length
    print(f"{reynolds:5}  {length:6.3f}  {known:5.2f}  {length / known - 1:6.1%}  {slope:.5f}")

# %%
# Exercises
# ---------
# 1. How does the length change if the channel before the step is left out? Set `UPSTREAM` to 1.
# 2. Which shape of the inlet profile, with the same mean, makes the vortex shortest? Make the profile a parameter of
#    `flow`, and give the gradient to `dp.minimize`.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (top, bottom) = pyplot.subplots(2, 1, figsize=(10, 5.5), layout="constrained")
    along_x, _ = grid.split(branch.states[-1]["v"])
    u = 0.5 * (along_x[:-1] + along_x[1:])
    image = top.pcolormesh(x, y, np.where(step, np.nan, u), shading="nearest")
    top.contour(x, y, np.where(step, np.nan, u), [0.0], colors="white")
    top.plot([KNOWN[800]], [0.0], "^", color="red", markersize=12, clip_on=False, label="reattachment, Erturk")
    top.set(title="u at Re 800; white: u = 0", xlim=(-2, 25), xlabel="x", ylabel="y")
    top.legend(loc="upper right")
    picture.colorbar(image, ax=top)
    bottom.plot(list(lengths), list(lengths.values()), label=f"{n} cells a step height")
    bottom.plot(list(KNOWN), list(KNOWN.values()), "o", label="Erturk")
    bottom.set(xlabel="Re", ylabel="reattachment length")
    bottom.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "backward_step.png", dpi=120)
