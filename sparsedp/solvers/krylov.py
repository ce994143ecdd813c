"""Krylov engines: conjugate gradients for symmetric operators, GMRES for the rest, around any preconditioner.

Conjugate gradients run in the inner product in which the operator is symmetric: that of the volumes w on stretched
grids, where W A = A^T W, and for A^T that of 1 / w.

Both keep the best iterate, and name what went wrong with a status word ("" when nothing did).
"""

from typing import Any

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from sparsedp.autodiff.tape import plain
from sparsedp.operators.structure.base import probes
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import ROUNDING
from sparsedp.solvers.scaling import dot, norm

__all__ = ["Krylov"]

RESTART = 30
DIVERGED = 1e8  # growth of the residual over the first one
MOST_NUMBERS = 2**27  # in the basis of GMRES, a complex one is two: 1 GB


class Krylov(Engine):
    """The engine around a preconditioner.

    Parameters
    ----------
    system : System
    precondition : callable or None
        precondition(r, transposed) -> z ~ A^-1 r (A^-T r), fresh.
    maxiter : int, optional
        Used when the system does not say.
    iterations : int, optional
        See `krylov_engine` in preconditioners.py.
    dtype : float64 or complex128
        In which is iterated: complex where the operator is, or what preconditions it.
    """

    method = "krylov"
    iterative = True
    precondition: Any = None

    def __init__(self, system, precondition=None, maxiter=None, iterations=None, dtype=float):
        self.system, self.dtype = system, np.result_type(system.op.dtype, dtype)
        if precondition is not None:  # subclasses bring a method of this name
            self.precondition = precondition
        self.sign = system.sign or _probed_sign(system) if self.dtype == float else 0
        self.symmetric = system.symmetric and self.sign != 0
        self.maxiter = iterations or system.maxiter or maxiter or int(np.clip(4 * system.size, 100, 20_000))
        self.iterations = iterations
        self.refines = iterations is None
        self.window = max(50, self.maxiter // (2 if self.precondition is None else 8))
        numbers = max(system.size, 1) * self.dtype.itemsize // 8
        self.restart = int(np.clip(MOST_NUMBERS // numbers, 8, RESTART))
        self.hierarchy = (
            "conjugate gradients" if self.symmetric else f"GMRES, restarted after {self.restart} iterations"
        )

    def solve(self, b, goal, transposed):
        """Iterate until |b - A x| <= goal."""
        goal = 0.9 * goal if self.refines else 0.0  # some room for the true residual
        data, size = norm(b), self.system.norm(transposed)

        def accepted(residual, x):
            if residual <= goal:
                return True
            near = self.refines and residual <= ROUNDING * (size * norm(x) + data)
            return near and residual <= self.system.rounding(x, data, transposed)

        def product(p):  # what rounding leaves along the null space no step can take back: residuals would end on it
            q = self.system.product(p, transposed)
            return self.system.null_space.project(q, transposed, into=q)

        if self.symmetric:
            return self._conjugate_gradients(b, accepted, transposed, product)
        x, used, word = self._gmres(b.astype(self.dtype, copy=False), goal, accepted, transposed)
        return (x if b.dtype == self.dtype else x.real.copy()), used, word

    def unroll(self, b, goal, transposed):
        """As `solve`, differentiable as it runs: b may be traced."""
        op = (self.system.unscaled.T if transposed else self.system.unscaled)._flat
        accepted = lambda residual, x: residual <= goal and self.refines
        return self._conjugate_gradients(b, accepted, transposed, op)

    def _conjugate_gradients(self, b, accepted, transposed, product):
        """Preconditioned conjugate gradients from 0, until accepted(|b - A x|, x); A p by ``product(p)``."""
        weights, uniform = self.system.weights, np.isscalar(self.system.weights)
        measure = 1.0 / weights if transposed else weights

        def inner(x, y):
            return self.sign * dot(x if uniform else measure * x, y)

        def corrected(r):  # z ~ A^-1 r; A^-T = W A^-1 W^-1
            if self.precondition is None:
                return self.sign * weights * r  # W A has a smaller condition number than A
            turned = transposed and not uniform
            z = weights * self.precondition(r / weights, False) if turned else self.precondition(r, False)
            return self.system.null_space.project(z, transposed)

        x = best = np.zeros(b.shape)
        r, p, found, word = b, corrected(b), 0, "max_iterations"
        z, rz, first = p, inner(r, p), norm(plain(r))
        least = first
        for number in range(1, self.maxiter + 1):
            q = product(p)
            pq = inner(p, q)
            if not (pq > 0 and rz > 0):
                number, word = number - 1, _without_descent(inner, *map(plain, (pq, rz, p, q, r, z)))
                break
            x, r = x + rz / pq * p, r - rz / pq * q
            residual = norm(plain(r))
            if accepted(residual, plain(x)):
                best, word = x, ""
                break
            if not np.isfinite(residual) or residual > DIVERGED * first:
                word = "diverged"
                break
            if residual < least:
                best, least, found = x, residual, number
            if number - found >= self.window:
                word = "stagnated"
                break
            z = corrected(r)
            rz, before = inner(r, z), rz
            p = z + rz / before * p
        else:
            best = best if self.refines else x  # of a fixed number of iterations, the last iterate
        return best, number, word

    def _gmres(self, b, goal, accepted, transposed):
        """Restarted GMRES from 0, preconditioned from the right: its residuals are those of A.

        A cycle, one call of SciPy's, ends at the residual `goal`; accepted(|b - A x|, x) is asked at the end of each.
        Source: Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 1986.
        """
        system = self.system

        def precondition(r):
            z = r.copy() if self.precondition is None else self.precondition(r, transposed)
            return system.null_space.project(z, transposed)

        right = LinearOperator((b.size,) * 2, lambda r: system.product(precondition(r), transposed), dtype=self.dtype)
        x, r, used, residual = np.zeros_like(b), b, 0, norm(b)
        while True:
            norms: list = []  # one for each iteration
            most = min(self.restart, self.maxiter - used)
            cycle = dict(rtol=0.0, atol=goal, restart=most, maxiter=1, callback=norms.append, callback_type="pr_norm")
            change = gmres(right, r, **cycle)[0]
            used += len(norms)
            trial = x + precondition(change)
            r = b - system.product(trial, transposed)
            before, residual = residual, norm(r)
            if not residual < before:
                return x, used, "stagnated" if np.isfinite(residual) else "diverged"
            x = trial
            if accepted(residual, x):
                return x, used, ""
            if used >= self.maxiter:
                return x, used, "max_iterations"
            if residual > 0.999 * before:
                return x, used, "stagnated"


def _probed_sign(system):
    """The sign of x.Ax, for an operator whose diagonal is not known."""
    if system.diagonal is not None or system.weights is None:
        return 0
    signs = {np.sign(x @ (system.weights * system.product(x))) for x in probes(system.size)}
    return int(signs.pop()) if len(signs) == 1 else 0


def _without_descent(inner, pq, rz, p, q, r, z):
    """Why p.Ap or r.z is not positive: rounding, or an operator that is not definite."""
    if not np.isfinite(pq) or not np.isfinite(rz):
        return "diverged"
    noise = 1e-13 * np.sqrt(inner(p, p) * inner(q, q)), 1e-13 * np.sqrt(inner(r, r) * inner(z, z))
    return "stagnated" if abs(pq) <= noise[0] or abs(rz) <= noise[1] else "indefinite_operator"
