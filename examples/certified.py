"""How exact is a gradient, and how exact need it be? Run: python examples/certified.py [cells]"""

import sys

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 48
grid = dp.Grid((n, n), size=1.0)
A = -dp.laplacian(grid, dp.dirichlet)
x, y = grid.centres()
goal, start = x * (1 - x**2) * y**2 * (1 - y), np.sin(3 * x) * y


def control(method, rtol=1e-10):
    """Find the load u whose deflection is near a goal, and that is not large."""
    solve = dp.inverse(A, method, rtol=rtol)
    return lambda u: 0.5 * (np.sum((solve(u) - goal) ** 2) + 1e-2 * np.sum(u**2)) / n**2


exact_value, exact = dp.value_and_grad(control("direct"))(start)
print("gradient of solves that stop early: the certificate beside the truth")
print(f"{'rtol':>6} {'estimated':>10} {'true':>10} {'forward':>10} {'adjoint':>10}   value off by, then corrected")
for rtol in (1e-1, 1e-2, 1e-4, 1e-6):
    found = dp.certify(control("krylov", rtol), start)
    true = np.linalg.norm(found.gradient - exact) / np.linalg.norm(exact)
    causes = " ".join(f"{error:10.1e}" for error in found.causes.values())
    off = [abs(value / exact_value - 1) for value in (found.value, found.corrected_value)]
    print(f"{rtol:6.0e} {found.gradient_error:10.2e} {true:10.2e} {causes}   {off[0]:.1e} {off[1]:.1e}")
print(found.advice)

print("\nL-BFGS to a gradient 1e-6 times as large, with solves to 1e-10, and as loose as the gradient allows")
for method in ("krylov", "multigrid"):
    counts = {}
    for name, tolerance in (("exact", 1e-6), ("certified", dp.certified(0.1, 1e-6))):
        spent = dp.explain(lambda u: dp.minimize(control(method), u, tolerance=tolerance).value, 0 * x, gradient=False)
        counts[name] = sum(many for (_, kind), many in spent.counts.items() if kind == "iterations")
        print(f"{method:10} {name:10} loss {spent.value:.9e} {counts[name]:6d} iterations in solves")
    print(tolerance)
