"""Posteriors of a heat source from 1000 sensors: seconds, products with the Hessian, and errors beside dense matrices.

The source in Poisson's equation on n x n cells has a Matern prior, either a power of a separable operator, or a product
of multigrid solves, for which only products are known. The noise is 5 % of the largest temperature. The columns are

- the eigenpairs above the tolerance of 0.01, and the products with the Hessian (one JVP and one VJP each); a double
  pass with the same rank and an oversampling of 10 takes 2 (k + 10),
- seconds of `laplace`, of `variance` and of one sample, and of one gradient of the misfit,
- the largest relative error of variances, of standard deviations of 10 sums and of the information gain, where the
  number of unknowns allows dense matrices.

Run ``python -m benchmarks.posterior`` in the root of the repository, or ``python -m benchmarks.posterior 64`` for one
grid. The multigrid prior is used up to 128 x 128 cells.
"""

import sys
import time
import warnings

import autograd.numpy as anp
import numpy as np

import sparsedp as dp

__all__ = ["Problem", "row"]

MOST_DENSE = 4096  # unknowns up to which the exact posterior is computed
MOST_MULTIGRID = 128  # cells along an axis
SENSORS = 1000
KAPPA_SQUARED = 100.0


class Problem:
    """A source, its sensors, and noisy data, whose posterior mean is known up to the accuracy of two Newton steps."""

    def __init__(self, cells, separable=True):
        self.grid = dp.Grid((cells, cells), size=1.0)
        A = KAPPA_SQUARED * dp.identity(self.grid.cells) - dp.laplacian(self.grid)
        scale = np.sqrt(4 * np.pi * KAPPA_SQUARED) * cells  # standard deviations of about 1
        self.root = scale * (dp.matrix_power(A, -1) if separable else dp.inverse(A, "multigrid"))
        self.prior = self.root @ self.root
        self.options = {} if separable else {"prior_root": self.root}
        self.solve = dp.inverse(-dp.laplacian(self.grid, dp.dirichlet))
        rng = np.random.default_rng(0)
        self.sensors = dp.sample(self.grid, rng.uniform(0.05, 0.95, (SENSORS, 2)))
        self.truth = self.root(rng.standard_normal(self.grid.shape))
        exact = self.readings(self.truth)
        self.noise = 0.05 * np.max(np.abs(exact))
        self.data = exact + self.noise * rng.standard_normal(SENSORS)

    def readings(self, source):
        """Temperatures at the sensors."""
        return self.sensors(self.solve(source))

    def residuals(self, source):
        """Differences from the data in standard deviations."""
        return (self.readings(source) - self.data) / self.noise

    def posterior(self, source):
        """The posterior at a source, without a warning if it is not the mode."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", dp.errors.PosteriorWarning)
            return dp.laplace(self.residuals, source, self.prior, **self.options)

    def exact(self):
        """The exact mean and covariance, and the information gain, by dense matrices."""
        n = self.grid.cells.size
        units = np.eye(n).reshape(n, *self.grid.shape)
        C = self.prior(units).reshape(n, n)
        J = self.readings_of_all(units).T / self.noise
        CJ = C @ J.T
        gram = J @ CJ
        gain = np.linalg.solve(gram + np.eye(SENSORS), CJ.T)
        weights = np.linalg.solve(gram + np.eye(SENSORS), self.data / self.noise)
        mean = CJ @ weights
        values = np.linalg.eigvalsh(gram)
        divergence = 0.5 * (np.sum(np.log1p(values) - values / (1 + values)) + weights @ gram @ weights)
        return mean.reshape(self.grid.shape), C - CJ @ gain, divergence

    def readings_of_all(self, sources):
        """Temperatures at the sensors for each of many sources."""
        return np.array([self.readings(source) for source in sources])


def seconds_of(function, *args):
    """The result of a call, and its time."""
    started = time.perf_counter()
    result = function(*args)
    return result, time.perf_counter() - started


def row(cells, separable=True):
    """The figures of one grid, as a dict."""
    problem = Problem(cells, separable)
    start = np.zeros(problem.grid.shape)
    loss = dp.value_and_grad(lambda source: 0.5 * anp.sum(problem.residuals(source) ** 2))
    loss(start)
    _, gradient = seconds_of(loss, start)
    first, _ = seconds_of(problem.posterior, start)
    posterior, seconds = seconds_of(problem.posterior, first.step)
    variance, of_variance = seconds_of(posterior.variance)
    _, of_sample = seconds_of(posterior.sample, 1)
    rank = len(posterior.eigenvalues)
    figures = {
        "prior": "separable" if separable else "multigrid",
        "unknowns": start.size,
        "eigenpairs": rank,
        "products": posterior.products,
        "double pass": 2 * (rank + 10),
        "laplace": seconds,
        "variance": of_variance,
        "sample": of_sample,
        "gradient": gradient,
        "stated": posterior.error,
    }
    if start.size <= MOST_DENSE and separable:
        mean, covariance, divergence = problem.exact()
        sums = np.random.default_rng(1).standard_normal((10, start.size))
        exact = np.sqrt(np.diag(sums @ covariance @ sums.T))
        deviations = posterior.std_of(lambda x: anp.dot(sums, anp.reshape(x, -1)))
        figures["mean"] = np.max(np.abs(posterior.x + posterior.step - mean) / np.sqrt(variance))
        figures["variances"] = np.max(np.abs(variance.reshape(-1) / np.diag(covariance) - 1))
        figures["deviations"] = np.max(np.abs(deviations / exact - 1))
        figures["gain"] = abs(posterior.information_gain / divergence - 1)
    return figures


def main():
    """Print one line for each grid and prior."""
    sizes = [int(word) for word in sys.argv[1:]] or [64, 128, 316]
    for cells in sizes:
        for separable in (True, False):
            if separable or cells <= MOST_MULTIGRID:
                shown = row(cells, separable).items()
                print(", ".join(f"{name} {value:.3g}" if name != "prior" else value for name, value in shown))


if __name__ == "__main__":
    main()
