"""Krylov engines: conjugate gradients for symmetric operators, GMRES for the others, with any preconditioner.

Conjugate gradients use the inner product in which the operator is symmetric: on stretched grids it is weighted by
the volumes w, where W A = A^T W, and for A^T by 1 / w.

Both keep the best iterate and return a status word if they fail.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from sparsedp.autodiff.tape import plain
from sparsedp.operators.structure.base import probes
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import ROUNDING
from sparsedp.solvers.scaling import dot, norm

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import DTypeLike

    from sparsedp.solvers.system import System

__all__ = ["Krylov"]

RESTART = 30
LARGEST_GROWTH = 1e8  # of the residual over the first one, beyond which the iteration diverges
MOST_NUMBERS = 2**27  # in the basis of GMRES, 1 GB; a complex number counts as two
LEAST_PROGRESS = 0.999  # a cycle of GMRES that leaves more of the residual stagnates
ROUGHLY_ZERO = 1e-13  # share of the sizes of two vectors below which their inner product is rounding


class Krylov(Engine):
    """The engine around a preconditioner.

    Parameters
    ----------
    system : System
    precondition : callable, optional
        ``precondition(r, transposed)`` returns z ~ A^-1 r (A^-T r) as a fresh array.
    maxiter : int, optional
        For systems that have no `maxiter`.
    iterations : int, optional
        See `krylov_engine` in preconditioners.py.
    dtype : float64 or complex128
        Of the preconditioner; the iterates are complex if it or the operator is.
    """

    method = "krylov"
    iterative = True
    precondition: Any = None

    def __init__(
        self,
        system: System,
        precondition: Callable[[np.ndarray, bool], np.ndarray] | None = None,
        maxiter: int | None = None,
        iterations: int | None = None,
        dtype: DTypeLike = float,
    ) -> None:
        self.system = system
        self.dtype = np.result_type(system.op.dtype, dtype)
        if precondition is not None:  # subclasses have a method of this name
            self.precondition = precondition
        self.sign = 0
        if self.dtype == float:
            self.sign = system.sign or _probed_sign(system)
        self.symmetric = system.symmetric and self.sign != 0
        self.iterations = iterations
        self.refines = iterations is None
        self.maxiter = iterations or system.maxiter or maxiter or int(np.clip(4 * system.size, 100, 20_000))
        self.window = max(50, self.maxiter // 2)  # iterations without progress that are allowed
        if self.precondition is not None:
            self.window = max(50, self.maxiter // 8)
        numbers = max(system.size, 1) * self.dtype.itemsize // 8
        self.restart = int(np.clip(MOST_NUMBERS // numbers, 8, RESTART))
        self.hierarchy = "conjugate gradients"
        if not self.symmetric:
            self.hierarchy = f"GMRES, restarted after {self.restart} iterations"

    def solve(self, b: np.ndarray, goal: float, transposed: bool) -> tuple[np.ndarray, int, str]:
        """Iterate until |b - A x| <= goal."""
        system = self.system
        goal = 0.9 * goal  # leaves room for the true residual
        if not self.refines:
            goal = 0.0
        data = norm(b)
        size = system.norm(transposed)

        def is_accepted(residual: float, x: np.ndarray) -> bool:
            if residual <= goal:
                return True
            if not self.refines or residual > ROUNDING * (size * norm(x) + data):
                return False
            return residual <= system.rounding(x, data, transposed)

        def product(p: np.ndarray) -> np.ndarray:
            q = system.product(p, transposed)
            # No step can remove rounding errors along the null space: residuals would stagnate at them.
            return system.null_space.project(q, transposed, into=q)

        if self.symmetric:
            return self._conjugate_gradients(b, is_accepted, transposed, product)
        x, iterations, status = self._gmres(b.astype(self.dtype, copy=False), goal, is_accepted, transposed)
        if b.dtype != self.dtype:
            x = x.real.copy()
        return x, iterations, status

    def unroll(self, b: Any, goal: float, transposed: bool) -> tuple[Any, int, str]:
        """Iterate as `solve` does; b may be traced, and the iterations are recorded."""
        op = self.system.operator(transposed)

        def is_accepted(residual: float, x: np.ndarray) -> bool:
            return residual <= goal and self.refines

        return self._conjugate_gradients(b, is_accepted, transposed, op._flat)

    def _conjugate_gradients(
        self, b: Any, is_accepted: Callable, transposed: bool, product: Callable
    ) -> tuple[Any, int, str]:
        """Iterate by preconditioned conjugate gradients from 0.

        Parameters
        ----------
        b : array
            May be traced.
        is_accepted : callable
            ``is_accepted(residual, x)``, where `residual` is the norm of b - A x.
        transposed : bool
        product : callable
            ``product(p)`` returns A p.
        """
        weights = self.system.weights
        is_uniform = np.isscalar(weights)
        measure = weights
        if transposed:
            measure = 1.0 / weights

        def inner(x: Any, y: Any) -> Any:
            weighted = x if is_uniform else measure * x
            return self.sign * dot(weighted, y)

        def preconditioned(r: Any) -> Any:  # z ~ A^-1 r; A^-T = W A^-1 W^-1
            if self.precondition is None:
                return self.sign * weights * r  # W A has a smaller condition number than A
            if transposed and not is_uniform:
                z = weights * self.precondition(r / weights, False)
            else:
                z = self.precondition(r, False)
            return self.system.null_space.project(z, transposed)

        x = np.zeros(b.shape)
        best = x
        best_iteration = 0
        r = b
        z = preconditioned(b)
        p = z
        rz = inner(r, z)
        first_residual = norm(plain(r))
        least_residual = first_residual
        iteration = 0
        while iteration < self.maxiter:
            q = product(p)
            pq = inner(p, q)
            if not (pq > 0 and rz > 0):
                return best, iteration, _reason_without_descent(inner, *map(plain, (pq, rz, p, q, r, z)))
            iteration += 1
            x = x + rz / pq * p
            r = r - rz / pq * q
            residual = norm(plain(r))
            if is_accepted(residual, plain(x)):
                return x, iteration, ""
            if not np.isfinite(residual) or residual > LARGEST_GROWTH * first_residual:
                return best, iteration, "diverged"
            if residual < least_residual:
                best = x
                best_iteration = iteration
                least_residual = residual
            if iteration - best_iteration >= self.window:
                return best, iteration, "stagnated"
            z = preconditioned(r)
            last_rz = rz
            rz = inner(r, z)
            p = z + rz / last_rz * p
        if not self.refines:  # of a fixed number of iterations, the last iterate
            best = x
        return best, iteration, "max_iterations"

    def _gmres(
        self, b: np.ndarray, goal: float, is_accepted: Callable, transposed: bool
    ) -> tuple[np.ndarray, int, str]:
        """Iterate by restarted GMRES from 0, preconditioned from the right: its residuals are those of A.

        A cycle, one call of SciPy, ends at the residual `goal`; `is_accepted` is called at the end of each.

        References
        ----------
        Saad and Schultz, GMRES: a generalized minimal residual algorithm for solving nonsymmetric linear systems, SIAM
        Journal on Scientific and Statistical Computing 7 (1986) 856-869.
        """
        system = self.system

        def precondition(r: np.ndarray) -> np.ndarray:
            if self.precondition is None:
                z = r.copy()
            else:
                z = self.precondition(r, transposed)
            return system.null_space.project(z, transposed)

        def preconditioned_product(r: np.ndarray) -> np.ndarray:
            return system.product(precondition(r), transposed)

        operator = LinearOperator((b.size, b.size), preconditioned_product, dtype=self.dtype)
        x = np.zeros_like(b)
        r = b
        residual = norm(b)
        iterations = 0
        while True:
            norms: list[float] = []  # one for each iteration
            change, _ = gmres(
                operator,
                r,
                rtol=0.0,
                atol=goal,
                restart=min(self.restart, self.maxiter - iterations),
                maxiter=1,
                callback=norms.append,
                callback_type="pr_norm",
            )
            iterations += len(norms)
            trial = x + precondition(change)
            r = b - system.product(trial, transposed)
            last_residual = residual
            residual = norm(r)
            if not residual < last_residual:
                return x, iterations, "stagnated" if np.isfinite(residual) else "diverged"
            x = trial
            if is_accepted(residual, x):
                return x, iterations, ""
            if iterations >= self.maxiter:
                return x, iterations, "max_iterations"
            if residual > LEAST_PROGRESS * last_residual:
                return x, iterations, "stagnated"


def _probed_sign(system: System) -> int:
    """Return the sign of x.Ax for an operator whose diagonal is not known; 0 if it is not the same for all x."""
    if system.diagonal is not None or system.weights is None:
        return 0
    signs = {np.sign(x @ (system.weights * system.product(x))) for x in probes(system.size)}
    if len(signs) != 1:
        return 0
    return int(signs.pop())


def _reason_without_descent(inner: Callable, pq: float, rz: float, p: Any, q: Any, r: Any, z: Any) -> str:
    """Return why p.Ap or r.z is not positive: rounding, or an operator that is not definite."""
    if not np.isfinite(pq) or not np.isfinite(rz):
        return "diverged"
    if abs(pq) <= ROUGHLY_ZERO * np.sqrt(inner(p, p) * inner(q, q)):
        return "stagnated"
    if abs(rz) <= ROUGHLY_ZERO * np.sqrt(inner(r, r) * inner(z, z)):
        return "stagnated"
    return "indefinite_operator"
