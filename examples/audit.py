"""Is a gradient right? A right one, a wrong one, a kink, noise and a ripple. Run: python examples/audit.py [cells]"""

import sys

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 32
grid = dp.Grid((n, n), size=1.0)
solve = dp.inverse(dp.identity(grid.cells) - 0.01 * dp.laplacian(grid, dp.dirichlet))
rough = dp.inverse(-dp.laplacian(grid, dp.dirichlet), "krylov", rtol=1e-3)
x, y = grid.centres()
start = np.sin(3 * x) * (1.1 + y)


def law(error):
    """Stefan's law of radiation, u^4, with a derivative by hand that is off by a share."""
    return dp.differentiable("radiation", lambda u: u**4, lambda nums, ans, u: lambda g: (4 * (1 + error) * u**3 * g,))


def loss(error):
    radiation = law(error)
    return lambda u: np.sum(solve(radiation(solve(u))) ** 2)


CASES = {
    "right": loss(0.0),
    "off by 0.1 %": loss(1e-3),
    "off by 0.01 %": loss(1e-4),
    "a kink at u = 0.5": lambda u: np.sum(np.abs(u - start[n // 2, n // 2]) + u**2),
    "a solve that stops at 1e-3": lambda u: np.sum(rough(u) ** 3),
    "a ripple of 1e-7": lambda u: np.sum(u**2 + np.sin(1e7 * u) / 1e7),
}
print(f"{'loss':28}{'verdict':14}{'digits':8}{'culprit':11} why")
for name, function in CASES.items():
    result = dp.check.gradient(function, start)
    print(f"{name:28}{result.verdict:14}{result.digits!s:8}{result.culprit!s:11} {result.reason}")

# A function that is not ours, with its own gradient. In a test: assert dp.check.gradient(...)
print(
    "a gradient that is given:", dp.check.gradient(lambda u: (u**3).sum(), start, gradient=lambda u: 3 * u**2).verdict
)
