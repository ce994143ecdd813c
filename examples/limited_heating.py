r"""
Heating a plate below a temperature limit
=========================================

One constraint for each cell, their Lagrange multipliers, and one constraint for all cells (p-norm).

A plate is heated so that its temperature is close to a target. No cell may be hotter than a limit, and no cell can be
cooled. We minimize under these constraints by the augmented Lagrangian method, which needs one adjoint solve for the
constraints of all cells, and compare the multipliers with a difference of two optima.

Run it: ``python examples/limited_heating.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Heating a plate below a temperature limit.")
parser.add_argument("cells", nargs="?", type=int, default=48, help="cells along each axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The problem
# -----------
# With the heat source :math:`q`, the temperature :math:`T`, the target :math:`T_d` and the limit :math:`T_{max}`,
#
# .. math:: \min_q \; \tfrac{1}{2} \int (T - T_d)^2 + \tfrac{\alpha}{2} \int q^2 \quad \text{with} \quad
#           -\Delta T = q, \quad T \le T_{max}, \quad q \ge 0 .
#
# The target has a plateau that is higher than the limit. The walls are kept at :math:`T = 0`.

n = options.cells
grid = dp.Grid((n, n), size=1.0)
temperature_of = dp.inverse(-dp.laplacian(grid, dp.dirichlet))
x, y = grid.centres()
target = np.where((np.abs(x - 0.35) < 0.2) & (np.abs(y - 0.5) < 0.3), 1.3, 0.5)
limit = 1.0
alpha = 1e-5
area = 1 / n**2


def loss(q):
    return 0.5 * area * np.sum((temperature_of(q) - target) ** 2) + 0.5 * area * alpha * np.sum(q**2)


start = np.ones(grid.shape)


def search(constraints=None, source=start):
    """Return the optimal source, with or without constraints."""
    return dp.minimize(
        loss,
        source,
        "augmented_lagrangian",
        constraints=constraints,
        bounds=(0.0, None),
        tolerance=1e-6,
        maxiter=2000,
    )


def report(label, best):
    """Print a row of the table."""
    hottest = np.max(temperature_of(best.x))
    print(f"{label:34} {best.value:9.6f} {hottest:9.5f} {best.evaluations:9} {best.history[-1].seconds:8.2f}")


print("                                        loss   hottest  gradients  seconds")
unlimited = search()
report("no limit", unlimited)

# %%
# One constraint for each cell
# ----------------------------
# The constraint function returns an array: the temperature of each cell minus the limit. In each iteration the
# augmented Lagrangian method differentiates one linear combination of all entries.


def excess(q):
    """Return the temperature above the limit, which must be <= 0 in each cell."""
    return temperature_of(q) - limit


limited = search(excess)
report("a limit for each cell", limited)

# %%
# The multipliers
# ---------------
# The result has one Lagrange multiplier for each cell. It is 0 where the plate is colder than the limit, and elsewhere
# the sensitivity of the optimum to the limit (shadow price): if the limit is raised by a small amount in all cells, the
# smallest loss decreases by the sum of the multipliers times this amount. We compare with a second search, and use the
# mean of the multipliers of both, which makes the error of the difference small.

multipliers = limited.multipliers
step = 0.01
raised = search(lambda q: excess(q) - step, limited.x)
is_active = temperature_of(limited.x) > limit - 1e-3
largest_inactive = np.max(np.abs(multipliers[~is_active]))
print(f"\ncells at the limit: {np.sum(is_active)}; multipliers elsewhere: {largest_inactive:.0e}")
mean_of_sums = 0.5 * (np.sum(multipliers) + np.sum(raised.multipliers))
print(f"change of the loss per degree: {(raised.value - limited.value) / step:.5f}")
print(f"minus the sum of multipliers:  {-mean_of_sums:.5f}, the mean of both limits\n")

# %%
# One constraint for all cells
# ----------------------------
# Methods for few constraints, such as the method of moving asymptotes, take a limit of the largest temperature as one
# constraint. The p-norm is a smooth upper bound: :math:`\|T\|_p = (\sum_i T_i^p)^{1/p} \ge \max_i T_i`. It is larger
# by a factor that depends on the number of hot cells, so that the plate stays colder than necessary.

for p in (8, 32):

    def excess_of_norm(q, p=p):
        """Return the p-norm of the temperature divided by the limit, minus 1."""
        positive = np.maximum(temperature_of(q), 0.0)
        return np.sum((positive / limit) ** p) ** (1 / p) - 1.0

    report(f"p-norm, p = {p}", search(excess_of_norm))

# %%
# The picture
# -----------
# Without the limit the plateau is too hot. With it, a part of the plateau has the temperature of the limit (the active
# set). The multipliers are positive inside of this part, and largest at its corners.
#
# Exercises
# ---------
# 1. Replace the bound on :math:`q` by a limit of the total heat. What is its multiplier?
# 2. Raise the limit step by step. At which limit are all multipliers 0?
# 3. Solve the problem with p-norms by ``method="mma"``.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, axes = pyplot.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    dp.plot(grid, temperature_of(unlimited.x), ax=axes[0], title="no limit", label="temperature")
    dp.plot(grid, temperature_of(limited.x), ax=axes[1], title="T <= 1 in each cell", label="temperature")
    dp.plot(grid, multipliers / area, ax=axes[2], title="multipliers", label="multiplier per area")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "limited_heating.png", dpi=120)
