"""Sod's tube, a dam break, a pressure found by sound. Run: python examples/conservation_laws.py [cells] [--out FOLDER]

du/dt + div F(u) = 0. A law is its flux and the speed of its waves; slopes, shocks, walls and gradients come with it.
"""

import sys
from pathlib import Path

import autograd.numpy as np
from scipy.optimize import brentq

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 400
gamma, g = 1.4, 9.81
grid = dp.Grid(n, size=1.0)
(x,) = grid.centres()


# ---- a gas: density, momentum, energy --------------------------------------------------------------------------------


def pressure(u):
    return (gamma - 1) * (u[2] - 0.5 * u[1] ** 2 / u[0])


def gas_flux(u, params, axis):
    v, p = u[1] / u[0], pressure(u)
    return np.stack([u[1], u[1] * v + p, v * (u[2] + p)])


def gas_speeds(u, params, axis):
    v, c = u[1] / u[0], np.sqrt(gamma * pressure(u) / u[0])
    return v - c, v + c  # the slowest and the fastest wave


def tube(left):
    """Gas at rest: pressure `left` on the left of a membrane in the middle, 0.1 on its right."""
    p = left * (x < 0.5) + 0.1 * (x >= 0.5)
    return np.stack([np.where(x < 0.5, 1.0, 0.125), 0 * x, p / (gamma - 1)])


gas = dp.conservation_law(grid, gas_flux, gas_speeds)
steps = int(np.ceil(0.2 / (0.45 * gas.time_step(tube(1.0)))))
burst = dp.stepper("ssprk3", gas, 0.2 / steps)

# ---- water: depth and momentum ---------------------------------------------------------------------------------------


def water_flux(u, params, axis):
    return np.stack([u[1], u[1] ** 2 / u[0] + 0.5 * g * u[0] ** 2])


def water_speeds(u, params, axis):
    v, c = u[1] / u[0], np.sqrt(g * u[0])
    return v - c, v + c


water = dp.conservation_law(grid, water_flux, water_speeds, boundary=dp.free_slip, momentum=1)
dam = np.stack([np.where(x < 0.5, 1.0, 0.2), 0 * x])
rush = dp.stepper("ssprk3", water, 0.1 / steps)

# ---- the exact solutions: a fan, what is between the waves, a shock --------------------------------------------------


def exact_gas(s):
    """Density along s = (x - 0.5) / t (Sod, J. Comput. Phys. 27, 1978)."""
    cl, cr, m = gamma**0.5, (gamma * 0.1 / 0.125) ** 0.5, (gamma - 1) / (gamma + 1)
    shock = lambda p: (p - 0.1) * np.sqrt(2 / ((gamma + 1) * 0.125) / (p + m * 0.1))
    fan = lambda p: 2 * cl / (gamma - 1) * (1 - p ** ((gamma - 1) / 2 / gamma))
    p = brentq(lambda p: fan(p) - shock(p), 0.1, 1.0)
    v, front = shock(p), cr * np.sqrt((gamma + 1) / 2 / gamma * p / 0.1 + (gamma - 1) / 2 / gamma)
    inner = cl * p ** ((gamma - 1) / 2 / gamma)
    rho = np.maximum(2 / (gamma + 1) - m / cl * s, 0.0) ** (2 / (gamma - 1))
    behind = 0.125 * (p / 0.1 + m) / (m * p / 0.1 + 1)
    return np.select([s < -cl, s < v - inner, s < v, s < front], [1.0, rho, p ** (1 / gamma), behind], 0.125)


def exact_water(s):
    """Depth along s (Stoker, Water Waves, 1957)."""
    c = np.sqrt(g)
    shock = lambda h: (h - 0.2) * np.sqrt(g * (h + 0.2) / (0.4 * h))
    h = brentq(lambda h: 2 * (c - np.sqrt(g * h)) - shock(h), 0.2, 1.0)
    v = shock(h)
    fan = (2 * c - s) ** 2 / 9 / g
    return np.select([s < -c, s < v - np.sqrt(g * h), s < h * v / (h - 0.2)], [1.0, fan, h], 0.2)


density = dp.rollout(burst, tube(1.0), None, steps)[0]
depth = dp.rollout(rush, dam, None, steps)[0]
right = exact_gas((x - 0.5) / 0.2), exact_water((x - 0.5) / 0.1)
print(f"Sod's tube, {n} cells, {steps} steps: mean error of the density {np.mean(np.abs(density - right[0])):.5f}")
print(f"dam break: mean error of the depth {np.mean(np.abs(depth - right[1])):.5f}, water lost "
      f"{abs(np.sum(depth - dam[0])) / np.sum(dam[0]):.0e}")  # fmt: skip

# ---- which pressure was on the left? A sensor near the right end heard the shock arrive ------------------------------


def heard(left):
    """Density at the sensor, summed over the steps."""
    sound = dp.rollout(burst, tube(left), None, steps, keep=lambda index, u: u[0][int(0.75 * n)])
    return sum(sound) / steps


signal = heard(1.0)


def loss(left):
    return (heard(left) / signal - 1) ** 2


start = np.array(0.8)
print(
    "gradient against finite differences:",
    dp.check.gradient(loss, start).verdict,
    "(limiters have kinks in gas at rest)",
)
best = dp.minimize(loss, start, maxiter=20)
print(f"pressure on the left: {best.x:.6f} (right: 1), from {float(start)} in {len(best.history)} evaluations")

if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(9, 3.5), layout="constrained")
    for axes, values, exact, name in zip(
        picture.subplots(1, 2), (density, depth), right, ("density, t = 0.2", "depth, t = 0.1")
    ):
        axes.plot(x, exact, "k-", lw=1, label="exact")
        axes.plot(x, values, ".", ms=3, label="computed")
        axes.set(xlabel="x", title=name)
        axes.legend()
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "conservation_laws.png", dpi=120)
