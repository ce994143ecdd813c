r"""
A crane for ropes of any length
===============================

One motion of a trolley that brings fifty pendulums to rest at once, by a recorded step.

A crane moves a load by 10 m in 12 s. The load swings, and the length of the rope is known only roughly. A motion that
is designed for one length leaves other lengths swinging. So we let fifty pendulums of different lengths hang from the
same trolley, as one array, and ask for the acceleration of the trolley that leaves all of them as calm as possible.

Run it: ``python examples/pendulums.py [pendulums] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="The motion of a crane for ropes of any length.")
parser.add_argument("pendulums", nargs="?", type=int, default=50)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The pendulums
# -------------
# Under a trolley with the acceleration :math:`a(t)`, the angle :math:`\theta` of a rope of length :math:`\ell` obeys
#
# .. math:: \ell \, \theta'' = -g \sin \theta - a(t) \cos \theta .
#
# The state has three arrays: the angles and angular velocities of all pendulums, and the place and the velocity of the
# trolley. The acceleration is constant in each of 60 intervals, an input of the rollout.

GRAVITY = 9.81
DISTANCE = 10.0
INTERVALS = 60
dt = 0.2


def rate(state, params):
    """Rates of change of angles, angular velocities, and of the place and velocity of the trolley."""
    lengths, acceleration = params
    angle, turning, trolley = state
    turn = -(GRAVITY * np.sin(angle) + acceleration * np.cos(angle)) / lengths
    return turning, turn, np.array([trolley[1], acceleration])


step = dp.stepper("rk4", rate, dt)
recorded_step = dp.jit(step)


def run(accelerations, lengths, step=recorded_step, keep="last"):
    """Return the final state of the trolley and of a pendulum of each length."""
    rest = np.zeros(len(lengths)), np.zeros(len(lengths)), np.zeros(2)
    return dp.rollout(step, rest, lengths, INTERVALS, inputs=accelerations, keep=keep)


# %%
# The loss
# --------
# The energy of a pendulum at the end, divided by its mass, is :math:`\ell^2 \theta'^2 / 2 + g \ell (1 - \cos \theta)`.
# The loss is its mean, plus penalties for a trolley that is not at rest at the right place, and a small one for strong
# accelerations.


def swing(state, lengths):
    """Return the energy of each pendulum relative to its mass."""
    angle, turning, _ = state
    return 0.5 * (lengths * turning) ** 2 + GRAVITY * lengths * (1 - np.cos(angle))


def loss(accelerations, lengths, step=recorded_step):
    """Return the mean energy of the swings, with penalties for the trolley."""
    end = run(accelerations, lengths, step)
    place, velocity = end[2][0], end[2][1]
    effort = 1e-5 * np.sum(accelerations**2)
    return np.mean(swing(end, lengths)) + 10 * (place - DISTANCE) ** 2 + 10 * velocity**2 + effort


# %%
# The step, recorded
# ------------------
# An array of 50 numbers is small: nearly all of the time of a step is spent by Python, on the functions around NumPy's.
# `dp.jit` records the step in its first call, and the rollout executes what was recorded.
#
# Many pendulums in one array cost little more than one. For that the function must be the same for all of them, with
# no decision that depends on one pendulum.

lengths = np.linspace(4.0, 8.0, options.pendulums)
middle = np.array([6.0])
start = np.where(np.arange(INTERVALS) < INTERVALS // 2, 1.0, -1.0) * DISTANCE / (0.5 * INTERVALS * dt) ** 2
state = 0.1 * lengths, np.sin(lengths), np.ones(2)
print("program of the step:", dp.check.jit(recorded_step, state, lengths, 0.3).verdict)
print("gradient:", dp.check.gradient(lambda a: loss(a, lengths), start, quick=True).verdict)


def milliseconds(step, lengths):
    """Return the smallest time of a gradient of five."""
    gradient = dp.grad(lambda a: loss(a, lengths, step))
    seconds = []
    for _ in range(5):
        clock = perf_counter()
        gradient(start)
        seconds.append(perf_counter() - clock)
    return 1e3 * min(seconds)


print(f"\none gradient through {INTERVALS} steps [ms]   plain step   recorded step")
for name, some in (("one pendulum", middle), (f"{options.pendulums} pendulums", lengths)):
    print(f"{name:37} {milliseconds(step, some):10.1f} {milliseconds(recorded_step, some):15.1f}")

# %%
# Two motions
# -----------
# One is designed for the rope of 6 m alone, the other for all ropes. Each is then applied to all of them. The largest
# angle of the swing that remains follows from the energy, :math:`\cos \theta_{\max} = 1 - E / (g \ell)`.


def largest_angles(accelerations):
    """Return the amplitude of the remaining swing in degrees, for each length."""
    energy = swing(run(accelerations, lengths), lengths)
    return np.degrees(np.arccos(1 - np.minimum(energy / (GRAVITY * lengths), 2.0)))


motions = {"one length": middle, "all lengths": lengths}
print("\ndesigned for   gradients  seconds  place of the trolley  remaining swing: mean, largest [degrees]")
for name, some in motions.items():
    clock = perf_counter()
    best = dp.minimize(lambda a, some=some: loss(a, some), start, "lbfgs", maxiter=150)
    seconds = perf_counter() - clock
    motions[name] = best.x
    angles = largest_angles(best.x)
    place = run(best.x, lengths)[2][0]
    print(
        f"{name:13} {len(best.history) - 1:10} {seconds:8.2f} {place:19.3f} m "
        f"{np.mean(angles):22.2f} {np.max(angles):9.2f}"
    )

# %%
# The picture
# -----------
# Exercises
# ---------
# 1. Let the lengths be between 2 m and 10 m. How calm can all of them be?
# 2. Add friction, :math:`-c \, \theta'` with an unknown :math:`c` for each pendulum.
# 3. Replace the array by one rollout for each length, with `dp.ensemble`. How long does a gradient take now, and why?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    for name, accelerations in motions.items():
        left.stairs(accelerations, dt * np.arange(INTERVALS + 1), baseline=None, label=f"for {name}")
        right.plot(lengths, largest_angles(accelerations), label=f"for {name}")
    left.set(title="acceleration of the trolley [m/s2]", xlabel="time [s]")
    right.set(title="remaining swing [degrees]", xlabel="length of the rope [m]")
    left.legend(frameon=False)
    right.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "pendulums.png", dpi=120)
