"""Flows whose viscosity, density, diffusivity, walls or step length vary, beside exact solutions: one row a scene.

Run ``python -m benchmarks.media [name ...] [--quick]`` in the root of the repository; a name is a part of a case.
Columns: case; the number that is compared; ours; exact; relative error; order of convergence from the error on half as
many cells; seconds of the scene; the verdict of `check.gradient` on the same scene with few cells; lines of the scene.
``--quick``: few cells for all.

A scene takes a number of cells and returns (f, p): f(p) is the number that is compared, differentiable in p.
"""

from time import perf_counter

import autograd.numpy as np
from autograd import elementwise_grad
from scipy.integrate import quad
from scipy.optimize import brentq

import sparsedp as dp
from benchmarks.tables import lines, print_rows


def channel(n):
    """A channel between walls at y = 0 and y = 1, with one column of cells."""
    return dp.Grid((1, n), spacing=[np.ones(1), np.full(n, 1 / n)], periodic=(True, False))


def mean_speed(n, viscosity, dt, steps):
    """Return the function of p that returns the mean speed in a channel, driven by the force 1, after steps."""
    grid = channel(n)
    push = grid.join(1.0, 0.0)
    step = dp.flow_step(grid, dt, viscosity, lambda v, p: push, implicit=True)
    start = np.zeros(grid.faces.size)

    def speed(p):
        end = dp.rollout(step, step.start(start, p), p, steps)
        return np.mean(grid.split(end["v"])[0])

    return speed


def power_law(n):
    """Mean speed of a shear-thinning fluid in a channel: m / (2 m + 1) (1/2)^(1 + 1/m), for viscosity rate^(m - 1)."""
    law = lambda rate, m: (1e-6 + rate**2) ** ((m - 1) / 2)
    return mean_speed(n, law, 0.02, 100), 0.7


def carreau(n):
    """Mean speed in a channel for the viscosity 0.01 + 0.99 (1 + (2 rate)^2)^((m - 1) / 2) (Carreau)."""
    law = lambda rate, m: 0.01 + 0.99 * (1 + (2 * rate) ** 2) ** ((m - 1) / 2)
    return mean_speed(n, law, 0.05, 60), 0.5


def smagorinsky(n):
    """Mean speed in a channel for the viscosity 0.01 + l^2 rate, with the mixing length l (Smagorinsky)."""
    law = lambda rate, length: 0.01 + length**2 * rate
    return mean_speed(n, law, 0.1, 80), 0.3


def hot_wall(n):
    """Mean speed in a channel with a temperature T = y and the viscosity exp(-b T)."""
    grid = channel(n)
    hot, push, y = {"y": dp.dirichlet}, grid.join(1.0, 0.0), grid.centres()[1]
    heat = {"diffusivity": 1.0, "boundary": hot, "values": dp.lift(grid, hot).domain.join(0.0, 1.0)}
    law = lambda rate, s, b: np.exp(-b * s["heat"])
    step = dp.flow_step(grid, 0.05, law, lambda v, s, b: push, implicit=True, scalars={"heat": heat})
    start = np.zeros(grid.faces.size)

    def mean_speed(b):
        end = dp.rollout(step, step.start(start, b, {"heat": y}), b, 60)
        return np.mean(grid.split(end["v"])[0])

    return mean_speed, 2.0


def rayleigh_taylor(n):
    """Growth rate of a wave between two fluids of equal depth (linear theory): sqrt(A k tanh(k / 2)), k = 2 pi."""
    grid = dp.Grid((n, n), size=1.0, periodic=(True, False))
    x, y = grid.face_centres(1)
    heavy = np.where(grid.centres()[1] > 0.5, 1.0, 0.0)
    start = grid.join(0.0, 1e-6 * np.cos(2 * np.pi * x) * np.exp(-2 * np.pi * np.abs(y - 0.5)))
    mixture = lambda s, ratio: 1 + (ratio - 1) * s["heavy"]
    down = grid.join(0.0, -1.0)
    step = dp.flow_step(grid, 0.02, 0.0, lambda v, s, r: down, density=mixture, scalars={"heavy": {}})

    def growth(ratio):
        first = step.start(start, ratio, {"heavy": heavy})
        v = dp.rollout(step, first, ratio, 200, keep=[100, 200])["v"]
        return np.log(np.sum(v[1] ** 2) / np.sum(v[0] ** 2)) / 4.0

    return growth, 3.0


def layers_at_rest(n):
    """Difference of the pressure at rest, of a fluid below one that is 1000 times lighter."""
    grid = dp.Grid((n, n), size=1.0)
    y = grid.centres()[1]
    density = lambda ratio: np.where(y < 0.5, ratio, 1.0)
    down = grid.join(0.0, -1.0)
    step = dp.flow_step(grid, 0.01, 1e-3, lambda v, ratio: down, density=density)
    start = np.zeros(grid.faces.size)

    def weight(ratio):
        end = dp.rollout(step, step.start(start, ratio), ratio, 50)
        p, speed = np.mean(end["p"], 0), np.sum(end["v"] ** 2)
        return 1.5 * (p[0] - p[-1]) - 0.5 * (p[1] - p[-2]) + speed

    return weight, 1000.0


def oscillating_wall(n):
    """Mean speed after a period, between a wall with the speed cos(2 pi t) and one at rest (Stokes)."""
    grid = channel(n)
    walls, y = dp.face_lift(grid).domain, grid.face_centres(0)[1]
    decay = np.sqrt(2j * np.pi / 0.02)
    start = np.real(np.sinh(decay * (1 - y)) / np.sinh(decay))
    flow = dp.flow_step(grid, 0.5 / n, lambda p: p[0], implicit=True, walls=lambda p: walls.join(p[1], 0.0))
    step = lambda state, nu, speed: flow(state, (nu, speed))
    speeds = np.cos(np.pi * np.arange(1, 2 * n + 1) / n)

    def mean_speed(nu):
        first = flow.start(grid.join(start, 0.0), (nu, 1.0))
        end = dp.rollout(step, first, nu, 2 * n, inputs=speeds)
        return np.mean(grid.split(end["v"])[0])

    return mean_speed, 0.02


def manufactured(n):
    """1 + relative error of a steady vortex in a box, in which the viscosity varies along both axes."""
    grid = dp.Grid((n, n), size=1.0)
    d, psi = elementwise_grad, lambda x, y: 0.5 * np.sin(np.pi * x) ** 2 * np.sin(np.pi * y) ** 2
    mu = lambda x, y: 0.1 + 0.05 * np.sin(3 * x) * np.cos(4 * y)
    u, v = d(psi, 1), lambda x, y: -d(psi, 0)(x, y)
    xx, yy = (lambda x, y, f=f, a=a: 2 * mu(x, y) * d(f, a)(x, y) for f, a in ((u, 0), (v, 1)))
    xy = lambda x, y: mu(x, y) * (d(u, 1)(x, y) + d(v, 0)(x, y))
    carried = lambda f: lambda x, y: u(x, y) * d(f, 0)(x, y) + v(x, y) * d(f, 1)(x, y)
    force = grid.join(
        *(
            carried(f)(x, y) - d(along, 0)(x, y) - d(across, 1)(x, y)
            for f, along, across, (x, y) in ((u, xx, xy, grid.face_centres(0)), (v, xy, yy, grid.face_centres(1)))
        )
    )
    exact = grid.join(u(*grid.face_centres(0)), v(*grid.face_centres(1)))
    viscosity = mu(*grid.centres())
    step = dp.flow_step(grid, 0.125 / n, lambda p: p * viscosity, lambda v, p: force, implicit=True)

    def error(p):
        end = dp.rollout(step, step.start(exact, p), p, 8 * n)
        return 1 + np.sqrt(np.sum((end["v"] - exact) ** 2) / np.sum(exact**2))

    return error, 1.0


def conduction(n):
    """Mean temperature of a rod with the diffusivity 1 + p x: ((1 + p) log(1 + p) - p) / p / log(1 + p)."""
    grid = dp.Grid(n, size=1.0)
    (x,), ends = grid.centres(), {"x": dp.dirichlet}
    values = dp.lift(grid, ends).domain.join(0.0, 1.0)
    heat = {"diffusivity": lambda p: 1 + p * x, "boundary": ends, "values": values}
    step = dp.flow_step(grid, 0.05, scalars={"heat": heat}, implicit=True, convective=False)
    return lambda p: np.mean(dp.rollout(step, step.start(np.zeros(n + 1), p, {"heat": x}), p, 60)["s"]["heat"]), 1.0


def conduction_of_temperature(n):
    """Mean temperature of a rod with the diffusivity 1 + p T: T = (sqrt(1 + (2 p + p^2) x) - 1) / p."""
    grid = dp.Grid(n, size=1.0)
    (x,), ends = grid.centres(), {"x": dp.dirichlet}
    heat = {"diffusivity": lambda s, p: 1 + p * s["heat"], "boundary": ends, "values": [0.0, 1.0]}
    step = dp.flow_step(grid, 0.05, scalars={"heat": heat}, implicit=True, convective=False)
    return lambda p: np.mean(dp.rollout(step, step.start(np.zeros(n + 1), p, {"heat": x}), p, 60)["s"]["heat"]), 1.0


def step_length(n):
    """Energy of decaying vortices after 2 n steps of length dt, beside the first: exp(-4 nu 2 n dt)."""
    grid = dp.Grid((n, n), size=2 * np.pi, periodic=True)
    (x, y), (z, w) = grid.face_centres(0), grid.face_centres(1)
    start = grid.join(np.sin(x) * np.cos(y), -np.cos(z) * np.sin(w))
    step = dp.flow_step(grid, lambda dt: dt, np.full(grid.shape, 0.05), implicit=True)

    def energy(dt):
        end = dp.rollout(step, step.start(start, dt), dt, 2 * n)
        return np.sum(end["v"] ** 2) / np.sum(start**2)

    return lambda stretch: energy(stretch / n), 1.0


def mean_of_hot_wall(b):
    """Return the exact mean speed of `hot_wall`."""
    moments = [quad(lambda y, k=k: y**k * np.exp(b * y), 0, 1)[0] for k in range(3)]
    middle = moments[1] / moments[0]  # where the stress is 0
    return middle * (moments[0] - moments[1]) - moments[1] + moments[2]


def mean_in_channel(rate):
    """Return the exact mean speed in a channel of width 1 where the stress s causes the shear rate rate(s)."""
    return 2 * quad(lambda stress: rate(stress) * stress, 0, 0.5, epsabs=1e-13)[0]


def rate_of_carreau(stress):
    """Return the shear rate of `carreau` for a stress, by bisection."""
    law = lambda rate: (0.01 + 0.99 * (1 + (2 * rate) ** 2) ** -0.25) * rate - stress
    return brentq(law, 0.0, 100 * stress + 1, xtol=1e-14)


def rate_of_smagorinsky(stress):
    """Return the shear rate of `smagorinsky` for a stress."""
    return (np.sqrt(1e-4 + 0.36 * stress) - 0.01) / 0.18


DECAY = np.sqrt(2j * np.pi / 0.02)
CASES = {  # name: scene, number that is compared, exact, cells, few cells
    "power law, m = 0.7": (power_law, "mean speed", 0.7 / 2.4 * 0.5 ** (1 + 1 / 0.7), 64, 8),
    "Carreau, m = 0.5": (carreau, "mean speed", mean_in_channel(rate_of_carreau), 64, 8),
    "Smagorinsky, l = 0.3": (smagorinsky, "mean speed", mean_in_channel(rate_of_smagorinsky), 64, 8),
    "viscosity exp(-2 T)": (hot_wall, "mean speed", mean_of_hot_wall(2.0), 64, 8),
    "Rayleigh-Taylor, 1:3": (rayleigh_taylor, "growth rate", np.sqrt(np.pi * np.tanh(np.pi)), 64, 8),
    "layers at rest, 1:1000": (layers_at_rest, "pressure drop", 500.5, 32, 8),
    "oscillating wall": (oscillating_wall, "mean speed", np.real((np.cosh(DECAY) - 1) / DECAY / np.sinh(DECAY)), 64, 8),
    "vortex, viscosity varies": (manufactured, "1 + error", 1.0, 32, 8),
    "diffusivity 1 + x": (conduction, "mean temperature", (2 * np.log(2) - 1) / np.log(2), 64, 8),
    "diffusivity 1 + T": (conduction_of_temperature, "mean temperature", 5 / 9, 64, 8),
    "Taylor-Green, dt of params": (step_length, "energy", np.exp(-0.4), 32, 8),
}


def row(name, quick):
    """Return our number, its relative error, the order, the seconds, and the verdict on the gradient."""
    scene, _, exact, n, few = CASES[name]
    coarse, p = scene(few)
    verdict = dp.check.gradient(coarse, p, quick=True).verdict
    cells = 2 * few if quick else n
    f, p = scene(cells // 2)
    coarse_error = abs(float(f(p)) / exact - 1)
    f, p = scene(cells)
    clock = perf_counter()
    ours = float(f(p))
    seconds = perf_counter() - clock
    error = abs(ours / exact - 1)
    order = np.log2(coarse_error / error) if error > 1e-11 else np.nan
    return ours, error, order, seconds, verdict


def cells(name, quick):
    """Return the cells of a row of the table."""
    ours, error, order, seconds, verdict = row(name, quick)
    scene, compared, exact, *_ = CASES[name]
    figures = f"{ours:.6g} | {exact:.6g} | {error:.1e} | {order:.1f} | {seconds:.2f}"
    shared = lines(mean_speed) if scene in (power_law, carreau, smagorinsky) else 0
    return f"{compared} | {figures} | {verdict} | {shared + lines(scene)}"


if __name__ == "__main__":
    columns = "case | number | ours | exact | error | order | seconds | gradient | lines"
    print_rows(__doc__, columns, CASES, cells)
