r"""
Data assimilation
=================

The state of a chaotic model and of a flow, from few and noisy observations.

A forecast starts from the state of today. It is known from an earlier forecast, the *background*, which is wrong by
now, and from observations, which are few. 4D-Var looks for the initial state of a time window from which the model
passes close to both. If the model itself has errors, they are unknowns too. In twin experiments the truth is known, so
that we can measure the error of the result, and how long a search takes.

Run it: ``python examples/data_assimilation.py [cells] [--out FOLDER]``
"""

import argparse
import time
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="4D-Var for Lorenz-96 and for a flow, beside the truth.")
parser.add_argument("cells", nargs="?", type=int, default=64, help="cells along an axis of the flow")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()


def rms_error(states, truth):
    """Return the root mean square of all differences."""
    return np.sqrt(np.mean((states - truth) ** 2))


# %%
# The background
# --------------
# The errors of a background are smooth: those of neighbours are correlated. Their covariance is :math:`B = R R^T` with
#
# .. math:: R = c \, (1 - l^2 \Delta)^{-p} .
#
# The number :math:`c` gives all entries the standard deviation :math:`s`. We search for :math:`z` with
# :math:`x = x_b + R z` (control variable transform). The entries of :math:`z` have variance 1 and are independent: the
# background term of the cost is :math:`\frac{1}{2} |z|^2`.


def root_of_covariance(grid, deviation, length, power):
    """Return the operator R."""
    helmholtz = dp.identity(grid.cells) - length**2 * dp.laplacian(grid)
    smooth = dp.matrix_power(helmholtz, -power)
    spike = np.zeros(grid.shape)
    spike.flat[0] = 1.0
    return (deviation / np.linalg.norm(smooth(spike))) * smooth


# %%
# Lorenz's model
# --------------
# Lorenz-96 has forty variables on a circle, with :math:`\dot x_i = (x_{i+1} - x_{i-2}) x_{i-1} - x_i + 8`. Errors
# double in about two days, which are 0.4 units of time. Every second variable is observed every 12 hours, with a
# standard deviation of 0.5. A window has four days. The last state of an analysis is the background of the next window.
#
# The true model differs from ours: every 12 hours a random model error :math:`q` is added to its state. A *strong*
# constraint ignores this. A *weak* constraint has the model errors as unknowns, with the prior :math:`q = R_q z_q`; in
# the loop over time they are inputs.

RING = dp.Grid(40, size=40.0, periodic=True)
WINDOW = 8  # half days
CYCLES = 12  # windows
NOISE = 0.5  # standard deviation of an observation
R = root_of_covariance(RING, 0.8, 1.0, 1.0)
R_q = root_of_covariance(RING, 0.3, 1.0, 1.0)
sensors = dp.sample(RING, np.arange(0.5, 40.0, 2.0)[:, None])
model = dp.stepper("rk4", lambda x, force: (np.roll(x, -1) - np.roll(x, 2)) * np.roll(x, 1) - x + force, 0.05)


@dp.jit
def half_day(x, force, model_error):
    """Return the state after two steps of the model, plus an error of the model."""
    return model(model(x, force), force) + model_error


def forecast(x, model_errors):
    """Return the states of all half days."""
    return dp.rollout(half_day, x, 8.0, len(model_errors), model_errors, keep="all")


def analysis(background, data, weak):
    """Return the states of a window, and the result of the search."""

    def states(z):
        model_errors = np.zeros((WINDOW, 40))
        if weak:
            model_errors = R_q(z["model_errors"])
        return forecast(background + R(z["start"]), model_errors)

    def residuals(z):
        misses = (sensors(states(z)[1:]) - data) / NOISE
        return np.concatenate([np.ravel(part) for part in (misses, *z.values())])

    start = {"start": np.zeros(40)}
    if weak:
        start["model_errors"] = np.zeros((WINDOW, 40))
    best = dp.minimize(residuals, start, "gauss_newton", maxiter=10, tolerance=1e-2, dense=False, accuracy=1e-2)
    return states(best.x), best


rng = np.random.default_rng(1)
start = dp.rollout(model, 8.0 + np.sin(np.arange(40)), 8.0, 400)
truth = forecast(start, R_q(rng.standard_normal((CYCLES * WINDOW, 40))))
data = sensors(truth[1:]) + NOISE * rng.standard_normal((CYCLES * WINDOW, 20))
first_background = truth[0] + R(rng.standard_normal(40))

print("Lorenz-96       error of the background  of its forecast  of the analysis  iterations  seconds")
errors_in_time = {}
for name, weak in (("strong", False), ("weak", True)):
    background = first_background
    errors = {"background": [], "forecast": [], "analysis": []}
    iterations = 0
    start_time = time.perf_counter()
    for cycle in range(CYCLES):
        window = slice(cycle * WINDOW, (cycle + 1) * WINDOW)
        true_states = truth[window.start : window.stop + 1]
        states, best = analysis(background, data[window], weak)
        errors["background"].append(rms_error(background, true_states[0]))
        forecast_states = forecast(background, np.zeros((WINDOW, 40)))
        errors["forecast"] += [rms_error(*pair) for pair in zip(forecast_states, true_states)]
        errors["analysis"] += [rms_error(*pair) for pair in zip(states, true_states)]
        iterations += best.history[-1].iteration
        background = states[-1]
    seconds = time.perf_counter() - start_time
    errors_in_time[name] = errors
    means = [np.mean(errors[kind]) for kind in ("background", "forecast", "analysis")]
    print(f"{name:14} {means[0]:24.3f} {means[1]:16.3f} {means[2]:16.3f} {iterations:11} {seconds:8.1f}")

# %%
# A flow
# ------
# The vorticity :math:`\omega` of a plane flow is carried by its own velocity :math:`v = \nabla \times \psi` with
# :math:`-\Delta \psi = \omega`. Sixty sensors measure it at four times. The background is zero: only its covariance is
# known.


class Flow:
    """The flow on n x n cells, its truth and its data."""

    steps = 16
    dt = 0.05
    noise = 0.5  # standard deviation of an observation
    times = [4, 8, 12, 16]  # the steps after which it is observed

    def __init__(self, n):
        self.grid = dp.Grid((n, n), size=1.0, periodic=True)
        laplacian = dp.laplacian(self.grid)
        stream = dp.inverse(-laplacian, nullspace="project")
        curl = dp.curl(self.grid)
        move = dp.transport(self.grid, "semi_lagrangian", interpolation="cubic")
        spread = dp.matrix_exponential(laplacian, 1e-4 * self.dt)

        @dp.jit
        def step(vorticity, params):
            psi = stream(vorticity)  # at the centres of cells; next its means at their corners
            psi = 0.5 * (psi + np.roll(psi, 1, 0))
            psi = 0.5 * (psi + np.roll(psi, 1, 1))
            return spread(move(vorticity, curl(psi), self.dt))

        self.step = step
        self.root = root_of_covariance(self.grid, 4.0, 0.05, 2.0)
        draw = np.random.default_rng(0)
        truth = self.root(draw.standard_normal((n, n)))
        self.truth = truth - np.mean(truth)
        self.places = draw.uniform(0.0, 1.0, (60, 2))
        self.sensors = dp.sample(self.grid, self.places)
        exact = self.readings(self.truth)
        self.data = exact + self.noise * draw.standard_normal(exact.shape)

    def readings(self, start):
        """Return the values at the sensors, at all times."""
        states = dp.rollout(self.step, start, None, self.steps, keep=self.times)
        return self.sensors(states)

    def residuals(self, z):
        """Return the residuals of the control variables z, each with variance 1."""
        misses = (self.readings(self.root(z)) - self.data) / self.noise
        return np.concatenate([np.ravel(z), np.ravel(misses)])

    def cost(self, z):
        """Return half of the sum of the squares of the residuals."""
        return 0.5 * np.sum(self.residuals(z) ** 2)

    def plain_cost(self, x):
        """Return the cost as a function of the vorticity itself."""
        misses = (self.readings(x) - self.data) / self.noise
        return 0.5 * np.sum(x * self.precision(x)) + 0.5 * np.sum(misses**2)

    @property
    def precision(self):
        """The inverse of the covariance B."""
        return dp.inverse(self.root @ self.root.T)


flow = Flow(options.cells)
zero = np.zeros(flow.grid.shape)

# %%
# Four searches
# -------------
# Gauss-Newton solves a linearized problem in each iteration, by products with the tangent-linear model and its adjoint:
# this is incremental 4D-Var. Two digits of each step are enough. L-BFGS takes one gradient in an iteration. In the
# metric of the precision :math:`B^{-1}` it needs no control variable transform. Without either, its first directions
# are rough fields, and the search takes many more iterations.
#
# Before the search: is the gradient right, and is the adjoint the transpose of the tangent-linear model?

draw = np.random.default_rng(2)
v = draw.standard_normal(zero.shape)
w = draw.standard_normal(flow.data.shape)
tangent = dp.jvp(flow.readings, flow.truth, v)[1]
cotangent = dp.vjp(flow.readings, flow.truth)[1](w)
print()
print(f"gradient: {dp.check.gradient(flow.cost, 0.1 * v, quick=True).verdict}")
print(f"adjoint test: {abs(np.sum(tangent * w) / np.sum(v * cotangent) - 1):.0e}")

searches = {
    "gauss_newton, z": (flow.residuals, "gauss_newton", 12, {"dense": False, "accuracy": 1e-2}, flow.root),
    "lbfgs, z": (flow.cost, "lbfgs", 120, {}, flow.root),
    "lbfgs, metric": (flow.plain_cost, "lbfgs", 120, {"metric": flow.precision}, lambda x: x),
    "lbfgs, plain": (flow.plain_cost, "lbfgs", 120, {}, lambda x: x),
}
print()
print("flow                 cost  iterations  seconds  error at the start  at the end")
rms_of_truth = rms_error(flow.truth, 0.0)
true_end = dp.rollout(flow.step, flow.truth, None, flow.steps)
curves = {}
fields = {}
for name, (loss, method, maxiter, arguments, field) in searches.items():
    curve = []

    def note(record, x, curve=curve, field=field):
        curve.append((record.seconds, rms_error(field(x), flow.truth) / rms_of_truth))

    best = dp.minimize(loss, zero, method, maxiter, 1e-4, note, **arguments)
    fields[name] = field(best.x)
    end = dp.rollout(flow.step, fields[name], None, flow.steps)
    error_at_end = rms_error(end, true_end) / rms_error(true_end, 0.0)
    last = best.history[-1]
    curves[name] = curve
    _, error_at_start = curve[-1]
    both_errors = f"{error_at_start:18.3f}  {error_at_end:10.3f}"
    print(f"{name:16} {best.value:8.2f}  {last.iteration:10}  {last.seconds:7.1f}  {both_errors}")

# %%
# The picture
# -----------
# First the errors of the analysis of Lorenz-96 in time: they are smaller with the weak constraint. Then the true
# vorticity at the start, and the estimate from sixty sensors (points). The last panel shows the error of the vorticity
# against the time of the search.
#
# Exercises
# ---------
# 1. Double the errors of the true model, but not :math:`R_q` in the analysis. For which constraint does the error of
#    the analysis grow more?
# 2. Draw the error of the vorticity together with the sensors. Is it smaller upstream of them?
# 3. ``dp.laplace(misfit, z, prior=1.0)`` estimates the uncertainty. Compare its standard deviations with the errors.

if options.out:
    from matplotlib import pyplot

    picture, axes = pyplot.subplots(1, 4, figsize=(17, 3.8), layout="constrained")
    days = 0.5 * np.arange(CYCLES * (WINDOW + 1)) * WINDOW / (WINDOW + 1)
    for name, errors in errors_in_time.items():
        axes[0].plot(days, errors["analysis"], label=f"{name} constraint")
    axes[0].set(title="Lorenz-96: analysis", xlabel="days", ylabel="error", ylim=(0.0, None))
    axes[0].legend()
    limits = -np.max(np.abs(flow.truth)), np.max(np.abs(flow.truth))
    for ax, (title, field) in zip(axes[1:3], {"truth": flow.truth, "estimate": fields["gauss_newton, z"]}.items()):
        dp.plot(flow.grid, field, ax=ax, title=title, label="vorticity", limits=limits)
        ax.plot(*flow.places.T, "k.", markersize=3)
    for name, curve in curves.items():
        axes[3].plot(*zip(*curve), label=name)
    axes[3].set(title="error against time", xlabel="seconds", ylabel="error of the vorticity", xscale="log")
    axes[3].legend(loc="lower left")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "data_assimilation.png", dpi=120)
