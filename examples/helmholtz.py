r"""
Waves of one frequency
======================

Helmholtz's equation with ends that absorb, two solvers, circular waves beside Hankel's function, and a gradient.

A source emits one frequency in a medium of varying speed and density. The wave is the solution of one complex linear
system. It is hard to solve, because the matrix is indefinite, and the boundaries must not reflect waves.

Run it: ``python examples/helmholtz.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np
from scipy.special import hankel1

import sparsedp as dp

parser = argparse.ArgumentParser(description="Waves in a medium, by Helmholtz's equation.")
parser.add_argument("cells", nargs="?", type=int, default=128, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

n = options.cells
h = 1 / n
cells = 10  # of a wavelength
omega = 2 * np.pi / (cells * h)  # for a speed of 1

# %%
# The equation
# ------------
# A wave of the frequency :math:`\omega` is the real part of :math:`u \, e^{-i \omega t}`. With the density :math:`\rho`
# and the source :math:`s`,
#
# .. math:: -\nabla \cdot \left( \frac{1}{\rho} \, \nabla u \right) - \frac{\omega^2}{c^2} \, (1 + i \sigma) \, u = s .
#
# Here :math:`c` is the speed where :math:`\rho = 1`; elsewhere waves run at :math:`c / \sqrt \rho`. The term with
# :math:`\sigma` damps. `dp.elliptic_solver` takes all of it: as :math:`k` one over the density, as *shift* minus
# :math:`(\omega / c)^2 \, (1 + i \sigma)`.
#
# Ends that absorb
# ----------------
# There are two ways to let a wave die out before it meets the end. A *sponge* lets :math:`\sigma` grow over the last
# two wavelengths; if it grows too fast the sponge itself reflects. A *perfectly matched layer* makes the lengths
# complex there: :math:`dx` becomes :math:`(1 + i \tau) \, dx`,
#
# .. math:: -\frac{d}{dx} \left( \frac{1}{1 + i \tau} \, \frac{du}{dx} \right) - \omega^2 (1 + i \tau) \, u = s,
#           \qquad u = \exp \left( i \omega \int (1 + i \tau) \, dx \right) .
#
# The wave on the right falls by :math:`e^{-\omega \int \tau}`, and there is no wave that goes back: nothing is
# reflected, but for what the grid makes of it.


def layer(x, size=1.0):
    """Return a profile that is 0 inside and grows to 1 over the last two wavelengths at both ends."""
    depth = 1 - np.minimum(x, size - x) / (2 * cells * h)
    return np.maximum(depth, 0) ** 3


# %%
# On a line we can measure that. Right of the source there is a wave that goes and one that comes back,
# :math:`u_j = a \, e^{i \kappa j} + b \, e^{-i \kappa j}`, and a fit tells :math:`|b / a|`. The phase from cell to cell
# is the one on the grid, where :math:`2 - 2 \cos \kappa = \omega^2 h^2`.

line = dp.Grid(200, spacing=h)
solve_line = dp.elliptic_solver(dp.divergence(line), dp.gradient(line, dp.dirichlet))
kappa = np.arccos(1 - (omega * h) ** 2 / 2)


def reflection(k, shift):
    """Return the amplitude of the reflected wave relative to the outgoing wave."""
    source = np.eye(200)[40]
    u = solve_line(k, source, shift)[50:170]  # between the source and the layer
    phase = kappa * np.arange(120)
    waves = np.exp(np.outer(phase, [1j, -1j]))
    there, back = np.abs(np.linalg.lstsq(waves, u, rcond=None)[0])
    return back / there


in_cells = layer(line.centres()[0], line.size[0])
on_faces = layer(line.face_centres(0)[0], line.size[0])
sponge = reflection(1.0, -(omega**2) * (1 + 3j * in_cells))
matched = reflection(1 / (1 + 2j * on_faces), -(omega**2) * (1 + 2j * in_cells))
print(f"reflection of a sponge, two wavelengths thick: {sponge:.1e}")
print(f"reflection of a perfectly matched layer: {matched:.1e}")

# %%
# A medium
# --------
# A source in the lower half of a square, a lens that is 20 % faster above it, and still higher a denser layer. Sponges
# stand on all four sides.

grid = dp.Grid((n, n), size=1.0)
x, y = grid.centres()
D = dp.divergence(grid)
G = dp.gradient(grid, dp.dirichlet)

source = n**2 * np.exp(-((x - 0.5) ** 2 + (y - 0.25) ** 2) * (n / 2) ** 2)
speed = 1 + 0.2 * np.exp(-((x - 0.45) ** 2 + (y - 0.5) ** 2) / 0.01)
density = 1 + dp.average(grid)(0.5 * (y > 0.6))
damping = 3 * (layer(x) + layer(y))


def shift(c):
    """Return the zeroth-order coefficient of the equation for the speed in each cell."""
    return -((omega / c) ** 2) * (1 + 1j * damping)


# %%
# Two solvers. LU factors the matrix and then solves without iterations. GMRES needs a preconditioner. Multigrid fails
# on this equation itself: smoothing makes smooth waves grow, and on coarse grids they have the wrong length. But it
# works on the same equation with strong damping, the *shifted Laplacian*, and that is near enough to precondition with.

solvers = {
    "LU": dp.elliptic_solver(D, G),
    "GMRES": dp.elliptic_solver(D, G, "krylov", preconditioner="shifted_laplace"),
}
for name, solve in solvers.items():
    u = solve(1 / density, source, shift(speed))
    info = solve.info.forward
    print(f"{name:6}{n} x {n}: {info.iterations} iterations, relative residual {info.residual:.0e}")

# %%
# Beside Hankel's function
# ------------------------
# With a speed and a density of 1 everywhere the source sends out circular waves,
#
# .. math:: u = \frac{i}{4} \, \hat s \, H_0^{(1)} \left( \frac{\kappa}{h} \, r \right), \qquad
#           \hat s = \int s(x, y) \, \cos \omega (y - 0.25) \; dx \, dy .
#
# :math:`\hat s` is the Fourier transform of the source at the wave number :math:`\omega`: the source is small beside a
# wavelength, but no point. The wave number is the one that waves along an axis have on the grid. Ten cells to a
# wavelength make waves 1.7 % too short; what is compared is what remains.

solve = solvers["LU"]
strength = np.sum(source * np.cos(omega * (y - 0.25))) / n**2
above = slice(n // 4 + 2, -2 * cells)  # from the source to the sponge
circles = solve(1.0, source, shift(1.0))[n // 2, above]
radius = np.hypot(x - 0.5, y - 0.25)[n // 2, above]
exact = 0.25j * strength * hankel1(0, kappa / h * radius)
off = np.linalg.norm(circles - exact) / np.linalg.norm(exact)
print(f"off Hankel's function: {off:.1%}")

# %%
# The error of the phase grows with the distance. Stencils of order 4 make it 23 times smaller, so that the waves agree
# with Hankel's function of the right wave number :math:`\omega`. Here the layers of `dp.matched_layer` absorb them.

in_cells, on_faces = dp.matched_layer(grid, 2 * cells, speed=1.0).coefficients(omega)
right = 0.25j * strength * hankel1(0, omega * radius)
lines = {}
for order in (2, 4):
    solve_order = dp.elliptic_solver(dp.divergence(grid, order), dp.gradient(grid, dp.dirichlet, order=order))
    lines[order] = solve_order(on_faces, in_cells * source, -(omega**2) * in_cells)[n // 2, above]
    off = np.linalg.norm(lines[order] - right) / np.linalg.norm(right)
    print(f"order {order}: {off:.1%} off Hankel's function of the right wave number")

# %%
# The gradient in every speed
# ---------------------------
# Microphones stand along a line above the lens. We do not know the lens: how should each speed change, starting from 1,
# so that they hear what they do? With :math:`A u = s` for the equation, and :math:`L` for listening,
#
# .. math:: J(c) = | L u - d |^2, \qquad A^T w = 2 \, L^T \, (L u - d)^*, \qquad
#           \frac{\partial J}{\partial c} = -\operatorname{Re} \left( \frac{2 \omega^2}{c^3} \, (1 + i \sigma) \,
#           w \, u \right) .
#
# The adjoint wave :math:`w` comes from the microphones. One forward and one adjoint solve, with one factorization,
# whatever the number of speeds.

listen = dp.sample(grid, np.stack([np.linspace(0.25, 0.75, 41), np.full(41, 0.75)], axis=1))
heard = listen(u)


def misfit(c):
    """Return the squared difference between predicted and measured waves."""
    return np.sum(np.abs(listen(solve(1 / density, source, shift(c))) - heard) ** 2)


even = np.ones(grid.shape)
_, slope = dp.value_and_grad(misfit)(even)
print(f"gradient in {slope.size} speeds: {dp.check.gradient(misfit, even).verdict}")

# %%
# The picture
# -----------
# Left: the waves; in the denser layer they are shorter. Middle: the gradient in every speed, largest on the way from
# the source to the microphones. Right: circular waves along a line above the source. With order 2 they fall behind.
#
# Exercises
# ---------
# 1. Let the sponge grow over one wavelength, then over four. What is reflected? And of the matched layer?
# 2. Take 20 cells to a wavelength: `cells = 20`. How far from Hankel's function are the waves now, and how far if you
#    take :math:`\omega` for :math:`\kappa / h`?
# 3. Find the lens: smooth the unknown as in `full_waveform.py`, and give `dp.minimize` the misfit.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, place) = pyplot.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    most = np.max(np.abs(u.real))
    dp.plot(grid, u.real, left, "waves in a medium", limits=(-most, most), cmap="RdBu_r", label="u")
    most = np.max(np.abs(slope))
    dp.plot(grid, slope, middle, "gradient in every speed", limits=(-most, most), cmap="RdBu_r", label="slope")
    place.plot(y[0, above], right.real, color="black", linewidth=1, label="Hankel's function")
    for order, marker in ((2, "x"), (4, ".")):
        place.plot(y[0, above], lines[order].real, marker, label=f"order {order}")
    place.set(title="above the source, in an even medium", xlabel="y", ylabel="u")
    place.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "helmholtz.png", dpi=120)
