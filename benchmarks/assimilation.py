"""4D-Var: the error of the analysis against the time of the search, for Gauss-Newton, L-BFGS and Newton-CG.

Run ``python -m benchmarks.assimilation [cells]`` in the root of the repository; cells is the size of the flow. The two
models are those of examples/data_assimilation.py: Lorenz-96 in a window of two days, and the vorticity of a plane flow.
The columns are the cost at the end, iterations, seconds, relative error at the end of the search, and the seconds until
the error is within 5 % of the smallest one that a search of this model finds.
"""

import sys

import autograd.numpy as anp
import numpy as np

import sparsedp as dp

__all__ = ["Flow", "Lorenz", "Problem"]


class Problem:
    """A window of 4D-Var with a known truth.

    A subclass sets `root`, `background`, `truth`, `noise` and `readings`, and calls `observe`.
    """

    def observe(self, rng):
        """Set the data, from the truth, and the covariance and the precision of the background."""
        exact = self.readings(self.truth)
        self.data = exact + self.noise * rng.standard_normal(exact.shape)
        self.covariance = self.root @ self.root.T
        self.precision = dp.inverse(self.covariance)

    def misses(self, x):
        """Return the differences from the data, divided by their standard deviation."""
        return anp.reshape((self.readings(x) - self.data) / self.noise, (-1,))

    def field(self, z):
        """Return the state of the control variables z."""
        return self.background + self.root(z)

    def residuals(self, z):
        """Return all residuals with variance 1."""
        return anp.concatenate([anp.reshape(z, (-1,)), self.misses(self.field(z))])

    def cost_of_control(self, z):
        """Return half of the sum of the squares of the residuals."""
        return 0.5 * anp.sum(self.residuals(z) ** 2)

    def cost(self, x):
        """Return the same cost for a state x."""
        d = x - self.background
        return 0.5 * anp.sum(d * self.precision(d)) + 0.5 * anp.sum(self.misses(x) ** 2)

    def searches(self):
        """Return for each search its loss, its start, and the arguments of `minimize`."""
        zero = np.zeros(self.background.shape)
        inexact = {"dense": False, "accuracy": 1e-2}
        x = self.cost, self.background
        return {
            "gauss_newton, z": (self.residuals, zero, {"method": "gauss_newton", "maxiter": 15, **inexact}),
            "lbfgs, z": (self.cost_of_control, zero, {}),
            "lbfgs, metric": (*x, {"metric": self.precision}),
            "lbfgs, plain": (*x, {}),
            "newton_cg, metric": (*x, {"method": "newton_cg", "maxiter": 15, "metric": self.precision}),
        }

    def error(self, x):
        """Return the relative error of a state."""
        return float(np.linalg.norm(x - self.truth) / np.linalg.norm(self.background - self.truth))


class Lorenz(Problem):
    """Lorenz-96, 40 variables of which 20 are observed every 12 hours, in a window of two days."""

    name = "Lorenz-96"

    def __init__(self):
        rng = np.random.default_rng(0)
        ring = dp.Grid(40, size=40.0, periodic=True)
        rate = lambda x, force: (anp.roll(x, -1) - anp.roll(x, 2)) * anp.roll(x, 1) - x + force
        step = dp.jit(dp.stepper("rk4", rate, 0.05))
        sensors = dp.sample(ring, np.arange(0.5, 40.0, 2.0)[:, None])
        self.readings = lambda x: sensors(dp.rollout(step, x, 8.0, 8, keep=[2, 4, 6, 8]))
        self.root = 1.9 * dp.matrix_power(dp.identity(ring.cells) - dp.laplacian(ring), -1.0)
        self.truth = dp.rollout(step, 8.0 + np.sin(np.arange(40)), 8.0, 400)
        self.background = self.truth + self.root(rng.standard_normal(40))
        self.noise = 0.5
        self.observe(rng)


class Flow(Problem):
    """The vorticity of a plane flow on n x n cells, observed at 60 points and four times; the background is 0."""

    def __init__(self, n):
        self.name = f"flow, {n}^2"
        rng = np.random.default_rng(0)
        grid = dp.Grid((n, n), size=1.0, periodic=True)
        laplacian = dp.laplacian(grid)
        stream = dp.inverse(-laplacian, nullspace="project")
        curl = dp.curl(grid)
        move = dp.transport(grid, "semi_lagrangian", interpolation="cubic")
        spread = dp.matrix_exponential(laplacian, 5e-6)

        @dp.jit
        def step(vorticity, params):
            psi = stream(vorticity)
            psi = 0.5 * (psi + anp.roll(psi, 1, 0))
            psi = 0.5 * (psi + anp.roll(psi, 1, 1))
            return spread(move(vorticity, curl(psi), 0.05))

        smooth = dp.matrix_power(dp.identity(grid.cells) - 0.05**2 * laplacian, -2.0)
        spike = np.zeros(grid.shape)
        spike[0, 0] = 1.0
        self.root = (4.0 / np.linalg.norm(smooth(spike))) * smooth
        truth = self.root(rng.standard_normal(grid.shape))
        self.truth = truth - np.mean(truth)
        self.background = np.zeros(grid.shape)
        sensors = dp.sample(grid, rng.uniform(0.0, 1.0, (60, 2)))
        self.readings = lambda x: sensors(dp.rollout(step, x, None, 16, keep=[4, 8, 12, 16]))
        self.noise = 0.5
        self.observe(rng)

    def searches(self):
        """Return the searches without newton_cg: the transport has first derivatives only."""
        searches = super().searches()
        del searches["newton_cg, metric"]
        return searches


def main(cells):
    """Print a table for each model."""
    for problem in (Lorenz(), Flow(cells)):
        for recorded in (problem.cost, problem.cost_of_control):  # programs are recorded and compared before the clock
            dp.value_and_grad(recorded)(
                0.01 * np.cos(np.arange(float(problem.truth.size))).reshape(problem.truth.shape)
            )
        rows = {}
        for name, (loss, start, arguments) in problem.searches().items():
            curve = []
            is_control = loss not in (problem.cost,)

            def note(record, x, curve=curve, is_control=is_control, problem=problem):
                curve.append((record.seconds, problem.error(problem.field(x) if is_control else x)))

            options = {"maxiter": 150, "tolerance": 1e-4, **arguments}
            rows[name] = dp.minimize(loss, start, callback=note, **options), curve
        smallest = min(error for _, curve in rows.values() for _, error in curve)
        print(f"{problem.name:18}     cost  iterations  seconds  error  seconds to 1.05 of the least error")
        for name, (best, curve) in rows.items():
            last = best.history[-1]
            soon = next((f"{seconds:.2f}" for seconds, error in curve if error <= 1.05 * smallest), "not reached")
            print(f"{name:18} {best.value:8.2f}  {last.iteration:10}  {last.seconds:7.2f}  {curve[-1][1]:.3f}  {soon}")
        print(flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 64)
