r"""
One scene, two families
=======================

The same operator as a sparse matrix and as a matrix-free stencil, with times.

An operator of this library can hold its numbers in a matrix, or compute them from the grid each time. The first is open
to everything that SciPy can do; the second needs next to no memory, and is fast. Both come from the same description,
so they give the same numbers, and each of them is the test of the other.

Run it: ``python examples/two_families.py [cells] [--out FOLDER]``
"""

import argparse
import time
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="One scene with sparse matrices and with matrix-free stencils.")
parser.add_argument("cells", nargs="?", type=int, default=512, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The operator
# ------------
# The Laplacian on a square is a sum of Kronecker products of 1-D factors,
#
# .. math:: L = L_x \otimes I + I \otimes L_y .
#
# Matrix, stencil, transpose and the inverse by transforms all follow from that. Which form is taken is chosen by
# itself, from size and dimension; both can be asked for.

n = options.cells
grid = dp.Grid((n, n), size=1.0)
L = dp.laplacian(grid, boundary=dp.dirichlet)
print(L)

# %%
# The scene
# ---------
# A drop of ink spreads, and we ask how uneven it still is.

x, y = grid.centres()
ink = np.exp(-((x - 0.4) ** 2 + (y - 0.5) ** 2) / 0.02)
dt, steps = 0.2 / n**2, 20


def spread(L, u):
    """The ink after all steps."""
    for _ in range(steps):
        u = u + dt * L(u)
    return u


def unevenness(L):
    """Return the loss of the scene for an operator, whatever the form of the operator is."""
    return lambda u: np.mean(spread(L, u) ** 2)


# %%
# Times
# -----
# The best of three runs, since the first one pays for the set-up.


def fastest(action, u, repeats=3):
    """Result of action(u), and the best time of a few runs [s]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = action(u)
        times.append(time.perf_counter() - start)
    return result, min(times)


bars = {}
gradients = []
print(f"{'family':>12}  {'apply [ms]':>10}  {'gradient [ms]':>13}  {'stored numbers':>14}  loss")
for member in (L.explicit(), L.matrix_free()):
    _, apply_time = fastest(member, ink)
    (value, gradient), grad_time = fastest(dp.value_and_grad(unevenness(member)), ink)
    stored = member.matrix.nnz if member.form == "explicit" else 0
    gradients.append(gradient)
    bars[member.form] = 1e3 * apply_time, 1e3 * grad_time
    print(f"{member.form:>12}  {1e3 * apply_time:10.2f}  {1e3 * grad_time:13.1f}  {stored:14d}  {value:.12f}")

difference = np.max(np.abs(gradients[0] - gradients[1])) / np.max(np.abs(gradients[0]))
print(f"largest difference of the two gradients, relative: {difference:.0e}")

# %%
# Each is the test of the other
# -----------------------------
# `dp.check.operator` compares the two forms, the transpose with the matrix, and more.

print(dp.check.operator(dp.laplacian(dp.Grid((7, 5)), boundary=dp.dirichlet)))

# %%
# The picture
# -----------
# The ink after all steps, and the times.
#
# Exercises
# ---------
# 1. Run it with 64, 256 and 1024 cells. Where does the matrix win, if anywhere?
# 2. Do the same in three dimensions: `dp.Grid((n, n, n), size=1.0)`. How many numbers does the matrix store now?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    dp.plot(grid, spread(L, ink), ax=left, title=f"ink after {steps} steps", label="ink")
    for ax, place, title in ((middle, 0, "apply"), (right, 1, f"gradient of {steps} steps")):
        ax.bar(list(bars), [both[place] for both in bars.values()], color=["C0", "C1"], width=0.5)
        ax.set(title=title, ylabel="time [ms]")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "two_families.png", dpi=120)
