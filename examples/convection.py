r"""
Natural convection
==================

Between a hot and a cold wall, against published heat flow and velocities.

A square box is hot on its left and cold on its right; its floor and its ceiling are insulated. Warm air rises along the
hot wall, flows across, and sinks along the cold one. How much more heat passes than in air at rest? It is the flow on
which solvers with heat are tried first. Its figures are known from G. de Vahl Davis, Int. J. Numer. Methods Fluids 3
(1983).

Run it: ``python examples/convection.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Natural convection in a square cavity, Pr 0.71, Ra 1e4.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis of the finer grid")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

PRANDTL = 0.71
RAYLEIGH = 1e4
KNOWN = 2.243, 16.178, 19.617  # Nusselt number; max u on x = 1/2; max v on y = 1/2
PLACES = 0.823, 0.119  # y of the first maximum, x of the second

# %%
# The equations
# -------------
# Lengths are in units of the box, temperatures in units of the difference between the walls, and times such that the
# diffusivity of heat is 1. The temperature :math:`T` is carried and conducted; the velocity :math:`v` carries itself,
# is slowed by viscosity, and pushed up where it is warm:
#
# .. math:: T_t + v \cdot \nabla T = \Delta T, \qquad
#           v_t + v \cdot \nabla v = \mathrm{Pr} \, \Delta v - \nabla p + \mathrm{Ra} \, \mathrm{Pr} \, T \, e_y,
#           \qquad \nabla \cdot v = 0 .
#
# The Prandtl number Pr compares viscosity with conduction, it is 0.71 in air. The Rayleigh number Ra says how hard
# heat drives the flow. It is the parameter of the step: a derivative in it is one call away.
#
# Where Boussinesq's equations have :math:`T` less a mean, ours has :math:`T` itself: a force that is the same
# everywhere is taken up by the pressure.


class Box:
    """The box on a grid of n cells along each axis: one step of flow and heat, and the heat flux."""

    def __init__(self, n):
        self.grid = dp.Grid((n, n), size=1.0)
        sides = {"x": dp.dirichlet}  # y is not named: insulated
        self.gradient = dp.gradient(self.grid, sides)
        self.to_faces = dp.average(self.grid, sides)
        self.up = self.grid.join(0.0, PRANDTL)

        lift = dp.lift(self.grid, sides)
        walls = lift.domain.join(1.0, 0.0, 0.0, 0.0)  # temperatures: hot, cold; no flux through floor and ceiling
        self.from_walls = lift(walls)

        heat = {"diffusivity": 1.0, "boundary": sides, "values": walls}
        dt = 0.01 / n
        self.step = dp.flow_step(self.grid, dt, PRANDTL, self.buoyancy, implicit=True, scalars={"heat": heat})

    def buoyancy(self, v, scalars, rayleigh):
        """Return the buoyancy force on the faces across y."""
        return rayleigh * self.up * self.to_faces(scalars["heat"])

    def start(self):
        """Return the initial state: air at rest, with T linear between the walls."""
        x, _ = self.grid.centres()
        return self.step.start(np.zeros(self.grid.faces.size), RAYLEIGH, {"heat": 1 - x})

    def nusselt(self, state):
        """Return the heat flux, relative to that of air at rest."""
        T, v = state["s"]["heat"], state["v"]
        flux = v * self.to_faces(T) - self.gradient(T) - self.from_walls
        across, _ = self.grid.split(flux)
        return np.mean(across[1:-1])


# %%
# The heat that passes
# --------------------
# Through a plane :math:`x = \text{const}` heat is carried and conducted,
#
# .. math:: \mathrm{Nu} = \int_0^1 \left( u \, T - \frac{\partial T}{\partial x} \right) dy .
#
# When the flow is steady, all planes say the same, since no heat is left anywhere. At rest :math:`T = 1 - x`, and the
# Nusselt number is 1. We take the mean over all planes between the walls.
#
# Viscosity and conduction are implicit, so that the step is limited by the velocity alone. We run 20 steps at a time,
# until the Nusselt number changes by less than 0.01 in a unit of time.


def steady(box):
    """Return the steady state, its Nusselt number and the number of time steps."""
    state, steps = box.start(), 0
    now, before = box.nusselt(state), 0.0
    while abs(now - before) > 1e-2 * 20 * box.step.dt:
        state = dp.rollout(box.step, state, RAYLEIGH, 20)
        now, before = box.nusselt(state), now
        steps += 20
    return state, now, steps


def centre_lines(grid, v):
    """u on the vertical line through the middle, and v on the horizontal one."""
    u, w = grid.split(v)
    return u[grid.shape[0] // 2], w[:, grid.shape[1] // 2]


# %%
# Beside the published figures
# ----------------------------

print("cells  Nusselt   max u   max v  steps  seconds")
for n in (options.cells // 2, options.cells):
    clock = perf_counter()
    box = Box(n)
    state, heat_flow, steps = steady(box)
    u, w = centre_lines(box.grid, state["v"])
    figures = f"{heat_flow:7.4f}  {np.max(u):6.3f}  {np.max(w):6.3f}"
    print(f"{n:4}^2  {figures}  {steps:5}  {perf_counter() - clock:7.1f}")
print(f" known  {KNOWN[0]:7.4f}  {KNOWN[1]:6.3f}  {KNOWN[2]:6.3f}")

# %%
# The picture
# -----------
# Isotherms: close together where heat enters and leaves, and nearly level in the middle, where warm air lies on cold.
# Right: the velocities on both lines through the middle, beside the published maxima.
#
# Exercises
# ---------
# 1. How does the Nusselt number grow with the Rayleigh number? Ask for its derivative: `dp.grad` of the Nusselt number
#    after the last 20 steps, and after 500. Why do they differ? The example `steady_states.py` has the answer without a
#    loop over time.
# 2. Heat the floor instead, and cool the ceiling. At Ra 1e4 the air at rest is unstable, at Ra 1e3 it is not: which
#    start shows it?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    T = state["s"]["heat"]
    title = f"isotherms, Ra 1e4: Nu {heat_flow:.3f}, published {KNOWN[0]}"
    dp.plot(box.grid, T, ax=left, title=title, cmap="inferno", label="temperature")
    left.contour(*box.grid.centres(), T, np.linspace(0.1, 0.9, 9), colors="white")
    places = (np.arange(options.cells) + 0.5) / options.cells
    right.plot(places, u, label="u on x = 1/2, over y")
    right.plot(places, w, "--", label="v on y = 1/2, over x")
    right.plot(PLACES, KNOWN[1:], "ko", label="published maxima")
    right.set(title="velocities on the centre lines", xlabel="x or y", ylabel="velocity", ylim=(-23, 36))
    right.legend(frameon=False, loc="upper center")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "convection.png", dpi=120)
