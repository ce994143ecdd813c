"""Drag of a cylinder, ours and published, and its slopes. Run: python examples/cylinder.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path
from time import process_time

import autograd.numpy as np

import sparsedp as dp

# Case 2D-1 of Schaefer and Turek (1996): Re 20, a channel of height 0.41. Digits of Nabh (1998), www.featflow.de
KNOWN = {"C_D": 5.57953523384, "C_L": 0.010618948146, "dp": 0.11752016697}
HEIGHT, D, NU = 0.41, 0.1, 1e-3  # of the channel, of the cylinder, viscosity
SIDES, SCALE = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}, 2 / (0.2**2 * D)  # mean inflow 0.2
most = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 20  # cells a diameter, on the finest grid


def channel(cells):
    """Grid -> what solves for the flow around an ellipse, and its coefficients. Cells are longer behind it."""
    h, rows = D / cells, round(HEIGHT / D * cells)
    wake = np.minimum(1.04 ** (20 / cells * np.arange(1, 40 * cells)), 6.0)
    wake = wake[: np.argmax(np.cumsum(wake) >= 1.8 / h) + 1]
    grid = dp.Grid(
        (4 * cells + wake.size, rows),
        spacing=[np.append(np.full(4 * cells, h), 1.8 / np.sum(wake) * wake), HEIGHT / rows],
    )
    x, y = (grid.join(*(grid.face_centres(axis)[a] for axis in (0, 1))) for a in (0, 1))
    div, slope = dp.divergence(grid), dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)})
    viscous, convect, friction = dp.face_laplacian(grid, SIDES), dp.convection(grid, SIDES), dp.brinkman(grid)
    free = np.where(grid.join(1.0, 0.0) == 1, x > 0, (y > 0) & (y < HEIGHT - h / 2)).astype(float)
    inflow = grid.join(1.0, 0.0) * 4 * 0.3 * y * (HEIGHT - y) / HEIGHT**2
    on = dp.forces(grid, boundary=SIDES, cells=np.hypot(*(c - 0.2 for c in grid.centres())) < 0.08, about=0.2)
    ends = dp.sample(grid, [[0.2 + side * (D / 2 + k * h), 0.2] for side in (-1, 1) for k in (1, 2)])

    def residual(x, rub):
        v, p = x["v"], x["p"]
        momentum = NU * (viscous(v) - rub * v) - convect(v, v) - slope(p)
        return {"v": free * momentum + (1 - free) * (v - inflow), "p": div(v)}

    def flow(shape):
        """An ellipse of axes r exp(s) and r exp(-s) around (0.2, y)."""
        a, b = (x - 0.2) / np.exp(shape["s"]), (y - shape["y"]) * np.exp(shape["s"])
        rub = friction(np.sqrt(a**2 + b**2 + 1e-20) - shape["r"])
        return dp.steady(residual, {"v": inflow, "p": np.zeros(grid.shape)}, rub)

    def coefficients(x):
        front, before, back, behind = ends(x["p"])  # on the surface: straight through one and two cells outside
        drag, lift, _ = SCALE * on(x["v"], x["p"], NU)
        return {"C_D": drag, "C_L": lift, "dp": 2 * front - before - 2 * back + behind}

    return grid, flow, coefficients


circle = {"r": D / 2, "s": 0.0, "y": 0.2}
print("cells  " + "".join(f"{name:>9} {'off by':>8}" for name in KNOWN) + "  seconds")
for cells in (most // 2, most):
    clock, (grid, flow, coefficients) = process_time(), channel(cells)
    x = flow(circle)
    found = coefficients(x)
    row = [f"{value:9.5f} {value / KNOWN[name] - 1:+8.2%}" for name, value in found.items()]
    print(f"{cells:5}  {''.join(row)}  {process_time() - clock:7.1f}", flush=True)
slopes = dp.grad(lambda shape: coefficients(flow(shape))["C_D"])(circle)
print("slopes of C_D:  " + "  ".join(f"d/d{name} {float(slope):.3f}" for name, slope in slopes.items()))
_, flow, coefficients = channel(4)  # more solves: on few cells
verdict = dp.check.gradient(lambda shape: coefficients(flow(shape))["C_D"], circle).verdict
print("gradient against finite differences:", verdict)
if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    ax, turn = dp.plot(grid, x["v"], label="speed"), np.linspace(0, 2 * np.pi)
    ax.plot(0.2 + D / 2 * np.cos(turn), 0.2 + D / 2 * np.sin(turn), "r")
    ax.set(xlim=(0, 1), title=f"flow around a cylinder, Re 20: C_D {found['C_D']:.4f}, published {KNOWN['C_D']:.4f}")
    ax.figure.savefig(Path(sys.argv[-1]) / "cylinder.png", dpi=120, bbox_inches="tight")
