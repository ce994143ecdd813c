r"""
Heat in a rod
=============

One operator, one gradient, one table of finite differences.

A rod is 1 m long, and both of its ends are held at 0 degrees. We know its temperature after it has cooled for a while,
and look for its temperature at the start. On the way we meet the idea on which this library is based: the derivative
of a linear operator is its transpose. It takes three lines.

Run it: ``python examples/heat_rod.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np
from autograd.extend import defvjp, primitive

import sparsedp as dp

parser = argparse.ArgumentParser(description="Heat in a rod: one operator, one gradient.")
parser.add_argument("cells", nargs="?", type=int, default=64)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# A grid and an operator
# ----------------------
# The rod is cut into cells of width :math:`h`. A field is a plain array with one number for each cell. The Laplacian
# takes the difference of the slopes on both sides of a cell,
#
# .. math:: (L u)_i = \frac{u_{i+1} - 2 u_i + u_{i-1}}{h^2},
#
# and it includes the condition at the ends: `dirichlet` means that the temperature there is 0.

rod = dp.Grid(options.cells, size=1.0)
L = dp.laplacian(rod, boundary=dp.dirichlet).explicit()
print(L)

# %%
# The idea, in three lines
# ------------------------
# Let :math:`J` be any number that we compute from :math:`v = L u`. When :math:`u` moves by :math:`du`, then
# :math:`v` moves by :math:`L \, du`, and
#
# .. math:: dJ = g^T L \, du = (L^T g)^T du \quad \text{with} \quad g = \partial J / \partial v .
#
# So a derivative that passes backward through :math:`L` is multiplied by the transpose of :math:`L`. A program that
# computes derivatives needs only these two functions: the product with :math:`L` and the product with its transpose.

apply = primitive(lambda u: L.matrix @ u)
transpose = lambda g: L.matrix.T @ g
defvjp(apply, lambda answer, u: transpose)

# %%
# Every operator of this library contains these three lines. The next lines show that ours give the same gradient.

(x,) = rod.centres()
bump = np.exp(-(((x - 0.3) / 0.1) ** 2))

_, by_hand = dp.value_and_grad(lambda u: np.sum(apply(u) ** 2))(bump)
_, built_in = dp.value_and_grad(lambda u: np.sum(L(u) ** 2))(bump)

difference = np.max(np.abs(by_hand - built_in)) / np.max(np.abs(built_in))
print(f"three lines against L(u): difference {difference:.0e}")

# %%
# The rod cools
# -------------
# The heat equation says :math:`u_t = u_{xx}` (the diffusivity is 1). A step of Euler is
# :math:`u \leftarrow u + \Delta t \, L u`. It is stable as long as :math:`\Delta t \le h^2 / 2`; beyond that, a
# zigzag from cell to cell grows. We stay below.

h = 1.0 / options.cells
dt = 0.4 * h**2
steps = 3 * options.cells


def cool(u):
    """Return the temperature after all time steps."""
    for _ in range(steps):
        u = u + dt * L(u)
    return u


# %%
# The data are the final temperatures of a rod that was warm around :math:`x = 0.6`. The loss is the deviation from
# them,
#
# .. math:: J(u) = \sum_i h \, \left(\text{cool}(u)_i - w_i\right)^2 .

truth = np.exp(-(((x - 0.6) / 0.1) ** 2))
wanted = cool(truth)


def loss(u):
    """Return the squared difference between the cooled rod and the wanted temperature."""
    return np.sum(rod.volumes * (cool(u) - wanted) ** 2)


# %%
# Is the gradient right?
# ----------------------
# An error in a gradient through hundreds of steps is hard to see. So the gradient is compared with differences of
# the loss itself, along a few directions and with many step sizes. What counts is the last line, the verdict.

print(f"gradient of the loss after {steps} steps, against finite differences:")
print(dp.check.gradient(loss, bump))

# %%
# Back to the start
# -----------------
# With a gradient, the minimization is one call. We begin with a bump at the wrong position.

best = dp.minimize(loss, bump, maxiter=20)
print(f"loss {loss(bump):.2e} -> {best.value:.2e} in {len(best.history)} entries of history")

# %%
# The picture
# -----------
# The initial state that is found fits the data and is near the true one, but it is not the same: cooling removes fine
# details, so that they have no effect on the loss.
#
# Exercises
# ---------
# 1. Set `dt = 0.6 * h**2`. What do you see, and what does the check say about the gradient of a run that explodes?
# 2. Let the rod cool ten times as long. Which part of the start can still be found?
# 3. Insulate the ends: `boundary=dp.neumann`. What is kept from step to step now?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (before, after) = pyplot.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
    before.set(title="at the start", xlabel="x [m]", ylabel="temperature [degrees]")
    before.plot(x, truth, color="black", label="true")
    before.plot(x, bump, ":", label="first guess")
    before.plot(x, best.x, label="found")
    before.legend(frameon=False)
    after.set(title=f"after {steps} steps", xlabel="x [m]")
    after.plot(x, wanted, color="black", linewidth=4, alpha=0.3, label="what is seen")
    after.plot(x, cool(bump), ":", label="from the first guess")
    after.plot(x, cool(best.x), label="from what is found")
    after.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "heat_rod.png", dpi=120)
