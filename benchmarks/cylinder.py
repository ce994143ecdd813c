"""Vortices behind a cylinder (DFG 2D-2, Re 100) by `brinkman`, beside published figures.

Run ``python -m benchmarks.cylinder [cells a diameter ...]`` in the root of the repository; 20 by default.
A row: the largest drag and lift coefficient and the Strouhal number of the last second of six, by how much they are off
the middle of the published ranges, and seconds of the steps. The force is the momentum that the friction takes in a
step of `flow_step` (see there).
"""

import sys
from time import perf_counter

import numpy as np

import sparsedp as dp

# Schaefer and Turek (1996): 3.22 to 3.24, 0.99 to 1.01, 0.295 to 0.305
KNOWN = {"C_D": 3.23, "C_L": 1.0, "Strouhal": 0.3}
HEIGHT, D, NU, END = 0.41, 0.1, 1e-3, 6.0
SIDES, SCALE = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}, 2 / D  # mean inflow 1


def channel(cells):
    """The grid, cells are longer behind the cylinder; coordinates of its faces."""
    h, rows = D / cells, round(HEIGHT / D * cells)
    wake = np.minimum(1.04 ** (20 / cells * np.arange(1, 40 * cells)), 6.0)
    wake = wake[: np.argmax(np.cumsum(wake) >= 1.8 / h) + 1]
    widths = np.append(np.full(4 * cells, h), 1.8 / np.sum(wake) * wake)
    grid = dp.Grid((widths.size, rows), spacing=[widths, HEIGHT / rows])
    return grid, *(grid.join(*(grid.face_centres(axis)[a] for axis in (0, 1))) for a in (0, 1))


def coefficients(cells):
    """Times, drag and lift coefficients."""
    grid, x, y = channel(cells)
    dt, steps = 0.02 / cells, round(END * cells / 0.02)
    friction = NU * dp.brinkman(grid)(np.hypot(x - 0.2, y - 0.2) - D / 2)
    step = dp.flow_step(grid, dt, NU, boundary=SIDES, unstable="allow", friction=friction)  # Courant numbers up to 0.75
    state, found = step.start(grid.join(1.0, 0.0) * 6 * y * (HEIGHT - y) / HEIGHT**2), []
    older = state["v"]
    for number in range(steps):
        before, state = state, step(state)
        ahead = state["v"] + dt * step.pressure_gradient(state["p"] - before["p"])  # before the pressure is corrected
        taken = grid.faces.volumes * friction * (ahead - 0.5 * (before["v"] - older))
        older = before["v"]
        found.append([number * dt, *(SCALE * np.sum(part) for part in grid.split(taken))])
    return np.array(found).T


def row(cells):
    clock = perf_counter()
    time, drag, lift = (line[-round(cells / 0.02) :] for line in coefficients(cells))
    mean = lift - np.mean(lift)
    up = time[1:][(mean[1:] > 0) & (mean[:-1] <= 0)]  # once a period
    figures = np.max(drag), np.max(lift), D * (up.size - 1) / (up[-1] - up[0])
    words = [f"{value:8.4f} {value / known - 1:+7.1%}" for value, known in zip(figures, KNOWN.values(), strict=True)]
    return f"{cells:5}  {'  '.join(words)}  {perf_counter() - clock:7.1f}"


if __name__ == "__main__":
    print("cells  " + "  ".join(f"{name:>8}  off by" for name in KNOWN) + "  seconds")
    for cells in map(int, sys.argv[1:] or ["20"]):
        print(row(cells), flush=True)
