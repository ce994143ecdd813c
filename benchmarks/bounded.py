"""Bounded lbfgs beside SciPy's L-BFGS-B: evaluations for the same loss, on ten problems of different kinds.

Run ``python -m benchmarks.bounded`` in the root of the repository. Counted are the evaluations of loss and gradient
until the loss is within a share of 1e-6 of the one that SciPy ends at; limit: 1.5 times those that SciPy takes.
"""

import autograd.numpy as anp
import numpy as np
import scipy.sparse
from scipy.optimize import minimize

import sparsedp as dp

__all__ = ["PROBLEMS", "compared"]

SAME = 1e-6  # share of the loss


def tomography(rng):
    """300 rays through 64 x 64 cells, a smooth image that is nowhere negative."""
    n, rays = 64, 300
    angle, offset = rng.uniform(0, np.pi, rays), rng.uniform(-0.4, 0.4, rays)
    t = np.linspace(-0.7, 0.7, 2 * n)[None]
    x = 0.5 + offset[:, None] * -np.sin(angle)[:, None] + t * np.cos(angle)[:, None]
    y = 0.5 + offset[:, None] * np.cos(angle)[:, None] + t * np.sin(angle)[:, None]
    seen = (x > 0) & (x < 1) & (y > 0) & (y < 1)
    ray, cell = np.nonzero(seen)[0], (x[seen] * n).astype(int) * n + (y[seen] * n).astype(int)
    lengths = np.full(ray.size, 1.4 / (2 * n))
    grid = dp.Grid((n, n), size=1.0)
    line = dp.from_matrix(scipy.sparse.csr_array((lengths, (ray, cell)), (rays, n * n)), grid.cells, rays)
    cx, cy = grid.centres()
    truth = 1.0 * ((cx - 0.4) ** 2 + (cy - 0.6) ** 2 < 0.04) + 0.5 * ((cx - 0.7) ** 2 + (cy - 0.3) ** 2 < 0.01)
    data, slopes = line(truth) + 0.002 * rng.standard_normal(rays), dp.gradient(grid)
    return (
        lambda u: 0.5 * anp.sum((line(u) - data) ** 2) + 1e-8 * anp.sum(slopes(u) ** 2),
        np.full((n, n), 0.1),
        (0.0, None),
    )


def nonnegative_least_squares(rng):
    """A random matrix of 200 x 100, condition 100."""
    matrix = np.linalg.qr(rng.standard_normal((200, 100)))[0] * np.geomspace(1, 100, 100)
    matrix = matrix @ np.linalg.qr(rng.standard_normal((100, 100)))[0]
    data = matrix @ np.maximum(rng.standard_normal(100), 0) + rng.standard_normal(200)
    return lambda x: 0.5 * anp.sum((anp.dot(matrix, x) - data) ** 2), np.ones(100), (0.0, None)


def _valley(x):
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def rosenbrock_2(rng):
    """Two unknowns, the minimum on a bound."""
    return _valley, np.array([-1.2, 1.0]), (-2.0, np.array([0.8, 2.0]))


def rosenbrock_100(rng):
    """A hundred unknowns, every third with an upper bound below 1."""
    return _valley, rng.uniform(-1, 0.4, 100), (-1.5, np.where(np.arange(100) % 3, 2.0, 0.5))


def deconvolution(rng):
    """A signal of spikes behind a Gaussian blur, nowhere negative."""
    n = 200
    at = np.arange(n)
    blur = np.exp(-0.5 * ((at[:, None] - at) / 3.0) ** 2)
    truth = np.zeros(n)
    truth[rng.choice(n, 12, replace=False)] = rng.uniform(0.5, 2.0, 12)
    data = blur @ truth + 0.01 * rng.standard_normal(n)
    return lambda u: anp.sum((anp.dot(blur, u) - data) ** 2) + 1e-3 * anp.sum(u**2), np.full(n, 0.1), (0.0, None)


def box_quadratic(rng):
    """500 unknowns, condition 1e4, a random half of which end on a bound."""
    n = 500
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    matrix = (basis * np.geomspace(1e-2, 1e2, n)) @ basis.T
    linear = matrix @ rng.uniform(-2, 2, n)
    return lambda x: 0.5 * anp.dot(x, anp.dot(matrix, x)) - anp.dot(linear, x), np.zeros(n), (-1.0, 1.0)


def obstacle(rng):
    """A membrane over an obstacle: 32 x 32 unknowns, in contact on a part that is to be found."""
    grid = dp.Grid((32, 32), size=1.0)
    stiff = -dp.laplacian(grid, dp.dirichlet)
    x, y = grid.centres()
    below = 0.5 - 4 * ((x - 0.4) ** 2 + (y - 0.5) ** 2)
    return lambda u: anp.sum(0.5 * u * stiff(u) + 2.0 * u) / 1024, np.maximum(below, 0.0), (below, None)


def poisson_control(rng):
    """The source of a Poisson problem, between -1 and 1, for a state that it cannot reach."""
    grid = dp.Grid((32, 32), size=1.0)
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet))
    x, y = grid.centres()
    wanted = 0.05 * np.sin(2 * np.pi * x) * np.sin(np.pi * y)
    return lambda f: anp.sum((solve(f) - wanted) ** 2) + 1e-6 * anp.sum(f**2), np.zeros((32, 32)), (-1.0, 1.0)


def logistic_regression(rng):
    """400 samples of 50 features, weights between -1/2 and 1/2."""
    features = rng.standard_normal((400, 50)) * np.geomspace(0.1, 3, 50)
    signs = np.sign(features @ rng.standard_normal(50) + rng.standard_normal(400))
    loss = lambda w: anp.mean(anp.logaddexp(0.0, -signs * anp.dot(features, w))) + 1e-4 * anp.sum(w**2)
    return loss, np.zeros(50), (-0.5, 0.5)


def conductivity(rng):
    """The conductivity of 24 x 24 cells, between 0.1 and 1, that keeps a heated plate cool."""
    grid = dp.Grid((24, 24), size=1.0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    average, heat = dp.average(grid), np.ones(grid.shape)
    return (
        lambda k: anp.mean(heat * solve(average(k), heat)) + 0.05 * anp.mean(k**2),
        np.full(grid.shape, 0.4),
        (0.1, 1.0),
    )


def degenerate(rng):
    """Bounds that hold with multipliers from 1 down to 1e-8: which of them are active is hard to see."""
    n = 60
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    matrix = (basis * np.geomspace(1, 100, n)) @ basis.T
    known = np.where(np.arange(n) % 2, 0.0, rng.uniform(0.1, 1, n))
    push = np.where(np.arange(n) % 2, np.geomspace(1, 1e-8, n), 0.0)
    return (
        lambda x: 1.0 + 0.5 * anp.dot(x - known, anp.dot(matrix, x - known)) + anp.dot(push, x),
        np.full(n, 0.5),
        (0.0, None),
    )


PROBLEMS = [
    tomography,
    nonnegative_least_squares,
    rosenbrock_2,
    rosenbrock_100,
    deconvolution,
    box_quadratic,
    obstacle,
    poisson_control,
    logistic_regression,
    conductivity,
    degenerate,
]


class Counted:
    """A loss and its gradient, that writes down every loss that it gave."""

    def __init__(self, loss, shape):
        self.both, self.shape, self.seen = dp.value_and_grad(loss), shape, []

    def __call__(self, x):
        value, slope = self.both(np.reshape(x, self.shape))
        self.seen.append(value)
        return value, np.ravel(slope)


def compared(problem, seed=0):
    """Return our result, and the evaluations that we and SciPy need to reach the final loss of SciPy."""
    loss, start, (lower, upper) = problem(np.random.default_rng(seed))
    sides = [np.broadcast_to(np.nan if side is None else side, start.shape).ravel() for side in (lower, upper)]
    pairs = [tuple(None if np.isnan(side) else side for side in pair) for pair in zip(*sides)]
    counted, options = Counted(loss, start.shape), {"maxiter": 2000, "maxfun": 20000, "ftol": 1e-14, "gtol": 1e-12}
    known = minimize(counted, start.ravel(), jac=True, bounds=pairs, method="L-BFGS-B", options=options)
    goal = known.fun + SAME * abs(known.fun)
    best = dp.minimize(
        loss, start, bounds=(lower, upper), maxiter=2000, tolerance=lambda record, first: record.value <= goal
    )
    ours = best.evaluations if best.value <= goal else np.inf
    return best, ours, int(np.argmax(np.array(counted.seen) <= goal)) + 1


if __name__ == "__main__":
    for problem in PROBLEMS:
        best, ours, scipys = compared(problem)
        print(
            f"{problem.__name__:26s} {ours:4.0f} evaluations, SciPy {scipys:4d}: {ours / scipys:4.2f} (limit 1.5); "
            f"loss {best.value:.8g}, {best.history[-1].seconds:.2f} s",
            flush=True,
        )
