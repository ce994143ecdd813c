r"""
Four patterns, one stepper each
===============================

Gray-Scott, Cahn-Hilliard, Swift-Hohenberg and Kuramoto-Sivashinsky in a plane, and a rate found from a picture.

Spots that divide, films that coarsen, rolls, and a flame that never settles: four equations of textbooks, each a
few lines here. All have a stiff linear part and a nonstiff nonlinear part, which `dp.stepper` takes separately.
Each is compared with a known result, and each is differentiable in its parameters.

Run it: ``python examples/patterns.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np
from scipy.ndimage import maximum_filter

import sparsedp as dp

parser = argparse.ArgumentParser(description="Four patterns, one stepper each, the stiff part in linear.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis, at least 20")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

n = options.cells
noise = np.random.default_rng(0).uniform(-1, 1, (n, n))

# %%
# Stiff and linear
# ----------------
# All four equations are of the form
#
# .. math:: u_t = A u + N(u, p) .
#
# In :math:`A` stand the highest derivatives. An explicit step would have to be shorter than :math:`h^2 / 4` over a
# diffusivity, and for fourth derivatives than about :math:`h^4 / 32`. Two methods take :math:`A` out of this:
#
# * `imex`: :math:`A` is implicit, :math:`N` explicit, of second order.
# * `etdrk4`: :math:`A` is exact, by transforms, as :math:`e^{A \Delta t}`; :math:`N` by a Runge-Kutta scheme of fourth
#   order.
#
# This runs one of them, and checks the gradient of the sum of squares after 5 steps in every parameter:


def report(name, step, state, params, steps, keep="last"):
    """The last state, or all."""
    clock = perf_counter()
    states = dp.rollout(step, state, params, steps, keep=keep)
    seconds = perf_counter() - clock

    def loss(p):
        after = dp.rollout(step, state, p, 5)
        field = after["v"] if isinstance(after, dict) else after
        return np.sum(field**2)

    verdict = dp.check.gradient(loss, params, quick=True).verdict
    print(f"{name:20} {steps:5} steps {seconds:6.1f} s   gradient {verdict}", end="   ")
    return states


# %%
# Gray-Scott: spots that divide
# -----------------------------
# A soup of :math:`u` is fed, :math:`v` eats it and is washed away (J. Pearson, Science 261, 1993):
#
# .. math:: u_t = 2 \cdot 10^{-5} \, \Delta u - u v^2 + F \, (1 - u), \qquad
#           v_t = 10^{-5} \, \Delta v + u v^2 - (F + k) \, v .
#
# At :math:`F = 0.034`, :math:`k = 0.065` a drop grows, divides, and divides again. With a little more :math:`k` it
# dies. The state is a dict, and `linear` is one like it.

dish = dp.Grid((n, n), spacing=2.5 / 256, periodic=True)
diffusion = dp.laplacian(dish)


def gray_scott(x, p):
    """What is eaten, fed, and washed away."""
    eaten = x["u"] * x["v"] ** 2
    return {
        "u": p["feed"] * (1 - x["u"]) - eaten,
        "v": eaten - (p["feed"] + p["kill"]) * x["v"],
    }


def spots(x):
    """How many local maxima of v."""
    highest = maximum_filter(x["v"], 5, mode="wrap")
    return int(np.sum((x["v"] == highest) & (x["v"] > 0.15)))


margin = (n - 20) // 2
drop = np.pad(np.ones((20, 20)), (margin, n - 20 - margin)) * (1 + 0.05 * noise)
soup = {"u": 1 - 0.5 * drop, "v": 0.25 * drop}
rates = {"feed": 0.034, "kill": 0.065}

eat = dp.stepper("imex", gray_scott, 4.0, linear={"u": (diffusion, 2e-5), "v": (diffusion, 1e-5)})
end = report("Gray-Scott", eat, soup, rates, 1500)
gone = dp.rollout(eat, soup, rates | {"kill": 0.075}, 250)
print(f"{spots(end)} spots (1 drop at the start; with more kill {spots(gone)}, known 0)")

# %%
# Cahn-Hilliard: two liquids part
# -------------------------------
# An alloy, or oil and vinegar: :math:`u` is 1 in one and -1 in the other.
#
# .. math:: u_t = m \, \Delta \left( u^3 - u - \Delta u \right) .
#
# What is below the Laplacian is the derivative of the energy
# :math:`\int \frac{1}{4} (u^2 - 1)^2 + \frac{1}{2} |\nabla u|^2`.
# So the energy falls, and the mean of :math:`u` stays. For the energy to fall in long steps too, the linear part gets
# :math:`2 u` more than it needs, and the other one :math:`2 u` less (after D. Eyre, 1998):
#
# .. math:: u_t = m \, (2 \Delta - \Delta^2) \, u + m \, \Delta (u^3 - 3 u) .

box = dp.Grid((n, n), spacing=0.5)
C = dp.laplacian(box)
slope = dp.gradient(box)

part = dp.stepper("imex", lambda u, m: m * C(u**3 - 3 * u), 0.1, linear=(2 * C - C @ C, lambda m: m))
films = report("Cahn-Hilliard", part, 0.1 * noise, 1.0, 400, keep="all")


def energy(u):
    """The energy over the volume of a cell."""
    return np.sum((u**2 - 1) ** 2) / 4 + np.sum(slope(u) ** 2) / 2


rise = np.max(np.diff([energy(u) for u in films]))
drift = np.max(np.abs(np.sum(films - films[0], axis=(1, 2)))) / n**2
print(f"drift of the mean {drift:.0e} (0), largest rise of energy {rise:.0e} (below 0)")

# %%
# Swift-Hohenberg: rolls
# ----------------------
# Convection in a thin layer just above its onset :math:`r = 0`:
#
# .. math:: u_t = r u - (1 + \Delta)^2 u - u^3 .
#
# Waves of length :math:`2 \pi` grow, all others die out or lag behind. A single wave :math:`a \cos x` is steady when
# :math:`r a = \frac{3}{4} a^3`, so the root mean square of :math:`u` is :math:`\sqrt{2 r / 3}`.
#
# `dp.matrix_function` makes an operator of a function of the eigenvalues of another one.

wide = dp.Grid((n, n), spacing=np.pi / 5, periodic=True)
L = dp.laplacian(wide)

convect = dp.stepper("etdrk4", lambda u, r: r * u - u**3, 0.5, linear=dp.matrix_function(L, lambda e: -((1 + e) ** 2)))
rolls = report("Swift-Hohenberg", convect, 0.1 * noise, 0.1, 1000)

frequencies = np.fft.fftfreq(n, np.pi / 5)
wavenumbers = 2 * np.pi * np.hypot(*np.meshgrid(frequencies, frequencies))
power = np.abs(np.fft.fft2(rolls)) ** 2
length = 2 * np.pi * np.sum(power) / np.sum(wavenumbers * power)
size = np.sqrt(np.mean(rolls**2))
print(f"wavelength {length:.2f} ({2 * np.pi:.2f}), size {size:.3f} (one wave: {np.sqrt(0.2 / 3):.3f})")

# %%
# Kuramoto-Sivashinsky: a flame front
# -----------------------------------
# Long waves grow, short ones are damped, and the last term transfers energy from long to short waves, for ever:
#
# .. math:: u_t = -\Delta u - \Delta^2 u - \tfrac{1}{2} \, c \, |\nabla u|^2 .
#
# A small wave of wavenumber :math:`k` grows like :math:`e^{(k^2 - k^4) t}`. The gradient lives on faces; the transpose
# of `dp.average` takes the squares of both components to the cells.

G = dp.gradient(wide)
to_cells = dp.average(wide).T

burn = dp.stepper("etdrk4", lambda u, c: -0.5 * c * to_cells(G(u) ** 2), 0.1, linear=-1.0 * L - L @ L)
flame = report("Kuramoto-Sivashinsky", burn, 0.1 * noise, 1.0, 1000)

k = 10 * round(n / 14) / n  # the whole number of waves that grows about fastest
x = wide.centres()[0]
small = 1e-6 * np.cos(k * (x - x[0, 0]))
growth = np.log(1e6 * np.max(dp.rollout(burn, small, 1.0, 50))) / 5
print(f"growth of a small wave {growth:.4f} ({k**2 - k**4:.4f})")

# %%
# A rate, found from a picture
# ----------------------------
# Given are the start, and :math:`v` after 25 steps. How much was fed? The search starts at 0.04.

seen = dp.rollout(eat, soup, rates, 25)["v"]


def miss(feed):
    """Return the mean squared difference from the observation."""
    return np.mean((dp.rollout(eat, soup, rates | {"feed": feed}, 25)["v"] - seen) ** 2)


best = dp.minimize(miss, np.array(0.04), maxiter=30)
print(f"feed found from what is seen after 25 steps: {best.x:.6f} (0.034), {len(best.history)} evaluations")

# %%
# The picture
# -----------
# All four at the end.
#
# Exercises
# ---------
# 1. Look for other patterns: feed 0.029 with kill 0.057, or 0.026 with 0.051.
# 2. Give Cahn-Hilliard the equation as it is, ``-1.0 * C - C @ C`` as the linear part and ``m * C(u**3)`` as the rate.
#    For which steps does the energy still fall? And for which as it stands above?
# 3. After how many steps can the feed rate of Gray-Scott no longer be found? And the :math:`c` of the flame, which is
#    chaotic?

if options.out:
    from matplotlib import pyplot

    titles = {
        f"Gray-Scott, v\n{spots(end)} spots": end["v"],
        f"Cahn-Hilliard\nmean off by {drift:.0e}": films[-1],
        f"Swift-Hohenberg\nwavelength {length:.2f}, known {2 * np.pi:.2f}": rolls,
        f"Kuramoto-Sivashinsky\ngrowth {growth:.3f}, known {k**2 - k**4:.3f}": flame - np.mean(flame),
    }
    picture, axes = pyplot.subplots(1, 4, figsize=(13, 3.2), layout="constrained")
    for ax, (title, u) in zip(axes, titles.items()):
        picture.colorbar(ax.imshow(u.T, origin="lower"), ax=ax, shrink=0.8)
        ax.set(title=title, xticks=[], yticks=[])
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "patterns.png", dpi=120)
