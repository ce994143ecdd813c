r"""
Reactions on ten thousand cells, and where to disturb them
===========================================================

The Brusselator with diffusion: a stiff system of many unknowns, error control, and the gradient in a whole field.

Two species react and diffuse. The time in which neighbouring cells become equal is thousands of times shorter than a
period of the reaction: the system is stiff. Explicit steps must resolve the short time. `rodas5p` takes implicit steps
as long as the reaction allows, with one sparse factorisation each, and its gradient uses the same factors.

Run it: ``python examples/reaction_waves.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np
from scipy.integrate import solve_ivp

import sparsedp as dp

parser = argparse.ArgumentParser(description="The Brusselator on a grid: stiff steps with sparse Jacobians.")
parser.add_argument("cells", nargs="?", type=int, default=70, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()
n = options.cells

# %%
# The reactions
# -------------
# With concentrations u and v,
#
# .. math:: u_t = a - (b + 1) u + u^2 v + D \Delta u, \qquad v_t = b u - u^2 v + D \Delta v,
#
# and no flux through the walls. For :math:`b > 1 + a^2` the reactions oscillate.

grid = dp.Grid((n, n), size=1.0)
spread = dp.laplacian(grid, dp.neumann)
params = {"a": 1.0, "b": 3.0, "D": 0.02}


def rate(s, p):
    """Rates of change of u and v."""
    reaction = s["u"] ** 2 * s["v"]
    return {
        "u": p["a"] - (p["b"] + 1) * s["u"] + reaction + p["D"] * spread(s["u"]),
        "v": p["b"] * s["u"] - reaction + p["D"] * spread(s["v"]),
    }


# %%
# A known result
# --------------
# If all cells start equal, they stay equal, and follow two ordinary differential equations.

end = 6.0
step = dp.stepper("rodas5p", rate, end / 5, tolerance=1e-4)
ones = np.ones(grid.shape)
equal = dp.rollout(step, {"u": 1.5 * ones, "v": 2.0 * ones}, params, 5, keep="all")


def well_mixed(t, z):
    """The reactions without diffusion, for SciPy."""
    reaction = z[0] ** 2 * z[1]
    return [params["a"] - (params["b"] + 1) * z[0] + reaction, params["b"] * z[0] - reaction]


times = np.linspace(0.0, end, 6)
exact = solve_ivp(well_mixed, (0, end), [1.5, 2.0], method="Radau", rtol=1e-10, atol=1e-12, dense_output=True).sol
errors = np.abs(equal["u"] - exact(times)[0][:, None, None])
print(f"Equal cells against two ODEs (SciPy): largest error {np.max(errors):.1e}")

# %%
# Waves
# -----
# A gradient of phases makes waves. Explicit steps of order 4 are stable up to :math:`2.8 / (8 D / h^2)`.

x, y = grid.centres()
start = {"u": 1.5 + np.cos(np.pi * x) * ones, "v": 2.0 - np.cos(2 * np.pi * y) * ones}
clock = perf_counter()
states = dp.rollout(step, start, params, 5, keep="all")
seconds = perf_counter() - clock
explicit = int(np.ceil(end * 8 * params["D"] * n**2 / 2.8))
whole = dp.stepper("rodas5p", rate, end, tolerance=1e-4)
whole(start, params)
print(f"{2 * n**2} unknowns: {len(whole.taken)} steps of rodas5p; rk4 would need {explicit} to be stable")

# %%
# Where to disturb them
# ---------------------
# How does the amount of u in the corner at the end change with each number at the start? One backward pass answers for
# all cells, and for the parameters.

corner = (x < 0.25) & (y < 0.25)
corner = corner / np.sum(corner)


def amount(s, p):
    """Mean of u in the corner at the end."""
    return np.sum(corner * dp.rollout(step, s, p, 5)["u"])


clock = perf_counter()
value, (of_start, of_params) = dp.value_and_grad(lambda z: amount(*z))((start, params))
both = perf_counter() - clock
print(f"value {value:.4f} in {seconds:.2f} s; with all {2 * n**2 + 3} derivatives {both / seconds:.1f} times as long")
print("derivatives in", ", ".join(f"{name}: {slope:.4f}" for name, slope in of_params.items()))

# %%
# The same derivative by forward mode, along one direction, and by a difference of two runs:

direction = {"u": np.sin(3 * x + y), "v": np.cos(2 * x * y)}
forward = dp.jvp(lambda s: amount(s, params), start, direction)[1]
reverse = np.sum(of_start["u"] * direction["u"]) + np.sum(of_start["v"] * direction["v"])
print(f"forward and reverse mode differ by {abs(forward / reverse - 1):.0e}")
moved = [{name: start[name] + h * direction[name] for name in start} for h in (1e-3, -1e-3)]
difference = (amount(moved[0], params) - amount(moved[1], params)) / 2e-3
print(f"a difference of two runs: off by {abs(difference / reverse - 1):.0e}")

# %%
# The picture
# -----------
# Waves of u at two times, the oscillation of equal cells with that of SciPy, and the derivative of the amount in the
# corner with respect to u at the start.
#
# Exercises
# ---------
# 1. Double the cells. How do the numbers of steps of both methods change?
# 2. Use `radau` on a grid of 15 x 15 cells, and compare seconds of value and gradient.
# 3. Find a start that has the largest amount in the corner, for a given norm of its change.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, axes = pyplot.subplots(1, 4, figsize=(14, 3.4), layout="constrained")
    for ax, k in zip(axes, (1, 5)):
        image = ax.imshow(states["u"][k].T, origin="lower", extent=(0, 1, 0, 1), cmap="viridis")
        ax.set(title=f"u at t = {times[k]:g}", xticks=[], yticks=[])
        picture.colorbar(image, ax=ax)
    fine = np.linspace(0.0, end, 300)
    axes[2].plot(fine, exact(fine)[0], label="two ODEs (SciPy)")
    axes[2].plot(times, equal["u"][:, 0, 0], "o", label="equal cells")
    axes[2].set(title="u of equal cells", xlabel="time")
    axes[2].legend(frameon=False)
    largest = np.max(np.abs(of_start["u"])) * n**2
    image = axes[3].imshow(
        of_start["u"].T * n**2, origin="lower", extent=(0, 1, 0, 1), cmap="RdBu", vmin=-largest, vmax=largest
    )
    axes[3].set(title="derivative in u at the start", xticks=[], yticks=[])
    picture.colorbar(image, ax=axes[3])
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "reaction_waves.png", dpi=120)
