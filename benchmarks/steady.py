"""Steady flows by Newton's method, beside published figures and beside a loop over time.

Run ``python -m benchmarks.steady [cells] [--loop]`` in the root of the repository; 128 cells an axis by default.
A row: the figures, by how much they are off, seconds from rest (the search of the pattern is in them), seconds of a
gradient at the solution (Newton's check of it, one new Jacobian, one adjoint solve), by how much it is off central
differences of fourth order, and the verdict of `check.gradient` on 24^2 cells. ``--loop``: seconds of Euler steps
with a projection, as in examples/cavity.py and examples/convection.py, until the first figure is as close as that to
the steady one (Re 100 and Ra 1e5; no gradient).
Seconds are of the processor, on one thread.
"""

import argparse
from time import process_time

import autograd.numpy as np

import sparsedp as dp

PRANDTL = 0.71
CAVITY = {  # min u on x = 1/2, max v, min v on y = 1/2: Botella and Peyret, 1998; for Re 400 Ghia, Ghia and Shin, 1982
    100.0: (-0.2140417, 0.1795728, -0.2538030),
    400.0: (-0.32726, 0.30203, -0.44993),
    1000.0: (-0.3885698, 0.3769447, -0.5270771),
}
CONVECTION = {1e4: (2.243,), 1e5: (4.519,), 1e6: (8.800,)}  # mean Nusselt number: de Vahl Davis, 1983


class Flow:
    """The unit square with n x n cells."""

    def __init__(self, n):
        self.grid = grid = dp.Grid((n, n), size=1.0)
        self.D, self.G, self.inside = dp.divergence(grid), dp.gradient(grid), dp.interior(grid)
        self.L, self.convect = dp.face_laplacian(grid), dp.convection(grid)
        self.pin = (np.arange(n * n) == 0.0).reshape(n, n)
        self.rest = {"v": np.zeros(grid.faces.size), "p": np.zeros((n, n))}

    def rates(self, v, p, force):
        """Momentum on free faces, v = 0 on walls, div v = 0, the constant of the pressure."""
        momentum = force - self.convect(v, v) - self.G(p)
        return {"v": self.inside(momentum) + v - self.inside(v), "p": self.D(v) + self.pin * p}

    def loop(self, step, state, goal, every=100):
        """Return the seconds of time steps until the figure is this close to its steady value."""
        clock, steps, off, words = process_time(), 0, np.inf, []
        for close in (1e-3, 1e-6, 1e-9):
            while off > close:
                state, steps = dp.rollout(step, state, self.number, every), steps + every
                off = abs(float(self.watched(state)) / goal - 1)
            words.append(f"{process_time() - clock:.1f} s to {close:.0e}")
        return f"{', '.join(words)}, {steps} steps"


class Cavity(Flow):
    """The upper wall moves."""

    known, number = CAVITY, 100.0

    def __init__(self, n):
        super().__init__(n)
        lid = dp.face_lift(self.grid)
        self.moving = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0))

    def residual(self, x, re):
        return self.rates(x["v"], x["p"], (self.L(x["v"]) + self.moving) / re)

    def first(self, x):
        return -peak(-self.grid.split(x["v"])[0][self.grid.shape[0] // 2])

    def figures(self, x):
        v = self.grid.split(x["v"])[1][:, self.grid.shape[1] // 2]
        return self.first(x), peak(v), -peak(-v)

    def watched(self, v):
        return self.first({"v": v})

    def over_time(self, goal):
        project, n = dp.projection(self.grid), self.grid.shape[0]
        dt = min(20 / n**2, 0.5 / n)  # 0.2 h^2 / nu
        step = lambda v, re: project(v + dt * ((self.L(v) + self.moving) / re - self.convect(v, v)))
        return self.loop(step, self.rest["v"], goal)


class Convection(Flow):
    """Hot (1) at x = 0, cold (0) at x = 1."""

    known, number = CONVECTION, 1e5

    def __init__(self, n):
        super().__init__(n)
        grid, hot = self.grid, {"x": dp.dirichlet}
        self.slope, self.mean, lift = dp.gradient(grid, hot), dp.average(grid), dp.lift(grid, hot)
        self.walls, self.up = lift(lift.domain.join(1.0, 0.0, 0.0, 0.0)), grid.join(0.0, 1.0)
        self.rest = {**self.rest, "T": 1 - grid.centres()[0]}

    def through(self, v, heat):
        """Heat per area through each face."""
        return v * self.mean(heat) - self.slope(heat) - self.walls

    def force(self, v, heat, ra):
        return PRANDTL * (self.L(v) + ra * self.up * self.mean(heat))

    def residual(self, x, ra):
        v, heat = x["v"], x["T"]
        return {**self.rates(v, x["p"], self.force(v, heat, ra)), "T": -self.D(self.through(v, heat))}

    def first(self, x):
        return np.mean(self.grid.split(self.through(x["v"], x["T"]))[0][1:-1])

    def figures(self, x):
        return (self.first(x),)

    def watched(self, state):
        return self.first({"v": state[1], "T": state[0]})

    def over_time(self, goal):
        project, dt = dp.projection(self.grid), 0.2 / self.grid.shape[0] ** 2

        def step(state, ra):
            heat, v = state
            after = v + dt * (self.force(v, heat, ra) - self.convect(v, v))
            return heat - dt * self.D(self.through(v, heat)), project(after)

        return self.loop(step, (self.rest["T"], self.rest["v"]), goal)


def peak(line):
    """The largest value, by a parabola through the points around it."""
    low, top, high = line[np.argmax(line) - 1 :][:3]
    return top + (high - low) ** 2 / (8 * (2 * top - low - high))


def verdict(kind, p):
    """What check.gradient says of the first figure on 24^2 cells."""
    scene = kind(24)
    find = dp.implicit(scene.residual, rtol=1e-13)  # differences from a near guess see the tolerance
    start = find(scene.rest, p)
    return dp.check.gradient(lambda p: scene.first(find(start, p)), p).verdict


def row(scene, p):
    """One case: solved from rest, its gradient."""
    find, clock = dp.implicit(scene.residual), process_time()
    x = find(scene.rest, p)
    seconds, ours = process_time() - clock, scene.figures(x)
    figure = lambda p: scene.first(find(x, p))
    clock = process_time()
    slope = dp.grad(figure)(p)
    adjoint, h = process_time() - clock, 3e-4 * p
    one, two = ((figure(p + k * h) - figure(p - k * h)) / (2 * k * h) for k in (1, 2))
    off = abs(slope / ((4 * one - two) / 3) - 1)
    error = max(abs(a / b - 1) for a, b in zip(ours, scene.known[p], strict=True))
    words = " ".join(f"{value:9.5f}" for value in ours)
    print(
        f"{type(scene).__name__:11}{p:8.0f}  {words:31}{error:7.2%}{seconds:9.1f}{adjoint:10.1f}{slope:13.4e}{off:9.1e}"
        f"  {verdict(type(scene), p)}",
        flush=True,
    )
    return ours[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cells", nargs="?", type=int, default=128)
    parser.add_argument("--loop", action="store_true")
    given = parser.parse_args()
    dp.set_threads(1)
    print(f"{given.cells}^2 cells")
    print(
        f"{'case':11}{'Re, Ra':>8}  {'figures':31}{'error':>7}{'seconds':>9}{'gradient s':>10}{'d first':>13}{'off':>9}"
    )
    for kind in (Cavity, Convection):
        scene = kind(given.cells)
        firsts = {p: row(scene, p) for p in kind.known}
        if given.loop:
            print(f"  the loop over time, {scene.number:.0f}: {scene.over_time(firsts[scene.number])}", flush=True)


if __name__ == "__main__":
    main()
