r"""
Where the conductor goes, on a mesh of triangles
================================================

A matrix that scikit-fem assembles, differentiable in the conductivity of each triangle.

A disc is heated everywhere and cold at its rim. We may spread a given amount of conductor over it, and want the disc as
cool as possible. The mesh, the elements and the load are those of scikit-fem; what this library adds is one solver that
knows its adjoint: ``dp.matrix_solver.from_coo``. The optimum is known exactly, so we see how close we come.

Run it: ``python examples/mesh_design.py [refinements] [--out FOLDER]``; it needs scikit-fem (in the extra `test`)
"""

import argparse
from pathlib import Path

import autograd.numpy as np
import skfem
from skfem.models.poisson import laplace, unit_load

import sparsedp as dp

parser = argparse.ArgumentParser(description="Where the conductor goes: element coefficients of a finite element mesh.")
parser.add_argument("refinements", nargs="?", type=int, default=4, help="how often the triangles are halved")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# What assembly gives
# -------------------
# The stiffness matrix is a sum over triangles,
#
# .. math:: A(k) = \sum_e k_e \, A_e ,
#
# and assembly returns all entries of all :math:`A_e`, each with its row and its column. Many of them have the same row
# and column. We keep the entries between inner nodes, because the rim is held at 0. The elements are of second order:
# first-order elements overestimate the conductivity of a checkerboard pattern.

mesh = skfem.MeshTri.init_circle(options.refinements)
basis = skfem.Basis(mesh, skfem.ElementTriP2())
inner = basis.complement_dofs(basis.get_dofs())
load = unit_load.assemble(basis)[inner]

entries = laplace.coo_data(basis)
element = np.arange(entries.data.size) % mesh.nelements  # scikit-fem lists one pair of nodes after the other
number = np.full(basis.N, -1)
number[inner] = np.arange(inner.size)
rows, columns = number[entries.indices]
kept = (rows >= 0) & (columns >= 0)
print(f"{mesh.nelements} triangles, {inner.size} inner nodes, {np.sum(kept)} entries")

# %%
# The solver
# ----------
# It is made of the places alone. Then `solve(values, b)` is the temperature, differentiable in each value and in b. The
# values at the same place are summed, and in the backward pass each of them gets the cotangent of the sum.

solve = dp.matrix_solver.from_coo(rows[kept], columns[kept])
unit = entries.data[kept]


def temperature(k):
    """Return the temperature of each inner node for the conductivity of each triangle."""
    return solve(unit * k[element[kept]], load)


# %%
# The loss
# --------
# The compliance :math:`c = b^T u` says how warm the disc is. The amount of conductor is fixed by how the unknowns are
# used: they are logarithms of shares, so each triangle gets some, and all of them together what there is.

corners = mesh.p[:, mesh.t]
area = 0.5 * np.abs(np.cross((corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T))


def conductivity(shares):
    """Return the conductivity of each triangle, 1 on average, from logarithms of shares."""
    weight = np.exp(shares)
    return weight * np.sum(area) / np.sum(area * weight)


def compliance(shares):
    """How warm the disc is."""
    return np.sum(load * temperature(conductivity(shares)))


# %%
# Textbooks give the derivative of the compliance by hand, for this one loss:
#
# .. math:: \frac{dc}{dk_e} = - u_e^T A_e u_e .
#
# Ours comes from the adjoint solve, and would be there for any other loss too.

even = np.ones(mesh.nelements)
_, slope = dp.value_and_grad(lambda k: np.sum(load * temperature(k)))(even)
nodes = np.zeros(basis.N)
nodes[inner] = temperature(even)
corners_of = nodes[basis.element_dofs].T  # the temperatures of a triangle
by_hand = -np.einsum("ei,eij,ej->e", corners_of, entries.tolocal(), corners_of)
print(f"adjoint against the formula of textbooks: difference {np.max(np.abs(slope / by_hand - 1)):.0e}")
print("gradient against finite differences:", dp.check.gradient(compliance, np.zeros(mesh.nelements)).verdict)

# %%
# The search
# ----------
# On the disc of radius 1 the heat that crosses a circle of radius :math:`r` is known, :math:`|q| = r / 2`, and
# :math:`c = \int q^2 / k` is least where :math:`k` grows like :math:`|q|`: :math:`k = 3 r / 2`, :math:`c = \pi / 9`.
# Spread evenly, the same conductor gives :math:`\pi / 8`.

best = dp.minimize(compliance, np.zeros(mesh.nelements), maxiter=60)
k = conductivity(best.x)
radius = np.hypot(*corners.mean(axis=1))
print(f"spread evenly {compliance(np.zeros(mesh.nelements)):.4f} (exact {np.pi / 8:.4f})")
print(f"after {best.history[-1].iteration} iterations {best.value:.4f} (exact {np.pi / 9:.4f})")
print(f"conductivity beside 3 r / 2: mean difference {np.sum(area * np.abs(k - 1.5 * radius)) / np.sum(area):.3f}")

# %%
# The picture
# -----------
# The conductor goes to the rim, where all heat has to pass. In the middle nothing flows, and nothing is needed.
#
# Exercises
# ---------
# 1. Hold only a quarter of the rim at 0: keep the other nodes of the rim among the unknowns. Where does the conductor
#    go?
# 2. Ask for the least *largest* temperature: ``np.sum(u**8) ** (1 / 8)``. Which line of the scene changes?
# 3. Take elements of first order, ``skfem.ElementTriP1()``. What is found is a pattern of chess that seems better than
#    the exact optimum. What would your loss have to say to forbid it?

if options.out:
    from matplotlib import pyplot

    picture, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    left.set(title="conductivity", aspect="equal")
    left.set_axis_off()
    drawn = left.tripcolor(*mesh.p, mesh.t.T, facecolors=k, cmap="viridis")
    picture.colorbar(drawn, ax=left)
    right.set(title="each triangle", xlabel="distance from the middle", ylabel="conductivity")
    right.plot(radius, k, ".", markersize=3, label="found")
    right.plot([0, 1], [0, 1.5], color="black", label="exact, 3 r / 2")
    right.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "mesh_design.png", dpi=120)
