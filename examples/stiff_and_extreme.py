r"""
What breaks a scene?
====================

Three sound scenes, and two with a fault, driven through stiff and extreme cases.

A loss that works for the numbers at hand may fail for others: a longer time step, a larger viscosity, a NaN, a field
that is read-only. ``dp.stress`` tries all that in turn and gives the outcome of each case: passed, refused with an
error that states the reason, degraded, or FAILED. A failure is a wrong number without an error.

Run it: ``python examples/stiff_and_extreme.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="What breaks a scene? Three sound ones, and two with a fault.")
parser.add_argument("cells", nargs="?", type=int, default=24, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

n = options.cells
h = 1 / n
square = dp.Grid((n, n), size=1.0)
D = dp.divergence(square)
x, y = square.centres()
hot = np.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2) / 0.02)  # a hot spot

# %%
# Sound: implicit diffusion
# -------------------------
# A step of backward Euler solves :math:`(1 - \Delta t \, \nu \, \Delta) u' = u`. A mode with the eigenvalue
# :math:`-\lambda` is divided by :math:`1 + \Delta t \, \nu \lambda`, so it never grows, whatever the step and the
# viscosity. We say in which range :math:`\nu` may be, six decades of it; the cases go up to both ends.

spread = dp.elliptic_solver(D, dp.gradient(square, dp.dirichlet))


def heat(p):
    """Mean square after five steps of implicit diffusion."""
    step = lambda u, p: spread(p["dt"] * p["nu"], u, 1.0)
    return np.mean(dp.rollout(step, p["start"], p, 5) ** 2)


# %%
# Sound: pressure in a closed box
# -------------------------------
# With walls all around, a pressure is known up to a constant. `nullspace="project"` takes it out, of the right-hand
# side and of the solution.

neumann = D @ dp.gradient(square)
closed = dp.inverse(-neumann, nullspace="project")


def pressure(b):
    """Mean square of the pressure."""
    return np.mean(closed(b) ** 2)


# %%
# Sound: ink in a wind
# --------------------
# Upwind transport is explicit. It is stable while the wind crosses less than a cell in a step, and it refuses a longer
# one: an error is a good answer here.

carry = dp.transport(square)
swirl = dp.curl(square)(np.outer(np.hanning(n + 1), np.hanning(n + 1)))


def ink(p):
    """Return the mean squared difference between the ink after ten steps and a ramp."""
    step = lambda u, p: carry(u, p["wind"], p["dt"])
    return np.mean((dp.rollout(step, hot, p, 10) - x) ** 2)


# %%
# A fault: an explicit step that is too long
# ------------------------------------------
# Explicit diffusion multiplies a mode by :math:`1 - \Delta t \, \nu \lambda`. The largest eigenvalue in a plane is
# about :math:`8 / h^2`, so the step is stable for
#
# .. math:: \frac{\Delta t \, \nu}{h^2} \le \frac{1}{4} .
#
# Here the number is 0.6, and no check refuses it: the shortest waves change their sign and become 3.8
# times as large in a step. After 20 steps the loss is still a finite number.

L = dp.laplacian(square, dp.dirichlet)


def too_long(p):
    """Mean square after 20 steps of explicit diffusion."""
    step = lambda u, p: u + p["dt"] * p["nu"] * L(u)
    return np.mean(dp.rollout(step, p["start"], p, 20) ** 2)


# %%
# A fault: a null space that was left in
# --------------------------------------
# The pressure again, but the singular matrix is inverted as if it were regular. Rounding, here 1e-14 on the
# diagonal, makes it regular, and the inverse has a factor of 1e14 for constants. For a right-hand side without a mean
# the answer looks right.

almost = -neumann.matrix.toarray() + 1e-14 * np.diag(1 + np.arange(n * n) / n**2)
forgotten = dp.from_matrix(np.linalg.inv(almost), square.cells, square.cells, "pressure without projection")


def unprojected(b):
    """Mean square of the pressure, by the inverse of a singular matrix."""
    return np.mean(forgotten(b) ** 2)


# %%
# The verdicts
# ------------
# `ranges` says what is legal. Beyond it a refusal is right; within it a gap counts.

flat = hot - hot.mean()  # no mean: a closed box takes nothing else
results = {
    "implicit diffusion": dp.stress(heat, {"start": hot, "dt": 1e-2, "nu": 1.0}, ranges={"nu": (1e-3, 1e3)}),
    "pressure in a closed box": dp.stress(pressure, flat),
    "ink in a wind": dp.stress(ink, {"wind": swirl, "dt": 0.2 * h}, ranges={"dt": (0.01 * h, 0.3 * h)}),
    "explicit, number 0.6": dp.stress(too_long, {"start": hot, "dt": 0.6 * h**2, "nu": 1.0}),
    "null space left in": dp.stress(unprojected, flat),
}

for name, result in results.items():
    print(f"{name:26}{result.summary}")
    for row in result.failures[:2]:
        print(f"{'':26}  {row['case']}: {row['note']}")

# %%
# Where is a step stable?
# -----------------------
# For a loss with a rollout, a time step and a viscosity, `.map` holds how much the fastest mode grows in one step,
# around the values of the scene.

growth = results["explicit, number 0.6"].map
print("\ngrowth factor of an explicit step, dt (down) against nu (across)")
print(" " * 9, *(f"{nu:9.2g}" for nu in growth.viscosities))
for dt, factors in zip(growth.time_steps, growth.factors):
    print(f"{dt:9.2e}", *(f"{factor:9.3g}" for factor in factors))

# %%
# The picture
# -----------
# The same map for both schemes. The explicit one has an edge where :math:`\Delta t \, \nu` is a quarter of :math:`h^2`;
# the implicit one has none.
#
# Exercises
# ---------
# 1. Print a whole result, ``print(results["ink in a wind"])``. Which cases were refused, and with what words?
# 2. Make the explicit step stable: ``0.2 * h**2``. Which failures remain?
# 3. Project in the last scene, ``forgotten(b - np.mean(b))``. Which failures go away, and which stay?

if options.out:
    from matplotlib import pyplot

    picture, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    results["explicit, number 0.6"].plot(left)
    left.set_title("explicit diffusion: growth in a step")
    results["implicit diffusion"].plot(right)
    right.set_title("implicit diffusion: growth in a step")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "stiff_and_extreme.png", dpi=120)
