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
    """Unit square, hot (1) at x = 0, cold (0) at x = 1, insulated below and above: grid, step, first state, Nusselt."""
    grid, hot = dp.Grid((n, n), size=1.0), {"x": dp.dirichlet}
    G, lift, mean = dp.gradient(grid, hot), dp.lift(grid, hot), dp.average(grid)
    values, up = lift.domain.join(1.0, 0.0, 0.0, 0.0), grid.join(0.0, PRANDTL)
    heat = {"diffusivity": 1.0, "boundary": hot, "values": values}
    rise = lambda v, s, rayleigh: rayleigh * up * mean(s["heat"])
    step = dp.flow_step(grid, 0.01 / n, PRANDTL, rise, implicit=True, scalars={"heat": heat})

    def nusselt(state):
        """Heat per area through planes across x: carried by v, less what is conducted."""
        u, v = state["s"]["heat"], state["v"]
        return np.mean(grid.split(v * mean(u) - G(u) - lift(values))[0][1:-1])

    return grid, step, step.start(np.zeros(grid.faces.size), RAYLEIGH, {"heat": 1 - grid.centres()[0]}), nusselt


def steady(n):
    """Steps until the heat that passes does not change."""
    grid, step, state, nusselt = scene(n)
    before, steps = 0.0, 0
    while abs(nusselt(state) - before) > 1e-2 * 20 * step.dt:  # d Nu / dt below 0.01
        before, steps = nusselt(state), steps + 20
        state = dp.rollout(step, state, RAYLEIGH, 20)
    return grid, state, before, steps


print("cells  Nusselt   max u   max v  steps  seconds")
for n in (finest // 2, finest):
    clock = perf_counter()
    grid, state, heat_flow, steps = steady(n)
    u, w = (
        np.max(np.take(part, n // 2, axis)) for axis, part in enumerate(grid.split(state["v"]))
    )  # on the centre lines
    print(f"{n:4}^2  {heat_flow:7.4f}  {u:6.3f}  {w:6.3f}  {steps:5}  {perf_counter() - clock:7.1f}")
print(" known  {:7.4f}  {:6.3f}  {:6.3f}".format(*KNOWN))
if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    words = f"isotherms, Ra 1e4: Nu {heat_flow:.3f}, published {KNOWN[0]}"
    ax = dp.plot(grid, state["s"]["heat"], title=words, cmap="inferno", label="temperature")
    ax.contour(*grid.centres(), state["s"]["heat"], np.linspace(0.1, 0.9, 9), colors="white")
    ax.figure.savefig(Path(sys.argv[-1]) / "convection.png", dpi=120)
