r"""
Rates of an ecosystem
=====================

Six numbers of a differential equation from noisy counts: exact gradients and a recorded step, beside SciPy.

Two species are counted a few times, with errors. We look for the four rates of their equation and for the two numbers
at the start. SciPy's `least_squares` needs only the counts that a run predicts. It takes derivatives by differences,
with seven runs for each Jacobian. Reverse mode takes one run forward and one backward, for any number of unknowns. But
the arrays have two entries, so that the calls of Python take most of the time. `dp.jit` removes them.

Run it: ``python examples/predator_prey.py [counts] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np
from scipy.optimize import least_squares

import sparsedp as dp

parser = argparse.ArgumentParser(description="Six numbers of a predator-prey equation from noisy counts.")
parser.add_argument("counts", nargs="?", type=int, default=30, help="number of times at which both species are counted")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The equation
# ------------
# Prey :math:`x` multiply, and predators :math:`y` die out without prey:
#
# .. math:: x' = a x - b x y, \qquad y' = c x y - d y .
#
# The solution is periodic. A step of the classical Runge-Kutta method takes a tenth of a year, and the species are
# counted twice a year.

dt = 0.1
between = 5  # steps between two counts


def rate(u, p):
    """Rates of change of both species."""
    x = u[0]
    y = u[1]
    return np.array([p[0] * x - p[1] * x * y, p[2] * x * y - p[3] * y])


step = dp.stepper("rk4", rate, dt)
recorded_step = dp.jit(step)


def predicted(logs, step):
    """Return both species at the times of the counts, for the logarithms of the six unknowns."""
    unknowns = np.exp(logs)
    last = between * options.counts
    return dp.rollout(step, unknowns[4:], unknowns[:4], last, keep=range(between, last + 1, between))


# %%
# The data
# --------
# Each count is wrong by about 5 %. All unknowns are positive. We take logarithms, so that an optimizer cannot choose
# negative rates, and residuals of logarithms, so that the errors of all counts have the same size.

truth = np.log([1.1, 0.4, 0.1, 0.4, 10.0, 5.0])
noise = np.random.default_rng(0).normal(0.0, 0.05, (options.counts, 2))
counted = np.log(predicted(truth, step)) + noise
start = truth + np.array([0.2, -0.1, 0.2, 0.1, 0.1, -0.1])


def residuals(logs, step=step):
    """Return the differences of the logarithms of all counts, relative to their standard deviation."""
    return ((np.log(predicted(logs, step)) - counted) / 0.05).reshape(-1)


def misfit(logs, step=step):
    """Return half of the sum of squares."""
    return 0.5 * np.sum(residuals(logs, step) ** 2)


# %%
# One gradient
# ------------
# The step is recorded in the first run. From then on the rollout executes the recorded calls of NumPy, forward and
# backward, without the functions that made them. The numbers are those of the plain step: `dp.check.jit` compares both
# at the given arguments and at two others.

print("program of the step:", dp.check.jit(recorded_step, np.array([10.0, 5.0]), np.exp(truth[:4])).verdict)


def measured(function):
    """Return the result of a function, and the smallest time of three calls in milliseconds."""
    seconds = []
    for _ in range(3):
        clock = perf_counter()
        result = function(start)
        seconds.append(perf_counter() - clock)
    return result, 1e3 * min(seconds)


def by_differences(logs):
    """Return the gradient by one-sided differences with the step of SciPy, from seven runs."""
    h = 1.5e-8 * np.abs(logs)
    value = misfit(logs)
    return np.array([(misfit(logs + shift) - value) / np.sum(shift) for shift in np.diag(h)])


exact, plain_time = measured(dp.grad(misfit))
recorded, recorded_time = measured(dp.grad(lambda logs: misfit(logs, recorded_step)))
differences, differences_time = measured(by_differences)
print(f"\none gradient in six unknowns through {between * options.counts} steps        ms   error")
for name, milliseconds, gradient in (
    ("differences, seven runs", differences_time, differences),
    ("reverse mode", plain_time, exact),
    ("reverse mode, recorded step", recorded_time, recorded),
):
    error = np.linalg.norm(gradient - exact) / np.linalg.norm(exact)
    print(f"{name:45} {milliseconds:10.1f} {error:7.0e}")

# %%
# The search
# ----------
# `least_squares` uses the structure of a sum of squares (Gauss-Newton with a trust region) and needs few iterations.
# `dp.minimize` with L-BFGS knows only values and gradients, and needs more iterations. With six unknowns, seven runs
# for each Jacobian are affordable, and `least_squares` is the better search. It can call the recorded step, too. With
# many unknowns only gradients remain affordable.


def with_scipy(step):
    """Return the unknowns by `least_squares` with differences, and the number of runs."""
    found = least_squares(residuals, start, kwargs={"step": step})
    return found.x, found.nfev + 6 * found.njev


def with_gradients(step):
    """Return the unknowns by L-BFGS, and the number of gradients."""
    found = dp.minimize(lambda logs: misfit(logs, step), start, "lbfgs", maxiter=100)
    return found.x, len(found.history) - 1


print("\nsearch                                 runs  seconds  misfit  error of the rates")
for name, search, chosen in (
    ("least_squares, differences", with_scipy, step),
    ("least_squares, recorded step", with_scipy, recorded_step),
    ("minimize", with_gradients, step),
    ("minimize, recorded step", with_gradients, recorded_step),
):
    clock = perf_counter()
    best, runs = search(chosen)
    seconds = perf_counter() - clock
    error = np.max(np.abs(np.exp(best[:4] - truth[:4]) - 1))
    print(f"{name:36} {runs:6} {seconds:8.2f} {misfit(best):7.2f} {100 * error:17.2f} %")

# %%
# All four searches find the same minimum. Its distance from the truth is due to the noise in the counts. The expected
# misfit is half of the number of residuals minus the number of unknowns, here 27.
#
# The picture
# -----------
# Exercises
# ---------
# 1. Let the first guess of the rates be wrong by a factor of two. Which searches still arrive?
# 2. Take counts of the prey alone. Which rates can still be found?
# 3. Let each of the rates change from year to year, so that there are 20 times as many unknowns. How do the times of
#    one gradient change?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, ax = pyplot.subplots(figsize=(6.5, 3.8), layout="constrained")
    times = dt * between * np.arange(1, options.counts + 1)
    for place, name in enumerate(("prey", "predators")):
        ax.plot(times, np.exp(counted[:, place]), "o", color=f"C{place}", label=f"{name}, counted")
        ax.plot(times, predicted(best, step)[:, place], color=f"C{place}", label=f"{name}, fitted")
        ax.plot(times, predicted(start, step)[:, place], ":", color=f"C{place}", label=f"{name}, first guess")
    ax.set(xlabel="time [years]", ylabel="number")
    ax.legend(frameon=False, ncols=2)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "predator_prey.png", dpi=120)
