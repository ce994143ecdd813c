"""Time of value and gradient for small arrays, where the calls of Python are the cost, beside jax if it is installed.

Each case is written twice: with the library, and with slices (the twin), which runs under autograd and under jax
(float64, jitted, warm; a scan of single steps or of ten, whichever is faster). The rows of a case are

- the twin under autograd,
- a loop of steps, and a rollout of the step,
- the same with ``dp.jit(step)``, and ``dp.jit(loss)`` of the loss with the plain loop,
- a rollout of ``dp.jit(step, compile=True)``, and ``dp.jit(loss, compile=True)`` of the loss with the rollout,
- the twin under ``jax.jit``.

All rows of a case run in turn. The columns are the time of the value, median and minimum of the time of value and
gradient, these two divided by those of jax, the limit, the first call (it records or compiles; the kernels of the
library are compiled before), the part of it that the recording takes, the peak memory of a call, and the largest
difference from the gradient of the twin under autograd, relative to its largest entry.

Run ``python -m benchmarks.small`` in the root of the repository, or ``python -m benchmarks.small Lorenz smoke`` for the
cases whose names contain one of these words.
"""

import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from statistics import median
from typing import Any, NamedTuple

import autograd
import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.triad import best_times, times_in_turn
from sparsedp import kernels

FIRST = """
import time

from benchmarks.small import burgers, gradient, looped
from sparsedp import kernels
kernels.compiled() and __import__("numba")
case = burgers()
begun = time.process_time()
gradient(looped(case))(case.x)
print(time.process_time() - begun)
"""

FIRST_COMPILED = """
import time

import sparsedp as dp
from benchmarks.small import {case}, gradient, rolled
case = {case}()
gradient(rolled(case._replace(n=1)))(case.x)
begun = time.perf_counter()
gradient(rolled(case._replace(step=dp.jit(case.step, compile=True))))(case.x)
print(time.perf_counter() - begun)
"""


class Case(NamedTuple):
    """A loss of x: measure(np, end), where `n` steps lead from the state and params of begin(x) to the end.

    ``step(state, params)`` is that of the library, ``twin(np)`` returns that of slices, with autograd.numpy or
    jax.numpy.
    """

    name: str
    n: int
    x: np.ndarray
    begin: Callable[[Any], tuple]
    step: Callable
    twin: Callable[[Any], Callable]
    measure: Callable
    limit: float | None  # of the plain loop and rollout, value and gradient [ms]
    share: float | None  # limit of the rows with dp.jit, as a multiple of the time of jax
    repeats: int


# ---- cases -----------------------------------------------------------------------------------------------------------


def burgers():
    """The step of the literature: 128 cells, the mean square of the miss at the end, derivatives in the start."""
    n, dt, nu = 128, 1 / 32, 0.01 / (128 * np.pi)
    ring = dp.Grid(n, size=2.0, origin=-1.0, periodic=True)
    start, share = -np.sin(np.pi * ring.centres()[0]), n / 2.0
    L, carry = dp.laplacian(ring), dp.transport(ring, "semi_lagrangian", velocity="cells")

    def step(u, _):
        d = u + dt * nu * L(u)
        return carry(d, d, dt)

    def twin(np):
        def step(u, _):
            d = u + dt * nu * share**2 * (np.roll(u, -1) - 2 * u + np.roll(u, 1))
            place = np.arange(n) - dt * share * d
            cell = np.floor(place).astype(int)
            part = place - cell
            return (1 - part) * d[cell % n] + part * d[(cell + 1) % n]

        return step

    miss = lambda np, u: np.mean((u - 0.5 * start) ** 2)
    return Case("Burgers composed, 128 cells", 16, start, lambda u: (u, 0.5 * start), step, twin, miss, 1.0, 4.0, 200)


def donor_cell():
    """A step that is one rule of the library."""
    share, move = 0.5, dp.transport(dp.Grid(128, periodic=True), "upwind", velocity="cells")

    def twin(np):
        def step(u, v):
            ahead, behind = np.roll(u, -1) - u, u - np.roll(u, 1)
            return u - share * (np.minimum(v, 0.0) * ahead + np.maximum(v, 0.0) * behind)

        return step

    step = lambda u, v: move(u, v, share)
    return burgers()._replace(name="one rule, 128 cells", step=step, twin=twin, limit=0.13, share=3.0)


def smoke(n=32, dt=0.05):
    """Buoyant smoke in a closed box: the height of the smoke, derivatives in its start."""
    room = dp.Grid((n, n), size=1.0)
    carry = dp.transport(room, "semi_lagrangian")
    carry_wind = dp.transport(room, "semi_lagrangian", dp.dirichlet, of="faces")
    project, to_faces, up = dp.projection(room), dp.average(room), room.join(0.0, 1.0)

    def step(state, _):
        smoke, wind = state
        smoke = carry(smoke, wind, dt)
        return smoke, project(carry_wind(wind, wind, dt) + dt * up * to_faces(smoke))

    x, y = room.centres()
    begin = lambda smoke: ((smoke, np.zeros(room.faces.size)), None)
    height = lambda np, end: np.sum(y * end[0]) / np.sum(end[0])
    puff = np.exp(-((x - 0.45) ** 2 + (y - 0.3) ** 2) / 0.01)
    return Case(
        f"smoke, {n} x {n} cells", 20, puff, begin, step, lambda np: sliced_smoke(np, n, dt), height, 6.0, 1.3, 40
    )


def sliced_smoke(np, n, dt):
    """The step of smoke in slices; the projection by products with a matrix of cosines, both ways along each axis."""
    angles = anp.pi * anp.arange(n) / n
    cosines = anp.sqrt((2 - (angles == 0)) / n)[:, None] * anp.cos(anp.outer(angles, anp.arange(n) + 0.5))
    lines = (2 * n * anp.sin(angles / 2)) ** 2
    eigenvalues = lines[:, None] + lines
    weights = (eigenvalues > 0) / anp.where(eigenvalues > 0, eigenvalues, 1.0)
    none = lambda u, axis: np.pad(u, ((1, 1), (0, 0)) if axis == 0 else ((0, 0), (1, 1)), "constant")  # 0 at both ends

    def like(u, axis):
        """At both ends the value beside it."""
        first, last = (u[:1], u[-1:]) if axis == 0 else (u[:, :1], u[:, -1:])
        return np.concatenate([first, u, last], axis)

    def to_faces(u, axis):
        wide = like(u, axis)
        return 0.5 * (wide[1:] + wide[:-1] if axis == 0 else wide[:, 1:] + wide[:, :-1])

    def carried(wide, vx, vy):
        """Values at the departure points, linear between the points, of a field with its ghost cells."""
        shape = wide.shape[0] - 2, wide.shape[1] - 2
        px = np.clip(anp.arange(shape[0])[:, None] - dt * n * vx, -1.0, shape[0]) + 1.0
        py = np.clip(anp.arange(shape[1]) - dt * n * vy, -1.0, shape[1]) + 1.0
        i, j = (np.clip(np.floor(p), 0, m).astype(int) for p, m in zip((px, py), shape))
        a, b = px - i, py - j
        low, high = ((1 - b) * wide[k, j] + b * wide[k, j + 1] for k in (i, i + 1))
        return (1 - a) * low + a * high

    def step(state, _):
        smoke, wind = state
        vx, vy = wind[: (n + 1) * n].reshape(n + 1, n), wind[(n + 1) * n :].reshape(n, n + 1)
        cx, cy = 0.5 * (vx[1:] + vx[:-1]), 0.5 * (vy[:, 1:] + vy[:, :-1])
        smoke = carried(like(like(smoke, 0), 1), cx, cy)
        wx = carried(none(none(vx, 0), 1), vx, to_faces(cy, 0))[1:-1]
        wy = (carried(none(none(vy, 0), 1), to_faces(cx, 1), vy) + dt * to_faces(smoke, 1))[:, 1:-1]
        wide, high = none(wx, 0), none(wy, 1)
        b = n * (wide[1:] - wide[:-1] + high[:, 1:] - high[:, :-1])
        p = cosines.T @ (weights * (cosines @ b @ cosines.T)) @ cosines
        vx, vy = none(wx + n * (p[1:] - p[:-1]), 0), none(wy + n * (p[:, 1:] - p[:, :-1]), 1)
        return smoke, np.concatenate([vx.reshape(-1), vy.reshape(-1)])

    return step


def rk4(rate, h):
    """Return the step of the classical Runge-Kutta method, written out."""

    def step(u, p):
        a = rate(u, p)
        b = rate(u + h / 2 * a, p)
        c = rate(u + h / 2 * b, p)
        d = rate(u + h * c, p)
        return u + h / 6 * (a + 2 * b + 2 * c + d)

    return step


def predators(h=0.05):
    """200 steps of rk4 with two unknowns: the sum of squares at the end, derivatives in three rates."""

    def rate(np):
        return lambda u, p: np.array([p[0] * u[0] - p[1] * u[0] * u[1], p[1] * u[0] * u[1] - p[2] * u[1]])

    start, p = np.array([1.0, 0.5]), np.array([1.0, 0.8, 0.9])
    total = lambda np, u: np.sum(u**2)
    step, twin = dp.stepper("rk4", rate(anp), h), lambda np: rk4(rate(np), h)
    return Case("rk4, two unknowns", 200, p, lambda p: (start, p), step, twin, total, None, 5.0, 7)


def lorenz(n=40, h=0.05):
    """Lorenz-96: 20 steps of rk4, the sum of squares at the end, derivatives in the start."""

    def rate(np):
        return lambda u, force: (np.roll(u, -1) - np.roll(u, 2)) * np.roll(u, 1) - u + force

    start = 8.0 + np.sin(np.arange(n))
    total = lambda np, u: np.sum(u**2)
    step, twin = dp.stepper("rk4", rate(anp), h), lambda np: rk4(rate(np), h)
    return Case("Lorenz-96, 40 variables", 20, start, lambda u: (u, 8.0), step, twin, total, None, 5.0, 50)


def pendulums(n=50, intervals=60, dt=0.2):
    """Fifty pendulums on one trolley (examples/pendulums.py): their energy at the end, derivatives in the lengths."""

    def rate(np):
        def slopes(state, lengths):
            angle, turning = state
            return turning, -(9.81 * np.sin(angle) + 0.3 * np.cos(angle)) / lengths

        return slopes

    def twin(np):
        slopes = rate(np)

        def shifted(state, slope, h):
            return state[0] + h * slope[0], state[1] + h * slope[1]

        def step(state, lengths):
            a = slopes(state, lengths)
            b = slopes(shifted(state, a, dt / 2), lengths)
            c = slopes(shifted(state, b, dt / 2), lengths)
            d = slopes(shifted(state, c, dt), lengths)
            return tuple(u + dt / 6 * (k + 2 * l + 2 * m + q) for u, k, l, m, q in zip(state, a, b, c, d))

        return step

    energy = lambda np, state: np.mean(0.5 * state[1] ** 2 - 9.81 * np.cos(state[0]))
    begin = lambda lengths: ((np.full(n, 0.5), np.zeros(n)), lengths)
    step = dp.stepper("rk4", rate(anp), dt)
    return Case("fifty pendulums, rk4", intervals, np.linspace(5.0, 15.0, n), begin, step, twin, energy, None, None, 20)


def eigenvectors(grid, boundary):
    """Return the eigenvalues of the Laplacian, an array (n, n), and the eigenvectors along one axis."""
    line = dp.laplacian(dp.Grid(grid.shape[0], size=1.0), boundary).matrix.toarray()
    values, vectors = np.linalg.eigh(line)
    return values[:, None] + values, vectors


def poisson(n=64):
    """A solve on 64 x 64 cells with u = 0 at the walls: the sum of squares, derivatives in the source."""
    room = dp.Grid((n, n), size=1.0)
    solve = dp.inverse(-dp.laplacian(room, dp.dirichlet))
    values, vectors = eigenvectors(room, dp.dirichlet)

    def twin(np):
        return lambda b, _: vectors @ ((vectors.T @ b @ vectors) / -values) @ vectors.T

    x, y = room.centres()
    total = lambda np, u: np.sum(u**2)
    source = np.exp(-((x - 0.4) ** 2 + (y - 0.3) ** 2) / 0.02)
    return Case("Poisson, 64 x 64", 1, source, lambda b: (b, None), lambda b, _: solve(b), twin, total, None, 1.5, 200)


def reaction_diffusion(n=64, h=0.1, nu=1e-3):
    """100 imex steps of u' = nu Laplacian u + u - u^3: the mean of u^4 at the end, derivatives in the start."""
    room = dp.Grid((n, n), size=1.0)
    react = lambda u, _: u - u**3
    step = dp.stepper("imex", react, h, linear=(dp.laplacian(room, dp.neumann), nu))
    values, vectors = eigenvectors(room, dp.neumann)
    gamma = 1 - np.sqrt(0.5)
    delta = 1 - 1 / (2 * gamma)

    def twin(np):
        """Return the two-stage IMEX Runge-Kutta step of second order (Ascher, Ruuth and Spiteri, 1997)."""
        apply = lambda f, u: vectors @ (f * (vectors.T @ u @ vectors)) @ vectors.T
        solve = 1 / (1 - gamma * h * nu * values)

        def step(u, _):
            first = react(u, None)
            v = apply(solve, u + gamma * h * first)
            slope = apply(nu * values, v)
            second = react(v, None)
            return apply(solve, u + h * (delta * first + (1 - delta) * second) + (1 - gamma) * h * slope)

        return step

    x, y = room.centres()
    start = 0.3 * np.cos(5 * x) * np.cos(7 * y) + 0.1
    size = lambda np, u: np.mean(u**4)
    return Case("reaction-diffusion, 64 x 64", 100, start, lambda u: (u, None), step, twin, size, None, None, 10)


# ---- forms -----------------------------------------------------------------------------------------------------------


def run(step, state, params, n):
    for _ in range(n):
        state = step(state, params)
    return state


def looped(case):
    """Loss of x, every step on the tape."""
    return lambda x: case.measure(anp, run(case.step, *case.begin(x), case.n))


def rolled(case):
    """The same, with the time loop as one node."""
    return lambda x: case.measure(anp, dp.rollout(case.step, *case.begin(x), case.n))


def written(case):
    """The same with slices and the tape of autograd."""
    step = case.twin(anp)
    return lambda x: case.measure(anp, run(step, *case.begin(x), case.n))


def forms(case):
    """Return the losses of the rows with the library, by name."""
    recorded = case._replace(step=dp.jit(case.step))
    losses = {"plain loop": looped(case), "rollout": rolled(case)}
    losses["jit step in a loop"] = looped(recorded)
    losses["jit step in rollout"] = rolled(case._replace(step=dp.jit(case.step)))
    losses["jit loss"] = dp.jit(looped(case))
    losses["compiled step in rollout"] = rolled(case._replace(step=dp.jit(case.step, compile=True)))
    losses["compiled loss"] = dp.jit(rolled(case), compile=True)
    if case.n == 1:
        del losses["rollout"], losses["jit step in rollout"], losses["compiled step in rollout"]
    return losses


def gradient(loss):
    return lambda x: dp.value_and_grad(loss)(x)[1]


def compiled_by_jax(case):
    """Return two functions for jax, of the value and of value and gradient, and the seconds of the first call.

    Return None if jax is not installed.
    """
    if find_spec("jax") is None:
        return None
    import jax  # optional: only this benchmark looks at it

    jax.config.update("jax_enable_x64", True)
    step = case.twin(jax.numpy)

    def loss(x, unroll):
        state, params = case.begin(x)
        end, _ = jax.lax.scan(lambda s, _: (step(s, params), None), state, None, length=case.n, unroll=unroll)
        return case.measure(jax.numpy, end)

    found = []
    seconds = 0.0
    for transform in (lambda f: f, jax.value_and_grad):
        ways = [jax.jit(transform(partial(loss, unroll=many))) for many in (1, 10)]
        runs = {k: partial(lambda way: jax.block_until_ready(way(case.x)), way) for k, way in enumerate(ways)}
        firsts = {k: first_seconds(run) for k, run in runs.items()}
        best = best_times(runs, 30)
        fastest = min(best, key=best.get)
        seconds = firsts[fastest]
        found.append(runs[fastest])
    return *found, seconds


def first_seconds(task):
    """Return the seconds of a call."""
    begun = time.perf_counter()
    task()
    return time.perf_counter() - begun


def peak_megabytes(task):
    """Return the peak memory that Python and NumPy take during a call."""
    tracemalloc.start()
    task()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def table(case):
    """Print the rows of a case."""
    x, theirs = case.x, autograd.value_and_grad(written(case))
    wanted = theirs(x)[1]
    rows = {"slices, tape of autograd": (lambda: written(case)(x), lambda: theirs(x))}
    for name, loss in forms(case).items():
        rows[name] = partial(loss, x), partial(dp.value_and_grad(loss), x)
    gradient(looped(case))(x)  # kernels are compiled
    first = {name: first_seconds(both) for name, (_, both) in rows.items()}
    jitted = compiled_by_jax(case)
    if jitted:
        *rows["slices, jax"], first["slices, jax"] = jitted
    times = times_in_turn({(name, k): task for name, row in rows.items() for k, task in enumerate(row)}, case.repeats)
    print(f"\n{case.name}, {case.n} step{'s' * (case.n > 1)}")
    print(
        f"{'':24} {'value ms':>9} {'gradient ms':>12} {'minimum':>8} {'x jax':>6} {'minimum':>8} {'limit':>8}"
        f" {'first s':>8} {'record s':>8} {'MB':>6} {'error':>8}"
    )
    for name, (_, both) in rows.items():
        seconds = times[name, 1]
        beside = " " * 15
        if jitted:
            reference = times["slices, jax", 1]
            beside = f"{median(seconds) / median(reference):6.2f} {min(seconds) / min(reference):8.2f}"
        megabytes = f"{peak_megabytes(both):6.2f}"
        if name == "slices, jax":
            megabytes = f"{'-':>6}"  # jax allocates outside Python
        recording = ""
        if name.startswith("jit"):
            recording = f"{max(first[name] - median(seconds), 0.0):.3f}"
        error = np.max(np.abs(np.asarray(both()[1]) - wanted)) / np.max(np.abs(wanted))
        print(
            f"{name:24} {1e3 * median(times[name, 0]):9.3f} {1e3 * median(seconds):12.3f} {1e3 * min(seconds):8.3f}"
            f" {beside} {limit(case, name):>8} {first[name]:8.3f} {recording:>8} {megabytes} {error:8.1e}"
        )


def limit(case, name):
    """Return the limit of a row as text."""
    if name in ("plain loop", "rollout") and case.limit:
        return f"{case.limit:g} ms"
    if name in ("jit step in rollout", "jit loss") and case.share:
        return f"{case.share:g} x"
    return ""


def descents(loss, x):
    """51 gradients, one after another."""
    u = np.zeros_like(x)
    for _ in range(51):
        u = u - 5 * gradient(loss)(u)
    return u


def of_autograd():
    """Microseconds that autograd takes for one primitive of one short array, forward and backward."""
    u = burgers().x

    def chain(many):
        def loss(u):
            for _ in range(many):
                u = -u
            return anp.sum(u)

        return lambda: autograd.grad(loss)(u)

    best = best_times({many: chain(many) for many in (20, 120)}, 300)
    return 1e6 * (best[120] - best[20]) / 100


CASES = (burgers, donor_cell, predators, lorenz, pendulums, smoke, poisson, reaction_diffusion)


def main(words):
    print(f"value and gradient, kernels: {'numba' if kernels.compiled() else 'NumPy'}")
    for build in CASES:
        case = build()
        if not words or any(word in case.name for word in words):
            table(case)
    if words:
        return
    case = burgers()
    tasks = {form.__name__: partial(descents, form(case), case.x) for form in (looped, rolled)}
    print()
    for name, seconds in best_times(tasks, 10).items():
        print(f"51 gradients of Burgers composed, {name:12} {1e3 * seconds:7.1f} ms, limit 100")
    print(f"autograd's own tape takes {of_autograd():.1f} us a primitive, 5 where the limits were measured")
    for build in (predators, lorenz, pendulums):
        code = FIRST_COMPILED.format(case=build.__name__)
        first = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        print(f"first gradient of a process, compiled rollout, {build().name:24} {1e3 * float(first.stdout):7.1f} ms")
    first = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True)
    print(f"first gradient of a process, numba loaded {1e3 * float(first.stdout):7.1f} ms, limit 50")


if __name__ == "__main__":
    main(sys.argv[1:])
