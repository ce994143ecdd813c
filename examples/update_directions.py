r"""
One update, three directions
============================

Gradient descent, Newton, and the physics backwards, on two variables and with published figures.

The loss has only two variables, so everything can be drawn. One of them is felt linearly, the other by its square, and
this is enough to part the ways: the first direction depends on how the variables are scaled, the second hardly, and the
third goes straight to the solution.

Run it: ``python examples/update_directions.py [steps] [--out FOLDER]``
"""

import argparse
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="One update, three directions, two variables.")
parser.add_argument("steps", nargs="?", type=int, default=10)
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# The problem
# -----------
# The physics is :math:`y = (x_1, x_2^2)`, and the loss :math:`J = |y|^2`. It can be undone: a root has two branches,
# and we stay on the branch of the present :math:`x`.


def physics(x):
    """Return two results for two variables."""
    return np.stack([x[0], x[1] ** 2])


def inverse(y, x):
    """The variables that give y, near x."""
    return np.stack([y[0], np.copysign(np.sqrt(y[1]), x[1])])


square = dp.value_and_grad(lambda x, physics: np.sum(physics(x) ** 2))

# %%
# Three directions
# ----------------
# All methods make the step :math:`x \leftarrow x - \rho \, d`. They differ in :math:`d`.
#
# Gradient descent takes :math:`d = \nabla J = (2 x_1, 4 x_2^3)`. Where :math:`x_2` is large it is nearly all that
# counts.


def gradient(x):
    """The gradient itself."""
    return square(x, physics)[1]


# %%
# Newton divides by the curvature, :math:`d = H^{-1} \nabla J`. Each row of :math:`H` is a gradient of a gradient.


def newton(x):
    """The gradient, divided by the Hessian."""
    rows = [dp.value_and_grad(lambda x, i=i: gradient(x)[i])(x)[1] for i in range(2)]
    return np.linalg.solve(np.stack(rows), gradient(x))


# %%
# The physical gradient makes the step in :math:`y`, where the loss is round, and then runs the physics backwards:
#
# .. math:: d = x - \text{inverse}(y - \rho_y \, y) .
#
# In code the inverse takes the place of the derivative in the backward pass; the rest of the program stays as it is.


def physical(rate):
    """The step y - rate y, and the physics backwards."""
    rule = dp.physical_gradient(physics, inverse, rate / 2)  # the cotangent of |y|^2 is 2 y
    return lambda x: square(x, rule)[1]


def update(x, direction, rate):
    """Apply an update to the variables, as all methods do."""
    return x - rate * direction(x)


# %%
# Ten steps each
# --------------
# From (3, 3). The column *diagonal* says how the first step is shared: :math:`\sqrt 2` would be evenly.

methods = {
    "gradient descent": (gradient, 0.01, options.steps, "1.053930  (2.4512184, 0.96171147)"),
    "Newton": (newton, 1 / 3, options.steps, "1.264911  (0.05202458, 0.92383826)"),
    "physical gradient": (physical(0.3), 1.0, options.steps, "1.356443  (0.08474258, 0.50421)"),
    "the same, rate 1": (physical(1.0), 1.0, 1, "-"),
}
paths = {}
print("update             steps  diagonal  the end                       loss  us a step  published")
for name, (direction, rate, steps, published) in methods.items():
    path = [np.array([3.0, 3.0])]
    clock = perf_counter()
    for _ in range(steps):
        path.append(update(path[-1], direction, rate))
    microseconds = 1e6 * (perf_counter() - clock) / steps
    first, last = path[0] - path[1], path[-1]
    diagonal = np.sum(first) / np.linalg.norm(first)
    value, _ = square(last, physics)
    text = f"{name:18} {steps:5} {diagonal:9.6f}  ({last[0]:.8f}, {last[1]:.8f}) {value:9.1e}"
    print(f"{text} {microseconds:10.0f}  {published}")
    paths[name] = np.transpose(path)

# %%
# The picture
# -----------
# The ways on a map of the loss; each ring is a factor of 10.
#
# Exercises
# ---------
# 1. Raise the rate of gradient descent. At which rate does the first step overshoot, and in which variable?
# 2. Take :math:`y = (x_1, x_2^4)`. Which of the three directions is the same as before?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, ax = pyplot.subplots(figsize=(6, 5), layout="constrained")
    side = np.linspace(-0.3, 3.3, 200)
    first, second = np.meshgrid(side, side)
    rings = ax.contour(first, second, first**2 + second**4, 10.0 ** np.arange(-3, 3), colors="0.8", zorder=0)
    ax.clabel(rings, fmt="%g", fontsize="small")
    for (name, path), line in zip(paths.items(), ("o-", "s-", "^-", "k--")):
        ax.plot(*path, line, markersize=4, label=name)
    ax.set(title="three ways to the minimum", xlabel="$x_1$", ylabel="$x_2$", aspect="equal")
    ax.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 0.05), fontsize="small")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "update_directions.png", dpi=120)
