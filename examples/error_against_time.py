"""Which scheme and solver for a given error? Burgers and Poisson. Run: python examples/error_against_time.py [cells]"""

import sys

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 64
NU, T, PLACES = 0.01 / np.pi, 0.5, np.array([-0.75, -0.5, -0.25])


def burgers(scheme, cells):
    """u_t + (u^2 / 2)_x = nu u_xx from a sine, while a front forms: three values of u, in amplitude and phase."""
    line = dp.Grid(cells, size=2.0, origin=-1.0, periodic=True)  # u = 0 at both ends: it is odd
    G, D, A = dp.gradient(line), dp.divergence(line), dp.average(line)
    h, x, see = 2 / cells, line.centres()[0], dp.sample(line, PLACES[:, None])
    longest = {"order 1": h**2 / (2 * NU + h), "order 2": min(h**2 / (2 * NU), h / 2), "exponential": 2 * h}[scheme]
    dt = T / (many := int(np.ceil(1.1 * T / longest)))
    convect = lambda u, p: -D(A(u) ** 2 / 2)
    step = {  # upwind (a flux that diffuses too much) and Euler; Heun; diffusion exact by transforms
        "order 1": lambda: dp.stepper("euler", lambda u, p: convect(u, p) + D((NU + np.abs(A(u)) * h / 2) * G(u)), dt),
        "order 2": lambda: dp.stepper("heun", lambda u, p: convect(u, p) + D(NU * G(u)), dt),
        "exponential": lambda: dp.stepper("etdrk4", convect, dt, linear=(D @ G, NU)),
    }[scheme]()

    def loss(p):
        return np.sum(see(dp.rollout(step, -p[0] * np.sin(np.pi * (x + p[1])), p, many)) ** 2)

    return loss, START, {"steps": many, "unknowns": cells}


def exact(p):
    """The same three values without a grid, by the formula of Cole and Hopf: means over all starting points y."""
    y, sees = np.linspace(-2, 2, 8001), PLACES[:, None] + p[1]
    power = -p[0] * np.cos(np.pi * y) / (2 * np.pi * NU) - (sees - y) ** 2 / (4 * NU * T)
    weight = np.exp(power - np.max(power, axis=1, keepdims=True))
    return np.sum((np.sum(weight * p[0] * np.sin(np.pi * y), axis=1) / np.sum(weight, axis=1)) ** 2)


def poisson(cells, method, rtol=1e-10):
    """-lap u = s on the square: the middle value, and its slope in s."""
    grid = dp.Grid((cells, cells), size=1.0)
    solve, middle = dp.inverse(-dp.laplacian(grid, dp.dirichlet), method, rtol=rtol), dp.sample(grid, [[0.5, 0.5]])
    return lambda s: middle(solve(s * np.ones(grid.shape)))[0], 1.0, {"unknowns": cells**2, "tolerance": rtol}


START, SCHEMES = np.array([1.0, 0.0]), {name: {"scheme": name} for name in ("order 1", "order 2", "exponential")}
SOLVERS = {name: {"method": name} for name in ("separable", "direct", "multigrid")}
SOLVERS |= {f"krylov {rtol:g}": {"method": "krylov", "rtol": rtol} for rtol in (1e-3, 1e-10)}
tables = [
    dp.workprec(burgers, SCHEMES, {"cells": [4 * n, 8 * n, 16 * n]}, reference=dp.value_and_grad(exact)(START)),
    dp.workprec(poisson, SOLVERS, {"cells": [n // 4, n // 2, n]}, reference=(0.07367135328151,) * 2),
]
for table in tables:
    print(f"{table}\nfastest at an error of 1 %: {(table.best(1e-2) or {'method': 'none'})['method']}\n")
# table.save("folder") writes Markdown, CSV and a picture with the Pareto set.
