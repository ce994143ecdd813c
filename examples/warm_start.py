r"""
How good must a first guess be?
===============================

What a good guess saves, beside what a good solver saves.

A pressure solve has to be done at every step of a flow. An iterative solver takes fewer iterations when its first guess
is close, and so networks have been trained to guess. With conjugate gradients (CG) the guess of a network saved three
quarters of the iterations (K. Um and others, *Solver-in-the-loop*, NeurIPS 2020). Here we make guesses with an error of
our choice, to see what any network could save, and put multigrid beside them, which needs no guess.

Run it: ``python examples/warm_start.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="How good must a first guess be? What it saves, beside multigrid.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The problem
# -----------
# In a closed box no flow crosses the walls. The pressure that makes a velocity :math:`v` incompressible solves
#
# .. math:: -\Delta p = -\nabla \cdot v, \qquad \frac{\partial p}{\partial n} = 0 .
#
# It is known up to a constant. `nullspace="project"` takes the constant out of the right-hand side and of the solution.

n = options.cells
grid = dp.Grid((n, n))
box = -dp.laplacian(grid)
D = dp.divergence(grid)
inside = dp.interior(grid)
mean = dp.average(grid)
along_y = dp.component(grid, 1)

# %%
# Right-hand sides are what a simulation of smoke sees: four puffs of warm air rise, and where they push there is
# divergence. Its sign makes no difference to a count of iterations.

rng = np.random.default_rng(0)


def smoke_divergence():
    """Divergence of a buoyant velocity."""
    x, y = grid.centres()
    puffs = zip(rng.uniform(0.2, 0.8, 4) * n, rng.uniform(0.1, 0.5, 4) * n, rng.uniform(2, 6, 4))
    smoke = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * radius**2)) for cx, cy, radius in puffs)
    buoyant = grid.join(0.0, along_y(mean(smoke)))
    return D(inside(buoyant))


states = [smoke_divergence() for _ in range(5)]

# %%
# Guesses with a given error
# --------------------------
# The exact pressure comes from cosine transforms (`separable`). A guess is the exact one plus an error of a given size.
# The error is smooth, as a trained network leaves it: noise, through the same solve.

exact = dp.inverse(box, "separable", nullspace="project")
solutions = [exact(b) for b in states]


def smooth_error():
    """An error that is mostly long waves, of norm 1."""
    noise = rng.standard_normal(grid.shape)
    error = exact(noise - noise.mean())
    return error / np.linalg.norm(error)


errors = [smooth_error() for _ in states]


def guesses(size):
    """Return guesses with the given relative error; None for a start from zero."""
    if size is None:
        return [None] * len(states)
    return [p + size * np.linalg.norm(p) * error for p, error in zip(solutions, errors)]


# %%
# Iterations
# ----------
# CG takes a number of iterations that grows with the square root of the condition number, here with the number of cells
# along an axis. A better guess leaves less to do but makes no iteration better: for each digit that is still missing CG
# takes about as many as before. Multigrid takes the long waves on coarse grids, where they are short.


def iterations(method, size, rtol):
    """Return the number of iterations to a relative residual, for each state."""
    inv = dp.inverse(box, method, rtol=rtol, nullspace="project")
    counts = []
    for b, guess in zip(states, guesses(size)):
        inv(b, start=guess)
        counts.append(inv.info.forward.iterations)
    return counts


methods = {
    "plain CG from zero": ("krylov", None),
    "plain CG, guess with 10 % error": ("krylov", 0.1),
    "plain CG, guess with 1 % error": ("krylov", 0.01),
    "multigrid from zero": ("multigrid", None),
    "multigrid, guess with 1 % error": ("multigrid", 0.01),
}

print("Iterations to a relative residual, mean of 5 smoke states:\n")
print("method                              1e-3   1e-6")
for label, (method, size) in methods.items():
    loose = np.mean(iterations(method, size, 1e-3))
    tight = np.mean(iterations(method, size, 1e-6))
    print(f"{label:32} {loose:7.1f} {tight:6.1f}")

# %%
# Beside what is published
# ------------------------
# There the count goes on until no entry of the residual is above 1e-3. We ask for a number of iterations instead of a
# tolerance, and try one after the other.


def largest_residual(b, count):
    """Return the largest entry of the residual after `count` iterations of CG from zero."""
    inv = dp.inverse(box, "krylov", iterations=count, nullspace="project")
    return np.max(np.abs(b - box(inv(b))))


def first_below(b, limit):
    """How many iterations of CG it takes until no entry of the residual is above the limit."""
    return next(count for count in range(1, 400) if largest_residual(b, count) <= limit)


count = np.mean([first_below(b, 1e-3) for b in states])
print(f"\nPlain CG until no residual is above 1e-3: {count:.1f}. Published, 64 x 64: 121.6, learned guess: 29.6.")

# %%
# The picture
# -----------
# Iterations against the residual that is asked for, for the first state. A guess with a tenth of the error moves a
# curve down by a digit; a good solver turns it.
#
# Exercises
# ---------
# 1. Take 128 cells. Which rows of the table double?
# 2. Make the error of the guess rough: leave the solve in `smooth_error` away. What does it do to the residual, and to
#    CG?
# 3. Count seconds: an iteration of multigrid costs several of CG. Which method is the fastest to 1e-3?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, ax = pyplot.subplots(figsize=(7.5, 4.2), layout="constrained")
    residuals = np.logspace(-1, -8, 15)
    for label, (method, size) in methods.items():
        ax.semilogy([iterations(method, size, rtol)[0] for rtol in residuals], residuals, ".-", label=label)
    ax.set(xlabel="iterations", ylabel="relative residual")
    ax.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.06, 0.0))
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "warm_start.png", dpi=120)
