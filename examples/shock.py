"""The shock of Burgers' equation, against the exact solution. Run: python examples/shock.py [cells] [--out FOLDER]"""

import sys
import time
from pathlib import Path

import numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 512  # cells for each unit of length
nu, steepest = 0.01 / np.pi, 1.6037 / np.pi  # viscosity; when the front is steepest


def run(n, end, interpolation):
    """u_t + u u_x = nu u_xx from -sin(pi x) on (-1, 1), u = 0 at both ends: cell centres and u(end)."""
    line, steps = dp.Grid(2 * n, size=2.0, origin=-1.0), int(np.ceil(2 * end * n))
    one, bend = dp.identity(line.cells), 0.25 * nu * end / steps * dp.laplacian(line, dp.dirichlet)
    smooth = dp.inverse(one - bend) @ (one + bend)  # half a step of diffusion (Crank-Nicolson)
    carry = dp.transport(line, "semi_lagrangian", dp.dirichlet, "cells", interpolation=interpolation)
    (x,) = line.centres()
    u = -np.sin(np.pi * x)
    for _ in range(steps):
        u = smooth(u)
        guess = carry(u, u, end / steps)
        u = smooth(carry(u, guess, end / steps))  # u keeps its value on its way, so its speed is that of the arrival
    return x, u


found = {}
print("          width   slope at t = 0.510   off by   profile at t = 0.5 off by   seconds")
for interpolation in ("linear", "cubic"):
    for cells in (n // 2, n):
        clock = time.perf_counter()
        x, u = found[f"{interpolation}, 1/{cells}"] = run(cells, steepest, interpolation)
        clock, slope = time.perf_counter() - clock, (u[cells] - u[cells - 1]) * cells
        exact = [0.302842708347, 0.592769534402, 0.847354524451]
        off = np.max(np.abs(np.interp([-0.75, -0.5, -0.25], *run(cells, 0.5, interpolation)) - exact))
        print(
            f"{interpolation:8} 1/{cells:<5} {slope:18.3f} {slope / -152.005161576 - 1:9.1%} {off:26.1e} {clock:10.2f}"
        )
print("exact                     -152.005")

if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(7, 4), layout="constrained")
    for name, (x, u) in found.items():
        picture.gca().plot(x, u, ".-", label=name)
    picture.gca().set(xlim=(-0.03, 0.03), xlabel="x", ylabel="u", title="the steepest moment")
    picture.gca().legend()
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "shock.png", dpi=120)
