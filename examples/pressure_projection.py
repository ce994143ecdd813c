r"""
Wind made from afar by pressure
===============================

Gradient descent as published, and the same question as least squares in five solves.

A closed box is full of air that cannot be compressed. We may set the velocity in its left half; the wind that we want
is in the right half. The only thing that reaches across is pressure. How near can we come?

Run it: ``python examples/pressure_projection.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np
from scipy.sparse.linalg import lsqr

import sparsedp as dp

parser = argparse.ArgumentParser(description="Wind made from afar by pressure.")
parser.add_argument("cells", nargs="?", type=int, default=80, help="cells along x")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The projection
# --------------
# Velocities have values on the faces of cells, so that the divergence of a cell is the flow out of its own faces. The
# pressure :math:`p` changes any wind :math:`v` to an incompressible one:
#
# .. math:: P v = v - \nabla p \quad \text{with} \quad \Delta p = \nabla \cdot v .
#
# As :math:`\nabla` and :math:`-\nabla\cdot` are transposes of each other, :math:`P` is a projection, symmetric and
# idempotent: :math:`P^T = P` and :math:`P P = P`. Its gradient costs one more projection.

grid = dp.Grid((options.cells, 4 * options.cells // 5), size=(80.0, 64.0))
project = dp.projection(grid)

# %%
# We check that with random winds. On a computer it holds to rounding.

w = np.random.default_rng(0).standard_normal(grid.faces.size)
z = np.random.default_rng(1).standard_normal(grid.faces.size)
asymmetry = abs(w @ project(z) - project(w) @ z) / abs(w @ project(z))
change = np.max(np.abs(project(project(w)) - project(w)))
left_over = np.max(np.abs(dp.divergence(grid)(project(w))))
print(f"symmetric: {asymmetry:.0e}, idempotent: {change:.0e}, divergence left: {left_over:.0e}")

# %%
# The unknown and the target
# --------------------------
# A mask is an operator as well: it keeps the values on some faces, and sets the others to zero. The wanted wind blows
# upwards in the right half, and is strongest around the point (50, 10).

x_faces, _ = grid.face_centres(0)
x, y = grid.face_centres(1)
across = grid.join(x_faces, x)  # x of every face
left = dp.mask(grid.faces, across <= 40)
right = dp.mask(grid.faces, across >= 40) @ dp.interior(grid)

upwards = 2 * np.exp(-((x - 50) ** 2 + (y - 10) ** 2) / (2 * 32**2))
target = right(grid.join(np.zeros_like(x_faces), upwards))

# %%
# Operators are composed with `@`. This one takes the wind in the left half, makes it incompressible, and returns its
# right half.
#
# .. math:: J(v) = \frac{1}{2} \, | R \, P \, M \, v - w |^2

reach = right @ project @ left


def loss(v):
    """Return half the sum of squared errors on the right."""
    return 0.5 * np.sum((reach(v) - target) ** 2)


# %%
# Gradient descent
# ----------------
# Rate 1, from rest, beside published figures. The loss falls fast at first, and slowly later.

loss_and_gradient = dp.value_and_grad(loss)
v = np.zeros(grid.faces.size)
losses = []
for _ in range(20):
    value, gradient = loss_and_gradient(v)
    losses.append(value)
    v = v - gradient

print("steps       loss   published")
for steps, known in ((0, "2432.29"), (1, "1945.7"), (4, "1462"), (10, "1373.0"), (19, "1370.7")):
    print(f"{steps:5} {losses[steps]:10.2f} {known:>11}")

# %%
# Least squares
# -------------
# The loss is quadratic in :math:`v`, so this is linear least squares, and `reach` is a linear operator that SciPy's
# LSQR accepts. Each of its iterations needs one forward and one adjoint projection.

fitted = []
print("LSQR: projections forward and adjoint")
print("pairs       loss")
for pairs in range(2, 7):  # the first adjoint only starts it
    best, *_ = lsqr(reach.to_scipy(), target, iter_lim=pairs - 1, atol=0, btol=0, conlim=0)
    fitted.append(loss(best))
    print(f"{pairs:5} {fitted[-1]:10.2f}")

# %%
# The picture
# -----------
# Left: the wind that we set. Middle: its projection, which has no divergence. Right: the wanted wind. Most of it cannot
# be reached: it has divergence and vorticity, while in the right half every reachable wind is a gradient.
#
# Exercises
# ---------
# 1. Use the right half of `project(target)` as the target. How small does the loss become?
# 2. Open the upper wall: `dp.projection(grid, boundary={"y": (dp.no_slip, dp.outflow)})`. Does the loss become smaller?
# 3. How many pairs does LSQR need on a grid of 320 cells? Compare with gradient descent.

if options.out:
    from matplotlib import pyplot

    picture, places = pyplot.subplots(1, 3, figsize=(13, 3.2), layout="constrained")
    fields = {"ours": left(best), "becomes": project(left(best)), "wanted": target}
    for ax, (title, field) in zip(places, fields.items()):
        dp.plot(grid, field, ax=ax, title=title, label="speed")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "pressure_projection.png", dpi=120)
