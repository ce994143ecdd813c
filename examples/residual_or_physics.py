r"""
Physics as a residual, or as it is
==================================

The start of a flow, found by a network with a residual in its loss, and by the adjoint of a solver.

From one later state of Burgers' equation we reconstruct the initial state, with two methods. One represents the whole
solution by a network and minimizes the residual of the equation at many points (M. Raissi and others, J. Comput. Phys.
378, 2019), without a solver. The other differentiates a solver, so that its result always satisfies the equation. Both
use the same optimizer, and we compare errors, run times and the residuals of the equation.

Run it: ``python examples/residual_or_physics.py [iterations] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp
from sparsedp import network

parser = argparse.ArgumentParser(description="The start of Burgers: residual losses, and the adjoint.")
parser.add_argument("iterations", nargs="?", type=int, default=600, help="of each network")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The task
# --------
# It is the same as in the example `burgers.py`: on a ring of 128 cells,
#
# .. math:: u_t + u \, u_x = \nu \, u_{xx} .
#
# The data are the field at :math:`t = 1/2`, after 16 steps. It contains a shock, in which information about the initial
# state is lost. So a good result fits the data, satisfies the equation, and is smooth otherwise.

n = 128
h = 2 / n
dt = 1 / 32
nu = 0.01 / (128 * np.pi)

ring = dp.Grid(n, size=2.0, origin=-1.0, periodic=True)
L = dp.laplacian(ring)
G = dp.gradient(ring)
carry = dp.transport(ring, "semi_lagrangian", velocity="cells")
(x,) = ring.centres()


def step(u, nu):
    """One time step: diffusion, then advection of the velocity by itself."""
    u = u + nu * dt * L(u)
    return carry(u, u, dt)


def run(u):
    """Return 32 frames, of which the first is the start."""
    return dp.rollout(step, u, nu, 31, keep="all")


truth = run(-np.sin(np.pi * x))


def misfit(u):
    """Return the mean squared difference from the observation, the only data."""
    return np.mean((u - truth[16]) ** 2)


# %%
# A network for the whole history
# -------------------------------
# It maps position and time to :math:`u`, with three layers of 20 units. Its inputs are :math:`\sin \pi x` and
# :math:`\cos \pi x` instead of :math:`x`, so that :math:`u` is periodic. We evaluate all 32 frames at once.

rng = np.random.default_rng(0)
sizes = (3, 20), (20, 20), (20, 20), (20, 1)
weights = [network.dense_weights(rng, *size, gain=5 / 3) for size in sizes]

angles = np.tile(np.pi * x, 32)
times = np.repeat(np.arange(32) / 16 - 1, n)  # from -1 to 1, a range that suits tanh
points = np.stack([np.sin(angles), np.cos(angles), times], axis=1)


def field(w, points=points):
    """Return the frames of u that the weights describe."""
    for layer in w[:-1]:
        points = network.tanh(network.dense(layer, points))
    return network.dense(w[-1], points).reshape(-1, n)


# %%
# Two residuals
# -------------
# The first is the residual of the equation, in central differences on the points of the grid, :math:`2 \Delta t` and
# :math:`2 h` wide:
#
# .. math:: r = \frac{u^{m+1}_i - u^{m-1}_i}{2 \Delta t} + u^m_i \, \frac{u^m_{i+1} - u^m_{i-1}}{2 h}
#           - \nu \, \frac{u^m_{i+1} - 2 u^m_i + u^m_{i-1}}{h^2} .
#
# It is small where :math:`u` is smooth, but it does not describe a shock. The second is the residual of a step
# :math:`\Phi` of the solver, :math:`r = (u^{m+1} - \Phi(u^m)) / \Delta t`: if it is zero, the network is a solution of
# the discrete equation. Its norm is also used to compare all results.


def by_equation(w):
    """Return the misfit plus the residual of the equation."""
    u = field(w)
    right = np.roll(u, -1, axis=1)
    left = np.roll(u, 1, axis=1)
    u_t = (u[2:] - u[:-2]) / (2 * dt)
    space = u * (right - left) / (2 * h) - nu * (right - 2 * u + left) / h**2
    return misfit(u[16]) + np.mean((u_t + space[1:-1]) ** 2)


def broken(frames):
    """Return the mean square of the residual of the scheme."""
    left = [after - step(before, nu) for before, after in zip(frames, frames[1:])]
    return np.mean(np.stack(left) ** 2) / dt**2


def by_scheme(w):
    """Return the misfit plus the residual of the scheme."""
    u = field(w)
    return misfit(u[16]) + broken(u)


# %%
# Through the solver
# ------------------
# The loss of an initial state is the misfit after 16 steps, plus a small penalty on slopes, which selects the smoothest
# of all initial states that fit. The initial state is given by a network at the first frame, or by 128 numbers.


def through(u):
    """Misfit of a start, by running it."""
    return misfit(dp.rollout(step, u, nu, 16)) + 1e-5 * np.mean(G(u) ** 2)


def start_of(w):
    """The start that a network gives."""
    return field(w, points[:n])[0]


# %%
# Side by side
# ------------
# All four use L-BFGS. The error is the mean of :math:`|u - u_\text{true}|` over all frames, and over the first one.

searches = {
    "network, residual of equation": (by_equation, weights, field),
    "network, residual of scheme": (by_scheme, weights, field),
    "network for the start, adjoint": (lambda w: through(start_of(w)), weights, lambda w: run(start_of(w))),
    "the start itself, adjoint": (through, np.zeros(n), run),
}
histories = {}

print("                              gradients  ms each  seconds  misfit   error  at start  physics broken by")
for label, (loss, begin, frames_of) in searches.items():
    limit = options.iterations if begin is weights else 200
    best = dp.minimize(loss, begin, "lbfgs", limit, tolerance=0)
    u = histories[label] = frames_of(best.x)
    error = np.mean(np.abs(u - truth), axis=1)
    seconds, calls = best.history[-1].seconds, best.evaluations
    print(f"{label:30} {calls:8} {1e3 * seconds / calls:8.1f} {seconds:8.1f} {misfit(u[16]):8.1e}", end=" ")
    print(f"{np.mean(error):7.4f} {error[0]:9.4f} {np.sqrt(broken(u)):17.1e}", flush=True)

# %%
# Conclusions
# -----------
# Ten iterations are too few for any network. After 200 iterations the mean errors of the methods with a residual are
# still 0.15 and 0.05, those of the methods with a solver below 0.01.
#
# A residual needs no solver, and the network returns an approximation of :math:`u` at any position and time. This
# approximation satisfies the equation only approximately: the loss is a weighted sum of misfit and residual, and it can
# be small although the shock is at a wrong position. With a solver there are no such weights, since each result
# satisfies the discrete equation, and a gradient costs no more. If a line search tries an initial state that is so
# steep that cotangents overflow, the rollout warns, and the line search shortens its step.
#
# The picture
# -----------
# The four initial states, and the error of each solution over time.
#
# Exercises
# ---------
# 1. Multiply the residual by 0.01, or by 100. Which column of the table increases, and which one decreases?
# 2. Use a state before the shock, after 4 steps, as data. Do the errors of the networks decrease?
# 3. Make the viscosity an unknown of both kinds of methods. Which kind finds it?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    left.plot(x, truth[0], color="black", linewidth=4, alpha=0.3, label="true")
    for (label, u), line in zip(histories.items(), ("-", "--", "-", "-")):
        left.plot(x, u[0], line, label=label)
        right.semilogy(dt * np.arange(32), np.mean(np.abs(u - truth), axis=1), line)
    left.set(title="the start", xlabel="x", ylabel="u")
    left.legend(frameon=False, fontsize="small", loc="upper right")
    right.set(title="mean error", xlabel="t")
    right.axvline(0.5, color="black", linestyle=":")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "residual_or_physics.png", dpi=120)
