"""One update, three directions, two variables. Run: python examples/update_directions.py [steps] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

count = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 10
physics = lambda x: np.stack([x[0], x[1] ** 2])
inverse = lambda y, x: np.stack([y[0], np.copysign(np.sqrt(y[1]), x[1])])  # on the branch of the present x
square = dp.value_and_grad(lambda x, physics: np.sum(physics(x) ** 2))


def gradient(x):
    return square(x, physics)[1]


def newton(x):
    curvature = [dp.value_and_grad(lambda x, i=i: gradient(x)[i])(x)[1] for i in range(2)]
    return np.linalg.solve(np.stack(curvature), gradient(x))


def physical(rate):
    """y - rate y, and the physics backwards: the backward rule takes the place of the derivative."""
    rule = dp.physical_gradient(physics, inverse, rate / 2)  # the cotangent of |y|^2 is 2 y
    return lambda x: square(x, rule)[1]


def update(x, direction, rate):  # what all methods share
    return x - rate * direction(x)


print("update             steps  diagonal  the end                       loss  us a step  published")
paths = {}
for name, direction, rate, steps, published in (
    ("gradient descent", gradient, 0.01, count, "1.053930  (2.4512184, 0.96171147)"),
    ("Newton", newton, 1 / 3, count, "1.264911  (0.05202458, 0.92383826)"),
    ("physical gradient", physical(0.3), 1.0, count, "1.356443  (0.08474258, 0.50421)"),
    ("the same, rate 1", physical(1.0), 1.0, 1, "-"),
):
    path, clock = [np.array([3.0, 3.0])], perf_counter()
    for _ in range(steps):
        path.append(update(path[-1], direction, rate))
    micro, first, last = 1e6 * (perf_counter() - clock) / steps, path[0] - path[1], path[-1]
    paths[name], aligned = np.transpose(path), np.sum(first) / np.linalg.norm(first)
    text = f"{name:18} {steps:5} {aligned:9.6f}  ({last[0]:.8f}, {last[1]:.8f}) {square(last, physics)[0]:9.1e}"
    print(f"{text} {micro:10.0f}  {published}")

if "--out" in sys.argv:
    from matplotlib import pyplot

    for name, path in paths.items():
        pyplot.plot(*path, ".-", label=name)
    pyplot.legend()
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    pyplot.savefig(Path(sys.argv[-1]) / "update_directions.png", dpi=120)
