r"""
A body in the Earth's crust, found from waves
=============================================

Leapfrog, a sponge, six shots and many receivers: the wave speed under ground is found from recorded waves.

Shots near the surface send waves down. Where the speed of the rock changes, a part of them is reflected. Receivers
record the pressure. From these records we reconstruct the speed in every cell, which is called full waveform inversion.
The crust is taken from the model ak135 (B. Kennett, E. Engdahl, R. Buland, Geophys. J. Int. 122, 1995). A body in it is
10 % slower.

Run it: ``python examples/full_waveform.py [cells deep] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="A body in the Earth's crust, found from waves.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells over 32 km of depth")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The crust
# ---------
# A section 64 km long and 32 km deep. Around it, but for the surface, cells are added in which waves die out: the
# *sponge*, so that nothing comes back from ends which the Earth does not have.

n = options.cells
h = 32.0 / n  # width of a cell [km]
deep = n // 3  # cells of the sponge
shape = 2 * n + 2 * deep, n + deep
grid = dp.Grid(shape, size=(shape[0] * h, shape[1] * h), origin=(-deep * h, 0.0))
x, depth = grid.centres()

crust = np.where(depth < 20.0, 5.80, 6.50)  # speed [km/s]
body = -0.1 * np.exp(-((((x - 26.0) / 6.0) ** 2 + ((depth - 12.0) / 4.0) ** 2) ** 2))  # its change, relative

# %%
# Waves
# -----
# The pressure :math:`p` and the velocity :math:`v` of the rock move each other:
#
# .. math:: p_t = -c^2 \, \nabla \cdot v + s, \qquad v_t = -\nabla p .
#
# Leapfrog takes :math:`v` half a step apart from :math:`p`, so that each jumps over the other. It is of second order,
# and stable in the plane for :math:`c \, \Delta t \le h / \sqrt 2`. At the surface the pressure is 0.
#
# A shot is a source in one place, with Ricker's wavelet in time,
#
# .. math:: w(t) = (1 - 2 a) \, e^{-a}, \qquad a = \pi^2 f^2 (t - t_0)^2 .
#
# Its frequency :math:`f` is chosen for the grid: 22 cells to a wavelength, and 11 for the higher frequencies that are
# also in it.

D = dp.divergence(grid)
G = dp.gradient(grid, {"y": (dp.dirichlet, dp.neumann)})

dt = 0.5 * h / 6.5  # [s]
steps = int(14.0 / dt)
frequency = 0.26 / h  # [1 / s]
a = (np.pi * frequency * (dt * np.arange(steps) - 1.2 / frequency)) ** 2
wavelet = (1 - 2 * a) * np.exp(-a)

# %%
# Six shots and :math:`2 n` receivers, all of them a kilometre deep. Reading a field at a point is an operator, and its
# transpose puts a number to that point: this is the shot. The six shots do not meet: they are a batch, with an axis of
# its own in front of the fields.

shots = np.linspace(8.0, 56.0, 6)
receivers = dp.sample(grid, np.stack([np.linspace(2.0, 62.0, 2 * n), np.full(2 * n, 1.0)], axis=1))
sources = np.stack([dp.sample(grid, [[place, 1.0]]).T(np.ones(1)) for place in shots]) / h**2


def pressure_rate(v, given):
    """Return p_t for the speed and the value of the wavelet at this time."""
    c, strength = given
    return -(c**2) * D(v) + strength * sources


def velocity_rate(p, given):
    """v_t."""
    return -G(p)


sponge = dp.sponge(grid, {"x": (deep, deep), "y": (0, deep)}, 6.5)
step = dp.stepper("leapfrog", (pressure_rate, velocity_rate), dt, damping=sponge)
quiet = np.zeros((len(shots), *grid.shape)), np.zeros((len(shots), grid.faces.size))


def heard(c):
    """Return the pressure at the receivers after each step, for all shots."""
    traces = dp.rollout(step, quiet, c, steps, inputs=wavelet, keep=lambda index, state: receivers(state[0]))
    return np.stack(traces)


# %%
# The loss
# --------
# The unknown :math:`m` is smoothed over 2 km before it counts as a change of speed, since shorter details leave no
# trace in waves of this length:
#
# .. math:: J(m) = \frac{| \text{heard}(c) - d |^2}{| \text{heard}(c_0) - d |^2}, \qquad
#           c = c_0 \left( 1 + S m \right), \quad S = (1 - (2\,\text{km})^2 \Delta)^{-1} .
#
# Its gradient in the speed is a product of two waves, summed over time and over the shots,
#
# .. math:: \frac{\partial J}{\partial c} = -2 c \int \lambda \, \nabla \cdot v \; dt :
#
# :math:`v` is what the shot sent out, and :math:`\lambda` is the adjoint wave. It starts from the misfit at all
# receivers at once, and runs backwards in time. Where both meet, the speed matters. One such pair of runs gives the
# derivative in all cells.

smooth = dp.inverse(dp.identity(grid.cells) - 2.0**2 * dp.laplacian(grid))
signal = heard(crust * (1 + body))
scale = np.sum((heard(crust) - signal) ** 2)


def loss(m):
    """Misfit of the traces, 1 for the crust without a body."""
    c = crust * (1 + smooth(m))
    return np.sum((heard(c) - signal) ** 2) / scale


start = np.zeros(grid.shape)
print(f"{len(shots)} shots, {steps} steps, {grid.shape[0]} x {grid.shape[1]} cells")
print("gradient against finite differences:", dp.check.gradient(loss, start, quick=True).verdict)

# %%
# The search
# ----------
# The search starts from the model of the crust. This is near enough: the waves that the body delays are late by less
# than half a period. Were they later, they would be fitted to the wrong crest.

best = dp.minimize(loss, start, maxiter=12)
answer = smooth(best.x)

near = (abs(x - 26.0) < 12) & (depth < 20)
error = np.linalg.norm((answer - body)[near]) / np.linalg.norm(body[near])
evaluations = f"misfit 1 -> {best.value:.4f} in {len(best.history)} evaluations"
print(f"{evaluations}; error of the speed around the body: {error:.2f}")

place = np.argmin(answer)
where = f"x = {x.flat[place]:.1f} km, depth {depth.flat[place]:.1f} km"
print(f"slowest place: {answer.flat[place]:.3f} at {where}")

# %%
# The picture
# -----------
# Stars are shots; the dashed line is where the body has half of its change of speed. Its place is found better than its
# strength, and bands of the other sign stand above and below it: waves come back from where the speed changes, and tell
# little of what is much wider or much narrower than they are long.
#
# Exercises
# ---------
# 1. Shoot from one end only, with six shots between 8 and 20 km. Which side of the body is lost?
# 2. Make the body 30 % slower. Does the search still find it, and if not: does a lower frequency help?
# 3. Omit the sponge (`damping=None`) in the runs of the search, but not in the run that computes the data. What does
#    the search find at the ends?

if options.out:
    from matplotlib import pyplot

    picture, places = pyplot.subplots(3, 1, figsize=(6, 9), layout="constrained")
    speed = {"cmap": "viridis", "vmin": 5.2, "vmax": 6.6}
    panels = [
        ("the crust", crust * (1 + body), speed, "speed [km/s]"),
        (f"what the waves told, error {error:.0%}", crust * (1 + answer), speed, "speed [km/s]"),
        ("relative to ak135", 100 * answer, {"cmap": "RdBu", "vmin": -10, "vmax": 10}, "change of speed [%]"),
    ]
    for ax, (title, field, colors, unit) in zip(places, panels):
        drawn = ax.pcolormesh(x, depth, field, shading="nearest", **colors)
        ax.contour(x, depth, body, [-0.05], colors="black", linestyles="dashed")
        ax.plot(shots, np.ones(shots.size), "r*", clip_on=False)
        ax.set(title=title, xlabel="x [km]", ylabel="depth [km]", xlim=(0, 64), ylim=(32, 0), aspect="equal")
        picture.colorbar(drawn, ax=ax, label=unit)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "full_waveform.png", dpi=120)
