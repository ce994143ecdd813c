r"""
A first guess for CG, learned with and without the solver
=========================================================

A network guesses the pressure, and conjugate gradients (CG) go on from there.

The example `warm_start.py` says what a first guess can save; here a network learns one. It is trained on the guess
itself, or on what CG makes of it: the iterations are part of the loss then, and the gradient goes back through all of
them. Does the network leave to the solver what the solver does well? Beside it stands what multigrid takes from zero.
The idea: K. Um, R. Brand, Y. Fei, P. Holl, N. Thuerey, "Solver-in-the-loop", NeurIPS 2020.

Run it: ``python examples/warm_start_learned.py [cells] [--out FOLDER]``; cells: a multiple of 8
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp
from sparsedp import network

parser = argparse.ArgumentParser(description="A first guess for CG, learned with and without the solver.")
parser.add_argument("cells", nargs="?", type=int, default=32, help="cells along an axis, a multiple of 8")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The problem
# -----------
# It is the pressure of a closed box, :math:`A x = b` with :math:`A = -\Delta`, for right-hand sides of a smoke
# simulation. All of them are scaled to a mean square of 1. 64 states are for training, 8 for judging.

n = options.cells
rng = np.random.default_rng(0)
grid = dp.Grid((n, n))
box = -dp.laplacian(grid)
D = dp.divergence(grid)
inside = dp.interior(grid)
mean = dp.average(grid)
along_y = dp.component(grid, 1)


def smoke_divergence():
    """Divergence of a buoyant velocity, scaled."""
    x, y = grid.centres()
    puffs = zip(rng.uniform(0.2, 0.8, 4) * n, rng.uniform(0.1, 0.5, 4) * n, rng.uniform(0.03, 0.1, 4) * n)
    smoke = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * radius**2)) for cx, cy, radius in puffs)
    buoyant = grid.join(0.0, along_y(mean(smoke)))
    b = D(inside(buoyant))
    return b / np.sqrt(np.mean(b**2))


# %%
# The solvers
# -----------
# For training: a fixed number of iterations of CG, unrolled, so that the tape keeps all of them. For evaluation: CG and
# multigrid until the residual is 1e-3, and a direct solve for the truth.

iterations = n // 4
unrolled = dp.inverse(box, "krylov", diff="unrolled", iterations=iterations, nullspace="project")
cg = dp.inverse(box, "krylov", rtol=1e-3, nullspace="project")
multigrid = dp.inverse(box, "multigrid", rtol=1e-3, nullspace="project")
direct = dp.inverse(box, "direct", nullspace="project")

# %%
# The network
# -----------
# What is long and what is short are told apart. A dense layer maps the means of 8 x 8 blocks of :math:`b` to 8 x 8
# values, which are interpolated: that is a small inverse for the long waves. Two convolutions look at the neighbourhood
# of a cell. All weights of the last layers are 0 at first, and so is the guess.

side = n // 8  # of a block, in cells
interpolation = dp.prolong(grid, side, "linear").matrix.toarray().T

untrained = {
    "far": network.dense_weights(rng, 64, 64, 0.0),
    "first": network.convolution_weights(rng, 1, 8, (5, 5)),
    "second": network.convolution_weights(rng, 8, 1, (5, 5), 0.0),
}
training = np.stack([smoke_divergence() for _ in range(64)])
unseen = np.stack([smoke_divergence() for _ in range(8)])


def guess(w, b):
    """Return an initial guess for each right-hand side of a batch."""
    blocks = b.reshape(-1, 8, side, 8, side).mean((2, 4)).reshape(-1, 64)
    far = np.reshape(network.dense(w["far"], blocks) @ interpolation, b.shape)
    hidden = network.tanh(network.convolution(w["first"], b[:, None], "replicate"))
    near = network.convolution(w["second"], hidden, "replicate")[:, 0]
    return far + near


# %%
# The loss
# --------
# The solution of :math:`A x = b` is where the energy is least, and CG is the method that makes it small:
#
# .. math:: E(x) = \tfrac{1}{2} \, x^T A x - b^T x = E(x^*) + \tfrac{1}{2} \, (x - x^*)^T A \, (x - x^*) .
#
# So the energy can be the loss, and training needs no exact solution. It is taken before the iterations
# of CG or after them.


def energy(x, b):
    """Return the energy, which CG minimizes."""
    return np.sum(x * (0.5 * box(x) - b))


def loss_of_guess(w, batch):
    """Energy of the guesses."""
    return sum(energy(x, b) for b, x in zip(batch, guess(w, batch)))


def loss_through_cg(w, batch):
    """Energy after some iterations of CG from the guesses."""
    return sum(energy(unrolled(b, start=x), b) for b, x in zip(batch, guess(w, batch)))


# %%
# Training
# --------
# First on the guess alone, from scratch; then on with a smaller rate, either as before or through CG. The last two
# start from the same weights and see the same batches, so that only the loss differs.

batches = [training[i : i + 2] for i in range(0, 64, 2)]


def train(loss, w, rate, steps=10 * n):
    """Return the weights after the given number of steps of Adam, and the run time in seconds."""
    best = dp.minimize(loss, w, "adam", steps, 0, rate=rate, batches=batches)
    return best.x, best.history[-1].seconds


# %%
# How good are they?
# ------------------
# After a fixed number of iterations, the residual and the error in the norm of :math:`A`, both relative: :math:`E(x^*)
# = -\frac{1}{2} x^{*T} A x^*`, so the squared error is :math:`1 - E(x) / E(x^*)`. Then the iterations of CG and of
# multigrid from the guess to a residual of 1e-3.

solutions = [direct(b) for b in unseen]


def energy_error(x, b, solution):
    """Relative error in the norm of A."""
    return np.sqrt(max(0.0, 1 - energy(x, b) / energy(solution, b)))


def count(inv, guesses):
    """Mean number of iterations to a residual of 1e-3."""
    counts = []
    for b, x in zip(unseen, guesses):
        inv(b, start=x)
        counts.append(inv.info.forward.iterations)
    return np.mean(counts)


def judge(label, w, seconds):
    """One row of the table."""
    guesses = guess(w, unseen)
    ends = [unrolled(b, start=x) for b, x in zip(unseen, guesses)]
    residual = np.mean([np.linalg.norm(b - box(x)) / np.linalg.norm(b) for b, x in zip(unseen, ends)])
    error = np.mean([energy_error(x, b, p) for b, x, p in zip(unseen, ends, solutions)])
    counts = f"{count(cg, guesses):10.1f} {count(multigrid, guesses):10.1f}"
    print(f"{label:33} {seconds:9.1f} {residual:10.1e} {error:8.1e} {counts}", flush=True)


weights = {"zero": untrained}
print(f"after {iterations} iterations of CG, from     trained [s]  residual    error  CG to 1e-3  multigrid")
judge("zero", untrained, 0.0)
for label, loss, before, rate in (
    ("guess", loss_of_guess, "zero", 0.03),
    ("guess, trained again", loss_of_guess, "guess", 0.01),
    ("guess, again through CG", loss_through_cg, "guess", 0.01),
):
    weights[label], seconds = train(loss, weights[before], rate)
    judge(label, weights[label], seconds)

# %%
# The picture
# -----------
# An unseen pressure, and the guess of it; then what CG makes of each start. The loss through CG looks at one place of
# these curves, where the dotted line is.
#
# There a learned guess is some ten times closer than zero. To a residual of 1e-3 CG saves no more than an eighth to a
# quarter of its iterations, since each further digit takes as many as before. Multigrid takes three, from zero or from
# any of the guesses. Training through CG pays on 32 x 32 cells, at four times the seconds; on 16 x 16, with only 4
# iterations in the loss, it does not.
#
# Exercises
# ---------
# 1. Train through CG from scratch. Is it worth its time?
# 2. Give CG a quarter of the iterations in the loss. Does the network leave another kind of error to it?
# 3. Train on 8 states instead of 64. What do the unseen ones say?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(14, 3.9), layout="constrained")
    limits = np.min(solutions[0]), np.max(solutions[0])
    first = guess(weights["guess, again through CG"], unseen)[0]
    dp.plot(grid, solutions[0], ax=left, title="an unseen pressure", limits=limits)
    dp.plot(grid, first - np.mean(first), ax=middle, title="guessed, trained through CG", limits=limits)
    counts = np.unique(np.linspace(1, 3 * iterations, 13).astype(int))
    for label, w in weights.items():
        errors = []
        for k in counts:
            inv = dp.inverse(box, "krylov", iterations=int(k), nullspace="project")
            ends = [inv(b, start=x) for b, x in zip(unseen, guess(w, unseen))]
            errors.append(np.mean([energy_error(x, b, p) for b, x, p in zip(unseen, ends, solutions)]))
        right.semilogy(counts, errors, ".-", label=label)
    right.axvline(iterations, color="black", linestyle=":")
    right.set(title="error in the norm of A", xlabel="iterations of CG")
    right.legend(frameon=False, loc="center right")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "warm_start_learned.png", dpi=120)
