r"""
Stiff kinetics, and what each rate changes
==========================================

Three reactions, their rates nine decades apart: implicit steps with error control, and the adjoint of them.

Robertson's reactions (1966) are the classic of stiff equations. We ask two things of them: how much of a product there
has been over a while, and how much more there would be if a rate were 1 % larger. The first takes a method that is
stable at any step; the second takes its adjoint.

Run it: ``python examples/stiff_chemistry.py [end time] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Robertson's kinetics: implicit steps, and derivatives in the rates.")
parser.add_argument("end", nargs="?", type=float, default=50.0, help="end time in seconds")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()
end = options.end

# %%
# Three reactions
# ---------------
# A becomes B slowly, B reacts with C and becomes A again, and C is formed from two B:
#
# .. math:: A \xrightarrow{p_1} B, \qquad B + C \xrightarrow{p_2} A + C, \qquad 2 B \xrightarrow{p_3} B + C,
#
# with :math:`p = (0.04, \, 10^4, \, 3 \cdot 10^7)`. So
#
# .. math:: A' = p_2 B C - p_1 A, \qquad B' = p_1 A - p_2 B C - p_3 B^2, \qquad C' = p_3 B^2 .
#
# A fourth unknown is the integral of C over time, :math:`G = \int_0^T C \, dt`.

RATES = np.array([0.04, 1e4, 3e7])
start = np.array([1.0, 0.0, 0.0, 0.0])


def robertson(u, p):
    """Rates of change of A, B, C and G."""
    slow = p[0] * u[0]
    back = p[1] * u[1] * u[2]
    fast = p[2] * u[1] ** 2
    return np.array([back - slow, slow - back - fast, fast, u[2]])


# %%
# Why it is stiff
# ---------------
# Within milliseconds B reaches the equilibrium of production and loss, :math:`B \approx \sqrt{p_1 / p_3} = 4 \cdot
# 10^{-5}`. After that it follows A and C, which change over seconds. But a disturbance of B still decays at the rate
# :math:`2 p_3 B + p_2 C`, about 2000 per second. Explicit steps must be short enough for this rate, although the
# solution changes slowly: for a rate :math:`\lambda`, rk4 is stable up to steps of :math:`2.8 / \lambda`. `radau` is
# implicit and stable for steps of any length.
#
# The error of each step is kept below a tolerance relative to :math:`|u|` + floor. Since B is 4e-5, the floor must be
# smaller, so that B is controlled as well.

small = dict(tolerance=1e-4, floor=1e-6)
explicit = dp.stepper("rk4", robertson, end / 50, **small)
implicit = dp.stepper("radau", robertson, end / 50, **small)
explicit(start, RATES)
implicit(start, RATES)
print(f"The first {end / 50:g} s: rk4 takes {len(explicit.taken)} steps, radau {len(implicit.taken)}.")

# %%
# The integral, and its gradient
# ------------------------------
# The adjoint uses the accepted steps in reverse order. One backward pass gives the derivatives in all three rates. For
# 50 s, G and its gradient are known to ten digits.

KNOWN = 10.948648481
KNOWN_SLOPES = np.array([1.734140891e2, -5.059191406e-4, 8.432346465e-8])

print(f"\nG = integral of C over {end:g} s, and its derivative in the logarithm of each rate\n")
print("tolerance  steps          G  dG/dlog p1  dG/dlog p2  dG/dlog p3  error of G    of dG/dp  seconds")
for tolerance in (1e-3, 1e-4, 1e-5):
    step = dp.stepper("radau", robertson, end, tolerance=tolerance)
    clock = perf_counter()
    value, slopes = dp.value_and_grad(lambda p: step(start, p)[3])(RATES)
    seconds = perf_counter() - clock
    error = error_of_slopes = np.nan
    if end == 50.0:
        error = abs(value / KNOWN - 1)
        error_of_slopes = np.max(np.abs(slopes / KNOWN_SLOPES - 1))
    figures = "  ".join(f"{slope:10.4f}" for slope in slopes * RATES)
    print(f"{tolerance:9.0e} {len(step.taken):6} {value:10.6f}  {figures}", end="  ")
    print(f"{error:10.1e}  {error_of_slopes:10.1e} {seconds:8.1f}")

# %%
# The derivative in the logarithm, :math:`p \, \partial G / \partial p`, is the change of G for a relative change of a
# rate, so that rates of any size can be compared. There is a check without reference values: multiplying all rates by
# :math:`\alpha` is the same as rescaling time, :math:`G(\alpha p, T) = G(p, \alpha T) / \alpha`. The derivative in
# :math:`\alpha` at 1 gives
#
# .. math:: \sum_i p_i \frac{\partial G}{\partial p_i} = T \, C(T) - G .

expected = end * step(start, RATES)[2] - value
print(f"\nsum of the three: {np.sum(slopes * RATES):.4f}, T C(T) - G: {expected:.4f}")

# %%
# All times at once
# -----------------
# For C at many times and only three rates, forward mode is cheaper: it computes the derivative along a direction of the
# rates together with all steps. The time between two outputs is an input of the rollout, so that the outputs can be
# close at the start and far apart at the end.

times = end * np.logspace(-3, 0, 10)
lengths = np.diff(times, prepend=0.0)
reach = dp.stepper("radau", lambda u, p: robertson(u, p[0]), lambda p: p[1], tolerance=1e-3)


def run(logs):
    """Return the state at all times, for the logarithms of factors on the rates."""
    return dp.rollout(reach, start, RATES * np.exp(logs), 10, inputs=lengths, keep="all")


forward = [dp.jvp(run, np.zeros(3), direction) for direction in np.eye(3)]
states = forward[0][0]
responses = [tangent[1:, 2] for _, tangent in forward]
last = " ".join(f"{response[-1]:.4f}" for response in responses)
print(f"C at the end: {states[-1, 2]:.4f}; in log p1, p2, p3: {last}")

# %%
# The picture
# -----------
# At first C depends on :math:`p_1` alone: all B soon becomes C. Later C turns B back into A, and :math:`p_2` has the
# opposite effect of :math:`p_1`; with a larger :math:`p_3` more of B becomes C before that.
#
# Exercises
# ---------
# 1. Run to 5000 s. How many more steps does radau take for a hundred times the time?
# 2. Use rk4 for the whole 50 s. Compare the run times.
# 3. Generate measurements of C with 1 % noise, and estimate the logarithms of the three rates with `dp.minimize`. Which
#    combination of them has the largest error?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    left.semilogx(times, states[1:, :3] * [1, 1e4, 1], ".-", label=["A", "10000 B", "C"])
    left.set(title="concentrations", xlabel="time [s]")
    left.legend(frameon=False, loc="center right")
    right.semilogx(times, np.transpose(responses), ".-", label=["p1", "p2", "p3"])
    right.set(title="derivative of C in the logarithm of a rate", xlabel="time [s]")
    right.legend(frameon=False, loc="upper left")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "stiff_chemistry.png", dpi=120)
