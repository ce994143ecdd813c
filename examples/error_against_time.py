r"""
Which scheme and solver for a given error?
==========================================

Burgers and Poisson: errors of values and gradients against run time.

"Faster" means nothing without an error, and "more exact" nothing without a time. The question is which method reaches
an error of one percent first, and whether the same method is the fastest for the gradient. So every method is run on
several grids, and error is drawn against time: once for an equation in time with three schemes, once for a linear
system with five solvers.

Run it: ``python examples/error_against_time.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Errors of values and gradients against run time: Burgers and Poisson.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis of Poisson's finest grid")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# A question to Burgers' equation
# -------------------------------
# On :math:`(-1, 1)`, from a sine,
#
# .. math:: u_t + \left( \tfrac{1}{2} u^2 \right)_x = \nu \, u_{xx}, \qquad u(x, 0) = -p_0 \, \sin \pi (x + p_1) .
#
# At :math:`t = 0.5` a front has formed. We look at three places, and ask for the sum of the squares there, with its
# slopes in the amplitude :math:`p_0` and the phase :math:`p_1`.
#
# The exact answer needs no grid. Cole and Hopf found that Burgers' equation is the heat equation in disguise, and that
# :math:`u` is a mean of its values at the start,
#
# .. math:: u(x, t) = \frac{\int u_0(y) \, w(y) \, dy}{\int w(y) \, dy}, \qquad
#           w(y) = \exp \left( -\frac{1}{2 \nu} \int_0^y u_0 - \frac{(x - y)^2}{4 \nu t} \right) .
#
# It is written with `autograd.numpy`, so that it has exact slopes, too.

NU = 0.01 / np.pi
T = 0.5
PLACES = np.array([-0.75, -0.5, -0.25])
START = np.array([1.0, 0.0])  # amplitude and phase


def exact(p):
    """The sum of squares at the three places, by the formula of Cole and Hopf."""
    y = np.linspace(-2, 2, 8001)
    x = PLACES[:, None] + p[1]  # moving the sine by p_1 to the left is looking p_1 further right
    u0 = -p[0] * np.sin(np.pi * y)
    exponent = -p[0] * np.cos(np.pi * y) / (2 * np.pi * NU) - (x - y) ** 2 / (4 * NU * T)
    w = np.exp(exponent - np.max(exponent, axis=1, keepdims=True))  # a factor that cancels
    u = np.sum(u0 * w, axis=1) / np.sum(w, axis=1)
    return np.sum(u**2)


# %%
# Three schemes
# -------------
# ``order 1`` is the upwind flux with steps of Euler: on a face with the velocity :math:`u` it is the central flux with
# a diffusion of :math:`|u| \, h / 2` too much. ``order 2`` has the central flux and steps of Heun. ``exponential`` has
# the central flux, too, but takes diffusion exactly, by transforms, and so its steps need not be as short as
# :math:`h^2 / (2 \nu)`.
#
# Each scheme takes the longest step that is stable, less a tenth: with a step of its own choice each shows what it can
# do. Stable are, for :math:`|u| \le 1`, the first with :math:`\Delta t \le h^2 / (2 \nu + h)`, the second with
# :math:`\Delta t \le h^2 / (2 \nu)` and about :math:`h / 2`, the third with about :math:`2 h`.
#
# What `dp.work_precision` takes is a function from settings to a loss, a point, and what else a row should say.


def burgers(scheme, cells):
    """Return, for a scheme and a grid, the loss, the point of evaluation, and entries for the table."""
    line = dp.Grid(cells, size=2.0, origin=-1.0, periodic=True)  # at p_1 = 0, u is odd: 0 at both ends
    (x,) = line.centres()
    h = 2 / cells
    G, D, A = dp.gradient(line), dp.divergence(line), dp.average(line)
    at_places = dp.sample(line, PLACES[:, None])

    def convect(u, p):
        """Return the rate of change by convection."""
        return -D(A(u) ** 2 / 2)

    def rate(u, p):
        """Return the rate of change, with central fluxes."""
        return convect(u, p) + D(NU * G(u))

    def upwind_rate(u, p):
        """Return the rate of change, with upwind fluxes."""
        return convect(u, p) + D((NU + np.abs(A(u)) * h / 2) * G(u))

    longest = {
        "order 1": h**2 / (2 * NU + h),
        "order 2": min(h**2 / (2 * NU), h / 2),
        "exponential": 2 * h,
    }
    steps = int(np.ceil(1.1 * T / longest[scheme]))
    dt = T / steps
    if scheme == "order 1":
        step = dp.stepper("euler", upwind_rate, dt)
    elif scheme == "order 2":
        step = dp.stepper("heun", rate, dt)
    else:
        step = dp.stepper("etdrk4", convect, dt, linear=(D @ G, NU))

    def loss(p):
        """The sum of squares at the three places."""
        u = dp.rollout(step, -p[0] * np.sin(np.pi * (x + p[1])), p, steps)
        return np.sum(at_places(u) ** 2)

    return loss, START, {"steps": steps, "unknowns": cells}


# %%
# A question to Poisson's equation
# --------------------------------
# A membrane under an even load :math:`s`: the height in its middle, and its slope in the load. As the height grows in
# proportion to the load, value and slope are the same number, and it is known.
#
# Here the grid makes the error, not the solver, as long as the solver is exact enough. How exact is that? The two rows
# of *krylov* stop at 1e-3 and at 1e-10.

MIDDLE = 0.07367135328151


def poisson(cells, method, rtol=1e-10):
    """Return, for a solver and a grid, the loss, the point of evaluation, and entries for the table."""
    grid = dp.Grid((cells, cells), size=1.0)
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet), method, rtol=rtol)
    middle = dp.sample(grid, [[0.5, 0.5]])

    def height(s):
        """Height of the membrane in the middle."""
        return middle(solve(s * np.ones(grid.shape)))[0]

    return height, 1.0, {"unknowns": cells**2, "tolerance": rtol}


# %%
# Two tables
# ----------
# Every run is repeated until its time has settled, and compiling is no part of it. A star marks the Pareto set: no
# other row is both faster and more exact.

n = options.cells
schemes = {name: {"scheme": name} for name in ("order 1", "order 2", "exponential")}
solvers = {name: {"method": name} for name in ("separable", "direct", "multigrid")}
for rtol in (1e-3, 1e-10):
    solvers[f"krylov {rtol:g}"] = {"method": "krylov", "rtol": rtol}

tables = [
    dp.work_precision(burgers, schemes, {"cells": [4 * n, 8 * n, 16 * n]}, reference=dp.value_and_grad(exact)(START)),
    dp.work_precision(poisson, solvers, {"cells": [n // 4, n // 2, n]}, reference=(MIDDLE, MIDDLE)),
]
for table in tables:
    best = table.best(1e-2)
    print(f"{table}\nfastest at an error of 1 %: {best['method'] if best else 'none'}\n")

# %%
# The picture
# -----------
# Down and to the left is better. A steeper curve belongs to a scheme of higher order: it wins in the end, but where a
# rough answer will do, the simplest may be the fastest. ``table.save("folder")`` writes a table with its picture, as
# Markdown and CSV.
#
# Exercises
# ---------
# 1. Look at the error of the value, `table.plot(ax, "forward_error")`. Is the order of the schemes the same as for the
#    gradient?
# 2. Look closer at the front: `PLACES = np.array([-0.04, -0.02, -0.01])`. Which scheme suffers most, and how many cells
#    are in the front?
# 3. Add ``structured`` to the solvers, and grids of up to 512 cells an axis. From which size on is ``multigrid`` faster
#    than ``direct``?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, places = pyplot.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    for ax, table in zip(places, tables):
        table.plot(ax)
        ax.tick_params(which="both", labelsize=7)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "error_against_time.png", dpi=120)
