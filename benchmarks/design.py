"""Topology design of a heat conductor by every constrained method, beside optimality criteria written by hand.

Run ``python -m benchmarks.design [cells ...] [--gradients N]`` in the root of the repository; 16, 64 and 256 cells an
axis by default. The scene is that of examples/volume_to_point.py: a plate heated everywhere, cold at an opening, 40 %
filled, with the same filter (radius 0.05) and the same penalty (SIMP, exponent 3) for all methods.

- First table: filter and penalty without projection; each method may use N gradients of the loss (200 by default).
- Second table: five stages of projection with steepness 1 to 16, N / 5 gradients each. Optimality criteria need a
  small move there: with 0.2 they oscillate. The augmented Lagrangian is shown with the multipliers 0 at the begin of
  each stage, and with those of the stage before.

A row: compliance (the mean temperature), volume fraction, the measure of non-discreteness `grey` (0: full and empty
cells only), gradients of the loss, and seconds. SLSQP forms dense matrices: it runs up to 16^2 cells.
Seconds are of the processor, on one thread.
"""

import argparse
from functools import partial
from time import process_time

import autograd.numpy as np

import sparsedp as dp

VOLUME_FRACTION = 0.4
POOR_CONDUCTIVITY = 1e-3
RADIUS = 0.05
STEEPNESS = (1.0, 2.0, 4.0, 8.0, 16.0)
LARGEST_FOR_SLSQP = 16


class Plate:
    """The unit square with n x n cells."""

    def __init__(self, n):
        self.grid = grid = dp.Grid((n, n), size=1.0)
        opening = dp.patch((0.4, 0.6), dp.dirichlet, elsewhere=dp.neumann)
        slopes = dp.gradient(grid, {"y": (opening, dp.neumann)})
        self.solve = dp.elliptic_solver(dp.divergence(grid), slopes)
        self.to_faces = dp.harmonic_average(grid)
        self.smooth = dp.inverse(dp.identity(grid.cells) - RADIUS**2 / 12 * dp.laplacian(grid))
        self.heat = np.ones(grid.shape)
        self.uniform = np.full(grid.shape, VOLUME_FRACTION)

    def density(self, z, steepness):
        """Return the filtered and, unless the steepness is None, projected unknowns."""
        s = self.smooth(z)
        if steepness is None:
            return s
        edge = np.tanh(0.5 * steepness)
        return 0.5 + np.tanh(steepness * (s - 0.5)) / (2.0 * edge)

    def compliance(self, z, steepness):
        """Return the mean temperature."""
        k = POOR_CONDUCTIVITY + (1.0 - POOR_CONDUCTIVITY) * self.density(z, steepness) ** 3
        return np.mean(self.heat * self.solve(self.to_faces(k), self.heat))

    def volume(self, z, steepness):
        """Return the volume fraction."""
        return np.mean(self.density(z, steepness))


def optimality_criteria(plate, z, steepness, gradients, multipliers, move):
    """Return the unknowns after the given number of updates, this number, and None for the multipliers."""
    slope_of_loss = dp.grad(lambda z: plate.compliance(z, steepness))
    slope_of_volume = dp.grad(lambda z: plate.volume(z, steepness))
    for _ in range(gradients):
        ratio = np.sqrt(np.maximum(-slope_of_loss(z), 0.0) / slope_of_volume(z))
        lowest, highest = np.maximum(z - move, 0.0), np.minimum(z + move, 1.0)
        lower, upper = 1e-9, 1e9
        while upper > (1.0 + 1e-6) * lower:
            multiplier = np.sqrt(lower * upper)
            new = np.clip(z * ratio / np.sqrt(multiplier), lowest, highest)
            if plate.volume(new, steepness) > VOLUME_FRACTION:
                lower = multiplier
            else:
                upper = multiplier
        z = new
    return z, gradients, None


def by_minimize(plate, z, steepness, gradients, multipliers, method, continues=False, **settings):
    """Return the unknowns that a method of `minimize` finds, the number of gradients, and the multipliers.

    If the method continues, it begins with the multipliers of the stage before.
    """
    if continues:
        settings["multipliers"] = multipliers
    best = dp.minimize(
        lambda z: plate.compliance(z, steepness),
        z,
        method,
        constraints=lambda z: plate.volume(z, steepness) - VOLUME_FRACTION,
        bounds=(0.0, 1.0),
        maxiter=gradients,
        callback=lambda record, x: record.evaluations >= gradients,
        **settings,
    )
    return best.x, best.evaluations, best.multipliers


def searches(n, in_stages):
    """Return the methods that run on this grid, with their settings."""
    found = {
        "mma": {"method": "mma"},
        "augmented_lagrangian": {"method": "augmented_lagrangian"},
        "the same, penalty 0.01": {"method": "augmented_lagrangian", "penalty": 0.01},
    }
    if in_stages:
        found["the same, continued"] = {"method": "augmented_lagrangian", "continues": True}
    if n <= LARGEST_FOR_SLSQP:
        found["slsqp"] = {"method": "slsqp"}
    return found


def row(n, label, stages, gradients, search):
    """Run the stages of one method, and print a row."""
    plate = Plate(n)
    z = plate.uniform
    dp.value_and_grad(lambda z: plate.compliance(z, stages[0]))(z)  # compiling is no part of a search
    used = 0
    multipliers = None
    began = process_time()
    for steepness in stages:
        z, evaluations, multipliers = search(plate, z, steepness, gradients // len(stages), multipliers)
        used += evaluations
    seconds = process_time() - began
    density = plate.density(z, stages[-1])
    grey = np.mean(4.0 * density * (1.0 - density))
    c = plate.compliance(z, stages[-1])
    print(f"{n:5}^2  {label:22}{c:10.4f}{np.mean(density):9.5f}{grey:7.3f}{used:11}{seconds:9.1f}", flush=True)


def table(cells, title, stages, gradients, move):
    """Print the rows of all methods on all grids."""
    print(f"\n{title}\n  cells  {'method':22}compliance   volume   grey  gradients  seconds")
    for n in cells:
        row(n, "optimality criteria", stages, gradients, partial(optimality_criteria, move=move))
        for label, settings in searches(n, len(stages) > 1).items():
            row(n, label, stages, gradients, partial(by_minimize, **settings))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cells", nargs="*", type=int, default=[16, 64, 256])
    parser.add_argument("--gradients", type=int, default=200)
    given = parser.parse_args()
    dp.set_threads(1)
    table(given.cells, "filter and penalty", (None,), given.gradients, move=0.2)
    table(given.cells, "filter, penalty and projection in stages", STEEPNESS, given.gradients, move=0.02)


if __name__ == "__main__":
    main()
