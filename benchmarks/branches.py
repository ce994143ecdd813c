"""Folds of the Bratu problem by continuation, and the steady flow in a cube, beside exact and published figures.

Run ``python -m benchmarks.branches [cells]`` in the root of the repository: cells an axis of the cube, 16 by default.
A row of a fold: the parameter on two grids extrapolated (order 2), the exact one, by how much it is off, seconds.
A row of the cube at Re 100: least u on x = z = 1/2, largest and least v on y = z = 1/2, seconds from rest, seconds of a
gradient at the solution, the largest memory of the process. Then the verdicts of `check.gradient` on small grids.
"""

import argparse
import resource
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

FOLDS = {1: 3.513830719, 2: 6.808124423}  # of the Bratu problem on a unit line and square


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
    cube(cells)
    verdicts()
