"""The time that the methods of `minimize` for constraints add to the evaluations of the loss and of the constraint.

Run ``python -m benchmarks.constraints [cells]`` in the root of the repository; cells: those along an axis.

The problem is to cool a square plate best with a given amount of conductor: the unknown is the share of conductor in
each cell, from 0 to 1, and its mean is at most 0.4. Two losses have 1e5 unknowns each on the default grid:

    conductor   the mean temperature, as a function of the conductivity: each evaluation sets up a new solver
    source      the distance from a target temperature, as a function of a heat source: the solver is set up once
"""

import sys
import time

import autograd.numpy as anp
import numpy as np

import sparsedp as dp

__all__ = ["LOSSES", "limited_mean", "own_seconds"]

MEAN = 0.4


def conductor(grid):
    """Return the mean temperature as a function of the share of conductor."""
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    to_faces = dp.harmonic_average(grid)
    heat = np.ones(grid.shape)
    return lambda share: anp.mean(solve(to_faces(1e-2 + share**3), heat))


def source(grid):
    """Return the mean squared distance from a target temperature as a function of the source."""
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet))
    x, y = grid.centres()
    target = np.where((x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.1, 0.03, 0.0)
    return lambda heat: 1e4 * anp.mean((solve(heat) - target) ** 2) + 1e-4 * anp.mean(heat**2)


LOSSES = {"conductor": conductor, "source": source}


def limited_mean(share):
    """Return the constraint: the mean is at most MEAN."""
    return anp.mean(share) - MEAN


class Timed:
    """A function with its gradient, and the time spent in it."""

    def __init__(self, function):
        self._both = dp.value_and_grad(function)
        self._gradient = None
        self.seconds = 0.0
        self.evaluations = 0

    def value(self, x):
        """Return the value; the gradient is computed too."""
        begin = time.perf_counter()
        value, self._gradient = self._both(x)
        self.seconds += time.perf_counter() - begin
        self.evaluations += 1
        return value

    def gradient(self, x):
        """Return the gradient at the point of the last value."""
        return self._gradient


def own_seconds(method, loss, grid, iterations):
    """Return (seconds of an iteration without the loss, seconds of one value and gradient of the loss)."""
    timed = Timed(loss)
    start = np.full(grid.shape, 0.2)
    begin = time.perf_counter()
    best = dp.minimize(
        timed.value,
        start,
        method,
        maxiter=iterations,
        gradient=timed.gradient,
        constraints=limited_mean,
        bounds=(0.0, 1.0),
        tolerance=0,
    )
    total = time.perf_counter() - begin
    return (total - timed.seconds) / best.history[-1].iteration, timed.seconds / timed.evaluations


def main(cells):
    """Print a row for each loss and method."""
    grid = dp.Grid((cells, cells), size=1.0)
    print(f"{cells**2} unknowns    own time of an iteration   one gradient   ratio")
    for name, build in LOSSES.items():
        loss = build(grid)
        for method in ("augmented_lagrangian", "mma"):
            own_seconds(method, loss, grid, 2)  # imports and the first set-up
            own, gradient = own_seconds(method, loss, grid, 20)
            print(f"{name:10} {method:21} {1e3 * own:10.1f} ms {1e3 * gradient:13.1f} ms {own / gradient:9.2f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 316)
