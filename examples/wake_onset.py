r"""
When a wake begins to swing
===========================

The Reynolds number at which the steady flow behind a cylinder becomes unstable, and where it is sensitive.

Behind a cylinder the flow is steady up to a Reynolds number between 46 and 47; beyond, vortices leave it in turn. The
number is that at which a small perturbation stops to decay. Its growth rate is the real part of an eigenvalue of the
linearized flow, and `dp.eigenpairs` has its derivative, so that Newton's method finds the onset in a few steps.

Run it: ``python examples/wake_onset.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Onset of vortices behind a cylinder.")
parser.add_argument("cells", nargs="?", type=int, default=8, help="cells along a diameter")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The scene
# ---------
# The cylinder has the diameter 1, and the fluid comes in with the velocity 1. The cells are square around the cylinder
# and become longer away from it.


def growing(h, length, ratio, widest):
    """Return widths that grow from h by a ratio up to the widest one, and sum to a length."""
    widths = np.minimum(h * ratio ** np.arange(1, round(length / h)), widest)
    widths = widths[: np.argmax(np.cumsum(widths) >= length) + 1]
    return widths * length / np.sum(widths)


h = 1.0 / options.cells
before, behind, beside = growing(h, 10.8, 1.1, 1.0), growing(h, 22.0, 1.03, 0.4), growing(h, 14.8, 1.12, 1.0)
near = np.full(round(1.2 / h), h)
widths = np.concatenate([before[::-1], near, np.full(round(3.0 / h), h), behind])
heights = np.concatenate([beside[::-1], near, near, beside])
centre = np.sum(before) + np.sum(near), np.sum(beside) + np.sum(near)
grid = dp.Grid((widths.size, heights.size), spacing=[widths, heights], origin=(-centre[0], -centre[1]))
sides = {"x": (dp.inflow, dp.outflow), "y": dp.free_slip}

D, G = dp.divergence(grid), dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)})
L, convect, free = dp.face_laplacian(grid, sides), dp.convection(grid, sides), dp.free_faces(grid, sides)
x, y = (grid.join(*(grid.face_centres(axis)[a] for axis in (0, 1))) for a in (0, 1))
friction = dp.brinkman(grid)(np.hypot(x, y) - 0.5)
stream = grid.join(1.0, 0.0)

# %%
# The steady flow
# ---------------
# .. math:: 0 = \frac{1}{Re} (\Delta v - k \, v) - \nabla \cdot (v \, v) - \nabla p, \qquad \nabla \cdot v = 0 ,
#
# with the friction :math:`k` of `dp.brinkman` inside of the cylinder. On faces where the velocity is given, the
# equation is :math:`v = v_{\text{given}}`.


def flow(state, reynolds):
    """Return the rates of the velocity and the divergence."""
    v, p = state["v"], state["p"]
    momentum = (L(v) - friction * v) / reynolds - convect(v, v) - G(p)
    given = v - stream
    return {"v": free(momentum) + given - free(given), "p": D(v)}


root = dp.implicit(flow, method="direct")
steady = {"v": stream, "p": np.zeros(grid.shape)}
for reynolds in (10.0, 46.0):
    steady = root(steady, reynolds)

# %%
# Perturbations
# -------------
# A perturbation grows like :math:`e^{\sigma t}`, with :math:`J v = \sigma M v`. :math:`J` is the Jacobian of the
# equations; :math:`M` is 1 where an equation is a rate, and 0 for constraints and given velocities. The frequency is
# known to be near :math:`0.74 / 2 \pi`, and so the eigenvalue is near :math:`0.74 \, i`.
#
# The derivative in the Reynolds number has two parts: :math:`J` contains it, and the steady flow depends on it.

mass = {"v": free(np.ones(grid.faces.size)), "p": 0.0}


def perturbation(reynolds):
    """Return the eigenvalue and the modes of the steady flow at a Reynolds number."""
    state = root(steady, reynolds)
    return dp.eigenpairs(root, 1, 0.74j, mass, (state, reynolds), symmetric=False)


def growth(reynolds):
    """Return the growth rate."""
    return np.real(perturbation(reynolds).values[0])


onset = 46.0
print("      Re  growth rate  derivative")
for _ in range(3):
    rate, slope = dp.value_and_grad(growth)(onset)
    print(f"{onset:8.4f}  {rate:11.3e}  {slope:10.6f}")
    onset -= rate / slope
pairs = perturbation(onset)
strouhal = np.imag(pairs.values[0]) / (2 * np.pi)
print(f"onset at Re {onset:.2f}, published 46 to 47; Strouhal number {strouhal:.4f}, published 0.118")

difference = (growth(onset + 0.01) - growth(onset - 0.01)) / 0.02
print(f"derivative {slope:.7f}, by differences {difference:.7f}")

# %%
# Where the wake is sensitive
# ---------------------------
# The right vector is the mode. The left one, the adjoint mode, says how a force starts it. A change of :math:`J` at one
# place changes the eigenvalue by at most the product of their magnitudes there (Giannetti and Luchini, 2007). The
# product is large in two lobes behind the cylinder, where the oscillation arises, and small far downstream, where the
# mode is largest.


def magnitude(faces):
    """Return the magnitude of a complex velocity in the cells."""
    u, v = grid.split(faces)
    return np.sqrt(0.5 * (np.abs(u[1:]) ** 2 + np.abs(u[:-1]) ** 2 + np.abs(v[:, 1:]) ** 2 + np.abs(v[:, :-1]) ** 2))


mode = pairs.vectors["v"][0]
adjoint = pairs.left_vectors["v"][0] / grid.faces.volumes
sensitivity = magnitude(mode) * magnitude(adjoint)
along, across = (places.ravel()[np.argmax(sensitivity)] for places in np.broadcast_arrays(*grid.centres()))
print(f"most sensitive at x = {along:.2f}, y = {abs(across):.2f} on both sides")

# %%
# Exercises
# ---------
# 1. Is the mode at Re 60 faster or slower than at the onset? Print the imaginary part.
# 2. Make the diameter a parameter of `friction`, and differentiate the growth rate in it.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (top, bottom) = pyplot.subplots(2, 1, figsize=(9, 6.5), layout="constrained")
    vertical = grid.split(np.real(mode))[1]
    shown = 0.5 * (vertical[:, 1:] + vertical[:, :-1])
    panels = [(top, shown, "the mode: velocity across the stream", "RdBu", (-2, 24))]
    panels.append((bottom, sensitivity, "where the eigenvalue is sensitive", "viridis", (-2, 8)))
    for axes, field, title, colours, limits in panels:
        axes.pcolormesh(*np.broadcast_arrays(*grid.centres()), field, shading="nearest", cmap=colours)
        axes.add_patch(pyplot.Circle((0, 0), 0.5, color="gray"))
        axes.set(
            title=f"{title}, Re {onset:.1f}", xlim=limits, ylim=(-2.5, 2.5), aspect="equal", xlabel="x", ylabel="y"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "wake_onset.png", dpi=120)
