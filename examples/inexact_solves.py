"""How exact must an inner solve be? Let the gradient's error say. Run: python examples/inexact_solves.py [cells]"""

import sys

import numpy as np

import sparsedp as dp

# Fit theta in u'' = -theta sin(2 pi x), u(0) = u(1) = 0, from 5 to 2. The loss is |u - wanted|^2 / (2 n).
n = int(sys.argv[1]) if len(sys.argv) > 1 else 30
h = 1 / (n + 1)
A = -dp.laplacian(dp.Grid(n, spacing=h), dp.robin(2, h)).matrix_free()  # u = 0 half a cell beyond the walls
load = np.sin(2 * np.pi * np.linspace(h, 1 - h, n))
solve = dp.inverse(A)
wanted = solve(2 * load)
START, RATE, STEPS, damp = 5.0, 275.0, 125, h**2 / 2  # the last: one over the diagonal of A


def descend(sweeps_at, keep=False):
    """Step i takes sweeps_at(i) Jacobi sweeps, then as many for the adjoint: from zero, or from the last answers."""
    theta, u, adjoint = START, np.zeros(n), np.zeros(n)
    for i in range(STEPS):
        u, adjoint = keep * u, keep * adjoint
        for _ in range(sweeps_at(i)):
            u += damp * (theta * load - A.apply(u))
        for _ in range(sweeps_at(i)):
            adjoint += damp * ((u - wanted) / n - A.T.apply(adjoint))
        theta -= RATE * load @ adjoint  # from zero, this is exactly the gradient through the sweeps
    return theta, sum(map(sweeps_at, range(STEPS)))


def descend_certified(share):
    """From the last answers, sweep both until the gradient is surely right to `share` of itself."""
    # Let w = A^-1 load, and r, s the residuals of u and the adjoint. The gradient is off by w.(s + A^-1 r / n):
    # at most |w| (|s| + |r| / (8 n)), as |A^-1| <= 1/8. And w = (u + A^-1 r) / theta is bounded the same way.
    theta, u, adjoint, sweeps = START, np.zeros(n), np.zeros(n), 0
    for _ in range(STEPS):
        sure = False
        while not sure:
            r, s = theta * load - A.apply(u), (u - wanted) / n - A.T.apply(adjoint)
            w, gradient = (np.linalg.norm(u) + np.linalg.norm(r) / 8) / abs(theta), load @ adjoint
            sure = w * (np.linalg.norm(s) + np.linalg.norm(r) / (8 * n)) <= share * abs(gradient)
            u, adjoint, sweeps = u + damp * r, adjoint + damp * s, sweeps + 1
        theta -= RATE * gradient
    return theta, sweeps


u = solve(START * load)  # one solve and one adjoint solve make the exact step: u / theta is the slope of u
exact = START - load @ solve.T((u - wanted) / n) / (np.sum((u / START) ** 2) / n)
print("gradient descent, 125 steps  sweeps each way  published  error of theta  published (n = 30)")
for label, (theta, sweeps), known in (
    ("from zero, 600 sweeps a step", descend(lambda i: 600), "75000 1.30e-05"),
    ("from zero, 100 and 5 more a step", descend(lambda i: 100 + 5 * i), "50465 1.47e-05"),  # their rule is not told
    ("from the last answers, 10 a step", descend(lambda i: 10, keep=True), "- -"),
    ("from the last answers, 46 a step", descend(lambda i: 46, keep=True), "- -"),
    ("from the last answers, certified", descend_certified(0.5), "- -"),
    ("one exact step: 1 + 1 solves", (exact, 0), "- -"),
):
    print(f"{label:34} {sweeps:10} {known.split()[0]:>10} {abs(theta / 2 - 1):15.2e} {known.split()[1]:>10}")
