"""Heat conduction and linear elasticity of Mosaic: a coefficient for each element of a box of hexahedra.

Both laws are those of SIMP with power 3: the coefficient of an element of density rho is r + (1 - r) rho^3 times that
of the full material, r = 1e-3. The box is 2 long and 1 wide. The face x = 0 is held at 0, the face x = 2 is loaded. The
compliance is the work of this load. Mosaic lists elements with x running fastest.
"""

import autograd.numpy as np

from benchmarks.mosaic.hexahedra import Hexahedra, elasticity_matrix, heat_matrix

__all__ = ["Cantilever", "Slab", "random_density", "simp"]

VOID = 1e-3
POWER = 3
LENGTH = 2.0
WIDTH = 1.0
HEIGHT = 1.0
YOUNG = 70_000.0
POISSON = 0.3


def simp(density):
    """Return the coefficient of each element, relative to that of the full material."""
    return VOID + (1.0 - VOID) * density**POWER


def random_density(shape):
    """Return 0.5 with Gaussian noise of deviation 0.3 in single precision, within 0.05 and 0.95."""
    noise = np.random.default_rng(0).standard_normal(int(np.prod(shape))).astype(np.float32)
    values = np.clip(np.float32(0.5) + np.float32(0.3) * noise, np.float32(0.05), np.float32(0.95))
    return values.astype(float).reshape(shape[::-1]).T


def _areas(elements, width):
    """Return the share of a side that belongs to each of its nodes: half as much at the ends."""
    share = np.full(elements + 1, width / elements)
    share[[0, -1]] *= 0.5
    return share


class Slab:
    """Steady heat in a slab of one layer of cubes: cold at x = 0, a heat flux 1 in total through x = 2.

    Parameters
    ----------
    nx : int
        Elements along x. There are half as many across, and one layer of them in z.
    """

    def __init__(self, nx):
        self.shape = (nx, max(1, nx // 2), 1)
        depth = LENGTH / nx
        self.widths = (depth, WIDTH / self.shape[1], depth)
        fixed = np.zeros([n + 1 for n in self.shape], dtype=bool)
        fixed[0] = True
        self.mesh = Hexahedra(self.shape, self.widths, heat_matrix(self.widths), fixed)
        self.load = np.zeros(self.mesh.nodes)
        self.load[0, -1] = np.outer(_areas(self.shape[1], WIDTH), _areas(1, depth)) / (WIDTH * depth)

    def temperature(self, density, source=None):
        """Return the temperature at the nodes; the source is heat per volume of each element."""
        load = self.load
        if source is not None:
            share = np.prod(self.widths) / 8
            load = load + self.mesh.gather.T(np.broadcast_to(share * source, self.mesh.corners) * np.ones((8, 1, 1, 1)))
        return self.mesh.solve(simp(density), load)

    def compliance(self, density, source=None):
        """Return the work of the flux through x = 2."""
        return np.sum(self.load * self.temperature(density, source))

    def gaussian_source(self, amplitude=1.0):
        """Return a source around the middle of the slab with deviation 0.2."""
        x, y = (width * (np.arange(n) + 0.5) for width, n in zip(self.widths[:2], self.shape[:2], strict=True))
        from_middle = (x[:, None] - 0.5 * LENGTH) ** 2 + (y - 0.5 * WIDTH) ** 2
        return amplitude * np.exp(-0.5 * from_middle / 0.2**2)[:, :, None]


class Cantilever:
    """A beam that is clamped at x = 0, with a force of 1 on the face x = 2.

    Parameters
    ----------
    shape : tuple of 3 int
    at_corner : bool
        Whether the force pushes up one element at a corner of the face, instead of pulling down the whole face.
    """

    def __init__(self, shape, at_corner=False):
        self.shape = tuple(shape)
        widths = [size / n for size, n in zip((LENGTH, WIDTH, HEIGHT), shape, strict=True)]
        fixed = np.zeros([n + 1 for n in shape], dtype=bool)
        fixed[0] = True
        self.mesh = Hexahedra(shape, widths, elasticity_matrix(widths, POISSON), fixed)
        self.load = np.zeros(self.mesh.nodes)
        if at_corner:
            self.load[2, -1, :2, :2] = 0.25
        else:
            self.load[2, -1] = -np.outer(_areas(shape[1], WIDTH), _areas(shape[2], HEIGHT)) / (WIDTH * HEIGHT)

    def displacement(self, density):
        """Return the displacement of the nodes, times Young's modulus of the full material."""
        return self.mesh.solve(simp(density), self.load)

    def compliance(self, density):
        """Return the work of the force."""
        return np.sum(self.load * self.displacement(density)) / YOUNG
