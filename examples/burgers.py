"""Burgers: forward, and back to the start by gradients. Run: python examples/burgers.py [cells] [--out FOLDER]

With --observation FILE (one number a cell) the state that is seen after 16 steps is read from a file."""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1].isdigit() else 128
option = dict(zip(sys.argv, sys.argv[1:], strict=False)).get
ring, dt, nu = dp.Grid(n, size=2.0, origin=-1.0, periodic=True), 1 / 32, 0.01 / (128 * np.pi)
L, G, carry = dp.laplacian(ring), dp.gradient(ring), dp.transport(ring, "semi_lagrangian", velocity="cells")
x = ring.centres()[0]


def step(u, nu):
    """u_t + u u_x = nu u_xx: diffusion, then the field carries itself."""
    u = u + nu * dt * L(u)
    return carry(u, u, dt)


truth = dp.rollout(step, -np.sin(np.pi * x), nu, 32, keep="all")
print("u at t = 1:", *(f"{value:.7f}" for value in truth[32][:5]))
print("published :  0.0057228 0.0171672 0.0286103 0.0400520 0.0514921   (128 cells)\n")


seen = np.loadtxt(option("--observation")) if option("--observation") else truth[16]


def loss(u):
    """Only the state after 16 steps is seen."""
    return np.mean((dp.rollout(step, u, nu, 16) - seen) ** 2)


found, losses, u = {}, [], np.zeros(n)
for descents in range(1, 201):
    value, slope = dp.value_and_grad(loss)(u)
    losses, u = [*losses, value], u - 5 * slope
    found |= {f"{descents} gradient descents": u} if descents in (49, 50, 200) else {}
print("loss before descent 1 to 6, 11, 16, 21 ... 46:", *(f"{losses[k]:.6f}" for k in [*range(6), *range(10, 46, 5)]))
# Many starts end like that. L-BFGS looks for the least steep one.
found["L-BFGS"] = dp.minimize(lambda u: loss(u) + 1e-5 * np.mean(G(u) ** 2), np.zeros(n), "lbfgs", maxiter=200).x
print("the start, found by           loss  mean error  at the start  33 frames over 32")
for name, u in found.items():
    off = np.abs(dp.rollout(step, u, nu, 32, keep="all") - truth)
    mean, published = np.mean(off[:32]), np.sum(off) / (32 * n)  # published: with --observation and 49 descents
    print(f"{name:22} {loss(u):11.1e} {mean:11.4f} {np.mean(off[0]):13.4f} {published:18.5f}")

if option("--out"):
    from matplotlib.figure import Figure

    picture = Figure(figsize=(7, 4), layout="constrained")
    picture.gca().plot(x, truth[0], "k", x, truth[16], "k:", *(a for u in found.values() for a in (x, u)))
    picture.gca().legend(["start", "what is seen", *found])
    Path(option("--out")).mkdir(exist_ok=True)
    picture.savefig(Path(option("--out")) / "burgers.png", dpi=120)
