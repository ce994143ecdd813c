"""The physics of the demo: pump at some wells, read the pressure at many sensors, find the ground.

The ground is a box. Its sides across x are rivers (pressure 0), the other sides are tight. With the
conductivity k and a pump of rate 1 at a well, the pressure p that sets in solves

    -div(k grad p) = b,        p = 0 at the rivers,   dp/dn = 0 at the tight sides.

Every well is pumped in turn, and each time all sensors are read. Unknown is log k, one number for
each cell. Lengths are in units of the longest side, pressures in rate / conductivity.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

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
WELLS = (4, 3)  # along the axes
SENSORS = (24, 20)


class Ground:
    """The forward model on one grid: the readings of all experiments as a function of log-conductivity."""

    def __init__(self, grid: dp.Grid, wells: np.ndarray, sensors: np.ndarray) -> None:
        self.grid = grid
        self.solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, RIVERS), rtol=RTOL)
        self.to_faces = dp.harmonic_average(grid)
        self.read = dp.sample(grid, sensors)
        self.pumps = [pump(grid, well) for well in wells]

    def readings(self, logk: Any) -> Any:
        """Return the pressure at the sensors, shape (wells, sensors), for a log-conductivity on cells."""
        k = self.to_faces(np.exp(logk))
        return np.stack([self.read(self.solve(k, b)) for b in self.pumps])


def pump(grid: dp.Grid, well: np.ndarray) -> np.ndarray:
    """Return the source of a well on cells: a bell of width `RADIUS` whose integral is 1, on every grid."""
    x, y = grid.centres()
    bell = np.exp(-((x - well[0]) ** 2 + (y - well[1]) ** 2) / (2 * RADIUS**2))
    return bell / np.sum(bell * grid.volumes)


def objective(ground: Ground, data: Survey) -> Callable[[Any], Any]:
    """Return the loss: half the mean square misfit to the readings, plus the roughness of log k."""
    roughness = regulariser(ground.grid)

    def loss(logk: Any) -> Any:
        misfit = (ground.readings(logk) - data.readings) / data.noise
        return 0.5 * np.mean(misfit**2) + roughness(logk)

    return loss


def regulariser(grid: dp.Grid) -> Callable[[Any], Any]:
    """Return the roughness of log k: SMOOTHNESS times half the integral of its squared slope."""
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


def survey(grid: dp.Grid, logk: np.ndarray) -> Survey:
    """Return the survey of a hidden ground, on a grid of its own, finer than those that invert it."""
    wells = centres_of(dp.Grid(WELLS, size=grid.size))
    sensors = centres_of(dp.Grid(SENSORS, size=grid.size))
    exact = Ground(grid, wells, sensors).readings(logk)
    noise = NOISE * np.sqrt(np.mean(exact**2, axis=1, keepdims=True))
    # Uniform numbers of standard deviation 1: their stream is the same with every version of NumPy.
    errors = np.sqrt(12) * (default_rng(SEED).random(exact.shape) - 0.5)
    return Survey(wells, sensors, exact + noise * errors, noise)


def centres_of(grid: dp.Grid) -> np.ndarray:
    """Return the centres of the cells of a grid as points, shape (m, 2)."""
    return np.stack([centres.ravel() for centres in grid.centres()], axis=1)
