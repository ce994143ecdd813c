"""Iterations of `minimize` on ever finer grids, with and without the metric of the unknowns.

Run ``python -m benchmarks.metric [cells]`` in the root of the repository; cells: the finest grid along an axis.

The problem is the optimal control of Poisson's equation on the unit square, with a source u that must be smooth:

    min  1/2 |y - w|^2 + a/2 (|u|^2 + |grad u|^2),    -lap y = u,  y = 0 at the walls,

where the norms are those of L2. The metric is the inner product of H1, M = h^2 (1 - lap), as in the second
term. All runs end when the norm of the gradient has fallen by 1e-6; with * when steps change the loss by less than its
rounding.
"""

import sys

import autograd.numpy as anp
import numpy as np

import sparsedp as dp

__all__ = ["METHODS", "Control"]

METHODS = "lbfgs", "gd", "newton_cg"
PRICE = 1e-4
LIMIT = {"lbfgs": 2000, "gd": 400, "newton_cg": 100}


class Control:
    """The problem on one grid of n x n cells."""

    def __init__(self, n):
        self.grid = dp.Grid((n, n), size=1.0)
        self.area = 1.0 / n**2
        x, y = self.grid.centres()
        self.wanted = x * (1 - x**2) * y**2 * (1 - y)
        self.solve = dp.inverse(-dp.laplacian(self.grid, dp.dirichlet))
        self.metric = self.area * (dp.identity(self.grid.cells) - dp.laplacian(self.grid))

    def loss(self, u):
        """Return the loss of a source u."""
        miss = self.solve(u) - self.wanted
        return 0.5 * self.area * anp.sum(miss**2) + 0.5 * PRICE * anp.sum(u * self.metric(u))

    def run(self, method, metric, maxiter=None):
        """Return the result of `minimize` from u = 0."""
        start = np.zeros(self.grid.shape)
        return dp.minimize(self.loss, start, method, maxiter or LIMIT[method], tolerance=1e-6, metric=metric)


def main(finest):
    """Print a row for each method and grid."""
    print("method      cells   iterations  seconds  solves   with metric:  iterations  seconds  solves  same loss to")
    for method in METHODS:
        for cells in (n for n in (16, 32, 64, 128, 256) if n <= finest):
            problem = Control(cells)
            plain, in_metric = (problem.run(method, metric) for metric in (None, problem.metric))
            columns = []
            for best in (plain, in_metric):
                last = best.history[-1]
                count = str(last.iteration)
                if last.iteration == LIMIT[method]:
                    count = f"> {count}"
                elif not best.converged:
                    count += "*"
                columns.append(f"{count:>10}  {last.seconds:7.2f}  {last.solves:6}")
            gap = abs(plain.value / in_metric.value - 1)
            print(f"{method:10} {cells:4}^2   {columns[0]}               {columns[1]}  {gap:12.0e}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 256)
