r"""
The drag of an obstacle, and its shape
======================================

An obstacle as a smooth penalty: the gradient of its drag in size, place and slenderness.

A fan blows air through a channel, around an obstacle. How does its drag change when it grows, moves, or becomes more
slender? On a grid of squares an obstacle is usually a set of cells, and a set has no derivative. A penalty that is
smooth over two cells has one.

Run it: ``python examples/shape.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="The drag of an obstacle, and its gradient in size and place.")
parser.add_argument("cells", nargs="?", type=int, default=32, help="cells across the channel")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The channel
# -----------
# Periodic along x, with walls above and below. Everything happens on faces, where velocities live.

n = options.cells
grid = dp.Grid((2 * n, n), size=(2.0, 1.0), periodic=(True, False))
dt = 0.2 / n
steps = 4 * n
volumes = grid.faces.volumes

x = grid.join(*(grid.face_centres(axis)[0] for axis in (0, 1)))
y = grid.join(*(grid.face_centres(axis)[1] for axis in (0, 1)))
along = grid.join(1.0, 0.0)
wind = along * 4 * y * (1 - y)  # strongest in the middle

# %%
# The obstacle
# ------------
# An ellipse has the radius :math:`r` of the disc of its area, a height :math:`y_0` of its centre, and a slenderness
# :math:`s`: its axes are :math:`r e^s` and :math:`r e^{-s}`. The penalty brakes what flows through it,
#
# .. math:: v_t + v \cdot \nabla v = \nu \, \Delta v - \nabla p - \frac{\chi}{\eta} \, v .
#
# Here :math:`\chi` is 1 inside and 0 outside, and :math:`\eta` is a short time. The fan adds a push along x. The drag
# is the brake itself, summed up. Source: P. Angot, C.-H. Bruneau, P. Fabrie, Numer. Math. 81 (1999).

brake = 1 / (4 * dt)


def inside(shape):
    """1 inside the ellipse, 0 outside, smooth over two cells."""
    stretch = np.exp(shape["s"])
    distance = np.sqrt(((x - 0.6) / stretch) ** 2 + ((y - shape["y"]) * stretch) ** 2)
    return 0.5 * (1 + np.tanh((shape["r"] - distance) * n / 2))


def force(v, shape):
    """A fan keeps the wind up; the obstacle brakes."""
    return 0.05 * (wind - v) - inside(shape) * v * brake


step = dp.flow_step(grid, dt, viscosity=0.004, force=force)


def flow(shape):
    """State of the air after all steps."""
    return dp.rollout(step, step.start(wind, shape), shape, steps, memory="100 MB")


def drag(shape):
    """Return the force of the wind on the obstacle along x."""
    velocity = flow(shape)["v"]
    return np.sum(volumes * along * inside(shape) * velocity) * brake


# %%
# Drag and its gradient
# ---------------------
# Five shapes. The last column compares with central differences of the drag; :math:`r, y, s` are a dict, and so is the
# gradient.

shapes = [(0.08, 0.5, 0.0), (0.12, 0.5, 0.0), (0.16, 0.5, 0.0), (0.12, 0.35, 0.0), (0.12, 0.35, 0.3)]
drag_and_slope = dp.value_and_grad(drag)
h = 1e-5
print("    r     y     s      drag   d drag/dr   d drag/dy   d drag/ds   off by")
for r, place, s in shapes:
    shape = {"r": r, "y": place, "s": s}
    value, slope = drag_and_slope(shape)
    off = 0.0
    for key in shape:
        more, less = {**shape, key: shape[key] + h}, {**shape, key: shape[key] - h}
        off = max(off, abs((drag(more) - drag(less)) / (2 * h) - slope[key]))
    slopes = "".join(f"  {slope[key]:10.6f}" for key in "rys")
    print(f"{r:5.2f} {place:5.2f} {s:5.2f}  {value:8.5f}{slopes} {off:8.0e}")

# %%
# A design question
# -----------------
# How slender must an obstacle of this area be, to be pushed three quarters as much?


def slender(s):
    """An ellipse in the middle of the channel."""
    return {"r": 0.12, "y": 0.5, "s": s}


def share(s):
    """Its drag, relative to the drag of the disc."""
    return drag(slender(s)) / drag(slender(0.0))


best = dp.minimize(lambda s: (share(s) - 0.75) ** 2, 0.0, maxiter=10)
print()
print(f"{share(best.x):.4f} of the drag of the disc at axes 1 : {np.exp(2 * best.x):.3f}")

# %%
# The picture
# -----------
# The wind around the disc, and around the ellipse that was found.
#
# Exercises
# ---------
# 1. At which height is the drag of the disc largest, and what does `d drag/dy` say there?
# 2. Halve and double the brake. Which digits of the drag change?

if options.out:
    from matplotlib import pyplot

    picture, places = pyplot.subplots(2, 1, figsize=(7, 6.4), layout="constrained")
    winds = {"disc": flow(slender(0.0))["v"], "three quarters of its drag": flow(slender(best.x))["v"]}
    most = max(np.max(np.abs(v)) for v in winds.values())
    for ax, (title, v) in zip(places, winds.items()):
        dp.plot(grid, v, ax=ax, title=title, label="speed", limits=(0, most))
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "shape.png", dpi=120)
