r"""
A ventilated room
=================

An inlet, an outlet and a heated strip, each on part of a wall, and the optimal velocity of the air at the inlet.

Fresh air enters through an opening high in the left wall and leaves through an opening low in the right wall. The sun
warms a strip of the floor: its temperature varies along the strip and in time. How fast should the air enter, at each
height of the inlet, so that the lower half of the room has a comfortable temperature, with little power of the fan?

Run it: ``python examples/room.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Ventilation of a room through openings in its walls.")
parser.add_argument("cells", nargs="?", type=int, default=24, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

n = options.cells
grid = dp.Grid((n, n), size=1.0)

# %%
# Conditions on part of a wall
# ----------------------------
# `dp.patch` is written in place of the condition of a wall. It holds on an interval of the wall; on the other faces
# another condition holds, by default `no_slip` for the flow and `neumann` (insulated) for the temperature. The air that
# enters has the temperature 0, so that the inlet is a patch of `dirichlet` for the temperature.

inlet = dp.patch((0.7, 0.95), dp.inflow, elsewhere=dp.no_slip)
outlet = dp.patch((0.05, 0.3), dp.outflow)
supply = dp.patch((0.7, 0.95), dp.dirichlet, elsewhere=dp.neumann)
strip = dp.patch((0.25, 0.75), dp.dirichlet)

flow_boundary = {"x": (inlet, outlet)}
heat_boundary = {"x": (supply, dp.neumann), "y": (strip, dp.neumann)}
walls = dp.lift(grid, heat_boundary).domain
to_faces = dp.average(grid, heat_boundary)
print(f"operator of the heat: {dp.laplacian(grid, heat_boundary).name}")

# %%
# The equations
# -------------
# The temperature :math:`T` is transported by the velocity :math:`v`, and diffuses. The air rises where it is warm
# (Boussinesq approximation):
#
# .. math:: T_t + v \cdot \nabla T = \kappa \, \Delta T, \qquad
#           v_t + v \cdot \nabla v = \nu \, \Delta v - \nabla p + T \, e_y, \qquad \nabla \cdot v = 0 .
#
# The parameters are the speed at each face of the inlet and the time. Boundary data are functions of the parameters:
# one line for the speed along the inlet, and one for the temperature along the strip, which the sun warms from left to
# right.

DT = 0.2 / n
STEPS = 16 * n
TIMES = DT * np.arange(1, STEPS + 1)
x_of_strip = grid.coordinates(0)
at_left = grid.face_centres(0)[0] == 0.0  # the x-faces on the left wall


def speed_of_inlet(params):
    """Return velocities on all faces; `flow_step` uses only those of the inlet."""
    return grid.join(at_left * inlet.values(grid, "x", params["speed"]), 0.0)


def temperature_of_walls(params):
    """Return the temperatures of the strip; they move along the floor in time."""
    sun = np.exp(-20.0 * (x_of_strip - 0.25 - 0.15 * params["time"]) ** 2)
    return walls.join(0.0, 0.0, strip.values(grid, "y", sun), 0.0)


def buoyancy(v, scalars, params):
    """Return the force on the faces across y."""
    return grid.join(0.0, 1.0) * to_faces(scalars["heat"])


step = dp.flow_step(
    grid,
    DT,
    2e-3,
    buoyancy,
    boundary=flow_boundary,
    inflow=speed_of_inlet,
    implicit=True,
    scalars={"heat": {"diffusivity": 2e-3, "boundary": heat_boundary, "values": temperature_of_walls}},
)


def simulate(speed):
    """Return the state at the end."""
    start = step.start(np.zeros(grid.faces.size), {"speed": speed, "time": 0.0}, {"heat": 0.3 * np.ones(grid.shape)})
    return dp.rollout(
        lambda state, speed, time: step(state, {"speed": speed, "time": time}), start, speed, STEPS, inputs=TIMES
    )


# %%
# Conservation of mass
# --------------------

first = 0.2 * np.ones(n)
state = simulate(first)
along_x, along_y = grid.split(state["v"])
h = 1 / n
closed = np.max(np.abs(along_x[0, : int(0.7 * n)])) + np.max(np.abs(along_y[:, [0, -1]]))
print(f"air in {h * np.sum(along_x[0]):.6f}, out {h * np.sum(along_x[-1]):.6f}, through closed walls {closed:.0e}")

# %%
# The search
# ----------
# The loss is the mean square difference of the temperature in the lower half of the room, away from the walls, from
# 0.2, plus the power of the fan, which grows with the third power of the speed. One backward pass gives the derivatives
# with respect to the speed at all faces of the inlet.

x, y = grid.centres()
zone = (x > 0.15) & (x < 0.85) & (y > 0.1) & (y < 0.5)
WANTED = 0.2


def loss(speed):
    """Return the discomfort plus the power of the fan."""
    heat = simulate(speed)["s"]["heat"]
    discomfort = np.sum(zone * (heat - WANTED) ** 2) / np.sum(zone)
    at_inlet = inlet.values(grid, "x", speed)
    return 100 * discomfort + 0.3 * h * np.sum(at_inlet**3)


gradient = dp.grad(loss)(first)
direction = np.cos(3.0 * y[0])
difference = (loss(first + 1e-4 * direction) - loss(first - 1e-4 * direction)) / 2e-4
print(f"gradient along a direction {np.sum(gradient * direction):.6f}, by a difference {difference:.6f}")
best = dp.minimize(loss, first, method="lbfgs", bounds=(0.0, 1.0), maxiter=15).x
after = simulate(best)
print(f"loss {loss(first):.4f} -> {loss(best):.4f}")
for name, end in (("before", state), ("after", after)):
    heat = end["s"]["heat"][zone]
    deviation = np.sqrt(np.mean((heat - WANTED) ** 2))
    print(f"{name:6} mean temperature of the zone {np.mean(heat):.4f}, deviation from {WANTED}: {deviation:.4f}")

# %%
# The picture
# -----------
# Left: the temperature and the streamlines before the search; the openings are green, the strip is red. Middle: the
# same after the search. Right: the speed along the inlet.
#
# Exercises
# ---------
# 1. Move the outlet to the ceiling: ``{"x": (inlet, dp.no_slip), "y": (dp.no_slip, outlet)}``. What changes?
# 2. Let the speed at the inlet change in time: pass rows of speeds as `inputs`, one for each step.
# 3. Replace the strip by a wall that loses heat, ``dp.patch((0.25, 0.75), dp.robin(1.0, 0.1))``.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    for ax, title, end in ((left, "before", state), (middle, "after", after)):
        dp.plot(grid, end["s"]["heat"], ax=ax, title=f"temperature {title}", cmap="inferno", label="T")
        u, w = grid.split(end["v"])
        centres = grid.coordinates(0)
        in_cells = 0.5 * (u[1:] + u[:-1]), 0.5 * (w[:, 1:] + w[:, :-1])
        ax.streamplot(centres, centres, in_cells[0].T, in_cells[1].T, color="white", density=0.8, linewidth=0.6)
        for place, ends in ((0.0, (0.7, 0.95)), (1.0, (0.05, 0.3))):
            ax.plot([place, place], ends, color="limegreen", linewidth=6, clip_on=False)
        ax.plot([0.25, 0.75], [0.0, 0.0], color="red", linewidth=6, clip_on=False)
    is_open = inlet.values(grid, "x", 1.0) > 0
    height = grid.coordinates(1)[is_open]
    right.plot(first[is_open], height, "--", label="before")
    right.plot(best[is_open], height, "o-", label="after")
    right.set(title="speed along the inlet", xlabel="speed", ylabel="y")
    right.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "room.png", dpi=120)
