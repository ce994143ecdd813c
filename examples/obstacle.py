r"""
What flows in, from sensors behind a cylinder
=============================================

An unknown profile of a wind, found through a whole flow.

Wind enters a channel, flows around a cylinder, and leaves. Its speed at each height of the inflow is unknown. There are
three columns of sensors behind the cylinder, with errors of 1 %. A search with gradients
through more than a hundred steps of flow finds the profile.

Run it: ``python examples/obstacle.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="What flows in, from sensors behind a cylinder.")
parser.add_argument("cells", nargs="?", type=int, default=24, help="cells across the channel")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture and a film into this folder")
options = parser.parse_args()

# %%
# The channel
# -----------
# It is 3 long and 1 wide. An obstacle is a field of booleans, True in its cells. Each side has its own condition: the
# wind enters at :math:`x = 0`, leaves at :math:`x = 3`, and sticks to the walls and to the cylinder. The cylinder does
# not stand in the middle, so the flow is not the same on both sides of it.

n = options.cells
grid = dp.Grid((3 * n, n), size=(3.0, 1.0))
x, y = grid.centres()
cylinder = (x - 0.7) ** 2 + (y - 0.45) ** 2 < 0.15**2
sides = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}

# %%
# A step
# ------
# The flow is incompressible, with viscosity :math:`\nu = 0.005`:
#
# .. math:: v_t + \nabla \cdot (v \otimes v) = \nu \, \Delta v - \nabla p, \qquad \nabla \cdot v = 0 .
#
# `dp.flow_step` is a step of second order in space and time. Beside the cylinder the wind is about three times as fast
# as on the average; the time step is as long as that allows.

dt = 0.15 / n
steps = 7 * n
step = dp.flow_step(grid, dt, viscosity=0.005, boundary=sides, solid=cylinder)


def start(profile):
    """The profile all along the channel, made incompressible: it flows around the cylinder."""
    return step.start(grid.join(profile, 0.0))


# %%
# The unknown enters once, at the start: the step leaves the faces of the inflow as they are, so the profile keeps
# flowing in.
#
# The sensors
# -----------
# They read :math:`u` in three columns behind the cylinder, at four times.

columns = [int(place * n) for place in (1.3, 2.0, 2.7)]


def readings(profile):
    """Return the readings of the sensors at the end of each quarter of the time."""
    state = start(profile)
    values = []
    for _ in range(4):
        state = dp.rollout(step, state, None, steps // 4)
        u, _ = grid.split(state["v"])
        values += [u[column] for column in columns]
    return np.concatenate(values)


# %%
# We make up a profile, a parabola that leans to one side, and what the sensors say of it. Speeds are around 1, the
# noise is 0.01.

height = grid.coordinates(1)
hidden = 6 * height * (1 - height) * (1 + 0.8 * np.sin(2 * np.pi * height)) / 1.5
exact = readings(hidden)
measured = exact + 0.01 * np.random.default_rng(0).standard_normal(exact.size)

# %%
# The loss
# --------
# The readings have to fit. Differences from cell to cell of the profile cost a little, so that noise is not taken for a
# detail of the wind:
#
# .. math:: J(q) = \frac{1}{2} \, |\text{readings}(q) - m|^2 + 10^{-3} \sum_j (q_{j+1} - q_j)^2 .


def loss(profile):
    """Return half the squared misfit of the readings plus a penalty on roughness of the profile."""
    miss = readings(profile) - measured
    rough = profile[1:] - profile[:-1]
    return 0.5 * np.sum(miss**2) + 1e-3 * np.sum(rough**2)


flat = np.ones(n)
print(f"{np.count_nonzero(cylinder)} solid cells, {measured.size} readings, {n} unknowns, {steps} steps")
print("gradient against finite differences:", dp.check.gradient(loss, flat, quick=True).verdict)

# %%
# The search
# ----------
# It starts from the same wind at all heights. One gradient costs as much as a few runs, for any number of unknowns.

best = dp.minimize(loss, flat, maxiter=30)


def error(profile):
    """Relative error of a profile."""
    return np.linalg.norm(profile - hidden) / np.linalg.norm(hidden)


print(f"loss {loss(flat):.3f} -> {best.value:.5f} in {best.evaluations} gradients")
print(f"error of the profile {error(flat):.3f} -> {error(best.x):.4f}")

# %%
# The picture
# -----------
# The profile, and the flow that it makes with the sensors in it; the film shows that flow for three times as long.
#
# Exercises
# ---------
# 1. Take the price on differences away. What does the profile do?
# 2. Keep only the last column of sensors. Which heights of the profile are lost first?
# 3. Let the viscosity be unknown too: ``viscosity=lambda params: params`` makes it a parameter of `dp.rollout`.

if options.out:
    from matplotlib import pyplot, style

    film = dp.rollout(step, start(best.x), None, 3 * steps, keep=lambda index, state: state["v"])

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(12, 3.6), width_ratios=[1, 2.2], layout="constrained")
    left.plot(hidden, height, color="black", linewidth=4, alpha=0.3, label="true")
    left.plot(flat, height, ":", label="first guess")
    left.plot(best.x, height, label="found")
    left.set(title="the wind that flows in", xlabel="u", ylabel="y")
    left.legend(frameon=False)
    dp.plot(grid, film[steps], ax=right, title=f"the flow after {steps} steps, and the sensors", label="speed")
    right.plot(*np.meshgrid(np.array(columns) / n, height), "o", color="tab:red", markersize=3)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "obstacle.png", dpi=120)
    dp.animate(grid, film[:: max(1, n // 4)], options.out / "obstacle.gif", title="speed")
