r"""
From a volume to a point
========================

Topology optimization of a heat conductor: filter, projection, SIMP, a volume constraint, and the peak temperature.

A plate is heated everywhere, and cold at a small opening in the middle of its lower wall. A good conductor may fill
40 % of it. Where should it go? The best layouts are trees. We design one for the mean temperature by a loop of our own
and by ``dp.minimize`` with a constraint, and another one for the highest temperature.

Run it: ``python examples/volume_to_point.py [cells] [--out FOLDER]``; it needs NLopt (the extra `design`)

References
----------
A. Gersborg-Hansen, M. P. Bendsøe, O. Sigmund, *Topology optimization of heat conduction problems using the finite
volume method*, Struct. Multidisc. Optim. 31, 2006.
B. S. Lazarov, O. Sigmund, *Filters in topology optimization based on Helmholtz-type differential equations*, Int. J.
Numer. Meth. Eng. 86, 2011.
F. Wang, B. S. Lazarov, O. Sigmund, *On projection methods, convergence and robust formulations in topology
optimization*, Struct. Multidisc. Optim. 43, 2011.
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Topology optimization of a heat conductor.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

SHARE = 0.4  # of the area that may be filled with the good conductor
POOR_CONDUCTIVITY = 1e-3  # of the remaining material; the good conductor has 1
POWER = 3.0  # the penalty of intermediate densities
RADIUS = 0.05  # of the filter, in a plate of size 1
STEEPNESS = (1.0, 2.0, 4.0, 8.0, 16.0)  # of the projection, one stage of the search after the other
ITERATIONS = 60  # of each stage
EXPONENT = 16.0  # of the norm that stands for the highest temperature

# %%
# The heat
# --------
# With the conductivity :math:`k` the temperature :math:`T` solves
#
# .. math:: -\nabla \cdot (k \, \nabla T) = 1, \qquad T = 0 \text{ at the opening},
#
# and no heat crosses the other walls. A face between two cells has the harmonic average of both conductivities: heat
# has to pass through both halves.

n = options.cells
grid = dp.Grid((n, n), size=1.0)
opening = dp.patch((0.4, 0.6), dp.dirichlet, elsewhere=dp.neumann)
slopes = dp.gradient(grid, {"y": (opening, dp.neumann)})
solve = dp.elliptic_solver(dp.divergence(grid), slopes)
to_faces = dp.harmonic_average(grid)
heat = np.ones(grid.shape)


def temperature(k):
    """Return the temperature of each cell for the conductivity of each cell."""
    return solve(to_faces(k), heat)


# %%
# From unknowns to a conductivity
# -------------------------------
# The unknown :math:`z`, one number between 0 and 1 for each cell, goes through three functions.
#
# 1. The **filter** is one solve of :math:`(1 - r^2 \, \Delta) \, s = z` with closed walls, where :math:`r` is the
#    radius divided by :math:`2 \sqrt 3`. It gives the layout a smallest width. Without it, finer grids would have ever
#    finer branches. On a box a cosine transform solves it.
# 2. The **projection** pushes the filtered field to 0 and 1. Its steepness :math:`\beta` grows from stage to stage:
#
#    .. math:: \rho = \frac{\tanh(\beta / 2) + \tanh(\beta \, (s - 1/2))}{2 \, \tanh(\beta / 2)} .
#
# 3. The **SIMP** law :math:`k = k_{min} + \rho^3 \, (1 - k_{min})` makes intermediate densities poor conductors for
#    the area that they take.

soften = dp.inverse(dp.identity(grid.cells) - (RADIUS / (2 * np.sqrt(3))) ** 2 * dp.laplacian(grid))


def project(s, steepness, threshold=0.5):
    """Return values nearer to 0 and 1; 0 and 1 stay."""
    low = np.tanh(steepness * threshold)
    high = np.tanh(steepness * (1.0 - threshold))
    return (low + np.tanh(steepness * (s - threshold))) / (low + high)


def simp(density):
    """Return the conductivity of each cell."""
    return POOR_CONDUCTIVITY + (1.0 - POOR_CONDUCTIVITY) * density**POWER


def norm(field, exponent):
    """Return the mean of field**exponent, to the power of 1 / exponent, without overflow; field >= 0."""
    largest = np.max(field)
    return largest * np.mean((field / largest) ** exponent) ** (1.0 / exponent)


def volume(z, steepness):
    """Return the share of the plate that the conductor fills."""
    return np.mean(project(soften(z), steepness))


def mean_temperature(z, steepness):
    """Return the compliance: the mean of heat times temperature."""
    density = project(soften(z), steepness)
    return np.mean(heat * temperature(simp(density)))


def peak_temperature(z, steepness):
    """Return a smooth stand-in for the highest temperature."""
    density = project(soften(z), steepness)
    return norm(temperature(simp(density)), EXPONENT)


# %%
# Every part has an exact derivative, and so has the chain. We check it at a random point before we search.

random = np.random.default_rng(0).uniform(0.2, 0.8, grid.shape)
for loss in (volume, mean_temperature, peak_temperature):
    verdict = dp.check.gradient(lambda z, loss=loss: loss(z, 4.0), random, quick=True).verdict
    print(f"derivative of {loss.__name__} against finite differences: {verdict}")

_, _ = dp.value_and_grad(lambda z: mean_temperature(z, 4.0))(0.99 * random)
log = solve.info
print(f"set-up {log.setup_seconds:.4f} s, {log.forward.seconds:.4f} s forward, {log.adjoint.seconds:.4f} s adjoint\n")

# %%
# A loop of our own
# -----------------
# **Optimality criteria** are the classical method for one volume constraint. Where a cell is neither full nor empty,
# the slope of the loss must be :math:`-\lambda` times the slope of the volume. Each unknown is multiplied by the square
# root of the ratio of both, and bisection finds the :math:`\lambda` for which the volume is right. The method needs a
# loss that falls in every unknown, as the compliance does.


def optimality_criteria(z, steepness, iterations, move):
    """Return the unknowns after some iterations; none of them changes by more than `move` in one."""
    slope_of_loss = dp.grad(lambda z: mean_temperature(z, steepness))
    slope_of_volume = dp.grad(lambda z: volume(z, steepness))
    for _ in range(iterations):
        ratio = np.sqrt(-slope_of_loss(z) / slope_of_volume(z))
        lowest = np.maximum(z - move, 0.0)
        highest = np.minimum(z + move, 1.0)
        lower, upper = 1e-9, 1e9
        while upper > (1.0 + 1e-6) * lower:
            multiplier = np.sqrt(lower * upper)
            new = np.clip(z * ratio / np.sqrt(multiplier), lowest, highest)
            if volume(new, steepness) > SHARE:
                lower = multiplier
            else:
                upper = multiplier
        z = new
    return z


# %%
# A search with a constraint
# --------------------------
# `minimize` takes any loss and any constraint. A constraint is a function that is at most 0 where a design is allowed.
# The method of moving asymptotes (``"mma"``) replaces loss and constraint by convex functions around each point, and is
# the usual method for designs.


def moving_asymptotes(loss):
    """Return a search for one stage."""

    def search(z, steepness):
        best = dp.minimize(
            lambda z: loss(z, steepness),
            z,
            "mma",
            constraints=lambda z: volume(z, steepness) - SHARE,
            bounds=(0.0, 1.0),
            maxiter=ITERATIONS,
        )
        return best.x

    return search


# %%
# Why in stages? Where the projection is steep, its slope is nearly 0 almost everywhere, so that a search from the even
# design sees little. The stages begin with a projection that is nearly linear. When the steepness grows, the volume of
# the same unknowns changes, and the search starts a little outside the constraint. ``grey`` is 0 if every cell is full
# or empty, and 1 if the density is 1/2 everywhere.


def figures(z, steepness):
    """Return share, mean and highest temperature, and how grey the design is."""
    density = project(soften(z), steepness)
    T = temperature(simp(density))
    return np.mean(density), np.mean(T), np.max(T), np.mean(4.0 * density * (1.0 - density))


designs = {}


def run(label, search):
    """Search in stages, and print a row for each."""
    z = np.full(grid.shape, SHARE)
    began = perf_counter()
    for steepness in STEEPNESS:
        z = search(z, steepness)
        share, mean, peak, grey = figures(z, steepness)
        seconds = perf_counter() - began
        print(f"{label:38}{steepness:9.0f}{share:8.4f}{mean:8.3f}{peak:8.3f}{grey:6.2f}{seconds:9.1f}")
    designs[label] = project(soften(z), STEEPNESS[-1])


print(f"{'':38}steepness  volume    mean    peak  grey  seconds")
run("mean, optimality criteria", lambda z, steepness: optimality_criteria(z, steepness, ITERATIONS, move=0.02))
run("mean, moving asymptotes", moving_asymptotes(mean_temperature))
run("peak, moving asymptotes", moving_asymptotes(peak_temperature))

# %%
# The picture
# -----------
# Heat is collected by thin branches, and carried to the opening by thick ones. The design for the highest temperature
# cools the far corners better, and the rest worse.
#
# Exercises
# ---------
# 1. Search with ``STEEPNESS = (16.0,)`` and as many iterations in all. How much is lost?
# 2. Set ``move=0.2`` in the loop of our own. What happens from the third stage on?
# 3. Ask for the smallest volume with a mean temperature of at most 2: loss and constraint change their places.

if options.out:
    from matplotlib import pyplot

    picture, places = pyplot.subplots(1, len(designs), figsize=(12, 4), layout="constrained")
    for ax, (title, density) in zip(places, designs.items()):
        dp.plot(grid, density, ax=ax, title=title, limits=(0.0, 1.0), label="density")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "volume_to_point.png", dpi=120)
