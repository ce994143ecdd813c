r"""
Where a given amount of conductor cools best
============================================

A rod with its exact optimum, and a plate with a pipe.

Heat is generated everywhere in a body, and leaves it at one place that is kept cold. A given amount of conductor can be
distributed in it. Which distribution keeps the body as cool as possible? For a rod there is an exact solution, with
which we compare the result of the optimization. For a plate there is none, but we can test an optimality condition.

Run it: ``python examples/conductivity_design.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Where a given amount of conductor cools best.")
parser.add_argument("cells", nargs="?", type=int, default=200, help="cells of the rod; of the plate at most 48 an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

V = 1.0  # the integral of the conductivity
f = 1.0  # the heat made in a unit of length or area

# %%
# The problem
# -----------
# With the conductivity :math:`k`, the temperature :math:`T` and the heat content :math:`c`,
#
# .. math:: \min_k \; c = \int f \, T \quad \text{with} \quad
#           -\nabla \cdot (k \, \nabla T) = f, \quad \int k = V, \quad k \ge 0 .
#
# How do we keep both conditions on :math:`k`, whatever the search tries? By a change of unknowns: each face gets a
# *share* :math:`s`, and its conductivity is
#
# .. math:: k_i = \frac{V \, s_i^2}{\sum_j w_j \, s_j^2} ,
#
# which is never negative, and has the integral :math:`V`; :math:`w_j` is the volume that face :math:`j` stands for.
#
# What to expect
# --------------
# More conductor at a face changes the content by :math:`-w \, g^2`, where :math:`g` is the slope of :math:`T` across
# the face. At the optimum it cannot pay to take some from one face and give it to another. So :math:`|g|` is the same
# wherever there is conductor, and smaller where there is none. This is a test of what the search finds, also where no
# exact solution is known: the table ends with the least and the largest :math:`|g|` on faces with conductor.
#
# Nor need we fear to end in a poor valley. Dirichlet's principle says
#
# .. math:: c = \max_T \int 2 f \, T - k \, |\nabla T|^2 ,
#
# a maximum of functions that are linear in :math:`k`. Such a maximum is convex: what is least nearby is least of all.


def design(label, grid, G, volumes, heat):
    """Return the optimal conductivity k on the faces of a grid."""
    solve = dp.elliptic_solver(dp.divergence(grid), G)

    def conductivity(share):
        """Map any real numbers to an admissible conductivity."""
        return V * share**2 / np.sum(volumes * share**2)

    def content(share):
        """Return the heat content, which is the loss."""
        temperature = solve(conductivity(share), heat)
        return np.sum(grid.volumes * heat * temperature)

    even = np.ones(grid.faces.shape)
    best = dp.minimize(content, even, maxiter=100, tolerance=1e-4)

    k = conductivity(best.x)
    slope = np.abs(G(solve(k, heat)))
    slope = slope[k > 1e-2 * np.max(k)]
    before = content(even)
    figures = f"{before:8.6f} {best.value:8.6f} {best.value / before:8.5f} {best.evaluations:9}"
    print(f"{label:28} {figures} {best.history[-1].seconds:8.2f}   {np.min(slope):.4f} to {np.max(slope):.4f}")
    return k


# %%
# A rod
# -----
# The rod is kept at :math:`T = 0` at its left end, and its right end is insulated. All heat that is made right of
# :math:`x` has to pass there: the flux is :math:`q = f \, (1 - x)`, whatever :math:`k` is. With
# :math:`c = \int q^2 / k` (multiply the equation by :math:`T`, and integrate by parts) the best :math:`k` is in
# proportion to :math:`q`:
#
# .. math:: k = 2 V (1 - x), \qquad c = \frac{f^2}{4 V}, \qquad |\nabla T| = \frac{q}{k} = \frac{f}{2 V} .
#
# Spread evenly, the same conductor leaves :math:`c = f^2 / (3 V)`. The faces at both ends stand for half a cell.

n = options.cells
rod = dp.Grid(n, size=1.0)
ends = dp.gradient(rod, {"x": (dp.dirichlet, dp.neumann)})

lengths = np.full(n + 1, 1 / n)
lengths[[0, n]] = 0.5 / n

print("                             even k   best k    ratio   gradients  seconds   |grad T| where k is")
on_rod = design(f"rod, {n} cells", rod, ends, lengths, np.full(n, f))

(x_faces,) = rod.face_centres(0)
best_on_rod = 2 * V * (1 - x_faces)
off = np.max(np.abs(on_rod - best_on_rod))
exact = f"exact {f**2 / (3 * V):.6f} and {f**2 / (4 * V):.6f}, ratio 0.75: k = 2 V (1 - x)"
print(f"{exact}; ours is off by {off:.0e}\n")

# %%
# A plate with a pipe
# -------------------
# All walls are insulated. Heat leaves through a cold pipe in the middle of the lower wall: its cells are *solid*, and
# at their sides :math:`T = 0`. A plate has faces across x and faces across y, each with a conductivity of its own: the
# conductor may be laid along an axis, like wires. Each kind of faces covers the whole plate, and together they count
# once, so that a face stands for half the area of a cell.
#
# The search stops a little before :math:`|g|` is the same on all faces with conductor: where little of it lies, little
# is left to gain.

m = min(n, 48)
plate = dp.Grid((m, m), size=1.0)
x, y = plate.centres()
pipe = (np.abs(x - 0.5) < 0.05) & (y < 0.05)
G = dp.gradient(plate, solid=pipe, solid_boundary=dp.dirichlet)

areas = np.full(plate.faces.shape, 0.5 / m**2)
on_plate = design(f"plate with a pipe, {m} x {m}", plate, G, areas, np.where(pipe, 0.0, f))

# %%
# The picture
# -----------
# Left: conductor on the rod, found and exact. Right: on the plate, the mean over the faces of each cell. Most of it
# lies close to the pipe, where all heat has to pass. The dark line above the pipe is no error: heat flows straight down
# there, and faces across x get nothing.
#
# Exercises
# ---------
# 1. Start from random shares in place of even ones. Does the search find the same contents?
# 2. Give each cell one conductivity, and each face the mean of its two cells, `dp.average(grid)`. How much of the gain
#    is lost on the plate?
# 3. Cool both ends of the rod. What is the best :math:`k` now, and what happens at the point where no heat flows?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(9.5, 4), layout="constrained")
    left.plot(x_faces, best_on_rod, color="black", linewidth=4, alpha=0.3, label="exact, 2 V (1 - x)")
    left.plot(x_faces, on_rod, label="found")
    left.axhline(V, linestyle=":", color="gray", label="even")
    left.set(title="rod, cold at x = 0", xlabel="x", ylabel="conductivity")
    left.legend(frameon=False)
    of_cells = dp.average(plate).T(on_plate) / 2  # the mean over the faces of each cell
    title = "plate, cold pipe below"
    dp.plot(plate, np.log10(1e-3 + of_cells), ax=right, title=title, label="log10 of the conductivity")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "conductivity_design.png", dpi=120)
