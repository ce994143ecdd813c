"""Natural convection in a cavity, Pr 0.71, Ra 1e4. Run: python examples/convection.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

finest = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 64
PRANDTL, RAYLEIGH = 0.71, 1e4
KNOWN = 2.243, 16.178, 19.617  # de Vahl Davis, Int. J. Numer. Methods Fluids 3 (1983)


def scene(n):
    """Unit square, hot (1) at x = 0, cold (0) at x = 1, insulated below and above: grid, one step, heat flow."""
    grid, hot = dp.Grid((n, n), size=1.0), {"x": dp.dirichlet}
    D, G, lift, mean = dp.divergence(grid), dp.gradient(grid, hot), dp.lift(grid, hot), dp.average(grid)
    walls = lift(lift.domain.join(1.0, 0.0, 0.0, 0.0))
    L, convect, project = dp.face_laplacian(grid), dp.convection(grid), dp.projection(grid)
    up, dt = grid.join(0.0, 1.0), 0.2 / n**2

    def flow(state):
        """Heat per area through each face: carried by v, less what is conducted."""
        heat, v = state
        return v * mean(heat) - G(heat) - walls

    def step(state, rayleigh):
        heat, v = state
        force = PRANDTL * (L(v) + rayleigh * up * mean(heat)) - convect(v, v)
        return heat - dt * D(flow(state)), project(v + dt * force)

    return grid, step, lambda state: np.mean(grid.split(flow(state))[0][1:-1]), dt


def steady(n):
    """Steps until the heat that passes does not change."""
    grid, step, nusselt, dt = scene(n)
    state, before, steps = (1 - grid.centres()[0], np.zeros(grid.faces.size)), 0.0, 0
    while abs(nusselt(state) - before) > 1e-2 * 100 * dt:  # d Nu / dt below 0.01
        before, steps = nusselt(state), steps + 100
        state = dp.rollout(step, state, RAYLEIGH, 100)
    return grid, state, before, steps


print("cells  Nusselt   max u   max v  steps  seconds")
for n in (finest // 2, finest):
    clock = perf_counter()
    grid, (heat, v), heat_flow, steps = steady(n)
    u, w = (np.max(np.take(part, n // 2, axis)) for axis, part in enumerate(grid.split(v)))  # on the centre lines
    print(f"{n:4}^2  {heat_flow:7.4f}  {u:6.3f}  {w:6.3f}  {steps:5}  {perf_counter() - clock:7.1f}")
print(" known  {:7.4f}  {:6.3f}  {:6.3f}".format(*KNOWN))
if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    ax = dp.plot(grid, heat, title="temperature", cmap="inferno")
    ax.figure.savefig(Path(sys.argv[-1]) / "convection.png", dpi=120)
