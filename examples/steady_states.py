r"""
Steady states without a loop over time
======================================

A cavity and a convection as roots of equations, with gradients in Reynolds and Rayleigh number.

The examples `cavity.py` and `convection.py` run until nothing changes any more. Here the steady flow is what it is: the
solution of equations without time. Newton's method finds it in a few steps, for Reynolds numbers too at which a loop
over time takes long. And its derivative in a parameter costs one linear solve, however the flow was found.

Run it: ``python examples/steady_states.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Cavity and convection as roots of equations.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# What is known
# -------------
# The least :math:`u` on the line :math:`x = 1/2` of the cavity: O. Botella, R. Peyret, Computers and Fluids 27 (1998)
# for 100 and 1000, and U. Ghia, K. N. Ghia, C. T. Shin, J. Comput. Phys. 48 (1982) for 400, who also list points of the
# whole line (below at Re 1000). The heat flow of the convection: G. de Vahl Davis, Int. J. Numer. Methods Fluids 3
# (1983).

MIN_U = {100: -0.21404, 400: -0.32726, 1000: -0.38857}
Y = [0.9766, 0.9531, 0.8516, 0.7344, 0.6172, 0.5, 0.4531, 0.2813, 0.1719, 0.1016, 0.0625]
GHIA = [0.65928, 0.46604, 0.33304, 0.18719, 0.05702, -0.0608, -0.10648, -0.27805, -0.38289, -0.2973, -0.20196]
NUSSELT = {1e4: 2.243, 1e5: 4.519}

# %%
# A steady flow
# -------------
# Velocity :math:`v` and pressure :math:`p` are found together, from
#
# .. math:: f - \nabla \cdot (v \otimes v) - \nabla p = 0, \qquad \nabla \cdot v = 0,
#
# where :math:`f` is viscosity and whatever else drives the flow. There have to be as many equations as unknowns:
#
# * On the walls stands :math:`v = 0` instead of the first equation; `inside` is the mask of all other faces.
# * The pressure is known up to a constant. So one cell gets :math:`p = 0` on top of :math:`\nabla \cdot v = 0`. What
#   flows out of all cells together is zero anyway, and that leaves :math:`p = 0` in this cell.

n = options.cells
grid = dp.Grid((n, n), size=1.0)
D = dp.divergence(grid)
G = dp.gradient(grid)
L = dp.face_laplacian(grid)
convect = dp.convection(grid)
inside = dp.interior(grid)

pin = np.zeros((n, n))
pin[0, 0] = 1.0


def flow(v, p, force):
    """Return the residuals of the momentum equation and of conservation of mass."""
    momentum = force - convect(v, v) - G(p)
    on_walls = v - inside(v)
    return {"v": inside(momentum) + on_walls, "p": D(v) + pin * p}


# %%
# The cavity
# ----------
# The lid moves with speed 1 along a box of side 1, so viscosity is :math:`1 / Re`. What the moving wall adds to the
# Laplacian is a constant.

lid = dp.face_lift(grid)
moving = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0))  # the upper wall in y, along x


def cavity(x, reynolds):
    """Equations of the lid-driven cavity."""
    return flow(x["v"], x["p"], (L(x["v"]) + moving) / reynolds)


def least_u(x):
    """Least u on the line x = 1/2."""
    u, _ = grid.split(x["v"])
    return np.min(u[n // 2])


# %%
# Newton's method needs a start that is not too far away: that is the flow at the Reynolds number before. Where it is
# too far all the same, `dp.steady` goes a part of the way in steps of a pseudo-time.

rest = {"v": np.zeros(grid.faces.size), "p": np.zeros((n, n))}
x = rest
for reynolds, known in MIN_U.items():
    x = dp.steady(cavity, x, float(reynolds))
    print(f"Re {reynolds:6}   min u {least_u(x):8.5f}, known {known:8.5f}")

# %%
# The derivative of a root
# ------------------------
# Let :math:`R(x, p) = 0` be the equations. When :math:`p` moves, :math:`x` follows: :math:`R_x \, dx + R_p \, dp = 0`.
# So for a number :math:`J(x)`,
#
# .. math:: \frac{dJ}{dp} = - \lambda^T R_p \quad \text{with} \quad R_x^T \lambda = \frac{\partial J}{\partial x}^T .
#
# That is one linear solve with the transposed Jacobian. Newton's steps do not occur in it.

change = dp.grad(lambda re: least_u(dp.steady(cavity, x, re)))(1000.0)
print(f"at Re 1000 min u changes by {1000 * change:.4f} for each unit of log Re")

# %%
# Convection
# ----------
# A box with a warm wall at :math:`x = 0` and a cold one at :math:`x = 1`; the other two let no heat through. Fluid
# rises along the one and sinks along the other. With the width as unit of length, and the time in which heat crosses
# it,
#
# .. math:: f = Pr \, \Delta v + Ra \, Pr \, T \, e_y, \qquad \nabla \cdot (v \, T - \nabla T) = 0 .
#
# The Prandtl number of air is 0.71. The Nusselt number is the heat that flows from wall to wall, beside that of a fluid
# at rest, for which it is 1.

PRANDTL = 0.71
heated = {"x": dp.dirichlet}  # the values stand in `warm`
slope = dp.gradient(grid, heated)
lift = dp.lift(grid, heated)
warm = lift(lift.domain.join(1.0, 0.0, 0.0, 0.0))
mean = dp.average(grid)
up = grid.join(0.0, 1.0)


def heat_flow(x):
    """Heat through each face and unit of its area: what v carries, less what is conducted down the slope."""
    return x["v"] * mean(x["T"]) - (slope(x["T"]) + warm)


def convection(x, rayleigh):
    """Equations of natural convection."""
    buoyancy = rayleigh * PRANDTL * up * mean(x["T"])
    equations = flow(x["v"], x["p"], PRANDTL * L(x["v"]) + buoyancy)
    equations["T"] = -D(heat_flow(x))
    return equations


def nusselt(x):
    """Mean heat flow along x, on the faces inside."""
    along_x, _ = grid.split(heat_flow(x))
    return np.mean(along_x[1:-1])


# %%
# How fast does the heat flow grow with the Rayleigh number? The two published figures say :math:`\log (4.519 / 2.243) /
# \log 10 = 0.304` on the way from one to the other. The derivative says it at each of them.

air = rest | {"T": 1 - grid.centres()[0]}
for rayleigh, known in NUSSELT.items():
    air = dp.steady(convection, air, rayleigh)
    heat, change = dp.value_and_grad(lambda ra, air=air: nusselt(dp.steady(convection, air, ra)))(rayleigh)
    power = change * rayleigh / heat
    print(f"Ra {rayleigh:6.0e}   Nu {heat:7.4f}, known {known:6.3f}   d log Nu / d log Ra {power:.4f}")

# %%
# The picture
# -----------
# The cavity at Re 1000, :math:`u` on its middle line beside Ghia's points, and the isotherms of convection. At Re 1000
# the layers along the walls are a few hundredths wide. On 24 x 24 cells they are as thin as a cell, and :math:`u` is
# off; the scheme is of second order, and 128 x 128 come close to what is published.
#
# Exercises
# ---------
# 1. Leave the pin away. Which error do you get, and what does it say?
# 2. Go on to Ra 1e6, where 8.800 is published. How many cells does it take to come as near as at 1e5? The layers along
#    the walls get thinner.
# 3. At which Rayleigh number is Nu = 3? Three steps of Newton's method with the derivative above tell it.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(14, 3.9), layout="constrained")
    dp.plot(grid, x["v"], ax=left, title="the cavity at Re 1000", label="speed")
    u, _ = grid.split(x["v"])
    middle.plot(u[n // 2], grid.coordinates(1), label=f"{n}^2 cells")
    middle.plot(GHIA, Y, "o", label="Ghia, Ghia, Shin")
    middle.set(title="u on x = 1/2, Re 1000", xlabel="u", ylabel="y")
    middle.legend(frameon=False)
    title = f"convection, Ra 1e5: Nu {heat:.3f}, published {known}"
    dp.plot(grid, air["T"], ax=right, title=title, label="temperature", cmap="inferno")
    right.contour(*grid.centres(), air["T"], np.linspace(0.1, 0.9, 9), colors="white")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "steady_states.png", dpi=120)
