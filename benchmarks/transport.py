"""What each transport scheme reaches, value and gradient, and what a step of it costs.

Error: a wave on the periodic square is carried by a wind that is the same everywhere. The value is a mode of the
field at the end, the gradient its derivative in the wind; both are known in closed form. Error and order stand
beside the seconds of value and gradient.
Cost: one step forward, and value and gradient on the tape of a weighted sum of its result: in the field, in field and
velocity, and in field, velocity and time step. The gate is for all three at once. What the weighted sum costs without
a step is printed too: it is part of every gradient, and taken out in the column "less sum". All rows of a table run
in turn and the smallest time counts; only ratios of one run mean anything.

Run ``python -m benchmarks.transport [--quick]`` in the root of the repository.
"""

import argparse
from math import cos, log2, nan, pi, sin
from time import perf_counter

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.triad import best_times
from sparsedp import kernels

WIND, END = (0.7, -0.4), 0.5
SCHEMES = {
    "upwind": {"scheme": "upwind"},
    "van_leer": {"scheme": "van_leer"},
    "semi_lagrangian, linear": {"scheme": "semi_lagrangian"},
    "semi_lagrangian, cubic": {"scheme": "semi_lagrangian", "interpolation": "cubic"},
    "maccormack": {"scheme": "maccormack"},
}
ASKED = {1: "u", 2: "u, v", 3: "u, v, dt"}  # by the number of arguments that are differentiated
LIMIT = 3.5  # value and gradient on the tape, over the step forward


# ---------------------------------------------------------------- error


def exact():
    """Value and its derivative in both components of the wind: int w u with w, u products of sines."""
    (a, b), turn = WIND, 2 * pi * END
    value = 0.125 * cos(turn * a) * cos(turn * b)
    return value, np.array(
        [-0.125 * turn * sin(turn * a) * cos(turn * b), -0.125 * turn * cos(turn * a) * sin(turn * b)]
    )


def wave(n, options):
    """Return the loss of one scene, a mode of the final field. The wind carries sine waves at a CFL number of 0.275."""
    grid = dp.Grid((n, n), size=1.0, periodic=True)
    x, y = grid.centres()
    mode = np.sin(2 * pi * x) * np.sin(2 * pi * y)
    steps = 2 * n
    move, dt = dp.transport(grid, **options), END / steps

    def loss(wind):
        v = grid.join(wind[0] * np.ones(grid.shape), wind[1] * np.ones(grid.shape))
        return anp.mean(mode * dp.rollout(lambda u, v: move(u, v, dt), 1 + 0.5 * mode, v, steps))

    return loss


def errors(sizes):
    """Print error and order of value and gradient, with the seconds of both."""
    value, slope = exact()
    print(f"\nwave on the periodic square, {END} in time, wind {WIND}; errors relative")
    print(f"{'scheme':26} {'cells':>10} {'value':>9} {'order':>6} {'gradient':>9} {'order':>6} {'ms':>9}")
    for name, options in SCHEMES.items():
        before = (nan, nan)
        for n in sizes:
            both = dp.value_and_grad(wave(n, options))
            both(np.array(WIND))  # compiled and warm
            start = perf_counter()
            found, gradient = both(np.array(WIND))
            seconds = perf_counter() - start
            now = (abs(found - value) / abs(value), np.linalg.norm(gradient - slope) / np.linalg.norm(slope))
            orders = [log2(old / new) for old, new in zip(before, now)]
            print(
                f"{name:26} {f'{n} x {n}':>10} {now[0]:9.1e} {orders[0]:6.2f} {now[1]:9.1e} {orders[1]:6.2f}"
                f" {1e3 * seconds:9.1f}"
            )
            before = now


# ---------------------------------------------------------------- cost


def cost(shape, rounds):
    """Print one block: nanoseconds a cell of a step, and value and gradient over it for each set of arguments."""
    grid = dp.Grid(shape, size=1.0, periodic=True)
    rng = np.random.default_rng(0)
    u, v, weights = rng.random(shape), rng.uniform(-1, 1, grid.faces.size), rng.standard_normal(shape)
    dt = 0.15 / sum(shape)
    # Half a scalar product as one rule, so that what is timed is the step.
    weigh = dp.differentiable("weigh", lambda u: np.vdot(u, weights), lambda nums, ans, u: lambda g: (g * weights,))
    alone = dp.value_and_grad(weigh)
    tasks = {("weighted sum alone", 0): lambda: alone(u)}
    for name, options in SCHEMES.items():
        move = dp.transport(grid, **options)
        tasks[name, 0] = lambda move=move: move(u, v, dt)
        for many in ASKED:
            both = dp.value_and_grad(lambda p, move=move, many=many: weigh(move(*p, *(u, v, dt)[many:])))
            tasks[name, many] = lambda both=both, many=many: both((u, v, dt)[:many])
    for task in tasks.values():
        task()
    best, cells = best_times(tasks, rounds), np.prod(shape)
    kind = "numba" if kernels.compiled() else "NumPy"
    print(f"\n{' x '.join(map(str, shape))} cells, {kernels.threads()} threads, kernels: {kind}; ns a cell, and ratios")
    print(
        f"{'scheme':26} {'forward':>9}"
        + "".join(f"{words:>10}" for words in ASKED.values())
        + f"{'limit':>7}{'less sum':>10}"
    )
    alone = best["weighted sum alone", 0]
    for name in SCHEMES:
        forward, *ratios = best[name, 0], *(best[name, many] / best[name, 0] for many in ASKED)
        numbers = f"{1e9 / cells * forward:9.1f}" + "".join(f"{ratio:10.2f}" for ratio in ratios)
        print(f"{name:26} {numbers}{LIMIT:7.1f}{ratios[-1] - alone / forward:10.2f}")
    print(f"{'weighted sum alone':26} {1e9 / cells * alone:9.1f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, few repeats")
    parser.add_argument("--part", choices=("errors", "cost"), help="one part only")
    options = parser.parse_args()
    if options.part != "cost":
        errors((16, 32) if options.quick else (32, 64, 128, 256))
    if options.part != "errors":
        for shape in ((64, 64), (16, 16, 16)) if options.quick else ((1024, 1024), (100, 100, 100)):
            cost(shape, 2 if options.quick else 7)


if __name__ == "__main__":
    main()
