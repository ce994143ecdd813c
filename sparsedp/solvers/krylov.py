"""Krylov engines: conjugate gradients for symmetric operators, GMRES for the rest, around any preconditioner.

Conjugate gradients run on S = sign * diag(w) * A, symmetric and positive, with w the volumes on
stretched grids. Then A x = b is S x = sign w b, and A^T y = g is S z = sign g with y = w z.
"""

from functools import partial
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import ConvergenceError
from sparsedp.fields import is_whole
from sparsedp.operator import Operator
from sparsedp.solvers.contract import Engine, norm
from sparsedp.solvers.iterations import conjugate_gradients, gmres
from sparsedp.solvers.nullspace import ROUNDING
from sparsedp.solvers.record import failure
from sparsedp.structure.base import probes
from sparsedp.tape import plain

__all__ = ["Krylov", "krylov_engine"]

RESTART = 30
MOST_NUMBERS = 2**27  # in the basis of GMRES: 1 GB


def krylov_engine(system, *, preconditioner=None, diff="implicit", iterations=None):
    """System -> Krylov: conjugate gradients when the operator is symmetric and definite, else GMRES.

    Parameters
    ----------
    system : System
    preconditioner : None, "jacobi", Operator, or callable on fields, optional
        Approximates the inverse of the operator; symmetric when the operator is.
    diff : "implicit" or "unrolled"
        How derivatives are made: by one adjoint solve, or through the iterations themselves. The
        latter costs memory and time for each iteration; it is there to compare, and to train `start`.
    iterations : int, optional
        Exactly this many iterations, whatever the residual: then nothing is refined and nothing raised.

    Returns
    -------
    Krylov

    Raises
    ------
    ValueError
        If an option is out of range, or an unrolled solve is asked of an operator that is not symmetric.
    """
    if diff not in ("implicit", "unrolled"):
        raise ValueError(f"diff must be 'implicit' or 'unrolled', got {diff!r}")
    if iterations is not None and not is_whole(iterations, 1):
        raise ValueError(f"iterations must be a whole number >= 1 or None, got {iterations!r}")
    engine = Krylov(system, _preconditioner(system, preconditioner), iterations=iterations and int(iterations))
    if diff == "unrolled":
        if system.weights is None or preconditioner is not None:
            raise ValueError("diff='unrolled' needs a symmetric operator and no preconditioner; write diff='implicit'")
        engine.unrolled = True
    return engine


class Krylov(Engine):
    """The engine around a preconditioner.

    Parameters
    ----------
    system : System
    precondition : callable or None
        precondition(r, transposed) -> z ~ A^-1 r (A^-T r), fresh. With `of_symmetric`, z ~ S^-1 r instead.
    of_symmetric : bool
    maxiter : int, optional
        Used when the system does not say.
    iterations : int, optional
        See `krylov_engine`.
    """

    method = "krylov"
    iterative = True
    overwrites = False
    precondition: Any = None

    def __init__(self, system, precondition=None, of_symmetric=False, maxiter=None, iterations=None):
        self.system = system
        if precondition is not None:  # subclasses bring a method of this name
            self.precondition = precondition
        self.of_symmetric = of_symmetric
        self.sign = system.sign or _probed_sign(system)
        self.symmetric = system.symmetric and self.sign != 0
        self.maxiter = iterations or system.maxiter or maxiter or int(np.clip(4 * system.size, 100, 20_000))
        self.iterations = iterations
        self.refines = iterations is None
        self.window = max(50, self.maxiter // (2 if self.precondition is None else 8))
        self.restart = int(np.clip(MOST_NUMBERS // max(system.size, 1), 8, RESTART))
        self.hierarchy = (
            "conjugate gradients" if self.symmetric else f"GMRES, restarted after {self.restart} iterations"
        )

    def solve(self, b, goal, transposed):
        """Iterate until |b - A x| <= goal."""
        goal = 0.9 * goal if self.refines else 0.0  # some room for the true residual
        data, size = norm(b), self.system.norm(transposed)

        def accepted(residual, solution):
            if residual <= goal:
                return True
            x = solution()
            near = self.refines and residual <= ROUNDING * (size * norm(x) + data)
            return near and residual <= self.system.rounding(x, data, transposed)

        return (self._conjugate_gradients if self.symmetric else self._gmres)(b, goal, accepted, transposed)

    def _conjugate_gradients(self, b, goal, accepted, transposed):
        system, sign, weights = self.system, self.sign, self.system.weights
        factor = sign * weights

        def apply(p):
            q = system.product(p)
            q *= factor
            return q

        def measure(r):
            return norm(r) if transposed else norm(r / weights)

        def tested(residual, x):
            return accepted(residual, lambda: weights * x if transposed else x)

        b = sign * b if transposed else factor * b
        x, used, word = conjugate_gradients(
            apply, b, self._for_symmetric(factor), measure, tested, self.maxiter, self.window, self.refines
        )
        return (weights * x if transposed else x), used, word

    def _for_symmetric(self, factor):
        space = self.system.null_space
        if self.precondition is None:
            return np.copy
        if self.of_symmetric:
            return lambda r: space.project(self.precondition(r, False))
        return lambda r: space.project(self.precondition(r / factor, False))

    def _gmres(self, b, goal, accepted, transposed):
        system = self.system

        def precondition(r):
            z = r.copy() if self.precondition is None else self.precondition(r, transposed)
            return system.null_space.project(z, transposed)

        def tested(residual, x):
            return accepted(residual, lambda: x)

        apply = partial(system.product, transposed=transposed)
        return gmres(apply, b, precondition, goal, tested, self.maxiter, self.restart)

    def unroll(self, b, start, transposed, run):
        """Conjugate gradients on the tape, in the inner product in which the operator is symmetric."""
        system = self.system
        op = system.given.T if transposed else system.given
        weights = np.broadcast_to(system.weights, system.size).reshape(op.domain.shape)
        weights = 1.0 / weights if transposed else weights
        x = anp.zeros(op.domain.shape) if start is None else start
        r = b - op(x) if start is not None else b * 1.0
        p, rr = r, anp.sum(weights * r * r)
        data = norm(np.ravel(np.asarray(plain(b), dtype=float)))
        goal = system.rtol * data
        for number in range(self.maxiter + 1):
            residual = norm(np.ravel(np.asarray(plain(r), dtype=float)))
            if residual == 0 or number == self.iterations or (self.iterations is None and residual <= goal):
                run.iterations = number
                run.status = "max_iterations" if residual > goal else "converged" if data else "exact_zero_rhs"
                return x
            q = op(p)
            step = rr / anp.sum(weights * p * q)
            x, r = x + step * p, r - step * q
            rr, before = anp.sum(weights * r * r), rr
            p = r + (rr / before) * p
        raise ConvergenceError(
            f"unrolled {self.method} on {op}: relative residual {residual * system.rtol / goal:.1e} "
            f"after {self.maxiter} iterations, wanted {system.rtol:g}",
            info=failure("max_iterations"),
            best=plain(x),
        )


def _probed_sign(system):
    """The sign of x.Ax, for an operator whose diagonal is not known."""
    if system.diagonal is not None or system.weights is None:
        return 0
    signs = {np.sign(x @ (system.weights * system.product(x))) for x in probes(system.size)}
    return int(signs.pop()) if len(signs) == 1 else 0


def _preconditioner(system, given):
    """The option -> precondition(r, transposed) on flat arrays, or None."""
    if given is None:
        return None
    if isinstance(given, str) and given == "jacobi" and system.sign:
        inverse = np.where(system.diagonal == 0, 0.0, 1.0 / np.where(system.diagonal == 0, 1.0, system.diagonal))
        return lambda r, transposed: r * inverse
    if isinstance(given, Operator):
        scale = 2.0**system.exponent
        return lambda r, transposed: scale * (given.T if transposed else given)._flat.apply(r)
    if callable(given):
        shape = system.op.domain.shape
        return lambda r, transposed: np.array(given(r.reshape(shape)), dtype=float).reshape(-1)
    raise ValueError(
        f"preconditioner must be None, 'jacobi' (for a diagonal of one sign), an Operator or a function, got {given!r}"
    )
