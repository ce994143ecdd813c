"""The drag of an obstacle, and its gradient in size and place. Run: python examples/shape.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 32
grid = dp.Grid((2 * n, n), size=(2.0, 1.0), periodic=(True, False))
dt, steps, W = 0.2 / n, 4 * n, grid.faces.volumes
x, y = (grid.join(*(grid.face_centres(axis)[a] for axis in (0, 1))) for a in (0, 1))
along = grid.join(1.0, 0.0)
wind = along * 4 * y * (1 - y)  # strongest in the middle


def inside(shape):
    """1 inside an ellipse of the area of a disc of radius r, 0 outside, smooth over two cells."""
    stretch = np.exp(shape["s"])
    distance = np.sqrt(((x - 0.6) / stretch) ** 2 + ((y - shape["y"]) * stretch) ** 2)
    return 0.5 * (1 + np.tanh((shape["r"] - distance) * n / 2))


def force(v, shape):
    """A fan keeps the wind up; the obstacle brakes what flows through it (Angot, Bruneau, Fabrie 1999)."""
    return 0.05 * (wind - v) - inside(shape) * v / (4 * dt)


step = dp.flow_step(grid, dt, viscosity=0.004, force=force)


def drag(shape):
    """The push of the wind on the obstacle along x, after all steps."""
    state = dp.rollout(step, step.start(wind, shape), shape, steps, memory="100 MB")
    return np.sum(W * along * inside(shape) * state["v"]) / (4 * dt)


gradient, h = dp.value_and_grad(drag), 1e-5
print("    r     y     s      drag   d drag/dr   d drag/dy   d drag/ds   off by")
for r, place, s in ((0.08, 0.5, 0.0), (0.12, 0.5, 0.0), (0.16, 0.5, 0.0), (0.12, 0.35, 0.0), (0.12, 0.35, 0.3)):
    shape = {"r": r, "y": place, "s": s}
    value, slope = gradient(shape)
    gaps = [(drag({**shape, key: shape[key] + h}) - drag({**shape, key: shape[key] - h})) / (2 * h) for key in shape]
    off = max(abs(gap - slope[key]) for gap, key in zip(gaps, shape))
    print(
        f"{r:5.2f} {place:5.2f} {s:5.2f}  {value:8.5f}" + "".join(f"  {slope[key]:10.6f}" for key in "rys"),
        f"{off:8.0e}",
    )

# How slender must an obstacle of this area be, to be pushed three quarters as much?
share = lambda s: drag({"r": 0.12, "y": 0.5, "s": s}) / drag({"r": 0.12, "y": 0.5, "s": 0.0})
best = dp.minimize(lambda s: (share(s) - 0.75) ** 2, 0.0, maxiter=10)
print(f"\n{share(best.x):.4f} of the drag of the disc at axes 1 : {np.exp(2 * best.x):.3f}")
if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    shape = {"r": 0.12, "y": 0.5, "s": best.x}
    state = dp.rollout(step, step.start(wind, shape), shape, steps)
    dp.plot(grid, state["v"], title="speed").figure.savefig(Path(sys.argv[-1]) / "shape.png", dpi=120)
