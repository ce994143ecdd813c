r"""
The lid-driven cavity
=====================

At Reynolds number 100, against published velocities.

A square box is full of fluid, and its lid moves along. A vortex spins up and becomes steady. This is the flow on which
every solver is tried first, since its velocities are known to many digits: by spectral methods (O. Botella, R. Peyret,
Computers and Fluids 27, 1998), and on a line through the middle by U. Ghia, K. N. Ghia, C. T. Shin (J. Comput. Phys.
48, 1982).

Run it: ``python examples/cavity.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="The lid-driven cavity at Reynolds number 100.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis of the finer grid")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

KNOWN = np.array([-0.2140417, 0.1795728, -0.2538030])  # min u on x = 1/2; max v and min v on y = 1/2
Y = [0.9766, 0.9531, 0.8516, 0.7344, 0.6172, 0.5, 0.4531, 0.2813, 0.1719, 0.1016, 0.0625]
GHIA = [0.84123, 0.68717, 0.23151, 0.00332, -0.13641, -0.20581, -0.2109, -0.15662, -0.1015, -0.06434, -0.04192]

# %%
# The equations
# -------------
# The velocity :math:`v` carries itself, is slowed by viscosity, and stays free of divergence:
#
# .. math:: v_t + v \cdot \nabla v = \nu \, \Delta v - \nabla p, \qquad \nabla \cdot v = 0 .
#
# With a lid of speed 1 over a box of side 1, the Reynolds number is :math:`1 / \nu`. The moving lid enters as a source:
# it is what the Laplacian makes of the value at that wall, and `dp.face_lift` knows it.


def cavity(n):
    """Return the grid of the unit square, one time step with a moving upper wall, and the step size."""
    grid = dp.Grid((n, n), size=1.0)
    slow = dp.face_laplacian(grid)
    lid = dp.face_lift(grid)
    convect = dp.convection(grid)
    project = dp.projection(grid)
    moving = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0))  # the upper wall in y, along x
    dt = min(20 / n**2, 0.5 / n)  # 0.2 h^2 / nu: explicit viscosity is stable

    def step(v, viscosity):
        """Viscosity and convection, then the projection."""
        rate = viscosity * (slow(v) + moving) - convect(v, v)
        return project(v + dt * rate)

    return grid, step, dt


# %%
# Until it is steady
# ------------------
# We run from rest, 50 steps at a time, until the velocity changes by less than 1e-5 in a unit of time.


def steady(grid, step, dt, viscosity=0.01):
    """Return the steady velocity and the number of time steps."""
    v = np.zeros(grid.faces.size)
    rate, steps = 1.0, 0
    while rate > 1e-5:
        before = v
        v = dp.rollout(step, v, viscosity, 50)
        rate = np.max(np.abs(v - before)) / (50 * dt)
        steps += 50
    return v, steps


# %%
# What is compared
# ----------------
# The extreme velocities on the two lines through the middle. An extreme lies between cells: a parabola through the
# three points around it finds it.


def peak(line):
    """Return the maximum of the parabola through the largest value and its neighbours."""
    low, top, high = line[np.argmax(line) - 1 :][:3]
    return top + (high - low) ** 2 / (8 * (2 * top - low - high))


def extremes(grid, v):
    """min u on x = 1/2, max v and min v on y = 1/2."""
    u, w = grid.split(v)
    on_x = u[grid.shape[0] // 2]
    on_y = w[:, grid.shape[1] // 2]
    return np.array([-peak(-on_x), peak(on_y), -peak(-on_y)])


print("cells     min u     max v     min v  off by  steps  seconds")
for n in (options.cells // 2, options.cells):
    clock = perf_counter()
    grid, step, dt = cavity(n)
    v, steps = steady(grid, step, dt)
    ours = extremes(grid, v)
    off = np.max(np.abs(ours / KNOWN - 1))
    values = "  ".join(f"{value:8.5f}" for value in ours)
    print(f"{n:4}^2  {values}  {off:6.2%}  {steps:5}  {perf_counter() - clock:7.1f}")
print(" known  " + "  ".join(f"{value:8.5f}" for value in KNOWN))

# %%
# The picture
# -----------
# The speed, and :math:`u` on the vertical line through the middle beside Ghia's points.
#
# Exercises
# ---------
# 1. Reynolds number 400: `viscosity=0.0025`. Where does the centre of the vortex go?
# 2. Ask for the slope of `min u` in the viscosity, by `dp.grad` through the last 50 steps, and through 500. Why do they
#    differ? The example `steady_states.py` has the answer without a loop over time.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    dp.plot(grid, v, ax=left, title="the flow at Re 100", label="speed")
    u, _ = grid.split(v)
    right.plot(u[grid.shape[0] // 2], grid.centres()[1][0], label=f"{options.cells}^2 cells")
    right.plot(GHIA, Y, "o", label="Ghia, Ghia, Shin")
    right.set(title="u on x = 1/2", xlabel="u", ylabel="y")
    right.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "cavity.png", dpi=120)
