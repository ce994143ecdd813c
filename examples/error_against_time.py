"""Which scheme and solver for a given error? Burgers and Poisson. Run: python examples/error_against_time.py [cells]"""

import sys

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 64
line = dp.Grid(2 * n, size=2.0, origin=-1.0, periodic=True)
L, D, A = dp.laplacian(line), dp.divergence(line), dp.average(line)
NU, T, x = 0.05, 0.5, line.centres()[0]


def burgers(scheme, steps):
    """u_t + (u^2 / 2)_x = nu u_xx from a sine with an amplitude and a phase: the value is the energy at the end."""
    dt = T / steps
    convect, rate = (lambda u: -D(A(u) ** 2 / 2)), (lambda u: -D(A(u) ** 2 / 2) + NU * L(u))
    if scheme == "exponential":
        spread = dp.exponential(L, NU * dt)  # exact diffusion; Heun for the rest, in its frame

    def step(u):
        if scheme == "euler":
            return u + dt * rate(u)
        if scheme == "heun":
            slope = rate(u)
            return u + dt / 2 * (slope + rate(u + dt * slope))
        slope = convect(u)
        return spread(u + dt / 2 * slope) + dt / 2 * convect(spread(u + dt * slope))

    def loss(p):
        u = -p[0] * np.sin(np.pi * (x + p[1]))
        for _ in range(steps):
            u = step(u)
        return np.sum(u**2) / n

    return loss, np.array([1.0, 0.1]), {"steps": steps}


def poisson(cells, method, rtol=1e-10):
    """-lap u = s on the square: the middle value, and its slope in s."""
    grid = dp.Grid((cells, cells), size=1.0)
    solve, ones = dp.inverse(-dp.laplacian(grid, dp.dirichlet), method, rtol=rtol), np.ones(grid.shape)
    middle = dp.sample(grid, [[0.5, 0.5]])
    return lambda s: middle(solve(s * ones))[0], 1.0, {"unknowns": cells**2, "tolerance": rtol}


SCHEMES = {name: {"scheme": name} for name in ("euler", "heun", "exponential")}
SOLVERS = {name: {"method": name} for name in ("separable", "direct", "multigrid")}
SOLVERS |= {f"krylov {rtol:g}": {"method": "krylov", "rtol": rtol} for rtol in (1e-3, 1e-10)}
coarse = int(2.5 * T * NU * n**2) + 1  # steps: fewer, and explicit diffusion is not stable
finest = [{"scheme": "exponential", "steps": coarse * k} for k in (8, 16)]
tables = [
    dp.workprec(burgers, SCHEMES, {"steps": [coarse * k for k in (1, 2, 4)]}, reference=finest),
    dp.workprec(poisson, SOLVERS, {"cells": [n // 4, n // 2, n]}, reference=(0.07367135328151,) * 2),
]
for table in tables:
    print(f"{table}\nfastest at an error of 1 %: {(table.best(1e-2) or {'method': 'none'})['method']}\n")
# table.save("folder") writes Markdown, CSV and a picture with the Pareto set.
