"""Where a given amount of conductor cools best. Run: python examples/conductivity_design.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 200
V, f = 1.0, 1.0  # the integral of the conductivity k, and the heat made in a unit of length or area


def design(label, grid, G, volumes, heat):
    """The k on the faces with the least integral of f T, where -div(k grad T) = f; returns k and T."""
    solve = dp.elliptic_solver(dp.divergence(grid), G)

    def conductivity(share):  # positive, and of integral V, whatever the optimizer tries
        return V * share**2 / np.sum(volumes * share**2)

    def content(share):
        return np.sum(grid.volumes * heat * solve(conductivity(share), heat))

    even = np.ones(grid.faces.shape)
    best = dp.minimize(content, even, maxiter=100, tolerance=1e-4)
    k = conductivity(best.x)
    T = solve(k, heat)
    steep = np.abs(G(T))[k > 1e-2 * np.max(k)]  # at the optimum conductor lies only where T is steepest
    told = f"{label:28} {content(even):8.6f} {best.value:8.6f} {best.value / content(even):8.5f} {best.evaluations:9}"
    print(f"{told} {best.history[-1].seconds:8.2f}   {np.min(steep):.4f} to {np.max(steep):.4f}")
    return k, T


print("                             even k   best k    ratio   gradients  seconds   |grad T| where k is")
rod = dp.Grid(n, size=1.0)
halves = np.full(n + 1, 1 / n) * np.where(np.arange(n + 1) % n == 0, 0.5, 1.0)  # a wall's face has half a cell
ends = dp.gradient(rod, {"x": (dp.dirichlet, dp.neumann)})
k, T = design(f"rod, {n} cells", rod, ends, halves, np.full(n, f))
print(f"exact {f**2 / (3 * V):.6f} and {f**2 / (4 * V):.6f}, ratio 0.75: k = 2 V (1 - x)", end="; ")
print(f"ours is off by {np.max(np.abs(k - 2 * V * (1 - rod.face_centres(0)[0]))):.0e}\n")

m = min(n, 48)
plate = dp.Grid((m, m), size=1.0)
x, y = plate.centres()
pipe = (np.abs(x - 0.5) < 0.05) & (y < 0.05)  # kept at T = 0; all walls are insulated
G = dp.gradient(plate, solid=pipe, solid_boundary=dp.dirichlet)
k, T = design(f"plate with a pipe, {m} x {m}", plate, G, np.full(plate.faces.shape, 0.5 / m**2), np.where(pipe, 0.0, f))

if "--out" in sys.argv:
    amount = dp.average(plate).T(k) / 2  # mean of the faces of each cell
    axes = dp.plot(plate, np.log10(1e-3 + amount), title="log10 of the conductivity")
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    axes.figure.savefig(Path(sys.argv[-1]) / "conductivity_design.png", dpi=120)
