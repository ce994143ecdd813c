"""Onsets of instability by `eigenpairs`: convection between two plates, and vortices behind a cylinder.

Run ``python -m benchmarks.stability [cells ...]`` in the root of the repository: cells a diameter of the cylinder, 10
by default. A row: the critical number, by Newton's method on the growth rate, whose derivative is the
derivative of the eigenvalue; the published one; by how much it is off;
the derivative of the growth rate there; seconds. For the cylinder
also the Strouhal number. Then the verdicts of `check.gradient` on small grids.

Published: 1707.762 at the wavenumber 3.117 between rigid plates (S. Chandrasekhar, Hydrodynamic and Hydromagnetic
Stability, 1961); Re 46.7 and Strouhal number 0.118 for the cylinder (F. Giannetti, P. Luchini, J. Fluid Mech. 581,
2007; other authors have 46 to 47).
"""

import argparse
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from benchmarks.tables import lines

CRITICAL_RAYLEIGH = 1707.762
CRITICAL_REYNOLDS = 46.7


def stretched(h, length, ratio, widest=0.4):
    """Return widths that grow from h by a ratio up to the widest one, and sum to a length."""
    widths = np.minimum(h * ratio ** np.arange(1, round(length / h)), widest)
    widths = widths[: np.argmax(np.cumsum(widths) >= length) + 1]
    return widths * length / np.sum(widths)


class Layer:
    """A layer of fluid heated from below, half a wavelength long: perturbations of the state at rest."""

    def __init__(self, n):
        self.grid = grid = dp.Grid((n, n), size=(np.pi / 3.117, 1.0))
        flow = {"x": dp.free_slip, "y": dp.no_slip}
        heat = {"x": dp.neumann, "y": dp.dirichlet}
        self.D, self.G, self.L = dp.divergence(grid), dp.gradient(grid), dp.face_laplacian(grid, flow)
        self.conduct, self.to_faces = dp.laplacian(grid, heat), dp.average(grid, heat)
        self.free, self.up = dp.free_faces(grid, flow), grid.join(0.0, 1.0)
        self.pin = (np.arange(n * n) == 0).reshape(grid.shape)
        cells = np.zeros(grid.shape)
        self.rest = {"v": np.zeros(grid.faces.size), "p": cells, "T": cells}
        self.mass = {"v": self.free(np.ones(grid.faces.size)), "p": 0.0, "T": 1.0}
        self.root = dp.implicit(self)

    def __call__(self, x, rayleigh):
        v, p, T = x["v"], x["p"], x["T"]
        momentum = self.L(v) + rayleigh * self.up * self.to_faces(T) - self.G(p)
        rising = self.grid.split(v)[1]
        return {
            "v": self.free(momentum) + v - self.free(v),
            "p": self.D(v) + self.pin * p,
            "T": self.conduct(T) - self.D(v * self.to_faces(T)) + 0.5 * (rising[:, 1:] + rising[:, :-1]),
        }

    def growth(self, rayleigh):
        """The growth rate of a perturbation."""
        pairs = dp.eigenpairs(self.root, 1, 1.0, self.mass, (self.rest, rayleigh), symmetric=False)
        return np.real(pairs.values[0])


class Wake:
    """The flow around a cylinder of diameter 1 at speed 1, from -12 to 25 along x and -16 to 16 along y."""

    sides = {"x": (dp.inflow, dp.outflow), "y": dp.free_slip}

    def __init__(self, cells):
        h = 1.0 / cells
        before = stretched(h, 10.8, 1.1, 1.0)[::-1]
        behind = stretched(h, 22.0, 1.03)
        beside = stretched(h, 14.8, 1.12, 1.0)
        near = np.full(round(1.2 * cells), h)
        widths = np.concatenate([before, near, np.full(round(3.0 * cells), h), behind])
        heights = np.concatenate([beside[::-1], near, near, beside])
        self.grid = grid = dp.Grid((widths.size, heights.size), spacing=[widths, heights])
        self.D, self.G = dp.divergence(grid), dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)})
        self.L, self.convect = dp.face_laplacian(grid, self.sides), dp.convection(grid, self.sides)
        self.free = dp.free_faces(grid, self.sides)
        x, y = (grid.join(*(grid.face_centres(axis)[a] for axis in (0, 1))) for a in (0, 1))
        left, low = np.sum(before) + np.sum(near), np.sum(beside) + np.sum(near)
        self.friction = dp.brinkman(grid)(np.hypot(x - left, y - low) - 0.5)
        self.stream = grid.join(1.0, 0.0)
        self.uniform = {"v": self.stream, "p": np.zeros(grid.shape)}
        self.mass = {"v": self.free(np.ones(grid.faces.size)), "p": 0.0}
        self.root = dp.implicit(self, method="direct")
        self.state = self.uniform

    def __call__(self, x, reynolds):
        v, p = x["v"], x["p"]
        momentum = (self.L(v) - self.friction * v) / reynolds - self.convect(v, v) - self.G(p)
        given = v - self.stream
        return {"v": self.free(momentum) + given - self.free(given), "p": self.D(v)}

    def eigenvalue(self, reynolds):
        """The growth rate and the frequency of the first unstable perturbation."""
        x = self.root(self.state, reynolds)
        pairs = dp.eigenpairs(self.root, 1, 0.01 + 0.74j, self.mass, (x, reynolds), symmetric=False)
        return pairs.values[0]

    def growth(self, reynolds):
        """The growth rate."""
        return np.real(self.eigenvalue(reynolds))


def critical(growth, number):
    """Return the zero of a growth rate near a number, and the derivative there."""
    slope = 0.0
    for _ in range(3):
        rate, slope = dp.value_and_grad(growth)(number)
        number -= rate / slope
    return number, slope


def row(name, ours, published, slope, seconds):
    """Print a row."""
    print(
        f"{name:24} {ours:9.3f} {published:9.3f} {ours / published - 1:9.1e} {slope:10.3e} {seconds:8.1f}", flush=True
    )


def plates():
    """Print the rows of convection between plates."""
    found = []
    for n in (16, 32, 64):
        clock = perf_counter()
        number, slope = critical(Layer(n).growth, 1700.0)
        row(f"plates, {n}^2", number, CRITICAL_RAYLEIGH, slope, perf_counter() - clock)
        found.append(number)
    row("plates, extrapolated", (4 * found[2] - found[1]) / 3, CRITICAL_RAYLEIGH, slope, 0.0)
    print(f"order {np.log2((CRITICAL_RAYLEIGH - found[1]) / (CRITICAL_RAYLEIGH - found[2])):.2f}")


def cylinder(cells):
    """Print the row of the cylinder."""
    clock = perf_counter()
    wake = Wake(cells)
    for reynolds in (10.0, 46.0):
        wake.state = wake.root(wake.state, reynolds)
    number, slope = critical(wake.growth, 46.0)
    row(f"cylinder, {cells} a diameter", number, CRITICAL_REYNOLDS, slope, perf_counter() - clock)
    print(f"Strouhal number {np.imag(wake.eigenvalue(number)) / (2 * np.pi):.4f} on {wake.grid.cells.size} cells")


def verdicts():
    """Print the verdicts of `check.gradient`."""
    print(f"gradient of the plates: {dp.check.gradient(Layer(6).growth, 1600.0).verdict}")
    wake = Wake(3)
    wake.root = dp.implicit(wake, method="direct", rtol=1e-13)
    wake.state = wake.root(wake.state, 20.0)
    print(f"gradient of the cylinder: {dp.check.gradient(wake.growth, 40.0).verdict}")
    strouhal = lambda reynolds: np.imag(wake.eigenvalue(reynolds)) / (2 * np.pi)
    print(f"gradient of its Strouhal number: {dp.check.gradient(strouhal, 40.0).verdict}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cells", nargs="*", type=int, default=[10])
    dp.set_threads(1)
    print("onset                         ours published    off by      slope  seconds")
    plates()
    for cells in parser.parse_args().cells:
        cylinder(cells)
    verdicts()
    print(f"lines: plates {lines(Layer)}, cylinder {lines(Wake)}")
