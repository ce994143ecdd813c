"""Optimal control of Poisson's equation, against the exact optimum. Run: python examples/poisson_control.py [cells]"""

import sys

import autograd.numpy as np
from scipy.fft import dstn

import sparsedp as dp

# Find the source u that makes y as y_d wants it, -lap y = u, y = 0 on the walls:
# J(u) = |y - y_d|^2 / 2 + alpha |u|^2 / 2, with |.| the L2 norm, h^2 sums over cells.
finest = int(sys.argv[1]) if len(sys.argv) > 1 else 128


def problem(n, alpha):
    """The loss of v = h u, and the exact optimum J*. In v the plain gradient is the one of L2, on every grid alike."""
    grid = dp.Grid((n, n), size=1.0)
    h = 1.0 / n
    x, y = grid.centres()
    wanted = x * (1 - x**2) * y**2 * (1 - y)
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet))

    def loss(v):
        return 0.5 * np.sum((h * (solve(v / h) - wanted)) ** 2) + 0.5 * alpha * np.sum(v**2)

    # Sine modes solve it one by one: J* = sum of alpha mu^2 / (1 + alpha mu^2) y_k^2 / 2.
    line = 4 * n**2 * np.sin(np.pi * np.arange(1, n + 1) / (2 * n)) ** 2
    mu = line[:, None] + line
    modes = h * dstn(wanted, type=2, norm="ortho")
    return loss, 0.5 * np.sum(alpha * mu**2 / (1 + alpha * mu**2) * modes**2), np.zeros((n, n))


print("cells   alpha  J found          J exact          gap     iterations  gradients")
for alpha in (1e-2, 1e-4):
    for n in (finest // 4, finest // 2, finest):
        loss, exact, start = problem(n, alpha)
        best = dp.minimize(loss, start, maxiter=60)
        gap, steps = abs(best.value / exact - 1), best.history[-1].iteration
        print(f"{n:4}^2  {alpha:6.0e}  {best.value:.9e}  {exact:.9e}  {gap:.0e}  {steps:10}  {best.evaluations:9}")
