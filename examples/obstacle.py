"""What flows in, from sensors behind a cylinder. Run: python examples/obstacle.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 24
grid = dp.Grid((3 * n, n), size=(3.0, 1.0))
x, y = grid.centres()
cylinder = (x - 0.7) ** 2 + (y - 0.45) ** 2 < 0.15**2
across = grid.coordinates(1)

# The wind enters at x = 0 with an unknown profile and leaves at x = 3; it sticks to the walls and to the cylinder.
sides = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}
dt, steps = 0.15 / n, 7 * n  # the wind is three times as fast beside the cylinder as on the average
step = dp.flow_step(grid, dt, viscosity=0.005, boundary=sides, solid=cylinder)
columns = [int(place * n) for place in (1.3, 2.0, 2.7)]  # sensors read u there


def start(profile):
    """The profile all along the channel, made incompressible: it flows around the cylinder."""
    return step.start(grid.join(profile, 0.0))


def readings(profile):
    """What the sensors say at the end of every fourth part of the time."""
    state, found = start(profile), []
    for _ in range(4):
        state = dp.rollout(step, state, None, steps // 4)
        u = grid.split(state["v"])[0]
        found.append(np.concatenate([u[column] for column in columns]))
    return np.concatenate(found)


hidden = 6 * across * (1 - across) * (1 + 0.8 * np.sin(2 * np.pi * across)) / 1.5
measured = readings(hidden)
measured = measured + 0.01 * np.random.default_rng(0).standard_normal(measured.size)  # 1 % noise


def loss(profile):
    rough = np.sum((profile[1:] - profile[:-1]) ** 2)
    return 0.5 * np.sum((readings(profile) - measured) ** 2) + 1e-3 * rough


flat = np.ones(n)
print(f"{np.count_nonzero(cylinder)} solid cells, {measured.size} readings, {n} unknowns, {steps} steps")
print("gradient against finite differences:", dp.check.gradient(loss, flat).verdict)
best = dp.minimize(loss, flat, maxiter=30)
print(f"loss {loss(flat):.3f} -> {best.value:.5f} in {best.evaluations} gradients")
error = lambda profile: np.linalg.norm(profile - hidden) / np.linalg.norm(hidden)
print(f"error of the profile {error(flat):.3f} -> {error(best.x):.4f}")
if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    v = dp.rollout(step, start(best.x), None, 3 * steps, keep=lambda k, state: state["v"])[:: n // 4]
    dp.animate(grid, v, Path(sys.argv[-1]) / "obstacle.gif", title="speed")
