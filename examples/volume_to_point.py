r"""
From a volume to a point
========================

Topology optimization of a heat conductor: filter, projection, SIMP, a volume constraint, and the peak temperature.

A plate is heated everywhere, and cold at a small opening in the middle of its lower wall. A good conductor may fill
40 % of it. Where should it be? The best layouts are trees. We design one for the mean temperature, by optimality
criteria and by ``dp.minimize`` with a constraint, and another one for the highest temperature.

Run it: ``python examples/volume_to_point.py [cells] [--out FOLDER]``; it needs NLopt (the extra `design`)

References
----------
A. Gersborg-Hansen, M. P. Bendsøe, O. Sigmund, *Topology optimization of heat conduction problems using the finite
volume method*, Struct. Multidisc. Optim. 31, 2006.
B. S. Lazarov, O. Sigmund, *Filters in topology optimization based on Helmholtz-type differential equations*, Int. J.
Numer. Meth. Eng. 86, 2011.
F. Wang, B. S. Lazarov, O. Sigmund, *On projection methods, convergence and robust formulations in topology
optimization*, Struct. Multidisc. Optim. 43, 2011.
O. Sigmund, *Morphology-based black and white filters for topology optimization*, Struct. Multidisc. Optim. 33, 2007:
the measure of non-discreteness.
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

VOLUME_FRACTION = 0.4  # the largest one of the good conductor
POOR_CONDUCTIVITY = 1e-3  # of the remaining material; the good conductor has 1
PENALIZATION = 3.0  # the exponent of SIMP, which penalizes intermediate densities
RADIUS = 0.05  # of the filter, in a plate of size 1
STEEPNESS = (1.0, 2.0, 4.0, 8.0, 16.0)  # of the projection, one for each stage (continuation)
ITERATIONS = 60  # of each stage
EXPONENT = 16.0  # of the p-norm that approximates the highest temperature

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
#    radius divided by :math:`2 \sqrt 3` (a Helmholtz filter). It gives the layout a smallest width. Without it, finer
#    grids would have ever finer branches. On a box a cosine transform solves it.
# 2. The **projection** moves the filtered field towards 0 and 1. Its steepness :math:`\beta` grows from stage to stage:
#
#    .. math:: \rho = \frac{\tanh(\beta / 2) + \tanh(\beta \, (s - 1/2))}{2 \, \tanh(\beta / 2)} .
#
# 3. The **SIMP** law :math:`k = k_{min} + \rho^3 \, (1 - k_{min})` (solid isotropic material with penalization) makes
#    intermediate densities poor conductors for the area that they take.

smooth = dp.inverse(dp.identity(grid.cells) - (RADIUS / (2 * np.sqrt(3))) ** 2 * dp.laplacian(grid))


def project(s, steepness, threshold=0.5):
    """Return values nearer to 0 and 1 (a smooth Heaviside function); 0 and 1 do not change."""
    below = np.tanh(steepness * threshold)
    above = np.tanh(steepness * (1.0 - threshold))
    return (below + np.tanh(steepness * (s - threshold))) / (below + above)


def simp(density):
    """Return the conductivity of each cell."""
    return POOR_CONDUCTIVITY + (1.0 - POOR_CONDUCTIVITY) * density**PENALIZATION


def p_norm(field, exponent):
    """Return mean(field**exponent) ** (1 / exponent) without overflow; field >= 0."""
    largest = np.max(field)
    return largest * np.mean((field / largest) ** exponent) ** (1.0 / exponent)


def volume(z, steepness):
    """Return the volume fraction of the conductor."""
    return np.mean(project(smooth(z), steepness))


def mean_temperature(z, steepness):
    """Return the compliance: the mean of heat times temperature."""
    density = project(smooth(z), steepness)
    return np.mean(heat * temperature(simp(density)))


def peak_temperature(z, steepness):
    """Return a smooth approximation of the highest temperature."""
    density = project(smooth(z), steepness)
    return p_norm(temperature(simp(density)), EXPONENT)


# %%
# Every part has an exact derivative, and so has the chain. We check it at a random point before we search.

random_unknowns = np.random.default_rng(0).uniform(0.2, 0.8, grid.shape)
for loss in (volume, mean_temperature, peak_temperature):
    verdict = dp.check.gradient(lambda z, loss=loss: loss(z, 4.0), random_unknowns, quick=True).verdict
    print(f"derivative of {loss.__name__} against finite differences: {verdict}")

# %%
# What does a gradient cost? The adjoint solve uses the set-up of the forward solve.

dp.grad(lambda z: mean_temperature(z, 4.0))(0.99 * random_unknowns)
log = solve.info
print(f"set-up {log.setup_seconds:.4f} s, {log.forward.seconds:.4f} s forward, {log.adjoint.seconds:.4f} s adjoint\n")

# %%
# Optimality criteria
# -------------------
# This is the classical method for one volume constraint. At the optimum, where a cell is neither full nor empty, the
# derivative of the loss is :math:`-\lambda` times that of the volume, with the Lagrange multiplier :math:`\lambda`.
# Each unknown is multiplied by the square root of the ratio of both sides, and bisection finds the :math:`\lambda` for
# which the volume is right. The method needs a loss that decreases in every unknown, as the compliance does.


def optimality_criteria(z, steepness, iterations, move):
    """Return the unknowns after some iterations; `move` is the largest change of an unknown in one (move limit)."""
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
            if volume(new, steepness) > VOLUME_FRACTION:
                lower = multiplier
            else:
                upper = multiplier
        z = new
    return z


# %%
# A search with a constraint
# --------------------------
# `minimize` takes any loss and any constraint. A constraint is a function that is <= 0 at a feasible design.
# The method of moving asymptotes (``"mma"``) replaces loss and constraint by convex functions around each point, and is
# the usual method for designs.


def moving_asymptotes(loss):
    """Return a search for one stage."""

    def search(z, steepness):
        best = dp.minimize(
            lambda z: loss(z, steepness),
            z,
            "mma",
            constraints=lambda z: volume(z, steepness) - VOLUME_FRACTION,
            bounds=(0.0, 1.0),
            maxiter=ITERATIONS,
        )
        return best.x

    return search


# %%
# Why in stages? The derivative of a steep projection is nearly 0 almost everywhere, so that a search from the uniform
# design makes little progress. The stages begin with a projection that is nearly linear. When the steepness grows, the
# volume of the same unknowns changes, and the next search starts at a point that violates the constraint a little.
# ``grey`` is the measure of non-discreteness: 0 if every cell is full or empty, 1 if the density is 1/2 everywhere.


def figures(z, steepness):
    """Return the volume fraction, the mean and the highest temperature, and the measure of non-discreteness."""
    density = project(smooth(z), steepness)
    T = temperature(simp(density))
    return np.mean(density), np.mean(T), np.max(T), np.mean(4.0 * density * (1.0 - density))


designs = {}


def run(label, search):
    """Search in stages, and print a row for each."""
    z = np.full(grid.shape, VOLUME_FRACTION)
    start = perf_counter()
    for steepness in STEEPNESS:
        z = search(z, steepness)
        fraction, mean, peak, grey = figures(z, steepness)
        seconds = perf_counter() - start
        print(f"{label:38}{steepness:9.0f}{fraction:8.4f}{mean:8.3f}{peak:8.3f}{grey:6.2f}{seconds:9.1f}")
    designs[label] = project(smooth(z), STEEPNESS[-1])


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
# 1. Search with ``STEEPNESS = (16.0,)`` and 300 iterations. How much higher is the mean temperature?
# 2. Set ``move=0.2`` in the optimality criteria. What happens from the third stage on?
# 3. Search for the smallest volume with a mean temperature of at most 2: exchange loss and constraint.

if options.out:
    from matplotlib import pyplot

    picture, axes = pyplot.subplots(1, len(designs), figsize=(12, 4), layout="constrained")
    for ax, (title, density) in zip(axes, designs.items()):
        dp.plot(grid, density, ax=ax, title=title, limits=(0.0, 1.0), label="density")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "volume_to_point.png", dpi=120)
