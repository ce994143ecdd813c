"""The physics of the demo: pump at some wells, read the pressure at many sensors, ask for the ground.

The ground is a box. Its sides across x are rivers (pressure 0), the other sides are tight. With the
conductivity k and a pump of rate 1 at a well, the pressure p that sets in solves

    -div(k grad p) = b,        p = 0 at the rivers,   dp/dn = 0 at the tight sides.

Every well is pumped in turn, and each time all sensors are read. Unknown is log k, one number for
each cell. Lengths are in units of the longest side, pressures in rate / conductivity.
"""

from typing import NamedTuple

import autograd.numpy as np
from numpy.random import default_rng

import sparsedp as dp

__all__ = ["NOISE", "Ground", "Survey", "centres_of", "objective", "regulariser", "survey"]

RIVERS = {"x": dp.dirichlet, "y": dp.neumann}
RADIUS = 0.05  # of the gravel pack around a well [longest side]
RTOL = 1e-10  # of every solve, on its true residual
NOISE = 0.005  # of a reading, relative to the mean square over the sensors
SMOOTHNESS = 6e-4  # weight of the regulariser, against misfit / noise
SEED = 0  # of the noise
WELLS, SENSORS = (4, 3), (24, 20)


class Ground:
    """The forward model on one grid: log-conductivity -> readings of all experiments."""

    def __init__(self, grid, wells, sensors):
        self.grid = grid
        self.solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, RIVERS), rtol=RTOL)
        self.to_faces = dp.harmonic_average(grid)
        self.read = dp.sample(grid, sensors)
        self.pumps = [pump(grid, well) for well in wells]

    def readings(self, logk):
        """Log-conductivity on cells -> pressure at the sensors, shape (wells, sensors)."""
        k = self.to_faces(np.exp(logk))
        return np.stack([self.read(self.solve(k, b)) for b in self.pumps])


def pump(grid, well):
    """Place -> source on cells: a bell of width `RADIUS` whose integral is 1, on every grid."""
    x, y = grid.centres()
    bell = np.exp(-((x - well[0]) ** 2 + (y - well[1]) ** 2) / (2 * RADIUS**2))
    return bell / np.sum(bell * grid.volumes)


def objective(ground, data):
    """Ground and what was read -> the loss: half the mean square misfit, plus the roughness of log k."""
    roughness = regulariser(ground.grid)

    def loss(logk):
        misfit = (ground.readings(logk) - data.readings) / data.noise
        return 0.5 * np.mean(misfit**2) + roughness(logk)

    return loss


def regulariser(grid):
    """Grid -> the roughness of log k: SMOOTHNESS times half the integral of its squared slope."""
    roughness = dp.smoothness(grid)
    return lambda logk: SMOOTHNESS * roughness(logk)


class Survey(NamedTuple):
    """What is known about the ground: where the wells and sensors are, and what was read.

    `readings` has the shape (wells, sensors); `noise` is the standard deviation in each experiment.
    """

    wells: np.ndarray
    sensors: np.ndarray
    readings: np.ndarray
    noise: np.ndarray


def survey(grid, logk):
    """Hidden ground -> Survey. It is made on a grid of its own, finer than those that invert it."""
    wells, sensors = (centres_of(dp.Grid(counts, size=grid.size)) for counts in (WELLS, SENSORS))
    exact = Ground(grid, wells, sensors).readings(logk)
    noise = NOISE * np.sqrt(np.mean(exact**2, axis=1, keepdims=True))
    # Uniform numbers of standard deviation 1: their stream is the same with every version of NumPy.
    return Survey(wells, sensors, exact + noise * (np.sqrt(12) * (default_rng(SEED).random(exact.shape) - 0.5)), noise)


def centres_of(grid):
    """The centres of the cells of a grid as points, shape (m, 2)."""
    return np.stack([centres.ravel() for centres in grid.centres()], axis=1)
