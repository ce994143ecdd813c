"""The lid-driven cavity at Reynolds number 100. Run: python examples/cavity.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

finest = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 64
KNOWN = np.array([-0.2140417, 0.1795728, -0.2538030])  # Botella and Peyret, Computers and Fluids 27 (1998)
# u on x = 1/2 at these y: Ghia, Ghia and Shin, J. Comput. Phys. 48 (1982)
Y = [0.9766, 0.9531, 0.8516, 0.7344, 0.6172, 0.5, 0.4531, 0.2813, 0.1719, 0.1016, 0.0625]
GHIA = [0.84123, 0.68717, 0.23151, 0.00332, -0.13641, -0.20581, -0.2109, -0.15662, -0.1015, -0.06434, -0.04192]


def cavity(n):
    """The unit square, its upper wall moves: grid and one step of the velocity."""
    grid = dp.Grid((n, n), size=1.0)
    L, lid, convect, project = dp.face_laplacian(grid), dp.face_lift(grid), dp.convection(grid), dp.projection(grid)
    moving = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0))  # y-upper, along x
    dt = min(20 / n**2, 0.5 / n)  # 0.2 h^2 / nu

    def step(v, nu):
        return project(v + dt * (nu * (L(v) + moving) - convect(v, v)))

    return grid, step, dt


def steady(grid, step, dt, nu=0.01):
    v, rate, steps = np.zeros(grid.faces.size), 1.0, 0
    while rate > 1e-5:
        before, v = v, dp.rollout(step, v, nu, 50)
        rate, steps = np.max(np.abs(v - before)) / (50 * dt), steps + 50
    return v, steps


def extremes(grid, v):
    """min u on x = 1/2, max v and min v on y = 1/2, each by a parabola through the points around it."""
    across, up = (np.take(part, grid.shape[0] // 2, axis) for axis, part in enumerate(grid.split(v)))
    return np.array([-peak(-across), peak(up), -peak(-up)])


def peak(line):
    low, top, high = line[np.argmax(line) - 1 :][:3]
    return top + (high - low) ** 2 / (8 * (2 * top - low - high))


print("cells     min u     max v     min v  off by  steps  seconds")
for n in (finest // 2, finest):
    clock = perf_counter()
    grid, step, dt = cavity(n)
    v, steps = steady(grid, step, dt)
    found = extremes(grid, v)
    rest = f"{np.max(np.abs(found / KNOWN - 1)):6.2%}  {steps:5}  {perf_counter() - clock:7.1f}"
    print(f"{n:4}^2  {'  '.join(f'{value:8.5f}' for value in found)}  {rest}")
print(" known  " + "  ".join(f"{value:8.5f}" for value in KNOWN))
if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    ax = dp.plot(grid, v, title="speed, Re 100; u on x = 1/2 and Ghia's points")
    ax.plot(0.5 + 0.4 * grid.split(v)[0][finest // 2], grid.centres()[1][0], "w-", 0.5 + 0.4 * np.array(GHIA), Y, "wo")
    ax.figure.savefig(Path(sys.argv[-1]) / "cavity.png", dpi=120)
