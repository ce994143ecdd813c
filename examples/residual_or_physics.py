"""Physics as a residual, or as it is. Run: python examples/residual_or_physics.py [iterations] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp
from sparsedp import network

count = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 600
n, dt, nu, rng = 128, 1 / 32, 0.01 / (128 * np.pi), np.random.default_rng(0)
ring = dp.Grid(n, size=2.0, origin=-1.0, periodic=True)
L, G, carry = dp.laplacian(ring), dp.gradient(ring), dp.transport(ring, "semi_lagrangian", velocity="cells")
step = lambda u, nu: (lambda spread: carry(spread, spread, dt))(u + nu * dt * L(u))  # as in burgers.py
x, run = ring.centres()[0], lambda u: dp.rollout(step, u, nu, 31, keep="all")
truth = run(-np.sin(np.pi * x))
seen = lambda u: np.mean((u - truth[16]) ** 2)  # all that is known; the start is wanted
places, times = np.tile(np.pi * x, 32), np.repeat(np.arange(32) / 16 - 1, n)
points = np.stack([np.sin(places), np.cos(places), times], axis=1)  # periodic in x


def field(w, points=points):
    """Network: places and times -> u, 32 frames at once."""
    for layer in w[:-1]:
        points = network.tanh(network.dense(layer, points))
    return network.dense(w[-1], points).reshape(-1, n)


def by_equation(w):
    """Misfit, and what is left of u_t + u u_x - nu u_xx in central differences: no solver anywhere."""
    u, right, left = (np.roll(field(w), shift, 1) for shift in (0, -1, 1))
    space = u * (right - left) * n / 4 - nu * (right - 2 * u + left) * n**2 / 4
    return seen(u[16]) + np.mean(((u[2:] - u[:-2]) / (2 * dt) + space[1:-1]) ** 2)


scheme = lambda u: np.mean(np.stack([end - step(begin, nu) for begin, end in zip(u, u[1:])]) ** 2) / dt**2
through = lambda u: seen(dp.rollout(step, u, nu, 16)) + 1e-5 * np.mean(G(u) ** 2)  # of all starts the least steep one
first = lambda w: field(w, points[:n])[0]
weights = [network.dense_weights(rng, *size, gain=5 / 3) for size in ((3, 20), (20, 20), (20, 20), (20, 1))]
print("                              gradients  ms each  seconds  misfit   error  at start  physics broken by")
for label, loss, start, frames in (
    ("network, residual of equation", by_equation, weights, field),
    ("network, residual of scheme", lambda w: seen(field(w)[16]) + scheme(field(w)), weights, field),
    ("network for the start, adjoint", lambda w: through(first(w)), weights, lambda w: run(first(w))),
    ("the start itself, adjoint", through, np.zeros(n), run),
):
    best = dp.minimize(loss, start, "lbfgs", count if start is weights else 200, 0)
    u, spent, calls = frames(best.x), best.history[-1].seconds, best.evaluations
    off, told = np.mean(np.abs(u - truth), 1), f"{label:30} {calls:8} {1e3 * spent / calls:8.1f} {spent:8.1f}"
    print(f"{told} {seen(u[16]):8.1e} {np.mean(off):7.4f} {off[0]:9.4f} {np.sqrt(scheme(u)):17.1e}", flush=True)
    if "--out" in sys.argv:
        from matplotlib import pyplot

        pyplot.plot(x, u[0], label=label)
        pyplot.legend()
        Path(sys.argv[-1]).mkdir(exist_ok=True)
        pyplot.savefig(Path(sys.argv[-1]) / "residual_or_physics.png", dpi=120)
print("A residual needs no solver and gives u anywhere, nearly; the adjoint needs one, and every step is a step of it.")
