r"""
Fluids that vary
================

A fluid that becomes thinner where it is sheared, and a heavy fluid on a light one, beside exact solutions.

The viscosity of paint and blood depends on the shear rate, and a heavy fluid on a light one is unstable. Here one call
of `flow_step` describes each: the viscosity is a function of the shear rate, the density one of a scalar.

Run it: ``python examples/variable_fluids.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="A power-law fluid in a channel, and Rayleigh-Taylor instability.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells across the channel and along the interface")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()
n = options.cells

# %%
# A channel
# ---------
# The viscosity is :math:`\dot\gamma^{m - 1}` with the shear rate :math:`\dot\gamma`. A constant force pushes the fluid
# between two walls at rest. Far from the start the stress is linear across the channel, and the speed is
#
# .. math:: u(y) = \frac{m}{m + 1} \left( 2^{-1 - 1/m} - |y - \tfrac{1}{2}|^{1 + 1/m} \right) .
#
# The small number in the law keeps the viscosity finite in the middle of the channel, where the shear rate is 0.

channel = dp.Grid((1, n), spacing=[np.ones(1), np.full(n, 1 / n)], periodic=(True, False))
push = channel.join(1.0, 0.0)


def law(shear_rate, m):
    """Return the viscosity."""
    return (1e-6 + shear_rate**2) ** ((m - 1) / 2)


flow = dp.flow_step(channel, 0.02, law, lambda v, m: push, implicit=True)


def speeds(m):
    """Return the speed across the channel after 150 steps."""
    end = dp.rollout(flow, flow.start(np.zeros(channel.faces.size), m), m, 150)
    return channel.split(end["v"])[0][0]


y = channel.coordinates(1)
profiles = {}
for m in (0.5, 0.7, 1.0):
    ours = speeds(m)
    exact = m / (m + 1) * (0.5 ** (1 + 1 / m) - np.abs(y - 0.5) ** (1 + 1 / m))
    profiles[m] = ours, exact
    print(f"exponent {m}: largest speed {np.max(ours):.5f}, error {np.max(np.abs(ours - exact)) / np.max(exact):.1e}")

mean, slope = dp.value_and_grad(lambda m: np.mean(speeds(m)))(0.7)
exact_slope = (1 / 2.4**2 + 0.7 / 2.4 * np.log(2) / 0.7**2) * 0.5 ** (1 + 1 / 0.7)
print(f"derivative of the mean speed in the exponent {slope:.5f}, exact {exact_slope:.5f}")

# %%
# A heavy fluid on a light one
# ----------------------------
# The density is a function of a scalar, the share of the heavy fluid, which the flow carries. A wave on the interface
# grows like :math:`e^{\sigma t}`. Linear theory for fluids of equal depth and a wave as long as the box has
#
# .. math:: \sigma^2 = A k \tanh(k / 2), \qquad k = 2 \pi, \qquad A = \frac{\varrho - 1}{\varrho + 1}
#
# for the ratio :math:`\varrho` of the densities. Gravity is 1.

tank = dp.Grid((n, n), size=1.0, periodic=(True, False))
across, up = tank.face_centres(1)
wave = tank.join(0.0, 1e-6 * np.cos(2 * np.pi * across) * np.exp(-2 * np.pi * np.abs(up - 0.5)))
heavy = np.where(tank.centres()[1] > 0.5, 1.0, 0.0)
down = tank.join(0.0, -1.0)
layers = dp.flow_step(
    tank,
    0.02,
    force=lambda v, s, ratio: down,
    density=lambda s, ratio: 1 + (ratio - 1) * s["heavy"],
    scalars={"heavy": {}},
)


def amplitudes(ratio):
    """Return the norm of the velocity after each of 200 steps."""
    start = layers.start(wave, ratio, {"heavy": heavy})
    v = dp.rollout(layers, start, ratio, 200, keep="all")["v"]
    return np.sqrt(np.sum(v**2, axis=1))


def growth(ratio):
    """Return the growth rate in the second half of the run."""
    size = amplitudes(ratio)
    return np.log(size[200] / size[100]) / 2


def theory(ratio):
    """Return the growth rate of linear theory."""
    return np.sqrt((ratio - 1) / (ratio + 1) * 2 * np.pi * np.tanh(np.pi))


rate, slope = dp.value_and_grad(growth)(3.0)
print(f"growth rate {rate:.4f}, linear theory {theory(3.0):.4f}")
print(f"derivative in the ratio {slope:.4f}, linear theory {dp.grad(theory)(3.0):.4f}")

# %%
# The picture
# -----------
# Left: speeds across the channel, with the exact profiles as points. Right: the wave grows at the rate of linear theory
# once the part that decays is small.
#
# Exercises
# ---------
# 1. Find the exponent from the speeds of a fluid: `dp.minimize` of the squared difference.
# 2. Give the fluids a viscosity. Which waves no longer grow as fast as theory says?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    stride = max(1, n // 16)
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for m, (ours, exact) in profiles.items():
        (line,) = left.plot(ours / np.max(exact), y, label=f"exponent {m}")
        left.plot(exact[::stride] / np.max(exact), y[::stride], "o", color=line.get_color(), fillstyle="none")
    left.set(title="speed in a channel, points: exact", xlabel="speed / largest exact speed", ylabel="y")
    left.legend(frameon=False)
    time = 0.02 * np.arange(201)
    size = amplitudes(3.0)
    right.semilogy(time, size / size[0], label=f"computed, rate {rate:.3f}")
    right.semilogy(
        time, size[200] / size[0] * np.exp(theory(3.0) * (time - 4)), "k--", label=f"theory, {theory(3.0):.3f}"
    )
    right.set(title="wave between two fluids, densities 1 and 3", xlabel="time", ylabel="velocity / first velocity")
    right.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "variable_fluids.png", dpi=120)
