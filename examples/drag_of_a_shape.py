r"""
The drag of a shape
===================

A cylinder in a channel, whose wall cuts the cells of the grid: drag and lift beside published digits, where the wall
has to move for less drag, and a shape of the same area with less drag.

``dp.cut_flow`` computes the steady flow around a body that is given by a level set. The force on the body has a
derivative in every value of the level, by one solve with the transposed Jacobian.

Run it: ``python examples/drag_of_a_shape.py [cells a diameter] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="The drag of a shape.")
parser.add_argument("cells", nargs="?", type=int, default=20, help="cells a diameter")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The published cylinder
# ----------------------
# The benchmark DFG 2D-1: a channel of height 0.41 with a cylinder of diameter 0.1 a little below the middle, Reynolds
# number 20. The cells are longer behind the cylinder. The coefficients of the force :math:`F` are
#
# .. math:: c = \frac{2 F}{U^2 D}, \qquad U = 0.2.

HEIGHT, RADIUS, CENTRE, VISCOSITY = 0.41, 0.05, 0.2, 1e-3
DRAG, LIFT = 5.57953523384, 0.010618948146  # published


def channel(cells):
    """The grid of the channel."""
    h = 2 * RADIUS / cells
    wake = np.minimum(1.04 ** (20 / cells * np.arange(1, 40 * cells)), 8.0)
    wake = wake[: np.argmax(np.cumsum(wake) >= 1.8 / h) + 1]
    widths = np.append(np.full(4 * cells, h), 1.8 / np.sum(wake) * wake)
    return dp.Grid((widths.size, round(HEIGHT / h)), spacing=[widths, h])


def flow_around(grid, level):
    """The flow around a body, and its coefficients of drag and lift."""
    y = grid.face_centres(0)[1]
    flow = dp.cut_flow(grid, level, {"x": (dp.inflow, dp.outflow)})
    state = flow.steady(VISCOSITY, grid.join(1.2 * y * (HEIGHT - y) / HEIGHT**2, 0.0))
    return state, 500 * flow.force(state, VISCOSITY)


def distance(x, y):
    """The distance from the axis of the cylinder."""
    return np.sqrt((x - CENTRE) ** 2 + (y - CENTRE) ** 2)


grid = channel(options.cells)
state, (drag, lift) = flow_around(grid, lambda x, y: distance(x, y) - RADIUS)
print(f"drag {drag:.4f}, published {DRAG:.4f}, {abs(drag / DRAG - 1):.2%} off")
print(f"lift {lift:.5f}, published {LIFT:.5f}, {abs(lift / LIFT - 1):.1%} off")

# %%
# Where the wall has to move
# --------------------------
# The shape is a radius that depends on the angle: waves :math:`a_k \cos k \theta + b_k \sin k \theta` on the circle.
# The derivatives of the drag in all of them are the waves of a function of the angle, the **shape gradient**: how much
# the drag changes when the wall moves outwards there. Differences confirm them for another shape, on no node of the
# grid.

WAVES = 5
coarse = channel(max(options.cells // 2, 10))


def radius_of(shape, angle):
    """The radius at an angle; all shapes have the area of the cylinder."""
    cosines, sines = shape
    waves = sum(c * np.cos(k * angle) + s * np.sin(k * angle) for k, (c, s) in enumerate(zip(cosines, sines)))
    area = (1 + cosines[0]) ** 2 + 0.5 * np.sum(cosines[1:] ** 2 + sines[1:] ** 2)
    return RADIUS * (1 + waves) / np.sqrt(area)


def drag_of(shape):
    """The drag coefficient of a shape."""
    level = lambda x, y: distance(x, y) - radius_of(shape, np.arctan2(y - CENTRE, x - CENTRE))
    return flow_around(coarse, level)[1][0]


circle = np.zeros((2, WAVES))
value, gradient = dp.value_and_grad(drag_of)(circle)
other = 0.02 / np.arange(1.0, 2 * WAVES + 1).reshape(2, WAVES)
slope = dp.grad(drag_of)(other)
step = 1e-5 * slope / np.linalg.norm(slope)
difference = (drag_of(other + step) - drag_of(other - step)) / 2e-5
print(f"slope {np.linalg.norm(slope):.5f}, by differences {difference:.5f}")

# %%
# A shape with less drag
# ----------------------
# Some steps of L-BFGS find a slender body of the same area. The waves of number 0 and 1 are left out: the first is the
# size, the second moves the body. Bounds keep the radius positive.

kept = np.ones((2, WAVES)) * (np.arange(WAVES) > 1)
found = dp.minimize(lambda shape: drag_of(kept * shape), circle, method="lbfgs", maxiter=5, bounds=(-0.12, 0.12))
best = kept * found.x
print(f"drag on the coarse grid {value:.3f} -> {drag_of(best):.3f} with the same area")

# %%
# The picture
# -----------
# Left: the speed around the cylinder. Middle: the shape gradient. Right: the speed around the slender body.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (before, around, after) = pyplot.subplots(1, 3, figsize=(13, 4), layout="constrained")
    angle = np.linspace(0, 2 * np.pi, 300)
    level = lambda x, y: distance(x, y) - radius_of(best, np.arctan2(y - CENTRE, x - CENTRE))
    slender, _ = flow_around(grid, level)
    drawn = (before, state, circle, "cylinder"), (after, slender, best, "less drag, same area")
    for axes, flow, shape, title in drawn:
        u, v = grid.split(flow["v"])
        speed = np.hypot(0.5 * (u[1:] + u[:-1]), 0.5 * (v[:, 1:] + v[:, :-1]))
        dp.plot(grid, speed, ax=axes, title=f"speed: {title}", label="speed")
        r = radius_of(shape, angle)
        axes.fill(CENTRE + r * np.cos(angle), CENTRE + r * np.sin(angle), "w", ec="k")
        axes.set(xlim=(0, 0.6))
    cosines, sines = gradient
    density = sum(c * np.cos(k * angle) + s * np.sin(k * angle) for k, (c, s) in enumerate(zip(cosines, sines)))
    points = around.scatter(np.cos(angle), np.sin(angle), c=density, cmap="coolwarm", s=60)
    around.quiver(
        np.cos(angle[::10]), np.sin(angle[::10]), *(-density[::10] * f(angle[::10]) for f in (np.cos, np.sin))
    )
    around.set(title="where the wall has to move", xlim=(-1.6, 1.6), ylim=(-1.6, 1.6), aspect="equal")
    picture.colorbar(points, ax=around, shrink=0.7, label="derivative of the drag")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "drag_of_a_shape.png", dpi=120)
