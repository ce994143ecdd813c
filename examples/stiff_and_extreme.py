"""What breaks a scene? Three sound ones, and two with a fault. Run: python examples/stiff_and_extreme.py [cells]"""

import sys

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 24
out = sys.argv[sys.argv.index("--out") + 1] if "--out" in sys.argv else None
square = dp.Grid((n, n), size=1.0)
D, L = dp.divergence(square), dp.laplacian(square, dp.dirichlet)
x, y = square.centres()
hot = np.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2) / 0.02)
spread = dp.elliptic_solver(D, dp.gradient(square, dp.dirichlet))
closed = dp.inverse(-D @ dp.gradient(square), nullspace="project")  # walls: pressure up to a constant
carry, swirl = dp.transport(square), dp.curl(square)(np.outer(np.hanning(n + 1), np.hanning(n + 1)))


def heat(p):
    """Implicit diffusion: (1 - dt nu lap) u' = u. Any time step, any viscosity."""
    return np.mean(dp.rollout(lambda u, p: spread(p["dt"] * p["nu"], u, 1.0), p["start"], p, 5) ** 2)


def pressure(b):
    return np.mean(closed(b) ** 2)


def ink(p):
    """Ink in a wind: refuses a step that is too long for the wind."""
    return np.mean((dp.rollout(lambda u, p: carry(u, p["wind"], p["dt"]), hot, p, 10) - x) ** 2)


def too_long(p):
    """Diffusion by an explicit step that nobody checks."""
    return np.mean(dp.rollout(lambda u, p: u + p["dt"] * p["nu"] * L(u), p["start"], p, 20) ** 2)


singular = (D @ dp.gradient(square)).matrix.toarray()
rough = np.linalg.inv(-singular + 1e-14 * np.diag(1 + np.arange(n * n) / n**2))  # regular by rounding alone
forgotten = dp.from_matrix(rough, square.cells, square.cells, "pressure without projection")
found = {
    "implicit diffusion": dp.stress(heat, {"start": hot, "dt": 1e-2, "nu": 1.0}, ranges={"nu": (1e-3, 1e3)}),
    "pressure in a closed box": dp.stress(pressure, hot - hot.mean()),
    "ink in a wind": dp.stress(ink, {"wind": swirl, "dt": 0.2 / n}, ranges={"dt": (0.01 / n, 0.3 / n)}),
    "explicit, number 0.6": dp.stress(too_long, {"start": hot, "dt": 0.6 / n**2, "nu": 1.0}),
    "null space left in": dp.stress(lambda b: np.mean(forgotten(b) ** 2), hot - hot.mean()),
}
for name, result in found.items():
    print(f"{name:26}{result.summary}")
    for row in result.failures[:2]:
        print(f"{'':26}  {row['case']}: {row['note']}")
print(f"\ngrowth factor of an explicit step, dt against nu\n{found['explicit, number 0.6'].map}")
if out:
    found["explicit, number 0.6"].plot().figure.savefig(f"{out}/stability.png")
