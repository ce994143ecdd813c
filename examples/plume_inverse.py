"""Winds that make three plumes end like a fourth. Run: python examples/plume_inverse.py [gradients] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

count = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 80
grid = dp.Grid((32, 40))
x, y = grid.centres()
*sources, wanted = (((x - cx) ** 2 + (y - cy) ** 2 <= 9) / 3.0 for cx, cy in ((12, 4), (13, 6), (14, 5), (16, 5)))
carry = dp.transport(grid, "maccormack")
carry_wind = dp.transport(grid, "semi_lagrangian", boundary=dp.dirichlet, of="faces")  # no wind beyond the walls
project, to_faces, up = dp.projection(grid), dp.average(grid), grid.join(0.0, 1.0)


def step(state, source):
    smoke, wind = state
    smoke = carry(smoke, wind, 1.0) + source
    return smoke, project(carry_wind(wind, wind, 1.0) + up * to_faces(smoke))


def run(wind, source, keep="last"):
    return dp.rollout(step, (np.zeros(grid.shape), wind), source, 20, keep=keep)[0]


goal = run(np.zeros(grid.faces.size), wanted)


def loss(winds):
    return sum(0.5 * np.sum((run(wind, source) - goal) ** 2) for wind, source in zip(winds, sources))


gradient = dp.value_and_grad(loss)
still = np.zeros((3, grid.faces.size))
value, g = gradient(still)
print(f"loss with no wind          {value:9.4f}  published 298.286")
print(f"one step down, rate 0.001  {loss(still - 1e-3 * g):9.4f}  published 291.4546\n")

# Clamps and kinks stall line searches. Adam steps over them; its rate falls to 0 at the last gradient.
winds, mean, square, clock = still, 0.0, 0.0, perf_counter()
for k in range(1, count + 1):
    value, g = gradient(winds)
    mean, square = 0.9 * mean + 0.1 * g, 0.999 * square + 0.001 * g**2
    rate = 0.1 * (1 - (k - 1) / count)
    winds = winds - rate * mean / (1 - 0.9**k) / (np.sqrt(square / (1 - 0.999**k)) + 1e-8)
    if k in (1, 5, 10, 20, 40, 60, 80):
        print(f"{k:3} gradients  loss {value:8.2f}")
print(f"at the end     loss {loss(winds):8.2f}  published after 80 gradients: 169.9")
print(f"{(perf_counter() - clock) / count:.2f} s for a gradient of three runs in {winds.size} unknowns")

if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    both = dp.Grid((64, 40))
    frames = [np.concatenate(pair) for pair in zip(run(winds[0], sources[0], "all"), run(still[0], wanted, "all"))]
    dp.animate(both, frames, Path(sys.argv[-1]) / "plume_inverse.gif", title="ours, and the wanted", cmap="magma")
