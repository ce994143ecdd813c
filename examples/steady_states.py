"""Cavity and convection without a loop over time. Run: python examples/steady_states.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 64
grid, hot = dp.Grid((n, n), size=1.0), {"x": dp.dirichlet}  # warm at x = 0, cold at x = 1
D, G, L, inside = dp.divergence(grid), dp.gradient(grid), dp.face_laplacian(grid), dp.interior(grid)
convect, lid, lift, steep = dp.convection(grid), dp.face_lift(grid), dp.lift(grid, hot), dp.gradient(grid, hot)
mean, gravity, pin = dp.average(grid), 0.71 * grid.join(0.0, 1.0), (np.arange(n * n) == 0.0).reshape(n, n)
moving, warm = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0)), lift(lift.domain.join(1.0, 0.0, 0.0, 0.0))
# u on x = 1/2 at these y for Re 1000: Ghia, Ghia and Shin, J. Comput. Phys. 48 (1982). Min u: Botella and Peyret (1998)
Y = [0.9766, 0.9531, 0.8516, 0.7344, 0.6172, 0.5, 0.4531, 0.2813, 0.1719, 0.1016, 0.0625]
GHIA = [0.65928, 0.46604, 0.33304, 0.18719, 0.05702, -0.0608, -0.10648, -0.27805, -0.38289, -0.2973, -0.20196]
MIN_U, NUSSELT = {100: -0.21404, 400: -0.32726, 1000: -0.38857}, {1e4: 2.243, 1e5: 4.519}  # de Vahl Davis (1983)


def flow(v, p, force):
    """Momentum inside, v = 0 on walls; div v = 0, and p = 0 in one cell: its constant is free."""
    return {"v": inside(force - convect(v, v) - G(p)) + v - inside(v), "p": D(v) + pin * p}


def cavity(x, reynolds):
    return flow(x["v"], x["p"], (L(x["v"]) + moving) / reynolds)


def heat_flow(x):
    return x["v"] * mean(x["T"]) - steep(x["T"]) - warm  # per area: carried by v, less what is conducted


def convection(x, rayleigh):
    momentum = flow(x["v"], x["p"], 0.71 * L(x["v"]) + rayleigh * gravity * mean(x["T"]))
    return momentum | {"T": -D(heat_flow(x))}


def nusselt(x):
    return np.mean(grid.split(heat_flow(x))[0][1:-1])


x = rest = {"v": np.zeros(grid.faces.size), "p": np.zeros((n, n))}
for reynolds, known in MIN_U.items():
    x = dp.steady(cavity, x, float(reynolds))  # from the flow before
    print(f"Re {reynolds:6}   min u {np.min(grid.split(x['v'])[0][n // 2]):8.5f}, known {known:8.5f}")
y = rest | {"T": 1 - grid.centres()[0]}
for rayleigh, known in NUSSELT.items():
    y = dp.steady(convection, y, rayleigh)
    change = dp.grad(lambda ra, y=y: nusselt(dp.steady(convection, y, ra)))(rayleigh) * rayleigh / nusselt(y)
    print(f"Ra {rayleigh:6.0e}   Nu {nusselt(y):7.4f}, known {known:6.3f}   d log Nu / d log Ra {change:.4f}")
if "--out" in sys.argv:
    from matplotlib.figure import Figure

    Path(sys.argv[-1]).mkdir(exist_ok=True)
    first, second = (Figure(layout="constrained").add_subplot() for _ in range(2))
    ax = dp.plot(grid, x["v"], first, "speed, Re 1000; u on x = 1/2 and Ghia's points")
    ax.plot(0.5 + 0.4 * grid.split(x["v"])[0][n // 2], grid.centres()[1][0], "w-", 0.5 + 0.4 * np.array(GHIA), Y, "wo")
    ax.figure.savefig(Path(sys.argv[-1]) / "steady_cavity.png", dpi=120)
    ax = dp.plot(grid, y["T"], second, f"isotherms, Ra 1e5: Nu {nusselt(y):.3f}, published {known}", cmap="inferno")
    ax.contour(*grid.centres(), y["T"], np.linspace(0.1, 0.9, 9), colors="white")
    ax.figure.savefig(Path(sys.argv[-1]) / "steady_convection.png", dpi=120)
