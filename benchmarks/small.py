"""What a gradient costs where the arrays are small and Python is what takes time, beside jax where that is at hand.

Three cases: Burgers' equation composed from an operator and a transport (case A7), smoke that rises in a closed box,
and a Runge-Kutta step of two unknowns. Each is written twice: with the library, and as a user of slices would, a twin
that runs under autograd and under jax (float64, jitted, warm; a scan of single steps or of ten, whichever is faster).
All rows of a case run in turn, the smallest time counts. The column beside it is the largest difference from the
gradient of the twin under autograd, relative to the largest entry.

Run ``python -m benchmarks.small`` in the root of the repository.
"""

import subprocess
import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import autograd
import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.triad import best_times
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


class Case(NamedTuple):
    """What is differentiated: measure(np, end) where n steps lead from state and params, begin(x), to the end.

    ``step(state, params)`` is ours, ``twin(np)`` makes that of slices, of autograd.numpy or jax.numpy.
    """

    name: str
    n: int
    x: np.ndarray
    begin: Callable[[Any], tuple]
    step: Callable
    twin: Callable[[Any], Callable]
    measure: Callable
    limit: float | None  # of value and gradient, in a rollout and as a loop [ms]


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
    return Case("Burgers composed, 128 cells", 16, start, lambda u: (u, 0.5 * start), step, twin, miss, 1.0)


def donor_cell():
    """A step that is one rule of the library."""
    share, move = 0.5, dp.transport(dp.Grid(128, periodic=True), "upwind", velocity="cells")

    def twin(np):
        def step(u, v):
            ahead, behind = np.roll(u, -1) - u, u - np.roll(u, 1)
            return u - share * (np.minimum(v, 0.0) * ahead + np.maximum(v, 0.0) * behind)

        return step

    step = lambda u, v: move(u, v, share)
    return burgers()._replace(name="one rule, 128 cells", step=step, twin=twin, limit=0.13)


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
    return Case(f"smoke, {n} x {n} cells", 20, puff, begin, step, lambda np: sliced_smoke(np, n, dt), height, 6.0)


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


def predators(h=0.05):
    """200 steps of rk4 with two unknowns: the sum of squares at the end, derivatives in three rates."""

    def rate(np):
        return lambda u, p: np.array([p[0] * u[0] - p[1] * u[0] * u[1], p[1] * u[0] * u[1] - p[2] * u[1]])

    def twin(np):
        f = rate(np)

        def step(u, p):
            a = f(u, p)
            b = f(u + h / 2 * a, p)
            c = f(u + h / 2 * b, p)
            d = f(u + h * c, p)
            return u + h / 6 * (a + 2 * b + 2 * c + d)

        return step

    start, p = np.array([1.0, 0.5]), np.array([1.0, 0.8, 0.9])
    total = lambda np, u: np.sum(u**2)
    return Case("rk4, two unknowns", 200, p, lambda p: (start, p), dp.stepper("rk4", rate(anp), h), twin, total, None)


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


def gradient(loss):
    return lambda x: dp.value_and_grad(loss)(x)[1]


def compiled_by_jax(case):
    """(value, value and gradient) of jax, each a function of x, or None where jax is not installed."""
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
    for transform in (lambda f: f, jax.value_and_grad):
        ways = [jax.jit(transform(partial(loss, unroll=many))) for many in (1, 10)]
        runs = {k: partial(lambda way: jax.block_until_ready(way(case.x)), way) for k, way in enumerate(ways)}
        best = best_times(runs, 30)
        found.append(runs[min(best, key=best.get)])
    return found


def table(case, repeats):
    """Print the rows of a case."""
    error = lambda g: np.max(np.abs(np.asarray(g) - wanted)) / np.max(np.abs(wanted))
    x, theirs = case.x, autograd.value_and_grad(written(case))
    wanted = theirs(x)[1]
    rows = {"slices, tape of autograd": (lambda: written(case)(x), lambda: theirs(x))}
    for name, form in (("loop by hand", looped(case)), ("rollout", rolled(case))):
        rows[name] = lambda form=form: form(x), lambda form=form: dp.value_and_grad(form)(x)
    if jitted := compiled_by_jax(case):
        rows["slices, jax"] = jitted
    best = best_times({(name, k): task for name, row in rows.items() for k, task in enumerate(row)}, repeats)
    print(f"\n{case.name}, {case.n} steps")
    print(f"{'':26} {'value ms':>9} {'and gradient':>13} {'over value':>11} {'limit ms':>9} {'x jax':>7} {'error':>9}")
    for name, (_, both) in rows.items():
        value, seconds = best[name, 0], best[name, 1]
        limit = "" if name.startswith("slices") else case.limit or ""
        beside = f"{seconds / best['slices, jax', 1]:7.2f}" if jitted else f"{'-':>7}"
        print(
            f"{name:26} {1e3 * value:9.3f} {1e3 * seconds:13.3f} {seconds / value:11.1f} {limit:>9} {beside}"
            f" {error(both()[1]):9.1e}"
        )


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


def main():
    print(f"value and gradient, kernels: {'numba' if kernels.compiled() else 'NumPy'}")
    for case, repeats in ((burgers(), 300), (donor_cell(), 300), (smoke(), 40), (predators(), 10)):
        table(case, repeats)
    case = burgers()
    tasks = {form.__name__: partial(descents, form(case), case.x) for form in (looped, rolled)}
    print()
    for name, seconds in best_times(tasks, 10).items():
        print(f"51 gradients of Burgers composed, {name:12} {1e3 * seconds:7.1f} ms, limit 100")
    print(f"autograd's own tape takes {of_autograd():.1f} us a primitive, 5 where the limits were measured")
    first = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True)
    print(f"first gradient of a process, numba loaded {1e3 * float(first.stdout):7.1f} ms, limit 50")


if __name__ == "__main__":
    main()
