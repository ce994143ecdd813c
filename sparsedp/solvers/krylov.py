"""Krylov engines: conjugate gradients for symmetric operators, GMRES for the rest, around any preconditioner.

Conjugate gradients run on S = sign * diag(w) * A, symmetric and positive, with w the volumes on
stretched grids. Then A x = b is S x = sign w b, and A^T y = g is S z = sign g with y = w z.

Both keep the best iterate, and name what went wrong with a status word ("" when nothing did).
"""

from itertools import count
from typing import Any

import autograd.numpy as anp
import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from sparsedp.solvers.nullspace import ROUNDING
from sparsedp.solvers.scaling import dot, norm
from sparsedp.solvers.solve import Engine
from sparsedp.structure.base import probes
from sparsedp.tape import plain

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

        if self.symmetric:
            return self._conjugate_gradients(b, accepted, transposed)
        x, used, word = self._gmres(b.astype(self.dtype, copy=False), goal, accepted, transposed)
        return (x if b.dtype == self.dtype else x.real.copy()), used, word

    def _conjugate_gradients(self, b, accepted, transposed):
        """Preconditioned conjugate gradients from 0, until accepted(|b - A x|, x)."""
        system, weights = self.system, self.system.weights
        factor, gauged = self.sign * weights, not transposed and not np.isscalar(weights)
        r = self.sign * b if transposed else factor * b
        x, scratch, best, found = np.zeros_like(r), np.empty_like(r), np.zeros_like(r), 0
        first = least = norm(r / weights if gauged else r)
        z = self._corrected(r, factor)
        p, rz, word = z.copy(), dot(r, z), "max_iterations"
        for number in range(1, self.maxiter + 1):
            q = system.product(p)
            q *= factor
            # What rounding leaves along the null space no step can take back: residuals would end on it.
            q = system.null_space.project(q, True, into=q)
            pq = dot(p, q)
            if not (pq > 0 and rz > 0):
                number, word = number - 1, _without_descent(pq, rz, p, q, r, z)
                break
            x += np.multiply(p, rz / pq, out=scratch)
            r -= np.multiply(q, rz / pq, out=scratch)
            residual = norm(r / weights if gauged else r)
            if accepted(residual, weights * x if transposed else x):
                best, word = x, ""
                break
            if not np.isfinite(residual) or residual > DIVERGED * first:
                word = "diverged"
                break
            if residual < least:
                np.copyto(best, x)
                least, found = residual, number
            if number - found >= self.window:
                word = "stagnated"
                break
            z = self._corrected(r, factor)
            rz, before = dot(r, z), rz
            p *= rz / before
            p += z
        else:
            best = best if self.refines else x  # of a fixed number of iterations, the last iterate
        return (weights * best if transposed else best), number, word

    def _corrected(self, r, factor):
        """z ~ S^-1 r, a fresh array or r itself."""
        if self.precondition is None:
            return r
        return self.system.null_space.project(self.precondition(r / factor, False))

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

    def unroll(self, b, start, transposed):
        """As `solve`, on the tape: conjugate gradients in the inner product in which the operator is symmetric."""
        system = self.system
        op = system.given.T if transposed else system.given
        weights = np.broadcast_to(system.weights, system.size).reshape(op.domain.shape)
        weights = 1.0 / weights if transposed else weights
        x = anp.zeros(op.domain.shape) if start is None else start
        r = b * 1.0 if start is None else b - op(x)
        p, rr = r, anp.sum(weights * r * r)
        data = _plain_norm(b)
        goal = system.rtol * data
        for number in count():
            residual = _plain_norm(r)
            if residual == 0 or number == self.maxiter or (self.refines and residual <= goal):
                word = "max_iterations" if residual > goal else "converged" if data else "exact_zero_rhs"
                return x, number, word
            q = op(p)
            step = rr / anp.sum(weights * p * q)
            x, r = x + step * p, r - step * q
            rr, before = anp.sum(weights * r * r), rr
            p = r + (rr / before) * p


def _plain_norm(x):
    """Norm of a field, traced or not."""
    return norm(np.ravel(np.asarray(plain(x), dtype=float)))


def _probed_sign(system):
    """The sign of x.Ax, for an operator whose diagonal is not known."""
    if system.diagonal is not None or system.weights is None:
        return 0
    signs = {np.sign(x @ (system.weights * system.product(x))) for x in probes(system.size)}
    return int(signs.pop()) if len(signs) == 1 else 0


# ---------------------------------------------------------------- the iterations


def _without_descent(pq, rz, p, q, r, z):
    """Why p.Sp or r.z is not positive: rounding, or an operator that is not definite."""
    if not np.isfinite(pq) or not np.isfinite(rz):
        return "diverged"
    noise = 1e-13 * np.sqrt(dot(p, p) * dot(q, q)), 1e-13 * np.sqrt(dot(r, r) * dot(z, z))
    return "stagnated" if abs(pq) <= noise[0] or abs(rz) <= noise[1] else "indefinite_operator"
