"""One scene, two families: sparse matrices and matrix-free stencils. Run: python examples/two_families.py [cells]"""

import sys
import time

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 512
grid = dp.Grid((n, n), size=1.0)
L = dp.laplacian(grid, boundary=dp.dirichlet)
x, y = grid.centres()
ink = np.exp(-((x - 0.4) ** 2 + (y - 0.5) ** 2) / 0.02)
dt, steps = 0.2 / n**2, 20
print(f"{L}\n(this is the form that was chosen by itself; both can be asked for)\n")


def scene(L):
    """Operator -> the loss of the scene: the ink spreads, and we ask how uneven it still is."""

    def loss(u):
        for _ in range(steps):
            u = u + dt * L(u)
        return np.mean(u**2)

    return loss


def fastest(action, u, repeats=3):
    """Result of action(u) and the best time of a few runs [s]; the first run pays for the set-up."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = action(u)
        times.append(time.perf_counter() - start)
    return result, min(times)


print(f"{'family':>12}  {'apply [ms]':>10}  {'gradient [ms]':>13}  {'stored numbers':>14}  loss")
gradients = []
for member in (L.explicit(), L.matrix_free()):
    _, apply_time = fastest(member, ink)
    (value, gradient), grad_time = fastest(dp.value_and_grad(scene(member)), ink)
    stored = member.matrix.nnz if member.form == "explicit" else 0
    gradients.append(gradient)
    print(f"{member.form:>12}  {1e3 * apply_time:10.2f}  {1e3 * grad_time:13.1f}  {stored:14d}  {value:.12f}")

difference = np.max(np.abs(gradients[0] - gradients[1])) / np.max(np.abs(gradients[0]))
print(f"\nlargest difference of the two gradients, relative: {difference:.0e}")
print("Both come from the same 1-D factors, so each is the test of the other:")
print(dp.check.operator(dp.laplacian(dp.Grid((7, 5)), boundary=dp.dirichlet)))
