r"""
The MBB beam
============

Topology optimization with a stiffness matrix of scikit-fem, beside published compliances.

A beam on two supports carries a load in the middle. Half of the area may be filled with material. Which layout is the
stiffest? The MBB beam is the standard test of topology optimization, and its compliance on 60 x 20 elements is
published. We use the published algorithm and the published filters. Only the derivatives come from this library.

Run it: ``python examples/mbb_beam.py [elements] [--out FOLDER]``; it needs scikit-fem and NLopt
(in the extras `test` and `design`)

References
----------
O. Sigmund, *A 99 line topology optimization code written in Matlab*, Struct. Multidisc. Optim. 21, 2001.
E. Andreassen, A. Clausen, M. Schevenels, B. S. Lazarov, O. Sigmund, *Efficient topology optimization in MATLAB using
88 lines of code*, Struct. Multidisc. Optim. 43, 2011.
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np
import skfem
from scipy.sparse import diags
from scipy.spatial import cKDTree
from skfem.models.elasticity import linear_elasticity

import sparsedp as dp

parser = argparse.ArgumentParser(description="Topology optimization of the MBB beam.")
parser.add_argument("elements", nargs="?", type=int, default=20, help="elements over the height; 3 times as many along")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

VOLUME_FRACTION = 0.5  # the largest one of the material
POISSON_RATIO = 0.3
PENALIZATION = 3.0  # the exponent of SIMP, which penalizes intermediate densities
VOID = 1e-9  # Young's modulus of an empty element; that of a full one is 1
MOVE_LIMIT = 0.2  # largest change of a density in one iteration
PUBLISHED = {"sensitivity filter": 216.81, "density filter": 233.71}  # Andreassen et al., 60 x 20 elements

# %%
# The stiffness matrix
# --------------------
# By symmetry we need only the right half. On the left side, the axis of symmetry, nothing moves in x; the lower right
# corner does not move in y; the load 1 pulls down the upper left corner. The elements are squares of side 1 with
# bilinear displacements in plane stress.
#
# scikit-fem returns the entries of all element matrices, each with its row and its column. `element` is the element
# that an entry belongs to.

height = options.elements
width = 3 * height
mesh = skfem.MeshQuad.init_tensor(np.arange(width + 1.0), np.arange(height + 1.0))
basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad1()))

first_lame = POISSON_RATIO / (1.0 - POISSON_RATIO**2)  # of plane stress, where Young's modulus is 1
shear_modulus = 0.5 / (1.0 + POISSON_RATIO)
entries = linear_elasticity(first_lame, shear_modulus).coo_data(basis)
element = np.arange(entries.data.size) % mesh.nelements  # scikit-fem lists one pair of unknowns after the other

x, y = mesh.p
x_unknowns, y_unknowns = basis.nodal_dofs
fixed = np.concatenate([x_unknowns[x == 0], y_unknowns[(x == width) & (y == 0)]])
free = basis.complement_dofs(fixed)

force = np.zeros(basis.N)
force[y_unknowns[(x == 0) & (y == height)]] = -1.0
load = force[free]

number = np.full(basis.N, -1)
number[free] = np.arange(free.size)
rows, columns = number[entries.indices]
kept = (rows >= 0) & (columns >= 0)

solve = dp.matrix_solver.from_coo(rows[kept], columns[kept])
unit = entries.data[kept]
element = element[kept]

# %%
# Density and stiffness
# ---------------------
# Each element has a density :math:`\rho` between 0 and 1. The aim is a layout of full and empty elements. The **SIMP**
# law (solid isotropic material with penalization) makes intermediate densities less stiff than the material they take:
#
# .. math:: E(\rho) = E_{min} + \rho^3 \, (1 - E_{min}) .
#
# The compliance :math:`c = f^T u` is the work of the load. A stiff beam has a small one.


def stiffness(density):
    """Return Young's modulus of each element."""
    return VOID + (1.0 - VOID) * density**PENALIZATION


def displacement(density):
    """Return the displacements that are not fixed."""
    return solve(unit * stiffness(density)[element], load)


def compliance(density):
    """Return the work of the load."""
    return np.sum(load * displacement(density))


# %%
# The derivative
# --------------
# The compliance is self-adjoint: the adjoint equation is the equation of the beam itself, so that textbooks write
#
# .. math:: \frac{\partial c}{\partial \rho_e} = -3 \, \rho_e^2 \, (1 - E_{min}) \; u_e^T K_e \, u_e .
#
# Automatic differentiation gives the same by an adjoint solve, and does so for any other loss. The adjoint solve uses
# the factors of the forward solve, so that it costs little.

value_and_gradient = dp.value_and_grad(compliance)
uniform = np.full(mesh.nelements, VOLUME_FRACTION)
c, gradient = value_and_gradient(uniform)

u = np.zeros(basis.N)
u[free] = displacement(uniform)
u_of_elements = u[basis.element_dofs].T
energy = np.einsum("ei,eij,ej->e", u_of_elements, entries.tolocal(), u_of_elements)
by_formula = -PENALIZATION * uniform ** (PENALIZATION - 1) * (1.0 - VOID) * energy

error = np.max(np.abs(gradient - by_formula)) / np.max(np.abs(by_formula))
seconds = solve.info.setup_seconds, solve.info.forward.seconds, solve.info.adjoint.seconds
print(f"{mesh.nelements} elements, {free.size} unknowns, {unit.size} entries")
print(f"adjoint against the formula of textbooks: difference {error:.0e}")
print("derivative against finite differences:", dp.check.gradient(compliance, uniform, quick=True).verdict)
print("factors {:.4f} s, forward solve {:.4f} s, adjoint solve {:.4f} s".format(*seconds))

# %%
# Filters
# -------
# Without a filter the best layout is a checkerboard, which is stiff only because bilinear elements are too stiff in
# it. Both published filters are weighted means over the neighbours of an element, up to the distance
# :math:`r = 0.04` of the width. A neighbour at the distance :math:`d` has the weight :math:`r - d`.
#
# - The **sensitivity filter** replaces each derivative by a mean of the derivatives of its neighbours. It is a
#   heuristic: the result is not the gradient of any loss, so that `minimize` cannot use it.
# - The **density filter** replaces each density by the mean :math:`\bar\rho = H z` of the unknowns of its neighbours.
#   It is part of the loss, and differentiated with it.

centres = mesh.p[:, mesh.t].mean(axis=1).T
radius = 0.04 * width
tree = cKDTree(centres)
pairs = tree.sparse_distance_matrix(tree, radius, output_type="coo_matrix")
weights = pairs.copy()
weights.data = radius - pairs.data
weights = weights.tocsr()
totals = np.ravel(weights.sum(axis=1))
average = dp.from_matrix(diags(1.0 / totals) @ weights)


def filtered_gradient(density, gradient):
    """Return the gradient after the sensitivity filter."""
    return (weights @ (density * gradient)) / (totals * np.maximum(density, 1e-3))


# %%
# Optimality criteria
# -------------------
# At the optimum the derivative of the compliance is :math:`-\lambda` times that of the volume, with the Lagrange
# multiplier :math:`\lambda`, in each element that is neither full nor empty. The published algorithm multiplies each
# unknown by the square root of the ratio of both sides, and finds the :math:`\lambda` for which the volume is right by
# bisection.


def updated(z, gradient, volume_gradient, volume):
    """Return the unknowns after one iteration of optimality criteria; ``volume(z)`` returns the volume fraction."""
    lowest = np.maximum(z - MOVE_LIMIT, 0.0)
    highest = np.minimum(z + MOVE_LIMIT, 1.0)
    lower, upper = 0.0, 1e9
    while upper - lower > 1e-3 * (upper + lower):
        multiplier = 0.5 * (lower + upper)
        factor = np.sqrt(-gradient / (multiplier * volume_gradient))
        new = np.clip(z * factor, lowest, highest)
        if volume(new) > VOLUME_FRACTION:
            lower = multiplier
        else:
            upper = multiplier
    return new


def by_sensitivity_filter(z):
    """Return compliance and next unknowns, where the unknowns are the densities."""
    c, gradient = value_and_gradient(z)
    return c, updated(z, filtered_gradient(z, gradient), 1.0, np.mean)


def compliance_of_unknowns(z):
    """Return the compliance of the filtered densities."""
    return compliance(average(z))


value_and_gradient_of_unknowns = dp.value_and_grad(compliance_of_unknowns)
volume_gradient = average.T(np.ones(mesh.nelements))


def volume(z):
    """Return the volume fraction."""
    return np.mean(average(z))


def by_density_filter(z):
    """Return compliance and next unknowns, where the densities are filtered."""
    c, gradient = value_and_gradient_of_unknowns(z)
    return c, updated(z, gradient, volume_gradient, volume)


def optimality_criteria(iterate):
    """Iterate until no unknown changes by more than 0.01."""
    z = uniform
    change = 1.0
    iterations = 0
    while change > 0.01:
        c, new = iterate(z)
        change = np.max(np.abs(new - z))
        z = new
        iterations += 1
    return z, c, iterations


print(f"\n{'':40}compliance  published  iterations  seconds  grey")


def report(label, density, c, iterations, seconds, published):
    """Print one row; `grey`, the measure of non-discreteness, is 0 for full and empty elements, 1 for densities 1/2."""
    grey = np.mean(4.0 * density * (1.0 - density))
    print(f"{label:40}{c:10.2f} {published:>10} {iterations:11} {seconds:8.1f} {grey:5.2f}")


layouts = {}
for name, iterate in {"sensitivity filter": by_sensitivity_filter, "density filter": by_density_filter}.items():
    start = perf_counter()
    z, c, iterations = optimality_criteria(iterate)
    seconds = perf_counter() - start
    density = z if iterate is by_sensitivity_filter else average(z)
    published = PUBLISHED[name] if height == 20 else "-"
    report(f"optimality criteria, {name}", density, c, iterations, seconds, published)
    layouts[f"optimality criteria, {name}"] = density

# %%
# General methods
# ---------------
# Optimality criteria are for this loss and this constraint. `minimize` takes other losses and other constraints as
# well. The constraint is a function that is <= 0 at a feasible layout. The method of moving asymptotes is the usual one
# for designs. The augmented Lagrangian also takes many constraints, and equalities. A small initial penalty suits
# designs: with a large one the search follows the constraint in short steps.

METHODS = {
    "moving asymptotes": {"method": "mma"},
    "augmented Lagrangian": {"method": "augmented_lagrangian", "penalty": 0.01},
}

for name, settings in METHODS.items():
    start = perf_counter()
    best = dp.minimize(
        compliance_of_unknowns,
        uniform,
        constraints=lambda z: volume(z) - VOLUME_FRACTION,
        bounds=(0.0, 1.0),
        maxiter=200,
        tolerance=1e-4,
        **settings,
    )
    seconds = perf_counter() - start
    density = average(best.x)
    report(f"{name}, density filter", density, best.value, len(best.history) - 1, seconds, "")
    print(f"{'':40}multiplier {best.multipliers:.1f}, volume {np.mean(density):.6f}, {best.evaluations} gradients")
    layouts[f"{name}, density filter"] = density

# %%
# The picture
# -----------
# All layouts are trusses. The density filter leaves intermediate densities at the edges of bars, which cost stiffness:
# a full and an empty element cannot be neighbours. Optimality criteria stop when no unknown changes by more than 0.01;
# the other methods reach a slightly lower compliance. The multiplier is the sensitivity of the optimum to the
# constraint: if one more percent of the area may be filled, the compliance decreases by 0.01 times the multiplier.
#
# Exercises
# ---------
# 1. Set ``radius = 1.0``: no element has neighbours now. What does the layout look like, and why is its compliance
#    so small?
# 2. Halve the elements (``mbb_beam.py 40``). The radius grows with the width: does the layout change? What happens if
#    the radius stays at 2.4 elements?
# 3. Minimize the deflection of one point instead of the compliance: replace `load` in `compliance` by another vector.
#    The formula of the textbooks is wrong now. Which check above shows this?

if options.out:
    from matplotlib import pyplot

    picture, axes = pyplot.subplots(len(layouts), 1, figsize=(8, 1.7 * len(layouts)), layout="constrained")
    column, row = centres.astype(int).T
    for ax, (title, density) in zip(axes, layouts.items()):
        half = np.zeros((height, width))
        half[row, column] = density
        whole = np.hstack([half[:, ::-1], half])
        ax.imshow(whole, origin="lower", cmap="gray_r", vmin=0, vmax=1, extent=(-width, width, 0, height))
        ax.set_title(title, fontsize=10)
        ax.set_axis_off()
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "mbb_beam.png", dpi=120)
