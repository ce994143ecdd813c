"""Folds by continuation, and steady flows over a step and in a cube, beside exact and published figures.

Run ``python -m benchmarks.branches [cells]`` in the root of the repository: cells an axis of the cube, 16 by default.
A row of a fold: the parameter on two grids extrapolated (order 2), the exact one, by how much it is off, seconds.
A row of the step: cells a step height across the channel, the reattachment length in step heights at Reynolds numbers
300, 400, 600 and 800, seconds; then the lengths extrapolated (order 2), and the published ones.
A row of the cube at Re 100: least u on x = z = 1/2, largest and least v on y = z = 1/2, seconds from rest, seconds of a
gradient at the solution, the largest memory of the process. Then the verdicts of `check.gradient` on small grids.
"""

import argparse
import resource
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from benchmarks.tables import lines

FOLDS = {1: 3.513830719, 2: 6.808124423}  # of the Bratu problem on a unit line and square
# Reattachment lengths by E. Erturk, Computers and Fluids 37 (2008), 633-655.
LENGTHS = {300: 6.751, 400: 8.237, 600: 10.349, 800: 11.834}


def bratu(n, dim):
    """L u + lam exp(u) on a unit box, u = 0 on its walls."""
    L = dp.laplacian(dp.Grid((n,) * dim, size=1.0), dp.dirichlet)
    return lambda u, lam: L(u) + lam * np.exp(u)


def folds():
    """Print the rows of the folds."""
    print("Bratu           fold        exact    off by  seconds")
    for dim, n in ((1, 128), (2, 32)):
        clock = perf_counter()
        coarse, fine = (
            dp.continuation(bratu(m, dim), np.zeros((m,) * dim), 1.0, 1.2 * FOLDS[dim]).folds[0].parameter
            for m in (n, 2 * n)
        )
        seconds = perf_counter() - clock
        ours = (4 * fine - coarse) / 3
        print(f"{2 * n:4}^{dim}    {ours:12.8f} {FOLDS[dim]:12.8f} {abs(ours / FOLDS[dim] - 1):9.1e} {seconds:8.1f}")


def growing(h, length, ratio, widest):
    """Return widths that grow from h by a ratio up to the widest one, and sum to a length."""
    widths = np.minimum(h * ratio ** np.arange(1, round(length / h)), widest)
    widths = widths[: np.argmax(np.cumsum(widths) >= length) + 1]
    return widths * length / np.sum(widths)


class Step:
    """A channel whose height doubles at a step: 12 cells a step height along x, longer far from the vortex."""

    def __init__(self, n, along=12):
        h = 1.0 / along
        widths = np.concatenate(
            [growing(h, 3.0, 1.05, 0.25)[::-1], np.full(14 * along, h), growing(h, 21.0, 1.03, 0.5)]
        )
        self.grid = grid = dp.Grid((widths.size, 2 * n), spacing=[widths, 1.0 / n], origin=(-3.0, 0.0))
        x, y = grid.centres()
        self.solid = solid = (x < 0) & (y < 1)
        sides = {"x": (dp.inflow, dp.outflow)}
        self.D, self.G = dp.divergence(grid), dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)})
        self.L, self.convect = dp.face_laplacian(grid, sides, solid), dp.convection(grid, sides, solid)
        self.free = dp.free_faces(grid, sides, solid)
        at, height = grid.face_centres(0)
        parabola = np.where((at == -3.0) & (height > 1), 6 * (height - 1) * (2 - height), 0.0)
        self.entering = grid.join(parabola, 0.0)
        self.rest = {"v": self.entering, "p": np.zeros(grid.shape)}

    def __call__(self, state, reynolds):
        v, p = state["v"], state["p"]
        momentum = 2.0 / reynolds * self.L(v) - self.convect(v, v) - self.G(p)
        given = v - self.entering
        return {"v": self.free(momentum) + given - self.free(given), "p": self.D(v) + self.solid * p}

    def reattachment(self, state):
        """Return the last zero of u next to the lower wall."""
        u = self.grid.split(state["v"])[0][:, 0]
        x = self.grid.face_centres(0)[0][:, 0]
        last = np.flatnonzero(u < 0)[-1]
        return x[last] + u[last] / (u[last] - u[last + 1]) * (x[last + 1] - x[last])


def steps():
    """Print the rows of the step."""
    print("step           " + "  ".join(f"Re {reynolds:4}" for reynolds in LENGTHS) + "  seconds")
    found = []
    for n in (24, 36):
        clock = perf_counter()
        scene = Step(n)
        root = dp.implicit(scene, method="direct")
        x, lengths = scene.rest, []
        for reynolds in (100, 200, 300, 400, 500, 600, 700, 800):
            x = root(x, float(reynolds))
            if reynolds in LENGTHS:
                lengths.append(scene.reattachment(x))
        found.append(np.array(lengths))
        print(
            f"{n:4} cells     " + "  ".join(f"{length:7.3f}" for length in lengths) + f"{perf_counter() - clock:9.1f}"
        )
    extrapolated = (36**2 * found[1] - 24**2 * found[0]) / (36**2 - 24**2)
    print("extrapolated   " + "  ".join(f"{length:7.3f}" for length in extrapolated))
    print("published      " + "  ".join(f"{length:7.3f}" for length in LENGTHS.values()))


class Cube:
    """The cavity in 3-D: the upper wall in y moves along x."""

    def __init__(self, n):
        self.grid = grid = dp.Grid((n, n, n), size=1.0)
        self.D, self.G, self.L = dp.divergence(grid), dp.gradient(grid), dp.face_laplacian(grid)
        self.convect, self.free = dp.convection(grid), dp.free_faces(grid)
        lid = dp.face_lift(grid)
        self.moving = lid(lid.domain.join(*(float(number == 6) for number in range(12))))
        self.pin = (np.arange(n**3) == 0.0).reshape(grid.shape)
        self.rest = {"v": np.zeros(grid.faces.size), "p": np.zeros(grid.shape)}

    def __call__(self, x, reynolds):
        v, p = x["v"], x["p"]
        momentum = (self.L(v) + self.moving) / reynolds - self.convect(v, v) - self.G(p)
        return {"v": self.free(momentum) + v - self.free(v), "p": self.D(v) + self.pin * p}

    def lines(self, x):
        """Return u on x = z = 1/2 and v on y = z = 1/2."""
        middle = self.grid.shape[0] // 2
        u, v, _ = self.grid.split(x["v"])
        return 0.5 * (u[middle, :, middle - 1] + u[middle, :, middle]), 0.5 * (
            v[:, middle, middle - 1] + v[:, middle, middle]
        )


def peak(line):
    """The largest value, by a parabola through the points around it."""
    low, top, high = line[np.argmax(line) - 1 :][:3]
    return top + (high - low) ** 2 / (8 * (2 * top - low - high))


def cube(n):
    """Print the row of the cube."""
    scene = Cube(n)
    root = dp.implicit(scene, method="schur")
    clock = perf_counter()
    x = root(scene.rest, 100.0)
    seconds = perf_counter() - clock
    u, v = scene.lines(x)
    clock = perf_counter()
    slope = dp.grad(lambda re: -peak(-scene.lines(root(x, re))[0]))(100.0)
    adjoint = perf_counter() - clock
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print("cube       min u     max v     min v  seconds  gradient s  memory GB  d min u / d Re")
    print(
        f"{n:4}^3 {-peak(-u):9.5f} {peak(v):9.5f} {-peak(-v):9.5f} {seconds:8.1f} {adjoint:11.1f} {memory:10.2f}"
        f"  {slope:.4e}"
    )


def verdicts():
    """Print the verdicts of `check.gradient`."""
    branch = dp.continuation(bratu(16, 1), np.zeros(16), 1.0, 4.0, rtol=1e-13)
    loss = lambda lam: np.sum(branch.solve(-1, lam) ** 2)
    print(f"gradient on the upper branch: {dp.check.gradient(loss, 1.05).verdict}")
    scene = Step(6, 4)
    root = dp.implicit(scene, method="direct", rtol=1e-13)
    x = root(scene.rest, 100.0)
    length = lambda re: scene.reattachment(root(x, re))
    print(f"gradient of the step: {dp.check.gradient(length, 100.0).verdict}")
    scene = Cube(4)
    root = dp.implicit(scene, method="schur", rtol=1e-13)
    x = root(scene.rest, 20.0)
    print(f"gradient of the cube: {dp.check.gradient(lambda re: np.sum(root(x, re)['v'] ** 2), 20.0).verdict}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cells", nargs="?", type=int, default=16)
    cells = parser.parse_args().cells
    dp.set_threads(1)
    folds()
    steps()
    cube(cells)
    verdicts()
    print(f"lines: Bratu {lines(bratu)}, step {lines(Step)}, cube {lines(Cube)}")
