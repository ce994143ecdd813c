"""A smoke plume in a closed box, step by step. Run: python examples/plume.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 32
grid = dp.Grid((n, 5 * n // 4), size=(80.0, 100.0))
dt, viscosity, steps = 1.5, 0.01, 11
x, y = grid.centres()
source = 0.2 * ((x - 30) ** 2 + (y - 15) ** 2 <= 100)  # smoke that enters in each step

carry = dp.transport(grid, "semi_lagrangian")
carry_wind = dp.transport(grid, "semi_lagrangian", boundary=dp.dirichlet, of="faces")  # no wind beyond the walls
project, to_faces = dp.projection(grid), dp.average(grid)
up = grid.join(0.0, 1.0)  # hot smoke rises
# Each component on its own mesh, 0 one spacing beyond its last samples, as in the published run.
bend = [dp.laplacian(dp.Grid(grid.face_shape(a), spacing=80 / n), dp.robin(2, 80 / n)) for a in (0, 1)]


def step(state, source):
    """What happens to smoke and wind in dt: carried, lifted, slowed by viscosity, made incompressible."""
    smoke, wind = state
    smoke = carry(smoke, wind, dt) + source
    wind = dp.interior(grid)(carry_wind(wind, wind, dt) + dt * up * to_faces(smoke))
    wind = wind + dt * viscosity * grid.join(*(L(part) for L, part in zip(bend, grid.split(wind))))
    return smoke, project(wind)


still = np.zeros(grid.shape), np.zeros(grid.faces.size)
smoke, wind = dp.rollout(step, still, source, steps, keep="all")

known = [0.1558497, 0.46300, 0.89665, 1.40989, 2.04113, 2.92796, 3.83948, 4.52694, 4.86798, 5.13108, 5.48387]
print("step  largest wind  published (n = 32)  mean smoke  divergence")
for k in range(1, steps + 1):
    left = np.max(np.abs(dp.divergence(grid)(wind[k])))
    print(f"{k:4} {np.max(np.abs(wind[k])):13.5f} {known[k - 1]:19.5f} {np.mean(smoke[k]):11.6f} {left:11.0e}")


def height(source):
    """Centre of the smoke after all steps."""
    smoke, _ = dp.rollout(step, still, source, steps)
    return np.sum(y * smoke) / np.sum(smoke)


print("\ngradient of that in the source, against finite differences:", dp.check.gradient(height, source).verdict)

if "--out" in sys.argv:
    smoke, _ = dp.rollout(step, still, source, 40, keep="all")
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    dp.animate(grid, smoke, Path(sys.argv[-1]) / "plume.gif", title="smoke", cmap="magma")
