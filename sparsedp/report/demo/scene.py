"""The model of the demo: pump at some wells, measure the pressure at many sensors, estimate the conductivity.

The domain is a box. The two boundaries at the ends of x are rivers (pressure 0), and there is no flow through the other
boundaries. For the conductivity k and a pump of rate 1 at a well, the steady pressure p solves

    -div(k grad p) = b,        p = 0 at the rivers,   dp/dn = 0 at the other boundaries.

In each experiment one well is pumped, and the pressure is measured at all sensors. The unknown is log k in each cell.
Lengths are in units of the longest side, pressures in units of rate / conductivity.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import autograd.numpy as np
from numpy.random import default_rng

import sparsedp as dp

__all__ = ["NOISE", "Ground", "Survey", "centres_of", "objective", "regulariser", "survey"]

RIVERS = {"x": dp.dirichlet, "y": dp.neumann}
RADIUS = 0.05  # radius of the source around a well, in units of the longest side
RTOL = 1e-10  # relative tolerance of each solve
NOISE = 0.005  # standard deviation of a measurement, relative to the root mean square over the sensors
SMOOTHNESS = 6e-4  # weight of the regularization relative to the misfit
SEED = 0  # of the noise
WELLS = (4, 3)  # number along each axis
SENSORS = (24, 20)


class Ground:
    """The forward model on one grid: the measurements of all experiments as a function of the log-conductivity."""

    def __init__(self, grid: dp.Grid, wells: np.ndarray, sensors: np.ndarray) -> None:
        self.grid = grid
        self.solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, RIVERS), rtol=RTOL)
        self.to_faces = dp.harmonic_average(grid)
        self.read = dp.sample(grid, sensors)
        self.pumps = [pump(grid, well) for well in wells]

    def readings(self, logk: Any) -> Any:
        """Return the pressures at the sensors, an array of shape (wells, sensors), for a log-conductivity on cells."""
        k = self.to_faces(np.exp(logk))
        return np.stack([self.read(self.solve(k, b)) for b in self.pumps])


def pump(grid: dp.Grid, well: np.ndarray) -> np.ndarray:
    """Return the source of a well on cells: a Gaussian of standard deviation `RADIUS`, normalized to integral 1."""
    x, y = grid.centres()
    bell = np.exp(-((x - well[0]) ** 2 + (y - well[1]) ** 2) / (2 * RADIUS**2))
    return bell / np.sum(bell * grid.volumes)


def objective(ground: Ground, data: Survey) -> Callable[[Any], Any]:
    """Return the loss: half the mean square misfit to the measurements, plus the regularization of log k."""
    roughness = regulariser(ground.grid)

    def loss(logk: Any) -> Any:
        misfit = (ground.readings(logk) - data.readings) / data.noise
        return 0.5 * np.mean(misfit**2) + roughness(logk)

    return loss


def regulariser(grid: dp.Grid) -> Callable[[Any], Any]:
    """Return the regularization as a function of log k: SMOOTHNESS / 2 times the integral of |grad log k|^2."""
    roughness = dp.smoothness(grid)
    return lambda logk: SMOOTHNESS * roughness(logk)


class Survey(NamedTuple):
    """The data of the inverse problem: positions of wells and sensors, and the measured pressures.

    `readings` has shape (wells, sensors). `noise` is the standard deviation of the noise in each experiment.
    """

    wells: np.ndarray
    sensors: np.ndarray
    readings: np.ndarray
    noise: np.ndarray


def survey(grid: dp.Grid, logk: np.ndarray) -> Survey:
    """Generate synthetic measurements, with noise, from a known log-conductivity.

    The grid is finer than the grids on which the inverse problem is solved, so that data and model differ.
    """
    wells = centres_of(dp.Grid(WELLS, size=grid.size))
    sensors = centres_of(dp.Grid(SENSORS, size=grid.size))
    exact = Ground(grid, wells, sensors).readings(logk)
    noise = NOISE * np.sqrt(np.mean(exact**2, axis=1, keepdims=True))
    # Uniform random numbers with standard deviation 1. `random` gives the same numbers in all versions of NumPy.
    errors = np.sqrt(12) * (default_rng(SEED).random(exact.shape) - 0.5)
    return Survey(wells, sensors, exact + noise * errors, noise)


def centres_of(grid: dp.Grid) -> np.ndarray:
    """Return the cell centres of a grid as an array of points, shape (m, 2)."""
    return np.stack([centres.ravel() for centres in grid.centres()], axis=1)
