r"""
Dry ground and near vacuum
==========================

A dam that breaks onto dry ground, a lake with an island, water in a bowl, and a gas torn apart, beside exact solutions;
two blast waves beside a fine grid.

Depth, density and pressure must not become negative. Where water runs onto dry ground or a gas is nearly a vacuum, a
scheme of second order makes them negative unless it limits its slopes. ``dp.shallow_water`` does so for the depth, and
``positive=`` of ``dp.conservation_law`` for any quantity that the user names.

Run it: ``python examples/dry_ground.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Water on dry ground and gas near a vacuum, beside exact solutions.")
parser.add_argument("cells", nargs="?", type=int, default=200)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

n = options.cells
g = 9.81


def run(law, start, end, faster, params=None):
    """Return the state at the time `end`; waves become `faster` times as fast as those of the start."""
    steps = int(np.ceil(faster * end / law.time_step(start, params, cfl=0.45)))
    return dp.rollout(dp.stepper("ssprk3", law, end / steps), start, params, steps)


# %%
# A dam on dry ground
# -------------------
# The state holds the depth and the discharge. At the time :math:`t` after the dam broke at :math:`x = 0`, the depth
# between :math:`x = -c t` and :math:`x = 2 c t` is
#
# .. math:: h = \frac{(2 c - x / t)^2}{9 g}, \quad c = \sqrt{g} .
#
# The front runs with :math:`2 c`, twice as fast as the waves of the start: steps are half of what is stable first.

line = dp.Grid(n, size=2.0, origin=-1.0)
(x,) = line.centres()
dam = np.stack([np.where(x < 0, 1.0, 0.0), 0 * x])
flood = run(dp.shallow_water(line), dam, 0.15, 2.0)
c = np.sqrt(g)
ritter = (2 * c - np.clip(x / 0.15, -c, 2 * c)) ** 2 / (9 * g)

print(f"dam on dry ground, {n} cells: mean error of the depth {np.mean(np.abs(flood[0] - ritter)):.5f}")
print(f"least depth {abs(np.min(flood[0])):.0e}, water lost {abs(np.mean(flood[0]) - 0.5):.0e}")

# %%
# A lake with an island
# ---------------------
# The ground rises above the surface. The push of the water and its weight on the slope balance in each cell, and a dry
# cell beside a wet one changes nothing.

island = 1.2 * np.exp(-8 * x**2)
lake = np.stack([np.maximum(0.7 - island, 0.0), 0 * x])
still = dp.shallow_water(line, island, boundary=dp.free_slip)
moved = np.max(np.abs(run(still, lake, 1.0, 1.0) - lake))
print(f"lake with an island, {np.mean(lake[0] == 0):.0%} dry: moved by {moved:.0e} in 1 s")

# %%
# Water in a bowl
# ---------------
# On the ground :math:`z = (x^2 - 1) / 2` a plane surface stays plane (W. C. Thacker, J. Fluid Mech. 107, 1981). The
# water swings from side to side with the period :math:`2 \pi / \sqrt{g}`, and so do its two shore lines.

wide = dp.Grid(n, size=4.0, origin=-2.0)
(r,) = wide.centres()
bowl = 0.5 * (r**2 - 1.0)


def swinging(phase):
    """The exact depth, where the phase goes from 0 to 2 pi in a period."""
    surface = 0.5 * (r * np.cos(phase) - 0.25 * np.cos(phase) ** 2)
    return np.maximum(surface - bowl, 0.0)


basin = dp.shallow_water(wide, bowl, gravity=lambda g: g)
water = np.stack([swinging(0.0), 0 * r])
half = run(basin, water, np.pi / np.sqrt(g), 2.0, g)[0]
print(f"bowl, half a period: mean error of the depth {np.mean(np.abs(half - swinging(np.pi))):.5f}")

# %%
# Which gravity?
# --------------
# On another planet the same water took the time of half a period here to go from one side to a place on the way. Its
# gravity follows from the depths at that time, by the gradient through all steps and both shore lines.

steps = int(np.ceil(2.0 * 0.6 / basin.time_step(water, g, cfl=0.45)))
swing = dp.stepper("ssprk3", basin, 0.6 / steps)
seen = dp.rollout(swing, water, 5.0, steps)[0]


def loss(gravity):
    """Return the mean squared difference from the depths that were seen."""
    return np.mean((dp.rollout(swing, water, gravity, steps)[0] - seen) ** 2)


best = dp.minimize(loss, np.array(6.0), maxiter=20)
print(f"gravity: {best.x:.4f} (right: 5), from 6 in {len(best.history)} evaluations")

# %%
# A gas that is torn apart
# ------------------------
# Both halves of a gas move apart, and nearly a vacuum remains between them (B. Einfeldt and others, J. Comput. Phys.
# 92, 1991). Without ``positive`` the pressure becomes negative within a few steps.

gamma = 1.4
tube = dp.Grid(n, size=1.0)
(s,) = tube.centres()


def pressure(u, params=None):
    """Pressure of the gas."""
    return (gamma - 1) * (u[2] - 0.5 * u[1] ** 2 / u[0])


def flux(u, params, axis):
    """Flux of density, momentum and energy."""
    v = u[1] / u[0]
    p = pressure(u)
    return np.stack([u[1], u[1] * v + p, v * (u[2] + p)])


def speeds(u, params, axis):
    """The slowest and the fastest wave."""
    v = u[1] / u[0]
    sound = np.sqrt(gamma * pressure(u) / u[0])
    return v - sound, v + sound


positive = {"density": lambda u, params: u[0], "pressure": pressure}
gas = dp.conservation_law(tube, flux, speeds, positive=positive)
torn = np.stack([1 + 0 * s, np.where(s < 0.5, -2.0, 2.0), 3.0 + 0 * s])
thin = run(gas, torn, 0.15, 1.1)

sound = np.sqrt(gamma * 0.4)
in_fan = (2 * sound + (gamma - 1) * (np.abs(s - 0.5) / 0.15 - 2.0)) / (gamma + 1)
exact = (np.clip(in_fan, sound - (gamma - 1), sound) / sound) ** (2 / (gamma - 1))
print(f"gas torn apart: mean error of the density {np.mean(np.abs(thin[0] - exact)):.4f}")

try:
    with np.errstate(invalid="ignore"):
        run(dp.conservation_law(tube, flux, speeds), torn, 0.15, 1.1)
except dp.errors.NonFiniteError as error:
    print("without positive:", str(error).split(",")[0])

# %%
# Two blast waves
# ---------------
# Pressures of 1000, 0.01 and 100 stand side by side between walls. Two shocks run inwards, meet, and press the gas to
# 6.4 times its density (P. Woodward, P. Colella, J. Comput. Phys. 54, 1984). There is no exact solution: the reference
# has four times the cells.


def blast(cells):
    """Return the density at 0.038 s."""
    grid = dp.Grid(cells, size=1.0)
    (y,) = grid.centres()
    law = dp.conservation_law(grid, flux, speeds, positive=positive, boundary=dp.free_slip, momentum=1)
    p = np.select([y < 0.1, y < 0.9], [1000.0, 0.01], 100.0)
    start = np.stack([1 + 0 * y, 0 * y, p / (gamma - 1)])
    return run(law, start, 0.038, 1.3)[0]


coarse = blast(n)
fine = blast(4 * n)
print(f"blast waves: largest density {np.max(coarse):.2f} with {n} cells, {np.max(fine):.2f} with {4 * n} (6.4)")

# %%
# The picture
# -----------
# The four fields beside the exact solutions and the fine grid. In the gas the density is too low where it was torn
# apart, and blast waves need many cells: the jump of the density between the two shocks smears over several of them.
#
# Exercises
# ---------
# 1. Take ``scheme="upwind"`` for the bowl. How much of the swing is left after five periods?
# 2. Take steps that are twice as long. What does the error say, and where is the cell that it names?
# 3. Let rain fall on the island: ``source=lambda u, params: ...``. Where does the water go?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, places = pyplot.subplots(2, 2, figsize=(9, 6), layout="constrained")
    panels = [
        ("dam on dry ground: depth", x, flood[0], x, ritter, "exact"),
        ("bowl, half a period: surface", r, half + bowl, r, swinging(np.pi) + bowl, "exact"),
        ("gas torn apart: density", s, thin[0], s, exact, "exact"),
        ("blast waves: density", s, coarse, dp.Grid(4 * n, size=1.0).centres()[0], fine, f"{4 * n} cells"),
    ]
    for ax, (title, at, values, where, wanted, label) in zip(places.flat, panels):
        ax.plot(where, wanted, color="black", linewidth=1, label=label)
        ax.plot(at, values, ".", markersize=3, label="computed")
        ax.set(title=title, xlabel="x")
        ax.legend(frameon=False)
    places[0, 1].fill_between(r, bowl, np.min(bowl), color="0.85", linewidth=0)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "dry_ground.png", dpi=120)
