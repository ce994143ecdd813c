"""Operators of Poisson's equation that the benchmarks solve: -div k grad on boxes, and what makes it hard."""

import numpy as np

import sparsedp as dp

__all__ = ["ANISOTROPIC", "JUMPS", "VARIABLE", "WINDS", "conductance", "vortex", "wind"]


def conductance(k, size=1.0, boundary=dp.dirichlet):
    """Return -div k grad for a coefficient on cells, with its harmonic averages on faces."""
    grid = dp.Grid(k.shape, size=size)
    faces = dp.diagonal(grid.faces, dp.harmonic_average(grid)(k))
    return -dp.divergence(grid) @ faces @ dp.gradient(grid, boundary)


def smooth(shape):
    """k between 0.1 and 1.9, without jumps."""
    return conductance(1 + 0.9 * np.prod([np.sin(9 * x) for x in dp.Grid(shape, size=1.0).centres()], axis=0))


def masked(shape):
    """k = 1 around nine solid balls without flux."""
    grid = dp.Grid(shape, size=1.0)
    return -dp.laplacian(grid, dp.dirichlet, solid(grid))


def inclusions(shape):
    """Twelve balls in which k is a million times larger."""
    generator, places = np.random.default_rng(1), dp.Grid(shape, size=1.0).centres()
    k = np.ones(shape)
    for _ in range(12):
        middle, radius = generator.random(len(shape)), generator.uniform(0.04, 0.1)
        k[sum((x - c) ** 2 for x, c in zip(places, middle, strict=True)) < radius**2] = 1e6
    return conductance(k)


def layers(shape):
    """One row in seven with k a million times smaller."""
    return conductance(np.where(np.arange(shape[0])[:, None] % 7, 1.0, 1e-6) * np.ones(shape))


def checkerboard(shape):
    """Eight by eight fields, k = 1 and 1e6."""
    x, y = dp.Grid(shape, size=1.0).centres()
    return conductance(np.where((np.floor(8 * x) + np.floor(8 * y)) % 2, 1e6, 1.0))


def random_decades(shape):
    """k of every cell drawn from eight decades."""
    return conductance(10.0 ** np.random.default_rng(0).uniform(-4, 4, shape))


def anisotropic(shape):
    """Along one axis k = 1, along the other 1e-6."""
    grid = dp.Grid(shape, size=1.0)
    weights = dp.diagonal(grid.faces, grid.join(1.0, 1e-6))
    return -dp.divergence(grid) @ weights @ dp.gradient(grid, dp.dirichlet)


def flat_cells(shape):
    """Cells ten thousand times as long as high."""
    return -dp.laplacian(dp.Grid(shape, size=(1.0, 1e-4)), dp.dirichlet)


def solid(grid):
    """Nine balls, in units of the lengths of the box."""
    x, y = (c / (c.flat[0] + c.flat[-1]) for c in grid.centres()[:2])
    return (x % (1 / 3) - 1 / 6) ** 2 + (y % (1 / 3) - 1 / 6) ** 2 < 0.01


def anisotropic_masked(shape):
    """As `anisotropic`, around nine solid balls: no transform takes it."""
    grid = dp.Grid(shape, size=1.0)
    weights = dp.diagonal(grid.faces, grid.join(1.0, 1e-6))
    return -dp.divergence(grid) @ weights @ dp.gradient(grid, dp.dirichlet, solid(grid))


def flat_cells_masked(shape):
    """As `flat_cells`, around nine solid balls."""
    grid = dp.Grid(shape, size=(1.0, 1e-4))
    return -dp.laplacian(grid, dp.dirichlet, solid(grid))


def clustered_masked(shape):
    """Cells from 1 to 1e5 high, around nine solid balls."""
    heights = np.geomspace(1e-5, 1.0, shape[1])
    grid = dp.Grid(shape, spacing=(1.0 / shape[0], heights / heights.sum()))
    return -dp.laplacian(grid, dp.dirichlet, solid(grid))


def wind(shape, strength=20.0):
    """Upwind advection across the box, and diffusion: not symmetric."""
    grid = dp.Grid(shape, size=1.0)
    flow = strength * (dp.upwind(grid, 0, 1, dp.dirichlet) - 0.5 * dp.upwind(grid, 1, -1, dp.dirichlet))
    return flow - dp.laplacian(grid, dp.dirichlet)


def vortex(shape, strength=20.0):
    """Upwind advection around the middle of the box, with closed stream lines, and diffusion: not symmetric."""
    grid = dp.Grid(shape, size=1.0)
    x, y = np.meshgrid(*(np.linspace(0.0, 1.0, n + 1) for n in shape), indexing="ij")
    v = strength * dp.curl(grid)((np.sin(np.pi * x) * np.sin(np.pi * y)) ** 2)
    dt = 0.1 / (strength * max(shape))
    rate = (dp.identity(grid.cells) - dp.transport(grid, "upwind").operator(v, dt)) * (1 / dt)
    return rate - dp.laplacian(grid, dp.dirichlet)


WINDS = {"wind": wind, "vortex": vortex}
VARIABLE = {"smooth k": smooth, "masks": masked}
JUMPS = {"inclusions": inclusions, "layers": layers, "checkerboard": checkerboard, "random decades": random_decades}
ANISOTROPIC = {
    "k ratio 1e-6": anisotropic,
    "cell aspect 1e4": flat_cells,
    "k ratio, masks": anisotropic_masked,
    "cell aspect, masks": flat_cells_masked,
    "clustered, masks": clustered_masked,
}
