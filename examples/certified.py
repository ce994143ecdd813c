r"""
How exact is a gradient, and how exact need it be?
==================================================

The error that loose solves leave in a gradient, estimated and true; a search that chooses tolerances by itself.

A gradient through a linear solve needs two solves, one forward and one adjoint. Both are iterations that stop at some
tolerance. How large is the error of the gradient if they stop early? And far from the optimum, where even a rough
direction decreases the loss, which tolerance is sufficient?

Run it: ``python examples/certified.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="How exact is a gradient, and how exact need it be?")
parser.add_argument("cells", nargs="?", type=int, default=48, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The loss
# --------
# Find the load :math:`u` on a membrane whose deflection comes near to a goal :math:`y_d`, and that is not large:
#
# .. math:: J(u) = \frac{h^2}{2} \left( | A^{-1} u - y_d |^2 + 10^{-2} \, | u |^2 \right),
#           \qquad A = -\Delta, \quad h = 1 / n .
#
# The same loss is made with different solvers, and with different tolerances of their relative residual.

n = options.cells
grid = dp.Grid((n, n), size=1.0)
x, y = grid.centres()
A = -dp.laplacian(grid, dp.dirichlet)
goal = x * (1 - x**2) * y**2 * (1 - y)
start = np.sin(3 * x) * y


def control(method, rtol=1e-10):
    """Return the loss that uses a solver with a tolerance."""
    solve = dp.inverse(A, method, rtol=rtol)

    def loss(u):
        miss = solve(u) - goal
        return 0.5 * (np.sum(miss**2) + 1e-2 * np.sum(u**2)) / n**2

    return loss


# %%
# Where the error comes from
# --------------------------
# With :math:`y = A^{-1} u`, the gradient is
#
# .. math:: \nabla J = h^2 \left( A^{-T} (y - y_d) + 10^{-2} \, u \right) .
#
# The forward solve leaves a residual :math:`r = u - A \tilde y`, the adjoint one, for :math:`A^T w = y - y_d`, a
# residual :math:`s = \tilde y - y_d - A^T \tilde w`. They move the gradient by
#
# .. math:: \delta \nabla J = -h^2 \left( A^{-T} A^{-1} r + A^{-T} s \right) :
#
# the first term is due to the forward solve, the second to the adjoint one. Both residuals are at hand, so the
# error can be estimated by solves for *corrections*, and these may be loose: an error that is known to 1 % is known.
# `dp.certify` does this for any loss with solves in it. Beside it stands the truth, from a direct solver.
#
# The value can be corrected as well. Its error is of the order of the residual. After the correction, the error is of
# the order of a product of two small numbers.

exact_value, exact = dp.value_and_grad(control("direct"))(start)

table = []
print("gradient of solves that stop early: the certificate beside the truth")
print("  rtol  estimated       true    forward    adjoint   value off by, then corrected")
for rtol in (1e-1, 1e-2, 1e-4, 1e-6):
    certificate = dp.certify(control("krylov", rtol), start)
    estimated = certificate.gradient_error
    true = np.linalg.norm(certificate.gradient - exact) / np.linalg.norm(exact)
    forward, adjoint = certificate.causes["forward solves"], certificate.causes["adjoint solves"]
    before = abs(certificate.value / exact_value - 1)
    after = abs(certificate.corrected_value / exact_value - 1)
    print(f"{rtol:6.0e} {estimated:10.2e} {true:10.2e} {forward:10.1e} {adjoint:10.1e}   {before:.1e} {after:.1e}")
    table.append((rtol, estimated, true, before, after))
print(certificate.advice)

# %%
# A search that knows this
# ------------------------
# A direction that is right to 10 % leads down as well as one that is right to ten digits. `dp.certified` lets each
# evaluation solve just so far that the gradient is right to a tenth of itself, and the value to a tenth of its change
# since the last step. As the search comes near to the optimum both become small, and the solves become more exact.
#
# Both searches end when the gradient is a millionth of the first one. We count the iterations in all solves.

print("\nL-BFGS to a gradient 1e-6 times as large, with solves to 1e-10, and as loose as the gradient allows")
for method in ("krylov", "multigrid"):
    loss = control(method)
    for name, tolerance in (("exact", 1e-6), ("certified", dp.certified(0.1, 1e-6))):
        search = lambda u: dp.minimize(loss, u, tolerance=tolerance).value
        plan = dp.explain(search, np.zeros(grid.shape), gradient=False)
        iterations = sum(count for (_, kind), count in plan.counts.items() if kind == "iterations")
        print(f"{method:10} {name:10} loss {plan.value:.9e} {iterations:6d} iterations in solves")
    print(tolerance)

# %%
# The picture
# -----------
# Left: the estimate lies on the true error, at each tolerance. Right: the value before and after its correction.
#
# Exercises
# ---------
# 1. Is the error of the gradient always smaller than the tolerance? Take a load of fast waves, `np.sin(40 * x) * y`.
# 2. Allow 50 % in place of 10 %: `dp.certified(0.5, 1e-6)`. Are fewer iterations in solves paid for by more steps?
# 3. Which of both solves should be more exact, when the goal is out of reach and the miss stays large?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    rtols, estimates, errors, plain, corrected = zip(*table)
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    left.loglog(rtols, errors, "o", label="true")
    left.loglog(rtols, estimates, "x--", label="estimated by dp.certify")
    left.set(title="gradient", xlabel="tolerance of the solves", ylabel="relative error")
    right.loglog(rtols, plain, "o-", label="as computed")
    right.loglog(rtols, corrected, "s-", label="corrected")
    right.set(title="value", xlabel="tolerance of the solves")
    for ax in (left, right):
        ax.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "certified.png", dpi=120)
