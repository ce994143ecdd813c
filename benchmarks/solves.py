"""One row of a table for one way to solve: set-up, first call, forward and adjoint, and how wrong they are."""

from time import perf_counter

import numpy as np
from scipy.sparse import csr_matrix

import sparsedp as dp

__all__ = ["HEAD", "PyAMG", "Ours", "row", "times"]

HEAD = (
    f"{'scene':20}{'method':23}{'set-up s':>9}{'first s':>9}{'forward s':>10}{'adjoint s':>10}{'iterations':>11}"
    f"{'residual':>10}{'backward':>9}{'adjoint error':>14}  status"
)


class Ours:
    """A method of `dp.inverse`."""

    def __init__(self, op, method, **options):
        start = perf_counter()
        self.inverse = dp.inverse(op, method, nullspace="project", **options)
        self.setup = perf_counter() - start
        self.name = f"auto: {self.inverse.method}" if method == "auto" else method

    def forward(self, b):
        return self.inverse(b)

    def adjoint(self, g):
        return self.inverse.T(g)

    def words(self):
        """(iterations forward/adjoint, status of the forward solve)."""
        info = self.inverse.info
        return f"{info.forward.iterations}/{info.adjoint.iterations}", info.forward.status


class PyAMG:
    """PyAMG at its best here: Ruge-Stueben, Gauss-Seidel there and back, V-cycle, conjugate gradients."""

    def __init__(self, op, rtol=1e-10):
        from pyamg import ruge_stuben_solver

        matrix = csr_matrix(op.matrix)
        start = perf_counter()
        sweeps = dict(
            presmoother=("gauss_seidel", {"sweep": "forward"}), postsmoother=("gauss_seidel", {"sweep": "backward"})
        )
        self.built = ruge_stuben_solver(matrix, CF=("RS", {"second_pass": True}), max_coarse=100, **sweeps)
        self.setup, self.rtol, self.name = perf_counter() - start, rtol, "pyamg RS + CG"
        self.used = 200

    def forward(self, b):
        """Later calls stop where the residual of the first one had come down to twice its least value."""
        residuals: list = []
        x = self.built.solve(b.reshape(-1), tol=self.rtol, accel="cg", maxiter=self.used, residuals=residuals)
        self.used = max(1, int(np.argmax(np.array(residuals) <= 2 * np.min(residuals))))
        return x.reshape(b.shape)

    adjoint = forward  # the operators it is given are symmetric

    def words(self):
        return f"{self.used}/{self.used}", "not judged"


def times(task, repeats):
    """Smallest of a few times [s]."""
    found = []
    for _ in range(repeats):
        start = perf_counter()
        task()
        found.append(perf_counter() - start)
    return min(found)


def row(scene, op, make, repeats=3):
    """Print a row, and return the seconds of one solve and of the set-up; both are NaN if the solve fails."""
    generator = np.random.default_rng(5)
    kept = op.T.apply(op.apply(generator.random(op.domain.shape))) != 0  # solid cells hold no equation
    b, g = generator.standard_normal((2, *op.domain.shape)) * kept
    way = None
    try:
        way = make(op)
        first = times(lambda: way.forward(b), 1)
        forward, adjoint = (times(lambda solve=solve: solve(g), repeats) for solve in (way.forward, way.adjoint))
    except dp.errors.ConvergenceError as error:
        print(f"{scene:20}{way.name if way else 'set-up':23} {error}", flush=True)
        return float("nan"), way.setup if way else float("nan")
    used, status = way.words()
    print(
        f"{scene:20}{way.name:23}{way.setup:9.3f}{first:9.3f}{forward:10.4f}{adjoint:10.4f}{used:>11}"
        f"{_errors(op, b, g, way.forward(b), way.adjoint(g))}  {status}",
        flush=True,
    )
    return forward, way.setup


def _errors(op, b, g, x, y):
    """True relative residual, backward error, and what the adjoint identity x.g = b.y leaves."""
    rest, data, length = (float(np.linalg.norm(v)) for v in (b - op.apply(x), b, x))
    size = float(abs(op.matrix).sum(axis=1).max()) if x.size <= 2**21 else float("nan")
    wrong = abs(np.vdot(x, g) - np.vdot(b, y)) / (length * np.linalg.norm(g))
    return f"{rest / data:10.1e}{rest / (size * length + data):9.1e}{wrong:14.1e}"
