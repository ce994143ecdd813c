r"""
Where the heat was
==================

From a blurred picture back to a sharp one: gradients, one physical gradient, and prior knowledge.

Rectangles of a plate are heated, and the heat spreads for a while. From the final temperature in single precision we
reconstruct the initial one. The physics is linear and has an exact inverse, but it damps short waves by many powers of
ten, so that they are smaller than rounding errors at the end. This is the basic difficulty of inverse problems.

Case and published figures: inverse heat conduction in P. Holl, V. Koltun, N. Thuerey, "Scale-invariant learning by
physics inversion", NeurIPS 2022. There a network is trained; here none is needed.

Run it: ``python examples/inverse_heat.py [samples] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Where the heat was, from a blurred picture.")
parser.add_argument("samples", nargs="?", type=int, default=128)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# What the physics does
# ---------------------
# The plate is periodic, and the heat equation runs until :math:`t = 8`: :math:`y = e^{8 \Delta} x`.

SIDE = 64
grid = dp.Grid((SIDE, SIDE), periodic=True)
heat = dp.matrix_exponential(dp.laplacian(grid), 8.0)

# %%
# On such a plate each wave :math:`k` is multiplied by a factor, :math:`\hat y_k = \varphi_k \hat x_k`. The factors are
# the Fourier transform of the result for a single hot cell.

dot = np.zeros(grid.shape)
dot[0, 0] = 1.0
fade = np.fft.fft2(heat(dot)).real  # of the physics
bend = np.fft.fft2(-dp.laplacian(grid)(dot)).real  # of minus the Laplacian


def waves(factor, u):
    """Multiply each wave of a field by its factor."""
    return np.fft.ifft2(factor * np.fft.fft2(u)).real


# %%
# The hidden starts
# -----------------
# Four to ten rectangles of random places, sizes and temperatures. Single precision is the only noise.

rng = np.random.default_rng(0)
places = np.arange(SIDE)


def rectangles():
    """Return a random initial temperature, to generate synthetic data."""
    x = np.zeros(grid.shape)
    for _ in range(rng.integers(4, 11)):
        temperature = rng.random()
        sides = [abs(places - rng.uniform(0.1 * SIDE, 0.9 * SIDE)) <= rng.uniform(0, 10) for _ in range(2)]
        x += temperature * np.outer(*sides)
    return x


hidden = [rectangles() for _ in range(options.samples)]
seen = [np.float32(heat(x)).astype(float) for x in hidden]
noise = np.std([y - heat(x) for x, y in zip(hidden, seen)])
warmth = np.sum(hidden) / options.samples
print(f"{options.samples} samples with heat {warmth:.0f}, noise of the data (single precision) {noise:.0e}")

# %%
# First way: gradient descent
# ---------------------------
# The gradient of :math:`|\text{heat}(x) - y|^2 / 2` damps each wave a second time. A step of rate 1 from zero
# multiplies the error of a wave by :math:`1 - \varphi_k^2`; after :math:`n` steps the sum of the geometric series is
#
# .. math:: \hat x_k = \frac{1 - (1 - \varphi_k^2)^n}{\varphi_k} \, \hat y_k .
#
# So we need not wait for 1000 steps. Waves with :math:`\varphi_k^2` far below 1/1000 have not moved by then.


def descent(y):
    """Return the result of 1000 steps of gradient descent."""
    return waves((1 - (1 - fade**2) ** 1000) / fade, y)


# %%
# Second way: one physical gradient
# ---------------------------------
# Why not invert the physics? Where :math:`\varphi_k` is above the rounding of the data, division by it is accurate
# enough; the other waves are not changed. `dp.physical_gradient` uses such an inverse simulator in place of the
# transpose: the "gradient" is then the step to the solution.


def inverse_simulator(end, x):
    """Return the start near x whose final state is nearer to `end`, in the waves that the data determine."""
    return x + waves((fade > 1e-6) / fade, end - heat(x))


rule = dp.physical_gradient(heat, inverse_simulator)


def physical(y):
    """One step along the physical gradient, from zero."""
    loss = lambda x: 0.5 * np.sum((rule(x) - y) ** 2)
    _, gradient = dp.value_and_grad(loss)(np.zeros(grid.shape))
    return -gradient


# %%
# Third way: prior knowledge
# --------------------------
# Temperatures are not negative, and rectangles have few edges. Of all initial states that fit, we choose the one with
# the smallest sum of jumps between neighbours:
#
# .. math:: \min_{x \ge 0} \; \frac{1}{2} |\text{heat}(x) - y|^2 + \lambda \sum_i |x_{i+1} - x_i| .
#
# ADMM splits this into two problems: a quadratic one, which is diagonal in waves, and one that reduces jumps and sets
# negative values to zero, cell by cell. Each is one line of code; a third array, the multiplier, couples them.

WEIGHT = 1e-8  # lambda: single precision leaves little noise


def jumps_and_values(x):
    """Jump to the next cell along each axis, and the value."""
    return np.stack([np.roll(x, -1, 0) - x, np.roll(x, -1, 1) - x, x])


def shrink(v, t):
    """Shrink jumps towards 0 by t (soft thresholding), and replace negative values by 0."""
    jumps = np.sign(v[:2]) * np.maximum(abs(v[:2]) - t, 0)
    values = np.maximum(v[2:], 0)
    return np.concatenate([jumps, values])


def piecewise(y):
    """The start with few jumps and no temperature below zero."""
    blurred = waves(fade, y)

    def inner(target, rho, x):
        """The x that fits y, and whose jumps and values are near the target: one division for each wave."""
        along_x, along_y, value = rho * target
        pulled = np.roll(along_x, 1, 0) - along_x + np.roll(along_y, 1, 1) - along_y + value
        return waves(1 / (fade**2 + rho * (1 + bend)), blurred + pulled)

    best = dp.minimize(
        lambda x: 0.5 * np.sum((heat(x) - y) ** 2),
        np.zeros(grid.shape),
        "admm",
        maxiter=300,
        tolerance=1e-4,
        weight=WEIGHT,
        rho=1e-7,
        inner=inner,
        operator=jumps_and_values,
        prox=shrink,
    )
    return np.maximum(best.x, 0)


# %%
# The three beside each other
# ---------------------------
# The error is the sum of :math:`|x - x_{\text{true}}|` over all cells. The last column contains published figures for
# other samples of the same kind.

ways = {
    "descent, summed": (descent, 1000, "170"),
    "physical gradient": (physical, 1, "104"),
    "jumps and x >= 0": (piecewise, 300, "50.4, by a network"),
}
first = {}  # what each way makes of the first sample
print("method             gradients  error  ms a sample  published, on other samples")
for label, (method, gradients, published) in ways.items():
    clock = perf_counter()
    starts = [method(y) for y in seen]
    milliseconds = 1e3 * (perf_counter() - clock) / options.samples
    error = np.mean([np.sum(abs(x - true)) for x, true in zip(starts, hidden)])
    first[label] = starts[0]
    print(f"{label:18} {gradients:9} {error:6.1f} {milliseconds:12.1f}  {published}")

# %%
# The picture
# -----------
# The same sample five times, on one scale. Gradient descent gives a blurred image, the physical gradient sharp edges
# with ripples around them, and the third method rectangles.
#
# Exercises
# ---------
# 1. Add noise of 1e-3 to the data. For which factors may the inverse simulator divide now, and how large must `WEIGHT`
#    be? Which of the three methods becomes worse the least?
# 2. The term with :math:`x \ge 0` alone is a strong regularizer. Leave the jumps out (`t = 0` in `shrink`) and compare.

if options.out:
    from matplotlib import pyplot

    picture, places = pyplot.subplots(1, 5, figsize=(13, 2.9), layout="constrained", sharey=True)
    fields = {"hidden": hidden[0], "seen": seen[0], **first}
    for ax, (title, field) in zip(places, fields.items()):
        image = ax.pcolormesh(*grid.centres(), field, vmin=0, vmax=np.max(hidden[0]), rasterized=True)
        ax.set(title=title, aspect="equal", xlabel="x [cells]")
    places[0].set_ylabel("y [cells]")
    picture.colorbar(image, ax=places, label="temperature", pad=0.01)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "inverse_heat.png", dpi=120)
