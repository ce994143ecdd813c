"""Waves in a medium, by Helmholtz's equation. Run: python examples/helmholtz.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path

import autograd.numpy as np
from scipy.special import hankel1

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 128
cells = 10  # to a wavelength
omega = 2 * np.pi * n / cells  # for a speed of 1, on the unit square


def layer(x, size=1.0):  # grows from 0 to 1 over the last two wavelengths
    return np.maximum(1 - np.minimum(x, size - x) * n / (2 * cells), 0) ** 3


def reflection(k, shift):  # what comes back from the end of a line
    u = dp.elliptic_solver(dp.divergence(line), dp.gradient(line, dp.dirichlet))(k, np.eye(200)[40], shift)[50:170]
    phase = np.arccos(1 - (omega / n) ** 2 / 2) * np.arange(120)
    back, there = np.sort(np.abs(np.linalg.lstsq(np.exp(np.outer(phase, [1j, -1j])), u, rcond=None)[0]))
    return back / there


line = dp.Grid(200, spacing=1 / n)
at_cells, at_faces = (layer(x, line.size[0]) for x in (line.centres()[0], line.face_centres(0)[0]))
print(f"reflection of a sponge, two wavelengths thick: {reflection(1.0, -(omega**2) * (1 + 3j * at_cells)):.1e}")
matched = reflection(1 / (1 - 2j * at_faces), -(omega**2) * (1 - 2j * at_cells))  # there lengths are complex
print(f"reflection of a perfectly matched layer: {matched:.1e}")

grid = dp.Grid((n, n), size=1.0)
x, y = grid.centres()
D, G = dp.divergence(grid), dp.gradient(grid, dp.dirichlet)
listen = dp.sample(grid, np.stack([np.linspace(0.25, 0.75, 41), np.full(41, 0.75)], axis=1))
source = n**2 * np.exp(-((x - 0.5) ** 2 + (y - 0.25) ** 2) * (n / 2) ** 2)
speed = 1 + 0.2 * np.exp(-((x - 0.45) ** 2 + (y - 0.5) ** 2) / 0.01)
k = 1 / (1 + dp.average(grid)(0.5 * (y > 0.6)))  # one over the density
damping = 3 * (layer(x) + layer(y))
waves = {"LU": dp.elliptic_solver(D, G), "GMRES": dp.elliptic_solver(D, G, "krylov", preconditioner="shifted_laplace")}
for name, solve in waves.items():
    u = solve(k, source, -((omega / speed) ** 2) * (1 + 1j * damping))
    done = solve.info.forward
    print(f"{name:6}{n} x {n}: {done.iterations} iterations, relative residual {done.residual:.0e}")

# Where speed and density are 1, Hankel's function of the wave number that waves along an axis have on the grid.
kh, total = n * np.arccos(1 - (omega / n) ** 2 / 2), np.sum(source * np.cos(omega * (y - 0.25))) / n**2
up = slice(n // 4 + 2, -2 * cells)
circles = waves["LU"](1.0, source, -(omega**2) * (1 + 1j * damping))[n // 2, up]
exact = 0.25j * total * hankel1(0, kh * np.hypot(x - 0.5, y - 0.25))[n // 2, up]
print(f"off Hankel's function: {np.linalg.norm(circles - exact) / np.linalg.norm(exact):.1%}")


def misfit(c):
    heard = listen(waves["LU"](k, source, -((omega / c) ** 2) * (1 + 1j * damping)))
    return np.sum(np.abs(heard - listen(u)) ** 2)


value, slope = dp.value_and_grad(misfit)(np.ones(grid.shape))  # one forward and one adjoint solve
print(f"gradient in {slope.size} speeds: {dp.check.gradient(misfit, np.ones(grid.shape)).verdict}")

if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(16, 4.4), layout="constrained")
    *maps, ax = picture.subplots(1, 3)
    dp.plot(grid, u.real, maps[0], "waves in a medium of varying speed and density")
    dp.plot(grid, slope, maps[1], "gradient in every speed")
    ax.plot(y[0, up], exact.real, "k-", label="Hankel's function")
    ax.plot(y[0, up], circles.real, ".", label="computed")
    ax.set(title="above the source, where speed and density are 1", xlabel="y")
    ax.legend()
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "helmholtz.png", dpi=120)
