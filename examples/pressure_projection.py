"""Wind made from afar by pressure. Run: python examples/pressure_projection.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np
from scipy.sparse.linalg import lsqr

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 80
grid = dp.Grid((n, 4 * n // 5), size=(80.0, 64.0))  # a closed box
project = dp.projection(grid)
across = grid.join(*(grid.face_centres(axis)[0] for axis in (0, 1)))  # x of every face
left, right = dp.mask(grid.faces, across <= 40), dp.mask(grid.faces, across >= 40) @ dp.interior(grid)
x, y = grid.face_centres(1)
target = right(grid.join(np.zeros(grid.face_shape(0)), 2 * np.exp(-((x - 50) ** 2 + (y - 10) ** 2) / (2 * 32**2))))

# Only the velocity on the left is ours. The projection makes it incompressible, and that moves the right.
reach = right @ project @ left


def loss(v):
    return 0.5 * np.sum((reach(v) - target) ** 2)


v, losses = np.zeros(grid.faces.size), []
for _ in range(20):
    value, gradient = dp.value_and_grad(loss)(v)
    losses.append(value)
    v = v - gradient

print("gradient descent, rate 1")
print("steps       loss   published")
for steps, known in ((0, "2432.29"), (1, "1945.7"), (4, "1462"), (10, "1373.0"), (19, "1370.7")):
    print(f"{steps:5} {losses[steps]:10.2f} {known:>11}")

# The loss is a linear least-squares problem, and `reach` an Operator: LSQR takes it as it is.
print("\nLSQR: projections forward and adjoint")
print("pairs       loss")
for pairs in range(2, 7):  # the first adjoint only starts it
    best, *_ = lsqr(reach.to_scipy(), target, iter_lim=pairs - 1, atol=0, btol=0, conlim=0)
    print(f"{pairs:5} {loss(best):10.2f}")

w, z = (np.random.default_rng(seed).standard_normal(grid.faces.size) for seed in (0, 1))
print(f"\nsymmetric: {abs(w @ project(z) - project(w) @ z) / abs(w @ project(z)):.0e}, ", end="")
print(f"idempotent: {np.max(np.abs(project(project(w)) - project(w))):.0e}, ", end="")
print(f"divergence left: {np.max(np.abs(dp.divergence(grid)(project(w)))):.0e}")

if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(11, 3.6), layout="constrained")
    for ax, (title, field) in zip(
        picture.subplots(1, 3), {"ours": left(best), "becomes": project(left(best)), "wanted": target}.items()
    ):
        dp.plot(grid, field, ax=ax, title=title)
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "pressure_projection.png", dpi=120)
