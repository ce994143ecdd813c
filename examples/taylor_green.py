"""Decaying vortices: exact solution, exact gradients. Run: python examples/taylor_green.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

finest = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 100
NU, END = 0.1, 10.0


def box(n):
    grid = dp.Grid((n, n), size=2 * np.pi, periodic=True)
    (x, y), (p, q) = grid.face_centres(0), grid.face_centres(1)
    start = grid.join(np.cos(x) * np.sin(y), -np.sin(p) * np.cos(q))
    return grid, start, dp.face_laplacian(grid), dp.projection(grid)


def first_order(n):
    """Viscosity, then carried along, then the projection: 199 steps. Returns the start, and v(0), nu -> v(END)."""
    grid, start, L, project = box(n)
    carry, dt = dp.transport(grid, "semi_lagrangian", of="faces"), END / 199
    moved = lambda v: project(carry(v, v, dt))
    return start, lambda v, nu: dp.rollout(lambda v, nu: moved(v + dt * nu * L(v)), v, nu, 199)


def second_order(n):
    """dv/dt = P(nu L v - div(v v)), central differences, Heun's steps."""
    grid, start, L, project = box(n)
    convect, steps = dp.convection(grid), int(np.ceil(END / min(0.2 * (2 * np.pi / n) ** 2 / NU, 0.2)))
    step = dp.stepper("heun", lambda v, nu: project(nu * L(v) - convect(v, v)), END / steps)
    return start, lambda v, nu: dp.rollout(step, v, nu, steps, memory="50 MB")


def error(start, run):  # relative, in L2
    return np.linalg.norm(run(start, NU) / np.exp(-2 * NU * END) - start) / np.linalg.norm(start)


start, run = first_order(25)
share = error(start, run) * np.sqrt(np.mean(start**2)) / np.mean(np.abs(start))
print("method          cells    error   known")
print(f"semi-Lagrangian  25^2  {share:.5f}   0.398  (root mean square over mean magnitude, as published)")
sizes = [n for n in (25, 50, 100, 200) if n <= finest]
errors = [error(*second_order(n)) for n in sizes]
for n, found in zip(sizes, errors):
    print(f"central, Heun   {n:3}^2  {found:.5f}" + "  0.0106" * (n == 25))
if len(errors) > 1:
    print(f"order {np.log2(errors[-2] / errors[-1]):.2f}")

# J = |alpha u(END)|^2 / 2 is exp(-4 nu END) |alpha u(0)|^2 / 2: both derivatives are known.
start, run = second_order(sizes[-1])
_, slopes = dp.value_and_grad(lambda x: 0.5 * np.sum(run(x[0] * start, x[1]) ** 2))((1.0, NU))
exact = np.exp(-4 * NU * END) * np.sum(start**2)
print(f"dJ/dalpha {slopes[0] / exact:.5f}, dJ/dnu {slopes[1] / (-2 * END * exact):.5f} of the exact ones")


def three_axes(n, steps):
    """A flow of Beltrami, v = curl v, dies out like exp(-nu t): grid, velocity at t = 1, energy at all steps."""
    grid = dp.Grid((n, n, n), size=2 * np.pi, periodic=True)
    (_, y, z), (p, _, q), (r, s, _) = map(grid.face_centres, range(3))  # Dombre and others, J. Fluid Mech. 167 (1986)
    start = grid.join(np.sin(z) + np.cos(y), np.sin(p) + np.cos(q), np.sin(s) + np.cos(r))
    step = dp.flow_step(grid, 1.0 / steps, lambda nu: nu)
    states = dp.rollout(step, step.start(start, NU), NU, steps, keep=lambda index, state: state["v"])
    return grid, states[-1], np.array([np.sum(v**2) / np.sum(start**2) for v in states]), start


found = {n: three_axes(n, 2 * n) for n in (sizes[-1] // 8, sizes[-1] // 4)}
errors = [np.linalg.norm(v / np.exp(-NU) - start) / np.linalg.norm(start) for _, v, _, start in found.values()]
cells, (grid, v, energy, _) = found.popitem()
print(f"three axes, {cells}^3: error {errors[-1]:.5f}, order {np.log2(errors[-2] / errors[-1]):.2f}, "
      f"energy {energy[-1]:.5f} (exact {np.exp(-2 * NU):.5f})")  # fmt: skip
if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture, t = Figure(figsize=(17, 3.8), layout="constrained"), np.linspace(0, 1, energy.size)
    left, middle, right = picture.subplots(1, 3, width_ratios=[1, 2.6, 1])
    dp.plot(box(sizes[-1])[0], run(start, NU), left, "speed of the vortices in a plane")
    dp.plot(grid, v, middle, "speed on the middle planes of three axes")
    right.plot(t, np.exp(-2 * NU * t), "k-", t[::4], energy[::4], "o")
    right.set(title="energy: exact, computed", xlabel="t")
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "taylor_green.png", dpi=120)
