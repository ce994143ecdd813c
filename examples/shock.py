r"""
The shock of Burgers' equation
==============================

A front 0.01 wide against the exact solution: what first and third order interpolation cost.

With a little viscosity the shock of Burgers' equation is not a jump but a front, and its exact shape is known. When it
is steepest, its slope is 152. How many cells does a scheme need to see that?

Run it: ``python examples/shock.py [cells] [--out FOLDER]``
"""

import argparse
import time
from pathlib import Path

import numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="The shock of Burgers' equation, against the exact solution.")
parser.add_argument("cells", nargs="?", type=int, default=512, help="cells for each unit of length")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# What is known
# -------------
# The problem is :math:`u_t + u \, u_x = \nu \, u_{xx}` on :math:`(-1, 1)`, with :math:`u = 0` at both ends and
# :math:`u = -\sin \pi x` at the start. The figures come from the exact solution.

VISCOSITY = 0.01 / np.pi
STEEPEST = 1.6037 / np.pi  # the time of the steepest slope
SLOPE = -152.005161576  # in the middle at that time
PLACES = [-0.75, -0.5, -0.25]
VALUES = [0.302842708347, 0.592769534402, 0.847354524451]  # there, at t = 0.5

# %%
# A step
# ------
# Half a step of diffusion, transport, half a step of diffusion. Diffusion is implicit, by the rule of Crank and
# Nicolson:
#
# .. math:: u \leftarrow (I - \tfrac{\Delta t}{4} \nu L)^{-1} (I + \tfrac{\Delta t}{4} \nu L) \, u .
#
# Transport looks upstream. Along its way :math:`u` keeps its value, so the speed of the way is the value on arrival;
# that is not known yet, and a first transport guesses it.


def run(n, end, interpolation):
    """Cell centres and u at the end, with n cells for each unit of length."""
    line = dp.Grid(2 * n, size=2.0, origin=-1.0)
    steps = int(np.ceil(2 * end * n))
    dt = end / steps

    one = dp.identity(line.cells)
    bend = 0.25 * VISCOSITY * dt * dp.laplacian(line, dp.dirichlet)
    smooth = dp.inverse(one - bend) @ (one + bend)
    carry = dp.transport(line, "semi_lagrangian", dp.dirichlet, "cells", interpolation=interpolation)

    (x,) = line.centres()
    u = -np.sin(np.pi * x)
    for _ in range(steps):
        u = smooth(u)
        arrival = carry(u, u, dt)
        u = carry(u, arrival, dt)
        u = smooth(u)
    return x, u


# %%
# First and third order
# ---------------------
# Between cells the scheme interpolates, linearly or by cubics. Linear interpolation smears a front in every step.

fronts = {}
print("          width   slope at t = 0.510   off by   profile at t = 0.5 off by   seconds")
for interpolation in ("linear", "cubic"):
    for n in (options.cells // 2, options.cells):
        clock = time.perf_counter()
        x, u = fronts[f"{interpolation}, 1/{n}"] = run(n, STEEPEST, interpolation)
        seconds = time.perf_counter() - clock
        slope = (u[n] - u[n - 1]) * n
        profile = np.interp(PLACES, *run(n, 0.5, interpolation))
        off = np.max(np.abs(profile - VALUES))
        print(f"{interpolation:8} 1/{n:<5} {slope:18.3f} {slope / SLOPE - 1:9.1%} {off:26.1e} {seconds:10.2f}")
print("exact                     -152.005")

# %%
# The picture
# -----------
# The front at its steepest moment. The thin line has the exact slope.
#
# Exercises
# ---------
# 1. Leave the guess of the arrival away (`carry(u, u, dt)` alone). Which order in time is left?
# 2. Put cells where the front is: `dp.Grid(..., spacing=widths)` takes an array of widths.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, ax = pyplot.subplots(figsize=(7, 4), layout="constrained")
    near = np.array([-0.006, 0.006])
    ax.plot(near, SLOPE * near, color="black", linewidth=1, label="exact slope")
    for (name, (x, u)), mark in zip(fronts.items(), "osv^"):
        ax.plot(x, u, marker=mark, markersize=4, linewidth=1, label=name)
    width = max(0.03, 4 / options.cells)
    ax.set(xlim=(-width, width), xlabel="x", ylabel="u", title="the steepest moment")
    ax.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "shock.png", dpi=120)
