r"""
Is a gradient right?
====================

A right gradient, a wrong one and who is at fault, a kink, noise, a ripple: three verdicts.

A wrong gradient raises no error. An optimization that uses it converges more slowly, or stops early, without a visible
reason. `dp.check.gradient` compares a gradient with finite differences of the loss, and returns one of three verdicts:
the gradient agrees, it disagrees, or the differences are inconclusive for this loss.

Run it: ``python examples/audit.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Is a gradient right? Six losses, three verdicts.")
parser.add_argument("cells", nargs="?", type=int, default=32, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

n = options.cells
grid = dp.Grid((n, n), size=1.0)
x, y = grid.centres()
start = np.sin(3 * x) * (1.1 + y)

# %%
# How one finds out
# -----------------
# Along a direction :math:`d`, the central difference of a smooth loss misses the slope by
#
# .. math:: \frac{J(u + h d) - J(u - h d)}{2 h} - \nabla J^T d = O(h^2) + O(\epsilon / h) .
#
# As the step :math:`h` shrinks, the miss falls, until rounding :math:`\epsilon` lifts it again: drawn over the step, it
# is a V. A gradient that is wrong by some share gives a plateau instead, at just that share.

# %%
# A law with a derivative by hand
# -------------------------------
# Stefan's law of radiation says :math:`u^4`. We write its derivative ourselves, and may be off by a small share. Around
# it stand two solves, which are right.

solve = dp.inverse(dp.identity(grid.cells) - 0.01 * dp.laplacian(grid, dp.dirichlet))


def law(error):
    """Return u^4; its hand-written derivative has a relative error."""

    def derivative(nums, answer, u):
        return lambda g: (4 * (1 + error) * u**3 * g,)

    return dp.differentiable("radiation", lambda u: u**4, derivative)


def loss(error):
    """Return a loss that applies the law between two linear solves."""
    radiation = law(error)
    return lambda u: np.sum(solve(radiation(solve(u))) ** 2)


# %%
# Losses for which differences are inconclusive
# ---------------------------------------------
# A kink has two slopes. A solve that stops at 1e-3 makes noise of that size. A fast ripple of size 1e-7 changes the
# slope by 1. In these cases the honest answer is that nothing can be said, and why.

rough = dp.inverse(-dp.laplacian(grid, dp.dirichlet), "krylov", rtol=1e-3)
corner = start[n // 2, n // 2]

cases = {
    "right": loss(0.0),
    "off by 0.1 %": loss(1e-3),
    "off by 0.01 %": loss(1e-4),
    "a kink at u = 0.5": lambda u: np.sum(np.abs(u - corner) + u**2),
    "a solve that stops at 1e-3": lambda u: np.sum(rough(u) ** 3),
    "a ripple of 1e-7": lambda u: np.sum(u**2 + np.sin(1e7 * u) / 1e7),
}

# %%
# The verdicts
# ------------
# Where a gradient is wrong, every rule on the tape is tried by itself, and the one at fault is named.

audits = {}
print(f"{'loss':28}{'verdict':14}{'digits':8}{'culprit':11} why")
for name, function in cases.items():
    audit = audits[name] = dp.check.gradient(function, start)
    print(f"{name:28}{audit.verdict:14}{audit.digits!s:8}{audit.culprit!s:11} {audit.reason}")

# %%
# A function that is not ours can come with its own gradient. In a test: `assert dp.check.gradient(...)`.

foreign = dp.check.gradient(lambda u: (u**3).sum(), start, gradient=lambda u: 3 * u**2)
print("a gradient that is given:", foreign.verdict)

# %%
# The picture
# -----------
# The V of a right gradient, and the plateau of one that is off by 0.1 %. The solve that stops early has plateaus as
# well, but they lie below what its tolerance may leave.
#
# Exercises
# ---------
# 1. Make the share 1e-8. From where on is an error hidden by rounding?
# 2. Cut a gradient on purpose: `u + 0 * dp.plain(u)` somewhere in a loss. Which verdict do you get?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, places = pyplot.subplots(1, 3, figsize=(13, 3.8), sharey=True, layout="constrained")
    for ax, name in zip(places, ("right", "off by 0.1 %", "a solve that stops at 1e-3")):
        dp.v_curve(audits[name], ax)
        ax.set_title(f"{name}: {audits[name].verdict}")
    for ax in places[1:]:
        ax.set_ylabel("")
        ax.get_legend().remove()
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "audit.png", dpi=120)
