"""Error against run time of every integrator on a stiff diffusion-reaction problem, with gradients.

Allen-Cahn, u' = nu L u + u - u^3 on the closed unit square, nu = 0.01, from random waves. The error is that of
the state at the end, in the largest entry; the gradient is that of sum(u_end^2)/2 in nu, against the same with
far smaller steps. A row is marked * when no other row is both faster and closer. Explicit rows stay below
their stable limit. The second table takes 1000 times the limit of Euler's method at 256 x 256. Those after it put
nonlinear steps beside plain SciPy (beside_scipy.py).

Run ``python -m benchmarks.integrators [--quick]`` in the root of the repository.
"""

import argparse
from time import perf_counter

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.beside_scipy import fields, kinetics, species, stages
from sparsedp import kernels

NU, END = 0.01, 1.0
RUNS = {  # method -> numbers of steps; None: as many as are stable, and twice as many
    "euler": (None,),
    "rk4": (None,),
    "backward_euler": (10, 40),
    "crank_nicolson": (10, 40),
    "tr_bdf2": (5, 20),
    "imex": (5, 20, 80, 320),
    "etdrk4": (5, 10, 20, 40),
}
EXPLICIT = {"euler": 2.0, "rk4": 2.785}


def react(u, nu):
    return u - u**3


def scene(n):
    """(Laplacian, start): a few smooth waves."""
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    rng = np.random.default_rng(0)
    start = sum(
        rng.standard_normal() * np.cos(np.pi * i * x) * np.cos(np.pi * j * y) / (1 + i + j)
        for i in range(5)
        for j in range(5)
    )
    return dp.laplacian(grid), 0.5 * start


def run(method, L, start, end, n, nu):
    """State after n steps."""
    step = dp.stepper(method, react, end / n, linear=(L, lambda nu: nu))
    return step, dp.rollout(step, start, nu, n)


def timed(method, L, start, end, n):
    """(state, derivative of sum(u^2)/2 in nu, seconds forward, seconds of value and gradient); set-up included."""
    state, forward = fastest(lambda: run(method, L, start, end, n, NU)[1])
    (_, slope), both = fastest(
        lambda: dp.value_and_grad(lambda nu: anp.sum(run(method, L, start, end, n, nu)[1] ** 2) / 2)(NU)
    )
    return state, slope, forward, both


def fastest(task):
    """(result, smallest time of three runs, or of one that takes more than a second)."""
    best = np.inf
    for _ in range(3):
        clock = perf_counter()
        result = task()
        best = min(best, perf_counter() - clock)
        if best > 1:
            break
    return result, best


def rows(cells):
    """Table of all methods; the reference is etdrk4 with 400 steps."""
    L, start = scene(cells)
    exact, slope, *_ = timed("etdrk4", L, start, END, 400)
    largest = 8 * cells**2 * NU
    found = []
    for method, counts in RUNS.items():
        for n in counts:
            n = n or int(np.ceil(1.05 * END * largest / EXPLICIT[method]))
            state, g, *seconds = timed(method, L, start, END, n)
            found.append((method, n, np.max(np.abs(state - exact)), abs(g / slope - 1), *seconds))
    return found


def table(cells):
    """Print one block."""
    found = rows(cells)
    print(f"\nAllen-Cahn, {cells} x {cells}, nu = {NU}, to t = {END}; {kernels.threads()} threads, kernels: {words()}")
    print(f"{'method':16} {'steps':>6} {'error':>9} {'of gradient':>12} {'forward s':>10} {'and gradient s':>15}")
    for row in found:
        method, n, error, of_gradient, forward, both = row
        best = not any(o[2] <= error and o[5] <= both and o is not row for o in found)
        print(f"{method:16} {n:6} {error:9.1e} {of_gradient:12.1e} {forward:10.3f} {both:15.3f} {'*' if best else ''}")


def words():
    return "numba" if kernels.compiled() else "NumPy"


def far_beyond(cells, steps):
    """1000 times the explicit limit: state, gradient, and the gradient against a central difference."""
    L, start = scene(cells)
    limit, dt = 2 / (8 * cells**2 * NU), 1000 * 2 / (8 * 256**2 * NU)
    print(f"\n{cells} x {cells}, {steps} steps of dt = {dt:.3g}, {dt / limit:.0f} times the limit of Euler's method")
    print(
        f"{'method':16} {'error':>9} {'dJ/dnu':>14} {'against difference':>19} {'forward s':>10} {'and gradient s':>15}"
    )
    exact = run("etdrk4", L, start, steps * dt, 100 * steps, NU)[1]
    for method in ("backward_euler", "tr_bdf2", "imex", "etdrk4"):
        state, g, forward, both = timed(method, L, start, steps * dt, steps)
        J = lambda nu, method=method: np.sum(run(method, L, start, steps * dt, steps, nu)[1] ** 2) / 2
        h = 1e-5 * NU
        central = (J(NU + h) - J(NU - h)) / (2 * h)
        error = np.max(np.abs(state - exact))
        print(f"{method:16} {error:9.1e} {g:14.6f} {abs(g / central - 1):19.1e} {forward:10.3f} {both:15.3f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes")
    quick = parser.parse_args().quick
    L, start = scene(16)
    for method in RUNS:
        timed(method, L, start, 0.01, 2)  # the first call of a compiled kernel is not the price of a step
    table(32 if quick else 128)
    far_beyond(64 if quick else 256, 4)
    fields((32,) if quick else (64, 128, 256))
    kinetics(quick)
    species(quick)
    stages(steps=20 if quick else 200)


if __name__ == "__main__":
    main()
