"""Burgers: forward, and back to the start by gradients. Run: python examples/burgers.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 128
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


def loss(u):
    """Only the state after 16 steps is seen."""
    return np.mean((dp.rollout(step, u, nu, 16) - truth[16]) ** 2)


found, u = {}, np.zeros(n)
for descents in range(1, 201):
    u = u - 5 * dp.value_and_grad(loss)(u)[1]
    found |= {f"{descents} gradient descents": u} if descents in (50, 200) else {}
# Many starts end like that. L-BFGS looks for the least steep one.
found["L-BFGS"] = dp.minimise(lambda u: loss(u) + 1e-5 * np.mean(G(u) ** 2), np.zeros(n), "lbfgs", maxiter=200).x
print("the start, found by           loss  mean error  at the start")
for name, u in found.items():
    off = np.abs(dp.rollout(step, u, nu, 31, keep="all") - truth[:32])
    print(f"{name:22} {loss(u):11.1e} {np.mean(off):11.4f} {np.mean(off[0]):13.4f}")

if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(7, 4), layout="constrained")
    picture.gca().plot(x, truth[0], "k", x, truth[16], "k:", *(a for u in found.values() for a in (x, u)))
    picture.gca().legend(["start", "what is seen", *found])
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "burgers.png", dpi=120)
